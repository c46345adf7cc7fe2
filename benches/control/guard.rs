//! Duration of a tick with the collision guard: two 7-joint arms over a table that follow streams, with a cloud of
//! points around them.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use dimos::arm::ArmState;
use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::collision::cloud::Cloud;
use dimos::collision::settings::GuardSettings;
use dimos::collision::world::{Obstacle, Robot};
use dimos::collision::{OwnMargins, Solid, World};
use dimos::control::config::{ServoParams, TaskKind};
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::guard::GuardWorld;
use dimos::control::request::{Envelope, Request};
use dimos::joint::joints_of;
use dimos::planning::scene::planning_scene::{always_touch, whole};
use dimos::robot::random::Random;
use dimos::robot::{Source, load};
use dimos::rt::host;
use dimos::telemetry::Event;
use glamx::{DAffine3, DVec3};

use crate::bed::{self, Bed, Load};
use crate::tick::Ticks;

/// A usual pose of a Franka arm [rad].
const HOME: [f64; 7] = [-0.8, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];
/// Points of the cloud.
const POINTS: usize = 10_000;
/// Ticks before the measurement, in which the arms become ready.
const SETTLED: u64 = 60;

fn world() -> World {
    let mut world = World::new();
    for (name, x, turn) in [("left", -0.45, 0.0), ("right", 0.45, std::f64::consts::PI)] {
        let model = load(&Source::new("builtin:fer")).into_model().expect("a robot of the box");
        let mut robot = whole(model, Vec::new()).expect("its solids");
        robot.allowed.extend(always_touch(&robot).into_iter().map(Into::into));
        let base = DAffine3 { translation: DVec3::new(x, 0.0, 0.0), ..DAffine3::from_rotation_z(turn) };
        world.add_robot(Robot { name: name.into(), base, ..robot }).expect("another name");
    }
    let at = DAffine3::from_translation(DVec3::new(0.0, 0.0, -0.08));
    let table = Solid::cuboid(DVec3::new(2.0, 2.0, 0.1), at).expect("a box");
    world.add(Obstacle { name: "table".into(), solid: table, padding: 0.0 }).expect("another name");
    let mut random = Random::new(1);
    // A surface around the cell, from below the table to above the arms.
    let mut point = || {
        let (sin, cos) = random.between(0.0, std::f64::consts::TAU).sin_cos();
        DVec3::new(1.2 * cos, 1.2 * sin, random.between(-0.1, 1.3))
    };
    let cloud = Cloud::new((0..POINTS).map(|_| point())).expect("points");
    let cloud = Solid::cloud(Arc::new(cloud), 0.01, DAffine3::IDENTITY).expect("a cloud");
    world.add(Obstacle { name: "cloud".into(), solid: cloud, padding: 0.0 }).expect("another name");
    world
}

/// What the streams do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Streams {
    /// They lead to random poses, most of which are in contact.
    Random,
    /// They push the arms towards each other and into the table.
    Push,
}

/// Times `Coordinator::tick` on a real-time thread, with or without the guard. Also returns how often an arm was
/// stopped.
pub fn ticks(guarded: bool, streams: Streams, number: usize) -> (Ticks, usize) {
    std::thread::spawn(move || {
        host::enter_realtime(host::TICK_PRIORITY);
        measure(guarded, streams, number)
    })
    .join()
    .expect("the measuring thread does not panic")
}

fn measure(guarded: bool, streams: Streams, number: usize) -> (Ticks, usize) {
    let bed = Bed::new(2, Load::Servo);
    let mut config = bed.config().clone();
    for (arm, task) in config.arms.iter_mut().zip(&mut config.tasks) {
        arm.limits.position_lower = vec![-2.9; bed::DOF];
        arm.limits.position_upper = vec![2.9; bed::DOF];
        arm.limits.velocity_max = vec![2.0; bed::DOF];
        arm.limits.acceleration_max = vec![8.0; bed::DOF];
        task.kind = TaskKind::new("servo", &ServoParams::default());
    }
    let tasks = dimos::control::task_spec::TaskTable::builtin().build(&config.tasks).expect("two servo tasks");
    let mut coordinator = Coordinator::new(&config, tasks);
    if guarded {
        let scene = world().snapshot();
        let own = OwnMargins::of(&scene, 0.002, &GuardSettings::default());
        let arms: Vec<u16> = (0..14).map(|joint| joint / 7).collect();
        let mut world = GuardWorld::new(&scene, (0..14).collect(), &arms, 0.01, &own).expect("a world");
        world.allow_present(|joint| HOME[usize::from(joint % 7)]);
        coordinator.set_guard(Some(Box::new(world)));
    }
    let mut states: Vec<ArmState> = vec![bed::fresh_arm(); 2];
    states.iter_mut().for_each(|state| state.position = joints_of(&HOME));
    let mut queue: VecDeque<Envelope> = VecDeque::with_capacity(8);
    let (mut random, mut targets, mut goals) = (Random::new(7), [HOME; 2], [HOME; 2]);
    let (mut times, mut stops) = (Vec::with_capacity(number), 0);
    let (start, began) = (MonotonicClock.now(), Instant::now());
    for tick in 0u64.. {
        let now: Mono = start.after(config.period() * tick as u32);
        if tick == 5 {
            (0..2).for_each(|arm| {
                queue.push_back(Envelope { id: 0, origin: None, request: Request::Enabled { arm, outside: false } })
            });
        }
        if tick >= SETTLED {
            for (arm, (target, goal)) in targets.iter_mut().zip(&mut goals).enumerate() {
                match streams {
                    Streams::Random if tick % 60 == 0 => goal.fill_with(|| random.between(-2.5, 2.5)),
                    Streams::Random => {}
                    Streams::Push => *goal = [0.0, 0.6, 0.0, -1.2, 0.0, 2.0, 0.785],
                }
                for (at, to) in target.iter_mut().zip(goal.iter()) {
                    *at += (to - *at).clamp(-0.1, 0.1);
                }
                let request = Request::Servo { task: arm as u16, target: joints_of(target) };
                queue.push_back(Envelope { id: tick, origin: None, request });
            }
        }
        let time = TickTime { now, next: now.after(config.period()), skipped: 0, late_ns: 0, woke_late_ns: 0 };
        let before = Instant::now();
        let output = coordinator.tick(time, &states, || queue.pop_front());
        let took = before.elapsed();
        for (state, command) in states.iter_mut().zip(&output.commands) {
            bed::follow(state, command, now);
        }
        stops += output.events.iter().filter(|event| matches!(event, Event::Guard(_, Some(_)))).count();
        output.retired.clear();
        if tick > SETTLED + 100 {
            times.push(took.as_nanos() as f64);
        }
        if times.len() == number {
            break;
        }
    }
    (Ticks { rate: number as f64 / began.elapsed().as_secs_f64(), times }, stops)
}
