//! Corrects a model to the dimensions of one arm, as its maker measured them.
//!
//! The parameters of [`FactoryKinematics`] are no places of links: where axes are nearly parallel, frames of the
//! product lie metres away from the arm. What they determine is the line of each joint's axis with all joints at zero,
//! and the pose of the flange there; any chain with these lines has the same flange at every position. So each joint of
//! the model is moved onto its line, to the point that is nearest to where it was, and turned by the least angle: its
//! link, with meshes and masses, stays where it belongs. The last link follows the flange.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3, Rotation3, Unit, UnitQuaternion, Vector3};

use super::model::RobotModel;
use super::xml::{Document, Element, Node};
use dimos_core::arm::{Dh, FactoryKinematics};
use dimos_core::pose::to_xyz_rpy;

/// Frames of joints on their parent links, by the joints' names: they replace those of a description.
pub type Places = BTreeMap<String, Isometry3<f64>>;

/// How far the axes of a model may be from those of the data sheet, for it to be a model of this arm [m, rad].
const SAME: (f64, f64) = (0.001, 0.002);
/// Sine of the angle between the first two axes of an arm, at least.
const CROSSING: f64 = 0.1;

/// The axis of a joint.
#[derive(Debug, Clone, Copy)]
struct Line {
    point: Point3<f64>,
    direction: Unit<Vector3<f64>>,
}

impl Line {
    fn moved(&self, by: &Isometry3<f64>) -> Self {
        Self { point: by * self.point, direction: by * self.direction }
    }

    fn nearest(&self, to: &Point3<f64>) -> Point3<f64> {
        self.point + self.direction.into_inner() * self.direction.dot(&(to - self.point))
    }

    /// Returns the frame that the common normal of two crossing lines makes: z along the first one, x along the normal.
    fn frame_with(&self, other: &Self) -> Option<Isometry3<f64>> {
        let (u, v) = (self.direction.into_inner(), other.direction.into_inner());
        let normal = u.cross(&v);
        let x = Unit::try_new(normal, CROSSING)?;
        let between = other.point - self.point;
        let along = between.cross(&v).dot(&normal) / normal.norm_squared();
        let y = u.cross(&x);
        let axes = Rotation3::from_basis_unchecked(&[x.into_inner(), y, u]);
        let origin = self.point + u * along;
        Some(Isometry3::from_parts(origin.into(), UnitQuaternion::from_rotation_matrix(&axes)))
    }
}

/// Returns the axes with all joints at zero, and the flange there, in the frame of the controller's base.
fn axes(dh: &[Dh]) -> (Vec<Line>, Isometry3<f64>) {
    let mut frame = Isometry3::identity();
    let axis = |dh: &Dh| {
        let line = Line { point: frame * Point3::origin(), direction: frame * Vector3::z_axis() };
        frame *= Isometry3::new(Vector3::new(0.0, 0.0, dh.d), Vector3::z() * dh.theta)
            * Isometry3::new(Vector3::new(dh.a, 0.0, 0.0), Vector3::x() * dh.alpha);
        line
    };
    let lines = dh.iter().map(axis).collect();
    (lines, frame)
}

/// The joints of an arm in its model.
struct Chain<'m> {
    model: &'m RobotModel,
    /// Indices of the joints, from the base.
    joints: Vec<usize>,
    /// Frames of all links in that of the link that carries the first joint, with all joints at zero.
    links: Vec<Isometry3<f64>>,
}

impl<'m> Chain<'m> {
    fn new(model: &'m RobotModel, names: &[String]) -> Result<Self, String> {
        let index = |name: &String| model.joint_index(name).ok_or_else(|| format!("the model has no joint {name:?}"));
        let joints = names.iter().map(index).collect::<Result<Vec<_>, _>>()?;
        let all = model.link_poses(&vec![0.0; model.joints.len()]);
        let first = joints.first().and_then(|joint| model.joints.get(*joint)).map_or(0, |joint| joint.parent);
        let base = all.get(first).copied().unwrap_or_default().inverse();
        let chain = Self { model, joints, links: all.iter().map(|link| base * link).collect() };
        let last = chain.joints.last().map_or(0, |joint| joint + 1);
        let way = model.chain(first, last).unwrap_or_default();
        let moving = way.iter().filter(|joint| model.joints.get(**joint).is_some_and(|joint| joint.is_movable()));
        if !moving.eq(chain.joints.iter()) {
            return Err("the arm's joints do not follow one another in the model".to_owned());
        }
        Ok(chain)
    }

    /// Returns the frame of a joint: that of the link that it carries.
    fn frame(&self, joint: usize) -> Isometry3<f64> {
        self.links.get(joint + 1).copied().unwrap_or_default()
    }

    fn lines(&self) -> Vec<Line> {
        let line = |joint: &usize| {
            let (frame, axis) = (self.frame(*joint), self.model.joints.get(*joint).map(|joint| joint.axis));
            Line { point: frame * Point3::origin(), direction: frame * axis.unwrap_or(Vector3::z_axis()) }
        };
        self.joints.iter().map(line).collect()
    }
}

/// Returns the frame of the controller's base in that of the link that carries the arm's first joint, and that link;
/// `None` if the model has other joints. `joints`: names of the arm's joints in the model, from the base.
pub fn controller_base(model: &RobotModel, joints: &[String], nominal: &[Dh]) -> Option<(usize, Isometry3<f64>)> {
    let chain = Chain::new(model, joints).ok()?;
    let first = chain.joints.first().and_then(|joint| model.joints.get(*joint))?.parent;
    Some((first, base(&chain.lines(), nominal)?))
}

