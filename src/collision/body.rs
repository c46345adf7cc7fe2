//! The solids of a robot's links, from its description.

use std::sync::Arc;

use glamx::{DAffine3, DVec3};

use crate::robot::kinematics::frame;
use crate::robot::mesh;
use crate::robot::model::{Geometry, RobotModel};

use super::shape::{Mesh, ShapeError, Solid};

/// How links that are given as meshes are checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum MeshMode {
    /// As the convex hull of each mesh: holds all of the mesh, and is faster.
    #[default]
    Hull,
    /// Triangle by triangle.
    Triangles,
}

/// Why a robot has no solids.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BodyError {
    /// A shape cannot be used.
    #[error("collision shape {number} of link {link:?}: {error}")]
    Shape {
        /// The link.
        link: String,
        /// Which of its shapes, from 1.
        number: usize,
        /// What is wrong.
        error: ShapeError,
    },
    /// A mesh file cannot be read.
    #[error("collision mesh {uri:?} of link {link:?}: {error}")]
    File {
        /// The link.
        link: String,
        /// The mesh as the description names it.
        uri: String,
        /// What is wrong.
        error: String,
    },
}

/// The collision solids of every link of a model, in the links' frames. Reads the mesh files.
pub fn solids(model: &RobotModel, mode: MeshMode) -> Result<Vec<Vec<Solid>>, BodyError> {
    let link = |link: &crate::robot::model::Link| {
        let solid = |(i, shape): (usize, &crate::robot::model::Shape)| {
            let bad = |error| BodyError::Shape { link: link.name.clone(), number: i + 1, error };
            let at = frame(&shape.origin);
            match &shape.geometry {
                Geometry::Box { size } => Solid::cuboid(DVec3::new(size.x, size.y, size.z), at).map_err(bad),
                Geometry::Sphere { radius } => Solid::sphere(*radius, at).map_err(bad),
                Geometry::Cylinder { radius, length } => Solid::cylinder(*radius, *length, at).map_err(bad),
                Geometry::Capsule { radius, length } => Solid::capsule(*radius, *length, at).map_err(bad),
                Geometry::Mesh(file) => {
                    let (link, uri) = (link.name.clone(), file.uri.clone());
                    let mesh = mesh::Mesh::load(file).map_err(|error| BodyError::File { link, uri, error })?;
                    of_mesh(&mesh, mode, at).map_err(bad)
                }
            }
        };
        link.collisions.iter().enumerate().map(solid).collect::<Result<Vec<_>, _>>()
    };
    model.links.iter().map(link).collect()
}

/// A solid of a mesh.
pub fn of_mesh(mesh: &mesh::Mesh, mode: MeshMode, frame: DAffine3) -> Result<Solid, ShapeError> {
    let vertices: Vec<DVec3> = mesh.vertices.iter().map(|v| DVec3::new(v.x, v.y, v.z)).collect();
    match mode {
        MeshMode::Hull => Solid::hull(&vertices, frame),
        MeshMode::Triangles => Solid::mesh(Arc::new(Mesh::new(vertices, mesh.triangles.clone())?), frame),
    }
}
