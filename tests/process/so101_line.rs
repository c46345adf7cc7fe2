//! Two SO-101 on one serial line as a user runs them: servos 1 to 6 and 7 to 12 of one emulator in another process.

use rustix::process::Signal;

use crate::support::program::{Home, eventually};

/// A blueprint with both arms at these addresses.
fn blueprint([left, right]: [&str; 2], options: &str) -> String {
    format!(
        "hardware:
  - {{hardware_id: left, joints: {{prefix: left, count: 5}}, adapter_type: so101, address: {left}, auto_enable: true}}
  - hardware_id: right
    joints: {{prefix: right, count: 5}}
    adapter_type: so101
    address: {right}
    auto_enable: true
    options: {options}
tasks:
  - {{name: traj_left, type: trajectory, joint_names: {{hardware: left}}, params: {{goal_tolerance: 0.05}}}}
  - {{name: traj_right, type: trajectory, joint_names: {{hardware: right}}, params: {{goal_tolerance: 0.05}}}}
"
    )
}

#[test]
fn two_arms_on_one_line_move_stop_and_are_lost_together() {
    let home = Home::new();
    let emulator = home.start("adapter emulate so101 --link line --option sim.ids=[1,2,3,4,5,6,7,8,9,10,11,12]");
    eventually("the emulator is there", || home.path().join("line").exists());
    let line = home.path().join("line").display().to_string();
    home.write("two.yaml", &blueprint([&line, &line], "{first_id: 7}"));
    let run = home.run("two.yaml");
    for (arm, other, goal) in [("left", "right", "0.3 -0.2 0.1 0.2 -0.3"), ("right", "left", "-0.3 0.2 0.2 -0.1 0.4")] {
        let before = home.positions(other);
        let moved = home.dimos(&format!("move {arm} {goal}")).with(0);
        assert!(moved.out.contains("COMPLETED"), "{}", moved.out);
        let apart = home.positions(other).into_iter().zip(before).all(|(now, before)| (now - before).abs() < 0.02);
        assert!(apart, "{other} stays");
    }
    home.dimos("stop").with(0);
    assert!((0..2).all(|arm| home.status()["arms"][arm]["phase"] == "held"), "{}", home.status());
    emulator.end(Signal::INT).with(130);
    eventually("both report the loss", || {
        let status = home.status();
        let lost = |arm: usize| status["arms"][arm]["link"] != "up";
        lost(0) && lost(1)
    });
    drop(run);
}

#[test]
fn two_arms_on_one_port_need_their_own_numbers_and_a_fast_line() {
    let home = Home::new();
    let check = |addresses: [&str; 2], options: &str| {
        home.write("two.yaml", &blueprint(addresses, options));
        home.dimos("check two.yaml")
    };
    let port = "/dev/ttyACM7";
    check([port; 2], "{first_id: 7}").with(0);
    check([port; 2], "{}").with(2).says(&["two.yaml:6:14", "two arms have the address", "`options.first_id`"]);
    let overlap = check([port; 2], "{first_id: 4}").with(2);
    overlap.says(&["two.yaml:8:25", "some of the numbers 4 to 9 are those of left", "first used here"]);
    check([port; 2], "{first_id: 248}").with(2).says(&["two.yaml:8:25", "1 to 252"]);
    let slow = "/dev/ttyACM7@500000";
    check([slow; 2], "{first_id: 7}").with(2).says(&["117 % of the line's time (limit 80 %)"]);
    check([port, slow], "{first_id: 7}").with(2).says(&["two.yaml:6:14", "have two rates", "first used here"]);
    // The same line by another name.
    home.write("port", "");
    let [file, link] = ["port", "by-id"].map(|name| home.path().join(name));
    std::os::unix::fs::symlink(&file, &link).unwrap();
    let [file, link] = [file, link].map(|path| path.display().to_string());
    check([&file, &link], "{first_id: 7}").with(0);
    check([&file, &link], "{}").with(2).says(&["two arms have the address"]);
    let slow = format!("{link}@500000");
    check([&format!("{file}@500000"), &slow], "{first_id: 7}").with(2).says(&["117 % of the line's time"]);
}
