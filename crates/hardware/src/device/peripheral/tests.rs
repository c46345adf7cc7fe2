//! A peripheral's cycles, one by one, on a virtual clock: no thread, no waiting.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::worker::Worker;
use super::*;
use crate::adapter::{AdapterError, Gripper};
use dimos_core::arm::ArmCommand;
use dimos_core::clock::Mono;

#[derive(Debug, Clone, Default)]
struct TestClock(Arc<Mutex<u64>>);

impl Clock for TestClock {
    fn now(&self) -> Mono {
        Mono(*lock(&self.0))
    }
}

/// Fingers whose cable can be pulled. Clones are the same ones.
#[derive(Debug, Clone, Default)]
struct Fingers(Arc<Mutex<Inner>>);

#[derive(Debug, Default)]
struct Inner {
    connected: bool,
    pulled: bool,
    condition: Condition,
    position: f64,
    holds: bool,
    commands: Vec<(f64, Option<f64>)>,
    halts: usize,
}

impl Fingers {
    fn change(&self, change: impl FnOnce(&mut Inner)) {
        change(&mut lock(&self.0));
    }
}

impl Peripheral for Fingers {
    fn connect(&mut self) -> AdapterResult<PeripheralInfo> {
        let mut inner = lock(&self.0);
        if inner.pulled {
            return Err(AdapterError::Io("no such device".into()));
        }
        inner.connected = true;
        Ok(PeripheralInfo::default())
    }
    fn disconnect(&mut self) {
        lock(&self.0).connected = false;
    }
    fn is_connected(&self) -> bool {
        lock(&self.0).connected
    }
    fn read(&mut self) -> AdapterResult<()> {
        let mut inner = lock(&self.0);
        if inner.pulled {
            inner.connected = false;
            return Err(AdapterError::Io("unplugged".into()));
        }
        Ok(())
    }
    fn condition(&self) -> Condition {
        lock(&self.0).condition
    }
    fn home(&mut self) -> AdapterResult<()> {
        lock(&self.0).condition = Condition::Homing;
        Ok(())
    }
    fn halt(&mut self) -> AdapterResult<()> {
        lock(&self.0).halts += 1;
        Ok(())
    }
    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }
}

impl Gripper for Fingers {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(Some(lock(&self.0).position))
    }
    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        Ok(Some(lock(&self.0).holds))
    }
    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        lock(&self.0).commands.push((position, None));
        Ok(())
    }
    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        lock(&self.0).commands.push((position, Some(force)));
        Ok(())
    }
    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some((1.0, 10.0))
    }
}

struct Bench {
    worker: Worker,
    fingers: Fingers,
    adapter: Fingers,
    clock: TestClock,
    port: Port,
    shared: Arc<Shared>,
    arm: Arc<Health>,
    orders: (Sender<Order>, Receiver<Order>),
    wake: Wake,
    notes: Arc<Mutex<Vec<String>>>,
    command: ArmCommand,
}

impl Bench {
    fn connected() -> Self {
        let (states, state_reader) = slot(PeripheralState::default());
        let (commands, command_reader) = slot(Command::default());
        let (wake, shared, arm) = (Wake::new().unwrap(), Arc::new(Shared::default()), Arc::new(Health::default()));
        let (clock, fingers, notes) = (TestClock::default(), Fingers::default(), Arc::new(Mutex::new(Vec::new())));
        let noted = notes.clone();
        let config = PeripheralConfig {
            arm: "left".into(),
            part: Part::Gripper,
            native_rate: 100.0,
            clock: Arc::new(clock.clone()),
            notes: Box::new(move |note| {
                lock(&noted).push(match note {
                    Note::Began(text) => text,
                    Note::Over(text) => format!("over: {text}"),
                });
            }),
        };
        let mut port = Port::new(commands, state_reader, (wake.clone(), shared.clone()), None);
        port.answer_to(arm.clone());
        port.state();
        let worker = Worker::new(config, states, command_reader, (wake.clone(), shared.clone()));
        let (adapter, orders, command) = (fingers.clone(), channel(), ArmCommand::default());
        let mut bench = Self { worker, fingers, adapter, clock, port, shared, arm, orders, wake, notes, command };
        bench.order(Order::Connect).unwrap();
        bench
    }

    /// Cycles of 10 ms each.
    fn run(&mut self, cycles: u64) {
        for _ in 0..cycles {
            *lock(&self.clock.0) += 10_000_000;
            self.wake.raise();
            assert!(!self.worker.cycle(&mut self.adapter, &self.orders.1));
        }
    }

    fn order<T>(&mut self, order: impl FnOnce(SyncSender<AdapterResult<T>>) -> Order) -> AdapterResult<T> {
        let (reply, answer) = sync_channel(1);
        self.orders.0.send(order(reply)).unwrap();
        self.run(1);
        answer.try_recv().unwrap()
    }

