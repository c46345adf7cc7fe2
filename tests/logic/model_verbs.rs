//! The verbs of `dimos model`, with the real binary.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use dimos::robot::urdf::Meshes;
use dimos::robot::{Source, load};

use crate::support::shared;

struct Ended {
    code: i32,
    out: String,
    err: String,
}

fn dimos(arguments: &[&str]) -> Ended {
    dimos_with(arguments, "")
}

/// Runs `dimos model` with a text as its standard input.
fn dimos_with(arguments: &[&str], input: &str) -> Ended {
    let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
    let pipes = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = pipes.arg("model").args(arguments).spawn().unwrap();
    let _ = child.stdin.take().unwrap().write_all(input.as_bytes());
    let output = child.wait_with_output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Ended { code: output.status.code().unwrap(), out: text(&output.stdout), err: text(&output.stderr) }
}

#[test]
fn joints_are_found_for_a_pose_and_what_is_missing_is_said() {
    let pose = ["--pose", "0.35", "0.05", "0.3", "--rpy", "3.1", "-.1", "0.2"];
    let ik = dimos(&[&["ik", "builtin:yourarm"], &pose[..]].concat());
    assert_eq!(ik.code, 0, "{}", ik.err);
    let joints: Vec<&str> = ik.out.lines().nth(1).unwrap().split_whitespace().collect();
    assert!(ik.out.lines().nth(2).unwrap().starts_with("distance to the seed: "), "{}", ik.out);
    let fk = dimos(&[&["fk", "builtin:yourarm"], &joints[..]].concat());
    assert!(fk.out.contains("xyz   0.350000 0.050000 0.300000  m"), "{}", fk.out);
    let rpy: Vec<f64> = { fk.out.lines() }
        .find_map(|line| line.strip_prefix("rpy"))
        .map(|values| values.split_whitespace().filter_map(|value| value.parse().ok()).collect())
        .unwrap_or_default();
    let off = rpy.iter().zip([3.1, -0.1, 0.2]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(rpy.len() == 3 && off < 5e-6, "{}", fk.out);
    // From where the solution is nearest to: another seed, another arm of the same hand.
    let seed: Vec<String> = joints.iter().map(|q| (q.parse::<f64>().unwrap() + 0.1).to_string()).collect();
    let seed: Vec<&str> = seed.iter().map(String::as_str).collect();
    let near = dimos(&[&["ik", "builtin:yourarm"], &pose[..], &["--json", "--seed"], &seed[..]].concat());
    let near: serde_json::Value = serde_json::from_str(&near.out).unwrap();
    assert!(near["reached"] == true && near["position_error"].as_f64().unwrap() < 1e-6, "{near}");
    for (q, expected) in near["positions"].as_array().unwrap().iter().zip(&joints) {
        assert!((q.as_f64().unwrap() - expected.parse::<f64>().unwrap()).abs() < 1e-3, "{near} {joints:?}");
    }
    let far = dimos(&["ik", "builtin:yourarm", "--pose", "2", "0", "0.3"]);
    assert!(far.code == 1 && far.err.contains("no IK solution after") && far.err.contains(" m and "), "{}", far.err);
    let far = dimos(&["ik", "builtin:yourarm", "--pose", "2", "0", "0.3", "--json"]);
    let report: serde_json::Value = serde_json::from_str(&far.out).unwrap();
    assert!(
        far.code == 1 && report["reached"] == false && report["position_error"].as_f64().unwrap() > 1.0,
        "{report}"
    );
    for wrong in [
        &["ik", "builtin:yourarm"][..],
        &["ik", "builtin:yourarm", "--pose", "0.3", "0", "0.3", "--quat", "0", "0", "0", "2"],
        &["ik", "builtin:yourarm", "--pose", "0.3", "0", "0.3", "--seed", "0"],
        &["ik", "builtin:yourarm", "--pose", "0.3", "0", "0.3", "--link", "flnge"],
    ] {
        assert_eq!(dimos(wrong).code, 2, "{wrong:?}");
    }
}

#[test]
fn verbs_show_a_robot() {
    let info = dimos(&["info", "builtin:xarm6_gripper"]);
    assert_eq!((info.code, info.err.as_str()), (0, ""));
    for what in ["7 of them independent", "-178.2", "follows drive_joint", "link2 → link3", "cylinder r"] {
        assert!(info.out.contains(what), "{what}\n{}", info.out);
    }
    let json: serde_json::Value = serde_json::from_str(&dimos(&["info", "builtin:piper", "--json"]).out).unwrap();
    assert_eq!(json["joints"][2]["lower"], -2.9670597);
    let tree = dimos(&["tree", "builtin:yourarm_gripper"]).out;
    assert!(tree.contains("├─ finger_left  (finger_joint, prismatic)") && tree.contains("└─ tcp"), "{tree}");
    let fk = dimos(&["fk", "builtin:yourarm", "0", "0", "0", "0", "0", "-.5", "--link", "flange"]);
    assert!(fk.out.contains("xyz   0.400000 0.000000 0.550000  m"), "{}{}", fk.out, fk.err);
    let wrong = dimos(&["fk", "builtin:yourarm", "0", "--link", "flange"]);
    assert!(wrong.code == 2 && wrong.err.contains("takes 6 positions, found 1"), "{}", wrong.err);
    let expanded = dimos(&["expand", "builtin:yourarm"]).out;
    assert!(expanded.contains("<joint name=\"joint1\" type=\"revolute\">"), "{expanded}");
}

#[test]
fn check_reports_everything_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("r.urdf");
    let shape = |tag: &str, mesh: &str| format!("<{tag}><geometry><mesh filename='{mesh}'/></geometry></{tag}>");
    let body = format!(
        "<robot name='r'>\n<link name='a'>{}{}</link>\n<link name='b'/>\n<joint name='j' type='revolute'><parent link='a'/>\
         <child link='b'/><axis xyz='0 0 0'/>\n<limit lower='1' upper='-1' velocity='1'/></joint></robot>",
        shape("visual", "package://nowhere/a.stl"),
        shape("collision", "gone.stl"),
    );
    std::fs::write(&file, &body).unwrap();
    let path = file.to_str().unwrap();
    let found = dimos(&["check", path]);
    assert_eq!(found.code, 2);
    for what in [
        "this axis is zero",
        "r.urdf:5:15",
        "above the upper limit",
        "collision mesh not found",
        "--package nowhere=FOLDER",
    ] {
        assert!(found.err.contains(what), "{what}\n{}", found.err);
    }
    let json: serde_json::Value = serde_json::from_str(&dimos(&["check", path, "--json"]).out).unwrap();
    assert_eq!((json["valid"].as_bool(), json["problems"].as_array().unwrap().len()), (Some(false), 4));
    // A collision mesh that is there but broken is found too; a visual one only warned of.
    std::fs::write(folder.path().join("gone.stl"), "solid\nendsolid").unwrap();
    let fine =
        body.replace("axis xyz='0 0 0'", "axis xyz='0 0 1'").replace("lower='1' upper='-1'", "lower='-1' upper='1'");
    std::fs::write(&file, &fine).unwrap();
    let found = dimos(&["check", path]);
    assert!(found.code == 2 && found.err.contains("unusable mesh"), "{}", found.err);
    // Soft limits are said once, with the ranges that are left.
    let soft = fine.replace("</joint>", "<safety_controller k_velocity='1' soft_upper_limit='0.5'/></joint>");
    std::fs::write(&file, soft.replace("gone.stl", "fine.stl")).unwrap();
    std::fs::write(folder.path().join("fine.stl"), tetrahedron(0.25)).unwrap();
    let found = dimos(&["check", path]);
    assert!(found.code == 0 && found.err.contains("narrow j to -1 … 0.5 rad"), "{}", found.err);
    assert!(found.out.contains("no mistakes, 2 warnings"), "{}", found.out);
    let shown = dimos(&["info", path]);
    assert!(shown.out.contains("-1.000…0.500"), "{}", shown.out);
    assert_eq!(dimos(&["check", "no/such/file.urdf"]).code, 2);
    assert_eq!(dimos(&["check", "builtin:lite6"]).code, 0);
}

