//! Frames, Jacobians and inverse kinematics of real arms; Pinocchio is the judge.

use std::collections::HashMap;
use std::time::Instant;

use dimos::collision::Stop;
use dimos::planning::ik::Ik;
use dimos::planning::ik::settings::IkSettings;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::model::RobotModel;
use dimos::robot::random::Random;
use dimos::robot::urdf::from_text;
use serde_json::json;

use crate::support::python::ask_python;
use crate::support::shared::shared;

const ARMS: [(&str, &str); 4] = [("panda", "fer_hand"), ("xarm6", "link6"), ("xarm7", "link7"), ("piper", "link6")];

fn arm(name: &str) -> Option<(std::path::PathBuf, RobotModel)> {
    let path = shared(&format!("models/{name}"))?.join(format!("{name}.urdf"));
    let model = from_text(name, &std::fs::read_to_string(&path).unwrap()).unwrap();
    Some((path, model))
}

fn random_q(kinematics: &Kinematics, random: &mut Random) -> Vec<f64> {
    kinematics.limits().iter().map(|l| random.between(l.lower.max(-3.0), l.upper.min(3.0))).collect()
}

#[test]
fn frames_and_jacobians_are_pinocchios() {
    for (name, _) in ARMS {
        let Some((path, model)) = arm(name) else { return };
        let kinematics = Kinematics::whole(&model).unwrap();
        let mut random = Random::new(8);
        let configurations: Vec<Vec<f64>> = (0..20).map(|_| random_q(&kinematics, &mut random)).collect();
        // Pinocchio gets the positions of mimic joints.
        let all = |q: &Vec<f64>| -> HashMap<String, f64> {
            let named = kinematics.names().iter().cloned().zip(q.iter().copied()).collect();
            let positions = model.positions(&named);
            let moving = model.joints.iter().zip(positions).filter(|(j, _)| j.is_movable());
            moving.map(|(j, p)| (j.name.clone(), p)).collect()
        };
        let links: Vec<&str> = model.links.iter().map(|l| l.name.as_str()).collect();
        let expanded: Vec<_> = configurations.iter().map(all).collect();
        let question = json!({ "urdf": path, "links": links, "configurations": expanded });
        let Some(answers) = ask_python("kinematics.py", "pinocchio", &question) else { return };
        let (mut frames, mut columns) = (kinematics.frames(), vec![[0.0; 6]; kinematics.dof()]);
        for (q, answer) in configurations.iter().zip(answers.as_array().unwrap()) {
            kinematics.forward(q, &mut frames);
            for (l, link) in links.iter().enumerate() {
                let expected = &answer[link];
                let found = kinematics.link_frame(l, &frames);
                for r in 0..3 {
                    let place = expected["translation"][r].as_f64().unwrap();
                    assert!((found.translation[r] - place).abs() < 1e-9, "{name} {link}");
                    for c in 0..3 {
                        let turn = expected["rotation"][r][c].as_f64().unwrap();
                        assert!((found.matrix3.col(c)[r] - turn).abs() < 1e-9, "{name} {link}");
                    }
                }
                kinematics.jacobian(l, &frames, &mut columns);
                for (j, joint) in kinematics.names().iter().enumerate() {
                    // A leader's column holds its followers' as well.
                    let index = model.joint_index(joint).unwrap();
                    let followers = model
                        .joints
                        .iter()
                        .filter_map(|f| f.mimic.filter(|m| m.leader == index).map(|m| (f.name.as_str(), m.multiplier)));
                    let mut column = [0.0; 6];
                    for (who, factor) in std::iter::once((joint.as_str(), 1.0)).chain(followers) {
                        for (sum, x) in column.iter_mut().zip(expected["jacobian"][who].as_array().unwrap()) {
                            *sum += factor * x.as_f64().unwrap();
                        }
                    }
                    for (a, b) in columns[j].iter().zip(column) {
                        assert!((a - b).abs() < 1e-9, "{name} {link} {joint}: {:?} {column:?}", columns[j]);
                    }
                }
            }
        }
    }
}

