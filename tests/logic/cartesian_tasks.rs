//! Cartesian tasks on a virtual clock: poses are reached, twists followed, and everything that may happen to a stream
//! ends in a hold. The rig checks that no command breaks a limit of the arm.

use std::f64::consts::PI;
use std::sync::LazyLock;

use dimos::control::config::*;
use dimos::control::request::{Goal, Request};
use dimos::robot::kinematics::Kinematics;
use dimos::robot::{Source, load};
use dimos::telemetry::{Bound, Event, Outcome, Phase, Reason, TaskState};
use glamx::{DAffine3, DQuat, DVec3};

use crate::support::rig::*;

/// A pose away from every singular one.
const HOME: [f64; 6] = [0.2, -0.3, 0.9, 0.3, 0.8, 0.1];
const POSES: u16 = 0;
const TWISTS: u16 = 1;

fn robot() -> TaskKinematics {
    static ROBOT: LazyLock<TaskKinematics> = LazyLock::new(|| {
        let model = load(&Source::new("builtin:yourarm")).into_model().unwrap();
        let link = model.link_index("flange").unwrap();
        TaskKinematics::new(Kinematics::whole(&model).unwrap(), link)
    });
    ROBOT.clone()
}

/// An arm with both tasks, and a trajectory task above and one below them; ready at a pose.
fn rig_at(q: &[f64; 6], poses: TaskKinematics, twists: &CartesianParams) -> Rig {
    let tasks = vec![
        task("poses", TaskKind::new("cartesian_ik", &CartesianParams::default()).of_robot(poses), 0..6, 20),
        task("twists", TaskKind::new("eef_twist", twists).of_robot(robot()), 0..6, 20),
        task("above", trajectory(), 0..6, 30),
        task("below", trajectory(), 0..6, 10),
        task("speeds", velocity(), 0..6, 10),
    ];
    let mut rig = Rig::new(100.0, vec![arm("arm", 6)], tasks);
    rig.arms[0].q = q.to_vec();
    rig.make_ready();
    rig
}

fn rig() -> Rig {
    rig_at(&HOME, robot(), &CartesianParams::default())
}

fn flange(q: &[f64]) -> DAffine3 {
    let p = robot();
    let mut frames = p.kinematics.frames();
    p.kinematics.forward(q, &mut frames);
    p.kinematics.link_frame(p.link, &frames)
}

fn commanded(rig: &Rig) -> DAffine3 {
    flange(&rig.commanded(0))
}

fn pose_of(frame: &DAffine3) -> Goal {
    Goal::Pose { position: frame.translation.to_array(), orientation: DQuat::from_mat3(&frame.matrix3).to_array() }
}

fn twist(linear: [f64; 3], angular: [f64; 3]) -> Goal {
    Goal::Twist { linear, angular, tool: false }
}

/// Distance [m] and angle [rad] between two frames.
fn between(a: &DAffine3, b: &DAffine3) -> (f64, f64) {
    let turn = DQuat::from_mat3(&(a.matrix3.transpose() * b.matrix3));
    (a.translation.distance(b.translation), 2.0 * turn.w.abs().min(1.0).acos())
}

fn steer(rig: &mut Rig, task: u16, goal: Goal) -> Outcome {
    rig.ask(Request::CartesianTarget { task, goal })
}

/// Repeats a goal every 20 ms.
fn stream(rig: &mut Rig, task: u16, goal: Goal, seconds: f64, mut after: impl FnMut(&Rig)) {
    for k in 0..(seconds * 100.0) as u32 {
        if k % 2 == 0 {
            rig.send(Request::CartesianTarget { task, goal });
        }
        rig.tick();
        after(rig);
    }
}

