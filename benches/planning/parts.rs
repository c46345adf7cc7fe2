//! The parts on their own: inverse kinematics of random reachable poses, timing of random paths.

use std::error::Error;
use std::time::Instant;

use dimos::collision::Stop;
use dimos::planning::ik::{Ik, IkSettings};
use dimos::planning::timing::{TimingSettings, time};
use dimos::planning::topp::JointBound;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::model::RobotModel;
use dimos::robot::random::Random;

use crate::quantile;

/// Solves `count` poses of link `tip`, each made from a random configuration, from another random one.
pub fn ik(model: &RobotModel, tip: &str, count: u64, seed: u64) -> Result<(), Box<dyn Error>> {
    let link = model.link_index(tip).ok_or(format!("{} has no link {tip:?}", model.name))?;
    let chain = model.chain(0, link).unwrap_or_default();
    let joints: Vec<usize> = chain.into_iter().filter(|&j| model.joints[j].is_independent()).collect();
    let kinematics = Kinematics::new(model, &joints, &[])?;
    let mut ik = Ik::new(&kinematics, link);
    let mut random = Random::new(seed);
    let mut any = || -> Vec<f64> {
        kinematics.limits().iter().map(|l| random.between(l.lower.max(-3.2), l.upper.min(3.2))).collect()
    };
    let (mut times, mut solved) = (Vec::new(), 0);
    for number in 0..count {
        let (target, near) = (ik.pose(&any()), any());
        let settings = IkSettings { seed: number, ..IkSettings::default() };
        let began = Instant::now();
        let found = ik.solve(&target, &near, &settings, |_| true, &Stop::never());
        times.push(began.elapsed().as_secs_f64() * 1e6);
        solved += u64::from(found.is_ok());
    }
    println!(
        "\nik        {} {tip}, {} joints, to 1 µm and 1 µrad: {solved}/{count} solved ({:.3} %), median {:.1} µs, p95 {:.1} µs, p99 {:.1} µs (goal: ≥ 99.9 %, ≤ 100 µs)",
        model.name,
        kinematics.dof(),
        100.0 * solved as f64 / count as f64,
        quantile(times.clone(), 0.5),
        quantile(times.clone(), 0.95),
        quantile(times, 0.99),
    );
    Ok(())
}

/// Times random paths of 100 waypoints and 7 joints.
pub fn timing(repeats: u64, seed: u64) -> Result<(), Box<dyn Error>> {
    let names: Vec<String> = (0..7).map(|j| format!("joint{j}")).collect();
    for (what, jerk) in [("without jerk limits", f64::INFINITY), ("with jerk limits", 50.0)] {
        let bounds = [JointBound { velocity: 2.0, acceleration: 5.0, jerk }; 7];
        let mut random = Random::new(seed);
        let (mut times, mut durations) = (Vec::new(), Vec::new());
        for _ in 0..repeats {
            let path: Vec<Vec<f64>> = (0..100).map(|_| (0..7).map(|_| random.between(-1.5, 1.5)).collect()).collect();
            let began = Instant::now();
            let timed = time(&names, &path, &bounds, &TimingSettings::default(), |_, _| true)?;
            times.push(began.elapsed().as_secs_f64() * 1e3);
            durations.push(timed.duration);
        }
        println!(
            "timing    100 waypoints, 7 joints, {what}: median {:.2} ms, p95 {:.2} ms; duration {:.1} s (goal: ≤ 1 ms)",
            quantile(times.clone(), 0.5),
            quantile(times, 0.95),
            quantile(durations, 0.5),
        );
    }
    Ok(())
}