#[test]
fn xacro_and_srdf_work_from_the_command_line() {
    let Some(root) = shared::shared("xacro") else { return };
    let package = format!("xarm_description={}", root.join("pkgs/xarm_description").display());
    let file = root.join("pkgs/xarm_description/urdf/xarm_device.urdf.xacro");
    let srdf = root.join("pkgs/xarm_description/srdf/xarm.srdf.xacro");
    let file = file.to_str().unwrap();
    let common = ["--package", &package, "--xacro-arg", "dof:=6", "--xacro-arg", "limited:=true"];
    let tree = dimos(&[&["tree", file][..], &common].concat());
    assert!(tree.code == 0 && tree.out.contains("link6  (joint6, revolute)"), "{}{}", tree.out, tree.err);
    let typo = dimos(&["tree", file, "--package", &package, "--xacro-arg", "dof:=6", "--xacro-arg", "limted:=true"]);
    assert!(typo.err.contains("did you mean `limited`?"), "{}", typo.err);
    let loaded = load(&Source {
        packages: [("xarm_description".to_owned(), root.join("pkgs/xarm_description"))].into(),
        xacro_args: [("dof".to_owned(), "6".to_owned())].into(),
        srdf: Some(srdf),
        meshes: Meshes::Ignore,
        ..Source::new(Path::new(file))
    });
    let robot = loaded.model.as_ref().unwrap_or_else(|| panic!("{}", loaded.render(false)));
    let group = loaded.semantics.groups.iter().find(|g| g.name == "xarm6").unwrap();
    assert_eq!(loaded.semantics.group_joints(robot, &group.name).unwrap().len(), 6);
    assert!(loaded.semantics.poses.iter().any(|p| p.positions.len() == 6), "{:?}", loaded.semantics.poses);
    assert!(loaded.semantics.disabled.len() > 5);
}

