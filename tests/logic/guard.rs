//! The collision guard of the tick: whatever streams ask, nothing touches, and arms that are in nothing's way move as
//! without it.

use dimos::collision::settings::GuardSettings;
use dimos::collision::{OwnMargins, World};
use dimos::control::config::TaskConfig;
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::joints_of;
use dimos::replay::verify::{Finding, verify};
use dimos::robot::random::Random;
use dimos::telemetry::{Bound, Event, Outcome, Phase, Reason, TaskState};
use glamx::{DAffine3, DVec3};

use crate::support::guarded::{Guarded, MARGINS, cloud, cuboid, prepared, robot};
use crate::support::rig::*;
use crate::support::virtual_run::{VirtualRun, one_arm};

/// A usual pose of a Franka arm [rad].
const HOME: [f64; 7] = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785];
/// Limits of velocity [rad/s] and acceleration [rad/s²].
const FAST: (f64, f64) = (2.0, 8.0);

/// Two arms that face each other over a table, between posts, with a cloud of points around both.
fn cell() -> World {
    let mut world = World::new();
    let left = DAffine3::from_translation(DVec3::new(-0.45, 0.0, 0.0));
    let right = DAffine3::from_rotation_z(std::f64::consts::PI);
    let right = DAffine3 { translation: DVec3::new(0.45, 0.0, 0.0), ..right };
    world.add_robot(robot("fer", "left", left)).unwrap();
    world.add_robot(robot("fer", "right", right)).unwrap();
    world.add(cuboid("table", [2.0, 2.0, 0.1], [0.0, 0.0, -0.08])).unwrap();
    world.add(cuboid("post", [0.05, 0.05, 1.0], [0.0, 0.45, 0.45])).unwrap();
    world.add(cloud("wall", 2_000, 1.15)).unwrap();
    world
}

fn home() -> Vec<f64> {
    let mut home = [HOME, HOME].concat();
    // Out of each other's way.
    (home[0], home[7]) = (-0.8, -0.8);
    home
}

/// A stream of positions to one arm that heads for random poses, half of them in contact.
struct Adversary {
    random: Random,
    joints: std::ops::Range<usize>,
    goal: Vec<f64>,
    target: Vec<f64>,
    left: usize,
}

impl Adversary {
    fn new(seed: u64, joints: std::ops::Range<usize>, start: &[f64]) -> Self {
        let start = start[joints.clone()].to_vec();
        Self { random: Random::new(seed), joints, goal: start.clone(), target: start, left: 0 }
    }

    /// Returns the next target: at most 0.15 rad from the last one.
    fn next(&mut self, cell: &mut Guarded) -> Vec<f64> {
        if self.left == 0 {
            self.left = 5 + self.random.below(120);
            for attempt in 0..8 {
                for (goal, arm) in self.goal.iter_mut().zip(self.joints.clone()) {
                    let (index, joint) = (arm / 7, arm % 7);
                    let limits = &cell.rig.config.arms[index].limits;
                    *goal =
                        self.random.between(limits.position_lower[joint] + 0.02, limits.position_upper[joint] - 0.02);
                }
                let mut q = cell.q();
                q[self.joints.clone()].copy_from_slice(&self.goal);
                if attempt % 2 == 0 || cell.contact_at(&q).is_some() {
                    break;
                }
            }
        }
        self.left -= 1;
        for (target, goal) in self.target.iter_mut().zip(&self.goal) {
            *target += (goal - *target).clamp(-0.15, 0.15);
        }
        self.target.clone()
    }
}

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).ok().and_then(|n| n.parse().ok()).unwrap_or(otherwise)
}

/// `DIMOS_GUARD_TARGETS` is the number of targets, `DIMOS_TEST_SEED` the seed.
#[test]
fn adversarial_targets_to_two_arms_bring_nothing_into_contact() {
    let (targets, seed) = (number("DIMOS_GUARD_TARGETS", 4_000), number("DIMOS_TEST_SEED", 1));
    let tasks = vec![task("left", servo(), 0..7, 10), task("right", servo(), 7..14, 10)];
    let mut cell = Guarded::new(cell(), &home(), FAST, tasks);
    let mut adversaries = [Adversary::new(seed, 0..7, &home()), Adversary::new(seed + 1, 7..14, &home())];
    let (mut moved, mut least) = (0.0, f64::INFINITY);
    for k in 0..targets / 2 {
        for (task, adversary) in adversaries.iter_mut().enumerate() {
            let target = adversary.next(&mut cell);
            cell.rig.servo(task as u16, &target);
        }
        let before = cell.q();
        cell.tick();
        moved += cell.q().iter().zip(&before).map(|(a, b)| (a - b).abs()).sum::<f64>();
        if k % 50 == 0 {
            least = f64::min(least, cell.distance_to(""));
        }
        assert!((0..2).all(|arm| cell.rig.phase(arm) == Phase::Ready), "seed {seed}: {:?}", cell.rig.events.last());
    }
    let blocked = cell.rig.count(|event| matches!(event, Event::Guard(_, Some(_))));
    let released = cell.rig.count(|event| matches!(event, Event::Guard(_, None)));
    println!("{targets} targets: {moved:.0} rad, blocked {blocked} times, released {released}, least {least:.4} m");
    assert!(blocked > 10 && released > 10 && moved > 0.01 * targets as f64, "{blocked} {released} {moved}");
    assert!(least > 0.8 * MARGINS.0, "{least}");
}

