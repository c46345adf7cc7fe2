use super::jacobian::{Column, manipulability, smallest_singular_value};
use super::step::{Bound, JointMotion, Step, StepSettings, Stepper, TargetTwist, rotation_between};
use super::*;
use crate::random::Random;
use crate::urdf::from_text;
use dimos_core::joint::JointBounds;

/// Seven joints: revolute about odd axes, one prismatic, one mimic, one fixed in between.
const ROBOT: &str = r#"<robot name="r"><link name="base"/><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<link name="e"/><link name="f"/><link name="g"/><link name="h"/><link name="tool"/>
<joint name="j1" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 0.3" rpy="0.1 0.2 0.3"/><axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
<joint name="j2" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.1 0 0.1" rpy="1.5 0 0"/><axis xyz="0 1 1"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="weld" type="fixed"><parent link="b"/><child link="c"/><origin xyz="0 0.3 0" rpy="0 0.4 0"/></joint>
<joint name="j3" type="prismatic"><parent link="c"/><child link="d"/><origin xyz="0 0 0.1"/><axis xyz="1 0 0"/><limit lower="-0.2" upper="0.4" velocity="1" effort="1"/></joint>
<joint name="j4" type="continuous"><parent link="d"/><child link="e"/><origin xyz="0.2 0 0"/><axis xyz="0 -1 0"/></joint>
<joint name="j5" type="revolute"><parent link="e"/><child link="f"/><origin xyz="0.2 0.1 0" rpy="0 0 1"/><axis xyz="1 0 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="j6" type="revolute"><parent link="f"/><child link="g"/><origin xyz="0.1 0 0.2"/><axis xyz="0 0 -1"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
<joint name="j7" type="revolute"><parent link="g"/><child link="h"/><origin xyz="0 0.1 0.1"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="1" effort="1"/><mimic joint="j5" multiplier="-0.5" offset="0.1"/></joint>
<joint name="hand" type="fixed"><parent link="h"/><child link="tool"/><origin xyz="0 0 0.15" rpy="0 1 0"/></joint></robot>"#;

fn robot() -> RobotModel {
    from_text("r.urdf", ROBOT).unwrap()
}

fn random_q(kinematics: &Kinematics, random: &mut Random) -> Vec<f64> {
    let sample = |l: &Limits| random.between(l.lower.max(-3.0), l.upper.min(3.0));
    kinematics.limits().iter().map(sample).collect()
}

#[test]
fn frames_are_those_of_the_plain_product_of_joints() {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    assert_eq!(kinematics.dof(), 6);
    let (mut random, mut frames) = (Random::new(1), kinematics.frames());
    for _ in 0..200 {
        let q = random_q(&kinematics, &mut random);
        let named = kinematics.names().iter().cloned().zip(q.iter().copied()).collect();
        let expected = model.link_poses(&model.positions(&named));
        kinematics.forward(&q, &mut frames);
        for (link, expected) in expected.iter().enumerate() {
            let found = kinematics.link_frame(link, &frames);
            assert!(found.abs_diff_eq(frame(expected), 1e-12), "link {link}");
            assert!((pose(&found).inverse() * expected).rotation.angle() < 1e-7);
        }
    }
}

#[test]
fn joints_that_are_not_selected_are_fixed_at_their_given_position() {
    let model = robot();
    let rest: Vec<f64> = vec![0.5; model.joints.len()];
    let some = Kinematics::new(&model, &[1, 5], &rest).unwrap();
    let mut q: Vec<f64> = rest.clone();
    (q[1], q[5], q[7]) = (0.3, -0.2, 0.2);
    let tool = model.link_index("tool").unwrap();
    let mut frames = some.frames();
    assert_eq!(frames.len(), 4);
    some.forward(&[0.3, -0.2], &mut frames);
    assert!(some.link_frame(tool, &frames).abs_diff_eq(frame(&model.link_poses(&q)[tool]), 1e-12));
    assert!(matches!(Kinematics::new(&model, &[2], &[]), Err(KinematicsError::NotIndependent(..))));
    assert!(matches!(Kinematics::new(&model, &[7], &[]), Err(KinematicsError::NotIndependent(..))));
    assert!(matches!(Kinematics::new(&model, &[1, 1], &[]), Err(KinematicsError::Twice(_))));
}

