//! The small verbs with the real binary: `state --watch`, `arm gripper`, `task`, `completions`, `man`, `doctor`.

use std::io::{BufRead, BufReader, Write};
use std::process::Stdio;

use dimos::rpc::api::{Motion, State, Status};
use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};

const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 2}, adapter_type: mock}
  - {hardware_id: bare, joints: {prefix: bare, count: 1}, adapter_type: mock, options: {gripper: false}}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: servo_arm, type: servo, joint_names: {hardware: arm}, priority: 20}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 30}
";

fn up() -> (Home, Started) {
    let home = Home::new();
    home.write("verbs.yaml", BLUEPRINT);
    let run = home.run("verbs.yaml --no-record");
    (home, run)
}

/// Starts a command that reads from us.
fn fed(home: &Home, arguments: &str) -> Started {
    Started::of(home.command(arguments).stdin(Stdio::piped()))
}

#[test]
fn watching_the_state_goes_on_until_nobody_reads() {
    let (home, run) = up();
    let mut command = home.command("state --watch --json --hz 50");
    let mut watch = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    let mut lines = BufReader::new(watch.stdout.take().unwrap()).lines();
    let states: Vec<Value> = (0..5).map(|_| serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap()).collect();
    assert!(states.windows(2).all(|s| s[0]["tick"].as_u64() <= s[1]["tick"].as_u64()), "{states:?}");
    assert!(states[0]["tick"] != states[4]["tick"]);
    drop(lines);
    assert!(watch.wait().unwrap().success(), "its reader has gone");

    let tables = home.start("state --watch --hz 50");
    eventually("tables follow each other", || tables.out().matches("JOINT").count() > 3);
    assert!(!tables.out().contains('\x1b'), "no terminal, no redraw");
    run.end(Signal::TERM);
    tables.wait().with(0).says(&["run verbs has ended"]);
    home.dimos("state --hz 5").with(2);
}

#[test]
fn a_gripper_opens_and_closes_as_far_as_it_goes() {
    let (home, _run) = up();
    let mut client = home.client();
    let mut opening = || client.call(State {}).unwrap().arms[0].gripper.unwrap();
    for (word, outcome, metres) in [("open", "open at", 0.08), ("close", "closed at", 0.0), ("0.03", "reached", 0.03)] {
        home.dimos(&format!("arm gripper arm {word}")).with(0).shows(&[&format!("gripper {outcome} {metres:.4} m")]);
        assert!((opening() - metres).abs() < 1e-3, "{word} waits");
    }
    // 40 mm at a quarter of 0.1 m/s.
    let slow = home.dimos("arm gripper arm 0.07 --speed 0.25 --json").with(0).json();
    assert!(slow["elapsed"].as_f64().unwrap() > 1.4, "{slow}");
    home.dimos("arm gripper bare open").with(1).says(&["bare has no gripper, or does not report its range"]);
    home.dimos("arm gripper rarm close").with(2).says(&["[UNKNOWN_ARM]", "did you mean `arm`?"]);
    for wrong in ["ajar", "nan", ""] {
        home.dimos(&format!("arm gripper arm {wrong}")).with(2);
    }
}

#[test]
fn tasks_are_listed_and_asked() {
    let (home, _run) = up();
    let list = home.dimos("task list").with(0).out;
    assert_eq!(list.lines().count(), 4, "{list}");
    assert_eq!(home.dimos("task list --json").with(0).json()[1]["name"], "servo_arm");
    assert!(home.dimos("task invoke servo_arm state").with(0).out.contains("IDLE"));
    assert_eq!(home.dimos("task invoke servo_arm cancel").with(0).out, "servo_arm: ALREADY_STOPPED\n");
    home.dimos("task invoke sevro_arm state").with(2).says(&["did you mean `servo_arm`?"]);
    home.dimos("task invoke servo_arm jump").with(2);
}

