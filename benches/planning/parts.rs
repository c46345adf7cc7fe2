//! Parts of the planner: inverse kinematics of random reachable poses, time parameterization of random paths.

use std::error::Error;
use std::time::Instant;

use dimos::collision::Stop;
use dimos::joint::JointBounds;
use dimos::planning::ik::Ik;
use dimos::planning::ik::settings::IkSettings;
use dimos::planning::timing::settings::TimingSettings;
use dimos::planning::timing::time;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::model::RobotModel;
use dimos::robot::random::Random;

use crate::python::ask_python;
use crate::{cpu_time, quantile};

/// Solves `count` poses of link `tip`, each from a random configuration, starting at another one.
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
        "\nik        {} {tip}, {} joints, to 1 µm and 1 µrad: {solved}/{count} solved ({:.3} %), median {:.1} µs, p95 {:.1} µs, p99 {:.1} µs (goal: ≥ 99.95 %, median ≤ 5 µs, p95 ≤ 10 µs)",
        model.name,
        kinematics.dof(),
        100.0 * solved as f64 / count as f64,
        quantile(times.clone(), 0.5),
        quantile(times.clone(), 0.95),
        quantile(times, 0.99),
    );
    Ok(())
}

/// Times random paths of 100 waypoints and 7 joints, also with toppra if it is installed.
pub fn timing(repeats: u64, seed: u64) -> Result<(), Box<dyn Error>> {
    const VELOCITY: f64 = 2.0;
    const ACCELERATION: f64 = 5.0;
    let names: Vec<String> = (0..7).map(|j| format!("joint{j}")).collect();
    let mut random = Random::new(seed);
    let mut point = || (0..7).map(|_| random.between(-1.5, 1.5)).collect::<Vec<f64>>();
    let paths: Vec<Vec<Vec<f64>>> = (0..repeats).map(|_| (0..100).map(|_| point()).collect()).collect();
    let cases = [
        ("no jerk limits", f64::INFINITY, 0.05, ", goal ≤ 17 µs"),
        ("jerk ≤ 50 rad/s³", 50.0, 0.05, ", goal ≤ 70 µs"),
        ("no jerk limits, corners within 1 mrad", f64::INFINITY, 1e-3, ""),
        ("jerk ≤ 50 rad/s³, corners within 1 mrad", 50.0, 1e-3, ""),
    ];
    let mut quickest = Vec::new();
    for (what, jerk, deviation, goal) in cases {
        let bounds = [JointBounds { velocity: VELOCITY, acceleration: ACCELERATION, jerk, ..JointBounds::NONE }; 7];
        let settings = TimingSettings { deviation, ..TimingSettings::default() };
        let (mut times, mut cpu, mut durations) = (Vec::new(), Vec::new(), Vec::new());
        for path in &paths {
            let (began, cpu_began) = (Instant::now(), cpu_time());
            let timed = time(&names, path, &bounds, &settings, |_, _| true)?;
            times.push(began.elapsed().as_secs_f64() * 1e6);
            cpu.push((cpu_time() - cpu_began).as_secs_f64() * 1e6);
            durations.push(timed.duration);
        }
        if jerk.is_infinite() {
            quickest.clone_from(&durations);
        }
        // No motion with a jerk limit is quicker than the time-optimum without.
        let ratios = durations.iter().zip(&quickest).map(|(own, least)| own / least).collect();
        println!(
            "timing    100 waypoints, 7 joints, {what}: median {:.0} µs (of the processor {:.0} µs{goal}), p95 {:.0} µs; motion {:.1} s, {:.3}x of that without jerk limits",
            quantile(times.clone(), 0.5),
            quantile(cpu, 0.5),
            quantile(times, 0.95),
            quantile(durations, 0.5),
            quantile(ratios, 0.5),
        );
    }
    let few = &paths[..paths.len().min(20)];
    let question = serde_json::json!({ "paths": few, "velocity": VELOCITY, "acceleration": ACCELERATION });
    if let Some(answer) = ask_python("timing_speed.py", "toppra", &question) {
        let of = |key: &str| -> Vec<f64> {
            answer[key].as_array().into_iter().flatten().filter_map(serde_json::Value::as_f64).collect()
        };
        println!(
            "peer      toppra {} (Python), the same waypoints as a spline, a grid point each, no jerk limits: median {:.1} ms; motion {:.1} s",
            answer["version"].as_str().unwrap_or_default(),
            quantile(of("times"), 0.5) * 1e3,
            quantile(of("durations"), 0.5),
        );
    }
    Ok(())
}