#[test]
fn reachable_poses_are_reached_and_others_are_said() {
    for (name, tip) in ARMS {
        let Some((_, model)) = arm(name) else { return };
        let tip = model.link_index(tip).unwrap();
        let joints = model.chain(0, tip).unwrap().into_iter().filter(|&j| model.joints[j].is_independent());
        let kinematics = Kinematics::new(&model, &joints.collect::<Vec<_>>(), &[]).unwrap();
        let mut ik = Ik::new(&kinematics, tip);
        let mut random = Random::new(9);
        let mut missed = 0;
        for seed in 0..300 {
            let (goal, near) = (random_q(&kinematics, &mut random), random_q(&kinematics, &mut random));
            let target = ik.pose(&goal);
            let settings = IkSettings { seed, ..IkSettings::default() };
            let Ok(found) = ik.solve(&target, &near, &settings, |_| true, &Stop::never()) else {
                missed += 1;
                continue;
            };
            assert_eq!(Ok(&found), ik.solve(&target, &near, &settings, |_| true, &Stop::never()).as_ref());
            let reached = ik.pose(&found[0]);
            assert!(reached.translation.distance(target.translation) < 2e-6, "{name}");
            assert!(reached.matrix3.abs_diff_eq(target.matrix3, 1e-5), "{name}");
            for (q, l) in found[0].iter().zip(kinematics.limits()) {
                assert!(*q >= l.lower && *q <= l.upper, "{name}");
            }
            // Close to the goal the solution is the one close by.
            let beside: Vec<f64> = goal.iter().map(|q| q + 0.003).collect();
            if let Ok(found) = ik.solve(&target, &beside, &settings, |_| true, &Stop::never()) {
                let far = found[0].iter().zip(&goal).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
                missed += usize::from(far > 0.3);
            }
        }
        assert!(missed <= 6, "{name}: {missed} of 300");
        let mut far = ik.pose(&vec![0.0; kinematics.dof()]);
        far.translation.x += 5.0;
        let failure = ik.solve(&far, &vec![0.0; kinematics.dof()], &IkSettings::default(), |_| true, &Stop::never());
        let failure = failure.unwrap_err();
        assert!(failure.position > 3.0 && failure.to_string().contains("no IK solution"), "{failure}");
        let here = ik.pose(&random_q(&kinematics, &mut random));
        let rejected = ik.solve(&here, &vec![0.1; kinematics.dof()], &IkSettings::default(), |_| false, &Stop::never());
        assert!(rejected.unwrap_err().to_string().contains("collide"));
    }
}

