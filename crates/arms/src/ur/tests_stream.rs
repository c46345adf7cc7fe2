//! Streams of setpoints, judged by what the program on the emulated controller gave to servoj.

use std::time::{Duration, Instant};

use serde_json::json;

use super::adapter::UrAdapter;
use super::emulator::UrEmulator;
use super::tests::{positions, ready, stream, text, until};
use super::{DOF, SPEC};
use dimos_core::arm::{StopPoint, Topology};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::AdapterConfig;

/// Setpoints that may be withheld because this computer was stalled, of 60 to 300.
const FEW: usize = 6;

/// Largest step of joint 1 between two positions of servoj [rad].
fn largest_step(emulator: &UrEmulator) -> f64 {
    let points = emulator.servoj();
    points.windows(2).map(|pair| (pair[1].1[0] - pair[0].1[0]).abs()).fold(0.0, f64::max)
}

/// Largest change of the velocity of a joint between the positions of servoj [rad/s].
fn largest_change(emulator: &UrEmulator, step: f64) -> f64 {
    let points: Vec<[f64; DOF]> = emulator.servoj().into_iter().map(|(_, point)| point).collect();
    let change = |at: &[[f64; DOF]], i: usize| (at[2][i] - 2.0 * at[1][i] + at[0][i]).abs() / step;
    points.windows(3).flat_map(|at| (0..DOF).map(move |i| change(at, i))).fold(0.0, f64::max)
}

/// Sends a setpoint until the arm is there.
fn reach(adapter: &mut UrAdapter, goal: [f64; DOF]) {
    until(adapter, |adapter| {
        let _ = adapter.write_joint_positions(&goal, 1.0);
        (positions(adapter)[0] - goal[0]).abs() < 1e-3
    });
}

/// Sends a setpoint every `period` that moves joint 1 at `speed` [rad/s], but none for `gap` in the middle. Returns the
/// last one, and how many were refused.
fn with_gap(adapter: &mut UrAdapter, speed: f64, period: Duration, gap: Duration) -> ([f64; DOF], usize) {
    let start = positions(adapter);
    let (mut goal, mut refused, began) = (start, 0, Instant::now());
    let half = Duration::from_millis(300);
    let mut next = began;
    while began.elapsed() < 2 * half + gap {
        let past = next.duration_since(began);
        goal[0] = start[0] + speed * past.as_secs_f64();
        if past < half || past >= half + gap {
            refused += usize::from(adapter.write_joint_positions(&goal, 1.0).is_err());
            positions(adapter);
        }
        next += period;
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    (goal, refused)
}

#[test]
fn after_a_gap_the_arm_catches_up_within_its_speed_limits() {
    for (model, speed, gap) in [("ur5e", 2.5, 20), ("ur5e", 2.0, 50), ("ur5e", 0.5, 40), ("ur10", 1.5, 45)] {
        let (mut adapter, emulator) = ready(json!({"model": model}));
        let (top, step) = (adapter.get_limits().unwrap().velocity_max[0], 1.0 / adapter.get_info().native_rate);
        let (goal, refused) = with_gap(&mut adapter, speed, Duration::from_millis(4), Duration::from_millis(gap));
        assert!(refused < FEW, "{model}: {refused} refused");
        reach(&mut adapter, goal);
        let change = largest_change(&emulator, step);
        assert!(change <= 1.1 * 8.0 * step, "{model} {gap} ms: {change:.4} rad/s within {step} s");
        let largest = largest_step(&emulator);
        assert!(largest <= top * step + 1e-9, "{model} {gap} ms: {:.2} rad/s, limit {top:.2}", largest / step);
        // More than twice the speed where this computer was stalled, too; `script/tests_patterns.rs` has no stalls.
        assert!(largest <= 5.0 * speed * step, "{model} {gap} ms: {:.2} rad/s for {speed} rad/s", largest / step);
    }
}

#[test]
fn a_steady_stream_is_as_fast_as_it_is_commanded() {
    for period in [2, 4, 8, 10] {
        let (mut adapter, emulator) = ready(json!({}));
        let (goal, refused) = with_gap(&mut adapter, 0.5, Duration::from_millis(period), Duration::ZERO);
        assert!(refused < FEW, "{refused} refused");
        reach(&mut adapter, goal);
        let points = emulator.servoj();
        // Over 50 ms: this computer sends some setpoints late.
        let ways = points.windows(26).map(|part| (part[25].1[0] - part[0].1[0]).abs() / 0.05);
        let fastest = ways.fold(0.0, f64::max);
        assert!(fastest < 1.4, "every {period} ms: {fastest:.2} rad/s for 0.5 rad/s");
    }
}

#[test]
fn orders_may_be_answered_some_ticks_later() {
    // A CB3 controller answers 2 to 3 steps of 8 ms later.
    let (mut adapter, emulator) = ready(json!({"model": "ur5"}));
    let (goal, refused) = with_gap(&mut adapter, 0.5, Duration::from_millis(4), Duration::ZERO);
    assert!(refused < FEW, "{refused} setpoints are withheld");
    reach(&mut adapter, goal);
    assert_eq!((adapter.foreign_change(), emulator.program().as_deref()), (None, Some("dimos_control")));
}

/// The stream ends in motion; returns where the arm stopped, and how far the setpoints had come.
fn cut(end: impl FnOnce(&mut UrAdapter)) -> (f64, f64) {
    let (mut adapter, emulator) = ready(json!({}));
    let start = positions(&mut adapter);
    let mut goal = start;
    for i in 1..=60 {
        goal[0] = start[0] + 1.0 * 0.005 * f64::from(i);
        adapter.write_joint_positions(&goal, 1.0).unwrap();
        std::thread::sleep(Duration::from_millis(5));
        positions(&mut adapter);
    }
    end(&mut adapter);
    until(&mut adapter, |adapter| {
        let state = adapter.state().unwrap();
        state.target_velocity[0] == 0.0 && (state.target[0] - state.position[0]).abs() < 1e-4
    });
    let change = largest_change(&emulator, 0.002);
    assert!(change <= 1.1 * 8.0 * 0.002, "{change:.4} rad/s within a step");
    let points = emulator.servoj();
    let last = points[points.len() - 1].1[0] - points[points.len() - 2].1[0];
    assert!(last.abs() < 0.0176 * 0.002, "the last points are {last} rad apart: no deceleration to rest");
    (positions(&mut adapter)[0] - start[0], goal[0] - start[0])
}

#[test]
fn the_end_of_a_stream_in_motion_is_a_deceleration() {
    // Silence; the end of the mode; enabling; disabling; a stop. The arm goes beyond the last setpoint: by 63 mm at
    // 1 rad/s and 8 rad/s².
    let (rest, last) = cut(|_| ());
    assert!(rest > last + 0.03 && rest < last + 0.2, "{rest} and {last} rad");
    cut(|adapter| drop(adapter.set_control_mode(ControlMode::Velocity)));
    // Enabling replaces the program: not in motion.
    cut(|adapter| adapter.activate().unwrap());
    cut(|adapter| adapter.write_enable(false).unwrap());
    cut(|adapter| assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed)));
}

