//! A robot and what it moves among as MuJoCo reads them: one text in MJCF, without files. Everything is in the frame
//! of the robot's root link. Links collide with objects, not with one another: their solid hulls overlap where their
//! meshes do not.

use std::fmt::Write as _;

use nalgebra::{Isometry3, Matrix3};

use crate::mesh::Mesh;
use crate::model::{Geometry, Inertial, Joint, JointKind, RobotModel};

/// Mass [kg] and inertia [kg·m²] of a link that moves and has none: MuJoCo takes no other.
const LEAST: (f64, f64) = (1e-3, 1e-6);
/// Fewer points are no solid.
const LEAST_POINTS: usize = 4;

/// Something in the world of a robot, which does not move.
#[derive(Debug, Clone, PartialEq)]
pub struct Fixture {
    /// Its name.
    pub name: String,
    /// Its geometry. A mesh is its convex hull.
    pub geometry: Geometry,
    /// Its pose in the frame of the robot's root link.
    pub pose: Isometry3<f64>,
}

/// Returns a robot among fixtures as MJCF. `gravity` is in the frame of its root link [m/s²]. The error names a mesh
/// that cannot be read.
pub fn mjcf(model: &RobotModel, gravity: [f64; 3], fixtures: &[Fixture]) -> Result<String, String> {
    let mut writer = Writer::default();
    if !model.links.is_empty() {
        writer.link(model, 0)?;
    }
    for fixture in fixtures {
        writer.body(&fixture.name, &fixture.pose);
        writer.geometry(&fixture.geometry, &Isometry3::identity(), "2\" conaffinity=\"1")?;
        writer.bodies += "</body>\n";
    }
    let Writer { meshes, bodies } = writer;
    let own = model.joints.iter().filter(|joint| joint.is_movable() && joint.mimic.is_none());
    let drives: String = own.map(|joint| drive(&joint.name)).collect();
    let followers: String = model.joints.iter().filter_map(|joint| follower(model, joint)).collect();
    let [x, y, z] = gravity;
    Ok(format!(
        "<mujoco model=\"{}\">\n<compiler angle=\"radian\" inertiafromgeom=\"false\" balanceinertia=\"true\" \
         autolimits=\"true\"/>\n<option gravity=\"{x} {y} {z}\" integrator=\"implicitfast\"/>\n\
         <asset>\n{meshes}</asset>\n<worldbody>\n{bodies}</worldbody>\n<equality>\n{followers}</equality>\n\
         <actuator>\n{drives}</actuator>\n</mujoco>\n",
        quoted(&model.name)
    ))
}

/// Returns the drive of a joint: its force is `ctrl`, and what the stepping program sets for position and velocity.
fn drive(joint: &str) -> String {
    let joint = quoted(joint);
    format!(
        "<general name=\"{joint}\" joint=\"{joint}\" biastype=\"affine\" forcelimited=\"true\" forcerange=\"-1 1\"/>\n"
    )
}

/// Returns the constraint of a joint that follows another one.
fn follower(model: &RobotModel, joint: &Joint) -> Option<String> {
    let mimic = joint.mimic.as_ref().filter(|_| joint.is_movable())?;
    let leader = model.joints.get(mimic.leader).filter(|leader| leader.is_movable())?;
    Some(format!(
        "<joint joint1=\"{}\" joint2=\"{}\" polycoef=\"{} {} 0 0 0\"/>\n",
        quoted(&joint.name),
        quoted(&leader.name),
        mimic.offset,
        mimic.multiplier
    ))
}

#[derive(Default)]
struct Writer {
    meshes: String,
    bodies: String,
}

impl Writer {
    fn link(&mut self, model: &RobotModel, index: usize) -> Result<(), String> {
        let Some(link) = model.links.get(index) else { return Ok(()) };
        let joint = index.checked_sub(1).and_then(|joint| model.joints.get(joint));
        self.body(&link.name, &joint.map_or_else(Isometry3::identity, |joint| joint.origin));
        let moves = joint.is_some_and(Joint::is_movable);
        if let Some(joint) = joint.filter(|joint| joint.is_movable()) {
            self.joint(joint);
        }
        match &link.inertial {
            Some(inertial) if inertial.mass > 0.0 => self.inertial(inertial),
            _ if moves => {
                let (mass, inertia) = LEAST;
                let inertia = Matrix3::from_diagonal_element(inertia);
                self.inertial(&Inertial { origin: Isometry3::identity(), mass, inertia });
            }
            _ => {}
        }
        for shape in &link.collisions {
            self.geometry(&shape.geometry, &shape.origin, "1\" conaffinity=\"2")?;
        }
        let children = model.joints.iter().filter(|joint| joint.parent == index).map(|joint| joint.child);
        children.into_iter().try_for_each(|child| self.link(model, child))?;
        self.bodies += "</body>\n";
        Ok(())
    }

    fn body(&mut self, name: &str, pose: &Isometry3<f64>) {
        let _ = writeln!(self.bodies, "<body name=\"{}\" {}>", quoted(name), placed(pose));
    }