/// One arm over a table.
fn bench() -> World {
    let mut world = World::new();
    world.add_robot(robot("fer", "arm", DAffine3::IDENTITY)).unwrap();
    world.add(cuboid("table", [2.0, 2.0, 0.1], [0.0, 0.0, -0.08])).unwrap();
    world
}

/// A post that the arm at [`HOME`] meets when its first joint turns by 0.9 rad.
fn post() -> dimos::collision::world::Obstacle {
    cuboid("post", [0.04, 0.04, 1.6], [0.33 * 0.9f64.cos(), 0.33 * 0.9f64.sin(), 0.8])
}

fn stream() -> Vec<TaskConfig> {
    vec![task("servo", servo(), 0..7, 10), task("velocity", velocity(), 0..7, 10)]
}

fn blocked(cell: &Guarded) -> usize {
    cell.rig.count(|event| matches!(event, Event::Guard(_, Some(_))))
}

#[test]
fn far_from_everything_an_arm_moves_as_without_a_guard() {
    let mut guarded = Guarded::new(bench(), &HOME, FAST, stream());
    let mut plain = Guarded::new(bench(), &HOME, FAST, stream());
    plain.rig.coordinator.set_guard(None);
    let mut random = Random::new(4);
    let (mut target, mut goal) = (HOME.to_vec(), HOME.to_vec());
    for k in 0..400 {
        if k % 40 == 0 {
            goal = HOME.iter().map(|q| q + random.between(-0.25, 0.25)).collect();
        }
        for (at, goal) in target.iter_mut().zip(&goal) {
            *at += (goal - *at).clamp(-0.05, 0.05);
        }
        for cell in [&mut guarded, &mut plain] {
            cell.rig.servo(0, &target);
            cell.tick();
        }
        assert_eq!(guarded.rig.commands, plain.rig.commands, "tick {k}");
    }
    assert_eq!(guarded.rig.events, plain.rig.events);
}

#[test]
fn an_obstacle_that_is_added_during_motion_stops_the_arm_until_it_is_led_away() {
    let mut cell = Guarded::new(bench(), &HOME, FAST, stream());
    let (mut target, mut there) = (HOME.to_vec(), HOME);
    there[0] = 1.6;
    cell.lead(0, &mut target, &there, 20);
    assert!(cell.rig.speed(0) > 0.8, "{}", cell.rig.speed(0));
    cell.take_world(|world| world.add(post()).unwrap());
    cell.lead(0, &mut target, &there, 150);
    // At rest before it, and close to it; the status and one event say so.
    assert_eq!(cell.rig.speed(0), 0.0);
    let clearance = cell.distance_to("post");
    assert!((0.008..0.03).contains(&clearance), "{clearance}");
    let Bound::Guard(pair) = cell.rig.tasks[0].bound else { panic!("{:?}", cell.rig.tasks[0]) };
    assert!(pair.link.as_str().starts_with("arm/link") && pair.other.as_str() == "post", "{pair:?}");
    assert!(pair.distance > 0.0 && pair.distance < clearance + 1e-3, "{pair:?} at {clearance}");
    assert_eq!((cell.rig.tasks[0].state, cell.rig.phase(0)), (TaskState::Executing, Phase::Ready));
    let stops = blocked(&cell);
    assert!((1..6).contains(&stops), "{:?}", cell.rig.events);
    // It stays at rest without further events, and follows when the stream leads away.
    cell.hold(0, &target, 100);
    assert_eq!((blocked(&cell), cell.rig.speed(0)), (stops, 0.0));
    cell.lead(0, &mut target, &HOME, 150);
    assert!((cell.q()[0] - HOME[0]).abs() < 1e-6, "{:?}", cell.q());
    assert_eq!(cell.rig.tasks[0].bound, Bound::None);
}

