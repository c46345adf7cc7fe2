//! Planning times over a file of problems.
//!
//! `cargo bench --bench planning -- --problems FILE.jsonl --urdf FILE [--srdf FILE] [--package NAME=DIR] [--level
//! fast|certified|exact] [--shapes true|vamp] [--seed N] [--limit N] [--rounds N] [--refine MS | --refine-rounds N]
//! [--paths-only] [--peer PROGRAM [--peer-range RAD]] [--out FILE.json]`; `--ik LINK --urdf FILE` and `--timing` time
//! only these parts.

mod parts;
mod peer;
mod problems;

#[path = "../support/machine.rs"]
#[allow(dead_code, reason = "shared with other benchmarks")]
mod machine;
#[path = "../../tests/support/python.rs"]
#[allow(dead_code, reason = "shared with tests")]
mod python;
#[path = "../../tests/support/skip.rs"]
#[allow(dead_code, reason = "shared with tests")]
mod skip;

use std::error::Error;
use std::hint::black_box;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::{Duration, Instant};

use clap::Parser;
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::planning::search::level::Level;
use dimos::planning::search::path_planner::{Plan, PlanError, plan};
use dimos::planning::search::settings::PlanSettings;
use dimos::planning::timing::settings::TimingSettings;
use dimos::planning::timing::{bounds, time};
use dimos_kernels::Width;
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
    /// How motions are checked
    #[arg(long, default_value = "certified")]
    level: LevelName,
    /// Rounds over all problems; the shortest times of each problem count
    #[arg(long, default_value_t = 1)]
    rounds: usize,
    /// Planner to compare with, built from VAMP: called as `PROGRAM problems.txt REPEATS RANGE out.json` in each round
    #[arg(long, value_name = "PROGRAM")]
    peer: Option<PathBuf>,
    /// Range of the peer's search [rad]
    #[arg(long, value_name = "RAD", default_value_t = 1.0)]
    peer_range: f64,
    /// Geometry of cylinders
    #[arg(long, default_value = "true")]
    shapes: Shapes,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Use only the first N problems
    #[arg(long, value_name = "N")]
    limit: Option<usize>,
    /// Vectors to use, of those that this processor has: avx512, avx2, portable. The paths are the same
    #[arg(long, value_name = "NAME")]
    lanes: Option<String>,
    /// Timeout per problem [s]
    #[arg(long, default_value_t = 10.0)]
    timeout: f64,
    /// Output file
    #[arg(long, value_name = "FILE.json")]
    out: Option<PathBuf>,
    /// Also solve random poses of this link
    #[arg(long, value_name = "LINK")]
    ik: Option<String>,
    /// Refine each path for this long [ms]
    #[arg(long, value_name = "MS", default_value_t = 0)]
    refine: u64,
    /// Refine each path in this number of rounds, as `dimos plan --refine`
    #[arg(long, value_name = "N", default_value_t = 0, conflicts_with = "refine")]
    refine_rounds: u32,
    /// Leave out the timing of the paths
    #[arg(long)]
    paths_only: bool,
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
enum LevelName {
    /// At samples, with covers; nothing is proven.
    Fast,
    /// Searched at samples, then proven free.
    Certified,
    /// Every edge of the search is proven.
    Exact,
}

