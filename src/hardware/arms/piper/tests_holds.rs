//! Where the arm holds after a stop and when its motors come on, judged by what the emulator received.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use super::adapter::PiperAdapter;
use super::emulator::PiperEmulator;
use super::protocol::DOF;
use super::tests::{START, activate, connected, farthest, pair, two, until};
use crate::arm::StopPoint;
use crate::hardware::adapter::ManipulatorAdapter;
use crate::hardware::registry::Emulator;
use crate::hardware::transport::can::{self, CanAddress, CanFrame};

/// Farthest that a hold may be from where the arm is [rad].
const WINDOW: f64 = 0.02;

/// The joint targets among the recorded frames [rad].
fn targets(emulator: &PiperEmulator) -> Vec<[f64; DOF]> {
    let trace = emulator.trace();
    let frames: Vec<CanFrame> = trace.iter().map(|(_, f)| *f).filter(|f| (0x155..=0x157).contains(&f.id)).collect();
    let wire = frames.chunks_exact(3).map(|burst| burst.iter().flat_map(two).collect::<Vec<i32>>());
    wire.map(|six| std::array::from_fn(|i| (f64::from(six[i]) / 1000.0).to_radians())).collect()
}

/// Sends the joint positions in place of the emulator, every fifth set with a damaged first frame.
struct Damage {
    ends: Arc<AtomicBool>,
    thread: Option<std::thread::JoinHandle<u32>>,
}

impl Damage {
    /// `how` makes of the second joint's angle [0.001°] and a random number what the damaged frame says.
    fn begin(emulator: &PiperEmulator, pose: [f64; DOF], how: fn(i32, u64) -> i32) -> Self {
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
                if seed % 5 == 0 {
                    wire[1] = how(wire[1], seed >> 8);
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
    let damage = Damage::begin(&emulator, START, how);
    emulator.record();
    for i in 0..150 {
        let _ = arm.write_stop(&StopPoint::default());
        std::thread::sleep(Duration::from_millis(i % 7));
    }
    let targets = targets(&emulator);
    let off = targets.iter().map(|target| farthest(target, &START)).fold(0.0, f64::max);
    assert!(
        off <= WINDOW,
        "a stop sent a standing arm {off:.3} rad away, in {} of {} stops",
        targets.iter().filter(|target| farthest(*target, &START) > WINDOW).count(),
        targets.len()
    );
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

#[test]
fn a_stop_keeps_what_was_written_where_the_arm_sags() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    // The target is 0.01 rad above the position that the arm reaches: its second joint is blocked.
    let fault = crate::hardware::sim::faults::Fault {
        joint: 2,
        ..crate::hardware::sim::faults::Fault::new(crate::hardware::sim::faults::FaultKind::Blocked).lasting(60.0)
    };
    emulator.inject(fault).unwrap();
    until("the block", || {
        std::thread::sleep(Duration::from_millis(10));
        true
    });
    let mut wanted = START;
    wanted[1] += 0.01;
    arm.write_joint_positions(&wanted, 1.0).unwrap();
    for (above, expected) in [(0.01, 0.01), (0.3, WINDOW)] {
        wanted[1] = START[1] + above;
        arm.write_joint_positions(&wanted, 1.0).unwrap();
        std::thread::sleep(Duration::from_millis(30));
        emulator.record();
        arm.write_stop(&StopPoint::default()).unwrap();
        until("the hold", || !targets(&emulator).is_empty());
        let held = targets(&emulator)[0];
        assert!((held[1] - START[1] - expected).abs() < 1e-4, "{above}: {} rad", held[1] - START[1]);
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
    arm.set_control_mode(crate::joint::ControlMode::ServoPosition).unwrap();
    arm.write_joint_positions(&OUTSIDE, 1.0).unwrap();
    arm.write_stop(&StopPoint::default()).unwrap();
    until("the limits", || emulator.joints().0[1].abs() < 1e-4 && emulator.joints().0[2].abs() < 1e-4);
    assert_eq!(arm.read_error(), Ok((0, String::new())), "nothing was refused since");
    never_farther_out(&emulator);
    assert!(!emulator.trace().iter().any(|(_, frame)| frame.id == 0x150));
}

#[test]
fn an_arm_that_rests_far_outside_is_not_drawn_back() {
    let far = [0.1, -0.04, -0.7, 0.05, 0.4, -0.1];
    let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "initial_positions": far } }));
    arm.connect().unwrap();
    emulator.record();
    let error = arm.activate().unwrap_err().to_string();
    let expected =
        "arm: joint 2 lies 0.040 rad outside its limits, and the controller takes no target there: not enabled";
    assert!(error.starts_with(expected) && error.contains("\nhint: "), "{error}");
    assert!(!emulator.enabled() && !emulator.trace().iter().any(|(_, frame)| frame.id == 0x471));
    assert!(farthest(&emulator.joints().0, &far) < 1e-4);
}
