//! Triangle meshes from STL, OBJ and Collada files: vertices merged, finite, in metres.

mod collada;
mod obj;
mod sizes;
mod stl;
mod stored_as;

use std::collections::HashMap;
use std::fs;
use std::path::Path;

use nalgebra::{Point3, Vector3};

use crate::model::MeshFile;

pub use sizes::{MeshSizes, Size};

/// Maximum file size [bytes].
pub const MAX_BYTES: u64 = 64 << 20;
/// Maximum number of triangles.
pub const MAX_TRIANGLES: usize = 2_000_000;
/// Maximum coordinate [m].
const MAX_COORDINATE: f64 = 1e6;

/// A triangle mesh in the frame of its shape.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Vertices [m], each once.
    pub vertices: Vec<Point3<f64>>,
    /// Vertices of each triangle, anticlockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Reads and scales the file of a shape. The error names the file.
    pub fn load(mesh: &MeshFile) -> Result<Self, String> {
        match &mesh.path {
            Some(path) => Self::read(path, mesh.scale),
            None => Err(format!("{}: file not found", mesh.uri)),
        }
    }

    /// Reads and scales a file. A scale with an odd number of negative factors mirrors: triangles are reversed to keep
    /// their outside.
    pub fn read(path: &Path, scale: Vector3<f64>) -> Result<Self, String> {
        let named = |what: String| format!("{}: {what}", path.display());
        let about = fs::metadata(path).map_err(|e| named(e.to_string()))?;
        if !about.is_file() {
            return Err(named("not a file".to_owned()));
        }
        if about.len() > MAX_BYTES {
            return Err(named(format!("the file is larger than {} MiB", MAX_BYTES >> 20)));
        }
        let bytes = fs::read(path).map_err(|e| named(e.to_string()))?;
        Self::from_bytes(&bytes, path, scale).map_err(named)
    }

    /// Reads a file's bytes; the extension of `name` decides the format.
    pub fn from_bytes(bytes: &[u8], name: &Path, scale: Vector3<f64>) -> Result<Self, String> {
        stored_as::refuse_other_files(bytes)?;
        let ending = name.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
        let corners = match ending.as_str() {
            "dae" => collada::read(bytes)?,
            "stl" => stl::read(bytes)?,
            "obj" => obj::read(bytes)?,
            other => {
                let what = format!("meshes of type `{other}` cannot be read\nhint: convert it to STL, OBJ or DAE");
                return Err(what);
            }
        };
        Self::weld(&corners, scale)
    }

    /// Merges equal vertices; drops triangles without area.
    fn weld(corners: &[[Point3<f64>; 3]], scale: Vector3<f64>) -> Result<Self, String> {
        if corners.len() > MAX_TRIANGLES {
            return Err(format!("{} triangles (limit {MAX_TRIANGLES})", corners.len()));
        }
        let mut mesh = Self::default();
        let mut seen: HashMap<[u64; 3], u32> = HashMap::with_capacity(corners.len() / 2);
        let mirrored = scale.iter().filter(|s| **s < 0.0).count() % 2 == 1;
        for triangle in corners {
            let mut indices = [0; 3];
            for (index, corner) in indices.iter_mut().zip(triangle) {
                // Adding zero turns -0.0 into 0.0.
                let point = corner.coords.component_mul(&scale).add_scalar(0.0);
                if !point.iter().all(|v| v.abs() <= MAX_COORDINATE) {
                    return Err(format!("a vertex at {} {} {}", point.x, point.y, point.z));
                }
                let key = [point.x.to_bits(), point.y.to_bits(), point.z.to_bits()];
                *index = *seen.entry(key).or_insert_with(|| {
                    mesh.vertices.push(point.into());
                    (mesh.vertices.len() - 1) as u32
                });
            }
            let [a, b, c] = indices;
            if a != b && b != c && a != c {
                mesh.triangles.push(if mirrored { [a, c, b] } else { [a, b, c] });
            }
        }
        if mesh.triangles.is_empty() {
            return Err("no triangles".to_owned());
        }
        if !mesh.triangles.iter().any(|triangle| mesh.has_area(*triangle)) {
            return Err("no triangle has an area: its corners are on a line".to_owned());
        }
        Ok(mesh)
    }

    /// Returns whether a triangle is more than a line: its height is larger than what rounding makes of zero.
    fn has_area(&self, triangle: [u32; 3]) -> bool {
        let corner = |i: u32| self.vertices.get(i as usize).map_or_else(Vector3::zeros, |vertex| vertex.coords);
        let [a, b, c] = triangle.map(corner);
        let (one, two) = (b - a, c - a);
        one.cross(&two).norm() > 1e-7 * one.norm() * two.norm()
    }

    /// Returns the extents of the bounding box along x, y, z [m].
    pub fn extents(&self) -> Vector3<f64> {
        let (low, high) = self.bounds();
        high - low
    }

    /// Returns the lowest and highest corner of the bounding box [m].
    pub fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        let start = self.vertices.first().copied().unwrap_or_default();
        self.vertices.iter().fold((start, start), |(low, high), v| (low.inf(v), high.sup(v)))
    }
}

#[cfg(test)]
mod tests;
