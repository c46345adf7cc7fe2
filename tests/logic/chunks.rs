//! Action chunks on a virtual clock: splices, late actions, the end of the last chunk; every command within the limits
//! of velocity, acceleration and jerk.

use dimos::clock::Mono;
use dimos::control::config::{ChunkParams, TaskKind};
use dimos::control::request::{Motion, Request};
use dimos::control::tasks::chunk::curve;
use dimos::joint::DEFAULT_JERK;
use dimos::robot::random::Random;
use dimos::telemetry::{Outcome, TaskState};
use dimos::trajectory::Spline;

use crate::support::rig::*;

/// Time between two actions [s].
const PERIOD: f64 = 1.0 / 30.0;
/// The policy's circle: two joints each make one, at constant speed.
const RADIUS: f64 = 0.15;
const FREQUENCY: f64 = 1.5;

fn rig() -> Rig {
    Rig::one_arm(one(TaskKind::new("chunk", &ChunkParams::default())))
}

/// Where the policy wants the joints [rad].
fn circle(t: f64) -> [f64; 6] {
    let (sin, cos) = (FREQUENCY * t).sin_cos();
    std::array::from_fn(|j| if j % 2 == 0 { RADIUS * sin } else { RADIUS * (1.0 - cos) })
}

fn chunk(rig: &Rig, start: Mono, actions: &[Vec<f64>]) -> Request {
    let names: Vec<String> = (0..6).map(|j| format!("j{j}")).collect();
    let spline = Spline::new(&curve(&names, actions, PERIOD, &rig.config.arms[0].limits)).unwrap();
    Request::Chunk { task: 0, start, motion: Box::new(Motion { id: 7, joints: (0..6).collect(), spline, until: None }) }
}

/// The commands of an arm, and what they stand for.
#[derive(Default)]
struct Trace(Vec<Vec<f64>>);

impl Trace {
    fn tick(&mut self, rig: &mut Rig) {
        rig.tick();
        self.0.push(rig.commanded(0));
    }

    /// The largest third and second difference of a joint's commands [rad/s³, rad/s²].
    fn steepest(&self) -> (f64, f64) {
        let dt: f64 = 0.01;
        let (mut jerk, mut acceleration) = (0.0_f64, 0.0_f64);
        for ticks in self.0.windows(4) {
            for q in (0..6).map(|j| [0, 1, 2, 3].map(|k| ticks[k][j])) {
                jerk = jerk.max((q[3] - 3.0 * q[2] + 3.0 * q[1] - q[0]).abs() / dt.powi(3));
                acceleration = acceleration.max((q[2] - 2.0 * q[1] + q[0]).abs() / dt.powi(2));
            }
        }
        (jerk, acceleration)
    }

    #[track_caller]
    fn keeps_its_limits(&self) {
        let (jerk, acceleration) = self.steepest();
        assert!(jerk <= 1.001 * DEFAULT_JERK && acceleration <= A_MAX, "{jerk} rad/s³, {acceleration} rad/s²");
    }
}

/// 50 actions at 30 Hz from a policy that takes 50 to 300 ms: 100 Hz of commands without a stop, within jerk limits.
#[test]
fn chunks_of_a_slow_and_noisy_policy_make_one_motion() {
    for seed in 0..4 {
        let (mut rig, mut trace, mut random) = (rig(), Trace::default(), Random::new(seed));
        let begin = rig.now;
        let (mut observed, mut arrives, mut chunks) = (rig.now, 0.05, 0);
        for k in 0..3000 {
            let now = rig.now.seconds_since(begin);
            if now >= arrives {
                let bias = random.between(-0.01, 0.01);
                let from = observed.seconds_since(begin);
                let actions = (0..50).map(|k| {
                    let wanted = circle(from + f64::from(k) * PERIOD);
                    wanted.iter().map(|q| q + bias + random.between(-0.001, 0.001)).collect()
                });
                let request = chunk(&rig, observed, &actions.collect::<Vec<Vec<f64>>>());
                let id = rig.send(request);
                (observed, arrives, chunks) = (rig.now, now + random.between(0.05, 0.3), chunks + 1);
                trace.tick(&mut rig);
                assert_eq!(rig.outcome(id), Outcome::Accepted);
            } else {
                trace.tick(&mut rig);
            }
            if k > 150 {
                let [.., a, b] = &trace.0[..] else { panic!("no commands") };
                let speed = (b[0] - a[0]).hypot(b[1] - a[1]) / 0.01;
                let wanted = RADIUS * FREQUENCY;
                assert!((0.5 * wanted..1.5 * wanted).contains(&speed), "{speed} rad/s after {now} s");
                let q = circle(rig.now.seconds_since(begin));
                let error = b.iter().zip(q).fold(0.0_f64, |most, (b, q)| most.max((b - q).abs()));
                assert!(error < 0.03, "{error} rad after {now} s");
            }
        }
        assert!(chunks > 120 && rig.tasks[0].state == TaskState::Executing, "{chunks}");
        assert_eq!(rig.retired.len(), chunks, "every chunk was given back");
        trace.keeps_its_limits();
    }
}

