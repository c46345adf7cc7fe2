//! A bus that answers each command with its state, a motor that no longer answers, and joints by time.

use std::sync::atomic::{AtomicU16, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use dimos::arm::{ArmCommand, JointSet, Setpoint};
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos::joint::ControlMode;
use dimos::testing::MockAdapter;

use super::device_stops::{LIMIT, spawn};
use crate::support::delegate::delegate;

/// What happened at an arm that exchanges.
#[derive(Debug, Clone, Default)]
struct Seen {
    /// The setpoints, in order; `None`: it was only asked for its state.
    exchanged: Arc<Mutex<Vec<Option<Setpoint>>>>,
    /// Calls that an exchange takes the place of.
    separately: Arc<AtomicU64>,
    /// The joints whose motors do not answer.
    lost: Arc<AtomicU16>,
}

struct Exchanging {
    mock: MockAdapter,
    seen: Seen,
}

impl ManipulatorAdapter for Exchanging {
    delegate!(mock: connect, disconnect, is_connected, activate, get_info, get_dof, get_limits, set_control_mode,
        get_control_mode, read_joint_positions, read_state, read_error, read_enabled, write_joint_positions, write_stop,
        write_enable, write_clear_errors);

    fn exchanges(&self) -> bool {
        true
    }

    fn exchange(&mut self, setpoint: Option<&Setpoint>, reading: &mut JointReading) -> AdapterResult<()> {
        self.seen.exchanged.lock().unwrap().push(setpoint.copied());
        if let Some(setpoint) = setpoint {
            self.mock.write_joint_positions(&setpoint.position[..6], 1.0)?;
        }
        self.mock.read_joints(reading)?;
        reading.missing = JointSet::from_bits(self.seen.lost.load(Relaxed));
        for joint in reading.missing.iter() {
            reading.position[joint] = f64::NAN;
        }
        Ok(())
    }

    fn write_setpoint(&mut self, _: &Setpoint) -> AdapterResult<()> {
        self.seen.separately.fetch_add(1, Relaxed);
        Err(AdapterError::Unsupported)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.seen.separately.fetch_add(1, Relaxed);
        self.mock.read_joints(reading)
    }
}

#[test]
fn an_arm_that_exchanges_is_given_setpoints_and_gives_its_state_in_one_call() {
    let seen = Seen::default();
    let adapter = Exchanging { mock: MockAdapter::new(6), seen: seen.clone() };
    let (device, beat, mut states, mut commands) = spawn(Box::new(adapter), 100.0, Arc::new(MonotonicClock));
    device.connect().wait(LIMIT).unwrap();
    device.activate().wait(LIMIT).unwrap();
    let before = states.read();
    let mut command = ArmCommand { mode: Some(ControlMode::ServoPosition), start_seq: 1, ..ArmCommand::default() };
    command.values = before.position;
    let mut tick = || {
        let now = MonotonicClock.now();
        beat.beat(now);
        (command.seq, command.at) = (command.seq + 1, now);
        command.next_tick = now.after(Duration::from_millis(10));
        commands.write(&command);
        device.wake().raise();
        std::thread::sleep(Duration::from_millis(10));
    };
    (0..40).for_each(|_| tick());
    let setpoints: Vec<Setpoint> = seen.exchanged.lock().unwrap().iter().flatten().copied().collect();
    assert!(setpoints.len() > 10, "{} setpoints", setpoints.len());
    let last = setpoints.last().unwrap();
    assert_eq!((last.mode, last.effort, last.stiffness), (ControlMode::ServoPosition, None, None));
    assert!(last.valid_for().is_some_and(|time| (0.01..0.5).contains(&time)), "{last:?}");
    assert!(seen.exchanged.lock().unwrap().iter().any(Option::is_none), "its state is asked for before any setpoint");
    assert_eq!(seen.separately.load(Relaxed), 0, "nothing is asked or written beside");

    seen.lost.store(0b100, Relaxed);
    (0..20).for_each(|_| tick());
    let state = states.read();
    assert_eq!((state.missing, state.position), (JointSet::of([2]), before.position), "its last position stays");
    assert!(state.seq > before.seq + 10, "the others still count");
    let ago = MonotonicClock.now().before(Duration::from_millis(150));
    assert_eq!(device.joints_at(ago), Some(before.position));
    assert_eq!(device.joints_at(ago.before(Duration::from_secs(60))), None);
    assert!(device.activate().wait(LIMIT).unwrap_err().to_string().contains("joint 3"));
}
