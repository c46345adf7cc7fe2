//! Files that have no end, or that nothing writes to, are refused: nothing waits for them, and no memory is filled.

use std::process::Command;

use crate::support::program::Home;

/// Runs the program with little memory and little time; returns its exit code and what it says.
fn ended(home: &Home, line: &str) -> (Option<i32>, String) {
    let mut command = Command::new("timeout");
    let limited = format!("ulimit -v 8000000; exec {} {line}", env!("CARGO_BIN_EXE_dimos"));
    let ended = home.settle(command.args(["20", "sh", "-c", &limited])).output().unwrap();
    (ended.status.code(), String::from_utf8_lossy(&ended.stderr).into_owned())
}

#[test]
fn files_without_end_are_refused() {
    let home = Home::new();
    let made = Command::new("mkfifo").arg(home.path().join("pipe")).status().unwrap();
    assert!(made.success());
    let servos = "name: servos
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 5}, adapter_type: so101, address: /dev/ttyACM9,
     options: {calibration: FILE}}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";
    let pipe = home.path().join("pipe").display().to_string();
    for (file, why) in [("/dev/zero", "not a regular file"), (pipe.as_str(), "not a regular file")] {
        home.write("servos.yaml", &servos.replace("FILE", file));
        for line in [format!("adapter emulate yourarm --fault {file}"), "check servos.yaml".to_owned()] {
            let (code, said) = ended(&home, &line);
            assert!(code == Some(2), "{line}: {code:?} {said}");
            assert!(said.contains(why) || line.starts_with("adapter"), "{line}: {said}");
        }
    }
    // A job may come from a pipe, and has an end.
    let (code, said) = ended(&home, "do /dev/zero --check");
    assert!(code == Some(2) && said.contains("larger than 1 MiB"), "{code:?} {said}");
    let _run = home.run("yourarm-planner --no-record");
    for file in ["/dev/zero", &pipe] {
        let (code, said) = ended(&home, &format!("world load {file}"));
        assert!(code == Some(2) && said.contains("not a regular file"), "{code:?} {said}");
    }
}
