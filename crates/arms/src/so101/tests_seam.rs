//! The seam of the encoders: leaders that are turned over it, arms that are enabled beside it, and joints that are
//! pushed over it under power. Ten thousand random states and pushes against a model of one servo, the rest against the
//! emulator.

use std::time::Duration;

use serde_json::json;

use super::activation::hold_goal;
use super::adapter::So101Adapter;
use super::calibration::{Calibration, NAMES, Range, SEAM_MARGIN};
use super::emulator::Servos;
use super::protocol::{SERVOS, Servo};
use super::seam::{LOW_TORQUE, Order, SEAM_CROSSED, Seams};
use super::tests::{arm, goals, positions};
use dimos_core::clock::Mono;
use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter};
use dimos_hardware::registry::{AdapterConfig, Emulator};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::serial_server::SerialServer;

/// Furthest that a goal may move [counts]: the relief, 0.04 rad.
const RELIEF: i32 = 26;
/// The wrist.
const WRIST: usize = 4;

/// LeRobot's file; the wrist has this range.
fn file(low: i32, high: i32, offset: i32) -> String {
    let entry = |i: usize| {
        let (offset, low, high) = if i == WRIST { (offset, low, high) } else { (0, 797, 3299) };
        json!({"id": i + 1, "drive_mode": 0, "homing_offset": offset, "range_min": low, "range_max": high})
    };
    json!(NAMES.iter().enumerate().map(|(i, name)| (*name, entry(i))).collect::<std::collections::BTreeMap<_, _>>())
        .to_string()
}

/// Random numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, n: i32) -> i32 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        ((self.0 >> 16) % u64::from(n.unsigned_abs().max(1))) as i32
    }

    fn within(&mut self, low: i32, high: i32) -> i32 {
        low + self.below(high - low + 1)
    }
}

/// A servo that holds its goal as the STS3215 does: never the short way over the end of its turn.
struct Model {
    /// Where it is, counted over the seam [counts], and how fast it moved there [counts/s].
    at: f64,
    velocity: f64,
    servo: Servo,
    /// How far it hangs from its goal [counts].
    droop: f64,
}

impl Model {
    /// Lets a period of 10 ms pass. `hand`: holds the joint there, if its torque gives way.
    fn pass(&mut self, hand: Option<f64>, random: &mut Random) {
        let before = self.at;
        let turn = self.at.div_euclid(4096.0) * 4096.0;
        let wanted = f64::from(self.servo.goal) + turn - self.droop;
        let top = if self.servo.top_speed > 0 { f64::from(self.servo.top_speed) * 0.01 } else { 30.0 };
        match hand {
            Some(to) => self.at += (to - self.at).clamp(-30.0, 30.0),
            None if self.servo.on => self.at += (wanted - self.at).clamp(-top, top),
            None => {}
        }
        self.velocity = (self.at - before) * 100.0;
        let noise = f64::from(random.within(-1, 1));
        self.servo.position = ((self.at + noise).round() as i32).rem_euclid(4096);
        self.servo.velocity = self.velocity.round() as i32;
        // Its own load, and what its motor does to get to the goal: never the short way.
        let duty = 7.0 * (f64::from(self.servo.goal) - self.at.rem_euclid(4096.0));
        self.servo.load = if self.servo.on { duty.clamp(-1000.0, 1000.0) as i32 } else { 0 };
    }
}

/// The seam's logic, and a clock.
struct Watch {
    seams: Seams,
    range: Range,
    now: u64,
}

impl Watch {
    /// Reads the servo; does what is ordered. Returns the order.
    fn read(&mut self, model: &mut Model) -> Option<Order> {
        self.now += 10_000_000;
        let mut servos = [Servo::default(); SERVOS];
        servos[WRIST] = model.servo;
        self.seams.take(&servos, Mono(self.now));
        let order = self.seams.order(WRIST, &model.servo, self.range);
        match order {
            Some(Order::Yield(goal)) => {
                (model.servo.goal, model.servo.torque_limit, model.servo.top_speed) = (goal, LOW_TORQUE, 200);
            }
            Some(Order::Release) => (model.servo.torque_limit, model.servo.top_speed) = (1000, 0),
            None => {}
        }
        order
    }

