//! Blueprints as users meet them: the shipped ones, and a corpus of broken ones with the answer each must get.

use std::path::{Path, PathBuf};
use std::{env, fs};

use dimos::blueprint::{self, Loaded, OnExit, Overrides, SearchPath, Source, Summary, find, load, load_from};

use crate::support::fake_arms;

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/blueprints")
}

fn load_fixture(name: &str, overrides: &Overrides) -> Loaded {
    let search = SearchPath { folders: vec![fixtures()] };
    let found = search.find(fixtures().join(name).to_str().unwrap()).unwrap();
    load_from(&search, &found, overrides, &fake_arms::registry())
}

/// The rendered answer, free of this machine's paths.
fn answer(name: &str) -> String {
    let text = load_fixture(name, &Overrides::default()).render(false);
    text.replace(&format!("{}/", fixtures().display()), "")
}

#[test]
fn shipped_blueprints_have_no_mistakes() {
    let (builtin, fake) = (dimos::arms::registry(), fake_arms::registry());
    let has_arms = builtin.get("yourarm").is_some() && builtin.get("mock").is_some();
    let listed = blueprint::list(&builtin);
    let shipped = listed.iter().map(|listing| listing.name.as_str());
    let needs_can = |name: &&str| cfg!(feature = "can") || !name.contains("piper");
    let names: Vec<&str> = shipped.filter(needs_can).collect();
    assert!(names.len() >= 15, "{names:?}");
    for name in names {
        let adapters = if has_arms { &builtin } else { &fake };
        let loaded = load(&find(name).unwrap(), &Overrides::default(), adapters);
        let text = loaded.render(false);
        assert!(text.is_empty(), "{name}: {text}");
        let blueprint = loaded.blueprint.unwrap();
        assert!(blueprint.arms.iter().all(|arm| !arm.is_real()), "{name} must run without hardware");
        assert_eq!(blueprint.name, name);
        // Without a name of its own: a copy is named after its file, and its poses are not those of the original.
        assert!(!blueprint.sources[0].1.lines().any(|line| line.starts_with("name:")), "{name}");
        assert!(!blueprint.description.is_empty());
        assert!(blueprint.sources[0].1.starts_with("# yaml-language-server: $schema="), "{name}");
    }
}

/// A real arm is one option away, or one line in a blueprint that includes a shipped one; both win over `sim`.
#[test]
fn an_address_makes_an_arm_real() {
    let addresses = |loaded: Loaded| -> Vec<(String, bool)> {
        let text = loaded.render(false);
        let blueprint = loaded.blueprint.unwrap_or_else(|| panic!("{text}"));
        blueprint.arms.iter().map(|arm| (arm.address.clone(), arm.is_real())).collect()
    };
    let with = |name: &str, address: &[(&str, &str)]| {
        let address = address.iter().map(|(arm, at)| ((*arm).to_owned(), (*at).to_owned())).collect();
        load(&find(name).unwrap(), &Overrides { address, ..Overrides::default() }, &dimos::arms::registry())
    };
    let at = |address: &str| (address.to_owned(), address != "sim");
    assert_eq!(addresses(with("coordinator-xarm6", &[("arm", "192.168.1.185")])), [at("192.168.1.185")]);
    assert_eq!(addresses(with("keyboard-teleop-xarm7", &[("arm", "192.168.1.185")])), [at("192.168.1.185")]);
    let one = with("coordinator-dual-xarm", &[("right_arm", "192.168.1.186")]);
    assert_eq!(addresses(one), [at("sim"), at("192.168.1.186")]);
    let wrong = with("coordinator-xarm6", &[("amr", "192.168.1.185")]).render(false);
    assert!(wrong.contains("the blueprint has no arm `amr`") && wrong.contains("did you mean `arm`?"), "{wrong}");
    assert!(with("coordinator-xarm6", &[("arm", "192.168.1.185:x")]).errors() == 1, "its form is checked");

    let folder = tempfile::tempdir().unwrap();
    let own = folder.path().join("cell.yaml");
    fs::write(&own, "include: [coordinator-xarm6]\nhardware: [{hardware_id: arm, address: 192.168.1.185}]\n").unwrap();
    let found = find(own.to_str().unwrap()).unwrap();
    let load_own = |overrides: Overrides| load(&found, &overrides, &dimos::arms::registry());
    assert_eq!(addresses(load_own(Overrides::default())), [at("192.168.1.185")]);
    assert_eq!(addresses(load_own(Overrides { sim: true, ..Overrides::default() })), [at("sim")]);
}