#[test]
fn the_jacobian_is_the_derivative() {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    let tool = model.link_index("tool").unwrap();
    let (mut random, mut frames) = (Random::new(2), kinematics.frames());
    let mut columns = vec![[0.0; 6]; 6];
    for _ in 0..100 {
        let q = random_q(&kinematics, &mut random);
        kinematics.forward(&q, &mut frames);
        kinematics.jacobian(tool, &frames, &mut columns);
        for j in 0..6 {
            let mut at = |d: f64| {
                let mut moved = q.clone();
                moved[j] += d;
                kinematics.forward(&moved, &mut frames);
                kinematics.link_frame(tool, &frames)
            };
            let (before, after) = (at(-1e-6), at(1e-6));
            let linear = (after.translation - before.translation) / 2e-6;
            let angular = rotation_between(&before.matrix3, &after.matrix3) / 2e-6;
            for (a, b) in columns[j].iter().zip(linear.to_array().into_iter().chain(angular.to_array())) {
                assert!((a - b).abs() < 1e-6, "joint {j}: {:?} {linear} {angular}", columns[j]);
            }
        }
        let product: f64 = manipulability(&columns);
        assert!(product >= 0.0 && smallest_singular_value(&columns, 0.3).is_finite());
    }
}

#[test]
fn no_point_moves_more_than_the_lever_bounds() {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    let tool = model.link_index("tool").unwrap();
    let body = kinematics.body_of(tool);
    let point = DVec3::new(0.05, -0.1, 0.2);
    let levers = kinematics.levers(body, point.length());
    let (mut random, mut frames) = (Random::new(3), kinematics.frames());
    for _ in 0..2000 {
        let (a, mut b) = (random_q(&kinematics, &mut random), random_q(&kinematics, &mut random));
        let part = random.unit();
        b.iter_mut().zip(&a).for_each(|(b, a)| *b = a + (*b - a) * part);
        let mut at = |q: &[f64]| {
            kinematics.forward(q, &mut frames);
            frames[body].transform_point3(point)
        };
        let moved = at(&a).distance(at(&b));
        let bound: f64 = levers
            .iter()
            .map(|(body, lever)| {
                let (j, factor) = kinematics.drive(*body).unwrap();
                lever * factor.abs() * (b[j] - a[j]).abs()
            })
            .sum();
        assert!(moved <= bound + 1e-12, "{moved} {bound}");
    }
}

/// Steps of the tool, and bounds for its joints: the model's positions, one speed and acceleration for all.
fn stepper(velocity: f64, acceleration: f64) -> (Stepper, Vec<JointBounds>) {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    let bound =
        |l: &Limits| JointBounds { lower: l.lower, upper: l.upper, velocity, acceleration, jerk: f64::INFINITY };
    let bounds = kinematics.limits().iter().map(bound).collect();
    (Stepper::new(kinematics, model.link_index("tool").unwrap(), StepSettings::default()), bounds)
}

fn standing(q: &[f64]) -> JointMotion {
    JointMotion { position: dimos_core::joint::joints_of(q), ..JointMotion::default() }
}

fn up(speed: f64) -> TargetTwist {
    TargetTwist { linear: DVec3::new(0.0, 0.0, speed), angular: DVec3::ZERO, horizon: f64::INFINITY }
}

#[test]
fn steps_follow_a_twist_within_speeds_and_limits() {
    let (mut stepper, bounds) = stepper(0.5, 1e6);
    let (mut random, mut followed) = (Random::new(4), 0);
    for _ in 0..500 {
        let q = random_q(stepper.kinematics(), &mut random);
        let mut joints = standing(&q);
        let start = stepper.pose(&q);
        let wish =
            TargetTwist { linear: DVec3::new(random.between(-0.1, 0.1), random.between(-0.1, 0.1), 0.1), ..up(0.0) };
        let step = stepper.step(&mut joints, &wish, &bounds, 0.01);
        for ((x, y), b) in joints.position.iter().zip(&q).zip(&bounds) {
            assert!((x - y).abs() <= 0.5 * 0.01 + 1e-12 && *x <= b.upper && *x >= b.lower);
        }
        let moved = stepper.pose(&joints.position).translation - start.translation;
        if step.bound == Bound::None {
            followed += 1;
            assert!((moved - wish.linear * 0.01).length() < 1e-4, "{moved} {wish:?} {step:?}");
        } else {
            assert!(step.pace < 1.0 && moved.length() < 0.05);
        }
    }
    assert!(followed > 100, "{followed}");
    let mut joints = standing(&[0.0; 6]);
    let bad = stepper.step(&mut joints, &up(f64::NAN), &bounds, 0.01);
    assert_eq!((bad.bound, joints), (Bound::Invalid, standing(&[0.0; 6])));
}

