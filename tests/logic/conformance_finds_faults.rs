//! The conformance suite must be able to fail: adapters with one mistake each, and the check that finds it.

use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::*;
use dimos::hardware::arms::{mock, xarm, yourarm};
use dimos::hardware::conformance::first_motion::{Motion, refusal, run_first_motion};
use dimos::hardware::conformance::{Outcome, checks, run};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec};
use dimos::joint::ControlMode;
use dimos::rt::counting;

use crate::support::delegate::delegate;

type Inner = Box<dyn ManipulatorAdapter>;

/// What is wrong with an adapter.
const DEGREES: u8 = 0;
const WRONG_SIGN: u8 = 1;
const SWAPPED_JOINTS: u8 = 2;
const IGNORES_STOP: u8 = 3;
const MOVES_ON_ACTIVATION: u8 = 4;
const ENABLES_ON_CONNECT: u8 = 5;
const HIDES_ERRORS: u8 = 6;
const CLAIMS_TO_BE_CONNECTED: u8 = 7;
const ACCEPTS_ANY_MODE: u8 = 8;
const ZERO_VELOCITIES: u8 = 9;
const FAILS_WITHOUT_SENSOR: u8 = 10;
const DROPS_POWER_ON_LEAVING: u8 = 11;
const HIDES_SILENCE: u8 = 12;
const RESTAMPS_STATES: u8 = 13;
const CLEARS_ERRORS_ON_CONNECT: u8 = 14;
const STOP_DROPS_POWER: u8 = 15;
const CONFIRMS_ALWAYS: u8 = 16;
const STOP_CLEARS_ERRORS: u8 = 17;
const STOP_IS_FINAL: u8 = 18;
const MOVES_ON_RECONNECTING: u8 = 19;
const STALE_STATE_AFTER_CONNECT: u8 = 20;
const WRONG_SIGN_BOTH_WAYS: u8 = 21;
const IGNORES_MODEL: u8 = 22;
const CANNOT_STOP_AFTER_RECONNECTING: u8 = 23;
const VELOCITIES_IN_DEGREES: u8 = 24;
const MOVES_WITHOUT_POWER: u8 = 25;
const ALLOCATES_FOR_NEWS: u8 = 26;
const GRIPPER_IGNORES_STOP: u8 = 27;
const STOP_LOCKS_GRIPPER: u8 = 28;
const ENABLES_AT_OLD_GOAL: u8 = 29;
const VELOCITIES_SCALED: u8 = 30;
const TAKES_LATE_ANSWERS: u8 = 31;
const ENABLED_BY_ONE_MOTOR: u8 = 32;
const GRIPPER_IN_MILLIMETRES: u8 = 33;
const GRIPPER_CLAMPS: u8 = 34;
const FORCE_CLAMPS: u8 = 35;
const FORCE_IS_LOST: u8 = 36;
const FORCE_REMAINS: u8 = 37;
const FORCE_CONTROL_ONLY_CLAIMED: u8 = 38;
const DROPS_POWER_ON_DISCONNECTING: u8 = 39;
const IGNORES_SPEED: u8 = 40;
const CLEARING_ENABLES: u8 = 41;
const GRIPPER_HURRIES_JOINTS: u8 = 42;
const NO_MISTAKE: u8 = 255;

/// The modes of an arm that takes only setpoints.
const SERVO: &[ControlMode] = &[ControlMode::ServoPosition];

/// An arm with one mistake.
struct Wrong<const MISTAKE: u8> {
    inner: Inner,
    /// How often it was connected.
    connections: u32,
    /// It was stopped once.
    stopped: bool,
    /// Where the gripper was sent [m].
    gripper: f64,
    /// With which force.
    force: Option<f64>,
    /// The last reading.
    last: Option<JointReading>,
    /// The last positions it was sent to [rad].
    goal: Option<[f64; 6]>,
    /// A reading failed: from now on each is the one before.
    late: bool,
    /// What its motors were ordered.
    ordered: bool,
    /// The next reading is to be the last once more.
    repeat: bool,
}

impl<const MISTAKE: u8> Wrong<MISTAKE> {
    /// Around the arm in memory.
    const SPEC: AdapterSpec = AdapterSpec {
        name: "wrong",
        dof: (6, 6),
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((mock::SPEC.create)(config)?))),
        ..mock::SPEC
    };
    /// Around an arm with a wire and an emulator.
    const WIRED: AdapterSpec = AdapterSpec {
        name: "wrong",
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((yourarm::SPEC.create)(config)?))),
        ..yourarm::SPEC
    };

    /// Around an arm that streams its state.
    const PUSHED: AdapterSpec = AdapterSpec {
        name: "wrong",
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((xarm::SPEC.create)(config)?))),
        ..xarm::SPEC
    };
    /// Around an arm with a wire that has no velocity mode.
    const SERVOS: AdapterSpec = AdapterSpec { modes: SERVO, ..Self::WIRED };
    /// Around an arm that is said to fall without power.
    const FALLING: AdapterSpec = AdapterSpec { holds_when_disabled: false, ..Self::SPEC };

    fn around(inner: Inner) -> Self {
        Self {
            inner,
            connections: 0,
            stopped: false,
            gripper: 0.0,
            force: None,
            last: None,
            goal: None,
            late: false,
            ordered: false,
            repeat: false,
        }
    }

    fn spoil(values: &mut [f64]) {
        match MISTAKE {
            DEGREES => values.iter_mut().for_each(|value| *value = value.to_degrees()),
            WRONG_SIGN | WRONG_SIGN_BOTH_WAYS => values[1] = -values[1],
            SWAPPED_JOINTS => values.swap(1, 2),
            _ => {}
        }
    }
}

