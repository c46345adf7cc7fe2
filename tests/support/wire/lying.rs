//! One trial on the wire: an arm whose emulator reports what is not so, a run that is asked for motions and stops, and
//! the judgement of the true joints and of the setpoints. Each trial is a seed.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use dimos::arm::Supervision;
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::hardware::sim::misreading::Misreading;
use dimos::joint::JointLimits;
use dimos::robot::random::Random;

use super::arms::{Arm, Bed, Setup, World, furthest};
use super::{What, lock};
use crate::support::motion_judge::Judge;

/// When a lie begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Occasion {
    Start,
    Enabling,
    Idle,
    Motion,
    Stopping,
    Held,
    Disabled,
}

const OCCASIONS: [Occasion; 7] = [
    Occasion::Start,
    Occasion::Enabling,
    Occasion::Idle,
    Occasion::Motion,
    Occasion::Stopping,
    Occasion::Held,
    Occasion::Disabled,
];

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Act {
    Move,
    Servo,
    Velocity,
}

/// How much later than in virtual time a wrong motion may be noticed, or a stop be sent, on a busy computer [s].
pub(super) const LATE: f64 = 0.06;
/// Setpoints of an honest trial's motion, at least.
const SEEN: usize = 20;
/// Time between two readings of the true joints.
const LOOK: Duration = Duration::from_millis(2);

/// The judge and what it needs to know of the script.
pub(super) struct Watched {
    pub judge: Judge,
    pub active: bool,
    /// Where the joints were when the motors came on is known.
    pub placed: bool,
}

/// Ends the thread that looks, whatever ends the script.
struct End<'a>(&'a AtomicBool);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

pub(super) struct Trial<'a> {
    pub bed: &'a Bed,
    pub random: Random,
    pub lie: Option<Vec<Fault>>,
    pub watched: &'a Mutex<Watched>,
    /// Besides what the judge finds: a stop that is not taken, an honest arm that is held.
    pub failures: Vec<String>,
    pub supervision: Supervision,
    pub limits: JointLimits,
    /// The lie has begun.
    pub told: bool,
}

/// Plays the trial of a seed. Returns what it is, and the rules that it broke.
pub fn trial(arm: Arm, seed: u64) -> (String, Vec<String>) {
    let mut random = Random::new(seed);
    let honest = seed % 6 == 5;
    let occasion = OCCASIONS[random.below(OCCASIONS.len())];
    let lie = (!honest).then(|| draw(&arm, &mut random));
    let acts = if arm.time_limit.is_some() { 3 } else { 2 };
    let act = [Act::Move, Act::Servo, Act::Velocity][random.below(acts)];
    let what = match &lie {
        Some(faults) => {
            let f = &faults[0];
            let misread =
                if f.kind == FaultKind::Misread { format!(" {:?} {:.3}", f.misread, f.amount) } else { String::new() };
            let joints: Vec<usize> = faults.iter().map(|f| f.joint).collect();
            format!("{occasion:?}, {act:?}, {:?}{misread} of joints {joints:?} for {:.2} s", f.kind, f.duration)
        }
        None => format!("honest, {act:?}"),
    };
    let start: Vec<f64> =
        arm.ends[0].iter().zip(arm.ends[1]).map(|(a, b)| a + random.between(0.3, 0.7) * (b - a)).collect();
    let world = World::new(arm, &Setup { start: start.clone(), ..Setup::default() });
    lie.iter().flatten().filter(|_| occasion == Occasion::Start).for_each(|fault| world.inject(*fault));
    let bed = match world.run() {
        Ok(bed) => bed,
        Err((why, world)) => {
            // An arm that is not believed does not start, and has not moved.
            let moved = furthest(&world.truth(), &start);
            let found = (honest || moved > 0.05).then(|| format!("it does not start ({why}) and moved {moved:.4} rad"));
            return (what, found.into_iter().collect());
        }
    };
    let config = bed.run.config().arms[0].clone();
    // What is read is rounded, and what is written.
    let mut judge = Judge::new(0, &config, &bed.truth(), 2.0 * arm.rounding + 1e-4, super::arms::PERIOD);
    judge.late = LATE;
    let since = super::now();
    let (watched, done) = (Mutex::new(Watched { judge, active: false, placed: true }), AtomicBool::new(false));
    let mut trial = Trial {
        bed: &bed,
        random,
        lie,
        watched: &watched,
        failures: Vec::new(),
        supervision: config.supervision,
        limits: config.limits,
        told: occasion == Occasion::Start,
    };
    std::thread::scope(|scope| {
        let (eyes, watched, done) = (bed.eyes(), &watched, &done);
        scope.spawn(move || look(eyes, watched, done));
        let _end = End(done);
        trial.place();
        trial.script(occasion, act);
    });
    let mut failures = trial.failures;
    // A decoder that misses what is sent in motion would find nothing wrong. Franka's datagrams pass no gate.
    let seen = bed.gate.sent().iter().filter(|one| matches!(one.what, What::Position(_) | What::Velocity(_))).count();
    if honest && arm.name != "franka" && seen < SEEN {
        failures.push(format!("only {seen} setpoints of a motion are judged"));
    }
    if std::env::var_os("DIMOS_WIRE_LIE").is_some() {
        for one in bed.gate.sent() {
            println!("{:.4} {:?} at {:.4?}", one.at.seconds_since(since), one.what, one.truth);
        }
    }
    failures.extend(bed.bounds.neighbours(&bed.gate.sent(), since).err());
    let found = lock(&watched).judge.found.clone();
    failures.extend(found.into_iter().map(|v| {
        format!("rule {}, {:.3} s, joint {}: {}; most {:.4} beyond", v.rule.name(), v.at, v.joint + 1, v.text, v.excess)
    }));
    (what, failures)
}