/// A base with a mesh, a link that turns, and two branches: a camera and an arm of two joints with a hand.
const BRANCHES: &str = "<robot name='b'>
<link name='base'/><link name='body'/><link name='camera'/><link name='upper'/><link name='lower'/><link name='hand'/>
<joint name='turn' type='revolute'><parent link='base'/><child link='body'/><axis xyz='0 0 1'/>
<limit lower='-3' upper='3' velocity='1'/></joint>
<joint name='tilt' type='revolute'><parent link='body'/><child link='camera'/><origin xyz='0 0 1'/><axis xyz='0 1 0'/>
<limit lower='-1' upper='1' velocity='1'/></joint>
<joint name='shoulder' type='revolute'><parent link='body'/><child link='upper'/><origin xyz='0 0 0.5'/>
<axis xyz='0 1 0'/><limit lower='-2' upper='2' velocity='1'/></joint>
<joint name='elbow' type='revolute'><parent link='upper'/><child link='lower'/><origin xyz='0.5 0 0'/>
<axis xyz='0 1 0'/><limit lower='-2' upper='2' velocity='1'/></joint>
<joint name='wrist' type='fixed'><parent link='lower'/><child link='hand'/><origin xyz='0.5 0 0'/></joint></robot>";

#[test]
fn fk_takes_any_two_frames_and_many_configurations() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("b.urdf");
    std::fs::write(&file, BRANCHES).unwrap();
    let file = file.to_str().unwrap();
    // From the camera up to the body and down to the hand: `turn` does not matter.
    let one = dimos(&["fk", file, "--base", "camera", "--link", "hand", "0", "0", "0"]);
    assert!(one.out.contains("hand in camera\nxyz   1.000000 0.000000 -0.500000  m"), "{}{}", one.out, one.err);
    let wrong = dimos(&["fk", file, "--base", "camera", "--link", "hand"]);
    assert!(wrong.err.contains("the joints are: tilt shoulder elbow"), "{}", wrong.err);
    let lines = "0 0 0\n[0, 0, 0]\n# note\n0 1.5707963267948966 0\n";
    let many = dimos_with(&["fk", file, "--base", "camera", "--link", "hand", "--stdin"], lines);
    let rows: Vec<Vec<f64>> =
        many.out.lines().map(|row| row.split_whitespace().map(|v| v.parse().unwrap()).collect()).collect();
    assert_eq!((many.code, rows.len(), rows[0].len()), (0, 3, 7), "{}{}", many.out, many.err);
    assert_eq!((&rows[0][..3], &rows[2][..3]), (&[1.0, 0.0, -0.5][..], &[0.0, 0.0, -1.5][..]));
    let json = dimos_with(&["fk", file, "--base", "camera", "--link", "hand", "--stdin", "--json"], lines);
    let last: serde_json::Value = serde_json::from_str(json.out.lines().last().unwrap()).unwrap();
    assert!((last["xyz"][2].as_f64().unwrap() + 1.5).abs() < 1e-9, "{last}");
    let broken = dimos_with(&["fk", file, "--base", "camera", "--link", "hand", "--stdin"], "0 0 0\n0 0\n");
    assert!(broken.code == 2 && broken.err.contains("stdin:2: 2 numbers for 3 joints"), "{}", broken.err);
}