#[test]
fn after_a_gap_a_stream_goes_on_without_enabling() {
    let (mut adapter, emulator) = ready(json!({}));
    let (goal, _) = with_gap(&mut adapter, 1.0, Duration::from_millis(5), Duration::from_millis(150));
    reach(&mut adapter, goal);
    assert_eq!((adapter.foreign_change(), emulator.program().as_deref()), (None, Some("dimos_control")));
    let change = largest_change(&emulator, 0.002);
    assert!(change <= 1.1 * 8.0 * 0.002, "{change:.4} rad/s within a step");
}

#[test]
fn a_reading_has_what_the_controller_commands() {
    let (mut adapter, emulator) = ready(json!({}));
    let goal = stream(&mut adapter, 0.05);
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).unwrap();
    let commanded = reading.commanded.unwrap();
    assert!((commanded.position[0] - goal[0]).abs() < 0.005, "{commanded:?}");
    reach(&mut adapter, goal);
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    let began = Instant::now();
    while began.elapsed() < Duration::from_millis(200) {
        let _ = adapter.write_joint_velocities(&[0.4, 0.0, 0.0, 0.0, 0.0, 0.0]);
        adapter.read_joints(&mut reading).unwrap();
        std::thread::sleep(Duration::from_millis(5));
    }
    let commanded = reading.commanded.unwrap();
    assert!((commanded.velocity[0] - 0.4).abs() < 1e-6, "{commanded:?}");
    assert!(commanded.position[0] > reading.position[0] + 0.005, "it leads: {commanded:?}");
    adapter.write_enable(false).unwrap();
    until(&mut adapter, |adapter| !adapter.read_enabled().unwrap());
    adapter.read_joints(&mut reading).unwrap();
    assert_eq!(reading.commanded, None, "nothing is commanded without power");
    drop(emulator);
}

#[test]
fn wrist_3_of_the_smallest_arms_is_endless() {
    let (mut adapter, _emulator) = ready(json!({
        "model": "ur3e", "sim": {"initial_positions": [0.0, -1.4, 1.5, -1.7, -1.5, 628.0]}
    }));
    let mut goal = positions(&mut adapter);
    assert_eq!(goal[5], 628.0);
    goal[5] += 0.05;
    until(&mut adapter, |adapter| {
        let _ = adapter.write_joint_positions(&goal, 1.0);
        (positions(adapter)[5] - goal[5]).abs() < 1e-3
    });
    for (model, last) in [("ur3", Topology::Endless), ("ur3e", Topology::Endless), ("ur5e", Topology::MultiTurn)] {
        let options = json!({"model": model});
        let config = AdapterConfig { hardware_id: "arm".into(), address: "127.0.0.1".into(), dof: DOF, options };
        let topology = (SPEC.check)(&config).unwrap().topology;
        assert_eq!((topology[4], topology[5]), (Topology::MultiTurn, last), "{model}");
    }
}

