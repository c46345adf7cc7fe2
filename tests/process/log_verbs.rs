//! `dimos log` and what 3D tools need, on logs of real runs.

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;

use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip_tool;

/// Runs the example arm with a planner: two motions, an obstacle that comes and goes.
fn recorded() -> Home {
    let home = Home::new();
    let run = home.run("yourarm-planner");
    home.dimos("world add wall --box 0.1 0.2 0.3 --at 0.6 0 0.2").with(0);
    home.dimos("move arm 0.3 -0.2 0.5 0 0.4 0").with(0);
    home.dimos("world remove wall").with(0);
    home.dimos("move arm --named home").with(0);
    run.end(Signal::INT).with(130);
    home
}

fn topics(info: &Value) -> Vec<(String, u64)> {
    let topics = info["topics"].as_array().unwrap().iter();
    topics.map(|t| (t["topic"].as_str().unwrap().to_owned(), t["messages"].as_u64().unwrap())).collect()
}

#[test]
fn a_log_is_listed_checked_printed_cut_and_exported() {
    let home = recorded();
    let log = home.logs()[0].display().to_string();
    let listed = home.dimos("log list --json").with(0).json();
    assert_eq!(
        (&listed[0]["state"], &listed[0]["arms"][0], &listed[0]["faults"]),
        (&"complete".into(), &"arm".into(), &0.into())
    );
    let info = home.dimos("log info --last --json").with(0).json();
    let seen = topics(&info);
    let count = |topic: &str| seen.iter().find(|(name, _)| name == topic).map_or(0, |(_, count)| *count);
    assert_eq!((count("/robot_description"), count("/tf_static"), count("/joint_trajectory")), (1, 1, 2), "{seen:?}");
    // Added, removed, and the paths of two motions.
    assert!(count("/markers") >= 4 && count("/diagnostics") > 1, "{seen:?}");
    let length = info["length"].as_f64().unwrap();
    assert!(count("/tf") as f64 >= 20.0 * (length - 1.0), "{} in {length} s", count("/tf"));
    home.dimos("log info --last").with(0).shows(&["/tf", "tf2_msgs/msg/TFMessage", "faults: 0"]);
    home.dimos("log doctor --last").with(0).shows(&["healthy"]);
    home.dimos("log verify --last").with(0).shows(&["reproducible"]);
    home.dimos("replay --last --verify").with(0).shows(&["reproducible"]);

    // `cat` reads every message, and each topic alone.
    let all = home.dimos("log cat --last --json").with(0);
    assert_eq!(all.out.lines().count() as u64, seen.iter().map(|(_, count)| count).sum::<u64>());
    let first =
        |topic: &str| all.out.lines().position(|line| line.contains(&format!("\"topic\":\"{topic}\""))).unwrap();
    assert!(first("/robot_description") < first("/joint_states"), "latched topics come first");
    let motions = home.dimos("log cat --last --json --topics /joint_trajectory").with(0);
    let motion: Value = serde_json::from_str(motions.out.lines().next().unwrap()).unwrap();
    assert_eq!(motion["data"]["joint_names"][0], "arm_joint1");

    // A part begins with the state before it.
    let part = home.path().join("part.mcap").display().to_string();
    home.dimos(&format!("log cut {log} --from 0.5 --to 1.5 -o {part}")).with(0);
    let cut = home.dimos(&format!("log info {part} --json")).with(0).json();
    let kept = topics(&cut);
    assert!((0.9..=1.01).contains(&cut["length"].as_f64().unwrap()), "{}", cut["length"]);
    for topic in ["/robot_description", "/tf_static", "/dimos/outputs/arm"] {
        assert!(kept.iter().any(|(name, count)| name == topic && *count > 0), "{topic} is not in {kept:?}");
    }
    assert_eq!(cut["attachments"], info["attachments"]);
    home.dimos(&format!("log doctor {part}")).with(0);
    home.dimos(&format!("log verify {part}")).with(2).says(&["is a part of", "verify the whole log"]);
    home.dimos(&format!("log cut {log} -o {part}")).with(1).says(&["cannot write", "hint: choose another file"]);
    home.dimos(&format!("log cut {log} --from 10h -o x.mcap")).with(2).says(&["nothing is between"]);

    let table = home.path().join("table.csv");
    home.dimos(&format!("log export {log} -o {}", table.display())).with(0);
    let table = std::fs::read_to_string(table).unwrap();
    let rows: Vec<Vec<&str>> = table.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows[0][..3], ["time", "arm_joint1.position", "arm_joint1.velocity"]);
    assert_eq!(rows.len() as u64, count("/joint_states") + 1);
    assert!(rows.iter().all(|row| row.len() == rows[0].len()));
    let moved = rows.iter().any(|row| row[1].parse::<f64>().is_ok_and(|q| (q - 0.3).abs() < 0.01));
    assert!(moved, "joint 1 went to 0.3 rad");
    let ticks = home.dimos("log export --last --topic /dimos/tick").with(0);
    assert!(ticks.out.lines().next().unwrap().contains("late_ns"));
    home.dimos("log plot --last --joint arm_joint1 -o plot.svg").with(0);
    let plot = std::fs::read_to_string(home.path().join("plot.svg")).unwrap();
    assert!(plot.contains("arm_joint1") && plot.contains("limits -") && !plot.contains("arm_joint2"), "{plot}");
    home.dimos("log plot --last --joint arm_gripper -o grip.svg").with(0);
    let grip = std::fs::read_to_string(home.path().join("grip.svg")).unwrap();
    assert!(grip.contains("position [m]") && !grip.contains("commanded"), "{grip}");
    home.dimos("log plot --last -o plot.png").with(2).says(&["the drawing is SVG", "-o plot.svg"]);
    assert!(!home.path().join("plot.png").exists());
    home.dimos("log plot --last --joint elbow -o plot.svg").with(2).says(&["joints: arm_joint1"]);
    home.dimos("log cat --last --topics /nothing").with(2).says(&["topics: "]);
    home.dimos("log export --last --topic /nothing").with(2).says(&["topics: "]);
    // What fails leaves nothing: the next attempt finds the name free.
    for failing in ["export --last --topic /nothing -o new", "what-if --last --set arms.arm.nothing=1 -o new"] {
        home.dimos(&format!("log {failing}")).with(2);
        assert!(!home.path().join("new").exists(), "{failing}");
    }
    home.dimos("log what-if --last --set rate=90 -o new").with(0);
    home.dimos("log export --last -o new").with(1).says(&["cannot write new"]);
    assert!(home.path().join("new").exists(), "a file that was there before is kept");

    played(&home, Path::new(&log), &seen);
}