#[test]
fn a_pose_is_reached_smoothly_within_a_millimetre_and_a_tenth_of_a_degree() {
    let mut reached = 0;
    let mut random = 12345u64;
    let mut unit = || {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        (random >> 33) as f64 / (1u64 << 31) as f64 * 2.0 - 1.0
    };
    for _ in 0..20 {
        let mut rig = rig();
        let mut goal = HOME;
        goal.iter_mut().for_each(|q| *q += 0.35 * unit());
        let (target, start) = (flange(&goal), commanded(&rig));
        let line = target.translation - start.translation;
        let (mut farthest, mut astray, mut fastest) = (0.0f64, 0.0f64, 0.0f64);
        let mut last = start;
        stream(&mut rig, POSES, pose_of(&target), 8.0, |rig| {
            let at = commanded(rig);
            let along = (at.translation - start.translation).dot(line.normalize());
            farthest = farthest.max(along);
            astray = astray.max((at.translation - start.translation - line.normalize() * along).length());
            fastest = fastest.max(at.translation.distance(last.translation) / 0.01);
            last = at;
        });
        let (distance, angle) = between(&commanded(&rig), &target);
        assert!(distance < 1e-3 && angle < 0.1f64.to_radians(), "{goal:?}: {distance} {angle} {:?}", rig.tasks[0]);
        assert!(farthest < line.length() + 1e-3, "overshoot: {farthest} of {}", line.length());
        assert!(astray < 5e-3, "off the straight line by {astray}");
        assert!(fastest < 0.25 * 1.01, "{fastest}");
        assert_eq!(rig.speed(0), 0.0, "it is at rest there");
        assert_eq!(rig.tasks[0].state, TaskState::Executing);
        reached += 1;
    }
    assert_eq!(reached, 20);
}

/// Poses are relative to the robot's base, not to the model's root frame.
#[test]
fn poses_are_in_the_frame_that_the_root_is_placed_in() {
    let turn = DQuat::from_rotation_z(PI / 2.0);
    let root = DAffine3::from_rotation_translation(turn, DVec3::new(1.0, 2.0, 0.5));
    let place = FramePose { position: root.translation.to_array(), orientation: turn.to_array() };
    let mut rig = rig_at(&HOME, TaskKinematics { root: place, ..robot() }, &CartesianParams::default());
    let mut goal = HOME;
    goal[0] += 0.2;
    stream(&mut rig, POSES, pose_of(&(root * flange(&goal))), 4.0, |_| {});
    let (distance, angle) = between(&commanded(&rig), &flange(&goal));
    assert!(distance < 1e-6 && angle < 1e-6, "{distance} {angle}");
}

#[test]
fn a_twist_is_followed_in_the_base_s_axes_and_in_the_tool_s() {
    for tool in [false, true] {
        let mut rig = rig();
        let goal = Goal::Twist { linear: [0.0, 0.08, 0.05], angular: [0.0, 0.0, 0.2], tool };
        stream(&mut rig, TWISTS, goal, 0.5, |_| {});
        let before = commanded(&rig);
        stream(&mut rig, TWISTS, goal, 0.02, |_| {});
        let after = commanded(&rig);
        let axes = if tool { before.matrix3 } else { DAffine3::IDENTITY.matrix3 };
        let moved = (after.translation - before.translation) / 0.02;
        assert!((moved - axes * DVec3::new(0.0, 0.08, 0.05)).length() < 1e-3, "{moved}");
        let turned = dimos::robot::kinematics::step::rotation_between(&before.matrix3, &after.matrix3) / 0.02;
        assert!((turned - axes * DVec3::new(0.0, 0.0, 0.2)).length() < 2e-3, "{turned}");
    }
}

#[test]
fn what_is_too_fast_for_the_task_is_slowed_down_as_a_whole() {
    let mut rig = rig();
    stream(&mut rig, TWISTS, twist([0.0, 5.0, 5.0], [0.0; 3]), 0.6, |_| {});
    let before = commanded(&rig);
    stream(&mut rig, TWISTS, twist([0.0, 5.0, 5.0], [0.0; 3]), 0.02, |_| {});
    let moved = (commanded(&rig).translation - before.translation) / 0.02;
    assert!((moved.length() - 0.25).abs() < 2e-3 && (moved.y - moved.z).abs() < 2e-3, "{moved}");
}

/// The joints' limits slow all joints down by the same factor: the way stays straight.
#[test]
fn joint_limits_keep_the_direction() {
    let wide =
        CartesianParams { max_linear_velocity: 3.0, max_linear_acceleration: 20.0, ..CartesianParams::default() };
    let mut rig = rig_at(&HOME, robot(), &wide);
    let start = commanded(&rig);
    let (mut bound, mut astray) = (false, 0.0f64);
    stream(&mut rig, TWISTS, twist([0.0, 3.0, 0.0], [0.0; 3]), 0.7, |rig| {
        bound |= matches!(rig.tasks[1].bound, Bound::Velocity(_));
        let moved = commanded(rig).translation - start.translation;
        astray = astray.max(moved.x.hypot(moved.z) - 0.02 * moved.y);
    });
    assert!(bound, "nothing was too fast");
    assert!(commanded(&rig).translation.y - start.translation.y > 0.1);
    assert!(astray < 1e-3, "{astray}");
}