    fn grip(&mut self, position: f64) -> AdapterResult<()> {
        self.command.gripper_seq += 1;
        (self.command.gripper, self.command.gripper_force) = (position, Some(5.0));
        self.port.command(&self.command);
        self.run(1);
        self.arm.gripper_answer(self.command.gripper_seq).unwrap()
    }

    fn notes(&self) -> Vec<String> {
        std::mem::take(&mut lock(&self.notes))
    }
}

#[test]
fn commands_reach_the_fingers_and_are_answered_where_the_arm_asks() {
    let mut bench = Bench::connected();
    bench.fingers.change(|fingers| fingers.position = 0.03);
    bench.run(2);
    let state = bench.port.state();
    assert_eq!((state.position, state.holds, state.at), (Some(0.03), Some(false), bench.clock.now()));
    assert_eq!(bench.grip(0.02), Ok(()));
    assert_eq!(lock(&bench.fingers.0).commands, [(0.02, Some(5.0))]);
    bench.fingers.change(|fingers| fingers.condition = Condition::NotHomed);
    bench.run(1);
    let refused = bench.grip(0.01).unwrap_err().to_string();
    assert!(refused.starts_with("the gripper is not homed\nhint: `dimos arm gripper left home`"), "{refused}");
    assert_eq!(lock(&bench.fingers.0).commands.len(), 1);
    assert_eq!(bench.order(Order::Home), Ok(()));
    assert_eq!(*lock(&bench.shared.condition), Condition::Homing);
    bench.port.stop();
    bench.run(1);
    assert_eq!(lock(&bench.fingers.0).halts, 1, "a stop of the arm ends homing");
}

#[test]
fn a_stop_holds_fingers_that_move_and_leaves_those_that_grip() {
    let mut bench = Bench::connected();
    bench.grip(0.0).unwrap();
    bench.port.stop();
    for position in [0.05, 0.048, 0.046] {
        bench.fingers.change(|fingers| fingers.position = position);
        bench.run(1);
    }
    assert_eq!(lock(&bench.fingers.0).commands, [(0.0, Some(5.0)), (0.046, Some(5.0))]);
    bench.port.stop();
    bench.run(300);
    assert_eq!(lock(&bench.fingers.0).commands.len(), 2);
}

#[test]
fn a_lost_one_is_named_refuses_and_comes_back() {
    let mut bench = Bench::connected();
    bench.run(3);
    bench.fingers.change(|fingers| fingers.pulled = true);
    bench.run(2);
    assert_eq!((bench.shared.link(), bench.port.state()), (Link::Faulted, PeripheralState::default()));
    assert!(!bench.port.is_missed(), "it held nothing");
    assert_eq!(bench.notes(), ["gripper: no state: unplugged"]);
    let refused = bench.grip(0.01).unwrap_err().to_string();
    let expected =
        "the gripper is lost: no state: unplugged\nhint: check its cable and supply, then: dimos arm reset left";
    assert_eq!(refused, expected);
    assert!(bench.order(Order::Home).is_err() && bench.order(Order::Reset).is_err());
    bench.fingers.change(|fingers| fingers.pulled = false);
    assert_eq!(bench.order(Order::Reset), Ok(()));
    assert_eq!((bench.shared.link(), bench.grip(0.01)), (Link::Up, Ok(())));
    assert_eq!(bench.notes(), ["over: gripper: no state: unplugged"]);
}

#[test]
fn what_it_held_is_missed_until_it_is_back_or_the_loss_is_acknowledged() {
    for carried in [false, true] {
        let mut bench = Bench::connected();
        bench.fingers.change(|fingers| fingers.holds = !carried);
        bench.shared.carries.store(carried, Ordering::Relaxed);
        bench.run(2);
        bench.fingers.change(|fingers| fingers.pulled = true);
        bench.run(2);
        assert!(bench.port.is_missed(), "{carried}");
        assert!(bench.order(Order::Reset).is_err());
        assert!(!bench.port.is_missed(), "acknowledged");
        bench.fingers.change(|fingers| fingers.pulled = false);
        bench.run(600);
        assert_eq!(bench.shared.link(), Link::Up, "on its own");
        bench.fingers.change(|fingers| fingers.pulled = true);
        bench.run(2);
        assert!(bench.port.is_missed());
        bench.fingers.change(|fingers| fingers.pulled = false);
        bench.run(60);
        assert!(!bench.port.is_missed(), "it is back");
    }
}

#[test]
fn a_thread_ends_with_its_handle() {
    let fingers = Fingers::default();
    let config = PeripheralConfig {
        arm: "left".into(),
        part: Part::Gripper,
        native_rate: 100.0,
        clock: Arc::new(dimos_core::clock::MonotonicClock),
        notes: Box::new(|_| ()),
    };
    let (device, _port) = PeripheralDevice::spawn(config, Box::new(fingers.clone())).unwrap();
    device.connect().wait(Duration::from_secs(5)).unwrap();
    assert_eq!((device.link(), device.condition()), (Link::Up, Condition::Ready));
    drop(device);
    assert!(!lock(&fingers.0).connected);
}
