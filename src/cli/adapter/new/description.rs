//! The first description of a new arm: a made-up arm with any number of joints, for a planner to work with from the
//! start.
//!
//! It points straight up when all joints are at zero. Its joints roll about z and pitch about y by turns, its shapes
//! are primitives, and it is about a metre long whatever the number of joints.

use std::fmt::Write;
use std::iter;

/// Limits of the templates' joints: lowest and highest position [deg], top speed [deg/s].
const LIMITS: (f64, f64, f64) = (-170.0, 170.0, 180.0);
/// How far it bends over, from straight up, in its pose `home` [rad].
const BENT: f64 = 1.6;

/// Which way a joint turns.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Joint {
    /// About the arm's own length.
    Roll,
    /// Up and down.
    Pitch,
}

/// The joints of an arm, base first: shoulder, elbow and wrist as most arms have them, by turns where there are more.
fn joints(dof: u8) -> impl Iterator<Item = Joint> {
    use Joint::{Pitch, Roll};
    let common = [Roll, Pitch, Pitch, Roll, Pitch, Roll];
    (0..usize::from(dof)).map(move |index| match common.get(index) {
        Some(joint) if dof <= 6 => *joint,
        _ if index % 2 == 0 => Roll,
        _ => Pitch,
    })
}

/// A pose in which it is bent over evenly [rad], as written in a blueprint.
pub fn home(dof: u8) -> String {
    let pitches = joints(dof).filter(|joint| *joint == Joint::Pitch).count().max(1);
    let each = (100.0 * BENT / pitches as f64).round() / 100.0;
    let value = |joint| if joint == Joint::Pitch { each } else { 0.0 };
    joints(dof).map(|joint| value(joint).to_string()).collect::<Vec<_>>().join(", ")
}

/// The names of its joints, as written in a blueprint.
pub fn joint_names(dof: u8) -> String {
    (1..=dof).map(|number| format!("joint{number}")).collect::<Vec<_>>().join(", ")
}

/// Its URDF. `about` says whose it is, `limits_in` in which file the adapter has its limits.
pub fn urdf(name: &str, about: &str, dof: u8, limits_in: &str) -> String {
    let mut out = format!(
        "<?xml version=\"1.0\"?>\n\
         <!-- {about}, as a planner sees it. YOUR ARM: lengths [m], axes, limits and shapes are made up. Put in those of\n     \
         the data sheet, or use the vendor's description in its place. Keep the limits those of {limits_in}.\n     \
         A gripper is not part of it: give the link `flange` its shape, or the planner does not know of it. -->\n\
         <robot name=\"{name}\">\n"
    );
    link(&mut out, "base_link", &[cylinder(0.07, 0.1, 0.05)]);
    // Many joints make an arm of short links, not a long arm.
    let scale = (7.0 / f64::from(dof)).min(1.0);
    let lengths = || joints(dof).map(|joint| millimetres(scale * if joint == Joint::Roll { 0.1 } else { 0.2 }));
    for (number, (joint, length)) in (1..).zip(joints(dof).zip(lengths())) {
        link(&mut out, &format!("link{number}"), &shapes(joint, length, millimetres(0.045 * scale)));
    }
    out += "  <link name=\"flange\"/>\n";
    let heights = iter::once(0.1).chain(lengths());
    for (number, (joint, height)) in (1..).zip(joints(dof).zip(heights)) {
        revolute(&mut out, number, joint, height);
    }
    let last = lengths().last().unwrap_or_default();
    let _ = write!(
        out,
        "  <joint name=\"flange_joint\" type=\"fixed\"> <!-- pose goals are for the flange -->\n    \
         <parent link=\"link{dof}\"/><child link=\"flange\"/>\n    \
         <origin xyz=\"0 0 {last}\"/>\n  </joint>\n</robot>\n"
    );
    out
}

/// A joint `height` [m] above the one before it.
fn revolute(out: &mut String, number: usize, joint: Joint, height: f64) {
    let (lower, upper, speed) = LIMITS;
    let axis = if joint == Joint::Roll { "0 0 1" } else { "0 1 0" };
    let parent = if number == 1 { "base_link".to_owned() } else { format!("link{}", number - 1) };
    let _ = write!(
        out,
        "  <joint name=\"joint{number}\" type=\"revolute\"> <!-- YOUR ARM -->\n    \
         <parent link=\"{parent}\"/><child link=\"link{number}\"/>\n    \
         <origin xyz=\"0 0 {height}\" rpy=\"0 0 0\"/>\n    \
         <axis xyz=\"{axis}\"/>\n    \
         <limit lower=\"{}\" upper=\"{}\" velocity=\"{}\" effort=\"50\"/> <!-- joint {number}: {lower} to {upper} deg, {speed} deg/s -->\n  \
         </joint>\n",
        lower.to_radians(),
        upper.to_radians(),
        speed.to_radians(),
    );
}