#[test]
fn a_motion_is_slowed_down_paused_and_resumed_and_its_log_verifies() {
    let home = Home::new();
    let run = home.run("coordinator-yourarm");
    assert_eq!(home.dimos("speed").with(0).out, "speed 100 %\n");
    home.dimos("speed 150%").with(2).says(&["0.01–1", "1–100%"]);
    home.dimos("speed 30").with(2).says(&["for percent write 30%"]);
    let moving = home.dimos("move arm 0.9 -0.3 0.6 0 0.8 0 --speed 0.3 --no-wait --json").with(0).json();
    let motion = moving["motion"].as_u64().unwrap();
    assert_eq!(home.dimos("pause").with(0).out, "paused; at 100 % of the speed after `dimos resume`\n");
    assert_eq!(home.dimos("speed 50% --json").with(0).json()["paused"], true);
    let task = || home.dimos("task invoke traj_arm state --json").with(0).json();
    eventually("the arm rests on its path", || {
        let (before, after) = (home.positions("arm"), home.positions("arm"));
        before == after && before[0] < 0.85
    });
    assert_eq!(task()["state"], "EXECUTING");
    home.dimos("status").with(0).shows(&["! all motions are paused", "paused; at 50 % of the speed"]);
    assert_eq!(home.dimos("resume").with(0).out, "speed 50 %\n");
    eventually("it arrives", || task()["state"] == "COMPLETED");
    assert_eq!(task()["motion"], motion);
    // The time that has passed: more than the task has counted on the path, at half the speed.
    let report = home.client().call(Motion { motion }).unwrap();
    let on_path = moving["duration"].as_f64().unwrap();
    assert!(report.done && report.elapsed > 1.4 * on_path, "{} s, {on_path} s on the path", report.elapsed);
    assert!((home.positions("arm")[0] - 0.9).abs() < 1e-3);
    home.dimos("down").with(0);
    drop(run);
    home.dimos("replay --last --verify").with(0).shows(&["reproducible"]);
}

#[test]
fn a_pose_is_saved_and_is_a_goal_without_a_planner_too() {
    let (home, _run) = up();
    home.dimos("pose list").with(0).says(&["no pose is saved", "hint: "]);
    home.dimos("move arm 0.3 -0.2 --speed 1").with(0);
    home.dimos("pose save grasp arm").with(0).shows(&["grasp saved", "0.3000 -0.2000"]);
    home.dimos("move arm 0 0 --speed 1").with(0);
    home.dimos("pose save grasp.2").with(0);
    home.dimos("move arm --named grasp --speed 1").with(0).says(&["direct, not collision-checked"]);
    assert!((home.positions("arm")[0] - 0.3).abs() < 1e-3);
    assert!(home.dimos("pose save grasp arm").with(0).out.contains("in place of the earlier one"));
    let poses = home.dimos("pose list --json").with(0).json();
    assert_eq!(poses["poses"]["grasp.2"]["bare"]["bare_joint1"], 0.0);
    assert!(std::fs::read_to_string(poses["file"].as_str().unwrap()).unwrap().starts_with("# Saved with"));
    home.dimos("move bare --named grasp").with(2).says(&["has no position of bare's joints", "hint: "]);
    home.dimos("move arm --named grsp").with(2).says(&["no saved pose grsp; saved: grasp, grasp.2"]);
    home.dimos("pose save a/b").with(2).says(&["letters, digits"]);
    home.dimos("pose save x rarm").with(2).says(&["did you mean `arm`?"]);
    home.dimos("pose remove graspp").with(2).says(&["did you mean `grasp`?"]);
    home.dimos("pose remove grasp").with(0);
    home.dimos("move arm --named grasp").with(2);
    // What is not a list of poses is not overwritten.
    std::fs::write(poses["file"].as_str().unwrap(), "poses: [1").unwrap();
    home.dimos("pose save x").with(1).says(&["is not a list of saved poses", "hint: correct the file"]);
    assert_eq!(std::fs::read_to_string(poses["file"].as_str().unwrap()).unwrap(), "poses: [1");
}

#[test]
fn blueprints_of_one_name_in_two_folders_have_their_own_poses() {
    let home = Home::new();
    let cell = "hardware:\n  - {hardware_id: arm, joints: {prefix: arm, count: 2}, adapter_type: mock}\n";
    for (folder, saved) in [("a", true), ("b", false), ("a", true)] {
        std::fs::create_dir_all(home.path().join(folder)).unwrap();
        home.write(&format!("{folder}/cell.yaml"), cell);
        let _run = home.run(&format!("{folder}/cell.yaml --no-record"));
        if folder == "a" {
            home.dimos("pose save grasp").with(0);
        }
        assert_eq!(home.dimos("pose list").with(0).out.contains("grasp"), saved, "{folder}");
    }
}