#[test]
fn an_arm_that_is_closer_than_the_margin_may_move_away_and_not_closer() {
    let mut cell = Guarded::new(bench(), &HOME, FAST, stream());
    // A wall 3 mm beside the hand.
    let mut at = 0.5;
    let wall = |y: f64| cuboid("wall", [0.8, 0.02, 1.6], [0.6, y, 0.8]);
    for _ in 0..40 {
        cell.take_world(|world| world.put(wall(at)).unwrap());
        at -= cell.distance_to("wall") - 0.003;
    }
    cell.take_world(|world| world.put(wall(at)).unwrap());
    let near = cell.distance_to("wall");
    assert!((0.002..0.004).contains(&near), "{near}");
    let mut target = HOME.to_vec();
    let mut closer = HOME;
    closer[0] = 0.5;
    cell.lead(0, &mut target, &closer, 100);
    assert!(cell.distance_to("wall") > near - 1e-4, "{}", cell.distance_to("wall"));
    assert!(blocked(&cell) > 0);
    let mut away = HOME;
    away[0] = -0.5;
    cell.lead(0, &mut target, &away, 200);
    assert!((cell.q()[0] + 0.5).abs() < 1e-6, "{:?}: {:?}", cell.q(), cell.rig.tasks[0]);
    // Back again it keeps the whole margin.
    cell.lead(0, &mut target, &closer, 300);
    assert!(cell.distance_to("wall") > MARGINS.0 - 1e-3, "{}", cell.distance_to("wall"));
}

