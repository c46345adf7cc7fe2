//! An adapter with one mistake, around one that has none.

use dimos::arm::{JointStatus, Load, Setpoint, SetpointFields, StopPoint};
use dimos::arms::{mock, so101, xarm, yourarm};
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::*;
use dimos::hardware::registry::{AdapterConfig, AdapterSpec};
use dimos::joint::{ControlMode, Joints};

use crate::support::delegate::delegate;

mod mistakes;
mod parts;

pub use mistakes::*;

pub type Inner = Box<dyn ManipulatorAdapter>;

/// The modes of an arm that takes only setpoints.
const SERVO: &[ControlMode] = &[ControlMode::ServoPosition];

/// An arm with one mistake.
pub struct Wrong<const MISTAKE: u8> {
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
    /// The last effort, and the first gains, that were passed on.
    effort: Option<Joints>,
    gains: Option<(Joints, Joints)>,
    /// The load that was set.
    load: Option<Load>,
    /// The last setpoint that was passed on [rad], and when.
    passed: Option<([f64; 6], f64)>,
}

impl<const MISTAKE: u8> Wrong<MISTAKE> {
    /// Around the arm in memory.
    pub const SPEC: AdapterSpec = AdapterSpec {
        name: "wrong",
        dof: (6, 6),
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((mock::SPEC.create)(config)?))),
        ..mock::SPEC
    };
    /// Around an arm with a wire and an emulator.
    pub const WIRED: AdapterSpec = AdapterSpec {
        name: "wrong",
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((yourarm::SPEC.create)(config)?))),
        ..yourarm::SPEC
    };

    /// Around the same, whose emulator does not say which setpoints it received.
    pub const BLIND: AdapterSpec = AdapterSpec { emulate: Some(parts::blind), ..Self::WIRED };
    /// Around an arm that streams its state.
    pub const PUSHED: AdapterSpec = AdapterSpec {
        name: "wrong",
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((xarm::SPEC.create)(config)?))),
        ..xarm::SPEC
    };
    /// Around an arm with a wire that has no velocity mode.
    pub const SERVOS: AdapterSpec = AdapterSpec { modes: SERVO, ..Self::WIRED };
    /// Around servos on a line, whose motors have errors of their own and which fall without power.
    pub const BUS: AdapterSpec = AdapterSpec {
        name: "wrong",
        create: |config: &AdapterConfig| Ok(Box::new(Self::around((so101::SPEC.create)(config)?))),
        holds_when_disabled: MISTAKE == CLAIMS_TO_HOLD,
        ..so101::SPEC
    };
    /// Around an arm that is said to fall without power.
    pub const FALLING: AdapterSpec = AdapterSpec { holds_when_disabled: false, ..Self::SPEC };

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
            effort: None,
            gains: None,
            load: None,
            passed: None,
        }
    }

    /// Setpoints as an adapter passes them on that limits joints to a tenth of their top speed; `None` without limits.
    fn limited(&mut self, positions: &[f64]) -> Option<[f64; 6]> {
        let wanted = <[f64; 6]>::try_from(positions).ok().filter(|_| MISTAKE == SERVO_TOO_SLOW)?;
        let (now, tops) = (MonotonicClock.now().0 as f64 * 1e-9, self.inner.get_limits().ok()?.velocity_max);
        let mut here = [0.0; 6];
        self.inner.read_joint_positions(&mut here).ok()?;
        let (mut at, then) = self.passed.unwrap_or((here, now));
        for ((at, wanted), top) in at.iter_mut().zip(wanted).zip(tops) {
            let most = 0.1 * top * (now - then);
            *at += (wanted - *at).clamp(-most, most);
        }
        self.passed = Some((at, now));
        Some(at)
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
            TOGGLES_POWER_ON_CONNECT => {
                let on = self.inner.read_enabled()?;
                self.inner.write_enable(!on).and_then(|()| self.inner.write_enable(on))
            }
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

    fn deactivate(&mut self, rest: &StopPoint) -> AdapterResult<()> {
        self.inner.deactivate(rest)?;
        if MISTAKE == DROPS_POWER_ON_LEAVING { self.inner.write_enable(false) } else { Ok(()) }
    }

    fn get_info(&self) -> ManipulatorInfo {
        let info = self.inner.get_info();
        match MISTAKE {
            VELOCITIES_SCALED => ManipulatorInfo { modes: SERVO, ..info },
            CLAIMS_TO_HOLD => ManipulatorInfo { holds_when_disabled: true, ..info },
            _ => info,
        }
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
        let began = MonotonicClock.now();
        let result = self.inner.read_joints(reading);
        if MISTAKE == LONG_TIMEOUT && MonotonicClock.now().seconds_since(began) > 0.008 {
            std::thread::sleep(std::time::Duration::from_millis(150));
        }
        match (result, self.last) {
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
        if let Some(velocity) = reading.velocity.as_mut().filter(|_| MISTAKE == ONE_VELOCITY_REVERSED) {
            velocity[2] = -velocity[2];
        }
        if let Some(effort) = reading.effort.as_mut() {
            match MISTAKE {
                EFFORTS_TENFOLD => *effort = effort.map(|value| -10.0 * value),
                EFFORTS_SHIFTED => effort[..6].rotate_left(1),
                _ => {}
            }
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
        if MISTAKE == ERRORS_OF_FIRST_ONLY {
            let mut joints = [JointStatus::default(); 5];
            let monitor = self.inner.joint_monitor().ok_or(AdapterError::Unsupported)?;
            monitor.read_joint_status(&mut joints)?;
            return Ok(if joints[0].error == Some(0) { (0, String::new()) } else { error });
        }
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
        let velocity = match MISTAKE {
            IGNORES_SPEED => 1.0,
            TOO_SLOW => 0.1 * velocity,
            _ => velocity,
        };
        let limited = self.limited(positions);
        let result = self.inner.write_joint_positions(limited.as_ref().map_or(positions, |all| &all[..]), velocity);
        if MISTAKE == MOVES_WITHOUT_POWER { Ok(()) } else { result }
    }

    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        self.stopped = true;
        match MISTAKE {
            IGNORES_STOP if self.inner.is_connected() => Ok(Stop::Confirmed),
            CANNOT_STOP_AFTER_RECONNECTING if self.connections > 1 => Ok(Stop::Confirmed),
            CONFIRMS_ALWAYS => self.inner.write_stop(rest).or(Ok(Stop::Confirmed)),
            CONFIRMS_UNSEEN => {
                let mut here = [0.0; 5];
                self.inner.read_joint_positions(&mut here)?;
                let mode = self.inner.get_control_mode();
                self.inner.set_control_mode(ControlMode::ServoPosition)?;
                self.inner.write_joint_positions(&here, 1.0)?;
                self.inner.set_control_mode(mode).map(|()| Stop::Confirmed)
            }
            STOP_DROPS_POWER => self.inner.write_enable(false).map(|()| Stop::Confirmed),
            STOP_CLEARS_ERRORS => self.inner.write_clear_errors().map(|()| Stop::Confirmed),
            // The arm's own stop holds the gripper too; this one does not.
            GRIPPER_IGNORES_STOP | STOP_LOCKS_GRIPPER => {
                let stop = self.inner.write_stop(rest)?;
                let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
                gripper.write_gripper_position(self.gripper).map(|()| stop)
            }
            _ => self.inner.write_stop(rest),
        }
    }

    fn setpoint_fields(&self) -> Option<SetpointFields> {
        self.inner.setpoint_fields()
    }

    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        let mut passed = *setpoint;
        let times = |list: Option<Joints>, factor: f64| list.map(|list| list.map(|value| factor * value));
        let gains = passed.stiffness.zip(passed.damping);
        match MISTAKE {
            GRAVITY_REVERSED => passed.effort = times(passed.effort, -1.0),
            VELOCITIES_TENFOLD => passed.velocity = passed.velocity.map(|value| -10.0 * value),
            A_TENTH_OF_THE_GAINS => {
                (passed.stiffness, passed.damping) = (times(passed.stiffness, 0.1), times(passed.damping, 0.1));
            }
            DROPS_EFFORTS => passed.effort = None,
            EFFORTS_REMAIN => passed.effort = passed.effort.or(self.effort),
            GAINS_AT_ONCE => {
                passed.stiffness = passed.stiffness.map(|list| list.map(|value| (value / 100.0).ceil() * 100.0))
            }
            KEEPS_FIRST_GAINS => {
                let (stiffness, damping) = self.gains.or(gains).unzip();
                (passed.stiffness, passed.damping) = (stiffness, damping);
            }
            _ => {}
        }
        (self.effort, self.gains) = (passed.effort, self.gains.or(gains));
        self.inner.write_setpoint(&passed)
    }

    fn payload(&mut self) -> Option<&mut dyn Payload> {
        if self.inner.payload().is_some() { Some(self) } else { None }
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.inner.gripper().is_some() { Some(self) } else { None }
    }

    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        if self.inner.joint_monitor().is_some() { Some(self) } else { None }
    }

    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        if MISTAKE == FAILS_WITHOUT_SENSOR { Some(self) } else { None }
    }
}