#[test]
fn targets_are_streamed_from_a_file() {
    let (home, _run) = up();
    let ramp: String = (0..=50).map(|i| format!("{}, {}\n", f64::from(i) * 0.004, f64::from(i) * -0.002)).collect();
    home.write("ramp.csv", &format!("# two joints\n\n{ramp}"));
    let said = home.dimos("task stream servo_arm ramp.csv --hz 100 --json").with(0).json();
    assert_eq!((&said["task"], &said["targets"]), (&"servo_arm".into(), &51.into()));
    assert!(said["seconds"].as_f64().unwrap() >= 0.5, "{said}");
    eventually("the last target is reached and held", || {
        let now = home.positions("arm");
        (now[0] - 0.2).abs() < 1e-3 && (now[1] + 0.1).abs() < 1e-3
    });

    home.write("bad.txt", "0.2 -0.1\n0.2 -0.1 0\n");
    let refused = home.dimos("task stream servo_arm bad.txt").with(2);
    assert!(refused.err.contains("error: bad.txt:2: 3 numbers for 2 joints\nhint: "), "{}", refused.err);
    home.dimos("task stream traj_arm ramp.csv").with(1).says(&["is a trajectory task", "[WRONG_TASK]"]);
    home.dimos("task stream servo_arm missing.txt").with(2);
    let idle = || home.dimos("task invoke servo_arm state --json").with(0).json()["state"] == "IDLE";
    eventually("the stream is stale", idle);
    home.write("far.txt", "1.5 0\n");
    home.dimos("task stream servo_arm far.txt").with(1).says(&["[START_STATE_MISMATCH]"]);
    let jump = "0.2 -0.1\n0.2 -0.1\n0.9 -0.1\n".to_owned();
    home.write("jump.txt", &(jump.clone() + "0.2 -0.1\n"));
    // A target that the joint does not reach in its time is not written, and the stream continues.
    let said = ["target 3: ", "0.7000 rad", "from the one before", "servo_arm: 1 of 4 targets were left out"];
    home.dimos("task stream servo_arm jump.txt").with(1).says(&said);
    // The arm is held when nothing else comes.
    home.write("far.txt", &(jump.clone() + &"2.5 -0.1\n".repeat(40)));
    home.dimos("task stream servo_arm far.txt").with(1).says(&["arm is held (a command jumped)", "hint: "]);
}

#[test]
fn targets_are_streamed_from_stdin_and_a_stream_that_ends_leaves_the_arm_at_rest() {
    let (home, _run) = up();
    let mut client = home.client();
    let mut velocity = || client.call(State {}).unwrap().arms[0].joints[0].velocity.unwrap();

    let mut stream = fed(&home, "task stream velocity_arm");
    let mut input = stream.stdin();
    eventually("the arm moves", || {
        input.write_all(b"[0.1, 0]\n").unwrap();
        velocity() > 0.05
    });
    drop(input);
    assert!(stream.wait().with(0).out.starts_with("velocity_arm: "));
    let task = home.dimos("task invoke velocity_arm state --json").with(0).json();
    assert_eq!((&task["state"], &task["reason"]), (&"IDLE".into(), &"its stream was ended".into()), "no fault: {task}");
    eventually("the arm is at rest", || velocity().abs() < 1e-6);
    home.dimos("move arm 0 0").with(0);

    let mut stream = fed(&home, "task stream velocity_arm -");
    let mut input = stream.stdin();
    input.write_all(b"0.1 0\n").unwrap();
    eventually("it streams", || home.status()["arms"][0]["commander"]["program"] == "dimos task");
    stream.end(Signal::INT).with(130);
    drop(input);

    let mut stream = fed(&home, "task stream velocity_arm");
    let mut input = stream.stdin();
    input.write_all(b"0.1 0\n0.1 zero\n").unwrap();
    stream.wait().with(2).says(&["stdin:2: \"zero\" is not a finite number"]);
    eventually("the arm is at rest", || velocity().abs() < 1e-6);
}

#[test]
fn a_streamer_that_is_killed_gives_up_its_lease_and_its_stream_goes_stale() {
    let (home, _run) = up();
    let mut watcher = home.client();
    let mut stream = fed(&home, "task stream velocity_arm --hz 50");
    let mut input = stream.stdin();
    let mut feed = || input.write_all(b"0.1 0\n").unwrap();
    eventually("the arm moves", || {
        feed();
        watcher.call(State {}).unwrap().arms[0].joints[0].velocity.unwrap() > 0.05
    });
    let holder = watcher.call(Status {}).unwrap().arms.remove(0).commander.unwrap();
    assert_eq!((holder.pid, holder.program.as_str()), (Some(stream.pid() as i32), "dimos task"));
    stream.end(Signal::KILL);
    eventually("the lease is free and the arm at rest", || {
        let free = watcher.call(Status {}).unwrap().arms[0].commander.is_none();
        free && watcher.call(State {}).unwrap().arms[0].joints[0].velocity.unwrap().abs() < 1e-6
    });
    let arm = watcher.call(Status {}).unwrap().arms.remove(0);
    assert_eq!(arm.phase, "ready", "that is no fault");
}