/// Checks which messages of a log are played: the options of `ros2 bag play`.
fn played(home: &Home, log: &Path, seen: &[(String, u64)]) {
    let name = log.file_name().unwrap().display();
    let play = |options: &str| {
        let out = home.dimos(&format!("replay {name} --json --rate 1000000 {options}")).with(0).out;
        let topic = |line: &str| serde_json::from_str::<Value>(line).unwrap()["topic"].as_str().unwrap().to_owned();
        out.lines().map(topic).collect::<Vec<_>>()
    };
    let all = seen.iter().map(|(_, count)| count).sum::<u64>() as usize;
    assert_eq!(play("").len(), all, "a log is found by its name alone");
    let fewer = play("--exclude-topics /joint_states,/tf");
    assert!(fewer.len() < all && !fewer.iter().any(|topic| topic == "/joint_states" || topic == "/tf"));
    home.dimos(&format!("replay {name} --exclude-topics /nothing")).with(2).says(&["has no topic /nothing"]);
    let info = home.dimos(&format!("log info {name} --json")).with(0).json();
    let start = info["start"].as_u64().unwrap() as f64 * 1e-9;
    let part = play("--playback-duration 0.5").len();
    let until = play(&format!("--playback-until-sec {:.3}", start + 0.5)).len();
    assert!(part > 10 && part.abs_diff(until) < 20 && until < all / 2, "{part}, {until} of {all}");
    home.dimos(&format!("replay {name} --playback-until-sec 5")).with(2).says(&["before the first message"]);
    let began = std::time::Instant::now();
    play("--topics /tf_static --delay 0.5 --disable-keyboard-controls");
    assert!(began.elapsed().as_secs_f64() >= 0.5);
}

