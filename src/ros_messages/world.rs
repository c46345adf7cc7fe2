//! Objects of the world as markers.

use std::collections::BTreeMap;

use dimos_core::pose;
use dimos_log::display_messages::{ColorRGBA, Marker};
use dimos_log::messages::{Point, Pose, Quaternion, Vector3};
use dimos_rpc::api::{ShapeSpec, WorldObject};

/// Returns the markers that change what was shown `before` into what is there `now`. `frame` returns the frame of a
/// robot's link, if it has another name than the link.
pub fn changes(
    before: &BTreeMap<String, WorldObject>,
    now: &BTreeMap<String, WorldObject>,
    frame: impl Fn(&str, &str) -> Option<String>,
) -> Vec<Marker> {
    let gone = before.keys().filter(|name| !now.contains_key(*name));
    let gone = gone.map(|name| Marker { ns: namespace(name), action: 2, ..Marker::default() });
    let changed = now.values().filter(|object| before.get(&object.name) != Some(object));
    gone.chain(changed.map(|object| marker(object, &frame))).collect()
}

fn namespace(object: &str) -> String {
    format!("world/{object}")
}

/// Returns the marker of an object.
fn marker(object: &WorldObject, frame: impl Fn(&str, &str) -> Option<String>) -> Marker {
    let at = pose::from_written(object.pose.xyz, object.pose.quat, object.pose.rpy);
    let ([x, y, z], turn) = (at.translation.vector.into(), at.rotation.coords);
    let mut marker = Marker {
        ns: namespace(&object.name),
        pose: Pose {
            position: Point { x, y, z },
            orientation: Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w },
        },
        color: ColorRGBA { r: 0.6, g: 0.6, b: 0.65, a: 0.8 },
        ..Marker::default()
    };
    marker.header.frame_id = "map".to_owned();
    if let Some([robot, link]) = &object.held_by {
        marker.header.frame_id = frame(robot, link).unwrap_or_else(|| link.clone());
        marker.frame_locked = true;
        marker.color = ColorRGBA { r: 0.9, g: 0.6, b: 0.2, a: 0.8 };
    }
    let (kind, [x, y, z]) = match &object.shape {
        ShapeSpec::Box(size) => (1, *size),
        ShapeSpec::Sphere(radius) => (2, [2.0 * radius; 3]),
        ShapeSpec::Cylinder([radius, length]) => (3, [2.0 * radius, 2.0 * radius, *length]),
        ShapeSpec::Mesh(path) => {
            marker.mesh_resource = format!("file://{path}");
            (10, [1.0; 3])
        }
        // Its points may be hundreds of megabytes: only its name is shown.
        ShapeSpec::Cloud(_) => {
            marker.text.clone_from(&object.name);
            (9, [0.05; 3])
        }
    };
    (marker.r#type, marker.scale) = (kind, Vector3 { x, y, z });
    marker
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_changes_is_sent_and_what_is_held_moves_with_its_link() {
        let object = |name: &str, radius: f64| WorldObject {
            name: name.to_owned(),
            shape: ShapeSpec::Sphere(radius),
            pose: Default::default(),
            padding: 0.0,
            held_by: None,
        };
        let world = |objects: &[WorldObject]| objects.iter().map(|o| (o.name.clone(), o.clone())).collect();
        let before = world(&[object("a", 0.1), object("b", 0.1), object("c", 0.1)]);
        let held = WorldObject { held_by: Some(["left".into(), "tip".into()]), ..object("c", 0.1) };
        let now = world(&[object("a", 0.1), held]);
        let markers = changes(&before, &now, |robot, link| Some(format!("{robot}_{link}")));
        let shown: Vec<_> = markers.iter().map(|m| (m.ns.as_str(), m.action, m.header.frame_id.as_str())).collect();
        assert_eq!(shown, [("world/b", 2, ""), ("world/c", 0, "left_tip")]);
        assert!(changes(&now, &now, |_, _| None).is_empty());
    }
}