impl<const MISTAKE: u8> ManipulatorAdapter for Wrong<MISTAKE> {
    delegate!(
        inner: state_fd, get_dof, get_limits, get_control_mode, read_state, write_joint_velocities
    );

    fn disconnect(&mut self) {
        if MISTAKE == DROPS_POWER_ON_DISCONNECTING {
            let _ = self.inner.write_enable(false);
        }
        self.inner.disconnect();
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.inner.write_clear_errors()?;
        if MISTAKE == CLEARING_ENABLES { self.inner.write_enable(true) } else { Ok(()) }
    }

    fn connect(&mut self) -> AdapterResult<()> {
        let result = self.inner.connect();
        if MISTAKE == IGNORES_MODEL {
            return Ok(());
        }
        result?;
        self.connections += 1;
        self.repeat = MISTAKE == STALE_STATE_AFTER_CONNECT;
        match MISTAKE {
            ENABLES_ON_CONNECT => self.inner.write_enable(true),
            CLEARS_ERRORS_ON_CONNECT => self.inner.write_clear_errors(),
            MOVES_ON_RECONNECTING if self.connections > 1 => {
                let mut positions = [0.0; 6];
                self.inner.read_joint_positions(&mut positions)?;
                self.inner.write_joint_positions(&positions.map(|value| value + 0.1), 0.5)
            }
            CANNOT_STOP_AFTER_RECONNECTING if self.connections > 1 => self.inner.write_joint_positions(&[1.0; 6], 0.01),
            _ => Ok(()),
        }
    }

    fn is_connected(&self) -> bool {
        MISTAKE == CLAIMS_TO_BE_CONNECTED || self.inner.is_connected()
    }

    fn activate(&mut self) -> AdapterResult<()> {
        self.inner.activate()?;
        self.ordered = true;
        if let Some(goal) = self.goal.filter(|_| MISTAKE == ENABLES_AT_OLD_GOAL) {
            return self.inner.write_joint_positions(&goal, 0.5);
        }
        if MISTAKE == MOVES_ON_ACTIVATION { self.inner.write_joint_positions(&[0.1; 6], 0.5) } else { Ok(()) }
    }

    fn deactivate(&mut self) -> AdapterResult<()> {
        self.inner.deactivate()?;
        if MISTAKE == DROPS_POWER_ON_LEAVING { self.inner.write_enable(false) } else { Ok(()) }
    }

    fn get_info(&self) -> ManipulatorInfo {
        let info = self.inner.get_info();
        if MISTAKE == VELOCITIES_SCALED { ManipulatorInfo { modes: SERVO, ..info } } else { info }
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        let enabled = self.inner.read_enabled()?;
        Ok(if MISTAKE == ENABLED_BY_ONE_MOTOR { self.ordered } else { enabled })
    }