#[test]
fn ik_has_a_base_a_group_a_tolerance_and_all_solutions() {
    let folder = tempfile::tempdir().unwrap();
    let (file, srdf) = (folder.path().join("b.urdf"), folder.path().join("b.srdf"));
    std::fs::write(&file, BRANCHES).unwrap();
    let groups = "<group name='arm'><chain base_link='body' tip_link='hand'/></group>\
                  <group name='body'><joint name='turn'/></group>";
    std::fs::write(&srdf, format!("<robot name='b'>{groups}</robot>")).unwrap();
    let (file, srdf) = (file.to_str().unwrap(), srdf.to_str().unwrap());
    let pose = ["--position-only", "--pose", "0.5", "0", "0"];
    // The arm alone, in the frame of its body 0.5 m below the shoulder: the elbow points up or down.
    let with = |more: &[&str]| dimos(&[&["ik", file, "--srdf", srdf][..], &pose, more].concat());
    let all = with(&["--group", "arm", "--base", "body", "--all", "--json"]);
    let all: serde_json::Value = serde_json::from_str(&all.out).unwrap();
    assert_eq!(
        (&all["link"], &all["base"], all["joints"].as_array().unwrap().len()),
        (&"hand".into(), &"body".into(), 2)
    );
    let found = all["all"].as_array().unwrap();
    let away: Vec<f64> = found.iter().map(|one| one["distance"].as_f64().unwrap()).collect();
    assert!(found.len() == 2 && away[0] <= away[1] && all["distance"] == away[0], "{all}");
    let elbows: Vec<f64> = found.iter().map(|one| one["positions"][1].as_f64().unwrap()).collect();
    assert!((elbows[0].abs() - std::f64::consts::FRAC_PI_2).abs() < 1e-3 && elbows[0] * elbows[1] < 0.0, "{all}");
    let table = with(&["--group", "arm", "--all"]);
    assert!(table.out.starts_with("DISTANCE") && table.out.lines().count() == 3, "{}", table.out);
    // 5 mm out of reach.
    let far = ["ik", file, "--srdf", srdf, "--position-only", "--pose", "1.005", "0", "0.5", "--group", "arm"];
    assert_eq!(dimos(&far).code, 1);
    let loose = dimos(&[&far[..], &["--tolerance", "0.01", "--json"]].concat());
    let loose: serde_json::Value = serde_json::from_str(&loose.out).unwrap();
    assert!((4.9e-3..0.01).contains(&loose["position_error"].as_f64().unwrap()), "{loose}");
    let seeded = with(&["--group", "arm", "--seed", "0", "2.5"]);
    assert!(seeded.err.contains("warning: elbow at 2.5 rad is outside its limits -2.0000 to 2.0000"), "{}", seeded.err);
    for (more, what) in [
        (&["--base", "camera", "--link", "hand"][..], "`hand` is not below `camera`"),
        (&["--group", "body", "--base", "body", "--link", "hand"], "`turn` moves the base `body`"),
        (&["--group", "leg"], "unknown group `leg`"),
        (&["--tolerance", "0"], "must be within 1e-9–0.1"),
    ] {
        let wrong = with(more);
        assert!(wrong.code == 2 && wrong.err.contains(what), "{what}: {}", wrong.err);
    }
}

