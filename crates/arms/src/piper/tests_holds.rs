//! Where the arm holds after a stop and when its motors come on, judged by what the emulator received.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use std::time::Duration;

use super::adapter::PiperAdapter;
use super::emulator::PiperEmulator;
use super::protocol::DOF;
use super::tests::{START, activate, at, connected, farthest, pair, read, two, until};
use dimos_core::arm::StopPoint;
use dimos_hardware::adapter::ManipulatorAdapter;
use dimos_hardware::registry::Emulator;
use dimos_hardware::transport::can::{self, CanAddress, CanFrame};

/// Farthest that a target may be from where the arm rests [rad]: the relief.
const RELIEF: f64 = 0.04;

/// The joint targets among the recorded frames [rad].
fn targets(emulator: &PiperEmulator) -> Vec<[f64; DOF]> {
    let trace = emulator.trace();
    let frames: Vec<CanFrame> = trace.iter().map(|(_, f)| *f).filter(|f| (0x155..=0x157).contains(&f.id)).collect();
    let wire = frames.chunks_exact(3).map(|burst| burst.iter().flat_map(two).collect::<Vec<i32>>());
    wire.map(|six| std::array::from_fn(|i| (f64::from(six[i]) / 1000.0).to_radians())).collect()
}

/// Sends the joint positions in place of the emulator, some sets with a wrong angle.
struct Damage {
    ends: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<u32>>,
}

impl Damage {
    /// `how` makes of the angle of `joint` [0.001°] and a random number what the frame says, if that is something else.
    fn begin(
        emulator: &PiperEmulator,
        pose: [f64; DOF],
        joint: usize,
        how: impl Fn(i32, u64) -> Option<i32> + Send + 'static,
    ) -> Self {
        let address = CanAddress::parse(&emulator.address()).unwrap();
        let mut port = can::open("damage", &address, &[can::CanFilter { id: 0, mask: 0x7FF }]).unwrap();
        emulator.mute(Some(0x2A5..=0x2A7));
        let ends = Arc::new(AtomicBool::new(false));
        let ended = ends.clone();
        let thread = std::thread::spawn(move || {
            let (mut seed, mut damaged) = (0x2545_F491_4F6C_DD1D_u64, 0);
            while !ended.load(Relaxed) {
                seed ^= seed << 13;
                seed ^= seed >> 7;
                seed ^= seed << 17;
                let mut wire = pose.map(super::protocol::millidegrees);
                if let Some(wrong) = how(wire[joint], seed) {
                    wire[joint] = wrong;
                    damaged += 1;
                }
                let part = |i: usize| {
                    let ([a, b, c, d], [e, f, g, h]) = (wire[2 * i].to_be_bytes(), wire[2 * i + 1].to_be_bytes());
                    CanFrame::new(0x2A5 + i as u16, &[a, b, c, d, e, f, g, h])
                };
                port.send(&[part(0), part(1), part(2)]).unwrap();
                std::thread::sleep(Duration::from_millis(5));
            }
            damaged
        });
        Self { ends, thread: Some(thread) }
    }

    /// How many sets it has damaged.
    fn end(mut self) -> u32 {
        self.ends.store(true, Relaxed);
        self.thread.take().unwrap().join().unwrap()
    }
}

fn stop_a_standing_arm(how: fn(i32, u64) -> i32) {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    let every_fifth = move |value, seed: u64| seed.is_multiple_of(5).then(|| how(value, seed >> 8));
    let damage = Damage::begin(&emulator, START, 1, every_fifth);
    emulator.record();
    for i in 0..150 {
        let _ = arm.write_stop(&at(&START));
        std::thread::sleep(Duration::from_millis(i % 7));
    }
    let targets = targets(&emulator);
    let off = targets.iter().map(|target| farthest(target, &START)).fold(0.0, f64::max);
    assert!(off < 1e-5, "a stop sent a standing arm {off:.3} rad away");
    assert!(targets.len() >= 140, "{} stops were sent", targets.len());
    assert!(damage.end() >= 10);
    assert!(farthest(&emulator.joints().0, &START) < 1e-3, "it moved");
}

#[test]
fn a_stop_never_moves_a_standing_arm_when_some_frames_are_off_by_60_degrees() {
    stop_a_standing_arm(|value, _| value + 60_000);
}

#[test]
fn a_stop_never_moves_a_standing_arm_when_some_frames_are_random() {
    stop_a_standing_arm(|_, random| (random % 600_000) as i32 - 300_000);
}

