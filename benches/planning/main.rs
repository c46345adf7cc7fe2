//! Planning times over a file of problems.
//!
//! `cargo bench --bench planning -- --problems FILE.jsonl --urdf FILE [--srdf FILE] [--package NAME=DIR]
//! [--level exact] [--shapes true|vamp] [--seed N] [--limit N] [--out FILE.json]`; `--ik LINK --urdf FILE` and
//! `--timing` measure only these parts.

mod parts;
mod problems;

#[path = "../support/machine.rs"]
#[allow(dead_code, reason = "shared with other benchmarks")]
mod machine;
#[path = "../../tests/support/python.rs"]
mod python;
#[path = "../../tests/support/skip.rs"]
#[allow(dead_code, reason = "shared with tests")]
mod skip;

use std::error::Error;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Parser;
use dimos::collision::{CollisionChecker, ExactChecker, Resolution, Stop};
use dimos::planning::path_planner::{Plan, PlanError, PlanSettings, plan};
use dimos::planning::timing::{TimingSettings, bounds, time};
use problems::{Arm, Problem, Shapes, load, packages};
use serde::Serialize;

#[derive(Debug, Parser)]
#[command(name = "planning", about = "Times the planner on a file of problems")]
struct Arguments {
    /// Problems, one JSON record per line
    #[arg(long, value_name = "FILE")]
    problems: Option<PathBuf>,
    /// URDF of the robot
    #[arg(long, value_name = "FILE")]
    urdf: Option<PathBuf>,
    /// SRDF with allowed collision pairs
    #[arg(long, value_name = "FILE")]
    srdf: Option<PathBuf>,
    /// Folder of `package://NAME`
    #[arg(long, value_name = "NAME=DIR")]
    package: Vec<String>,
    /// Collision checker
    #[arg(long, default_value = "exact")]
    level: Level,
    /// Geometry of cylinders
    #[arg(long, default_value = "true")]
    shapes: Shapes,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Use only the first N problems
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Timeout per problem [s]
    #[arg(long, default_value_t = 10.0)]
    timeout: f64,
    /// Output file
    #[arg(long, value_name = "FILE.json")]
    out: Option<PathBuf>,
    /// Also solve random poses of this link
    #[arg(long, value_name = "LINK")]
    ik: Option<String>,
    /// Also time random paths
    #[arg(long)]
    timing: bool,
    /// Passed by cargo
    #[arg(long, hide = true)]
    bench: bool,
    /// Short run, to see that it works (or DIMOS_BENCH_QUICK=1)
    #[arg(long, hide = true)]
    quick: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Level {
    /// Every solid against every other, in double precision, with continuous motion checks.
    Exact,
}

/// Result of one problem; empty fields if not solved.
#[derive(Debug, Serialize)]
struct Row {
    problem: String,
    index: u64,
    solved: bool,
    plan_us: Option<f64>,
    simplify_us: Option<f64>,
    total_us: Option<f64>,
    cost: Option<f64>,
    duration_s: Option<f64>,
    path: Option<Vec<Vec<f64>>>,
    /// Processor time of this thread: `total_us` on an idle machine.
    cpu_us: Option<f64>,
    checks: Option<u64>,
    timing_us: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    why: Option<String>,
    /// Whether start and goal are inside the limits and free for this robot; otherwise there is nothing to solve.
    #[serde(skip)]
    solvable: bool,
    /// Time from the timeout to the planner's return.
    #[serde(skip)]
    late_us: Option<f64>,
}

fn main() -> ExitCode {
    let mut arguments = Arguments::parse();
    arguments.quick |= std::env::var_os("DIMOS_BENCH_QUICK").is_some_and(|v| v == "1");
    match run(&arguments) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    machine::print();
    let nothing = arguments.problems.is_none() && arguments.ik.is_none();
    if arguments.timing || nothing {
        parts::timing(if arguments.quick { 1 } else { 100 }, arguments.seed)?;
    }
    if nothing {
        println!("nothing else to do: --problems FILE.jsonl or --ik LINK, with --urdf FILE");
        return Ok(());
    }
    let urdf = arguments.urdf.as_ref().ok_or("--urdf is needed")?;
    let began = Instant::now();
    let arm = Arm::load(urdf, arguments.srdf.as_deref(), packages(&arguments.package)?)?;
    if let Some(tip) = &arguments.ik {
        parts::ik(arm.model(), tip, if arguments.quick { 200 } else { 20_000 }, arguments.seed)?;
    }
    let Some(problems) = &arguments.problems else { return Ok(()) };
    let problems = load(problems, arguments.limit)?;
    println!("loaded    {} problems and {} in {:.0?}", problems.len(), arm.model().name, began.elapsed());
    let rows = problems.iter().map(|p| solve(&arm, p, arguments)).collect::<Result<Vec<_>, _>>()?;
    report(&rows, &arguments.level);
    if let Some(out) = &arguments.out {
        std::fs::write(out, serde_json::to_string(&serde_json::json!({ "rows": rows }))?)?;
        println!("wrote     {}", out.display());
    }
    Ok(())
}

fn solve(arm: &Arm, problem: &Problem, arguments: &Arguments) -> Result<Row, Box<dyn Error>> {
    let kinematics = Arc::new(arm.kinematics(problem)?);
    let scene = arm.scene(&kinematics, problem, arguments.shapes)?;
    let (start, goal) = problem.ends();
    let (began, cpu) = (Instant::now(), cpu_time());
    let mut checker = ExactChecker::new(scene, Resolution::default());
    let settings = PlanSettings { seed: arguments.seed, ..PlanSettings::default() };
    let stop = Stop::new(Some(began + Duration::from_secs_f64(arguments.timeout)), None);
    let found = plan(&mut checker, start, &[goal.to_vec()], &settings, &stop);
    let (total, cpu) = (began.elapsed(), cpu_time().saturating_sub(cpu));
    let timeout = matches!(found, Err(PlanError::Timeout(_)));
    let mut row = row(problem, found, total, cpu);
    row.late_us = timeout.then_some((total.as_secs_f64() - arguments.timeout) * 1e6);
    if let Some(path) = &row.path {
        let bounds = bounds(kinematics.names(), kinematics.limits())?;
        let free = |a: &[f64], b: &[f64]| checker.motion_is_free(a, b, &Stop::never());
        let began = Instant::now();
        let timed = time(kinematics.names(), path, &bounds, &TimingSettings::default(), free);
        row.timing_us = Some(began.elapsed().as_secs_f64() * 1e6);
        match timed {
            Ok(timed) => row.duration_s = Some(timed.duration),
            Err(error) => eprintln!("{} {}: {error}", row.problem, row.index),
        }
    }
    Ok(row)
}

fn row(problem: &Problem, found: Result<Plan, PlanError>, total: Duration, cpu: Duration) -> Row {
    let us = |d: Duration| d.as_secs_f64() * 1e6;
    let (family, index) = (problem.problem.clone(), problem.index);
    match found {
        Ok(plan) => Row {
            problem: family,
            index,
            solved: true,
            plan_us: Some(us(total.saturating_sub(plan.shorten_time))),
            simplify_us: Some(us(plan.shorten_time)),
            total_us: Some(us(total)),
            cost: Some(plan.length),
            duration_s: None,
            cpu_us: Some(us(cpu)),
            checks: Some(plan.checks),
            timing_us: None,
            path: Some(plan.path),
            why: None,
            solvable: true,
            late_us: None,
        },
        Err(error) => {
            eprintln!("{family} {index}: {error}");
            let solvable = !matches!(error, PlanError::Outside { .. } | PlanError::Collides { .. });
            let why = Some(error.to_string());
            let none = None;
            Row {
                problem: family,
                index,
                solved: false,
                plan_us: none,
                simplify_us: none,
                total_us: none,
                cost: none,
                duration_s: none,
                path: None,
                cpu_us: None,
                checks: None,
                timing_us: None,
                why,
                solvable,
                late_us: None,
            }
        }
    }
}

fn report(rows: &[Row], level: &Level) {
    let mut families: Vec<&str> = rows.iter().map(|r| r.problem.as_str()).collect();
    families.dedup();
    println!(
        "\n{:<20} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>8} {:>8}",
        "family", "solved", "plan", "simplify", "total", "p95", "max", "cost", "duration"
    );
    println!(
        "{:<20} {:>11} {:>9} {:>9} {:>9} {:>9} {:>9} {:>9} {:>8} {:>8}",
        format!("{level:?}").to_lowercase(),
        "of solvable",
        "med ms",
        "med ms",
        "med ms",
        "ms",
        "ms",
        "ms",
        "med rad",
        "med s"
    );
    for family in families.into_iter().chain(["all"]) {
        let own: Vec<&Row> = rows.iter().filter(|r| family == "all" || r.problem == family).collect();
        let of = |f: fn(&Row) -> Option<f64>, q: f64| quantile(own.iter().filter_map(|r| f(r)).collect(), q);
        let solved = own.iter().filter(|r| r.solved).count();
        let solvable = own.iter().filter(|r| r.solvable).count();
        println!(
            "{family:<20} {:>11} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>9.3} {:>8.2} {:>8.2}",
            format!("{solved}/{solvable}/{}", own.len()),
            of(|r| r.plan_us, 0.5) / 1e3,
            of(|r| r.simplify_us, 0.5) / 1e3,
            of(|r| r.total_us, 0.5) / 1e3,
            of(|r| r.total_us, 0.95) / 1e3,
            of(|r| r.total_us, 0.99) / 1e3,
            of(|r| r.total_us, 1.0) / 1e3,
            of(|r| r.cost, 0.5),
            of(|r| r.duration_s, 0.5),
        );
    }
    let cpu = |q| quantile(rows.iter().filter_map(|r| r.cpu_us).collect(), q) / 1e3;
    let timing: Vec<f64> = rows.iter().filter_map(|r| r.timing_us).map(|us| us / 1e3).collect();
    let late: Vec<f64> = rows.iter().filter_map(|r| r.late_us).collect();
    if !late.is_empty() {
        let worst = quantile(late.clone(), 1.0) / 1e3;
        println!("{} ran out of time, and ended at most {worst:.2} ms after that", late.len());
    }
    println!("solved / solvable / all; solvable: start and goal are inside the limits and collision-free");
    println!(
        "\ntiming, re-checks included: median {:.3} ms, p95 {:.3} ms",
        quantile(timing.clone(), 0.5),
        quantile(timing, 0.95)
    );
    let mut checks: Vec<f64> = rows.iter().filter_map(|r| r.checks).map(|n| n as f64).collect();
    checks.sort_by(f64::total_cmp);
    println!(
        "\nprocessor time: median {:.3} ms, p95 {:.3} ms, p99 {:.3} ms, max {:.3} ms; configurations checked: median {:.0}, mean {:.0}",
        cpu(0.5),
        cpu(0.95),
        cpu(0.99),
        cpu(1.0),
        quantile(checks.clone(), 0.5),
        checks.iter().sum::<f64>() / checks.len().max(1) as f64
    );
}

fn quantile(mut values: Vec<f64>, q: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let rank = ((values.len() as f64 * q).ceil() as usize).clamp(1, values.len().max(1));
    values.get(rank - 1).copied().unwrap_or(f64::NAN)
}

fn cpu_time() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}
