//! The conformance suite must be able to fail: adapters with one mistake each, and the check that finds it.

use dimos::arms::mock;
use dimos::hardware::conformance::first_motion::{Motion, refusal, run_first_motion};
use dimos::hardware::conformance::{Outcome, checks, run};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec};
use dimos::joint::ControlMode;
use dimos::rt::counting;

mod wrong;

use wrong::*;

#[test]
fn each_mistake_is_found_by_the_check_for_it() {
    let cases: &[(AdapterSpec, &str)] = &[
        (Wrong::<DEGREES>::SPEC, "planned_moves_arrive"),
        (Wrong::<WRONG_SIGN>::SPEC, "planned_moves_arrive"),
        (Wrong::<SWAPPED_JOINTS>::SPEC, "set_points_are_followed"),
        (Wrong::<IGNORES_STOP>::SPEC, "stop_ends_motion"),
        (Wrong::<MOVES_ON_ACTIVATION>::SPEC, "activation_holds"),
        (Wrong::<ENABLES_ON_CONNECT>::SPEC, "connecting_changes_nothing"),
        (Wrong::<HIDES_ERRORS>::SPEC, "errors_have_code_and_text"),
        (Wrong::<CLAIMS_TO_BE_CONNECTED>::SPEC, "not_connected_is_said"),
        (Wrong::<ACCEPTS_ANY_MODE>::SPEC, "modes_are_what_it_says"),
        (Wrong::<ZERO_VELOCITIES>::SPEC, "velocities_are_kept"),
        (Wrong::<FAILS_WITHOUT_SENSOR>::SPEC, "optional_parts_never_fail"),
        (Wrong::<DROPS_POWER_ON_LEAVING>::SPEC, "leaving_moves_nothing"),
        (Wrong::<DROPS_POWER_ON_DISCONNECTING>::SPEC, "leaving_moves_nothing"),
        (Wrong::<DROPS_POWER_ON_DISCONNECTING>::WIRED, "leaving_moves_nothing"),
        (Wrong::<IGNORES_SPEED>::SPEC, "planned_speed_is_kept"),
        (Wrong::<IGNORES_SPEED>::WIRED, "planned_speed_is_kept"),
        (Wrong::<CLEARING_ENABLES>::WIRED, "clearing_enables_nothing"),
        (Wrong::<GRIPPER_HURRIES_JOINTS>::WIRED, "gripper_moves_no_joint"),
        (Wrong::<WRONG_SIGN_BOTH_WAYS>::WIRED, "joints_are_the_arms_own"),
        (Wrong::<IGNORES_MODEL>::WIRED, "wrong_model_is_refused"),
        (Wrong::<HIDES_SILENCE>::WIRED, "silence_is_noticed"),
        (Wrong::<RESTAMPS_STATES>::WIRED, "frozen_state_is_noticed"),
        (Wrong::<RESTAMPS_STATES>::SPEC, "frozen_state_is_noticed"),
        (Wrong::<IGNORES_STOP>::WIRED, "stop_ends_motion"),
        (Wrong::<IGNORES_STOP>::SPEC, "stop_ends_velocity"),
        (Wrong::<IGNORES_STOP>::WIRED, "stop_ends_velocity"),
        (Wrong::<STOP_DROPS_POWER>::SPEC, "stop_ends_streaming"),
        (Wrong::<STOP_CLEARS_ERRORS>::WIRED, "stop_in_error_is_harmless"),
        (Wrong::<STOP_IS_FINAL>::WIRED, "stop_is_no_fault"),
        (Wrong::<GRIPPER_IGNORES_STOP>::WIRED, "stop_holds_the_gripper"),
        (Wrong::<STOP_LOCKS_GRIPPER>::SPEC, "stop_holds_the_gripper"),
        (Wrong::<GRIPPER_IN_MILLIMETRES>::SPEC, "gripper_is_in_its_unit"),
        (Wrong::<GRIPPER_CLAMPS>::WIRED, "gripper_range_is_kept"),
        (Wrong::<FORCE_CLAMPS>::SPEC, "gripper_force_is_kept"),
        (Wrong::<FORCE_IS_LOST>::WIRED, "gripper_force_is_kept"),
        (Wrong::<FORCE_REMAINS>::WIRED, "gripper_force_is_kept"),
        (Wrong::<FORCE_CONTROL_ONLY_CLAIMED>::SPEC, "gripper_force_is_kept"),
        (Wrong::<ENABLES_ON_CONNECT>::WIRED, "cut_when_disabled"),
        (Wrong::<CLAIMS_TO_BE_CONNECTED>::WIRED, "cut_when_enabled"),
        (Wrong::<STALE_STATE_AFTER_CONNECT>::WIRED, "cut_when_enabled"),
        (Wrong::<MOVES_ON_RECONNECTING>::WIRED, "cut_when_enabled"),
        (Wrong::<MOVES_ON_RECONNECTING>::WIRED, "cut_while_streaming"),
        (Wrong::<CANNOT_STOP_AFTER_RECONNECTING>::SPEC, "cut_in_motion"),
        (Wrong::<CLEARS_ERRORS_ON_CONNECT>::WIRED, "cut_in_error"),
        (Wrong::<ENABLES_ON_CONNECT>::WIRED, "power_cut"),
        (Wrong::<CONFIRMS_ALWAYS>::WIRED, "stop_into_the_void"),
        (Wrong::<MOVES_WITHOUT_POWER>::SPEC, "disabled_arms_do_not_move"),
        (Wrong::<MOVES_WITHOUT_POWER>::FALLING, "disabled_arms_do_not_move"),
        (Wrong::<ALLOCATES_FOR_NEWS>::PUSHED, "reads_do_not_allocate"),
        (Wrong::<ENABLES_AT_OLD_GOAL>::WIRED, "enabling_moves_nothing"),
        (Wrong::<VELOCITIES_SCALED>::SERVOS, "velocities_are_those_of_motion"),
        (Wrong::<TAKES_LATE_ANSWERS>::WIRED, "late_answers_are_not_new"),
        (Wrong::<ENABLED_BY_ONE_MOTOR>::WIRED, "enabled_means_every_motor"),
        (Wrong::<CONFIRMS_ALWAYS>::WIRED, "stop_without_answer"),
        (Wrong::<TOGGLES_POWER_ON_CONNECT>::WIRED, "connecting_changes_nothing"),
        (Wrong::<TOGGLES_POWER_ON_CONNECT>::WIRED, "leaving_moves_nothing"),
        (Wrong::<TOO_SLOW>::SPEC, "planned_speed_is_kept"),
        (Wrong::<TOO_SLOW>::WIRED, "planned_speed_is_kept"),
        (Wrong::<SERVO_TOO_SLOW>::SPEC, "fast_set_points_are_followed"),
        (Wrong::<SERVO_TOO_SLOW>::WIRED, "fast_set_points_are_followed"),
        (Wrong::<CONFIRMS_UNSEEN>::BUS, "lost_commands_are_noticed"),
        (Wrong::<ERRORS_OF_FIRST_ONLY>::BUS, "errors_of_any_joint"),
        (Wrong::<LONG_TIMEOUT>::WIRED, "a_lost_answer_holds_no_arm"),
        (Wrong::<STATUS_SHIFTED>::BUS, "joint_status_is_read"),
        (Wrong::<STATUS_SHIFTED>::WIRED, "joint_status_is_read"),
        (Wrong::<GRIPPER_REVERSED>::WIRED, "gripper_is_the_arms_own"),
        (Wrong::<CLAIMS_TO_HOLD>::BUS, "disabled_arms_do_not_move"),
        (Wrong::<ONE_VELOCITY_REVERSED>::SERVOS, "velocities_are_those_of_motion"),
        (Wrong::<GRAVITY_REVERSED>::BLIND, "gravity_is_carried"),
        (Wrong::<VELOCITIES_TENFOLD>::WIRED, "setpoints_arrive_whole"),
        (Wrong::<A_TENTH_OF_THE_GAINS>::BLIND, "gravity_is_carried"),
        (Wrong::<EFFORTS_TENFOLD>::WIRED, "efforts_are_those_of_the_arm"),
        (Wrong::<IGNORES_PAYLOAD>::WIRED, "payload_is_felt"),
        (Wrong::<DROPS_EFFORTS>::BLIND, "gravity_is_carried"),
        (Wrong::<EFFORTS_REMAIN>::BLIND, "gravity_is_carried"),
        (Wrong::<GAINS_AT_ONCE>::BLIND, "gains_ramp"),
        (Wrong::<KEEPS_FIRST_GAINS>::BLIND, "gains_ramp"),
        (Wrong::<EFFORTS_SHIFTED>::WIRED, "efforts_are_those_of_the_arm"),
        (Wrong::<PAYLOAD_IN_GRAMS>::WIRED, "payload_is_felt"),
    ];
    std::thread::scope(|scope| {
        for (row, name) in cases {
            scope.spawn(move || {
                let check = checks().find(|check| check.name == *name).unwrap();
                let outcome = run(row, check, Some(counting::allocations));
                assert!(matches!(outcome, Outcome::Failed(_)), "{name}: {outcome:?}");
                println!("{name}: {outcome:?}");
            });
        }
    });
}