    fn write_enable(&mut self, on: bool) -> AdapterResult<()> {
        self.inner.write_enable(on)?;
        self.ordered = on;
        Ok(())
    }

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let result = self.inner.set_control_mode(mode);
        if MISTAKE == ACCEPTS_ANY_MODE { Ok(()) } else { result }
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.inner.read_joint_positions(positions)?;
        Self::spoil(positions);
        Ok(())
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        if let Some(last) = self.last.filter(|_| std::mem::take(&mut self.repeat)) {
            *reading = last;
            return Ok(());
        }
        match (self.inner.read_joints(reading), self.last) {
            (Err(_), Some(last)) if MISTAKE == HIDES_SILENCE => *reading = last,
            (Err(error), _) if MISTAKE == TAKES_LATE_ANSWERS => {
                self.late = true;
                return Err(error);
            }
            (Ok(()), Some(last)) if self.late => {
                self.last = Some(*reading);
                *reading = last;
                return Ok(());
            }
            (result, _) => result?,
        }
        Self::spoil(&mut reading.position[..6]);
        if MISTAKE == ALLOCATES_FOR_NEWS && self.last.is_some_and(|last| last.stamp != reading.stamp) {
            std::hint::black_box(reading.position.to_vec());
        }
        if MISTAKE == ZERO_VELOCITIES {
            reading.velocity = Some(Default::default());
        }
        if let Some(velocity) = reading.velocity.as_mut().filter(|_| MISTAKE == VELOCITIES_IN_DEGREES) {
            *velocity = velocity.map(f64::to_degrees);
        }
        if let Some(velocity) = reading.velocity.as_mut().filter(|_| MISTAKE == VELOCITIES_SCALED) {
            *velocity = velocity.map(|v| -651.0 * v);
        }
        if MISTAKE == RESTAMPS_STATES {
            reading.stamp = Some(MonotonicClock.now());
        }
        self.last = Some(*reading);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let known = self.inner.read_joint_velocities(velocities)?;
        if MISTAKE == ZERO_VELOCITIES {
            velocities.fill(0.0);
        }
        Ok(known)
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let error = self.inner.read_error()?;
        Ok(if MISTAKE == HIDES_ERRORS { (0, String::new()) } else { error })
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        if MISTAKE == STOP_IS_FINAL && self.stopped {
            return Err(AdapterError::Rejected("stopped".into()));
        }
        if let (WRONG_SIGN_BOTH_WAYS, Ok(mut positions)) = (MISTAKE, <[f64; 6]>::try_from(positions)) {
            Self::spoil(&mut positions);
            return self.inner.write_joint_positions(&positions, velocity);
        }
        self.goal = positions.try_into().ok();
        let velocity = if MISTAKE == IGNORES_SPEED { 1.0 } else { velocity };
        let result = self.inner.write_joint_positions(positions, velocity);
        if MISTAKE == MOVES_WITHOUT_POWER { Ok(()) } else { result }
    }

    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.stopped = true;
        match MISTAKE {
            IGNORES_STOP if self.inner.is_connected() => Ok(Stop::Confirmed),
            CANNOT_STOP_AFTER_RECONNECTING if self.connections > 1 => Ok(Stop::Confirmed),
            CONFIRMS_ALWAYS => self.inner.write_stop().or(Ok(Stop::Confirmed)),
            STOP_DROPS_POWER => self.inner.write_enable(false).map(|()| Stop::Confirmed),
            STOP_CLEARS_ERRORS => self.inner.write_clear_errors().map(|()| Stop::Confirmed),
            // The arm's own stop holds the gripper too; this one does not.
            GRIPPER_IGNORES_STOP | STOP_LOCKS_GRIPPER => {
                let stop = self.inner.write_stop()?;
                let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
                gripper.write_gripper_position(self.gripper).map(|()| stop)
            }
            _ => self.inner.write_stop(),
        }
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.inner.gripper().is_some() { Some(self) } else { None }
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if MISTAKE == FAILS_WITHOUT_SENSOR { Some(self) } else { None }
    }
}

impl<const MISTAKE: u8> Gripper for Wrong<MISTAKE> {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let position = self.inner.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_position())?;
        Ok(position.map(|metres| if MISTAKE == GRIPPER_IN_MILLIMETRES { 1000.0 * metres } else { metres }))
    }
    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        self.inner.gripper().and_then(|gripper| gripper.get_gripper_force_range())
    }
    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
        let (least, most) = gripper.get_gripper_force_range().ok_or(AdapterError::Unsupported)?;
        self.force = (least..=most).contains(&force).then_some(force);
        match MISTAKE {
            FORCE_CONTROL_ONLY_CLAIMED => Err(AdapterError::Unsupported),
            FORCE_CLAMPS => gripper.write_gripper_position_with_force(position, force.max(least).min(most)),
            FORCE_IS_LOST if (least..=most).contains(&force) => gripper.write_gripper_position(position),
            _ => gripper.write_gripper_position_with_force(position, force),
        }
    }
    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        self.inner.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_force())
    }
    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        self.inner.gripper().and_then(|gripper| gripper.get_gripper_range())
    }
    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        match MISTAKE {
            GRIPPER_IGNORES_STOP if self.stopped => return Ok(()),
            STOP_LOCKS_GRIPPER if self.stopped => return Err(AdapterError::Rejected("stopped".into())),
            _ => self.gripper = position,
        }
        if let Some(goal) = self.goal.filter(|_| MISTAKE == GRIPPER_HURRIES_JOINTS) {
            self.inner.write_joint_positions(&goal, 1.0)?;
        }
        let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
        match (MISTAKE, self.force) {
            (GRIPPER_CLAMPS, _) => gripper.write_gripper_position(position.clamp(0.0, 0.08)),
            (FORCE_REMAINS, Some(force)) => gripper.write_gripper_position_with_force(position, force),
            _ => gripper.write_gripper_position(position),
        }
    }
}

impl<const MISTAKE: u8> ForceTorque for Wrong<MISTAKE> {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Err(AdapterError::Unsupported)
    }
}

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
        (Wrong::<DROPS_POWER_ON_DISCONNECTING>::FALLING, "leaving_moves_nothing"),
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
        (Wrong::<NO_MISTAKE>::FALLING, "leaving_moves_nothing"),
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
