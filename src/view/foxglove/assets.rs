//! The files that a client may fetch: meshes of the robots' description and of objects, and no others.

use std::path::PathBuf;

use super::super::subject::Subject;
use dimos_core::bounded;
use dimos_log::display_messages::Marker;
use dimos_rpc::api::ShapeSpec;

/// Viewers fetch `package://` from the server, and other URIs not at all or themselves: those of meshes follow this.
const MESH: &str = "package://dimos/mesh/";
/// Before the name of an object and the name of its file.
const OBJECT: &str = "package://dimos/object/";

/// The URI of a mesh in the description, and its file.
pub type Asset = (String, Option<PathBuf>);

/// Returns a description in which viewers can fetch every mesh.
pub fn fetchable(urdf: &str) -> String {
    let mut parts = urdf.split("filename=\"");
    let mut out = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let is_package = part.starts_with("package://");
        out = out + "filename=\"" + if is_package { "" } else { MESH } + part;
    }
    out
}

/// Lets viewers fetch the mesh of an object.
pub fn make_fetchable(marker: &mut Marker) {
    if let (Some(object), Some(path)) = (marker.ns.strip_prefix("world/"), marker.mesh_resource.strip_prefix("file://"))
    {
        marker.mesh_resource = format!("{OBJECT}{object}/{}", path.rsplit('/').next().unwrap_or_default());
    }
}

/// Reads the file that a client asks for, or returns why it gets none. Blocks.
pub fn read(subject: &dyn Subject, meshes: &[Asset], uri: &str) -> Result<Vec<u8>, String> {
    let path = match uri.strip_prefix(OBJECT) {
        Some(rest) => {
            let name = rest.split('/').next().unwrap_or_default();
            match subject.object(name).map(|object| object.shape) {
                Some(ShapeSpec::Mesh(path)) => PathBuf::from(path),
                _ => return Err(format!("{name}: no object with a mesh")),
            }
        }
        None => {
            let own = uri.strip_prefix(MESH).unwrap_or(uri);
            match meshes.iter().find(|(known, _)| known == own) {
                Some((_, Some(path))) => path.clone(),
                Some((_, None)) => return Err(format!("{own}: file not found")),
                None => return Err(format!("{uri}: no mesh of this run")),
            }
        }
    };
    bounded::read(&path, bounded::LARGE).map_err(|error| format!("{}: {error}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mesh_becomes_fetchable() {
        let urdf = r#"<mesh filename="package://a/b.stl"/><mesh filename="c.dae" scale="1 1 1"/>"#;
        let wanted =
            r#"<mesh filename="package://a/b.stl"/><mesh filename="package://dimos/mesh/c.dae" scale="1 1 1"/>"#;
        assert_eq!(fetchable(urdf), wanted);
        assert_eq!(fetchable("<robot/>"), "<robot/>");
        let mut marker =
            Marker { ns: "world/cup".into(), mesh_resource: "file:///a/b/c.stl".into(), ..Marker::default() };
        make_fetchable(&mut marker);
        assert_eq!(marker.mesh_resource, "package://dimos/object/cup/c.stl");
    }
}
