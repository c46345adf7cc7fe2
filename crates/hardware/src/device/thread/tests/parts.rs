//! Optional parts: the load and the mounting, the stop input, values that are read now and then, outputs.

use super::*;
use crate::adapter::{AdapterError, Io, JointMonitor, ManipulatorAdapter, ManipulatorInfo, Payload, RobotState, Stop};
use crate::device::thread::slow_readings;
use dimos_core::arm::{AnalogUnit, IoInfo, IoState, JointStatus, Load, OutputValue, StopInput, StopPoint};
use dimos_core::joint::JointLimits;

const DOWN: [f64; 3] = [0.0, 0.0, -1.0];
const UP: [f64; 3] = [0.0, 0.0, 1.0];
const SPECS: IoInfo =
    IoInfo { digital_inputs: 2, digital_outputs: 2, analog_inputs: &[], analog_outputs: &[AnalogUnit::Volt] };

/// What the controller has, and what was written.
#[derive(Debug, Default)]
struct Parts {
    io: IoState,
    load: Load,
    /// What it makes of the next loads that are written.
    taken_as: Vec<Load>,
    gravity: [f64; 3],
    mounting: Option<AdapterError>,
    /// It takes a mounting, and stays with its own.
    keeps_mounting: bool,
    /// It knows its calibration offsets.
    reports_offsets: bool,
    /// Readings that fail: inputs, joints, load.
    failing: [Option<AdapterError>; 3],
    read: [u32; 3],
    written: Vec<String>,
}

impl Parts {
    fn read(&mut self, which: usize) -> AdapterResult<()> {
        self.read[which] += 1;
        self.failing[which].clone().map_or(Ok(()), Err)
    }
}

/// The mock arm with all parts.
struct Equipped {
    inner: MockAdapter,
    parts: Parts,
}

impl ManipulatorAdapter for Equipped {
    fn connect(&mut self) -> AdapterResult<()> {
        self.inner.connect()
    }
    fn disconnect(&mut self) {
        self.inner.disconnect();
    }
    fn is_connected(&self) -> bool {
        self.inner.is_connected()
    }
    fn get_info(&self) -> ManipulatorInfo {
        self.inner.get_info()
    }
    fn get_dof(&self) -> usize {
        self.inner.get_dof()
    }
    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        self.inner.get_limits()
    }
    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        self.inner.set_control_mode(mode)
    }
    fn get_control_mode(&self) -> ControlMode {
        self.inner.get_control_mode()
    }
    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.inner.read_joint_positions(positions)
    }
    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        self.inner.read_joint_velocities(velocities)
    }
    fn read_state(&mut self) -> AdapterResult<RobotState> {
        self.inner.read_state()
    }
    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.inner.read_error()
    }
    fn read_enabled(&mut self) -> AdapterResult<bool> {
        self.inner.read_enabled()
    }
    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        self.inner.write_joint_positions(positions, velocity)
    }
    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        self.inner.write_stop(rest)
    }
    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.inner.write_enable(enable)
    }
    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.inner.write_clear_errors()
    }
    fn io(&mut self) -> Option<&mut dyn Io> {
        Some(self)
    }
    fn payload(&mut self) -> Option<&mut dyn Payload> {
        Some(self)
    }
    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        Some(self)
    }
}

impl Io for Equipped {
    fn get_io(&self) -> IoInfo {
        SPECS
    }
    fn read_io(&mut self, state: &mut IoState) -> AdapterResult<()> {
        *state = self.parts.io;
        self.parts.read(0)
    }
    fn write_digital_output(&mut self, output: u8, high: bool) -> AdapterResult<()> {
        self.parts.written.push(format!("do{output}={high}"));
        Ok(())
    }
    fn write_analog_output(&mut self, output: u8, value: f64) -> AdapterResult<()> {
        self.parts.written.push(format!("ao{output}={value}"));
        Ok(())
    }
}

impl JointMonitor for Equipped {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        assert_eq!(joints.len(), DOF);
        joints[0].temperature = Some(40.0);
        self.parts.read(1)
    }
    fn read_calibration_offsets(&mut self, offsets: &mut [f64]) -> AdapterResult<bool> {
        offsets.copy_from_slice(&[0.1, -0.2, 0.3]);
        Ok(self.parts.reports_offsets)
    }
}