/// Start and length of the contents of each chunk of an MCAP file.
fn chunks(file: &[u8]) -> Vec<(usize, usize)> {
    const CHUNK: u8 = 0x06;
    let (mut at, mut found) = (8, Vec::new());
    while let Some(length) = file.get(at + 1..at + 9) {
        let length = u64::from_le_bytes(length.try_into().unwrap()) as usize;
        if file[at] == CHUNK {
            found.push((at + 9, length));
        }
        at += 9 + length;
    }
    found
}

#[test]
fn the_log_of_a_killed_run_is_recovered() {
    let home = Home::new();
    let run = home.run("coordinator-mock");
    eventually("there is something to lose", || {
        home.logs().first().is_some_and(|log| log.metadata().unwrap().len() > 60_000)
    });
    let log = home.logs()[0].clone();
    home.dimos("log doctor --last").with(0).shows(&["live"]);
    home.dimos("log recover --last").with(2).says(&["live run"]);
    run.signal(Signal::KILL);
    let _ = run.wait();
    // The last record is torn, as by a loss of power.
    let bytes = std::fs::read(&log).unwrap();
    std::fs::write(&log, &bytes[..bytes.len() - 7]).unwrap();
    home.dimos("log doctor --last").with(5).shows(&["problem: it ends at byte", "not whole"]);
    home.dimos("log info --last").with(5).shows(&["cut"]);
    home.dimos("log cat --last --topics /dimos/tick").with(5);
    home.dimos("log verify --last").with(5);
    // A part before the cut is whole.
    home.dimos("log cut --last -o end.mcap").with(5).says(&["the log is not whole: it ends at byte"]);
    let verbs = [
        "cut --to 0.2 -o b.mcap",
        "export --to 0.2",
        "export --to 0.2 --topic /dimos/tick",
        "export --to 0.2 --rosbag2 b",
    ];
    for verb in verbs.into_iter().chain(["cat --to 0.2", "plot --to 0.2 -o b.svg"]) {
        let begin = home.dimos(&format!("log {verb} --last")).with(0);
        assert!(!begin.err.contains("warning"), "{verb}: {}", begin.err);
    }
    home.dimos("log export --last -o all.csv").with(5);
    let recovered = home.dimos("log recover --last --json").with(5).json();
    let file = recovered["file"].as_str().unwrap();
    assert!(recovered["messages"].as_u64().unwrap() > 100 && file.ends_with("-recovered.mcap"), "{recovered}");
    home.dimos(&format!("log doctor {file}")).with(0);
    home.dimos(&format!("log verify {file}")).with(0).shows(&["reproducible"]);
    // A chunk in the middle is damaged: the rest is still read.
    let mut damaged = std::fs::read(file).unwrap();
    let chunks = chunks(&damaged);
    let (start, length) = chunks[chunks.len() / 2];
    damaged[start + length / 2] ^= 0x55;
    std::fs::write(home.path().join("damaged.mcap"), damaged).unwrap();
    home.dimos("log doctor damaged.mcap").with(5).shows(&["damaged at byte"]);
    home.dimos("log recover damaged.mcap").with(5);
    home.dimos("log doctor README.md").with(2);
}

