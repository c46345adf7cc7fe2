//! The condition of the joints, their calibration and the device's own time: what the program says of them, and how
//! often the controller is asked.

use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::recording::messages::JointStatus;
use dimos::recording::replay::{LogReader, Payload};

use crate::support::program::{Home, eventually};

#[test]
fn joints_are_in_status_and_in_the_log_and_are_read_rarely() {
    let (home, arm) = (Home::new(), YourArmEmulator::with(&SimOptions::default()).unwrap());
    let run = home.run(&format!("coordinator-yourarm --set hardware.arm.address={}", arm.address()));
    let joint = |j: usize| home.status()["arms"][0]["joints"][j].clone();
    eventually("the joints", || joint(5)["temperature"].is_number());
    let second = joint(1);
    assert_eq!((second["name"].as_str(), second["voltage"].as_f64()), (Some("arm_joint2"), Some(48.0)));
    assert!((30.5..40.0).contains(&second["temperature"].as_f64().unwrap()), "{second}");
    let offset = second["calibration_offset"].as_f64().unwrap();
    assert!((offset - (-2.0_f64).to_radians()).abs() < 1e-6, "{offset} rad");
    home.dimos("status -v").with(0).shows(&[
        "arm: temperature °C: 3",
        "arm: supply V: 48.0 48.0",
        "calibration offset rad: ",
    ]);

    arm.record();
    std::thread::sleep(std::time::Duration::from_secs(2));
    let trace = arm.trace();
    let count = |request: Request| trace.iter().filter(|r| r.request == request).count();
    let (status, states) = (count(Request::GetJointStatus), count(Request::GetState(true)));
    assert!((1..=6).contains(&status) && states > 20 * status, "{status} of {states} in 2 s");

    arm.inject(Fault { joint: 3, ..Fault::new(FaultKind::MotorOff) }).unwrap();
    eventually("the drive's error", || joint(2)["error"] == 7);
    home.dimos("status -v").with(0).shows(&["the drive of arm_joint3 reports error 7", "drive error: 0 0 7 0 0 0"]);
    home.dimos("down").with(0);
    drop(run);

    let [log] = &home.logs()[..] else { panic!("one log") };
    let mut reader = LogReader::open(log).unwrap();
    let (mut conditions, mut calibrated, mut times) = (Vec::<JointStatus>::new(), 0, Vec::new());
    while let Some(entry) = reader.next_entry().unwrap() {
        match entry.data {
            Payload::JointStatus(condition) => conditions.push(condition),
            Payload::Log(line) => {
                calibrated += usize::from(line.msg.contains("arm: calibration offsets 0.0262 -0.0349"))
            }
            Payload::ArmInput(input) => times.extend(input.device_ns.first().map(|own| (*own, input.stamp_ns))),
            _ => {}
        }
    }
    assert_eq!(calibrated, 1, "logged once");
    assert!(conditions.len() > 3, "{}", conditions.len());
    assert!(conditions.iter().all(|c| c.name.len() == 6 && c.temperature.len() == 6 && c.error.len() == 6));
    assert!(conditions.iter().any(|c| c.error[2] == 7) && conditions[0].error[2] == 0);
    // The device's clock and the host's go at the same rate, from zeros of their own.
    let ((first_own, first), (last_own, last)) = (times[0], times[times.len() - 1]);
    assert!(last_own > first_own && first_own != first);
    let drift = (last_own - first_own) as f64 / (last - first) as f64 - 1.0;
    assert!(drift.abs() < 0.02, "{drift}");
}