impl Payload for Equipped {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        self.parts.read(2)?;
        Ok(Some(self.parts.load))
    }
    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        self.parts.written.push(format!("{} kg", load.mass));
        self.parts.load = if self.parts.taken_as.is_empty() { *load } else { self.parts.taken_as.remove(0) };
        Ok(())
    }
    fn read_mounting(&mut self) -> AdapterResult<Option<[f64; 3]>> {
        Ok(Some(self.parts.gravity))
    }
    fn write_mounting(&mut self, gravity: [f64; 3]) -> AdapterResult<()> {
        if let Some(error) = self.parts.mounting.clone() {
            return Err(error);
        }
        self.parts.written.push(format!("gravity {gravity:?}"));
        if !self.parts.keeps_mounting {
            self.parts.gravity = gravity;
        }
        Ok(())
    }
}

fn kg(mass: f64) -> Load {
    Load { mass, ..Load::default() }
}

/// A connected worker with an arm that has all parts.
fn equipped(setup: Setup) -> (Bench, Equipped) {
    let mut bench = Bench::with(MockAdapter::new(DOF), |config| config.setup = setup);
    let parts = Parts { gravity: DOWN, io: IoState { digital_inputs: 0b11, ..IoState::default() }, ..Parts::default() };
    let mut arm = Equipped { inner: bench.arm.clone(), parts };
    bench.worker.connect(&mut arm).unwrap();
    arm.parts.read = [0; 3];
    (bench, arm)
}

fn cycle(bench: &mut Bench, arm: &mut Equipped) -> ArmState {
    bench.advance(PERIOD);
    bench.wake.raise();
    bench.worker.cycle(arm, &bench.orders);
    bench.states.read()
}

#[test]
fn the_load_is_set_before_the_motors_only_if_the_controller_has_another_one() {
    let configure = |wanted: Option<f64>, present: f64| {
        let (mut bench, mut arm) = equipped(Setup { payload: wanted.map(kg), ..Setup::default() });
        arm.parts.load = kg(present);
        bench.worker.configure(&mut arm).unwrap();
        arm.parts.written
    };
    assert_eq!(configure(Some(1.5), 0.0), ["1.5 kg"]);
    assert!(configure(Some(1.5), 1.5).is_empty());
    assert!(configure(None, 1.5).is_empty());
    // An inertia that the controller lacks is set again, as is one that it should not have.
    let (mut bench, mut arm) = equipped(Setup::default());
    let body = Load { inertia: [0.1, 0.0, 0.0, 0.1, 0.0, 0.1], ..kg(1.5) };
    for (wanted, present) in [(body, kg(1.5)), (kg(1.5), body)] {
        bench.worker.payload = Some(wanted);
        arm.parts.load = present;
        arm.parts.written.clear();
        bench.worker.configure(&mut arm).unwrap();
        assert_eq!(arm.parts.written.len(), 1);
    }
}

#[test]
fn a_load_that_the_controller_takes_for_another_is_taken_back() {
    let (mut bench, mut arm) = equipped(Setup::default());
    arm.parts.load = kg(0.5);
    arm.parts.taken_as = vec![kg(9.0)];
    let refused = bench.worker.set_payload(&mut arm, &kg(2.0)).unwrap_err();
    let text = "the controller reports a payload of 9.000 kg at 0.000 0.000 0.000 m after 2.000 kg at 0.000 0.000 0.000 m was set";
    assert_eq!(refused, AdapterError::Rejected(text.into()));
    assert_eq!((arm.parts.load, &arm.parts.written[..]), (kg(0.5), &["2 kg".to_owned(), "0.5 kg".to_owned()][..]));
    assert_eq!(bench.worker.payload, None);

    assert_eq!(bench.worker.set_payload(&mut arm, &kg(2.0)), Ok(Some(kg(2.0))));
    assert_eq!(bench.worker.payload, Some(kg(2.0)), "set again with the motors");
    assert_eq!(bench.worker.health.details().payload, Some(kg(2.0)), "and known at once");
    assert!(bench.worker.set_payload(&mut arm, &kg(-1.0)).is_err());
}

