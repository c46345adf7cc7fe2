//! The program for aarch64, run by an emulator of that processor (`make test-arm64`): what it prints, plans and
//! commands is equal in every bit to what the program under test does. Another compiler made it, with another C
//! library.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use dimos::rpc::api::{Plan, PlanGoal, Planning, Preview};
use dimos::rpc::client::Client;
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::program::{Ended, Home, Started, TIMEOUT, UP};
use crate::support::skip::{skip, skip_optional};

/// Plans of all arms together; `DIMOS_PLANS=1000` is what the figures are about.
const PLANS: usize = 20;
/// Blueprints with a planner, and the models of their arms.
const ARMS: [(&str, &str); 6] = [
    ("xarm6-planner", "xarm6"),
    ("xarm7-planner", "xarm7"),
    ("ur5e-planner", "ur5e"),
    ("fr3-planner", "fr3"),
    ("piper-planner", "piper"),
    ("yourarm-planner", "yourarm"),
];

/// The program of one machine, and a home for its runs.
struct Machine {
    home: Home,
    program: PathBuf,
}

/// This machine and the emulated one. Nothing where that is missing. `DIMOS_HERE` and `DIMOS_AARCH64` name other
/// programs of theirs.
fn machines() -> Option<[Machine; 2]> {
    let tested = PathBuf::from(env!("CARGO_BIN_EXE_dimos"));
    let built = tested.ancestors().nth(2).unwrap().join("cross/dimos-aarch64");
    let ours = std::env::var_os("DIMOS_HERE").map_or(tested, PathBuf::from);
    let theirs = std::env::var_os("DIMOS_AARCH64").map_or(built, PathBuf::from);
    if !theirs.exists() {
        skip_optional("dimos for aarch64 (make test-arm64)");
        return None;
    }
    Some([ours, theirs].map(|program| Machine { home: Home::new(), program }))
}

impl Machine {
    fn start(&self, arguments: &str) -> Started {
        let mut command = Command::new(&self.program);
        Started::of(self.home.settle(command.args(arguments.split_whitespace())).stdin(Stdio::null()))
    }

    /// `dimos run …`, when it is up.
    #[track_caller]
    fn run(&self, arguments: &str) -> Started {
        let run = self.start(&format!("run --no-view {arguments}"));
        run.until(UP);
        run
    }

    fn dimos(&self, arguments: &str) -> Ended {
        self.start(arguments).wait()
    }
}

/// Numbers of 0 to 1 that are the same on every machine.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn within(&mut self, lower: f64, upper: f64) -> f64 {
        lower + (upper - lower) * self.next()
    }
}

/// Limits of the joints of a built-in model [rad].
fn limits(machine: &Machine, model: &str) -> Vec<(f64, f64)> {
    let info = machine.dimos(&format!("model info builtin:{model} --json")).with(0).json();
    let joints = info["joints"].as_array().unwrap().iter().filter(|joint| joint["type"] == "revolute");
    joints.map(|joint| (joint["lower"].as_f64().unwrap(), joint["upper"].as_f64().unwrap())).collect()
}

/// A request: joints, a position, a pose, or two waypoints that are passed.
fn request(numbers: &mut Numbers, limits: &[(f64, f64)], index: usize) -> Plan {
    let goal = |value: Value| -> PlanGoal { serde_json::from_value(value).unwrap() };
    let mut joints = || {
        let q: Vec<f64> = limits.iter().map(|(lower, upper)| numbers.within(0.7 * lower, 0.7 * upper)).collect();
        goal(json!({"robot": "arm", "joints": q}))
    };
    let (through, last) = match index % 4 {
        0 => (vec![joints()], joints()),
        1 => (Vec::new(), joints()),
        kind => {
            let (angle, radius) = (numbers.within(-1.5, 1.5), numbers.within(0.25, 0.45));
            let mut pose = json!({"xyz": [radius * angle.cos(), radius * angle.sin(), numbers.within(0.15, 0.5)]});
            if kind == 3 {
                pose["rpy"] = json!([3.1, numbers.within(-0.3, 0.3), numbers.within(-1.0, 1.0)]);
            }
            (Vec::new(), goal(json!({"robot": "arm", "pose": pose})))
        }
    };
    let blend = if through.is_empty() { 0.0 } else { 0.02 };
    // No time limit that only the emulated machine reaches.
    Plan { goals: vec![last], through, blend, seed: index as u64, timeout: Some(600.0), ..Plan::default() }
}

/// What a run plans: the whole motion at 100 Hz, or why there is none; without what is measured.
fn planned(client: &mut Client, plan: &Plan) -> (bool, String) {
    let number = client.call(plan.clone()).unwrap().plan;
    let began = Instant::now();
    let report = loop {
        let report = client.call(Planning { plan: number }).unwrap();
        if report.state != "PLANNING" {
            break report;
        }
        assert!(began.elapsed() < 4 * TIMEOUT, "{report:?}");
        std::thread::sleep(Duration::from_millis(3));
    };
    if report.state != "PLANNED" {
        return (false, format!("{}: {:?}", report.state, report.error));
    }
    let mut preview =
        serde_json::to_value(client.call(Preview { plan: Some(number), hz: Some(100.0) }).unwrap()).unwrap();
    preview["summary"]["times"].take();
    (true, preview.to_string())
}