#[test]
fn setpoints_accelerate_no_faster_than_the_arm_decelerates() {
    for (deceleration, acceleration) in [(1.0, 1.0), (8.0, 8.0), (20.0, 8.0)] {
        let (mut adapter, _emulator) = ready(json!({"stop_deceleration": deceleration}));
        assert_eq!(adapter.get_limits().unwrap().acceleration_max, [acceleration; DOF]);
    }
}

#[test]
fn a_setpoint_far_away_ends_the_program() {
    let (mut adapter, emulator) = ready(json!({}));
    let start = positions(&mut adapter);
    let mut goal = start;
    goal[1] += 1.5;
    adapter.write_joint_positions(&goal, 1.0).unwrap();
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    let what = adapter.foreign_change().unwrap();
    assert!(what.contains("a setpoint was farther away than the arm moves in 0.2 s"), "{what}");
    until(&mut adapter, |_| emulator.program().is_none());
    assert!((positions(&mut adapter)[1] - start[1]).abs() < 1e-3, "it has not moved");
}

#[test]
fn a_long_stop_is_no_program_that_hangs() {
    let (mut adapter, emulator) = ready(json!({"stop_deceleration": 1.0}));
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    for _ in 0..320 {
        adapter.write_joint_velocities(&[1.4, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        std::thread::sleep(Duration::from_millis(5));
        positions(&mut adapter);
    }
    // No more velocities: the program decelerates for more than a second.
    let began = Instant::now();
    until(&mut adapter, |adapter| adapter.state().unwrap().velocity[0].abs() < 0.01);
    assert!(began.elapsed() > Duration::from_secs(1), "{:?}", began.elapsed());
    std::thread::sleep(Duration::from_millis(20));
    until(&mut adapter, |adapter| adapter.write_joint_velocities(&[0.0; DOF]).is_ok());
    assert_eq!((adapter.foreign_change(), emulator.program().as_deref()), (None, Some("dimos_control")));
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
}

#[test]
fn a_program_that_hangs_or_is_refused_is_reported() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.hang_program(true);
    let here = positions(&mut adapter);
    adapter.write_joint_positions(&here, 1.0).unwrap();
    std::thread::sleep(Duration::from_millis(80));
    assert_eq!(adapter.write_joint_positions(&here, 1.0), Err(AdapterError::Busy), "nothing more behind a silence");
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    assert!(adapter.foreign_change().unwrap().contains("does not answer"));
    // A stop is not confirmed by a program that hangs, but by the dashboard.
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert_eq!(emulator.program(), None);
    emulator.hang_program(false);
    emulator.refuse_programs(true);
    let refused = text(adapter.activate().unwrap_err());
    assert!(refused.starts_with("the controller refuses the program of dimos: line 1: compile_error"), "{refused}");
}

/// A program of another client: up to this speed within 0.5 s, along there, then the same point repeatedly.
fn ends_at_speed(speed: f64) -> String {
    format!(
        "def dimos_control():\n  q = get_target_joint_positions()\n  v = 0.0\n  i = 0\n  while i < 500:\n    if i < 250:\n      \
         v = v + {}\n    elif i > 300:\n      v = 0.0\n    end\n    q[0] = q[0] + v * 0.002\n    servoj(q, 0, 0, 0.002, 0.05, \
         500)\n    i = i + 1\n  end\n  stopj(8)\nend\n",
        speed / 250.0
    )
}

/// The emulated controller refuses it: no stream of this adapter's may end like that.
#[test]
fn points_that_end_at_speed_are_c204a3() {
    for (speed, stops) in [(1.5, true), (0.8, false)] {
        let (mut adapter, emulator) = ready(json!({}));
        let mut primary = std::net::TcpStream::connect(emulator.primary()).unwrap();
        std::io::Write::write_all(&mut primary, ends_at_speed(speed).as_bytes()).unwrap();
        let began = Instant::now();
        let stopped = |adapter: &mut UrAdapter| adapter.read_error().unwrap().0 != 0;
        until(&mut adapter, |adapter| stopped(adapter) || began.elapsed() > Duration::from_millis(1500));
        let (code, what) = adapter.read_error().unwrap();
        assert_eq!((code, what.contains("C204A3")), if stops { (204, true) } else { (0, false) }, "{speed}: {what}");
    }
}