fn base(lines: &[Line], nominal: &[Dh]) -> Option<Isometry3<f64>> {
    let ([model, next, ..], (sheet, _)) = (lines, axes(nominal)) else { return None };
    let [first, second, ..] = &sheet[..] else { return None };
    Some(model.frame_with(next)? * first.frame_with(second)?.inverse())
}

/// Returns where the joints of a model are on the arm that these kinematics are of: empty if it is as the data sheet
/// has it. `joints`: names of the arm's joints in the model, from the base. The error says why the model is not of this
/// kind of arm.
pub fn places(model: &RobotModel, joints: &[String], kinematics: &FactoryKinematics) -> Result<Places, String> {
    let Some(actual) = &kinematics.actual else { return Ok(Places::new()) };
    let chain = Chain::new(model, joints)?;
    let (lines, nominal) = (chain.lines(), &kinematics.nominal);
    if lines.len() != nominal.len() || lines.len() != actual.len() {
        return Err(format!("the model has {} joints of the arm, the controller {}", lines.len(), actual.len()));
    }
    let base = base(&lines, nominal).ok_or("its first two axes are parallel")?;
    let ((sheet, sheet_flange), (own, own_flange)) = (axes(nominal), axes(actual));
    for ((line, sheet), name) in lines.iter().zip(&sheet).zip(joints) {
        let sheet = sheet.moved(&base);
        let (far, turned) = (
            (sheet.nearest(&line.point) - line.point).norm(),
            sheet.direction.into_inner().angle(&line.direction.into_inner()),
        );
        if far > SAME.0 || turned > SAME.1 {
            return Err(format!(
                "the axis of {name} is {:.1} mm and {:.2}° from that of the data sheet",
                far * 1e3,
                turned.to_degrees()
            ));
        }
    }
    if sheet.iter().zip(&own).all(|(a, b)| (a.point - b.point).norm() + (*a.direction - *b.direction).norm() < 1e-9)
        && (own_flange.to_homogeneous() - sheet_flange.to_homogeneous()).amax() < 1e-9
    {
        return Ok(Places::new());
    }
    // The flange of the model, and with it the last link, moves as that of the arm does.
    let moved = base * own_flange * (base * sheet_flange).inverse();
    Ok(placed(&chain, &own.iter().map(|line| line.moved(&base)).collect::<Vec<_>>(), &moved))
}

/// Returns the rotation by the least angle that takes one direction to another, exact for small angles.
fn least_turn(from: &Unit<Vector3<f64>>, to: &Unit<Vector3<f64>>) -> UnitQuaternion<f64> {
    let across = from.cross(to);
    let angle = across.norm().atan2(from.dot(to));
    Unit::try_new(across, f64::MIN_POSITIVE)
        .map_or_else(UnitQuaternion::identity, |axis| UnitQuaternion::from_axis_angle(&axis, angle))
}

/// Moves each joint onto its line, and what the last link carries by `moved`.
fn placed(chain: &Chain<'_>, lines: &[Line], moved: &Isometry3<f64>) -> Places {
    let mut places = Places::new();
    // The link that carried the joint before: where it was, and where it is.
    let mut before = (Isometry3::identity(), Isometry3::identity());
    for (index, (joint, line)) in chain.joints.iter().zip(lines).enumerate() {
        let Some(about) = chain.model.joints.get(*joint) else { continue };
        let was = chain.frame(*joint);
        let guide = if index + 1 == lines.len() { moved * was } else { was };
        let axis = guide * about.axis;
        let turn = least_turn(&axis, &line.direction);
        let origin = line.nearest(&Point3::from(guide.translation.vector));
        let is = Isometry3::from_parts(origin.into(), turn * guide.rotation);
        let parent = chain.links.get(about.parent).copied().unwrap_or_default();
        let parent = before.1 * before.0.inverse() * parent;
        places.insert(about.name.clone(), parent.inverse() * is);
        before = (was, is);
    }
    let (Some(last), (was, is)) = (chain.joints.last(), before) else { return places };
    let rest = is.inverse() * moved * was;
    for carried in chain.model.joints.iter().filter(|joint| joint.parent == last + 1) {
        places.insert(carried.name.clone(), rest * carried.origin);
    }
    places
}

/// Puts joints at their places, in a model and in the description that it was read from.
pub(super) fn put(places: &Places, model: Option<&mut RobotModel>, document: &mut Document) {
    for joint in model.into_iter().flat_map(|model| &mut model.joints) {
        if let Some(place) = places.get(&joint.name) {
            joint.origin = *place;
        }
    }
    for node in &mut document.root.children {
        let Node::Element(joint) = node else { continue };
        let name = joint.attribute("name").filter(|_| joint.name == "joint").map(|name| name.value.clone());
        let Some(place) = name.and_then(|name| places.get(&name)) else { continue };
        let (xyz, rpy) = to_xyz_rpy(place);
        let at = joint.at;
        let is_origin = |node: &Node| matches!(node, Node::Element(element) if element.name == "origin");
        joint.children.retain(|node| !is_origin(node));
        let mut origin = Element { name: "origin".to_owned(), at, ..Element::default() };
        let text = |values: [f64; 3]| values.map(|value| value.to_string()).join(" ");
        origin.set("xyz", text(xyz), at);
        origin.set("rpy", text(rpy), at);
        joint.children.insert(0, Node::Element(origin));
    }
}

#[cfg(test)]
#[path = "calibrated_tests.rs"]
mod tests;
