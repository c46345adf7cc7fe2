//! Whatever ends a motion, the arm decelerates along its path: a trajectory along its curve, a stream along the line on
//! which it was, with all joints together.

use dimos::control::config::{ServoParams, TaskKind};
use dimos::control::request::Request;
use dimos::telemetry::{Outcome, Phase};

use super::support::rig::*;

/// Starts a curve through points that no straight line connects, and runs on it for a while [s].
fn on_a_curve(seconds: f64) -> Rig {
    let mut rig = Rig::one_arm(one(trajectory()));
    let joints: Vec<u16> = (0..6).collect();
    let there = [0.5, 0.05, 0.0, 0.1, 0.0, 0.3];
    let goal = [0.6, 0.6, -0.5, 0.0, 0.4, 0.0];
    let curve = motion(1, &joints, &[(0.0, &[0.0; 6]), (0.8, &there), (1.8, &goal)]);
    assert_eq!(rig.execute(0, curve), Outcome::Accepted);
    rig.run_for(seconds);
    rig
}

/// Distance of a pose from a polyline [rad].
fn distance(path: &[Vec<f64>], q: &[f64]) -> f64 {
    let of = |ends: &[Vec<f64>]| {
        let line: Vec<f64> = ends[1].iter().zip(&ends[0]).map(|(b, a)| b - a).collect();
        let length = line.iter().map(|d| d * d).sum::<f64>().max(1e-18);
        let along: f64 = q.iter().zip(&ends[0]).zip(&line).map(|((q, a), d)| (q - a) * d).sum::<f64>() / length;
        let along = along.clamp(0.0, 1.0);
        let off = q.iter().zip(&ends[0]).zip(&line).map(|((q, a), d)| (q - a - along * d).powi(2));
        off.sum::<f64>().sqrt()
    };
    path.windows(2).map(of).fold(f64::INFINITY, f64::min)
}

#[test]
fn a_curve_is_not_left_by_a_stop_a_cancel_or_a_pause() {
    let mut whole = on_a_curve(0.0);
    let mut path = vec![vec![0.0; 6], whole.commanded(0)];
    for _ in 0..250 {
        whole.tick();
        path.push(whole.commanded(0));
    }
    for request in [Request::Stop { arm: None }, Request::Cancel { task: None }, Request::Pause { on: true }] {
        let mut rig = on_a_curve(0.7);
        let (mut last, what) = (rig.commanded(0), format!("{request:?}"));
        rig.ask(request);
        let mut ticks = 0;
        loop {
            let now = rig.commanded(0);
            let off = distance(&path, &now);
            assert!(off < 1e-3, "{what}: {off} rad off the path after {ticks} ticks");
            if now == last {
                break;
            }
            last = now;
            rig.tick();
            ticks += 1;
            assert!(ticks < 200, "{what}");
        }
        assert!((10..100).contains(&ticks), "{what}: {ticks} ticks");
    }
}

#[test]
fn a_stream_ends_on_its_line_by_a_stop_or_a_cancel() {
    for end in [Request::Stop { arm: None }, Request::Cancel { task: None }] {
        let what = format!("{end:?}");
        let mut rig = Rig::one_arm(one(TaskKind::new("servo", &ServoParams::default())));
        let speeds = [1.0, 0.1, -0.5, 0.3, 0.0, -0.9];
        for k in 1..=60 {
            rig.servo(0, &speeds.map(|v| v * 0.01 * f64::from(k)));
            rig.tick();
        }
        let (from, speed) = (rig.commanded(0), rig.commands[0].velocity);
        rig.ask(end);
        for _ in 0..150 {
            rig.tick();
            let q = rig.commanded(0);
            for j in 1..6 {
                let off = (q[j] - from[j]) - (q[0] - from[0]) * speed[j] / speed[0];
                assert!(off.abs() < 2e-3, "{what}: joint {j} is {off} rad off the line");
            }
        }
        assert!(rig.commanded(0)[0] > from[0] + 0.05, "{what}: it decelerates");
        assert!(matches!(rig.phase(0), Phase::Ready | Phase::Held));
    }
}

/// By the adapter, or by the last check before the wire.
#[test]
fn a_refused_setpoint_stops_the_arm() {
    let mut rig = on_a_curve(0.5);
    rig.arms[0].deaf = true;
    for _ in 0..4 {
        rig.tick();
        rig.arms[0].state.refused = rig.commands[0].seq;
    }
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "setpoint_refused"));
    rig.arms[0].deaf = false;
    let (written, stops) = (rig.arms[0].written.clone().unwrap(), rig.arms[0].stops);
    rig.run_for(2.0);
    assert_eq!((rig.phase(0), rig.arms[0].written.clone().unwrap()), (Phase::Held, written), "nothing resumes");
    assert!(rig.arms[0].stops > 0, "{stops}");
}