#[test]
fn a_velocity_stream_into_the_table_stops_before_it() {
    let mut cell = Guarded::new(bench(), &HOME, FAST, stream());
    for _ in 0..400 {
        cell.rig.velocity(1, &[0.0, 1.0, 0.0, 0.3, 0.0, 0.5, 0.0]);
        cell.tick();
    }
    let state = (blocked(&cell), cell.distance_to("table"), cell.q(), cell.rig.tasks[1].bound);
    assert!(cell.rig.speed(0) == 0.0 && (1..10).contains(&state.0), "{} rad/s: {state:?}", cell.rig.speed(0));
    for _ in 0..100 {
        cell.rig.velocity(1, &[0.0, -0.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
        cell.tick();
    }
    assert!(cell.distance_to("table") > 0.1, "{}", cell.distance_to("table"));
}

/// Both arms are sent to where the other one is; each counts on the other's braking path.
#[test]
fn two_arms_that_approach_each_other_both_stop_and_can_part() {
    let tasks = vec![task("left", servo(), 0..7, 10), task("right", servo(), 7..14, 10)];
    let mut cell = Guarded::new(cell(), &home(), FAST, tasks);
    let (mut left, mut right) = (home()[..7].to_vec(), home()[7..].to_vec());
    // Stretched towards each other.
    let reaching = [0.0, 0.4, 0.0, -1.6, 0.0, 2.0, 0.785];
    for _ in 0..300 {
        for (task, target) in [&mut left, &mut right].into_iter().enumerate() {
            for (at, goal) in target.iter_mut().zip(&reaching) {
                *at += (goal - *at).clamp(-0.02, 0.02);
            }
            let target = target.clone();
            cell.rig.servo(task as u16, &target);
        }
        cell.tick();
    }
    assert!(blocked(&cell) >= 1 && cell.rig.speed(0).max(cell.rig.speed(1)) == 0.0, "{:?}", cell.rig.tasks);
    assert!((0.008..0.06).contains(&cell.distance_to("right")), "{}", cell.distance_to("right"));
    // One goes home while the other one still pushes.
    for _ in 0..400 {
        let mut target = left.clone();
        for (at, goal) in target.iter_mut().zip(&home()[..7]) {
            *at += (goal - *at).clamp(-0.02, 0.02);
        }
        left.clone_from(&target);
        cell.rig.servo(0, &target);
        cell.rig.servo(1, &right);
        cell.tick();
    }
    let off = cell.q()[..7].iter().zip(&home()[..7]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(off < 1e-6, "{off}: {:?}", cell.rig.tasks[0]);
}

#[test]
fn a_trajectory_towards_an_arm_that_follows_a_stream_ends_before_contact() {
    let tasks = vec![task("left", servo(), 0..7, 10), task("right", trajectory(), 7..14, 10)];
    let mut cell = Guarded::new(cell(), &home(), FAST, tasks);
    let mut left = home()[..7].to_vec();
    let reaching = [0.0, 0.4, 0.0, -1.6, 0.0, 2.0, 0.785];
    cell.lead(0, &mut left, &reaching, 200);
    let joints: Vec<u16> = (7..14).collect();
    let sent = motion(1, &joints, &[(0.0, &home()[7..]), (2.5, &reaching)]);
    let id = cell.rig.send(Request::Execute { task: 1, motion: sent });
    cell.hold(0, &left, 300);
    assert_eq!(cell.rig.outcome(id), Outcome::Accepted);
    assert_eq!((cell.rig.tasks[1].state, cell.rig.tasks[1].reason), (TaskState::Aborted, Reason::Guarded(1)));
    assert!(cell.distance_to("right") > 0.008, "{}", cell.distance_to("right"));
}

#[test]
fn the_first_arms_trajectory_ends_as_well() {
    let tasks = vec![task("left", trajectory(), 0..7, 10), task("right", servo(), 7..14, 10)];
    let mut cell = Guarded::new(cell(), &home(), FAST, tasks);
    let mut right = home()[7..].to_vec();
    let reaching = [0.0, 0.4, 0.0, -1.6, 0.0, 2.0, 0.785];
    cell.lead(1, &mut right, &reaching, 200);
    let joints: Vec<u16> = (0..7).collect();
    let sent = motion(1, &joints, &[(0.0, &home()[..7]), (2.5, &reaching)]);
    let id = cell.rig.send(Request::Execute { task: 0, motion: sent });
    cell.hold(1, &right, 300);
    assert_eq!(cell.rig.outcome(id), Outcome::Accepted);
    assert_eq!((cell.rig.tasks[0].state, cell.rig.tasks[0].reason), (TaskState::Aborted, Reason::Guarded(0)));
}

/// Its zeros would be somewhere, and no arm is there.
#[test]
fn an_arm_that_was_never_read_is_in_nothings_way() {
    let tasks = || vec![task("left", servo(), 0..7, 10)];
    let mut world = World::new();
    for (name, x) in [("left", 0.0), ("right", 0.75)] {
        world.add_robot(robot("fer", name, DAffine3::from_translation(DVec3::new(x, 0.0, 0.0)))).unwrap();
    }
    let reaching = [0.0, 1.2, 0.0, -0.4, 0.0, 0.1, 0.785];
    let reached = |known: bool| {
        let mut cell = Guarded::unready(world.clone(), &[HOME, [0.0; 7]].concat(), FAST, tasks());
        cell.rig.arms[1].silent = !known;
        cell.rig.arms[1].enabled = false;
        cell.rig.run(2);
        assert_eq!(cell.rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
        cell.rig.run_for(0.3);
        cell.take_world(|_| {});
        let mut target = HOME.to_vec();
        for _ in 0..200 {
            for (at, goal) in target.iter_mut().zip(&reaching) {
                *at += (goal - *at).clamp(-0.02, 0.02);
            }
            cell.rig.servo(0, &target);
            cell.rig.tick();
        }
        (cell.rig.arms[0].q[1], blocked(&cell))
    };
    let ((with, stops), (without, none)) = (reached(true), reached(false));
    assert!(stops > 0 && with < 1.1, "{with} {stops}");
    assert!(none == 0 && (without - 1.2).abs() < 1e-6, "{without} {none}");
}

/// The world of the guard is not in the log: its verdicts are.
#[test]
fn a_guarded_run_replays_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("guarded.mcap");
    let mut config = one_arm(7);
    config.tasks = vec![task("servo", servo(), 0..7, 10)];
    let mut run = VirtualRun::start(&config, &log);
    run.states[0].position = joints_of(&HOME);
    let mut world = bench();
    world.add(post()).unwrap();
    let own = OwnMargins::of(&world.snapshot(), MARGINS.1, &GuardSettings::default());
    run.coordinator.set_guard(Some(prepared(&world.snapshot(), &own, &HOME)));
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..40).for_each(|_| run.step());
    let mut target = HOME;
    for k in 0..700 {
        target[0] += match k {
            0..200 => 0.01,
            200..400 => -0.01,
            _ => 0.0,
        };
        run.ask(Request::Servo { task: 0, target: joints_of(&target) });
        run.step();
        if k == 199 {
            assert!(matches!(run.tasks[0].bound, Bound::Guard(_)), "{:?}", run.tasks[0]);
        }
    }
    assert!(run.states[0].position[0].abs() < 1e-6, "{}: {:?}", run.states[0].position[0], run.tasks[0]);
    run.finish();
    let found = verify(&log, &TaskTable::builtin()).unwrap();
    assert_eq!(found.finding, Finding::Reproducible, "{found:?}");
}