#[test]
fn completions_and_manual_know_the_verbs() {
    let home = Home::new();
    for shell in ["bash", "zsh", "fish"] {
        let script = home.dimos(&format!("completions {shell}")).with(0).out;
        assert!(script.contains("DIMOS_COMPLETE") && script.contains("dimos"), "{shell}: {script}");
    }
    home.dimos("completions tcsh").with(2);
    let page = home.dimos("man").with(0).out;
    assert!(page.starts_with(".ie") && page.contains("list\\-adapters"), "{page}");
    home.dimos("man --dir pages").with(0);
    let pages: Vec<_> =
        std::fs::read_dir(home.path().join("pages")).unwrap().map(|page| page.unwrap().path()).collect();
    assert!(pages.len() > 80, "{}", pages.len());
    for page in pages {
        let text = std::fs::read_to_string(&page).unwrap();
        let page = page.display();
        for section in ["SYNOPSIS", "EXAMPLES", "EXIT STATUS", "FILES", "ENVIRONMENT"] {
            assert!(
                text.contains(&format!(".SH \"{section}\"")) || text.contains(&format!(".SH {section}")),
                "{page}: {section}"
            );
        }
        assert!(text.contains("DIMOS_AT"), "{page}");
        assert!(!text.contains("EXTRA"), "{page}");
    }
}

/// bash itself completes: with the script that `dimos completions bash` prints, words as its readline has them.
#[test]
fn bash_completes_what_exists_now() {
    let (home, _run) = up();
    let offered = |line: &str| -> Vec<String> {
        let words: Vec<&str> = line.split(' ').collect();
        let script = format!(
            "source <(dimos completions bash); COMP_WORDS=({line} {empty}); COMP_CWORD={at}; COMP_TYPE=9; \
             _clap_complete_dimos dimos \"{last}\" x; echo -n \"${{COMPREPLY[*]}}\"",
            empty = if line.ends_with(' ') { "''" } else { "" },
            at = words.len() - 1,
            last = words.last().unwrap(),
        );
        let mut bash = std::process::Command::new("bash");
        let program = std::path::Path::new(env!("CARGO_BIN_EXE_dimos")).parent().unwrap();
        let path = std::env::join_paths(
            [program.to_owned()].into_iter().chain(std::env::split_paths(&std::env::var_os("PATH").unwrap())),
        );
        let ended = Started::of(home.settle(bash.args(["-c", &script]).env("PATH", path.unwrap()))).wait().with(0);
        assert_eq!(ended.err, "", "{line}");
        ended.out.split([' ', '\u{b}', '\n']).map(str::to_owned).collect()
    };
    let has = |line: &str, word: &str| {
        let offered = offered(line);
        assert!(offered.iter().any(|w| w == word), "{line:?}: no {word} in {offered:?}");
    };
    has("dimos run coord", "coordinator-xarm6");
    has("dimos run verb", "verbs.yaml");
    has("dimos down ", "verbs");
    has("dimos state --run ", "verbs");
    has("dimos move ", "bare");
    has("dimos arm gripper ", "arm");
    has("dimos task stream serv", "servo_arm");
    has("dimos adapter test you", "yourarm");
    has("dimos jo", "jog");
    home.dimos("pose save grasp").with(0);
    has("dimos pose remove ", "grasp");
    has("dimos pose save other ", "bare");
    has("dimos move arm --named ", "grasp");
    has("dimos move arm --through gri", "gripper:close");
    has("dimos plan arm --by 0 0 0.1 --frame ", "tool");
    has("dimos plan --goal ", "arm=named:grasp");
    has("dimos log plot x.mcap --joint arm_jo", "arm_joint1");
    has("dimos arm gripper arm o", "open");
    has("dimos run keyboard-teleop-xarm6 --address ", "arm=");
    has("dimos check keyboard-teleop-xarm6 --set coord", "coordinator.tick_rate=");
    has("dimos model info builtin:y", "builtin:yourarm");
}

