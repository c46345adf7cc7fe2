use super::jacobian::{Column, manipulability, smallest_singular_value};
use super::step::{Bound, StepSettings, Stepper, rotation_between};
use super::*;
use crate::robot::random::Random;
use crate::robot::urdf::from_text;

/// Seven joints: revolute about odd axes, one prismatic, one follower, one fixed in between.
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
fn joints_that_are_not_chosen_stand_where_they_are_told() {
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
fn no_point_moves_more_than_the_levers_say() {
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

#[test]
fn steps_follow_a_twist_within_speeds_and_limits() {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    let tool = model.link_index("tool").unwrap();
    let mut stepper = Stepper::new(&kinematics, tool, StepSettings::default());
    let mut random = Random::new(4);
    let mut followed = 0;
    for _ in 0..500 {
        let mut q = random_q(&kinematics, &mut random);
        let before = q.clone();
        let start = stepper.pose(&kinematics, &q);
        let twist = DVec3::new(random.between(-1e-3, 1e-3), random.between(-1e-3, 1e-3), 1e-3);
        let velocity = [0.5; 6];
        let step = stepper.step(&kinematics, &mut q, twist, DVec3::ZERO, &velocity, 0.01);
        for ((x, y), l) in q.iter().zip(&before).zip(kinematics.limits()) {
            assert!((x - y).abs() <= 0.5 * 0.01 + 1e-12 && *x <= l.upper && *x >= l.lower);
        }
        let moved = stepper.pose(&kinematics, &q).translation - start.translation;
        if step.bound == Bound::None {
            followed += 1;
            assert!((moved - twist).length() < 1e-4, "{moved} {twist} {step:?}");
        } else {
            assert!(step.scale <= 1.0 && moved.length() < 0.05);
        }
    }
    assert!(followed > 100, "{followed}");
    let mut q = vec![0.0; 6];
    let bad = stepper.step(&kinematics, &mut q, DVec3::new(f64::NAN, 0.0, 0.0), DVec3::ZERO, &[1.0; 6], 0.01);
    assert_eq!((bad.bound, q.as_slice()), (Bound::Invalid, &[0.0; 6][..]));
}

#[test]
fn a_step_into_a_limit_stops_at_it_and_others_go_on() {
    let model = robot();
    let kinematics = Kinematics::whole(&model).unwrap();
    let tool = model.link_index("tool").unwrap();
    let mut stepper = Stepper::new(&kinematics, tool, StepSettings::default());
    let mut q = vec![0.0, 1.9, 0.1, 0.3, 0.2, 0.1];
    for _ in 0..2000 {
        stepper.step(&kinematics, &mut q, DVec3::new(0.0, 0.0, -1e-3), DVec3::ZERO, &[1.0; 6], 0.01);
        for (x, l) in q.iter().zip(kinematics.limits()) {
            assert!(*x <= l.upper && *x >= l.lower, "{q:?}");
        }
    }
}

#[test]
fn solving_with_cholesky_solves() {
    let mut random = Random::new(6);
    let columns: Vec<Column> = (0..7).map(|_| std::array::from_fn(|_| random.between(-1.0, 1.0))).collect();
    let matrix = super::jacobian::gram(&columns, 0.1);
    let b: Column = std::array::from_fn(|_| random.between(-1.0, 1.0));
    let x = super::jacobian::solve(&super::jacobian::cholesky(&matrix).unwrap(), &b);
    for (row, b) in matrix.iter().zip(&b) {
        assert!((row.iter().zip(&x).map(|(a, x)| a * x).sum::<f64>() - b).abs() < 1e-12);
    }
}