    fn joint(&mut self, joint: &Joint) {
        let kind = if joint.kind == JointKind::Prismatic { "slide" } else { "hinge" };
        let (name, axis) = (quoted(&joint.name), joint.axis.into_inner());
        let axis = format!("{} {} {}", axis.x, axis.y, axis.z);
        let _ = write!(self.bodies, "<joint name=\"{name}\" type=\"{kind}\" axis=\"{axis}\"");
        let (lower, upper) = (joint.limits.lower, joint.limits.upper);
        if joint.kind != JointKind::Continuous && lower.is_finite() && upper.is_finite() && lower < upper {
            let _ = write!(self.bodies, " range=\"{lower} {upper}\"");
        }
        self.bodies += "/>\n";
    }

    fn inertial(&mut self, inertial: &Inertial) {
        let turn = inertial.origin.rotation.to_rotation_matrix();
        let mut i = turn.matrix() * inertial.inertia * turn.matrix().transpose();
        if i.symmetric_eigenvalues().min() < LEAST.1 {
            i += Matrix3::from_diagonal_element(LEAST.1); // a point mass
        }
        let at = inertial.origin.translation.vector;
        let (xx, yy, zz) = (i[(0, 0)], i[(1, 1)], i[(2, 2)]);
        let (xy, xz, yz) = (i[(0, 1)], i[(0, 2)], i[(1, 2)]);
        let _ = writeln!(
            self.bodies,
            "<inertial pos=\"{} {} {}\" mass=\"{}\" fullinertia=\"{xx} {yy} {zz} {xy} {xz} {yz}\"/>",
            at.x, at.y, at.z, inertial.mass
        );
    }

    /// Writes a geometry; `groups`: with what it collides.
    fn geometry(&mut self, geometry: &Geometry, pose: &Isometry3<f64>, groups: &str) -> Result<(), String> {
        let kind = match geometry {
            Geometry::Box { size } => format!("box\" size=\"{} {} {}", 0.5 * size.x, 0.5 * size.y, 0.5 * size.z),
            Geometry::Sphere { radius } => format!("sphere\" size=\"{radius}"),
            Geometry::Cylinder { radius, length } => format!("cylinder\" size=\"{radius} {}", 0.5 * length),
            Geometry::Capsule { radius, length } => format!("capsule\" size=\"{radius} {}", 0.5 * length),
            Geometry::Mesh(file) => {
                let mesh = Mesh::load(file)?;
                if mesh.vertices.len() < LEAST_POINTS {
                    return Ok(());
                }
                let name = format!("mesh{}", self.meshes.lines().count());
                let _ = write!(self.meshes, "<mesh name=\"{name}\" inertia=\"convex\" vertex=\"");
                mesh.vertices.iter().for_each(|p| {
                    let _ = write!(self.meshes, "{} {} {} ", p.x, p.y, p.z);
                });
                self.meshes += "\"/>\n";
                format!("mesh\" mesh=\"{name}")
            }
        };
        let _ = writeln!(self.bodies, "<geom type=\"{kind}\" {} contype=\"{groups}\"/>", placed(pose));
        Ok(())
    }
}

/// Returns a pose as attributes.
fn placed(pose: &Isometry3<f64>) -> String {
    let (p, q) = (pose.translation.vector, pose.rotation);
    format!("pos=\"{} {} {}\" quat=\"{} {} {} {}\"", p.x, p.y, p.z, q.w, q.i, q.j, q.k)
}

/// Returns a name as the value of an attribute.
fn quoted(name: &str) -> String {
    name.replace('&', "&amp;").replace('"', "&quot;").replace('<', "&lt;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Source, load};
    use nalgebra::Vector3;

    #[test]
    fn a_robot_is_written_with_its_masses_its_joints_and_what_is_around_it() {
        let model = load(&Source { path: "builtin:yourarm".into(), ..Source::default() }).into_model().unwrap();
        let table = Fixture {
            name: "a \"table\"".into(),
            geometry: Geometry::Box { size: Vector3::new(1.0, 2.0, 0.1) },
            pose: Isometry3::translation(0.0, 0.5, -0.1),
        };
        let text = mjcf(&model, [0.0, 0.0, -9.81], &[table]).unwrap();
        let read = roxmltree::Document::parse(&text).unwrap();
        let of = |tag: &'static str| read.descendants().filter(move |node| node.has_tag_name(tag));
        assert_eq!(of("body").count(), model.links.len() + 1);
        let movable: Vec<&str> = model.joints.iter().filter(|j| j.is_movable()).map(|j| j.name.as_str()).collect();
        let written: Vec<&str> =
            of("joint").filter(|node| node.has_attribute("axis")).filter_map(|node| node.attribute("name")).collect();
        assert_eq!(written, movable);
        let masses = model.links.iter().filter_map(|link| link.inertial.as_ref()).filter(|own| own.mass > 0.0);
        assert!(of("inertial").count() >= masses.count());
        let table = of("body").find(|node| node.attribute("name") == Some("a \"table\"")).unwrap();
        let geom = table.children().find(|node| node.has_tag_name("geom")).unwrap();
        assert_eq!((geom.attribute("type"), geom.attribute("size")), (Some("box"), Some("0.5 1 0.05")));
        assert_eq!(of("option").next().unwrap().attribute("gravity"), Some("0 0 -9.81"));
    }
}