/// A failed write to stdout is a failure; a closed pipe is none.
#[test]
fn what_could_not_be_printed_is_an_error() {
    let (home, _run) = up();
    home.write("log.txt", "");
    let full = || Stdio::from(std::fs::File::options().write(true).open("/dev/full").unwrap());
    let verbs = [
        "status",
        "status --json",
        "state",
        "state --watch",
        "state --json",
        "task list",
        "list-adapters",
        "list-blueprints",
        "list-blueprints --json",
        "check verbs.yaml",
        "check verbs.yaml --json",
        "schema",
        "schema --rpc",
        "completions bash",
        "man",
        "doctor",
        "model info builtin:yourarm",
        "model expand builtin:yourarm",
        "model tree builtin:yourarm",
        "model fk builtin:yourarm 0 0 0 0 0 0",
        "cancel --json",
        "arm reset arm",
        "stop --json",
        "adapter emulate yourarm --fault list",
        "--help",
        "--version",
    ];
    for verb in verbs {
        let mut command = home.command(verb);
        let mut child = command.stdout(full()).stderr(Stdio::piped()).spawn().unwrap();
        let mut said = String::new();
        std::io::Read::read_to_string(&mut child.stderr.take().unwrap(), &mut said).unwrap();
        let code = child.wait().unwrap().code();
        assert_eq!(code, Some(1), "{verb}: {said}");
        assert!(said.contains("No space left on device") || said.contains("no space left"), "{verb}: {said}");
    }
    for verb in ["status", "list-adapters", "man", "schema"] {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let ended = home.command(verb).stdout(writer).stderr(Stdio::null()).status().unwrap();
        assert_eq!(ended.code(), Some(0), "{verb}");
    }
}

#[test]
fn errors_of_json_are_json_and_positional_names_select_a_run() {
    let (home, _run) = up();
    let error = |line: &str, exit: i32| {
        let ended = home.dimos(line).with(exit);
        assert_eq!(ended.out, "", "{line}");
        serde_json::from_str::<Value>(ended.err.lines().last().unwrap()).unwrap()["error"].take()
    };
    let unknown = error("move rarm 0 0 --json", 2);
    assert_eq!(
        (&unknown["code"], &unknown["hint"]),
        (&"UNKNOWN_ARM".into(), &"did you mean `arm`?".into()),
        "{unknown}"
    );
    assert_eq!(error("state --run nope --json", 2)["code"], "USAGE");
    assert_eq!(error("move arm home --json", 2)["message"].as_str().unwrap().matches("--named home").count(), 1);
    assert_eq!(error("plan arm 0 0 --json", 1)["code"], "NO_PLANNER");
    assert_eq!(error("run nope --json", 2)["code"], "USAGE");
    home.write("bad.yaml", "hardware: [{hardware_id: arm, adapter_type: mokc, joints: {prefix: arm, count: 2}}]");
    let wrong = error("run bad.yaml --json", 2);
    assert_eq!(wrong["data"]["errors"], 1, "{wrong}");
    home.dimos("run verbs.yaml --name bad/.. --no-record").with(2);

    assert!(home.dimos("status verbs").with(0).out.starts_with("run verbs  SIMULATED"), "mock arms are in memory");
    assert_eq!(home.dimos("status verbs --json").with(0).json()["run"], "verbs");
    home.dimos("status nope").with(2);
    for entry in home.dimos("status --json").with(0).json().as_array().unwrap() {
        assert!(["run", "pid", "state", "arms", "log"].iter().all(|key| entry.get(key).is_some()), "{entry}");
    }
    home.dimos("state --watch --rate 50 --json --run nope").with(2);
}

#[test]
fn schemas_are_printed() {
    let home = Home::new();
    assert!(home.dimos("schema").with(0).json()["properties"]["hardware"].is_object());
    assert!(home.dimos("schema --rpc").with(0).json()["methods"]["move"]["params"].is_object());
}

#[test]
fn the_doctor_finds_what_prevents_a_run() {
    let home = Home::new();
    let findings = home.dimos("doctor --json").with(0).json();
    let findings = findings.as_array().unwrap();
    for check in ["kernel", "rtprio", "memlock", "cpu_dma_latency", "governor", "clock source", "log folder"] {
        let finding = findings.iter().find(|f| f["check"] == check).unwrap_or_else(|| panic!("no {check}"));
        assert_eq!(finding["level"] == "ok", finding["fix"].is_null(), "{finding}");
    }
    let sockets = findings.iter().find(|f| f["check"] == "sockets folder").unwrap();
    assert!(sockets["found"].as_str().unwrap().ends_with("0 live runs"), "{sockets}");
    assert!(home.dimos("doctor").with(0).out.starts_with("CHECK"));
    assert!(home.runs().runs().unwrap().is_empty(), "nothing is left behind");

    std::fs::remove_dir_all(home.path().join("run")).unwrap();
    std::fs::create_dir(home.path().join("run")).unwrap();
    home.write("run/dimos", "in the way");
    let ended = home.dimos("doctor").with(1).says(&["error: runs cannot start: ", "hint: "]);
    assert!(ended.out.contains("BAD"), "{}", ended.out);
}
