//! Meshes as binary STL, which every viewer reads: 80 bytes that mean nothing, the number of triangles, and for each of
//! them normal and corners as 32-bit floats, little-endian, with two bytes that mean nothing.

use std::path::Path;

use nalgebra::Vector3;

use crate::robot::mesh::Mesh;

/// Bytes before the number of triangles.
const HEADER: usize = 80;
/// Bytes per triangle.
const TRIANGLE: usize = 50;

/// Reads a mesh file (STL, OBJ, Collada) and returns it as binary STL, not scaled.
pub fn from_file(path: &Path) -> Result<Vec<u8>, String> {
    Mesh::read(path, Vector3::repeat(1.0)).map(|mesh| from_mesh(&mesh))
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
    fn a_file_that_is_no_mesh_is_refused_by_name() {
        let error = from_file(Path::new("/etc/hostname")).unwrap_err();
        assert!(error.starts_with("/etc/hostname: meshes of type"), "{error}");
    }
}