#[test]
fn a_stream_that_stops_decelerates_into_a_hold() {
    for (task, goal) in
        [(POSES, pose_of(&flange(&[0.5, 0.0, 0.9, 0.3, 0.8, 0.1]))), (TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]))]
    {
        let mut rig = rig();
        assert_eq!(steer(&mut rig, task, goal), Outcome::Accepted);
        rig.run_for(0.29);
        assert!(rig.speed(0) > 0.1, "it moves");
        rig.run_until(1.0, |rig| rig.tasks[task as usize].state == TaskState::Idle);
        assert_eq!(rig.tasks[task as usize].reason, Reason::Timeout);
        assert!(rig.reported(Event::Task(task, TaskState::Executing, Reason::Timeout)), "it reports why it slows down");
        assert_eq!(rig.speed(0), 0.0);
        let held = rig.commanded(0);
        rig.run_for(1.0);
        assert_eq!(rig.commanded(0), held);
        assert_eq!(rig.phase(0), Phase::Ready);
    }
}

/// A peer's task begins each hold where the arm is measured, and so sinks under gravity.
#[test]
fn an_arm_that_sags_does_not_creep() {
    for goal in [None, Some(twist([0.0; 3], [0.0; 3]))] {
        let mut rig = rig();
        rig.arms[0].sag = 0.05;
        rig.arms[0].lag = 0.05;
        rig.run_for(1.0);
        let before = rig.commanded(0);
        let here = pose_of(&flange(&before));
        let (task, goal) = goal.map_or((POSES, here), |goal| (TWISTS, goal));
        for _ in 0..20 {
            // Streams that begin, end and begin again.
            stream(&mut rig, task, goal, 1.0, |_| {});
            rig.run_for(0.5);
        }
        let crept = rig.commanded(0).iter().zip(&before).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(crept < 1e-9, "{crept}");
        let sunk = rig.arms[0].q.iter().zip(&before).map(|(a, b)| (a - b + 0.05).abs()).fold(0.0, f64::max);
        assert!(sunk < 1e-6, "{sunk}");
    }
}

#[test]
fn an_arm_that_does_not_follow_is_held_and_says_why() {
    let mut rig = rig();
    stream(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]), 0.3, |_| {});
    rig.arms[0].blocked = true;
    let began = rig.commanded(0);
    stream(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]), 1.5, |_| {});
    let Reason::TrackingError(joint, error) = rig.tasks[1].reason else { panic!("{:?}", rig.tasks[1]) };
    assert!(error.abs() > 0.1745 && error.abs() < 0.25, "{joint} {error}");
    assert_eq!(rig.tasks[1].state, TaskState::Aborted);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "tracking"));
    // That error, and the way to brake.
    assert!(rig.commanded(0).iter().zip(&began).all(|(a, b)| (a - b).abs() < 0.2 + V_MAX * V_MAX / (2.0 * A_MAX)));
    // It does not start again before a reset.
    let again = steer(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]));
    assert!(matches!(again, Outcome::ArmLatched(..)), "{again:?}");
}

