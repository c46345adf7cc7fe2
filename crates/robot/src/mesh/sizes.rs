//! Sizes of mesh files, and what is wrong with those of a description. Each is read once.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use nalgebra::Vector3;

use super::Mesh;
use crate::model::MeshFile;
use crate::xml::{Document, Element};
use crate::{Geometry, RobotModel, Shape};
use dimos_core::message::Message;
use dimos_core::written::{LONG, LONGEST};
use dimos_yaml::{Diag, Label};

/// Extent below which the unit of a mesh is doubted [m].
const SMALL: f64 = 1e-4;

/// What to do about a mesh of an object that is in another unit.
const OBJECT_HINT: &str = "a mesh in the world is in metres: convert the file, for example from millimetres";

/// Size of a mesh.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Number of triangles.
    pub triangles: usize,
    /// Extents along x, y, z, after scaling [m].
    pub extents: Vector3<f64>,
}

impl Size {
    /// Reads the size of a file that is not scaled.
    pub fn read(path: &Path) -> Result<Self, String> {
        Mesh::read(path, Vector3::repeat(1.0)).map(|mesh| Self::of(&mesh))
    }

    fn of(mesh: &Mesh) -> Self {
        Self { triangles: mesh.triangles.len(), extents: mesh.extents() }
    }

    /// Returns why the unit of the mesh is doubtful: it is larger than this [m], or tiny.
    fn doubt(&self, large: f64) -> Option<String> {
        let (most, shown) = (self.extents.amax(), self.shown());
        if most > large {
            return Some(format!("extends over {shown}"));
        }
        (most < SMALL).then(|| format!("extends over only {shown}"))
    }

    /// Refuses the mesh of an object in the world that is not in metres.
    pub fn of_object(mesh: &Mesh, path: &Path) -> Result<(), String> {
        let size = Self::of(mesh);
        match size.extents.amax() > LONGEST {
            true => Err(format!("{} extends over {}\nhint: {OBJECT_HINT}", path.display(), size.shown())),
            false => Ok(()),
        }
    }

    /// Returns a warning if the unit of the mesh of an object in the world is doubtful: such a mesh has no scale.
    pub fn doubt_of_object(&self, object: &str, path: &Path) -> Option<Diag> {
        let doubt = self.doubt(LONG).filter(|_| self.extents.amax() <= LONGEST)?;
        Some(Diag::warning(format!("the mesh of the object `{object}` {doubt}: {}", path.display())).hint(OBJECT_HINT))
    }

    /// Returns a warning if the unit of the mesh of a link is doubtful.
    fn doubt_of_link(&self, link: &str, uri: &str) -> Option<Diag> {
        let hint = match self.extents.amax() > LONGEST {
            true => "a URDF is in metres: if the file is in millimetres, add scale=\"0.001 0.001 0.001\"",
            false => "is it scaled twice? a file in metres needs no scale",
        };
        Some(Diag::warning(format!("the mesh of the link `{link}` {}: {uri}", self.doubt(LONGEST)?)).hint(hint))
    }

    /// Returns the extents as text.
    pub fn shown(&self) -> String {
        // Four significant digits of the largest one.
        let digits = (3.0 - self.extents.amax().log10().floor()).clamp(0.0, 12.0) as usize;
        let [x, y, z] = [self.extents.x, self.extents.y, self.extents.z];
        format!("{x:.digits$} × {y:.digits$} × {z:.digits$} m")
    }
}

/// The meshes read so far, by file and scale.
#[derive(Debug, Default)]
pub struct MeshSizes(HashMap<(PathBuf, [u64; 3]), Result<Size, String>>);

impl MeshSizes {
    /// Returns the size of a mesh, or why it cannot be read; `None` if its file was not found.
    pub fn of(&mut self, mesh: &MeshFile) -> Option<&Result<Size, String>> {
        let path = mesh.path.clone()?;
        let scale = [mesh.scale.x, mesh.scale.y, mesh.scale.z].map(f64::to_bits);
        let read = || Mesh::load(mesh).map(|mesh| Size::of(&mesh));
        Some(self.0.entry((path, scale)).or_insert_with(read))
    }

    /// Returns the number of triangles of all meshes read.
    pub fn triangles(&self) -> usize {
        self.0.values().flatten().map(|size| size.triangles).sum()
    }

    /// Returns what is wrong with the meshes of a robot, each once: an unreadable collision mesh is an error, a
    /// visual one and an unlikely size are warnings. Positions are those in the expanded description.
    pub fn mistakes(&mut self, robot: &RobotModel, document: Option<&Document>) -> Vec<Diag> {
        let mut diags: Vec<Diag> = Vec::new();
        for link in &robot.links {
            let collisions = link.collisions.iter().map(|shape| (shape, true));
            for (shape, collides) in collisions.chain(link.visuals.iter().map(|shape| (shape, false))) {
                let Shape { geometry: Geometry::Mesh(mesh), .. } = shape else { continue };
                let diag = match self.of(mesh) {
                    Some(Ok(size)) => size.doubt_of_link(&link.name, &mesh.uri),
                    Some(Err(why)) => {
                        let Message { what, hint } = why.clone().into();
                        let what = format!("unusable mesh of the link `{}`: {what}", link.name);
                        let diag = if collides { Diag::error(what) } else { Diag::warning(what) };
                        Some(diag.maybe_hint(hint))
                    }
                    None => None,
                };
                let Some(mut diag) = diag else { continue };
                diag.at = document.and_then(|document| place(document, &link.name, &mesh.uri, collides));
                let known = |other: &Diag| other.message == diag.message && other.severity == diag.severity;
                if !diags.iter().any(known) {
                    diags.push(diag);
                }
            }
        }
        diags
    }
}

/// Returns the position of a mesh's file name in a description.
fn place(document: &Document, link: &str, uri: &str, collides: bool) -> Option<Label> {
    let named = |element: &&Element| element.attribute("name").is_some_and(|a| a.value == link);
    let link = document.root.named("link").find(named)?;
    let shapes = link.named(if collides { "collision" } else { "visual" });
    let files = shapes.filter_map(|shape| shape.child("geometry")?.child("mesh")?.attribute("filename"));
    let mut files = files.filter(|file| file.value == uri);
    files.next().map(|file| file.at.label())
}