/// What was found above was the mistake, and not the wrapping.
#[test]
fn without_a_mistake_the_same_checks_pass() {
    let cases: &[(AdapterSpec, &str)] = &[
        (Wrong::<NO_MISTAKE>::FALLING, "disabled_arms_do_not_move"),
        (Wrong::<NO_MISTAKE>::SPEC, "leaving_moves_nothing"),
        (Wrong::<NO_MISTAKE>::WIRED, "leaving_moves_nothing"),
        (Wrong::<NO_MISTAKE>::PUSHED, "reads_do_not_allocate"),
        (Wrong::<NO_MISTAKE>::WIRED, "enabling_moves_nothing"),
        (Wrong::<NO_MISTAKE>::SERVOS, "velocities_are_those_of_motion"),
        (Wrong::<NO_MISTAKE>::WIRED, "late_answers_are_not_new"),
        (Wrong::<NO_MISTAKE>::WIRED, "enabled_means_every_motor"),
        (Wrong::<NO_MISTAKE>::WIRED, "stop_without_answer"),
        (Wrong::<NO_MISTAKE>::WIRED, "planned_speed_is_kept"),
        (Wrong::<NO_MISTAKE>::WIRED, "clearing_enables_nothing"),
        (Wrong::<NO_MISTAKE>::WIRED, "gripper_moves_no_joint"),
        (Wrong::<NO_MISTAKE>::WIRED, "gripper_range_is_kept"),
        (Wrong::<NO_MISTAKE>::WIRED, "gripper_force_is_kept"),
        (Wrong::<NO_MISTAKE>::WIRED, "connecting_changes_nothing"),
        (Wrong::<NO_MISTAKE>::SPEC, "planned_speed_is_kept"),
        (Wrong::<NO_MISTAKE>::SPEC, "fast_set_points_are_followed"),
        (Wrong::<NO_MISTAKE>::WIRED, "fast_set_points_are_followed"),
        (Wrong::<NO_MISTAKE>::BUS, "lost_commands_are_noticed"),
        (Wrong::<NO_MISTAKE>::BUS, "errors_of_any_joint"),
        (Wrong::<NO_MISTAKE>::WIRED, "a_lost_answer_holds_no_arm"),
        (Wrong::<NO_MISTAKE>::BUS, "joint_status_is_read"),
        (Wrong::<NO_MISTAKE>::WIRED, "joint_status_is_read"),
        (Wrong::<NO_MISTAKE>::WIRED, "gripper_is_the_arms_own"),
        (Wrong::<NO_MISTAKE>::BUS, "disabled_arms_do_not_move"),
        (Wrong::<NO_MISTAKE>::BLIND, "gravity_is_carried"),
        (Wrong::<NO_MISTAKE>::BLIND, "gains_ramp"),
        (Wrong::<NO_MISTAKE>::WIRED, "efforts_are_those_of_the_arm"),
        (Wrong::<NO_MISTAKE>::WIRED, "setpoints_arrive_whole"),
        (Wrong::<NO_MISTAKE>::WIRED, "payload_is_felt"),
    ];
    std::thread::scope(|scope| {
        for (row, name) in cases {
            let check = checks().find(|check| check.name == *name).unwrap();
            scope.spawn(move || assert_eq!(run(row, check, Some(counting::allocations)), Outcome::Passed, "{name}"));
        }
    });
}