#[test]
fn other_tools_place_the_tool_where_the_model_does() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv/bin/python");
    if !python.exists() {
        return skip_tool("the Python readers in .venv");
    }
    let home = recorded();
    let urdf = home.path().join("description.urdf");
    let mut read = Command::new(python);
    read.arg(root.join("tests/readers/read_scene.py")).arg(&home.logs()[0]).arg("arm_tcp").arg(&urdf);
    let output = read.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let scene: Value = serde_json::from_slice(&output.stdout).unwrap();
    let joints: Vec<String> = (1..=6).map(|i| scene["joints"][format!("arm_joint{i}")].to_string()).collect();
    let joints = joints.join(" ");
    // By the arm's model, and by the description in the log.
    for model in ["builtin:yourarm --link flange", &format!("{} --base map --link flange", urdf.display())] {
        let fk = home.dimos(&format!("model fk {model} {joints} --json")).with(0).json();
        for (axis, row) in scene["pose"].as_array().unwrap().iter().take(3).enumerate() {
            let off = row[3].as_f64().unwrap() - fk["xyz"][axis].as_f64().unwrap();
            assert!(off.abs() < 1e-6, "{off} m along axis {axis}: {} {fk}", scene["pose"]);
        }
    }
    // What is exported is what was recorded, to other people's readers.
    home.dimos("log export --last -o table.csv").with(0);
    home.dimos("log export --last --parquet table.parquet").with(0).shows(&["rows"]);
    home.dimos("log export --last --rosbag2 bag").with(0);
    let mut export = home.command("log export --last --lerobot set --task wave --json");
    export.env("PYTHONPATH", root.join("tests/python/recorded"));
    let set = Started::of(&mut export).wait().with(0).json();
    assert!(set["frames"].as_u64().unwrap() > 100 && set["fps"] == 100.0, "{set}");
    let mut read = Command::new(root.join(".venv/bin/python"));
    let output = read.arg(root.join("tests/readers/read_exports.py")).arg(&home.logs()[0]).arg(home.path()).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(String::from_utf8_lossy(&output.stdout).matches("are the same").count(), 3);
    home.dimos("log verify bag").with(0).shows(&["reproducible"]);
    home.dimos("log export --last --rosbag2 bag").with(1).says(&["cannot write", "hint: choose another file"]);
}

/// Without the package, or Python, nothing is written, and the message has what is to be installed.
#[test]
fn a_table_has_the_commands_of_the_gripper() {
    let home = Home::new();
    let run = home.run("coordinator-yourarm");
    home.dimos("arm gripper arm 0.02").with(0);
    home.dimos("down").with(0);
    run.wait().with(0);
    let table = home.dimos("log export --last").with(0).out;
    let mut rows = table.lines().map(|line| line.split(',').collect::<Vec<_>>());
    let column = rows.next().unwrap().iter().position(|name| *name == "arm_gripper.command").unwrap();
    let mut commands: Vec<&str> = rows.map(|row| row[column]).collect();
    commands.dedup();
    assert_eq!(commands, ["", "0.02"], "none before the command, and kept after it");
}

#[test]
fn exports_say_what_python_lacks() {
    let home = recorded();
    let bare = home.path().join("python");
    std::fs::write(&bare, "#!/bin/sh\nexec python3 -I -S \"$@\"\n").unwrap();
    std::fs::set_permissions(&bare, std::fs::Permissions::from_mode(0o755)).unwrap();
    for (format, to, package) in [("parquet", "a.parquet", "pyarrow"), ("lerobot", "set", "lerobot")] {
        let mut export = home.command(&format!("log export --last --{format} {to}"));
        let ended = Started::of(export.env("DIMOS_PYTHON", &bare)).wait().with(2);
        ended.says(&["has no package to write", "hint: ", &format!("-m pip install {package}"), "DIMOS_PYTHON"]);
        let mut export = home.command(&format!("log export --last --{format} {to}"));
        let ended = Started::of(export.env("DIMOS_PYTHON", "/nowhere/python")).wait().with(2);
        ended.says(&["/nowhere/python does not start", "hint: install Python 3, or set DIMOS_PYTHON"]);
        assert!(!home.path().join(to).exists());
    }
}

/// `make test-lerobot` installs LeRobot and asks for this one; it is too large for `make test-tools`.
#[test]
fn lerobot_loads_a_data_set() {
    if std::env::var("DIMOS_LEROBOT").as_deref() != Ok("1") {
        return;
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let home = recorded();
    for (folder, options) in [("set", ""), ("slow", "--fps 30")] {
        let python = root.join(".venv-lerobot/bin/python");
        let mut export = home.command(&format!("log export --last --lerobot {folder} --task wave {options}"));
        Started::of(export.env("DIMOS_PYTHON", &python)).wait().with(0);
        let mut load = Command::new(python);
        let output = load.arg(root.join("tests/readers/load_lerobot.py")).arg(home.path().join(folder)).output();
        let output = output.unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
}
