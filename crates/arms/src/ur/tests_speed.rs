//! A controller that runs motion at a fraction of its speed: its slider, the limits of its safety system.

use std::time::{Duration, Instant};

use serde_json::json;

use super::tests::{positions, ready, until};
use dimos_core::arm::StopPoint;
use dimos_hardware::adapter::{JointReading, ManipulatorAdapter, Stop};

/// Sends a setpoint every 10 ms that moves joint 1 by `speed` [rad/s] for this time; returns how many were refused.
fn stream(adapter: &mut super::adapter::UrAdapter, goal: &mut [f64; super::DOF], speed: f64, time: Duration) -> u32 {
    let (mut refused, began) = (0, Instant::now());
    while began.elapsed() < time {
        goal[0] += 0.01 * speed;
        refused += u32::from(adapter.write_joint_positions(goal, 1.0).is_err());
        std::thread::sleep(Duration::from_millis(10));
        positions(adapter);
    }
    refused
}

fn fraction(adapter: &mut super::adapter::UrAdapter) -> Option<f64> {
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).unwrap();
    reading.speed_fraction
}

#[test]
fn the_slider_and_the_limits_together_are_the_fraction_and_no_setpoint_is_refused() {
    let (mut adapter, emulator) = ready(json!({"sim": {"speed_slider": 0.6}}));
    let (mut goal, second) = (positions(&mut adapter), Duration::from_secs(1));
    let start = goal[0];
    for (slider, scaling) in [(0.6, 1.0), (0.6, 0.5), (0.02, 1.0), (0.0, 1.0), (1.0, 1.0)] {
        emulator.set_slider(slider);
        emulator.set_scaling(scaling);
        let both = slider * scaling;
        until(&mut adapter, |adapter| fraction(adapter) == Some(both));
        let refused = stream(&mut adapter, &mut goal, 0.3 * both, second);
        assert!(refused <= 3, "{refused} refused at {slider} and {scaling}");
        assert_eq!(adapter.foreign_change(), None, "at {slider} and {scaling}");
    }
    until(&mut adapter, |adapter| (positions(adapter)[0] - goal[0]).abs() < 1e-3);
    assert!(goal[0] - start > 0.4 && emulator.program().as_deref() == Some("dimos_control"));
}

#[test]
fn a_step_of_servoj_takes_longer_by_the_fraction() {
    let (mut adapter, emulator) = ready(json!({}));
    let mut goal = positions(&mut adapter);
    stream(&mut adapter, &mut goal, 0.1, Duration::from_millis(200));
    emulator.set_slider(0.25);
    let (before, began) = (emulator.servoj().len(), Instant::now());
    stream(&mut adapter, &mut goal, 0.025, Duration::from_secs(1));
    let steps = (emulator.servoj().len() - before) as f64 / began.elapsed().as_secs_f64();
    assert!((100.0..140.0).contains(&steps), "{steps} points of servoj in a second");
}

#[test]
fn a_stop_of_a_controller_that_waits_is_confirmed() {
    let stop = |slider: f64, scaling: f64| {
        let (mut adapter, emulator) = ready(json!({}));
        let mut goal = positions(&mut adapter);
        stream(&mut adapter, &mut goal, 0.3, Duration::from_millis(300));
        emulator.set_slider(slider);
        emulator.set_scaling(scaling);
        until(&mut adapter, |adapter| fraction(adapter) == Some(slider * scaling));
        let began = Instant::now();
        assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed), "at {slider}, {scaling}");
        let took = began.elapsed();
        until(&mut adapter, |_| emulator.program().is_none());
        // Without a program, the factor of the trajectory limiter is 0.
        until(&mut adapter, |adapter| adapter.state().unwrap().scaling == 0.0);
        assert_eq!(fraction(&mut adapter), Some(slider));
        took
    };
    for slider in [0.3, 0.01, 0.0] {
        stop(slider, 1.0);
    }
    // The program's answer, which cannot come, is not waited for; a busy computer may take that long once.
    assert!((0..3).any(|_| stop(1.0, 0.0) < super::motion::STOP_LIMIT));
}
