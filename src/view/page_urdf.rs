//! Descriptions in the words that the page's reader knows: `rpy` in place of quaternions, a cylinder with two spheres
//! in place of a capsule.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

use dimos_core::pose::{from_xyz_rpy, to_xyz_rpy};
use dimos_robot::urdf;
use dimos_robot::xml::{Element, Node};

/// Rewrites a description that was read without mistakes.
pub(super) fn simplify(root: &mut Element) {
    let quaternions = urdf::version(root).is_ok_and(|minor| minor > 0);
    for link_or_joint in elements(root) {
        turn(link_or_joint, quaternions);
        let mut children = Vec::with_capacity(link_or_joint.children.len());
        for mut node in std::mem::take(&mut link_or_joint.children) {
            if let Node::Element(element) = &mut node {
                turn(element, quaternions);
                if let Some(parts) = parts_of_capsule(element) {
                    children.extend(parts.map(Node::Element));
                    continue;
                }
            }
            children.push(node);
        }
        link_or_joint.children = children;
    }
}

fn elements(element: &mut Element) -> impl Iterator<Item = &mut Element> {
    element.children.iter_mut().filter_map(|node| match node {
        Node::Element(child) => Some(child),
        _ => None,
    })
}

fn numbers<const N: usize>(element: &Element, name: &str) -> Option<[f64; N]> {
    let words = element.attribute(name)?.value.split_whitespace();
    words.map(|word| word.parse().ok()).collect::<Option<Vec<f64>>>()?.try_into().ok()
}

/// Replaces the quaternion of an element's origin, if they count in this version.
fn turn(element: &mut Element, quaternions: bool) {
    for origin in elements(element).filter(|child| child.name == "origin") {
        let quaternion = numbers(origin, "quat_xyzw").filter(|_| quaternions);
        origin.attributes.retain(|attribute| attribute.name != "quat_xyzw");
        if let Some([x, y, z, w]) = quaternion {
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let (_, rpy) = to_xyz_rpy(&Isometry3::from_parts(Translation3::identity(), rotation));
            origin.set("rpy", text(&rpy), origin.at);
        }
    }
}

fn text(values: &[f64]) -> String {
    values.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")
}

/// Returns the cylinder and the spheres of a shape that is a capsule.
fn parts_of_capsule(shape: &Element) -> Option<[Element; 3]> {
    let capsule = shape.child("geometry")?.child("capsule")?;
    let ([radius], [length]) = (numbers(capsule, "radius")?, numbers(capsule, "length")?);
    let origin = shape.child("origin");
    let part = |name: &str| origin.and_then(|origin| numbers(origin, name)).unwrap_or_default();
    let pose = from_xyz_rpy(part("xyz"), part("rpy"));
    let at = capsule.at;
    let named = |name: &str| Element { name: name.to_owned(), at, ..Element::default() };
    Some([("cylinder", 0.0), ("sphere", 0.5), ("sphere", -0.5)].map(|(kind, along)| {
        let mut solid = named(kind);
        solid.set("radius", radius.to_string(), at);
        if kind == "cylinder" {
            solid.set("length", length.to_string(), at);
        }
        let (xyz, rpy) = to_xyz_rpy(&(pose * Translation3::new(0.0, 0.0, along * length)));
        let mut origin = named("origin");
        origin.set("xyz", text(&xyz), at);
        origin.set("rpy", text(&rpy), at);
        let mut geometry = named("geometry");
        geometry.children.push(Node::Element(solid));
        let mut part = shape.clone();
        part.children.retain(|node| !matches!(node, Node::Element(e) if e.name == "origin" || e.name == "geometry"));
        part.children.extend([Node::Element(origin), Node::Element(geometry)]);
        part
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::RobotModel;
    use dimos_robot::urdf::from_text;
    use dimos_robot::xml::parse;
    use dimos_yaml::Tree;

    const ARM: &str = "<robot name='r' version='1.1'><link name='a'>\
        <visual name='v'><origin xyz='0 0 0.5' quat_xyzw='1 0 0 1'/>\
        <geometry><capsule radius='0.1' length='0.4'/></geometry><material name='red'/></visual>\
        <inertial><origin quat_xyzw='0 0 1 0'/><mass value='1'/><inertia ixx='1' iyy='2' izz='2'/></inertial></link>\
        <link name='b'/><joint name='j' type='continuous'><parent link='a'/><child link='b'/>\
        <origin xyz='1 2 3' quat_xyzw='0.5 0.5 -0.5 0.7'/></joint></robot>";

    fn simple(text: &str) -> String {
        let mut tree = Tree::new();
        let source = tree.add_source("r.urdf", text);
        let mut document = parse(&mut tree, source).unwrap();
        simplify(&mut document.root);
        document.to_text()
    }

    fn place(model: &RobotModel) -> Isometry3<f64> {
        model.joints[0].origin
    }

    #[test]
    fn the_page_reads_the_same_frames_without_quaternions() {
        let (text, model) = (simple(ARM), from_text("r", ARM).unwrap());
        let read = from_text("r", &text).unwrap();
        assert!(!text.contains("quat_xyzw"), "{text}");
        let far = place(&read).inverse() * place(&model);
        assert!(far.rotation.angle() < 1e-9 && far.translation.vector.norm() < 1e-12, "{text}");
        let turned = |model: &RobotModel| model.links[0].inertial.as_ref().unwrap().origin.rotation;
        assert!(turned(&read).angle_to(&turned(&model)) < 1e-9, "{text}");
        // In version 1.0 the quaternion does not count, for the page either.
        let old = ARM
            .replace(" version='1.1'", "")
            .replace("quat_xyzw='0.5 0.5 -0.5 0.7'", "rpy='0 0 1' quat_xyzw='1 0 0 0'");
        let read = from_text("r", &simple(&old)).unwrap();
        assert!((place(&read).rotation.euler_angles().2 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_capsule_becomes_a_cylinder_with_a_sphere_at_each_end() {
        let text = simple(ARM);
        assert!(!text.contains("capsule"), "{text}");
        let visuals = from_text("r", &text).unwrap().links.remove(0).visuals;
        // Turned by 90° about x: its ends lie along -y and y.
        let at: Vec<_> = visuals.iter().map(|shape| shape.origin.translation.vector).collect();
        let expected = [[0.0, 0.0, 0.5], [0.0, -0.2, 0.5], [0.0, 0.2, 0.5]];
        assert_eq!(at.len(), 3, "{text}");
        for (at, expected) in at.iter().zip(expected) {
            assert!((at - nalgebra::Vector3::from(expected)).norm() < 1e-12, "{text}");
        }
        assert!(text.matches("material").count() == 3 && text.matches("radius=\"0.1\"").count() == 3, "{text}");
    }
}