    /// Lets this number of periods pass. Returns the last order.
    fn pass(&mut self, model: &mut Model, hand: Option<f64>, periods: u32, random: &mut Random) -> Option<Order> {
        let mut last = None;
        for _ in 0..periods {
            model.pass(hand, random);
            last = self.read(model).or(last);
        }
        last
    }
}

#[test]
fn no_goal_moves_at_a_seam_in_ten_thousand_states_and_pushes() {
    let mut random = Random(0x2545_F491_4F6C_DD1D);
    let (mut crossings, mut refused, mut enabled) = (0, 0, 0);
    for n in 0..10_000 {
        let (low, high) = match random.below(3) {
            0 => (0, 4095),
            1 => (random.below(200), 4095 - random.below(200)),
            _ => (random.below(1500), 2500 + random.below(1595)),
        };
        let range = Calibration::parse(&file(low, high, random.within(-2047, 2047)), 1).unwrap().0[WRIST];
        let mut watch = Watch { seams: Seams::default(), range, now: 1_000_000_000 };
        // Near an end of the range, or anywhere in it.
        let goal = match random.below(3) {
            0 => range.low + random.below(60),
            1 => range.high - random.below(60),
            _ => random.within(range.low, range.high),
        };
        // Up to 0.08 rad, whichever way the load pulls.
        let droop = f64::from(random.within(-52, 52));
        let servo = Servo { on: true, goal, position: goal, torque_limit: 1000, ..Servo::default() };
        let mut model = Model { at: f64::from(goal) - droop, velocity: 0.0, servo, droop };
        assert_eq!(watch.pass(&mut model, None, 20, &mut random), None, "{n}: held at {goal} of {range:?}");
        // Pushed by up to 60°, and let go.
        let push = f64::from(random.within(-680, 680));
        let to = model.at + push;
        let over = !(-2.0..4097.0).contains(&to);
        let order = watch.pass(&mut model, Some(to), 30, &mut random);
        if over && !(-100.0..=4200.0).contains(&to) {
            crossings += 1;
            assert!(matches!(order, Some(Order::Yield(_))), "{n}: {to} of {range:?}");
        } else if (2.0..4093.0).contains(&to) {
            assert_eq!(order, None, "{n}: {to} of {range:?}");
        }
        let before = model.at;
        watch.pass(&mut model, None, 100, &mut random);
        let moved = (model.at - before).abs();
        let back = push.abs() + 2.0 * f64::from(SEAM_MARGIN) + 60.0;
        assert!(moved <= back, "{n}: let go at {before}, it went to {} ({range:?}, goal {goal})", model.at);
        if watch.seams.is_crossed(WRIST) {
            // Turned back by hand, and let go: it goes to the end on the side on which it was held, weakly, then holds
            // it.
            let home = f64::from(goal) - droop;
            watch.pass(&mut model, Some(home), 60, &mut random);
            watch.pass(&mut model, None, 400, &mut random);
            let end = f64::from(if push > 0.0 { range.high } else { range.low });
            assert!((model.at - end).abs() <= 55.0 && !watch.seams.is_crossed(WRIST), "{n}: {} {end}", model.at);
            assert_eq!((model.servo.torque_limit, model.servo.top_speed), (1000, 0), "{n}");
        }
        // Enabling where it is: stays, or is refused.
        let here = random.within(-50, 4145);
        match hold_goal(WRIST, range, here) {
            Ok(goal) if goal == low || goal == high => assert!((goal - here).abs() <= 33),
            Ok(goal) => {
                enabled += 1;
                assert!((goal - here).abs() <= RELIEF && (SEAM_MARGIN..=4095 - SEAM_MARGIN).contains(&goal));
            }
            Err(error) => {
                refused += 1;
                let by = if here < range.low { "larger" } else { "smaller" };
                assert!(error.to_string().contains(&format!("towards {by} angles by hand")), "{error}");
            }
        }
        // A leader that rests on its seam.
        let rests = random.within(-3, 3);
        let mut leader = Watch { seams: Seams::default(), range, now: 1_000_000_000 };
        let limp = Servo { position: rests.rem_euclid(4096), ..Servo::default() };
        let mut led = Model { at: f64::from(rests), velocity: 0.0, servo: limp, droop: 0.0 };
        leader.read(&mut led);
        let first = leader.seams.positions[WRIST];
        for _ in 0..10 {
            led.pass(None, &mut random);
            assert_eq!(leader.read(&mut led), None);
            assert!((leader.seams.positions[WRIST] - first).abs() <= 3, "{n}");
        }
    }
    assert!(crossings > 500 && refused > 300 && enabled > 5_000, "{crossings} {refused} {enabled}");
}