/// The small slow motion of a wrong arm, which begins to be interrupted at the `looks`th look.
fn moved_gently(row: &AdapterSpec, looks: u32) -> (Motion, Inner) {
    let config = AdapterConfig {
        hardware_id: "arm".into(),
        address: String::new(),
        dof: 6,
        options: serde_json::json!({"initial_positions": [0, 0, 0, 0, 0, 0]}),
    };
    let mut adapter = (row.create)(&config).unwrap();
    adapter.connect().unwrap();
    let mut left = looks;
    let interrupted = std::cell::Cell::new(false);
    let motion = run_first_motion(&mut *adapter, &|| interrupted.get(), &mut |_| {
        left -= 1;
        interrupted.set(left == 0);
    });
    (motion, adapter)
}

#[test]
fn the_small_slow_motion_ends_where_something_is_odd() {
    let cases: &[(AdapterSpec, &str)] = &[
        (Wrong::<DEGREES>::SPEC, "joint 1 was sent by +2.00° and moved by"),
        (Wrong::<WRONG_SIGN>::SPEC, "joint 2 was sent by +2.00° and moves the other way"),
        (Wrong::<SWAPPED_JOINTS>::SPEC, "joint 3 moved by"),
        (Wrong::<MOVES_ON_ACTIVATION>::SPEC, "moved by 0.5"),
        (Wrong::<IGNORES_STOP>::SPEC, "in spite of a stop"),
        (Wrong::<STOP_DROPS_POWER>::SPEC, "the motors went off"),
        (Wrong::<VELOCITIES_IN_DEGREES>::SPEC, "are they in rad/s"),
        (Wrong::<STOP_IS_FINAL>::SPEC, "stopped"),
        (Wrong::<IGNORES_SPEED>::SPEC, "times as fast as ordered"),
    ];
    std::thread::scope(|scope| {
        for (row, says) in cases {
            scope.spawn(move || {
                let (motion, mut adapter) = moved_gently(row, u32::MAX);
                let odd = motion.odd.unwrap_or_else(|| panic!("{says}: nothing was odd in {:?}", motion.ways));
                assert!(odd.contains(says), "{odd}");
                println!("{odd}");
                // In every case the arm is at rest.
                let mut before = [0.0; 6];
                let mut after = [0.0; 6];
                adapter.read_joint_positions(&mut before).unwrap();
                std::thread::sleep(std::time::Duration::from_millis(100));
                adapter.read_joint_positions(&mut after).unwrap();
                assert_eq!(before, after, "{says}");
            });
        }
    });
}

#[test]
fn the_small_slow_motion_can_be_interrupted_and_refused() {
    let (motion, mut adapter) = moved_gently(&mock::SPEC, 3);
    assert!(motion.interrupted && motion.odd.is_none() && motion.ways.len() == 1, "{motion:?}");
    assert_eq!(motion.left, "motors off, as they were found");
    assert!(refusal(&mut *adapter).is_ok());
    adapter.set_control_mode(ControlMode::ServoPosition).unwrap();
    adapter.activate().unwrap();
    adapter.write_joint_positions(&[0.0, 0.0, 0.0, 6.25, 0.0, 0.0], 1.0).unwrap();
    std::thread::sleep(std::time::Duration::from_secs(3));
    let refused = refusal(&mut *adapter).unwrap_err();
    assert!(refused.contains("joint 4 at 358.10° has 1.90° to its upper limit"), "{refused}");
}
