//! The conformance suite must be able to fail: adapters that are wrong in one way each, and the check that says so.

use dimos::hardware::arms::mock;
use dimos::hardware::conformance::{Outcome, checks, run};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec};
use dimos::hardware::spec::*;
use dimos::joint::{ControlMode, JointLimits};

type Inner = Box<dyn ManipulatorAdapter>;

/// What is wrong with an adapter.
const DEGREES: u8 = 0;
const WRONG_SIGN: u8 = 1;
const SWAPPED_JOINTS: u8 = 2;
const DEAF_TO_STOP: u8 = 3;
const MOVES_ON_ACTIVATION: u8 = 4;
const ENABLES_ON_CONNECT: u8 = 5;
const HIDES_ERRORS: u8 = 6;
const CLAIMS_TO_BE_CONNECTED: u8 = 7;
const ACCEPTS_ANY_MODE: u8 = 8;
const ZERO_VELOCITIES: u8 = 9;
const FAILS_WITHOUT_SENSOR: u8 = 10;
const DROPS_POWER_ON_LEAVING: u8 = 11;

/// A mock arm with one mistake.
struct Wrong<const MISTAKE: u8>(Inner);

impl<const MISTAKE: u8> Wrong<MISTAKE> {
    const SPEC: AdapterSpec = AdapterSpec {
        name: "wrong",
        dof: (6, 6),
        create: |config: &AdapterConfig| Ok(Box::new(Self((mock::SPEC.create)(config)?))),
        ..mock::SPEC
    };

    fn spoil(values: &mut [f64]) {
        match MISTAKE {
            DEGREES => values.iter_mut().for_each(|value| *value = value.to_degrees()),
            WRONG_SIGN => values[1] = -values[1],
            SWAPPED_JOINTS => values.swap(1, 2),
            _ => {}
        }
    }
}

impl<const MISTAKE: u8> ManipulatorAdapter for Wrong<MISTAKE> {
    fn connect(&mut self) -> AdapterResult<()> {
        self.0.connect()?;
        if MISTAKE == ENABLES_ON_CONNECT { self.0.write_enable(true) } else { Ok(()) }
    }
    fn disconnect(&mut self) {
        self.0.disconnect();
    }
    fn is_connected(&self) -> bool {
        MISTAKE == CLAIMS_TO_BE_CONNECTED || self.0.is_connected()
    }
    fn activate(&mut self) -> AdapterResult<()> {
        self.0.activate()?;
        if MISTAKE == MOVES_ON_ACTIVATION { self.0.write_joint_positions(&[0.1; 6], 0.5) } else { Ok(()) }
    }
    fn deactivate(&mut self) -> AdapterResult<()> {
        self.0.deactivate()?;
        if MISTAKE == DROPS_POWER_ON_LEAVING { self.0.write_enable(false) } else { Ok(()) }
    }
    fn get_info(&self) -> ManipulatorInfo {
        self.0.get_info()
    }
    fn get_dof(&self) -> usize {
        self.0.get_dof()
    }
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        self.0.get_limits()
    }
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let result = self.0.set_control_mode(mode);
        if MISTAKE == ACCEPTS_ANY_MODE { Ok(()) } else { result }
    }
    fn get_control_mode(&self) -> ControlMode {
        self.0.get_control_mode()
    }
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.0.read_joint_positions(positions)?;
        Self::spoil(positions);
        Ok(())
    }
    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let known = self.0.read_joint_velocities(velocities)?;
        if MISTAKE == ZERO_VELOCITIES {
            velocities.fill(0.0);
        }
        Ok(known)
    }
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.0.read_state()
    }
    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let error = self.0.read_error()?;
        Ok(if MISTAKE == HIDES_ERRORS { (0, String::new()) } else { error })
    }
    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.0.read_enabled()
    }
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.0.write_joint_positions(positions, velocity)
    }
    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.0.write_joint_velocities(velocities)
    }
    fn write_stop(&mut self) -> AdapterResult<Stop> {
        if MISTAKE == DEAF_TO_STOP && self.0.is_connected() { Ok(Stop::Confirmed) } else { self.0.write_stop() }
    }
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.0.write_enable(enable)
    }
    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.0.write_clear_errors()
    }
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        if MISTAKE == FAILS_WITHOUT_SENSOR { Err(AdapterError::Unsupported) } else { Ok(None) }
    }
}

#[test]
fn each_mistake_is_found_by_the_check_for_it() {
    let cases: &[(AdapterSpec, &str)] = &[
        (Wrong::<DEGREES>::SPEC, "planned_moves_arrive"),
        (Wrong::<WRONG_SIGN>::SPEC, "planned_moves_arrive"),
        (Wrong::<SWAPPED_JOINTS>::SPEC, "set_points_are_followed"),
        (Wrong::<DEAF_TO_STOP>::SPEC, "stop_ends_motion"),
        (Wrong::<MOVES_ON_ACTIVATION>::SPEC, "activation_holds"),
        (Wrong::<ENABLES_ON_CONNECT>::SPEC, "connecting_changes_nothing"),
        (Wrong::<HIDES_ERRORS>::SPEC, "errors_have_code_and_text"),
        (Wrong::<CLAIMS_TO_BE_CONNECTED>::SPEC, "not_connected_is_said"),
        (Wrong::<ACCEPTS_ANY_MODE>::SPEC, "modes_are_what_it_says"),
        (Wrong::<ZERO_VELOCITIES>::SPEC, "velocities_are_kept"),
        (Wrong::<FAILS_WITHOUT_SENSOR>::SPEC, "optional_parts_never_fail"),
        (Wrong::<DROPS_POWER_ON_LEAVING>::SPEC, "leaving_moves_nothing"),
    ];
    std::thread::scope(|scope| {
        for (row, name) in cases {
            scope.spawn(move || {
                let check = checks().find(|check| check.name == *name).unwrap();
                let outcome = run(row, check, None);
                assert!(matches!(outcome, Outcome::Failed(_)), "{name}: {outcome:?}");
                println!("{name}: {outcome:?}");
            });
        }
    });
}
