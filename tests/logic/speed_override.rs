//! The speed override on a virtual clock: motions slow down and pause on their paths, streams keep slower limits. The
//! rig checks that no command breaks a limit of the arm.

use dimos::control::point_to_point::point_to_point;
use dimos::control::request::{Motion, Request};
use dimos::joint::{JointLimits, make_joints};
use dimos::telemetry::{Event, Outcome, Reason, TaskState};
use dimos::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryPoint};

use crate::support::rig::*;

const JERK: f64 = 40.0;

/// A motion of all joints, each another way, within the arm's limits.
fn long_motion(id: u64) -> Box<Motion> {
    let limits = JointLimits {
        acceleration_max: vec![A_MAX; 6],
        jerk_max: vec![JERK; 6],
        ..JointLimits::uniform(6, RANGE, V_MAX).with_defaults()
    };
    let target = [1.8, -1.2, 0.9, 0.3, -0.6, 1.5];
    let trajectory = point_to_point(&make_joints("arm", 6), &[0.0; 6], &target, &limits, 1.0).unwrap();
    Box::new(Motion { id, joints: (0..6).collect(), spline: Spline::new(&trajectory).unwrap(), until: None })
}

fn rig(tasks: Vec<dimos::control::config::TaskConfig>) -> Rig {
    let mut config = arm("arm", 6);
    config.limits.jerk_max = vec![JERK; 6];
    let mut rig = Rig::new(100.0, vec![config], tasks);
    rig.make_ready();
    rig
}

/// What the commands of a motion showed.
struct Watched<'a> {
    spline: &'a Spline,
    last: Vec<f64>,
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    jerk: f64,
}

impl<'a> Watched<'a> {
    fn new(rig: &Rig, spline: &'a Spline) -> Self {
        Self { spline, last: rig.commanded(0), velocity: vec![0.0; 6], acceleration: vec![0.0; 6], jerk: 0.0 }
    }

    /// Ticks, and checks that the command is a point of the path.
    fn tick(&mut self, rig: &mut Rig) {
        rig.tick();
        let (now, dt) = (rig.commanded(0), rig.dt());
        let mut samples = vec![Sample::default(); 6];
        self.spline.sample(rig.tasks[0].elapsed, &mut Cursor::default(), &mut samples);
        for (j, sample) in samples.iter().enumerate() {
            let off = (now[j] - sample.position).abs();
            assert!(off < 1e-9, "joint {j} is {off:e} rad off the path at {} s", rig.tasks[0].elapsed);
            let velocity = (now[j] - self.last[j]) / dt;
            let acceleration = (velocity - self.velocity[j]) / dt;
            self.jerk = self.jerk.max((acceleration - self.acceleration[j]).abs() / dt);
            (self.velocity[j], self.acceleration[j]) = (velocity, acceleration);
        }
        self.last = now;
    }

    fn fastest(&self) -> f64 {
        self.velocity.iter().fold(0.0, |most: f64, v| most.max(v.abs()))
    }
}

#[test]
fn a_motion_slows_down_on_its_path_and_speeds_up_again() {
    let mut rig = rig(one(trajectory()));
    let motion = long_motion(7);
    let spline = motion.spline.clone();
    assert_eq!(rig.execute(0, motion), Outcome::Accepted);
    let mut watched = Watched::new(&rig, &spline);
    (0..70).for_each(|_| watched.tick(&mut rig));
    let full = watched.fastest();
    assert!(full > 0.9 * V_MAX, "{full}");
    rig.send(Request::Speed { fraction: 0.3 });
    (0..60).for_each(|_| watched.tick(&mut rig));
    assert!((watched.fastest() - 0.3 * V_MAX).abs() < 1e-6, "{} rad/s", watched.fastest());
    assert!(rig.reported(Event::Speed(0.3, false)));
    rig.send(Request::Speed { fraction: 1.0 });
    let mut fastest = 0.0f64;
    rig.run_until(0.0, |_| true);
    while rig.tasks[0].state == TaskState::Executing {
        watched.tick(&mut rig);
        fastest = fastest.max(watched.fastest());
    }
    assert!(fastest > 0.9 * V_MAX, "{fastest}");
    assert_eq!(rig.tasks[0].state, TaskState::Completed);
    // The path uses the jerk limit itself, and the change of its rate comes on top.
    assert!(watched.jerk < 2.0 * JERK, "{} rad/s³", watched.jerk);
}

#[test]
fn a_motion_pauses_on_its_path_and_ends_where_it_should() {
    let mut rig = rig(one(trajectory()));
    let motion = long_motion(7);
    let spline = motion.spline.clone();
    let goal: Vec<f64> = (0..6).map(|k| spline.goal(k)).collect();
    rig.execute(0, motion);
    let mut watched = Watched::new(&rig, &spline);
    for pause in [12, 35, 60, 61, 95] {
        while rig.tasks[0].elapsed < f64::from(pause) * 0.01 {
            watched.tick(&mut rig);
        }
        assert_eq!(rig.ask(Request::Pause { on: true }), Outcome::Accepted);
        watched.last = rig.commanded(0);
        watched = Watched { jerk: watched.jerk, ..Watched::new(&rig, &spline) };
        (0..80).for_each(|_| watched.tick(&mut rig));
        assert_eq!((watched.fastest(), rig.tasks[0].state), (0.0, TaskState::Executing), "paused at {pause}");
        rig.send(Request::Pause { on: false });
    }
    while rig.tasks[0].state == TaskState::Executing {
        watched.tick(&mut rig);
    }
    assert_eq!(rig.tasks[0].state, TaskState::Completed);
    assert_eq!(rig.commanded(0), goal);
}