/// A reading that slips over the seam, with or without a velocity, is false: the motor of a joint that is there works.
#[test]
fn a_reading_that_slips_over_the_seam_gives_no_goal() {
    let mut random = Random(0x9E37_79B9_7F4A_7C15);
    for n in 0..3_000 {
        let (low, high) = (random.below(1500), 2500 + random.below(1595));
        let range = Calibration::parse(&file(low, high, 0), 1).unwrap().0[WRIST];
        let mut watch = Watch { seams: Seams::default(), range, now: 1_000_000_000 };
        let goal = random.within(range.low, range.high);
        let droop = f64::from(random.within(-14, 14));
        let servo = Servo { on: true, goal, position: goal, torque_limit: 1000, ..Servo::default() };
        let mut model = Model { at: f64::from(goal) - droop, velocity: 0.0, servo, droop };
        watch.pass(&mut model, None, 20, &mut random);
        let (slip, shown) = (f64::from(random.within(-40, 40)), random.below(3));
        let mut slipped = 0.0;
        for _ in 0..400 {
            model.pass(None, &mut random);
            slipped += slip;
            let truth = model.servo;
            model.servo.position = ((model.at + slipped).round() as i32).rem_euclid(4096);
            if shown > 0 {
                model.servo.velocity += (slip * 100.0) as i32;
            }
            let order = watch.read(&mut model);
            assert_eq!(order, None, "{n}: {slip} counts per reading, {} of {range:?}", model.servo.position);
            model.servo = Servo { position: truth.position, velocity: truth.velocity, ..model.servo };
        }
    }
}

/// An arm whose wrist has its seam inside its travel: `offset` counts from half a turn.
fn calibrated(offset: i32, at: f64) -> (So101Adapter, SerialServer<Servos>, tempfile::TempDir) {
    let pose = json!([0.1, -0.5, 0.5, 0.3, at, 0.2]);
    let (_, servos) = arm(json!({"sim": {"initial_positions": pose}}));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    std::fs::write(&path, file(0, 4095, offset)).unwrap();
    let config = AdapterConfig {
        hardware_id: "arm".into(),
        address: servos.path().into(),
        dof: 5,
        options: json!({"calibration": path}),
    };
    super::SPEC.service.unwrap()(&config).unwrap().write_calibration(&path).unwrap();
    let mut adapter = So101Adapter::new(&config).unwrap();
    adapter.connect().unwrap();
    (adapter, servos, folder)
}

/// Moves the wrist by hand [rad], in half a second.
fn turn(adapter: &mut So101Adapter, servos: &SerialServer<Servos>, by: f64) -> Vec<f64> {
    let hand = Fault { joint: WRIST + 1, amount: by, ..Fault::new(FaultKind::Pushed).lasting(0.5) };
    servos.inject(hand).unwrap();
    let read = |_| {
        std::thread::sleep(Duration::from_millis(10));
        positions(adapter)[WRIST]
    };
    (0..60).map(read).collect()
}