/// Mistakes in options that only the built-in arms can find, each located like any other.
#[test]
#[cfg(feature = "can")]
fn options_that_do_not_fit_are_located() {
    let file = fixtures().join("misfits.yaml");
    let found = SearchPath { folders: vec![fixtures()] }.find(file.to_str().unwrap()).unwrap();
    let loaded = load_from(&SearchPath::default(), &found, &Overrides::default(), &dimos::arms::registry());
    let got = loaded.render(false).replace(&format!("{}/", fixtures().display()), "");
    if env::var_os("DIMOS_REGENERATE").is_some() {
        fs::write(file.with_extension("txt"), &got).unwrap();
    }
    assert_eq!(got, fs::read_to_string(file.with_extension("txt")).unwrap());
}

/// The limits that `check` shows are those of the model, not of the number of joints.
#[test]
fn limits_are_those_of_the_model() {
    let joint = |name: &str, overrides: &[&str]| {
        let set = overrides.iter().map(|text| (*text).to_owned()).collect();
        let loaded =
            load(&find(name).unwrap(), &Overrides { set, sim: true, ..Overrides::default() }, &dimos::arms::registry());
        assert_eq!(loaded.render(false), "", "{name}");
        let lower = Summary::of(&loaded.blueprint.unwrap()).arms[0].joints[2].position_lower.unwrap().value;
        (lower * 1e6).round() / 1e6
    };
    assert_eq!(joint("coordinator-xarm6", &[]), -3.822271, "xArm 6, the narrower of its series");
    assert_eq!(joint("coordinator-lite6", &[]), -0.061087);
    assert_eq!(
        joint("coordinator-xarm6", &["hardware.arm.options.gripper=none", "hardware.arm.options.model=xarm850"]),
        -4.223697
    );
}

#[test]
fn every_broken_blueprint_gets_its_answer() {
    let mut files: Vec<PathBuf> = fs::read_dir(fixtures()).unwrap().map(|e| e.unwrap().path()).collect();
    files.retain(|f| f.extension().is_some_and(|e| e == "yaml"));
    files.retain(|f| f.file_name().unwrap().to_str().unwrap().starts_with(|c: char| c.is_ascii_digit()));
    files.sort();
    assert!(files.len() >= 14, "the corpus has {} files", files.len());
    let mut wrong = Vec::new();
    for file in files {
        let name = file.file_name().unwrap().to_str().unwrap().to_owned();
        let golden = file.with_extension("txt");
        let got = answer(&name);
        if env::var_os("DIMOS_REGENERATE").is_some() {
            fs::write(&golden, &got).unwrap();
        }
        if fs::read_to_string(&golden).unwrap_or_default() != got {
            wrong.push(format!("=== {name}\n{got}"));
        }
    }
    assert!(
        wrong.is_empty(),
        "answers changed; look at each, then run with DIMOS_REGENERATE=1 to keep them:\n{}",
        wrong.join("\n")
    );
}

/// Every `# MISTAKE` comment of the corpus marks a line that an error must point at, and errors point nowhere else.
#[test]
fn every_planted_mistake_is_found_and_nothing_else() {
    let mut planted = 0;
    for entry in fs::read_dir(fixtures()).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap().to_owned();
        if path.extension().is_none_or(|e| e != "yaml") || !name.starts_with(|c: char| c.is_ascii_digit()) {
            continue;
        }
        let text = String::from_utf8_lossy(&fs::read(&path).unwrap()).into_owned();
        let mut want: Vec<usize> = Vec::new();
        for (number, line) in text.lines().enumerate() {
            want.extend(line.matches("MISTAKE").map(|_| number + 1));
        }
        let reports = load_fixture(&name, &Overrides::default()).reports();
        let file = path.display().to_string();
        let mut got: Vec<usize> =
            reports.iter().filter(|r| r.file.as_deref() == Some(&file)).filter_map(|r| r.line).collect();
        got.sort_unstable();
        assert_eq!(got, want, "{name}: lines with mistakes found, and lines where they were planted");
        for report in &reports {
            assert!(report.hint.is_some(), "{name}: no hint for: {}", report.message);
        }
        planted += want.len();
    }
    assert!(planted >= 41, "only {planted} mistakes are planted");
}

