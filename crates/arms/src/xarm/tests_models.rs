//! Other models, firmware versions and configurations.

use serde_json::json;

use super::emulator::Withhold;
use super::tests::{config, pair, read, ready, sent, set, six};
use super::{MODES_WITHOUT_VELOCITY, SPEC};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::ManipulatorAdapter;
use dimos_hardware::conformance::{Outcome, Subject, checks, run_all};
use dimos_hardware::registry::{AdapterSpec, Emulator};
use dimos_hardware::sim::faults::{Fault, FaultKind};

#[test]
fn other_models_options_and_firmwares_conform_too() {
    for (dof, options) in [
        (6, json!({"gripper": "xarm", "force_torque": true})),
        (6, json!({"model": "lite6"})),
        (5, json!({"sim": {"firmware": "1.12.10"}, "gripper": "xarm_g2"})),
        (6, json!({"model": "xarm850", "sim": {"firmware": "1.5.20"}})),
    ] {
        let old = options["sim"].is_object();
        let subject = Subject { config: config("", dof, options.clone()), ..Subject::emulated(&SPEC) };
        // Reports before firmware 2.1.0 have no time stamp, so a repeated measurement looks like an arm at rest. Before
        // 1.8.0 there is no velocity mode.
        let old_modes = options["sim"]["firmware"] == "1.5.20";
        let modes = if old_modes { MODES_WITHOUT_VELOCITY } else { SPEC.modes };
        let subject = Subject { row: AdapterSpec { modes, ..SPEC }, ..subject };
        let differs = |name: &str| match name {
            "frozen_state_is_noticed" => old,
            "modes_are_what_it_says" => old_modes, // velocity mode is refused with more words than Unsupported
            _ => false,
        };
        let all: Vec<_> = checks().filter(|check| !differs(check.name)).collect();
        for (check, outcome, _) in run_all(&subject, &all, &|_, _| (), &|| false) {
            assert!(!matches!(outcome, Outcome::Failed(_)), "{options} {}: {outcome:?}", check.name);
        }
    }
}

#[test]
fn old_firmware_has_no_velocity_mode_because_it_would_not_end_a_velocity() {
    let (emulator, mut arm) = ready(json!({"sim": {"firmware": "1.7.9"}}), ControlMode::ServoPosition);
    assert_eq!(arm.get_info().modes, [ControlMode::Position, ControlMode::ServoPosition]);
    emulator.record();
    let refused = set(&mut arm, ControlMode::Velocity).unwrap_err().to_string();
    assert!(refused.contains("needs firmware 1.8.0 or newer") && refused.contains("has 1.7.9"), "{refused}");
    assert!(arm.write_joint_velocities(&[0.1; 6]).is_err());
    assert_eq!((sent(&emulator, 81).len(), sent(&emulator, 19).len()), (0, 0));
    let (_emulator, mut arm) = ready(json!({"sim": {"firmware": "1.8.0"}}), ControlMode::Velocity);
    assert!(arm.get_info().modes.contains(&ControlMode::Velocity));
    arm.write_joint_velocities(&[0.0; 6]).unwrap();
}

/// Firmware before 2.4.0 reports commanded positions at port 30003: a blocked joint does not show.
#[test]
fn reports_of_commanded_positions_are_warned_of() {
    for (firmware, withhold, blind) in [
        ("1.12.10", Withhold::No, true),
        ("2.2.0", Withhold::Close, true),
        ("2.2.0", Withhold::No, false),
        ("2.5.1", Withhold::Close, false),
    ] {
        let (emulator, mut arm) = pair(6, json!({"sim": {"firmware": firmware}}));
        emulator.withhold_full_reports(withhold);
        arm.connect().unwrap();
        let warning = arm.connection_warning().unwrap_or_default();
        assert_eq!(
            warning.contains("tracking supervision sees no difference"),
            blind,
            "{firmware} {withhold:?}: {warning}"
        );
    }
    let (emulator, mut arm) = ready(json!({"sim": {"firmware": "1.12.10"}}), ControlMode::ServoPosition);
    emulator.inject(Fault::new(FaultKind::Blocked).lasting(10.0)).unwrap();
    let start = six(&mut arm);
    let mut target = start;
    for _ in 0..10 {
        target[0] += 0.02;
        arm.write_joint_positions(&target, 1.0).unwrap();
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    std::thread::sleep(std::time::Duration::from_millis(100));
    let (shown, truth) = (six(&mut arm)[0], emulator.joints().0[0]);
    assert!((shown - target[0]).abs() < 1e-3 && (truth - start[0]).abs() < 1e-3, "{shown}, in truth {truth}");
}

#[test]
fn without_port_30000_the_reports_of_30003_are_used() {
    for withhold in [Withhold::Close, Withhold::Silence] {
        let (emulator, mut arm) = pair(6, json!({}));
        emulator.withhold_full_reports(withhold);
        arm.connect().unwrap();
        assert_eq!(arm.get_info().native_rate, 100.0);
        arm.activate().unwrap();
        assert!(read(&mut arm).unwrap().velocity.is_none());
    }
}

#[test]
fn old_firmware_has_no_velocities_and_gets_no_new_parameters() {
    let (emulator, mut arm) = pair(6, json!({"sim": {"firmware": "1.5.20"}}));
    emulator.record();
    arm.connect().unwrap();
    arm.activate().unwrap();
    assert_eq!(arm.get_info().native_rate, 100.0);
    let reading = read(&mut arm).unwrap();
    assert!(reading.velocity.is_none() && reading.effort.is_some() && reading.stamp.is_some());
    assert!(sent(&emulator, 19).iter().all(|payload| payload.len() == 1));
    assert!(emulator.trace().iter().all(|received| received.protocol == 2), "not watched before 1.8.6");
}

#[test]
fn a_wrong_arm_is_refused_before_anything_else_is_asked() {
    let (emulator, mut arm) = pair(6, json!({}));
    emulator.inject(Fault::new(FaultKind::WrongModel)).unwrap();
    emulator.record();
    let error = arm.connect().unwrap_err().to_string();
    let expected = "expected the model xArm 6 with 6 joints, found a Lite 6 with 6 joints\nhint: is the address right? \
                    Else set the arm's options to {model: lite6}";
    assert!(error.ends_with(expected), "{error}");
    assert_eq!(emulator.trace().len(), 1, "nothing but the version was asked");
}

#[test]
fn wrong_configurations_are_refused() {
    for (config, part) in [
        (config("192.168.1.185", 8, json!({})), "arm: no xArm has 8 joints"),
        (config("192.168.1.185", 6, json!({"model": "xarm7"})), "arm: xArm 7 has 7 joints, not 6"),
        (config("192.168.1.185", 6, json!({"model": "xarm9"})), "xarm9"),
        (config("192.168.1.185:502:x", 6, json!({})), "not a report port"),
        (config("", 6, json!({})), "host is missing"),
        (config("::1", 6, json!({"speed_scale": 0})), "is not above 0 and at most 1"),
        (config("::1", 6, json!({"speed": 1.0})), "unknown field"),
    ] {
        let error = (SPEC.create)(&config).err().unwrap().to_string();
        assert!(error.contains(part), "{error}");
    }
}