#[test]
fn a_leader_is_read_over_its_seam() {
    // Its seam is at 600 counts of the encoder: −2.22 rad of the emulated arm.
    let (mut adapter, servos, _folder) = calibrated(600, -1.9);
    let start = positions(&mut adapter)[WRIST];
    let read = turn(&mut adapter, &servos, -0.6);
    let steps = read.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    assert!(steps < 0.1 && (read[59] - start + 0.6).abs() < 0.03, "{start}: {read:?}");
    assert_eq!(adapter.read_error(), Ok((0, String::new())), "its motors are off");
    // There it cannot be enabled: behind its seam, a whole turn from its range.
    let refused = adapter.activate().unwrap_err().to_string();
    assert!(refused.contains("joint 5 (wrist_roll) is "), "{refused}");
    assert!(refused.contains("beside the seam of its encoder\nhint: turn it by "), "{refused}");
    assert!(refused.contains("° towards larger angles by hand") && !adapter.read_enabled().unwrap(), "{refused}");
    turn(&mut adapter, &servos, 0.6);
    adapter.activate().unwrap();
}

#[test]
fn an_arm_beside_its_seam_is_not_enabled() {
    for (by, towards) in [(0.05, "larger"), (-0.05, "smaller")] {
        let (mut adapter, _servos, _folder) = calibrated(600, -2.2212 + by);
        let refused = adapter.activate().unwrap_err().to_string();
        assert!(refused.contains(&format!("towards {towards} angles by hand")), "{refused}");
        assert!(!adapter.read_enabled().unwrap());
    }
}

#[test]
fn a_wrist_that_crosses_its_seam_under_power_is_not_driven_round() {
    let (mut adapter, servos, _folder) = calibrated(600, -2.0);
    adapter.activate().unwrap();
    let mut goal = positions(&mut adapter);
    let (low, high) = (adapter.get_limits().unwrap().position_lower[WRIST], goals(&servos)[WRIST]);
    assert!((low + 2.9706).abs() < 1e-3 && high < 300, "near its lower end: {high}");
    goal[WRIST] = low;
    adapter.write_joint_positions(&goal, 1.0).unwrap();
    for _ in 0..30 {
        std::thread::sleep(Duration::from_millis(10));
        positions(&mut adapter);
    }
    // Pushed by 120 counts: in the servo's frame a shift of its offset is the same.
    let offset = |by: i32| {
        let word = (600 + by) as u16;
        servos.with(|servos, _| {
            servos.execute(5, 0x03, &[31, word.to_le_bytes()[0], word.to_le_bytes()[1]], &mut vec![])
        });
    };
    let before = servos.true_positions().unwrap()[WRIST];
    offset(120);
    let mut errors = Vec::new();
    for _ in 0..150 {
        std::thread::sleep(Duration::from_millis(10));
        positions(&mut adapter);
        errors.push(adapter.read_error().unwrap().0);
    }
    let moved = (servos.true_positions().unwrap()[WRIST] - before).abs();
    assert!(moved < 0.8, "driven round by {moved} rad");
    assert!(errors.contains(&SEAM_CROSSED), "{errors:?}");
    let limit =
        |servos: &SerialServer<Servos>| servos.with(|s, _| u16::from_le_bytes([s.byte(WRIST, 48), s.byte(WRIST, 49)]));
    let text = adapter.read_error().unwrap().1;
    assert!(text.starts_with("wrist_roll was turned across the seam of its encoder\nhint: turn it by "), "{text}");
    assert_eq!((goals(&servos)[WRIST], limit(&servos)), (4095 - SEAM_MARGIN as u16, LOW_TORQUE));
    assert!(matches!(adapter.write_joint_positions(&goal, 1.0), Err(AdapterError::Fault { code: SEAM_CROSSED, .. })));
    // Back: it has its own torque again, and a goal on this side.
    offset(0);
    for _ in 0..200 {
        std::thread::sleep(Duration::from_millis(10));
        positions(&mut adapter);
    }
    assert_eq!((adapter.read_error().unwrap().0, limit(&servos)), (0, 1000));
    assert_eq!(i32::from(goals(&servos)[WRIST]), SEAM_MARGIN);
    let rest = (servos.true_positions().unwrap()[WRIST] - before).abs();
    assert!(rest < 0.3, "{rest} rad from where it was");
}