#[test]
fn the_shipped_arm_is_resolved() {
    let loaded = load(&find("coordinator-yourarm").unwrap(), &Overrides::default(), &fake_arms::registry());
    let blueprint = loaded.blueprint.unwrap();
    assert_eq!(blueprint.coordinator.tick_rate, 100.0);
    let arm = &blueprint.arms[0];
    assert_eq!((arm.hardware_id.as_str(), arm.address.as_str(), arm.simulated), ("arm", "sim", true));
    assert_eq!(arm.joints, ["arm_joint1", "arm_joint2", "arm_joint3", "arm_joint4", "arm_joint5", "arm_joint6"]);
    assert_eq!(arm.on_exit, OnExit::Disable, "it has brakes");
    let task = &blueprint.tasks[0];
    assert_eq!((task.name.as_str(), task.priority, task.auto_start), ("traj_arm", 10, false));
    assert_eq!((&task.joints[..], &task.arms[..]), (&[0, 1, 2, 3, 4, 5][..], &[0][..]));
    assert_eq!(task.spec.name, "trajectory");
    assert_eq!(task.params["start_position_tolerance"], 0.05);
}

#[test]
fn tasks_count_joints_over_all_arms() {
    let loaded = load(&find("coordinator-dual-mock").unwrap(), &Overrides::default(), &fake_arms::registry());
    let blueprint = loaded.blueprint.unwrap();
    assert_eq!(blueprint.tasks[1].joints, (7..13).collect::<Vec<_>>());
    assert_eq!(blueprint.tasks[1].arms, [1]);
    assert_eq!(blueprint.joint_names()[7], "right_arm_joint1");
}

fn set(arguments: &[&str]) -> Loaded {
    let overrides = Overrides { set: arguments.iter().map(|s| (*s).to_owned()).collect(), ..Overrides::default() };
    load(&find("coordinator-yourarm").unwrap(), &overrides, &fake_arms::registry())
}

#[test]
fn set_reaches_entries_by_id() {
    let loaded = set(&["hardware.arm.address=192.168.1.100", "coordinator.tick_rate=250", "recording.keep=3"]);
    assert_eq!(loaded.render(false), "");
    let blueprint = loaded.blueprint.unwrap();
    assert_eq!(blueprint.coordinator.tick_rate, 250.0);
    assert_eq!(blueprint.arms[0].address, "192.168.1.100");
    assert!(!blueprint.arms[0].simulated);
    assert_eq!(blueprint.recording.keep, 3);
}

#[test]
fn mistakes_in_set_are_shown_in_the_argument() {
    let loaded = set(&[
        "hardware.amr.address=sim",
        "coordinator.tick_rate=fast",
        "coordinator.tick_rte=1",
        "nonsense",
        "tasks.traj_arm.priority.x=1",
        "hardware.arm.options={a: [}",
    ]);
    insta(&loaded.render(false), "set.txt");
}

#[test]
fn sim_gives_every_arm_its_emulator() {
    let found = find("coordinator-yourarm").unwrap();
    let overrides =
        Overrides { set: vec!["hardware.arm.address=10.0.0.1".to_owned()], sim: true, ..Overrides::default() };
    let blueprint = load(&found, &overrides, &fake_arms::registry()).blueprint.unwrap();
    assert!(blueprint.arms[0].simulated);
}

#[test]
fn a_simulated_arm_may_be_silent_for_250_ms() {
    let stale_after = |sim: bool, set: &[&str]| {
        let set = set.iter().map(|&s| s.to_owned()).collect();
        let address = vec![("arm".to_owned(), "192.168.1.185".to_owned())];
        let overrides = Overrides { set, sim, address, physics: false };
        let loaded = load(&find("coordinator-xarm7").unwrap(), &overrides, &dimos::arms::registry());
        loaded.blueprint.unwrap().arms[0].supervision.stale_after.as_millis()
    };
    assert_eq!(stale_after(false, &[]), 50);
    assert_eq!(stale_after(true, &[]), 250);
    assert_eq!(stale_after(true, &["hardware.arm.stale_after=0.05"]), 50, "what is written counts");
}

#[test]
fn sim_refuses_an_arm_that_would_stay_real() {
    let loaded = load_fixture("serial.yaml", &Overrides { sim: true, ..Overrides::default() });
    assert!(loaded.blueprint.is_none());
    assert!(loaded.render(false).contains("would be the real one"), "{}", loaded.render(false));
    let loaded = load_fixture("serial.yaml", &Overrides::default());
    assert_eq!(loaded.render(false), "");
    assert_eq!(loaded.blueprint.unwrap().arms[0].on_exit, OnExit::Hold, "it falls when disabled");
}

