//! Covers of solids and of links, for the checks in lanes: each is made once, when it is first needed.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, OnceLock, Weak};

use dimos_kernels::cover::{Inside, Place, Tree};
use glamx::{DAffine3, DVec3};
use parry3d_f64::shape::ConvexPolyhedron;

use super::ball;
use super::field::Field;
use super::outline::{cuboid, outline, prism};
use super::shape::{Core, Solid};
use super::triangles::Triangles;
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
    /// Of what it and other meshes enclose together, it being the first.
    merged: Mutex<VecDeque<Merged>>,
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

/// The cover of several meshes, each given by where its own covers are kept and by its frame.
#[derive(Debug)]
struct Merged {
    meshes: Vec<(Weak<Covers>, DAffine3)>,
    tree: Arc<Tree>,
}

impl Solid {
    /// Returns balls that contain the core, in its own frame: without `radius`.
    pub fn cover(&self) -> &Arc<Tree> {
        self.covers.own.get_or_init(|| Arc::new(of(&self.core)))
    }

    /// Returns whether triangles decide about it.
    fn is_mesh(&self) -> bool {
        matches!(&self.core, Core::Hull(hull) if hull.surface().is_some())
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
    let (meshes, mut others): (Vec<&Solid>, Vec<&Solid>) = solids.iter().partition(|solid| solid.is_mesh());
    let mut parts = Vec::new();
    match meshes.first() {
        // What several meshes enclose together is inside of none of them.
        Some(one) if meshes.len() > 1 && meshes.iter().all(|mesh| mesh.radius == one.radius) => {
            let place = place(&Solid::clone(one).at(DAffine3::IDENTITY));
            parts.push(Part { tree: merged(&meshes), place });
        }
        _ => others = solids.iter().collect(),
    }
    parts.extend(others.into_iter().map(part));
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

/// Returns the cover of meshes of one link, in its frame.
fn merged(meshes: &[&Solid]) -> Arc<Tree> {
    let Some(first) = meshes.first() else { return Arc::default() };
    let mut known = lock(&first.covers.merged);
    let is = |solid: &Solid, (covers, frame): &(Weak<Covers>, DAffine3)| {
        covers.as_ptr() == Arc::as_ptr(&solid.covers) && *frame == solid.frame
    };
    let same = |one: &&Merged| {
        one.meshes.len() == meshes.len() && one.meshes.iter().zip(meshes).all(|(own, solid)| is(solid, own))
    };
    if let Some(known) = known.iter().find(same) {
        return known.tree.clone();
    }
    let of_solid = |solid: &&Solid| {
        let frame = solid.frame;
        let triangles = outline(&solid.core).unwrap_or_default().into_iter();
        triangles.map(move |corners| corners.map(|p| frame.transform_point3(p)))
    };
    let tree = Arc::new(of_mesh(&Triangles::new(meshes.iter().flat_map(of_solid))));
    if known.len() == MOST {
        known.pop_front();
    }
    let meshes = meshes.iter().map(|solid| (Arc::downgrade(&solid.covers), solid.frame)).collect();
    known.push_back(Merged { meshes, tree: tree.clone() });
    tree
}

fn of(core: &Core) -> Tree {
    match core {
        Core::Point => Tree::of_point(),
        Core::Segment { half } => Tree::of_segment(*half),
        Core::Box { half } => cuboid(*half).as_ref().map(of_polyhedron).unwrap_or_default(),
        Core::Cylinder { half, radius } => prism(*half, *radius).as_ref().map(of_polyhedron).unwrap_or_default(),
        Core::Hull(hull) => match hull.surface() {
            Some(mesh) => of_mesh(mesh.triangles()),
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

/// Covers the solid within meshes: what cannot be reached from outside through their openings.
fn of_mesh(triangles: &Triangles) -> Tree {
    let field = Field::new(triangles);
    let corners = triangles.all().iter().map(|corners| corners.map(|p| p.to_array()));
    Tree::of_triangles(corners, Inside::Depth(&field))
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