#[test]
fn collide_shows_the_pairs_that_touch_or_are_close() {
    let folded = ["0", "0", "1.7", "0", "0", "0"];
    let free = dimos(&["collide", "builtin:yourarm", "0", "0", "0", "0", "0", "0", "--within", "0"]);
    assert_eq!((free.code, free.out.as_str()), (0, "free: no two links are within 0.0000 m\n"), "{}", free.err);
    let near = dimos(&["collide", "builtin:yourarm", "0", "0", "0", "0", "0", "0", "--within", "1", "--json"]);
    let near: serde_json::Value = serde_json::from_str(&near.out).unwrap();
    let distances: Vec<f64> =
        near["pairs"].as_array().unwrap().iter().map(|pair| pair["distance"].as_f64().unwrap()).collect();
    assert!(distances.len() > 5 && distances[0] > 0.0 && distances.is_sorted() && near["free"] == true, "{near}");
    let touching = dimos(&[&["collide", "builtin:yourarm"][..], &folded].concat());
    assert!(touching.code == 1 && touching.out.contains("touches"), "{}{}", touching.out, touching.err);
    assert!(touching.out.contains("a negative distance is the penetration depth"), "{}", touching.out);
    let wrong = dimos(&["collide", "builtin:yourarm", "0"]);
    assert!(wrong.code == 2 && wrong.err.contains("takes 6 positions, found 1"), "{}", wrong.err);
}

/// A binary STL file of a tetrahedron with edges of this length.
fn tetrahedron(length: f32) -> Vec<u8> {
    let corners = [[0.0, 0.0, 0.0], [length, 0.0, 0.0], [0.0, length, 0.0], [0.0, 0.0, length]];
    let mut bytes = vec![0; 80];
    bytes.extend(4_u32.to_le_bytes());
    for face in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
        bytes.extend([0; 12]);
        face.iter().flat_map(|i: &usize| corners[*i]).for_each(|v: f32| bytes.extend(v.to_le_bytes()));
        bytes.extend([0, 0]);
    }
    bytes
}

#[test]
fn meshes_are_shown_with_their_size_and_doubted() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("m.urdf");
    let mesh = |tag: &str, name: &str| format!("<{tag}><geometry>\n<mesh filename='{name}'/></geometry></{tag}>");
    let body = |collision: &str| {
        let shapes = mesh("visual", "big.stl") + &mesh("collision", collision);
        std::fs::write(&file, format!("<robot name='m'><link name='a'>{shapes}</link></robot>")).unwrap();
    };
    let at = |name: &str| folder.path().join(name);
    std::fs::write(at("fine.stl"), tetrahedron(0.25)).unwrap();
    std::fs::write(at("big.stl"), tetrahedron(250.0)).unwrap();
    std::fs::write(at("small.stl"), tetrahedron(0.25e-5)).unwrap();
    std::fs::write(at("cut.stl"), &tetrahedron(0.25)[..184]).unwrap();
    std::fs::write(at("pointer.stl"), "version https://git-lfs.github.com/spec/v1\noid sha256:1\n").unwrap();
    let path = file.to_str().unwrap();
    body("fine.stl");
    let info = dimos(&["info", path]);
    assert!(info.code == 0 && info.out.contains("fine.stl (4 triangles, 0.2500 × 0.2500 × 0.2500 m)"), "{}", info.out);
    assert!(
        info.err.contains("the mesh of the link `a` extends over 250.0 × 250.0 × 250.0 m: big.stl"),
        "{}",
        info.err
    );
    let check = dimos(&["check", path]);
    assert!(check.code == 0 && check.err.contains("scale=\"0.001 0.001 0.001\""), "{}", check.err);
    assert!(check.err.contains("m.urdf:2:17"), "{}", check.err);
    body("small.stl");
    assert!(dimos(&["check", path]).err.contains("extends over only"));
    for (name, what) in [
        ("cut.stl", "its header declares 4 triangles (284 bytes), it has 184 bytes"),
        ("pointer.stl", "this is a Git LFS pointer"),
        ("gone.stl", "collision mesh not found"),
    ] {
        body(name);
        let check = dimos(&["check", path]);
        assert!(check.code == 2 && check.err.contains(what) && check.err.contains("m.urdf:3:17"), "{}", check.err);
        let info = dimos(&["info", path]);
        let mark = if name == "gone.stl" { "gone.stl (NOT FOUND)".to_owned() } else { format!("{name} (UNREADABLE)") };
        assert!(info.code == 2 && info.out.contains(&mark) && info.err.contains(what), "{}{}", info.out, info.err);
    }
}

