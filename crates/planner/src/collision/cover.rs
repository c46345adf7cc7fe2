//! Covers of solids and of links, for the checks in lanes: each is made once, when it is first needed.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock};

use dimos_kernels::cover::{Inside, Place, Tree};
use glamx::DVec3;
use parry3d_f64::shape::ConvexPolyhedron;

use super::ball;
use super::field::Field;
use super::outline::{cuboid, prism};
use super::shape::{Core, Mesh, Solid};
use dimos_core::sync::lock;

/// Covers of links that are kept: an object may be held at many places.
const MOST: usize = 8;

/// Covers that a solid keeps.
#[derive(Debug, Default)]
pub(super) struct Covers {
    /// Of its core.
    own: OnceLock<Arc<Tree>>,
    /// Of links whose first solid it is.
    links: Mutex<VecDeque<LinkCover>>,
}

#[derive(Debug)]
struct LinkCover {
    parts: Vec<Part>,
    tree: Arc<Tree>,
    ball: Ball,
}

/// Centre and radius of a bounding ball [m].
type Ball = (DVec3, f64);

/// The cover of a solid of a link, and its place. Covers are made once, so equal ones are the same in memory.
#[derive(Debug)]
struct Part {
    tree: Arc<Tree>,
    place: Place,
}

impl PartialEq for Part {
    fn eq(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.tree, &other.tree) && self.place == other.place
    }
}

impl Solid {
    /// Returns balls that contain the core, in its own frame: without `radius`.
    pub fn cover(&self) -> &Arc<Tree> {
        self.covers.own.get_or_init(|| Arc::new(of(&self.core)))
    }
}

/// Returns balls that contain all solids of a link, in its frame.
pub(super) fn of_link(solids: &[Solid]) -> Arc<Tree> {
    known(solids).0
}

/// Returns a bounding ball of all solids of a link, in its frame.
pub(super) fn ball_of_link(solids: &[Solid]) -> Ball {
    known(solids).1
}

fn known(solids: &[Solid]) -> (Arc<Tree>, Ball) {
    let Some(first) = solids.first() else { return (Arc::default(), ball::around(solids)) };
    let place = |solid: &Solid| Place {
        rotation: solid.frame.matrix3.to_cols_array_2d(),
        translation: solid.frame.translation.to_array(),
        radius: solid.radius,
    };
    let part = |solid: &Solid| Part { tree: solid.cover().clone(), place: place(solid) };
    let parts: Vec<Part> = solids.iter().map(part).collect();
    let mut links = lock(&first.covers.links);
    if let Some(known) = links.iter().find(|known| known.parts == parts) {
        return (known.tree.clone(), known.ball);
    }
    let tree = Arc::new(Tree::join(&parts.iter().map(|part| (&*part.tree, part.place)).collect::<Vec<_>>()));
    if links.len() == MOST {
        links.pop_front();
    }
    let ball = ball::around(solids);
    links.push_back(LinkCover { parts, tree: tree.clone(), ball });
    (tree, ball)
}

fn of(core: &Core) -> Tree {
    match core {
        Core::Point => Tree::of_point(),
        Core::Segment { half } => Tree::of_segment(*half),
        Core::Box { half } => cuboid(*half).as_ref().map(of_polyhedron).unwrap_or_default(),
        Core::Cylinder { half, radius } => prism(*half, *radius).as_ref().map(of_polyhedron).unwrap_or_default(),
        Core::Hull(hull) => match hull.surface() {
            Some(mesh) => of_mesh(mesh),
            None => of_polyhedron(hull.polyhedron()),
        },
        Core::Mesh(mesh) => {
            let inside = |p: [f64; 3]| mesh.holds(DVec3::from_array(p));
            let triangles = mesh.surface().triangles().map(|t| [t.a, t.b, t.c].map(|p| p.to_array()));
            Tree::of_triangles(triangles, if mesh.is_closed() { Inside::Test(&inside) } else { Inside::Nothing })
        }
        Core::Cloud(cloud) => Tree::of_sorted_points(cloud.points()),
    }
}

/// Covers the solid within a mesh: what cannot be reached from outside through its openings.
fn of_mesh(mesh: &Mesh) -> Tree {
    let field = Field::new(mesh.triangles());
    let depth = |p: [f64; 3]| field.depth(DVec3::from_array(p));
    let triangles = mesh.triangles().all().iter().map(|corners| corners.map(|p| p.to_array()));
    Tree::of_triangles(triangles, Inside::Depth(&depth))
}

fn of_polyhedron(polyhedron: &ConvexPolyhedron) -> Tree {
    let (points, triangles) = polyhedron.to_trimesh();
    let corner = |i: u32| points[i as usize].to_array();
    Tree::of_triangles(triangles.iter().map(|t| t.map(corner)), Inside::Convex)
}

#[cfg(test)]
mod tests {
    use super::*;
    use glamx::DAffine3;

    #[test]
    fn a_link_is_covered_once_at_each_place() {
        let ball = Solid::sphere(0.1, DAffine3::from_translation(DVec3::X)).unwrap();
        let link = vec![ball.clone(), Solid::cuboid(DVec3::splat(0.2), DAffine3::IDENTITY).unwrap()];
        let cover = of_link(&link);
        assert!(Arc::ptr_eq(&cover, &of_link(&link.clone())));
        let mut padded = link.clone();
        padded[1].radius += 0.01;
        assert_ne!(*of_link(&padded), *cover);
        for i in 0..2 * MOST {
            let moved: Vec<Solid> =
                link.iter().map(|s| s.clone().at(DAffine3::from_translation(DVec3::Y * i as f64))).collect();
            assert_ne!(*of_link(&moved), *cover);
        }
        assert_eq!(*of_link(&link), *cover);
        assert!(lock(&ball.covers.links).len() <= MOST);
        assert_eq!(*of_link(&[]), Tree::default());
    }
}