#[test]
fn bad_goals_are_refused_and_stop_the_stream() {
    let mut rig = rig();
    let here = commanded(&rig).translation.to_array();
    let pose = |orientation: [f64; 4]| Goal::Pose { position: here, orientation };
    for bad in [
        pose([0.0; 4]),
        pose([0.0, 0.0, 0.0, 1.1]),
        pose([f64::NAN, 0.0, 0.0, 1.0]),
        Goal::Pose { position: [f64::INFINITY, 0.0, 0.0], orientation: [0.0, 0.0, 0.0, 1.0] },
    ] {
        assert_eq!(steer(&mut rig, POSES, bad), Outcome::InvalidTarget(POSES), "{bad:?}");
        assert_eq!(rig.tasks[0].state, TaskState::Idle);
    }
    stream(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]), 0.4, |_| {});
    assert!(rig.speed(0) > 0.1);
    let bad = twist([0.0, f64::NAN, 0.0], [0.0; 3]);
    assert_eq!(steer(&mut rig, TWISTS, bad), Outcome::InvalidTarget(TWISTS));
    rig.run_for(0.6);
    assert_eq!((rig.speed(0), rig.tasks[1].state), (0.0, TaskState::Idle));
    // Numbers that are finite and make none.
    let far = Goal::Pose { position: [1e308, -1e308, 1e308], orientation: [0.0, 0.0, 0.0, 1.0] };
    assert_eq!(steer(&mut rig, POSES, far), Outcome::Accepted);
    assert_eq!(steer(&mut rig, TWISTS, pose([0.0, 0.0, 0.0, 1.0])), Outcome::WrongTask(TWISTS));
    assert_eq!(steer(&mut rig, 2, bad), Outcome::WrongTask(2));
    rig.run_for(1.0);
    assert_eq!(rig.phase(0), Phase::Ready);
}

/// With joint 5 straight, axes 4 and 6 are the same: it goes there slowly, moves no joint fast there, and comes back.
#[test]
fn near_a_singular_configuration_it_slows_down_and_says_so() {
    let mut rig = rig();
    let mut straight = HOME;
    straight[4] = 0.0;
    let mut seen = false;
    stream(&mut rig, POSES, pose_of(&flange(&straight)), 8.0, |rig| seen |= rig.tasks[0].bound == Bound::Singularity);
    assert!(seen && rig.commanded(0)[4].abs() < 0.1, "{:?} {:?}", rig.tasks[0], rig.commanded(0));
    let (mut fastest, start) = (0.0f64, commanded(&rig));
    stream(&mut rig, TWISTS, Goal::Twist { linear: [0.0; 3], angular: [0.5, 0.0, 0.0], tool: true }, 1.0, |rig| {
        fastest = fastest.max(rig.speed(0));
    });
    let (_, turned) = between(&commanded(&rig), &start);
    assert!(fastest < 0.5 && turned < 0.3 && turned > 0.01, "{fastest} {turned} {:?}", rig.tasks[1]);
    stream(&mut rig, POSES, pose_of(&flange(&HOME)), 8.0, |_| {});
    let (distance, angle) = between(&commanded(&rig), &flange(&HOME));
    assert!(distance < 1e-3 && angle < 2e-3, "{distance} {angle} {:?}", rig.tasks[0]);
}

#[test]
fn a_pose_out_of_reach_is_approached_and_held_without_shaking() {
    let mut rig = rig();
    let far =
        Goal::Pose { position: [2.0, 0.5, 0.6], orientation: DQuat::from_mat3(&flange(&HOME).matrix3).to_array() };
    stream(&mut rig, POSES, far, 12.0, |_| {});
    let mut fastest = 0.0f64;
    stream(&mut rig, POSES, far, 2.0, |rig| fastest = fastest.max(rig.speed(0)));
    assert!(fastest < 0.02, "it shakes at {fastest} rad/s: {:?}", rig.tasks[0]);
    assert_ne!(rig.tasks[0].bound, Bound::None);
}

#[test]
fn the_end_of_a_joint_s_range_stops_the_whole_motion() {
    let mut rig = rig();
    // Turning about the flange's own axis until joint 6 can no more.
    let goal = Goal::Twist { linear: [0.0; 3], angular: [0.0, 0.0, 1.0], tool: true };
    let start = commanded(&rig).translation;
    stream(&mut rig, TWISTS, goal, 4.0, |_| {});
    assert_eq!((rig.tasks[1].bound, rig.speed(0)), (Bound::Position(5), 0.0));
    assert!((rig.commanded(0)[5] - SOFT).abs() < 1e-4, "{:?}", rig.commanded(0));
    assert!(commanded(&rig).translation.distance(start) < 1e-3, "it stayed where it was");
}