#[test]
fn after_the_last_chunk_the_arm_rests_and_the_task_ends() {
    let (mut rig, mut trace) = (rig(), Trace::default());
    let begin = rig.now;
    let actions: Vec<Vec<f64>> = (0..30).map(|k| circle(f64::from(k) * PERIOD).to_vec()).collect();
    let request = chunk(&rig, begin, &actions);
    rig.send(request);
    (0..400).for_each(|_| trace.tick(&mut rig));
    trace.keeps_its_limits();
    assert_eq!(rig.tasks[0].state, TaskState::Idle);
    let end = circle(29.0 * PERIOD);
    let way = rig.commanded(0).iter().zip(end).fold(0.0_f64, |most, (q, end)| most.max((q - end).abs()));
    assert!(rig.speed(0) < 1e-9 && way < 0.1, "{way} rad beyond the last action");
}

#[test]
fn a_chunk_takes_over_from_its_start_on() {
    let (mut rig, mut trace) = (rig(), Trace::default());
    let begin = rig.now;
    let rest = vec![vec![0.0; 6]; 50];
    let aside = vec![vec![0.1; 6]; 50];
    let (first, later) = (chunk(&rig, begin, &rest), chunk(&rig, begin.after(rig.config.period() * 50), &aside));
    rig.send(first);
    rig.send(later);
    for k in 0..150 {
        trace.tick(&mut rig);
        let moved = rig.commanded(0)[0].abs() > 1e-9;
        assert!(moved == (k >= 49), "tick {k}: {}", rig.commanded(0)[0]);
    }
    assert!((rig.commanded(0)[3] - 0.1).abs() < 1e-3);
    trace.keeps_its_limits();
}

#[test]
fn chunks_that_are_late_or_jump_are_refused_and_change_nothing() {
    let mut rig = rig();
    let (begin, rest) = (rig.now, vec![vec![0.0; 6]; 30]);
    rig.run(200);
    let request = chunk(&rig, begin, &rest);
    assert_eq!(rig.ask(request), Outcome::InvalidTarget(0), "its last action is 1 s old");
    let (now, far) = (rig.now, vec![vec![0.5; 6]; 30]);
    let request = chunk(&rig, now, &far);
    assert_eq!(rig.ask(request), Outcome::StartStateMismatch(0, 0.5));
    let (now, request) = (rig.now, chunk(&rig, rig.now, &rest));
    assert_eq!(rig.ask(request), Outcome::Accepted);
    let request = chunk(&rig, now, &far);
    assert_eq!(rig.ask(request), Outcome::StartStateMismatch(0, 0.5));
    rig.run(20);
    assert_eq!(rig.tasks[0].state, TaskState::Executing);
    assert!(rig.commanded(0).iter().all(|q| q.abs() < 1e-9));
}

#[test]
fn lost_ticks_make_no_jump() {
    let (mut rig, mut trace) = (rig(), Trace::default());
    let begin = rig.now;
    let actions: Vec<Vec<f64>> = (0..200).map(|k| circle(f64::from(k) * PERIOD).to_vec()).collect();
    let request = chunk(&rig, begin, &actions);
    rig.send(request);
    (0..150).for_each(|_| trace.tick(&mut rig));
    // A lost period is bridged: this command is where the motion is, two periods later.
    trace.keeps_its_limits();
    trace = Trace::default();
    rig.tick_after(1);
    let error = (rig.commanded(0)[0] - circle(rig.now.seconds_since(begin))[0]).abs();
    assert!(error < 1e-3, "{error} rad");
    (0..150).for_each(|_| trace.tick(&mut rig));
    trace.keeps_its_limits();
    // An arm that got no command for longer has stopped; it starts again, and catches up.
    rig.tick_after(4);
    rig.run(200);
    let error = (rig.commanded(0)[0] - circle(rig.now.seconds_since(begin))[0]).abs();
    assert!(error < 0.01, "{error} rad: it has caught up");
}