#[test]
fn the_written_blueprint_reads_back_the_same() {
    let overrides = Overrides { set: vec!["description=\"yes\"".to_owned()], sim: true, ..Overrides::default() };
    let first = load_fixture("full.yaml", &overrides);
    assert_eq!(first.render(false), "");
    let first = first.blueprint.unwrap();
    let found = blueprint::Found {
        name: "again".to_owned(),
        source: Source::Path(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/blueprints/full.yaml")),
        bytes: first.source_yaml.clone().into_bytes(),
    };
    let again = load(&found, &Overrides::default(), &fake_arms::registry());
    assert_eq!(again.render(false), "", "{}", first.source_yaml);
    let again = again.blueprint.unwrap();
    assert_eq!(again.description, "yes");
    let (mut a, mut b) = (Summary::of(&first), Summary::of(&again));
    (a.files, b.files) = (Vec::new(), Vec::new());
    assert_eq!(a, b);
}

#[test]
fn a_live_view_that_is_open_to_the_network_is_warned_of() {
    for quiet in ["view.port=7000", "view.host=127.0.0.2", "view={backend: none, host: 0.0.0.0}", "view.host='::1'"] {
        assert_eq!((set(&[quiet]).errors(), set(&[quiet]).warnings()), (0, 0), "{quiet}");
    }
    let in_planner =
        Overrides { set: vec!["planner.visualization.host=0.0.0.0".to_owned()], sim: true, ..Overrides::default() };
    let in_planner = load(&find("yourarm-planner").unwrap(), &in_planner, &fake_arms::registry());
    for loaded in [set(&["view.host=192.168.1.5"]), in_planner] {
        assert_eq!((loaded.errors(), loaded.warnings()), (0, 1), "{}", loaded.render(false));
        let text = loaded.render(false);
        assert!(text.contains("open to the network at ") && text.contains("ssh"), "{text}");
    }
    for wrong in ["view.host=robot.local", "view.host=''", "view.port=70000"] {
        assert_eq!(set(&[wrong]).errors(), 1, "{wrong}: {}", set(&[wrong]).render(false));
    }
}

#[test]
fn json_has_places_and_hints() {
    let json = set(&["hardware.arm.adress=1.2.3.4"]).to_json();
    assert_eq!(json["ok"], false);
    let diagnostic = &json["diagnostics"][0];
    assert_eq!(
        (&diagnostic["file"], &diagnostic["line"], &diagnostic["column"], &diagnostic["severity"]),
        (&"--set".into(), &1.into(), &14.into(), &"error".into())
    );
    assert_eq!(diagnostic["hint"], "did you mean `address`?");
}

#[test]
fn colour_is_only_drawn_when_asked_for() {
    let loaded = set(&["hardware.arm.adress=1.2.3.4"]);
    assert!(!loaded.render(false).contains('\x1b'));
    assert!(loaded.render(true).contains('\x1b'));
}

/// Compares with a golden file beside the fixtures.
fn insta(got: &str, golden: &str) {
    let path = fixtures().join("golden").join(golden);
    if env::var_os("DIMOS_REGENERATE").is_some() {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(&path, got).unwrap();
    }
    let want = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(got, want, "run with DIMOS_REGENERATE=1 to keep the new text of {golden}");
}

#[test]
fn a_stream_over_more_joints_than_a_target_holds_is_refused() {
    let text = |task: &str| {
        format!(
            "hardware:
  - {{hardware_id: left, joints: {{prefix: left, count: 9}}, adapter_type: mock}}
  - {{hardware_id: right, joints: {{prefix: right, count: 9}}, adapter_type: mock}}
tasks:
  - {{name: both, type: {task}, joint_names: [{}]}}
",
            ["left", "right"].iter().flat_map(|p| dimos::joint::make_joints(p, 9)).collect::<Vec<_>>().join(", ")
        )
    };
    for (task, errors) in [("trajectory", 0), ("servo", 1), ("velocity", 1)] {
        let found = blueprint::Found { name: "wide".into(), source: Source::Embedded, bytes: text(task).into_bytes() };
        let loaded = load_from(&SearchPath::default(), &found, &Overrides::default(), &dimos::arms::registry());
        assert_eq!(loaded.errors(), errors, "{task}: {}", loaded.render(false));
        assert!(errors == 0 || loaded.render(false).contains("at most 16 joints, this one names 18"));
    }
}

/// A Cartesian task's robot: its own, or that of the planner; every mistake at its place.
#[test]
fn a_cartesian_task_has_a_robot_and_its_mistakes_have_their_places() {
    let load_text = |task: &str, planner: bool| {
        let planner = if planner {
            "planner:
  robots:
    - {name: arm, model_path: builtin:yourarm, end_effector_link: flange, joint_prefix: arm_,
       base_pose: {xyz: [1, 0, 0]}, joint_names: [joint1, joint2, joint3, joint4, joint5, joint6]}
"
        } else {
            ""
        };
        let text = format!(
            "hardware:
  - {{hardware_id: arm, joints: {{prefix: arm, count: 6}}, adapter_type: mock}}
tasks:
  - {task}
{planner}"
        );
        let found = blueprint::Found { name: "cart".into(), source: Source::Embedded, bytes: text.into_bytes() };
        load_from(&SearchPath::default(), &found, &Overrides::default(), &dimos::arms::registry())
    };
    let task = |params: &str| format!("{{name: c, type: cartesian_ik, joint_names: {{hardware: arm}}, {params}}}");
    let own = |more: &str| task(&format!("params: {{model_path: 'builtin:yourarm', {more}}}"));
    let good = load_text(&own("end_effector_link: flange, joint_prefix: arm_"), false);
    let robot = good.blueprint.unwrap().tasks[0].robot.clone().unwrap();
    assert_eq!((robot.link.as_str(), robot.joints[5].as_str(), robot.base), ("flange", "joint6", None));
    // The planner's robot, where none is given; of it, another link.
    for (params, link) in [("params: {timeout: 1.0}", "flange"), ("params: {end_effector_link: link4}", "link4")] {
        let planned = load_text(&task(params), true);
        assert_eq!(planned.render(false), "");
        let robot = planned.blueprint.unwrap().tasks[0].robot.clone().unwrap();
        let (base, at) = robot.base.unwrap();
        assert_eq!((robot.link.as_str(), base.as_str(), at.translation.x), (link, "base_link", 1.0));
        assert_eq!(robot.joints[0], "joint1");
    }
    let mapped = "end_effector_link: flange, joint_name_mapping: {arm_joint1: joint2, arm_joint2: joint1}";
    for (entry, said, place) in [
        (task("params: {}"), "task needs a robot description", "4:21"),
        (own(""), "the end effector is missing", "builtin:yourarm"),
        (own("end_effector_link: flnge, joint_prefix: arm_"), "no link `flnge`", "flnge"),
        (own("end_effector_link: base_link, joint_prefix: arm_"), "no joint of the task moves", "base_link"),
        (own("end_effector_link: flange"), "the model has no joint `arm_joint1`", "4:"),
        (own("end_effector_link: flange, joint_prefix: left_"), "does not begin with `left_`", "left_"),
        (own(mapped), "the model has no joint `arm_joint3`", "4:"),
        (own("end_effector_link: flange, joint_prefix: arm_, timeout: -1"), "out of range", "-1"),
        (own("end_effector_link: flange, joint_prefix: arm_, max_linear_velocity: 0"), "out of range", "0"),
        (own("end_effector_link: flange, speed: 1"), "speed", "speed"),
        (task("params: {model_path: 'builtin:missing', end_effector_link: x}"), "cannot be used", "builtin:missing"),
        (task("params: {model_path: gone.urdf, end_effector_link: x}"), "cannot be used", "gone.urdf"),
    ] {
        let loaded = load_text(&entry, false);
        let text = loaded.render(false);
        assert!(loaded.errors() >= 1 && text.contains(said), "{entry}\n{text}");
        assert!(text.contains("cart:4:") || text.contains(":4:"), "{text}");
        let first = loaded.reports().into_iter().find(|r| r.message.contains(said)).unwrap();
        if let Some((line, column)) = place.split_once(':').filter(|(line, _)| *line == "4") {
            assert!(first.line == Some(line.parse().unwrap()), "{text}");
            assert!(column.is_empty() || first.column == Some(column.parse().unwrap()), "{text}");
        } else {
            let written = "  - ".len() + entry.rfind(place).unwrap() + 1;
            assert!(first.column.is_some_and(|c| c <= written && c + 2 >= written), "{written} {first:?}");
        }
    }
    let part = "{name: c, type: eef_twist, joint_names: [arm_joint1, arm_joint2],
     params: {model_path: 'builtin:yourarm', end_effector_link: flange, joint_prefix: arm_}}";
    let text = load_text(part, false).render(false);
    assert!(text.contains("`joint3` moves the end effector but is not a joint of the task"), "{text}");
}
