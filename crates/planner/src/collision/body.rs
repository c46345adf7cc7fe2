//! Collision solids of a robot's links, from its description.

use std::sync::Arc;

use glamx::{DAffine3, DVec3};
use parry3d_f64::transformation::vhacd::{VHACD, VHACDParameters};
use schemars::JsonSchema;
use serde::Deserialize;

use dimos_robot::kinematics::frame;
use dimos_robot::mesh;
use dimos_robot::model::{Geometry, RobotModel, Shape};

use super::shape::{Mesh, ShapeError, Solid};

/// Distance below which two centres are the same [m].
const SAME_CENTER: f64 = 1e-6;

/// Collision geometry of links that are described by meshes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MeshMode {
    /// The mesh: its convex hull first, which is fast, and triangle by triangle where only the hull touches.
    #[default]
    Mesh,
    /// The convex hull of each mesh alone: what touches it only there counts, too.
    Hull,
    /// Convex hulls of parts of each mesh: together they contain the mesh, but not the space between fingers, which a
    /// single hull fills. The decomposition takes a moment; more parts are slower.
    Decomposition,
    /// Triangle by triangle.
    Triangles,
}

/// Why a robot's collision solids cannot be built.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BodyError {
    /// A shape is not usable.
    #[error("collision shape {number} of link {link:?}: {error}")]
    Shape {
        /// The link.
        link: String,
        /// Number of the shape, from 1.
        number: usize,
        /// Its error.
        error: ShapeError,
    },
    /// A mesh file cannot be read.
    #[error("collision mesh {uri:?} of link {link:?}: {error}")]
    File {
        /// The link.
        link: String,
        /// The mesh as the description names it.
        uri: String,
        /// The reading error.
        error: String,
    },
}

/// Returns the collision solids of every link, in the links' frames, all in one mode. Reads the mesh files.
pub fn solids(model: &RobotModel, mode: MeshMode) -> Result<Vec<Vec<Solid>>, BodyError> {
    solids_of(model, |_| mode)
}

/// Returns the collision solids of every link, in the links' frames; `mode` gives the mode of a link by its name. Reads
/// the mesh files.
pub fn solids_of(model: &RobotModel, mode: impl Fn(&str) -> MeshMode) -> Result<Vec<Vec<Solid>>, BodyError> {
    let link = |link: &dimos_robot::model::Link| {
        let solid = |(i, shape): (usize, &Shape)| {
            let bad = |error| BodyError::Shape { link: link.name.clone(), number: i + 1, error };
            let at = frame(&shape.origin);
            let one = match &shape.geometry {
                Geometry::Box { size } => Solid::cuboid(DVec3::new(size.x, size.y, size.z), at),
                Geometry::Sphere { radius } => Solid::sphere(*radius, at),
                Geometry::Cylinder { radius, length } => Solid::cylinder(*radius, *length, at),
                Geometry::Capsule { radius, length } => Solid::capsule(*radius, *length, at),
                Geometry::Mesh(file) => {
                    let (name, uri) = (link.name.clone(), file.uri.clone());
                    let mesh = mesh::Mesh::load(file).map_err(|error| BodyError::File { link: name, uri, error })?;
                    return of_mesh(&mesh, mode(&link.name), at).map_err(bad);
                }
            };
            one.map(|solid| vec![solid]).map_err(bad)
        };
        let shapes = with_capsules(&link.collisions);
        let all = shapes.iter().map(|(number, shape)| (*number, shape)).map(solid).collect::<Result<Vec<_>, _>>()?;
        Ok(all.into_iter().flatten().collect())
    };
    model.links.iter().map(link).collect()
}

/// Returns the shapes of a link with their numbers, where a cylinder with a sphere of its radius at each end is one
/// capsule: URDF has none, so that descriptions compose them. One capsule is faster to check than three shapes.
fn with_capsules(shapes: &[Shape]) -> Vec<(usize, Shape)> {
    let mut all: Vec<(usize, Shape)> = shapes.iter().cloned().enumerate().collect();
    for (number, shape) in shapes.iter().enumerate() {
        let Geometry::Cylinder { radius, length } = shape.geometry else { continue };
        let end = |part: f64| {
            let center = shape.origin * nalgebra::Point3::new(0.0, 0.0, part * length);
            all.iter().find(|(_, other)| {
                let same = matches!(other.geometry, Geometry::Sphere { radius: own } if (own - radius).abs() < 1e-9);
                same && (other.origin.translation.vector - center.coords).norm() < SAME_CENTER
            })
        };
        if let (Some((first, _)), Some((last, _))) = (end(-0.5), end(0.5)) {
            let ends = [*first, *last];
            all.retain(|(other, _)| !ends.contains(other));
            if let Some((_, own)) = all.iter_mut().find(|(other, _)| *other == number) {
                own.geometry = Geometry::Capsule { radius, length };
            }
        }
    }
    all
}

/// Returns the solids of a mesh: one, unless it is decomposed.
pub fn of_mesh(mesh: &mesh::Mesh, mode: MeshMode, frame: DAffine3) -> Result<Vec<Solid>, ShapeError> {
    match mode {
        MeshMode::Mesh => {
            let own = Mesh::new(vertices(mesh), mesh.triangles.clone())?;
            Ok(vec![Solid::hull_of(Arc::new(own), frame)?])
        }
        MeshMode::Hull => Ok(vec![Solid::rough_hull(&vertices(mesh), frame)?]),
        MeshMode::Decomposition => decomposed(&vertices(mesh), &mesh.triangles, frame),
        MeshMode::Triangles => Ok(vec![surface(mesh, frame)?]),
    }
}

/// Returns a mesh as triangles.
pub fn surface(mesh: &mesh::Mesh, frame: DAffine3) -> Result<Solid, ShapeError> {
    Solid::mesh(Arc::new(Mesh::new(vertices(mesh), mesh.triangles.clone())?), frame)
}

fn vertices(mesh: &mesh::Mesh) -> Vec<DVec3> {
    mesh.vertices.iter().map(|v| DVec3::new(v.x, v.y, v.z)).collect()
}

/// Returns convex parts that together contain a mesh (V-HACD: K. Mamou, "Volumetric Hierarchical Approximate Convex
/// Decomposition", 2016), each the hull of the surface it covers. Falls back to the hull of the whole mesh.
fn decomposed(vertices: &[DVec3], triangles: &[[u32; 3]], frame: DAffine3) -> Result<Vec<Solid>, ShapeError> {
    // Rejects meshes that are not usable at all.
    let whole = Solid::rough_hull(vertices, frame)?;
    let parts = VHACD::decompose(&VHACDParameters::default(), vertices, triangles, true);
    let hulls = parts.compute_exact_convex_hulls(vertices, triangles);
    let hulls = hulls.iter().map(|(points, _)| Solid::rough_hull(points, frame)).collect::<Result<Vec<_>, _>>();
    Ok(hulls.ok().filter(|hulls| hulls.len() > 1).unwrap_or_else(|| vec![whole]))
}