/// What a link of a length consists of, from its joint up.
fn shapes(joint: Joint, length: f64, radius: f64) -> Vec<String> {
    match joint {
        Joint::Roll => vec![cylinder(radius, length, length / 2.0)],
        // A housing across, and the link's own length as a capsule.
        Joint::Pitch => {
            let (own, straight) = (millimetres(0.8 * radius), millimetres(length - 1.6 * radius));
            // Half a millimetre is the finest step.
            let end = |sign: f64| sphere(own, (1e4 * (length + sign * straight) / 2.0).round() / 1e4);
            let housing = format!(
                "<origin xyz=\"0 0 0\" rpy=\"1.5707963267948966 0 0\"/><geometry>\
                 <cylinder radius=\"{radius}\" length=\"{}\"/></geometry>",
                millimetres(2.4 * radius)
            );
            vec![housing, cylinder(own, straight, length / 2.0), end(-1.0), end(1.0)]
        }
    }
}

/// A sphere on the z axis at a height.
fn sphere(radius: f64, middle: f64) -> String {
    format!("<origin xyz=\"0 0 {middle}\"/><geometry><sphere radius=\"{radius}\"/></geometry>")
}

/// A cylinder about z with its middle at a height.
fn cylinder(radius: f64, length: f64, middle: f64) -> String {
    format!("<origin xyz=\"0 0 {middle}\"/><geometry><cylinder radius=\"{radius}\" length=\"{length}\"/></geometry>")
}

/// A link that looks as it collides.
fn link(out: &mut String, name: &str, shapes: &[String]) {
    let _ = writeln!(out, "  <link name=\"{name}\">");
    for kind in ["visual", "collision"] {
        for shape in shapes {
            let _ = writeln!(out, "    <{kind}>{shape}</{kind}>");
        }
    }
    *out += "  </link>\n";
}

fn millimetres(value: f64) -> f64 {
    (1000.0 * value).round() / 1000.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;
    use std::time::Duration;

    use dimos_core::clock::Mono;
    use dimos_core::joint::{JointLimits, MAX_DOF};
    use dimos_hardware::sim::arm::{PLAYABLE, SimArm, SimOptions};
    use nalgebra::Isometry3;

    use crate::offline::{Contacts, ObjectConfig, ObjectShape, PlannerConfig, PlanningScene, RobotConfig};

    /// The arm beside the table of the template's blueprint.
    fn setup(dof: u8, folder: &std::path::Path) -> PlanningScene {
        let path = folder.join(format!("{dof}.urdf"));
        std::fs::write(&path, urdf("acme", "Acme", dof, "src/lib.rs")).unwrap();
        let loaded = dimos_robot::load(&dimos_robot::Source::new(&path));
        assert_eq!(loaded.render(false), "", "{dof} joints: no mistake, no warning");
        let joints: Vec<String> = joint_names(dof).split(", ").map(str::to_owned).collect();
        assert_eq!(joints.len(), usize::from(dof));
        let home = home(dof).split(", ").map(|value| value.parse().unwrap()).collect();
        let robot = RobotConfig {
            name: "arm".into(),
            model_path: path,
            coordinator_joints: joints.clone(),
            joints,
            named_poses: BTreeMap::from([("home".to_owned(), home), ("zero".to_owned(), vec![0.0; dof.into()])]),
            ..RobotConfig::yourarm()
        };
        let table = ObjectConfig {
            name: "table".into(),
            shape: ObjectShape::Box([1.2, 1.2, 0.02]),
            pose: Isometry3::translation(0.0, 0.0, -0.02),
            padding: 0.0,
        };
        PlanningScene::load(&PlannerConfig {
            timeout: Duration::from_secs(1),
            padding: 0.0,
            robots: vec![robot],
            objects: vec![table],
            proofs: None,
        })
        .unwrap()
    }

    #[test]
    fn an_arm_of_any_number_of_joints_can_be_planned_for() {
        let folder = tempfile::tempdir().unwrap();
        for dof in 1..=MAX_DOF as u8 {
            let setup = setup(dof, folder.path());
            assert_eq!(setup.always_touching, [], "{dof} joints");
            let robot = &setup.robots[0];
            let mut contacts = Contacts::of_scene(&setup, 0.0);
            let limits = JointLimits::uniform(dof.into(), 170_f64.to_radians(), 1.0);
            let emulated =
                SimArm::new("acme", &limits, &SimOptions::default(), PLAYABLE, Mono::ZERO).unwrap().joints().0;
            let power_up = ("power-up".to_owned(), emulated[..usize::from(dof)].to_vec());
            for (name, pose) in robot.config.named_poses.clone().into_iter().chain([power_up]) {
                let touching = contacts.at(&pose);
                assert!(touching.is_empty(), "{dof} joints: {name} collides: {touching:?}");
            }
            let own = &robot.limits[0];
            assert!((own.lower + 170_f64.to_radians()).abs() < 1e-12 && own.upper == -own.lower);
            let reach: f64 = robot.model.joints.iter().map(|joint| joint.origin.translation.vector.norm()).sum();
            assert!((0.2..1.3).contains(&reach), "{dof} joints: {reach} m");
        }
    }
}
