//! Meshes as binary STL, which every viewer reads: 80 bytes that mean nothing, the number of triangles, and for each of
//! them normal and corners as 32-bit floats, little-endian, with two bytes that mean nothing. Point clouds as 32-bit
//! floats, little-endian, three for each point.

use std::path::Path;

use nalgebra::Vector3;

use super::scene::MeshFile;
use dimos_core::bounded;
use dimos_planner::collision::ply;
use dimos_robot::mesh::Mesh;
use dimos_rpc::api::ShapeSpec;

/// Bytes before the number of triangles.
const HEADER: usize = 80;
/// Bytes per triangle.
const TRIANGLE: usize = 50;

/// Maximum number of points of a cloud that are shown.
const MAX_POINTS: usize = 100_000;

/// Reads a mesh file (STL, OBJ, Collada) and returns it as binary STL, not scaled.
pub fn from_file(path: &Path) -> Result<Vec<u8>, String> {
    Mesh::read(path, Vector3::repeat(1.0)).map(|mesh| from_mesh(&mesh))
}

/// Same for a mesh of a scene.
pub fn of(mesh: &MeshFile) -> Result<Vec<u8>, String> {
    match mesh {
        MeshFile::At(path) => from_file(path),
        MeshFile::Inside(name, bytes) => {
            let mesh = Mesh::from_bytes(bytes, Path::new(name), Vector3::repeat(1.0));
            mesh.map(|mesh| from_mesh(&mesh)).map_err(|what| format!("{name}: {what}"))
        }
        MeshFile::Missing(why) => Err(why.clone()),
    }
}

/// Returns the mesh of an object of the world as binary STL, or the points of its cloud.
pub fn of_object(shape: &ShapeSpec) -> Result<Vec<u8>, String> {
    match shape {
        ShapeSpec::Mesh(path) => from_file(Path::new(path)),
        ShapeSpec::Cloud(path) => {
            let data = bounded::read(Path::new(path), bounded::LARGE).map_err(|e| format!("{path}: {e}"))?;
            let points = ply::read(&data).map_err(|e| format!("{path}: {e}"))?;
            let every = points.len().div_ceil(MAX_POINTS).max(1);
            let finite = points.into_iter().step_by(every).filter(|point| point.is_finite());
            Ok(finite.flat_map(|p| p.to_array()).flat_map(|value| (value as f32).to_le_bytes()).collect())
        }
        _ => Err("this object has no file".to_owned()),
    }
}

fn from_mesh(mesh: &Mesh) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER + 4 + mesh.triangles.len() * TRIANGLE);
    bytes.resize(HEADER, 0);
    bytes.extend((mesh.triangles.len() as u32).to_le_bytes());
    for triangle in &mesh.triangles {
        let [a, b, c] = triangle.map(|index| mesh.vertices.get(index as usize).copied().unwrap_or_default().coords);
        // Viewers light a face by its normal.
        let normal = (b - a).cross(&(c - a)).try_normalize(0.0).unwrap_or_default();
        let values = [normal, a, b, c].into_iter().flat_map(|v| [v.x, v.y, v.z]);
        values.for_each(|value| bytes.extend((value as f32).to_le_bytes()));
        bytes.extend([0; 2]);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_obj_file_becomes_stl_that_reads_back_as_the_same_mesh() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("part.obj");
        std::fs::write(&path, "v 0 0 0\nv 0.5 0 0\nv 0 0.25 0\nv 0 0 0.125\nf 1 2 3\nf 1 4 2\n").unwrap();
        let bytes = from_file(&path).unwrap();
        assert_eq!(bytes.len(), HEADER + 4 + 2 * TRIANGLE);
        let float = |at: usize| f32::from_le_bytes(bytes[HEADER + 4 + at..][..4].try_into().unwrap());
        assert_eq!([float(0), float(4), float(8)], [0.0, 0.0, 1.0], "the normal points outside");
        let read = Mesh::from_bytes(&bytes, Path::new("part.stl"), Vector3::repeat(1.0)).unwrap();
        assert_eq!(read, Mesh::read(&path, Vector3::repeat(1.0)).unwrap());
    }

    #[test]
    fn a_cloud_becomes_its_points_and_a_large_one_fewer() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cloud.ply");
        let shown = |count: usize| {
            let header = format!("ply\nformat ascii 1.0\nelement vertex {count}\n");
            let header = header + "property float x\nproperty float y\nproperty float z\nend_header\n";
            std::fs::write(&path, header + &"0.5 -0.25 2\n".repeat(count)).unwrap();
            of_object(&ShapeSpec::Cloud(path.display().to_string())).unwrap()
        };
        let bytes: Vec<u8> = [0.5_f32, -0.25, 2.0].into_iter().flat_map(f32::to_le_bytes).collect();
        assert_eq!(shown(2), bytes.repeat(2));
        assert_eq!(shown(3 * MAX_POINTS - 1).len(), 12 * MAX_POINTS);
        assert!(of_object(&ShapeSpec::Sphere(0.1)).is_err());
    }

    #[test]
    fn a_file_that_is_no_mesh_is_refused_by_name() {
        let error = from_file(Path::new("/etc/hostname")).unwrap_err();
        assert!(error.starts_with("/etc/hostname: meshes of type"), "{error}");
    }
}