#[test]
fn seeded_plans_are_equal_in_every_bit() {
    let Some(machines) = machines() else { return };
    let all = std::env::var("DIMOS_PLANS").map_or(PLANS, |count| count.parse().unwrap());
    let (mut found, mut different) = (0, Vec::new());
    for (number, (blueprint, model)) in ARMS.into_iter().enumerate() {
        let limits = limits(&machines[0], model);
        let runs = machines.each_ref().map(|machine| machine.run(&format!("{blueprint} --no-record")));
        let mut clients = machines.each_ref().map(|machine| machine.home.client());
        let mut numbers = Numbers(0x9E37_79B9_7F4A_7C15 + number as u64);
        for index in (number..all).step_by(ARMS.len()) {
            let plan = request(&mut numbers, &limits, index / ARMS.len());
            let [ours, theirs] = clients.each_mut().map(|client| planned(client, &plan));
            found += usize::from(ours.0);
            if ours != theirs {
                different.push(format!(
                    "{blueprint}, {index}: {}\n{}\n{}",
                    serde_json::to_string(&plan).unwrap(),
                    ours.1,
                    theirs.1
                ));
            }
        }
        runs.into_iter().for_each(|run| {
            run.end(Signal::TERM).with(143);
        });
    }
    println!("{found} of {all} requests have a plan; {} differ", different.len());
    assert!(2 * found > all, "{found} of {all} requests have a plan");
    assert!(different.is_empty(), "{} differ; the first: {:.4000}", different.len(), different[0]);
}

#[test]
fn checks_models_and_kinematics_print_the_same() {
    let Some(machines) = machines() else { return };
    let mut numbers = Numbers(7);
    let same = |arguments: &str, stdin: Option<&str>| {
        let [ours, theirs] = machines.each_ref().map(|machine| {
            let mut command = Command::new(&machine.program);
            let command = machine.home.settle(command.args(arguments.split_whitespace()));
            machine.home.write("stdin", stdin.unwrap_or_default());
            let input = std::fs::File::open(machine.home.path().join("stdin")).unwrap();
            let ended = Started::of(command.stdin(input)).wait();
            let at = machine.home.path().display().to_string();
            (ended.code, ended.out.replace(&at, ""), ended.err.replace(&at, ""))
        });
        assert_eq!(ours, theirs, "{arguments}");
        assert!(ours.0 == Some(0) && !ours.1.is_empty(), "{arguments}: {ours:?}");
        ours.1
    };
    for (blueprint, model) in ARMS {
        same(&format!("check {blueprint}"), None);
        same(&format!("model info builtin:{model} --json"), None);
        let limits = limits(&machines[0], model);
        let line = |numbers: &mut Numbers| {
            limits.iter().map(|(lower, upper)| format!("{} ", numbers.within(*lower, *upper))).collect::<String>()
                + "\n"
        };
        let configurations: String = (0..500).map(|_| line(&mut numbers)).collect();
        let poses = same(&format!("model fk builtin:{model} --stdin"), Some(&configurations));
        for pose in poses.lines().step_by(100) {
            let p: Vec<&str> = pose.split_whitespace().collect();
            same(
                &format!("model ik builtin:{model} --pose {} --quat {} --json", p[..3].join(" "), p[3..].join(" ")),
                None,
            );
        }
    }
}

#[test]
fn logs_verify_on_the_other_machine() {
    let Some(machines) = machines() else { return };
    let streams = "include: [yourarm-planner]\ntasks:\n  - {name: pose_arm, type: cartesian_ik, joint_names: {hardware: arm}, priority: 30}\n";
    for machine in &machines {
        machine.home.write("streams.yaml", streams);
        let run = machine.run("streams.yaml --record log.mcap");
        let began = Instant::now();
        machine.dimos("move arm --pose 0.35 0.1 0.3 --rpy 3.14 0 0").with(0);
        machine.dimos("move arm 0.3 -0.2 0.5 0 0.4 0 --direct").with(0);
        machine.home.write("poses", "0.35 0.1 0.35 3.14 0 0\n0.35 0.05 0.3 3.14 0.1 0\n");
        let mut stream = Command::new(&machine.program);
        let stream = machine.home.settle(stream.args(["task", "stream", "pose_arm", "poses", "--hz", "1"]));
        Started::of(stream.stdin(Stdio::null())).wait().with(0);
        std::thread::sleep(Duration::from_secs(10).saturating_sub(began.elapsed()));
        run.end(Signal::INT).with(130);
    }
    for (recorder, verifier) in [(0, 1), (1, 0), (1, 1)] {
        let log = machines[recorder].home.path().join("log.mcap");
        let verified = machines[verifier].dimos(&format!("log verify {} --json", log.display())).with(0).json();
        let ticks = verified["ticks"].as_u64().unwrap();
        assert!(verified["result"] == "reproducible" && ticks > 500, "{recorder} by {verifier}: {verified}");
        println!("{ticks} ticks of machine {recorder} are equal on machine {verifier}");
    }
}

/// Sines and logarithms of the C library differ from one to the next.
#[test]
fn the_program_takes_only_exact_functions_from_the_c_library() {
    let symbols = |program: &Path| {
        let output = Command::new("readelf").args(["--wide", "--dyn-syms"]).arg(program).output();
        output.map(|output| String::from_utf8(output.stdout).unwrap())
    };
    let Ok(text) = symbols(Path::new(env!("CARGO_BIN_EXE_dimos"))) else {
        return skip("readelf (apt install binutils)");
    };
    let taken: Vec<&str> = text
        .lines()
        .filter(|line| line.contains(" UND "))
        .filter_map(|line| line.split_whitespace().nth(7)?.split('@').next())
        .collect();
    assert!(taken.contains(&"memcpy") || taken.contains(&"malloc"), "{text}");
    for name in
        "sin cos tan asin acos atan atan2 sincos sinh cosh tanh asinh acosh atanh exp exp2 exp10 expm1 log log2 log10 \
                 log1p pow hypot cbrt"
            .split_whitespace()
    {
        for name in [name.to_owned(), format!("{name}f")] {
            assert!(!taken.contains(&name.as_str()), "{name} is the C library's");
        }
    }
}
