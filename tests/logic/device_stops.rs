//! The device thread and commands that an arm does not take: a stop is retried, whether the tick requested it or the
//! device thread did because no tick came; other refusals are reported as such.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use dimos::arm::{ArmCommand, ArmState, Interference, IoInfo, IoState, Link, Supervision};
use dimos::arms::piper::{self, emulator::PiperEmulator};
use dimos::arms::xarm::{self, emulator::XArmEmulator};
use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::adapter::{
    AdapterError, AdapterResult, Io, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos::hardware::device::{Device, DeviceConfig};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::joint::ControlMode;
use dimos::rt::heartbeat::Heartbeat;
use dimos::rt::host;
use dimos::rt::slot::{SlotReader, SlotWriter, slot};
use dimos::testing::{Call, MockAdapter};

use crate::support::delegate::delegate;
use crate::support::wire::watch::Watch;

pub(crate) const LIMIT: Duration = Duration::from_secs(20);

struct Bench {
    device: Device,
    beat: Arc<Heartbeat>,
    states: SlotReader<ArmState>,
    commands: SlotWriter<ArmCommand>,
    command: ArmCommand,
    mock: MockAdapter,
}

/// A clock that jumps forward once while the device thread waits, as it does for a process that was stopped.
#[derive(Debug, Default)]
struct JumpingClock {
    /// The jump to come, and what was jumped so far [ns].
    jump: AtomicU64,
    ahead: AtomicU64,
    /// When the thread last asked for the time [ns].
    asked: AtomicU64,
}

/// Between two questions for the time that are further apart than this the thread waited.
const WAITED: u64 = 3_000_000;

impl Clock for JumpingClock {
    fn now(&self) -> Mono {
        let now = MonotonicClock.now();
        if now.0.saturating_sub(self.asked.swap(now.0, Relaxed)) > WAITED {
            self.ahead.fetch_add(self.jump.swap(0, Relaxed), Relaxed);
        }
        now.after(Duration::from_nanos(self.ahead.load(Relaxed)))
    }
}

fn bench(native_rate: f64) -> Bench {
    let mock = MockAdapter::new(6);
    bench_of(Box::new(mock.clone()), mock, native_rate)
}

/// A device thread with this adapter, and the tick's ends: heartbeat, states and commands.
pub(crate) fn spawn(
    adapter: Box<dyn ManipulatorAdapter>,
    native_rate: f64,
    clock: Arc<dyn Clock>,
) -> (Device, Arc<Heartbeat>, SlotReader<ArmState>, SlotWriter<ArmCommand>) {
    let beat = Arc::new(Heartbeat::default());
    let (state_writer, states) = slot(ArmState::default());
    let (commands, command_reader) = slot(ArmCommand::default());
    let config = DeviceConfig {
        hardware_id: "arm".into(),
        dof: 6,
        usb: Box::new(|| None),
        tick_period: Duration::from_millis(10),
        native_rate,
        supervision: Supervision { accept_zero_pose: true, ..Supervision::default() },
        setup: dimos::hardware::device::Setup::default(),
        peripherals: Default::default(),
        beat: beat.clone(),
        pace: None,
        clock,
        notes: Box::new(|_| {}),
    };
    let device = Device::spawn(config, adapter, state_writer, command_reader).unwrap();
    (device, beat, states, commands)
}

/// A connected and enabled arm with this adapter; `mock` is that adapter, or unused.
fn bench_of(adapter: Box<dyn ManipulatorAdapter>, mock: MockAdapter, native_rate: f64) -> Bench {
    bench_on(Arc::new(MonotonicClock), adapter, mock, native_rate)
}

/// As above, on this clock.
fn bench_on(clock: Arc<dyn Clock>, adapter: Box<dyn ManipulatorAdapter>, mock: MockAdapter, native_rate: f64) -> Bench {
    let (device, beat, states, commands) = spawn(adapter, native_rate, clock);
    device.connect().wait(LIMIT).unwrap();
    device.activate().wait(LIMIT).unwrap();
    Bench { device, beat, states, commands, command: ArmCommand::default(), mock }
}

impl Bench {
    /// What a tick does: a heartbeat, and the next command.
    fn tick(&mut self, change: impl FnOnce(&mut ArmCommand)) {
        let now = MonotonicClock.now();
        self.beat.beat(now);
        self.command.seq += 1;
        self.command.next_tick = now.after(Duration::from_millis(10));
        change(&mut self.command);
        self.commands.write(&self.command);
        self.device.wake().raise();
    }

    fn stops(&self) -> usize {
        self.mock.calls().iter().filter(|c| **c == Call::Method("write_stop")).count()
    }

    fn until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> bool) {
        let began = Instant::now();
        while !done(self) {
            assert!(began.elapsed() < LIMIT, "not within {LIMIT:?}: {what}");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn end(self) {
        self.device.finish(false).wait(LIMIT).unwrap();
        self.device.join();
    }
}

#[test]
fn a_stop_that_fails_is_sent_again_and_confirmed() {
    let mut bench = bench(100.0);
    bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.03));
    bench.until("the velocity", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    bench.mock.fail("write_stop", AdapterError::Timeout("no answer".into()));
    bench.mock.fail("write_stop", AdapterError::Rejected("busy".into()));
    bench.tick(|c| (c.mode, c.stop_seq) = (None, 1));
    // No more ticks come: the thread continues on its own.
    bench.until("the stop", |b| b.device.health().stop_confirmed.load(Relaxed) == 1);
    assert_eq!(bench.stops(), 3);
    bench.end();
}

#[test]
fn a_stop_that_was_asked_for_while_the_link_was_down_is_sent_when_it_is_back() {
    let mut bench = bench(100.0);
    bench.tick(|c| c.mode = Some(ControlMode::Velocity));
    bench.until("the velocity", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    bench.mock.fail("read_joint_positions", AdapterError::NotConnected);
    bench.until("the loss", |b| b.states.read().link == Link::Faulted);
    bench.tick(|c| (c.mode, c.stop_seq) = (None, 1));
    bench.until("the stop", |b| b.device.health().stop_confirmed.load(Relaxed) == 1);
    let calls = bench.mock.calls();
    let at = |name: &str| calls.iter().rposition(|c| c.name() == name).unwrap();
    assert!(at("connect") < at("write_stop"), "after the new connection");
    bench.until("the link", |b| b.states.read().link == Link::Up);
    assert!(bench.states.read().self_held, "it must be enabled before it moves again");
    bench.end();
}

#[test]
fn a_tick_that_gets_no_processor_holds_no_arm_for_less_than_a_tenth_of_a_second() {
    let mut bench = bench(100.0);
    bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.03));
    let began = MonotonicClock.now();
    bench.beat.sleep_until(began.after(Duration::from_millis(10)));
    bench.until("the hold", |b| b.states.read().self_held);
    let held_after = MonotonicClock.now().since(began);
    assert!(held_after >= Duration::from_millis(105), "it sleeps and was not woken: held after {held_after:?}");
    bench.end();
}