#[test]
fn a_pause_takes_effect_also_where_the_path_needs_all_of_the_acceleration() {
    let mut rig = rig(one(trajectory()));
    // To the top speed at the acceleration limit, and back to rest.
    let top = V_MAX / A_MAX;
    let point = |t: f64, q: f64, v: f64, a: f64| TrajectoryPoint {
        time_from_start: t,
        positions: [q][..].into(),
        velocities: [v][..].into(),
        accelerations: [a][..].into(),
    };
    let rise = 0.5 * V_MAX * top;
    let points = vec![
        point(0.0, 0.0, 0.0, A_MAX),
        point(top, rise, V_MAX, A_MAX),
        point(top + 1e-3, rise + V_MAX * 1e-3, V_MAX, 0.0),
        point(top + 0.4, rise + V_MAX * 0.4, V_MAX, 0.0),
        point(2.0 * top + 1.0, rise + V_MAX * 0.4 + 0.4, 0.0, 0.0),
    ];
    let spline = Spline::new(&JointTrajectory { joint_names: vec!["j0".into()], points }).unwrap();
    rig.execute(0, Box::new(Motion { id: 7, joints: vec![0], spline, until: None }));
    rig.run(10);
    rig.ask(Request::Pause { on: true });
    let took = rig.run_until(5.0, |rig| rig.speed(0) == 0.0);
    // A tenth of the limit is left for it: 0.70 s.
    assert!(took < 0.74, "{took} s");
}

#[test]
fn what_begins_while_all_is_paused_waits() {
    let mut rig = rig(one(trajectory()));
    rig.ask(Request::Pause { on: true });
    rig.ask(Request::Speed { fraction: 0.5 });
    assert_eq!(rig.execute(0, long_motion(7)), Outcome::Accepted);
    rig.run_for(1.0);
    assert_eq!((rig.tasks[0].state, rig.speed(0)), (TaskState::Executing, 0.0));
    assert!(rig.commanded(0).iter().all(|q| *q == 0.0));
    rig.ask(Request::Pause { on: false });
    let mut fastest = 0.0f64;
    let took = rig.run_until(10.0, |rig| {
        fastest = fastest.max(rig.speed(0));
        rig.tasks[0].state == TaskState::Completed
    });
    assert!(took > 1.8 && fastest <= 0.5 * V_MAX + 1e-9, "{took} s, {fastest} rad/s");
}

#[test]
fn a_paused_motion_can_be_cancelled_and_stopped() {
    for stop in [Request::Cancel { task: Some(0) }, Request::Stop { arm: None }] {
        let mut rig = rig(one(trajectory()));
        rig.execute(0, long_motion(7));
        rig.run(60);
        rig.ask(Request::Pause { on: true });
        rig.run(80);
        let at = rig.commanded(0);
        rig.ask(stop);
        rig.run(20);
        assert_eq!((rig.tasks[0].state, rig.retired.clone()), (TaskState::Aborted, vec![7]));
        assert_eq!(rig.commanded(0), at, "nothing moves");
    }
}

#[test]
fn streams_keep_slower_limits_and_pause() {
    let mut rig = rig(vec![task("servo", servo(), 0..6, 10), task("velocity", velocity(), 0..6, 20)]);
    let mut at = 0.0;
    let follow = |rig: &mut Rig, at: &mut f64, ticks: u32| {
        let mut fastest = 0.0f64;
        for _ in 0..ticks {
            *at += 0.012;
            rig.servo(0, &[*at; 6]);
            rig.tick();
            fastest = fastest.max(rig.speed(0));
        }
        fastest
    };
    assert!(follow(&mut rig, &mut at, 60) > 1.1);
    rig.send(Request::Speed { fraction: 0.2 });
    follow(&mut rig, &mut at, 80);
    let slow = follow(&mut rig, &mut at, 5);
    assert!((slow - 0.2 * V_MAX).abs() < 1e-9, "{slow} rad/s");
    assert_eq!(rig.tasks[0].reason, Reason::None);

    rig.run_for(1.0); // the stream ends
    rig.send(Request::Speed { fraction: 1.0 });
    let drive = |rig: &mut Rig, ticks: u32| {
        for _ in 0..ticks {
            rig.velocity(1, &[-1.2; 6]);
            rig.tick();
        }
        rig.speed(0)
    };
    assert!((drive(&mut rig, 100) - 1.2).abs() < 1e-9);
    rig.send(Request::Pause { on: true });
    assert_eq!(drive(&mut rig, 100), 0.0);
    rig.send(Request::Pause { on: false });
    rig.send(Request::Speed { fraction: 0.1 });
    assert!((drive(&mut rig, 10) - 0.1 * V_MAX).abs() < 0.1);
}