/// Sets that agree on a wrong angle, in a row.
fn lying(emulator: &PiperEmulator, joint: usize, by: i32) -> (Damage, Arc<AtomicU32>) {
    let left = Arc::new(AtomicU32::new(0));
    let lies = left.clone();
    let how = move |value: i32, _| {
        let one_less = |left: u32| left.checked_sub(1);
        lies.fetch_update(Relaxed, Relaxed, one_less).is_ok().then_some(value + by)
    };
    (Damage::begin(emulator, START, joint, how), left)
}

#[test]
fn no_target_follows_wrong_positions_that_agree_around_a_stop_a_reset_or_enabling() {
    for (joint, by, before) in [(1, 59_000, 0), (0, -90_000, 20), (4, 59_000, 5), (5, 4_000, 0)] {
        let (emulator, mut arm) = connected();
        activate(&emulator, &mut arm);
        let (damage, left) = lying(&emulator, joint, by);
        std::thread::sleep(Duration::from_millis(50));
        emulator.record();
        for run in [1, 3, 10, u32::MAX] {
            for act in 0..3 {
                left.store(run, Relaxed);
                let end = std::time::Instant::now() + Duration::from_millis(before);
                while std::time::Instant::now() < end {
                    let _ = read(&mut arm);
                }
                let _ = match act {
                    0 => arm.write_stop(&at(&START)).map(drop),
                    1 => arm.write_clear_errors(),
                    _ => arm.write_enable(true),
                };
                left.store(0, Relaxed);
            }
        }
        let targets = targets(&emulator);
        let off = targets.iter().map(|target| farthest(target, &START)).fold(0.0, f64::max);
        assert!(targets.len() >= 8 && off < 1e-5, "joint {}: {off:.3} rad in {} targets", joint + 1, targets.len());
        assert!(damage.end() > 10 && farthest(&emulator.joints().0, &START) < 1e-3);
    }
}

#[test]
fn motors_do_not_come_on_with_a_target_from_wrong_positions() {
    for (run, after) in [(3, 0), (3, 30), (10, 0), (10, 25)] {
        let (emulator, mut arm) = connected();
        let (damage, left) = lying(&emulator, 1, 59_000);
        until("positions", || {
            let _ = read(&mut arm);
            arm.counts().0.sets > 20
        });
        emulator.record();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(after));
                left.store(run, Relaxed);
            });
            let _ = arm.write_enable(true);
        });
        let off = targets(&emulator).iter().map(|target| farthest(target, &START)).fold(0.0, f64::max);
        assert!(off <= RELIEF, "{run} sets after {after} ms: {off:.3} rad");
        damage.end();
    }
}

#[test]
fn an_arm_under_power_that_is_not_where_it_was_commanded_is_refused_with_both_poses() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    let (damage, left) = lying(&emulator, 1, 59_000);
    left.store(u32::MAX, Relaxed);
    let end = std::time::Instant::now() + Duration::from_millis(400);
    while std::time::Instant::now() < end {
        let _ = read(&mut arm);
    }
    emulator.record();
    arm.write_clear_errors().unwrap();
    let refused = arm.write_enable(true).unwrap_err().to_string();
    assert!(refused.starts_with("arm: it reads (5.7, 93.4, -40.1, 2.9, 22.9, -5.7) deg"), "{refused}");
    assert!(refused.contains("was commanded (5.7, 34.4, -40.1, 2.9, 22.9, -5.7) deg last: not enabled\nhint: "));
    assert!(targets(&emulator).is_empty() && emulator.enabled());
    damage.end();
}

#[test]
fn a_stop_keeps_what_was_written_where_the_arm_sags() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    // The target is 0.01 rad above the position that the arm reaches: its second joint is blocked.
    let fault = dimos_hardware::sim::faults::Fault {
        joint: 2,
        ..dimos_hardware::sim::faults::Fault::new(dimos_hardware::sim::faults::FaultKind::Blocked).lasting(60.0)
    };
    emulator.inject(fault).unwrap();
    until("the block", || {
        std::thread::sleep(Duration::from_millis(10));
        true
    });
    let mut wanted = START;
    wanted[1] += 0.01;
    arm.write_joint_positions(&wanted, 1.0).unwrap();
    for above in [0.01, 0.3] {
        wanted[1] = START[1] + above;
        arm.write_joint_positions(&wanted, 1.0).unwrap();
        std::thread::sleep(Duration::from_millis(30));
        emulator.record();
        // Nothing was commanded: nothing is sent.
        arm.write_stop(&StopPoint::default()).unwrap();
        assert_eq!(targets(&emulator), [[0.0; DOF]; 0]);
        arm.write_stop(&at(&wanted)).unwrap();
        until("the hold", || !targets(&emulator).is_empty());
        assert!(farthest(&targets(&emulator)[0], &wanted) < 1e-4, "{above}");
    }
}