impl From<LevelName> for Level {
    fn from(name: LevelName) -> Self {
        match name {
            LevelName::Fast => Self::Fast,
            LevelName::Certified => Self::Certified,
            LevelName::Exact => Self::Exact,
        }
    }
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
    /// Processor time of the preparation of the scene: not in the other times.
    setup_us: f64,
    checks: Option<u64>,
    /// Time of one configuration of the path, where none touches.
    check_ns: Option<f64>,
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

impl Row {
    /// Keeps the shorter of the times of two rounds.
    fn keep_shortest(&mut self, again: &Self) {
        self.setup_us = self.setup_us.min(again.setup_us);
        let times = [
            (&mut self.plan_us, again.plan_us),
            (&mut self.simplify_us, again.simplify_us),
            (&mut self.total_us, again.total_us),
            (&mut self.cpu_us, again.cpu_us),
            (&mut self.check_ns, again.check_ns),
        ];
        for (time, again) in times {
            *time = time.zip(again).map(|(a, b)| a.min(b)).or(*time);
        }
    }
}

fn main() -> ExitCode {
    // As a run does.
    dimos::rt::host::keep_freed_memory();
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

/// Uses these vectors, or the widest; prints which, and which were not run.
fn choose_lanes(name: Option<&str>) -> Result<(), String> {
    let usable = Width::usable();
    let found = name.map(|name| usable.iter().find(|width| width.name() == name).ok_or(name)).transpose();
    let chosen = match found {
        Ok(width) => width.copied().unwrap_or_else(Width::widest),
        Err(name) => return Err(format!("this processor has no lanes {name:?}")),
    };
    chosen.prefer();
    let state = |name: &str| match usable.iter().find(|width| width.name() == name) {
        Some(width) if *width == chosen => format!("{name} run"),
        Some(_) => format!("{name} not run (--lanes {name})"),
        None => format!("{name} NOT RUN: this processor has none"),
    };
    println!("lanes     {}\n", ["avx512", "avx2", "portable"].map(state).join(", "));
    Ok(())
}

fn run(arguments: &Arguments) -> Result<(), Box<dyn Error>> {
    machine::print();
    choose_lanes(arguments.lanes.as_deref())?;
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
    let mut arm = Arm::load(urdf, arguments.srdf.as_deref(), packages(&arguments.package)?)?;
    if let Some(tip) = &arguments.ik {
        parts::ik(arm.model(), tip, if arguments.quick { 200 } else { 20_000 }, arguments.seed)?;
    }
    let Some(problems) = &arguments.problems else { return Ok(()) };
    let problems = load(problems, arguments.limit)?;
    if let Some(first) = problems.first() {
        arm.allow_always_touching_pairs(&Arc::new(arm.kinematics(first)?));
    }
    println!("loaded    {} problems and {} in {:.0?}", problems.len(), arm.model().name, began.elapsed());
    let peer = peer::Peer::of(arguments.peer.as_deref(), &problems, arguments.peer_range)?;
    let mut rows: Vec<Row> = Vec::new();
    for round in 0..arguments.rounds.max(1) {
        let again = problems.iter().map(|p| solve(&arm, p, arguments)).collect::<Result<Vec<_>, _>>()?;
        if round == 0 {
            rows = again;
        } else {
            rows.iter_mut().zip(again).for_each(|(row, again)| row.keep_shortest(&again));
        }
        if let Some(peer) = &peer {
            peer.run()?;
        }
    }
    report(&rows, arguments.level);
    match &peer {
        Some(peer) => peer.report(&rows),
        None => println!("peer      SKIPPED: no program of VAMP is given with --peer"),
    }
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
    let cpu = cpu_time();
    let mut checker = ExactChecker::new(scene, CheckSettings::default());
    let setup = cpu_time().saturating_sub(cpu);
    let settings = PlanSettings {
        seed: arguments.seed,
        level: arguments.level.into(),
        refine: if arguments.refine > 0 { u32::MAX } else { arguments.refine_rounds },
        refine_time: Some(arguments.refine).filter(|ms| *ms > 0).map(Duration::from_millis),
        ..PlanSettings::default()
    };
    let (began, cpu) = (Instant::now(), cpu_time());
    let stop = Stop::new(Some(began + Duration::from_secs_f64(arguments.timeout)), None);
    let found = plan(&mut checker, start, &[goal.to_vec()], &settings, &stop);
    let (total, cpu) = (began.elapsed(), cpu_time().saturating_sub(cpu));
    let timeout = matches!(found, Err(PlanError::Timeout(_)));
    let bounds = bounds(kinematics.names(), kinematics.limits())?;
    // As a run does: of the paths of a refinement, that of the quickest motion is executed.
    let quickest = found.as_ref().ok().filter(|_| !arguments.paths_only).cloned().map(|plan| {
        plan.quickest(kinematics.names(), &bounds, &TimingSettings::default(), |a, b| checker.motion_looks_free(a, b)).0
    });
    let mut row = row(problem, found, total, cpu);
    row.setup_us = setup.as_secs_f64() * 1e6;
    row.check_ns = row.path.as_ref().and_then(|path| check_time(&mut checker, path));
    row.late_us = timeout.then_some((total.as_secs_f64() - arguments.timeout) * 1e6);
    if let Some(path) = &quickest {
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

/// Returns the time of one configuration of a path on which nothing is found to touch [ns].
fn check_time(checker: &mut ExactChecker, path: &[Vec<f64>]) -> Option<f64> {
    const REPEATS: usize = 8;
    let (began, before) = (Instant::now(), checker.checks());
    for _ in 0..REPEATS {
        if !path.windows(2).all(|edge| black_box(checker.motion_looks_free(&edge[0], &edge[1]))) {
            return None;
        }
    }
    Some(began.elapsed().as_secs_f64() * 1e9 / (checker.checks() - before).max(1) as f64)
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
            setup_us: 0.0,
            checks: Some(plan.checks),
            check_ns: None,
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
                setup_us: 0.0,
                checks: None,
                check_ns: None,
                timing_us: None,
                why,
                solvable,
                late_us: None,
            }
        }
    }
}

fn report(rows: &[Row], level: LevelName) {
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
    let costs: Vec<f64> = rows.iter().filter_map(|r| r.cost).collect();
    println!("cost, mean over all solved: {:.3} rad", costs.iter().sum::<f64>() / costs.len().max(1) as f64);
    println!(
        "\ntiming, re-checks included: median {:.3} ms, p95 {:.3} ms",
        quantile(timing.clone(), 0.5),
        quantile(timing, 0.95)
    );
    let setup: Vec<f64> = rows.iter().map(|r| r.setup_us / 1e3).collect();
    println!(
        "scene prepared, not in these times: median {:.3} ms, max {:.3} ms",
        quantile(setup.clone(), 0.5),
        quantile(setup, 1.0)
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
    let check = |q| quantile(rows.iter().filter_map(|r| r.check_ns).collect(), q);
    println!(
        "one configuration of a path: median {:.0} ns, p95 {:.0} ns (goal with spheres: ≤ 38 ns with AVX-512, ≤ 68 ns with AVX2)",
        check(0.5),
        check(0.95)
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