#[test]
fn a_load_is_set_at_rest() {
    let set = |speed: f64| {
        let (mut bench, mut arm) = equipped(Setup::default());
        drop(bench.arm.clone().velocities(Some(&[0.0, -speed, 0.0])));
        cycle(&mut bench, &mut arm);
        bench.worker.set_payload(&mut arm, &kg(1.0)).is_ok()
    };
    assert!(set(0.0) && set(dimos_core::joint::STANDSTILL));
    assert!(!set(0.2));
    // Without measured velocities only the coordinator can tell.
    let (mut bench, mut arm) = equipped(Setup::default());
    bench.worker.state.velocity[0] = 0.2;
    bench.worker.state.velocity_source = dimos_core::arm::VelocitySource::Absent;
    assert!(bench.worker.set_payload(&mut arm, &kg(1.0)).is_ok());
}

#[test]
fn the_mounting_is_set_if_it_differs_and_read_back() {
    let mount = |present: [f64; 3], error: Option<AdapterError>| {
        let (mut bench, mut arm) = equipped(Setup { gravity: Some(UP), ..Setup::default() });
        (arm.parts.gravity, arm.parts.mounting) = (present, error);
        let result = bench.worker.configure(&mut arm).map_err(|e| e.to_string());
        (result, arm.parts.written.len())
    };
    assert_eq!(mount(DOWN, None), (Ok(()), 1));
    assert_eq!(mount(UP, None), (Ok(()), 0));
    assert_eq!(mount([0.0, 0.009, 1.0], None), (Ok(()), 0), "as read back, rounded");
    assert_eq!(mount([0.0, 0.02, 1.0], None), (Ok(()), 1));
    let (refused, _) = mount(DOWN, Some(AdapterError::Unsupported));
    assert!(refused.unwrap_err().starts_with("the mounting of this arm cannot be set\nhint: "));
    assert_eq!(mount(DOWN, Some(AdapterError::Rejected("no".into()))).0, Err("no".into()));
    let (mut bench, mut arm) = equipped(Setup { gravity: Some(UP), ..Setup::default() });
    arm.parts.keeps_mounting = true;
    let refused = bench.worker.configure(&mut arm).unwrap_err().to_string();
    assert!(refused.contains("the controller reports gravity along [0.000, 0.000, -1.000]"), "{refused}");
}

#[test]
fn the_stop_input_is_read_in_every_cycle_and_unread_it_is_no_state() {
    let (mut bench, mut arm) =
        equipped(Setup { stop_input: Some(StopInput { input: 1, open: false }), ..Setup::default() });
    for _ in 0..120 {
        assert!(!cycle(&mut bench, &mut arm).stop_input_open);
    }
    assert_eq!(arm.parts.read[0], 120, "once per cycle, also where it would be its turn among slow readings");
    arm.parts.io.digital_inputs = 0b01;
    assert!(cycle(&mut bench, &mut arm).stop_input_open);
    assert_eq!(bench.worker.health.details().io, Some(arm.parts.io));
    arm.parts.failing[0] = Some(AdapterError::Timeout("no answer".into()));
    let seq = bench.states.read().seq;
    assert_eq!(cycle(&mut bench, &mut arm).seq, seq);
}

#[test]
fn a_stop_input_that_the_arm_lacks_and_parts_that_it_lacks_are_refused() {
    let check = |input: u8| {
        let stop_input = Some(StopInput { input, open: false });
        let mut bench = Bench::with(MockAdapter::new(DOF), |c| c.setup = Setup { stop_input, ..Setup::default() });
        let mut arm = Equipped { inner: bench.arm.clone(), parts: Parts::default() };
        bench.worker.connect(&mut arm).map(drop)
    };
    assert_eq!(check(1), Ok(()));
    assert!(check(2).unwrap_err().to_string().contains("di2"));
    for setup in [
        Setup { stop_input: Some(StopInput { input: 0, open: false }), ..Setup::default() },
        Setup { payload: Some(kg(1.0)), ..Setup::default() },
        Setup { gravity: Some(UP), ..Setup::default() },
    ] {
        let mut bench = Bench::with(MockAdapter::new(DOF), |config| config.setup = setup);
        assert!(bench.worker.connect(&mut bench.adapter).is_err());
        assert_eq!(bench.count("disconnect"), 1);
    }
}