#[test]
fn a_tick_that_was_charged_for_a_pause_of_the_computer_does_not_hang() {
    let mut bench = bench(100.0);
    // Linux charges a pause of a virtual machine to the thread that ran, as if it had computed all the time.
    let beat = bench.beat.clone();
    let tick = std::thread::spawn(move || {
        beat.adopt_thread();
        let charged = host::thread_cpu_time() + Duration::from_millis(28);
        while host::thread_cpu_time() < charged {}
        std::thread::park();
    });
    bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.03));
    let began = MonotonicClock.now();
    bench.until("the hold", |b| b.states.read().self_held);
    let held_after = MonotonicClock.now().since(began);
    assert!(held_after >= Duration::from_millis(105), "it waits, and was held after {held_after:?}");
    tick.thread().unpark();
    tick.join().unwrap();
    bench.end();
}

#[test]
fn a_delay_of_the_device_thread_is_not_the_arms_silence() {
    let (clock, mock) = (Arc::new(JumpingClock::default()), MockAdapter::new(6));
    let mut bench = bench_on(clock.clone(), Box::new(mock.clone()), mock, 100.0);
    // A setpoint whose acknowledgement was lost may still be on its way.
    bench.mock.fail("write_joint_velocities", AdapterError::Timeout("no answer".into()));
    bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.03));
    bench.until("the refusal", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    clock.jump.store(65_000_000, Relaxed);
    let beat = |b: &Bench| b.beat.beat(MonotonicClock.now().after(Duration::from_nanos(clock.ahead.load(Relaxed))));
    bench.until("the jump", |b| {
        beat(b);
        clock.ahead.load(Relaxed) > 0
    });
    // Until the state is read again.
    let reads = |b: &Bench| b.mock.calls().iter().filter(|c| c.name() == "read_joint_positions").count();
    let before = reads(&bench);
    bench.until("two readings", |b| {
        beat(b);
        reads(b) >= before + 2
    });
    assert!(!bench.states.read().self_held, "the process was stopped for 65 ms, the arm was not silent");
    bench.end();
}