/// A number of the normal distribution (Box and Muller, 1958).
fn normal(random: &mut Random) -> f64 {
    let (u, v) = (random.unit().max(1e-300), random.unit());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

#[test]
fn the_closest_solution_of_a_redundant_arm_is_at_most_as_far_as_a_known_one() {
    let far = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt();
    for (name, tip) in [("fer", "flange"), ("xarm7", "link7"), ("xarm6", "link6")] {
        let model = from_text(name, dimos::robot::builtin::text(name).unwrap()).unwrap();
        let kinematics = Kinematics::whole(&model).unwrap();
        let mut ik = Ik::new(&kinematics, model.link_index(tip).unwrap());
        for spread in [0.2, 1.0] {
            let mut random = Random::new(17);
            let (mut farther, mut plainly_farther, mut times) = (0, 0, [0.0; 2]);
            for _ in 0..60 {
                let known = random_q(&kinematics, &mut random);
                let seed: Vec<f64> = known.iter().map(|q| q + spread * normal(&mut random)).collect();
                let (target, least) = (ik.pose(&known), far(&known, &seed));
                let settings = IkSettings { solutions: 8, ..IkSettings::default() };
                let began = Instant::now();
                let plain = ik.solve(&target, &seed, &settings, |_| true, &Stop::never());
                times[0] += began.elapsed().as_secs_f64();
                let began = Instant::now();
                let closest = ik.closest(&target, &seed, &settings, |_| true, &Stop::never()).unwrap();
                times[1] += began.elapsed().as_secs_f64();
                let reached = ik.pose(&closest[0]);
                assert!(reached.translation.distance(target.translation) < 2e-6, "{name}");
                assert!(reached.matrix3.abs_diff_eq(target.matrix3, 1e-5), "{name}");
                let inside = |(q, l): (&f64, &dimos::robot::Limits)| *q >= l.lower && *q <= l.upper;
                assert!(closest.iter().all(|q| q.iter().zip(kinematics.limits()).all(inside)), "{name}");
                farther += usize::from(far(&closest[0], &seed) > least + 1e-3);
                plainly_farther += usize::from(plain.is_ok_and(|found| far(&found[0], &seed) > least + 1e-3));
            }
            let [plain, closest] = times.map(|time| time / 60.0 * 1e3);
            println!(
                "{name}, spread {spread}: farther {plainly_farther} → {farther} of 60; {plain:.3} → {closest:.3} ms"
            );
            assert!(farther <= 1, "{name}, spread {spread}: {farther} of 60");
        }
    }
}

#[test]
fn a_farther_branch_is_not_given_for_the_closest() {
    let Some((_, model)) = arm("panda") else { return };
    let tip = model.link_index("fer_link8").unwrap();
    let joints = model.independent_of(&model.path(0, tip));
    let kinematics = Kinematics::new(&model, &joints, &[]).unwrap();
    let mut ik = Ik::new(&kinematics, tip);
    let turn = glamx::DQuat::from_xyzw(-0.509450976, -0.781436287, -0.111495143, 0.342616207).normalize();
    let place = glamx::DVec3::new(-0.573369, 0.102578, 0.512945);
    let target = glamx::DAffine3::from_rotation_translation(turn, place);
    let seed = [-2.89, 0.6, -2.74, -2.22, 1.73, 3.62, 0.95];
    let settings = IkSettings { solutions: 8, ..IkSettings::default() };
    let found = ik.closest(&target, &seed, &settings, |_| true, &Stop::never()).unwrap();
    let away = found[0].iter().zip(&seed).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
    // A search over many more starts finds none closer than 2.23 rad.
    assert!(away < 2.24, "{away}: {:?}", found[0]);
}

#[test]
fn a_position_alone_is_enough_when_asked() {
    let Some((_, model)) = arm("xarm6") else { return };
    let tip = model.link_index("link6").unwrap();
    let joints = model.chain(0, tip).unwrap().into_iter().filter(|&j| model.joints[j].is_independent());
    let kinematics = Kinematics::new(&model, &joints.collect::<Vec<_>>(), &[]).unwrap();
    let mut ik = Ik::new(&kinematics, tip);
    let mut target = ik.pose(&[0.3, -0.4, -0.8, 0.1, 0.9, 0.0]);
    target.matrix3 = glamx::DMat3::IDENTITY;
    let settings = IkSettings { position_only: true, solutions: 3, ..IkSettings::default() };
    let found = ik.solve(&target, &[0.0; 6], &settings, |_| true, &Stop::never()).unwrap();
    assert_eq!(found.len(), 3);
    for q in &found {
        assert!(ik.pose(q).translation.distance(target.translation) < 2e-6);
    }
}

/// Fails unless a description has the flange where an emulated controller has it.
fn has_the_flange(name: &str, tip: &str, of: impl Fn(&[f64]) -> nalgebra::Isometry3<f64>) {
    let model = from_text(name, dimos::robot::builtin::text(name).unwrap()).unwrap();
    let kinematics = Kinematics::whole(&model).unwrap();
    let tool = model.link_index(tip).unwrap();
    let (mut random, mut frames) = (Random::new(5), kinematics.frames());
    for _ in 0..20 {
        let q = random_q(&kinematics, &mut random);
        kinematics.forward(&q, &mut frames);
        let found = kinematics.link_frame(tool, &frames);
        let expected = of(&q);
        let turn = expected.rotation.to_rotation_matrix();
        for r in 0..3 {
            assert!((found.translation[r] - expected.translation.vector[r]).abs() < 1e-9);
            for c in 0..3 {
                assert!((found.matrix3.col(c)[r] - turn[(r, c)]).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn a_ur5e_has_the_controllers_kinematics() {
    use dimos::arms::ur::model::Model;

    has_the_flange("ur5e", "tool0", |q| {
        let links = q.iter().enumerate().map(|(joint, position)| Model::Ur5e.link(joint, *position).unwrap());
        links.reduce(|pose, link| pose * link).unwrap()
    });
}

#[test]
fn fr3_and_fer_have_the_controllers_kinematics_and_limits() {
    use dimos::arms::franka::model::Model;

    for (name, arm) in [("fr3", Model::Fr3), ("fer", Model::Fer)] {
        has_the_flange(name, "flange", |q| {
            let links = q.iter().enumerate().map(|(joint, position)| Model::link(joint, *position).unwrap());
            links.reduce(|pose, link| pose * link).unwrap() * nalgebra::Translation3::new(0.0, 0.0, Model::FLANGE)
        });
        let model = from_text(name, dimos::robot::builtin::text(name).unwrap()).unwrap();
        let limits = arm.limits(false);
        for (i, joint) in model.joints.iter().filter(|joint| joint.is_independent()).enumerate() {
            // The adapter of an FER keeps 10 mrad from the ends, and 5 % of the speed, for what it makes up.
            let found = (joint.limits.lower, joint.limits.upper, joint.limits.velocity);
            let expected = (limits.position_lower[i], limits.position_upper[i], limits.velocity_max[i]);
            let inside = [expected.0 - found.0, found.1 - expected.1];
            let (margin, share) = if arm == Model::Fer { (0.01, 0.95) } else { (0.0, 1.0) };
            assert!(inside.iter().all(|by| (by - margin).abs() < 1e-9), "{name} {found:?} {expected:?}");
            assert!((expected.2 / found.2 - share).abs() < 1e-9, "{name} {found:?} {expected:?}");
        }
    }
}