#[test]
fn poses_and_inertias_that_are_impossible_are_warnings() {
    let folder = tempfile::tempdir().unwrap();
    let (file, srdf) = (folder.path().join("b.urdf"), folder.path().join("b.srdf"));
    let inertial = |moments: &str| format!("<inertial><mass value='1'/><inertia {moments}/></inertial>");
    let with = |moments: &str| {
        let link = format!("<link name='hand'>{}</link>", inertial(moments));
        std::fs::write(&file, BRANCHES.replace("<link name='hand'/>", &link)).unwrap();
        let arguments = ["check", file.to_str().unwrap(), "--srdf", srdf.to_str().unwrap()];
        dimos(&arguments)
    };
    let pose = "<group name='arm'><joint name='elbow'/></group>\n<group_state name='far' group='arm'><joint name='elbow' value='9'/></group_state>";
    std::fs::write(&srdf, format!("<robot name='b'>\n{pose}</robot>")).unwrap();
    let found = with("ixx='1' iyy='1' izz='1' ixy='0' ixz='0' iyz='0'");
    assert!(found.code == 0 && found.out.contains("no mistakes, 1 warning"), "{}{}", found.out, found.err);
    assert!(found.err.contains("b.srdf:3:20") && found.err.contains("the pose `far` cannot be used"), "{}", found.err);
    let info = dimos(&["info", file.to_str().unwrap(), "--srdf", srdf.to_str().unwrap()]);
    assert!(info.out.contains("pose far of arm: elbow 9 (OUTSIDE THE LIMITS)"), "{}", info.out);
    for (moments, what) in [
        ("ixx='1' iyy='-1' izz='1' ixy='0' ixz='0' iyz='0'", "a principal moment is -1.000e0"),
        ("ixx='1' iyy='1' izz='1' ixy='5' ixz='0' iyz='0'", "a principal moment is -4.000e0"),
        ("ixx='1' iyy='1' izz='2.5' ixy='0' ixz='0' iyz='0'", "above the sum of the others, 2.000e0"),
    ] {
        let found = with(moments);
        assert!(found.code == 0 && found.err.contains(what), "{what}: {}", found.err);
        assert!(found.err.contains("the inertia of the link `hand` is impossible"), "{}", found.err);
    }
}

#[test]
fn a_file_that_cannot_be_read_is_one_error() {
    let folder = tempfile::tempdir().unwrap();
    for (path, what) in [
        (folder.path().join("x.urdf").display().to_string(), "No such file or directory"),
        (folder.path().display().to_string(), "this is a folder, not a file"),
        ("/dev/zero".to_owned(), "not a regular file"),
        ("builtin:xarm66".to_owned(), "unknown built-in robot `xarm66`"),
    ] {
        for verb in ["check", "info", "tree", "expand"] {
            let found = dimos(&[verb, &path]);
            assert!(found.code == 2 && found.err.contains(what), "{verb}: {}", found.err);
            assert_eq!(found.err.matches("error:").count(), 1, "{verb}: {}", found.err);
            assert!(!found.err.contains("has mistakes"), "{verb}: {}", found.err);
        }
    }
}