#[test]
fn a_slow_arm_is_held_too_when_the_tick_falls_silent() {
    // It is read once a second, and must be stopped long before the next time.
    let mut bench = bench(1.0);
    bench.mock.fail("write_stop", AdapterError::Timeout("no answer".into()));
    bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.03));
    bench.until("the velocity", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    bench.mock.clear_calls();
    bench.until("the stops", |b| b.stops() == 2);
    assert!(bench.states.read().self_held);
    let reads = bench.mock.calls().iter().filter(|c| c.name() == "read_joint_positions").count();
    assert!(reads <= 1, "held between two readings, not after {reads} of them");
    let written = |b: &Bench| b.mock.calls().iter().filter(|c| c.name() == "write_joint_velocities").count();
    let before = written(&bench);
    bench.tick(|_| {});
    bench.until("the command", |b| b.states.read().seq > 0);
    std::thread::sleep(Duration::from_millis(30));
    assert_eq!(written(&bench), before, "a tick that comes back does not move it again");
    bench.end();
}

#[test]
fn a_change_of_mode_that_a_moving_arm_refuses_is_asked_for_again_and_is_no_fault() {
    let mut bench = bench(100.0);
    for _ in 0..5 {
        bench.mock.fail("set_control_mode", AdapterError::Rejected("the arm is moving".into()));
    }
    let asked = |b: &Bench| b.mock.calls().iter().filter(|c| c.name() == "set_control_mode").count();
    for refusals in 1..=5 {
        bench.tick(|c| c.mode = Some(ControlMode::Velocity));
        bench.until("the question", |b| asked(b) >= refusals);
        assert_eq!(bench.states.read().link, Link::Up);
        assert!(!bench.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"), "no value in the wrong mode");
    }
    bench.tick(|c| c.mode = Some(ControlMode::Velocity));
    bench.until("the velocity", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    bench.end();
}

#[test]
fn a_mode_refused_in_an_earlier_motion_does_not_count_in_the_next_one() {
    let mut bench = bench(100.0);
    let requests = |b: &Bench| b.mock.calls().iter().filter(|c| c.name() == "set_control_mode").count();
    let refuse = |b: &Bench| b.mock.fail("set_control_mode", AdapterError::Rejected("the arm is moving".into()));
    refuse(&bench);
    bench.tick(|c| c.mode = Some(ControlMode::Velocity));
    bench.until("the first request", |b| requests(b) == 1);
    bench.tick(|c| c.mode = None);
    // Longer than an arm may refuse a change of mode.
    std::thread::sleep(Duration::from_millis(1100));
    refuse(&bench);
    bench.tick(|c| c.mode = Some(ControlMode::Velocity));
    bench.until("the second request", |b| requests(b) == 2);
    bench.tick(|c| c.mode = Some(ControlMode::Velocity));
    bench.until("the velocity", |b| b.mock.calls().iter().any(|c| c.name() == "write_joint_velocities"));
    assert_eq!(bench.device.health().write_errors.load(Relaxed), 0);
    bench.end();
}

#[test]
fn motors_that_stay_on_after_a_refused_disable_are_no_interference() {
    let mut bench = bench(100.0);
    bench.mock.fail("write_enable", AdapterError::Rejected("the arm is moving".into()));
    assert!(bench.device.disable().wait(LIMIT).is_err());
    let seq = bench.states.read().seq;
    bench.until("five readings", |b| b.states.read().seq >= seq + 5);
    assert_eq!(bench.states.read().interference, Interference::None);
    bench.end();
}

#[test]
fn the_reason_for_a_refused_reconnect_is_reported() {
    let mut bench = bench(100.0);
    bench.mock.fail("connect", AdapterError::Rejected("another arm".into()));
    bench.mock.fail("read_joint_positions", AdapterError::NotConnected);
    bench.until("the new connection", |b| b.device.health().reconnects.load(Relaxed) == 1);
    let texts: Vec<_> = bench.device.health().episodes().into_iter().map(|episode| episode.text).collect();
    assert!(texts.iter().any(|text| text == "cannot reconnect: another arm"), "{texts:?}");
    bench.end();
}

#[test]
fn the_end_of_a_run_reports_an_arm_that_was_lost() {
    for (disable, orders) in [(false, "no stop"), (true, "neither a stop nor a disable")] {
        let mut bench = bench(100.0);
        for _ in 0..100 {
            bench.mock.fail("connect", AdapterError::Io("unplugged".into()));
        }
        bench.mock.fail("read_joint_positions", AdapterError::NotConnected);
        bench.until("the loss", |b| b.states.read().link == Link::Faulted);
        let expected = AdapterError::Io(format!("the connection is lost: {orders} reached the arm"));
        assert_eq!(bench.device.finish(disable).wait(LIMIT), Err(expected));
        assert_eq!(bench.states.read().link, Link::Down);
        bench.device.join();
    }
}

#[test]
fn an_arm_that_was_never_connected_is_released_without_an_error() {
    let mock = MockAdapter::new(6);
    mock.fail("connect", AdapterError::Io("unplugged".into()));
    let (device, ..) = spawn(Box::new(mock), 100.0, Arc::new(MonotonicClock));
    assert!(device.connect().wait(LIMIT).is_err());
    device.finish(true).wait(LIMIT).unwrap();
    device.join();
}

/// The stop of an xArm does not reach its gripper: the device thread holds it.
#[test]
fn a_gripper_that_goes_on_after_a_stop_is_held() {
    let options = serde_json::json!({ "gripper": "xarm" });
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let emulator = XArmEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    let mut bench = bench_of((xarm::SPEC.create)(&config).unwrap(), MockAdapter::new(6), 250.0);
    let send = |bench: &mut Bench, opening: f64| {
        bench.tick(|command| (command.gripper, command.gripper_seq) = (opening, command.gripper_seq + 1));
    };
    Watch::of_processors().unless_stalled(|| {
        send(&mut bench, 0.0);
        bench.until("it is closed", |_| emulator.gripper() < 1e-4);
        send(&mut bench, 0.085);
        bench.until("it opens", |_| emulator.gripper() > 0.005);
        bench.tick(|command| command.stop_seq += 1);
        let sent = bench.command.stop_seq;
        bench.until("the stop", |bench| bench.device.health().stop_sent.load(Relaxed) == sent);
        let at_the_stop = emulator.gripper();
        // The whole way takes 0.85 s: only a stall lets the gripper arrive before the stop.
        if at_the_stop >= 0.06 {
            bench.device.activate().wait(LIMIT).unwrap();
            return Err(format!("the stop reached the arm with the gripper at {at_the_stop} m"));
        }
        std::thread::sleep(Duration::from_millis(1200));
        let held = emulator.gripper();
        std::thread::sleep(Duration::from_millis(300));
        assert!(held < 0.0849, "stopped at {at_the_stop} m, it continued to {held} m");
        assert!((emulator.gripper() - held).abs() < 1e-6, "held");
        Ok(())
    });
    bench.end();
}

/// The stop of a Piper does not reach its gripper either: it is held with the torque of its command, not with that of
/// the options.
#[test]
fn a_gripper_is_held_with_the_force_of_its_command() {
    let options = serde_json::json!({ "gripper_torque": 1.0 });
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let emulator = PiperEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    let mut bench = bench_of((piper::SPEC.create)(&config).unwrap(), MockAdapter::new(6), 200.0);
    let send = |bench: &mut Bench, opening: f64, force: Option<f64>| {
        bench.tick(|command| {
            (command.gripper, command.gripper_force, command.gripper_seq) = (opening, force, command.gripper_seq + 1);
        });
    };
    let opening = |bench: &mut Bench| bench.states.read().gripper.unwrap_or(f64::NAN);
    Watch::of_processors().unless_stalled(|| {
        send(&mut bench, 0.0, None);
        bench.until("it is closed", |bench| opening(bench) < 1e-4);
        send(&mut bench, 0.07, Some(2.5));
        bench.until("it opens", |bench| opening(bench) > 0.005);
        emulator.record();
        bench.tick(|command| command.stop_seq += 1);
        let sent = bench.command.stop_seq;
        bench.until("the stop", |bench| bench.device.health().stop_sent.load(Relaxed) == sent);
        let at_the_stop = opening(&mut bench);
        if at_the_stop >= 0.05 {
            bench.device.activate().wait(LIMIT).unwrap();
            return Err(format!("the stop reached the arm with the gripper at {at_the_stop} m"));
        }
        std::thread::sleep(Duration::from_millis(500));
        let orders: Vec<_> = emulator.trace().into_iter().filter(|(_, frame)| frame.id == 0x159).collect();
        let [(_, hold)] = orders[..] else { panic!("{orders:?}") };
        assert_eq!(hold.data[4..7], [0x09, 0xC4, 1], "2500 mNm, on");
        assert!(opening(&mut bench) < 0.069, "stopped at {at_the_stop} m, it continued to {} m", opening(&mut bench));
        Ok(())
    });
    bench.end();
}

/// An arm whose inputs take longer to read than a client takes to ask again.
struct SlowInputs {
    inner: MockAdapter,
}

impl ManipulatorAdapter for SlowInputs {
    delegate!(
        inner: connect, disconnect, is_connected, get_info, get_dof, get_limits, set_control_mode, get_control_mode,
        read_joint_positions, read_state, read_error, read_enabled, write_joint_positions, write_joint_velocities,
        write_stop, write_enable, write_clear_errors
    );

    fn io(&mut self) -> Option<&mut dyn Io> {
        Some(self)
    }
}

impl Io for SlowInputs {
    fn get_io(&self) -> IoInfo {
        IoInfo::default()
    }

    fn read_io(&mut self, _: &mut IoState) -> AdapterResult<()> {
        std::thread::sleep(Duration::from_millis(5));
        Ok(())
    }

    fn write_digital_output(&mut self, _: u8, _: bool) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
}

#[test]
fn clients_that_ask_without_a_pause_delay_no_stop() {
    let mock = MockAdapter::new(6);
    let mut bench = bench_of(Box::new(SlowInputs { inner: mock.clone() }), mock, 100.0);
    let asking = AtomicU64::new(1);
    let device = &bench.device;
    let (stopped, asked) = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..3)
            .map(|_| {
                scope.spawn(|| {
                    let mut asked = 0;
                    while asking.load(Relaxed) == 1 {
                        device.read_io().wait(LIMIT).unwrap();
                        asked += 1;
                    }
                    asked
                })
            })
            .collect();
        std::thread::sleep(Duration::from_millis(200));
        let stop = ArmCommand { seq: 1, stop_seq: 1, ..ArmCommand::default() };
        bench.beat.beat(MonotonicClock.now());
        bench.commands.write(&stop);
        device.wake().raise();
        std::thread::sleep(Duration::from_millis(500));
        let stopped = device.health().stop_confirmed.load(Relaxed) == 1;
        asking.store(0, Relaxed);
        (stopped, clients.into_iter().map(|client| client.join().unwrap()).sum::<u32>())
    });
    assert!(stopped, "after {asked} answers to clients");
    bench.end();
}