/// Judges the true joints until the trial is over.
fn look(eyes: impl Fn() -> (Vec<f64>, bool), watched: &Mutex<Watched>, done: &AtomicBool) {
    let began = Instant::now();
    let (mut before, mut at) = (eyes().0, began);
    let mut at_rest = true;
    while !done.load(Ordering::Relaxed) {
        std::thread::sleep(LOOK);
        let ((q, motors_on), dt) = (eyes(), at.elapsed().as_secs_f64());
        if dt >= 0.01 {
            at_rest = furthest(&q, &before) < 0.01 * dt;
            (before, at) = (q.clone(), Instant::now());
        }
        let mut watched = lock(watched);
        let active = watched.active;
        if motors_on && watched.placed {
            watched.judge.joints(began.elapsed().as_secs_f64(), &q, at_rest, active);
        }
    }
}

/// Draws what is wrong with the readings.
fn draw(arm: &Arm, random: &mut Random) -> Vec<Fault> {
    let signed = |random: &mut Random, low: f64, high: f64| {
        let size = random.between(low, high);
        if random.below(2) == 0 { size } else { -size }
    };
    let misreadings = [
        (Misreading::Offset, std::f64::consts::TAU * if random.below(2) == 0 { 1.0 } else { -1.0 }),
        (Misreading::Offset, signed(random, 0.02, 0.5)),
        (Misreading::Drift, signed(random, 0.1, 2.5)),
        (Misreading::Drift, signed(random, 0.005, 0.08)),
        (Misreading::Slip, signed(random, 0.1, 2.5)),
        (Misreading::Slip, signed(random, 0.005, 0.08)),
        (Misreading::Scaled, [0.5, 0.9, 1.1, 2.0, 0.0, std::f64::consts::PI / 180.0][random.below(6)]),
        (Misreading::Mirrored, 0.0),
        (Misreading::Swapped, 0.0),
        (Misreading::Noise, random.between(0.01, 0.4)),
        (Misreading::Late, random.between(0.02, 0.2)),
        (Misreading::Frozen, 0.0),
    ];
    let duration = [0.05, 0.2, 1.0, 30.0][random.below(4)];
    let of = |kind: FaultKind| Fault { kind, ..Fault::new(FaultKind::Misread).lasting(duration) };
    // What the whole arm says.
    match random.below(9) {
        0 if !matches!(arm.name, "so101" | "remote") => return vec![of(FaultKind::ZeroState)],
        1 if !matches!(arm.name, "so101" | "piper") => return vec![of(FaultKind::Nan)],
        2 if !matches!(arm.name, "so101" | "piper") => return vec![of(FaultKind::Frozen)],
        _ => {}
    }
    let (misread, amount) = misreadings[random.below(misreadings.len())];
    let (first, second) = (1 + random.below(arm.dof()), 1 + random.below(arm.dof()));
    let joints: Vec<usize> = match random.below(6) {
        0 => (1..=arm.dof()).collect(),
        1 if first != second => vec![first, second],
        _ => vec![first],
    };
    joints.into_iter().map(|joint| Fault { misread, amount, joint, ..of(FaultKind::Misread) }).collect()
}