#[test]
fn slow_values_are_read_in_turn_five_times_a_second_and_published_with_their_changes() {
    let (mut bench, mut arm) = equipped(Setup::default());
    for _ in 0..120 {
        cycle(&mut bench, &mut arm);
    }
    assert_eq!(arm.parts.read, [2, 2, 2], "1.2 s");
    let details = bench.worker.health.details();
    assert_eq!((details.io_seq, details.payload_seq), (1, 1), "both have not changed since the first reading");
    assert_eq!(details.joints_seq, u64::from(arm.parts.read[1]));
    assert_eq!(details.joints.unwrap()[0].temperature, Some(40.0));

    arm.parts.io.digital_inputs = 0;
    arm.parts.load = kg(3.0);
    for _ in 0..60 {
        cycle(&mut bench, &mut arm);
    }
    let details = bench.worker.health.details();
    assert_eq!((details.io_seq, details.payload_seq, details.payload), (2, 2, Some(kg(3.0))));
    assert_eq!(details.io.map(|io| io.digital_inputs), Some(0));
    // What a reader keeps from being published is published when it lets go.
    arm.parts.load = kg(4.0);
    bench.worker.health.clone().while_details_are_read(|| {
        for _ in 0..60 {
            cycle(&mut bench, &mut arm);
        }
    });
    assert_eq!(bench.worker.health.details().payload, Some(kg(3.0)));
    arm.parts.failing[2] = Some(AdapterError::Timeout("no load".into()));
    cycle(&mut bench, &mut arm);
    assert_eq!(bench.worker.health.details().payload, Some(kg(4.0)));
    // An output was set: inputs and outputs are next.
    let before = arm.parts.read[0];
    bench.worker.slow.read_io_next();
    cycle(&mut bench, &mut arm);
    assert_eq!(arm.parts.read[0], before + 1);
}

#[test]
fn calibration_offsets_are_told_with_the_connection_if_the_arm_knows_them() {
    let offsets = |reports_offsets: bool| {
        let (mut bench, mut arm) = equipped(Setup::default());
        arm.parts.reports_offsets = reports_offsets;
        bench.worker.connect(&mut arm).unwrap().calibration_offsets
    };
    assert_eq!(offsets(true), Some(dimos_core::joint::joints_of(&[0.1, -0.2, 0.3])));
    assert_eq!(offsets(false), None);
}

#[test]
fn a_slow_reading_that_fails_is_said_once_and_affects_no_other() {
    let (mut bench, mut arm) = equipped(Setup::default());
    arm.parts.failing[2] = Some(AdapterError::Timeout("no load".into()));
    let mut last = ArmState::default();
    for _ in 0..180 {
        last = cycle(&mut bench, &mut arm);
    }
    assert!(last.seq > 170 && last.link == dimos_core::arm::Link::Up);
    assert_eq!(bench.notes(), ["status values cannot be read: no load"]);
    assert!(bench.worker.health.details().io.is_some());
    arm.parts.failing[2] = None;
    for _ in 0..60 {
        cycle(&mut bench, &mut arm);
    }
    arm.parts.failing[2] = Some(AdapterError::Timeout("no load".into()));
    for _ in 0..60 {
        cycle(&mut bench, &mut arm);
    }
    assert_eq!(bench.notes(), ["status values cannot be read: no load"], "again");

    // A lost connection is a failed read.
    arm.parts.failing = [0; 3].map(|_| Some(AdapterError::NotConnected));
    let before = bench.worker.health.read_errors.load(std::sync::atomic::Ordering::Relaxed);
    for _ in 0..30 {
        cycle(&mut bench, &mut arm);
    }
    assert!(bench.worker.health.read_errors.load(std::sync::atomic::Ordering::Relaxed) > before);
}

#[test]
fn outputs_that_the_arm_lacks_and_values_that_are_no_number_are_refused() {
    let (_, mut arm) = equipped(Setup::default());
    let mut set = |value| slow_readings::set_output(&mut arm, value).map_err(|e| e.to_string());
    assert_eq!(set(OutputValue::Digital(1, true)), Ok(()));
    assert_eq!(set(OutputValue::Analog(0, 2.5)), Ok(()));
    assert_eq!(set(OutputValue::Digital(2, true)), Err("the arm has no output do2\nhint: it has do0 to do1".into()));
    assert_eq!(set(OutputValue::Analog(1, 2.5)), Err("the arm has no output ao1\nhint: it has ao0 to ao0".into()));
    assert_eq!(set(OutputValue::Analog(0, f64::NAN)), Err("NaN is not a finite number".into()));
    assert_eq!(arm.parts.written, ["do1=true", "ao0=2.5"]);
}