#[test]
fn losing_a_joint_ends_the_motion_and_a_stream_takes_over_a_moving_arm() {
    let mut rig = rig();
    stream(&mut rig, TWISTS, twist([0.0, 0.1, 0.0], [0.0; 3]), 0.2, |_| {});
    // One joint is enough.
    let q = rig.commanded(0);
    assert_eq!(rig.execute(2, motion(1, &[5], &[(0.0, &[q[5]]), (1.0, &[q[5] + 0.1])])), Outcome::Accepted);
    assert_eq!(rig.tasks[1].state, TaskState::Aborted);
    assert!(matches!(rig.tasks[1].reason, Reason::Preempted(2, 5)), "{:?}", rig.tasks[1]);
    rig.run_for(1.5);
    // Over a trajectory of lower priority, in motion: it continues from there without a step back.
    let q = rig.commanded(0);
    let to: Vec<f64> = q.iter().map(|q| q - 0.3).collect();
    assert_eq!(rig.execute(3, motion(2, &[0, 1, 2, 3, 4, 5], &[(0.0, &q), (0.6, &to)])), Outcome::Accepted);
    rig.run_for(0.3);
    let moving = rig.commanded(0)[0];
    stream(&mut rig, TWISTS, twist([0.0; 3], [0.0; 3]), 0.5, |_| {});
    assert!(matches!(rig.tasks[3].reason, Reason::Preempted(1, _)), "{:?}", rig.tasks[3]);
    assert!(rig.commanded(0)[0] < moving && rig.speed(0) == 0.0);
}

#[test]
fn a_cancel_slows_down_in_the_same_direction_and_the_next_target_begins_again() {
    let mut rig = rig();
    stream(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]), 0.5, |_| {});
    let start = commanded(&rig).translation;
    assert_eq!(rig.ask(Request::Cancel { task: Some(TWISTS) }), Outcome::Cancelled);
    assert_eq!(rig.tasks[1].state, TaskState::Cancelling);
    rig.run_until(1.0, |rig| rig.tasks[1].state == TaskState::Idle);
    let moved = commanded(&rig).translation - start;
    assert!(moved.y > 0.01 && moved.x.hypot(moved.z) < 0.01 * moved.y, "{moved}");
    assert_eq!(rig.speed(0), 0.0);
    // A target while it slows down takes it up again.
    stream(&mut rig, TWISTS, twist([0.0, -0.2, 0.0], [0.0; 3]), 0.5, |_| {});
    rig.ask(Request::Cancel { task: None });
    assert_eq!(steer(&mut rig, TWISTS, twist([0.0, -0.2, 0.0], [0.0; 3])), Outcome::Accepted);
    assert_eq!((rig.tasks[1].state, rig.tasks[1].reason), (TaskState::Executing, Reason::None));
    assert!(rig.speed(0) > 0.1);
}

#[test]
fn a_stop_ends_it_and_a_velocity_task_hands_the_arm_over() {
    let mut rig = rig();
    stream(&mut rig, TWISTS, twist([0.0, 0.2, 0.0], [0.0; 3]), 0.3, |_| {});
    rig.send(Request::Stop { arm: None });
    rig.run_for(0.5);
    assert!(matches!(rig.tasks[1].reason, Reason::ArmHeld(0, _)), "{:?}", rig.tasks[1]);
    assert!(matches!(steer(&mut rig, TWISTS, twist([0.0; 3], [0.0; 3])), Outcome::ArmLatched(..)));
    rig.send(Request::Reset { arm: 0 });
    rig.run_for(0.1);
    rig.make_ready();
    for _ in 0..50 {
        rig.velocity(4, &[0.3, 0.0, 0.0, 0.0, 0.0, 0.0]);
        rig.tick();
    }
    // Another mode: it waits until the arm is at rest, and begins there.
    stream(&mut rig, TWISTS, twist([0.0, 0.1, 0.0], [0.0; 3]), 1.5, |_| {});
    assert_eq!(rig.tasks[1].state, TaskState::Executing);
    assert!(rig.speed(0) > 0.05);
}