/// Any limit slows the motion, all joints by the same factor.
#[test]
fn a_motion_that_is_too_fast_keeps_its_direction() {
    let (mut fast, wide) = stepper(1e6, 1e9);
    let (mut slow, narrow) = stepper(0.1, 1e9);
    let (mut random, mut bounded) = (Random::new(5), 0);
    for _ in 0..300 {
        let q = random_q(fast.kinematics(), &mut random);
        let wish =
            TargetTwist { angular: DVec3::new(random.between(-1.0, 1.0), 0.5, 0.0), ..up(random.between(-0.3, 0.3)) };
        let (mut a, mut b) = (standing(&q), standing(&q));
        let free = fast.step(&mut a, &wish, &wide, 0.001);
        let held = slow.step(&mut b, &wish, &narrow, 0.001);
        if let Bound::Velocity(joint) = held.bound {
            bounded += 1;
            assert!((b.velocity[joint].abs() - 0.1).abs() < 1e-9);
            let part = held.pace / free.pace;
            assert!(a.velocity.iter().zip(&b.velocity).all(|(a, b)| (a * part - b).abs() < 1e-9), "{a:?} {b:?}");
        }
    }
    assert!(bounded > 100, "{bounded}");
}

#[test]
fn a_motion_into_a_limit_decelerates_before_it_and_can_leave_it() {
    let (mut stepper, bounds) = stepper(1.0, 2.0);
    let mut joints = standing(&[0.0, 1.9, 0.1, 0.3, 0.2, 0.1]);
    let run = |stepper: &mut Stepper, joints: &mut JointMotion, speed: f64| {
        let mut last = Step::default();
        for _ in 0..3000 {
            let before = *joints;
            last = stepper.step(joints, &up(speed), &bounds, 0.01);
            for (((q, v), was), b) in joints.position.iter().zip(&joints.velocity).zip(&before.velocity).zip(&bounds) {
                assert!(*q <= b.upper && *q >= b.lower, "{joints:?}");
                assert!(v.abs() <= 1.0 + 1e-9 && (v - was).abs() <= 2.0 * 0.01 + 1e-9, "{was} {joints:?}");
            }
        }
        last
    };
    let end = run(&mut stepper, &mut joints, -0.1);
    assert!(matches!(end.bound, Bound::Position(_)), "{end:?} {joints:?}");
    assert!(joints.velocity.iter().all(|v| v.abs() < 1e-6), "{joints:?}");
    let stopped = stepper.pose(&joints.position).translation.z;
    for _ in 0..200 {
        stepper.step(&mut joints, &up(0.1), &bounds, 0.01);
    }
    assert!(stepper.pose(&joints.position).translation.z > stopped + 0.01);
}

#[test]
fn kinematics_are_unchanged_by_a_log() {
    let kinematics = Kinematics::whole(&robot()).unwrap();
    let json = serde_json::to_string(&kinematics).unwrap();
    let again: Kinematics = serde_json::from_str(&json).unwrap();
    assert_eq!(again, kinematics);
    // A body whose parent comes later would loop forever.
    let mut odd: serde_json::Value = serde_json::from_str(&json).unwrap();
    odd["bodies"][2]["parent"] = serde_json::json!(2);
    assert!(serde_json::from_value::<Kinematics>(odd.clone()).is_err());
    odd["bodies"][2]["parent"] = serde_json::json!(1);
    odd["bodies"][2]["variable"] = serde_json::json!(6);
    assert!(serde_json::from_value::<Kinematics>(odd).is_err());
}

#[test]
fn solving_with_cholesky_solves() {
    let mut random = Random::new(6);
    let columns: Vec<Column> = (0..7).map(|_| std::array::from_fn(|_| random.between(-1.0, 1.0))).collect();
    let matrix = jacobian::gram(&columns, 0.1);
    let b: Column = std::array::from_fn(|_| random.between(-1.0, 1.0));
    let x = jacobian::solve(&jacobian::cholesky(&matrix).unwrap(), &b);
    for (row, b) in matrix.iter().zip(&b) {
        assert!((row.iter().zip(&x).map(|(a, x)| a * x).sum::<f64>() - b).abs() < 1e-12);
    }
}