/// Joints 2 and 3 rest 0.6° and 0.7° outside their limits.
const OUTSIDE: [f64; DOF] = [0.1, -0.010_472, 0.012_217, 0.05, 0.4, -0.1];

fn outside() -> (PiperEmulator, PiperAdapter) {
    let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "initial_positions": OUTSIDE } }));
    arm.connect().unwrap();
    emulator.record();
    (emulator, arm)
}

/// No target is farther outside than the arm was measured, within the wire's resolution.
fn never_farther_out(emulator: &PiperEmulator) {
    let targets = targets(emulator);
    assert!(!targets.is_empty());
    for target in targets {
        assert!(target[1] >= OUTSIDE[1] - 1e-5 && target[2] <= OUTSIDE[2] + 1e-5, "{target:?}");
    }
}

#[test]
fn an_arm_that_rests_just_outside_its_limits_holds_there_where_its_controller_takes_that() {
    let (emulator, mut arm) = outside();
    emulator.refuse_outside(false);
    arm.activate().unwrap();
    until("the hold", || targets(&emulator).len() == 2);
    assert_eq!(arm.read_error(), Ok((0, String::new())));
    assert!(farthest(&emulator.joints().0, &OUTSIDE) < 1e-3, "it did not move");
    // Commands back are taken, and those farther out are not.
    let mut wanted = OUTSIDE;
    (wanted[1], wanted[2]) = (-0.05, 0.05);
    arm.write_joint_positions(&wanted, 1.0).unwrap();
    arm.write_stop(&StopPoint::default()).unwrap();
    (wanted[1], wanted[2]) = (0.1, -0.1);
    arm.write_joint_positions(&wanted, 1.0).unwrap();
    until("the way back", || farthest(&emulator.joints().0, &wanted) < 1e-3);
    (wanted[1], wanted[2]) = (-0.05, 0.05);
    arm.write_joint_positions(&wanted, 1.0).unwrap();
    until("the limits", || emulator.joints().0[1].abs() < 1e-4 && emulator.joints().0[2].abs() < 1e-4);
    never_farther_out(&emulator);
}

#[test]
fn an_arm_that_rests_just_outside_its_limits_holds_at_them_where_its_controller_refuses_more() {
    let (emulator, mut arm) = outside();
    arm.activate().unwrap();
    assert_eq!((arm.read_enabled(), arm.read_error()), (Ok(true), Ok((0, String::new()))));
    arm.set_control_mode(dimos_core::joint::ControlMode::ServoPosition).unwrap();
    arm.write_joint_positions(&OUTSIDE, 1.0).unwrap();
    arm.write_stop(&StopPoint::default()).unwrap();
    until("the limits", || emulator.joints().0[1].abs() < 1e-4 && emulator.joints().0[2].abs() < 1e-4);
    assert_eq!(arm.read_error(), Ok((0, String::new())), "nothing was refused since");
    never_farther_out(&emulator);
    assert!(!emulator.trace().iter().any(|(_, frame)| frame.id == 0x150));
}

#[test]
fn an_arm_that_rests_far_outside_is_not_drawn_back() {
    let far = [0.1, 0.0, -0.7, 0.05, 0.4, -0.1];
    let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "initial_positions": far } }));
    // Its controller is given the range 4° to 180°.
    super::tests_faults::other(&emulator).send(&[super::golden::frame("474#02070800287FFF00")]).unwrap();
    until("the limit", || {
        arm.connect().unwrap();
        arm.get_limits().unwrap().position_lower[1] > 0.06
    });
    emulator.record();
    let error = arm.activate().unwrap_err().to_string();
    let expected =
        "arm: joint 2 lies 0.070 rad outside its limits, and the controller takes no target there: not enabled";
    assert!(error.starts_with(expected) && error.contains("\nhint: "), "{error}");
    assert!(!emulator.enabled() && !emulator.trace().iter().any(|(_, frame)| frame.id == 0x471));
    assert!(farthest(&emulator.joints().0, &far) < 1e-4);
}