#[test]
fn the_speed_override_slows_an_end_effector_and_pauses_it_on_its_way() {
    let mut rig = rig();
    let limits = CartesianParams::default();
    rig.ask(Request::Speed { fraction: 0.3 });
    rig.run_for(1.0);
    let mut before = commanded(&rig);
    let mut fastest = 0.0f64;
    stream(&mut rig, TWISTS, twist([limits.max_linear_velocity, 0.0, 0.0], [0.0; 3]), 0.6, |rig| {
        let now = commanded(rig);
        fastest = fastest.max(between(&before, &now).0 / 0.01);
        before = now;
    });
    let slow = 0.3 * limits.max_linear_velocity;
    assert!((fastest - slow).abs() < 0.02 * slow, "{fastest} m/s instead of {slow} m/s");

    rig.run_for(1.0);
    let goal = DAffine3::from_translation(DVec3::new(0.0, 0.05, 0.0)) * commanded(&rig);
    rig.ask(Request::Pause { on: true });
    rig.run_for(1.0);
    let start = commanded(&rig);
    stream(&mut rig, POSES, pose_of(&goal), 0.6, |_| {});
    assert_eq!(between(&start, &commanded(&rig)).0, 0.0, "paused");
    rig.ask(Request::Pause { on: false });
    stream(&mut rig, POSES, pose_of(&goal), 2.0, |_| {});
    assert!(between(&goal, &commanded(&rig)).0 < 1e-6);
}

/// The pose of the tool centre point is the goal, and a twist in the tool's axes turns about it.
#[test]
fn a_tool_is_what_moves_and_is_replaced_only_at_rest() {
    let turn = DQuat::from_rotation_y(0.5);
    let tool = FramePose { position: [0.0, 0.05, 0.1], orientation: turn.to_array() };
    let mut rig = rig_at(&HOME, TaskKinematics { tool, ..robot() }, &CartesianParams::default());
    let mut goal = HOME;
    goal[0] += 0.2;
    stream(&mut rig, POSES, pose_of(&(flange(&goal) * tool.frame())), 4.0, |_| {});
    let (distance, angle) = between(&commanded(&rig), &flange(&goal));
    assert!(distance < 1e-6 && angle < 1e-6, "{distance} {angle}");

    let set = |task, tool| Request::Tool { task, tool };
    assert_eq!(rig.ask(set(POSES, FramePose::SAME)), Outcome::AlreadyExecuting(POSES));
    assert_eq!(rig.ask(set(2, tool)), Outcome::WrongTask(2));
    assert_eq!(rig.ask(set(77, tool)), Outcome::WrongTask(77));
    let long = FramePose { position: [f64::NAN; 3], ..tool };
    assert_eq!(rig.ask(set(TWISTS, long)), Outcome::InvalidTarget(TWISTS));
    for _ in 0..100 {
        rig.tick();
    }
    assert_eq!(rig.ask(set(TWISTS, tool)), Outcome::Accepted);
    let tip = |rig: &Rig| commanded(rig) * tool.frame();
    let before = tip(&rig);
    stream(&mut rig, TWISTS, Goal::Twist { linear: [0.0; 3], angular: [0.0, 0.0, 0.3], tool: true }, 1.0, |_| {});
    let (distance, angle) = between(&before, &tip(&rig));
    assert!(distance < 1e-3 && angle > 0.1, "its centre point stays: {distance} m, {angle} rad");
}

/// Its limiter keeps the time that passes at the controller, the task that which passes here.
#[test]
fn a_slowed_arm_is_steered_no_faster_than_asked_and_rests_at_the_end() {
    for fraction in [0.5, 0.3, 0.1] {
        let mut rig = rig();
        rig.checked = false;
        rig.arms[0].state.speed_fraction = Some(fraction);
        let (mut last, mut fastest) = (commanded(&rig).translation, 0.0f64);
        let mut watch = |rig: &Rig| {
            let now = commanded(rig).translation;
            fastest = fastest.max(now.distance(std::mem::replace(&mut last, now)) / 0.01);
        };
        stream(&mut rig, TWISTS, twist([0.1, 0.0, 0.0], [0.0; 3]), 1.5, &mut watch);
        stream(&mut rig, TWISTS, twist([0.0; 3], [0.0; 3]), 2.0, &mut watch);
        assert!((0.1 * fraction..0.102).contains(&fastest), "{fastest} m/s at {fraction}");
        let rests = commanded(&rig).translation;
        stream(&mut rig, TWISTS, twist([0.0; 3], [0.0; 3]), 0.2, |_| ());
        assert!(commanded(&rig).translation.distance(rests) < 1e-6, "it moves on at {fraction}");
        assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.events);
    }
}
