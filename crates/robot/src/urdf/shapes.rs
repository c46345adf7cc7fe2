//! Shapes, materials and inertia of links. Mistakes in visual shapes are warnings; those in collision shapes are
//! errors.

use nalgebra::Matrix3;

use super::{Meshes, Reader};
use crate::model::{Geometry, Inertial, MeshFile, Shape};
use crate::xml::{Element, SourcePos};
use dimos_core::message::Message;
use dimos_yaml::{Diag, quote};

/// Start of the warning of a missing visual mesh, which a description may have many of.
pub const VISUAL_NOT_FOUND: &str = "visual mesh not found";

impl Reader<'_> {
    /// Returns a shape; `None` if it is not usable, which is reported.
    pub(super) fn shape(&mut self, element: &Element, collides: bool) -> Option<Shape> {
        let origin = self.origin(element);
        let geometry = match element.child("geometry") {
            Some(geometry) => self.geometry(geometry, collides),
            None => self.unusable(element.at, collides, format!("this {} has no `geometry`", element.name)),
        };
        let color = element.child("material").filter(|_| !collides).and_then(|m| self.color_of(m));
        let name = element.attribute("name").map(|a| a.value.clone()).filter(|n| !n.is_empty());
        Some(Shape { name, origin: origin?, geometry: geometry?, color })
    }

    /// Reports an unusable shape: an error for a collision shape.
    fn unusable<T>(&mut self, at: SourcePos, collides: bool, what: String) -> Option<T> {
        match collides {
            true => self.error(at, what),
            false => self.warn(at, format!("{what}; it is not shown")),
        }
        None
    }

    fn geometry(&mut self, element: &Element, collides: bool) -> Option<Geometry> {
        let Some(shape) = element.elements().next() else {
            return self.unusable(element.at, collides, "this geometry is empty".to_owned());
        };
        if collides && has_no_extent(shape) {
            self.warn(shape.at, format!("this {} has no extent: it is left out", shape.name));
            return None;
        }
        let length = |reader: &mut Self, name: &str| {
            let (_, at) = reader.needed(shape, name)?;
            let value = reader.number_or(shape, name, 0.0)?;
            if value <= 0.0 {
                let what = format!("the {name} of this {} is {value}: it must be positive", shape.name);
                return reader.unusable(at, collides, what);
            }
            Some(value)
        };
        match shape.name.as_str() {
            "box" => {
                let size = self.vector(shape, "size")?;
                if size.iter().any(|s| *s <= 0.0) {
                    let at = shape.attribute("size").map_or(shape.at, |a| a.at);
                    return self.unusable(at, collides, "every extent of this box must be positive".to_owned());
                }
                Some(Geometry::Box { size: size.into() })
            }
            "sphere" => length(self, "radius").map(|radius| Geometry::Sphere { radius }),
            "cylinder" | "capsule" => {
                let (radius, length) = (length(self, "radius"), length(self, "length"));
                let (radius, length) = (radius?, length?);
                Some(match shape.name.as_str() {
                    "cylinder" => Geometry::Cylinder { radius, length },
                    _ => Geometry::Capsule { radius, length },
                })
            }
            "mesh" => self.mesh(shape, collides),
            other => {
                let what = format!("unknown geometry {}", quote(other));
                self.unusable(shape.at, collides, what)
            }
        }
    }

    fn mesh(&mut self, element: &Element, collides: bool) -> Option<Geometry> {
        let (uri, at) = self.needed(element, "filename")?;
        let scale = match element.attribute("scale") {
            Some(attribute) => self.numbers::<3>(attribute)?,
            None => [1.0; 3],
        };
        if scale.contains(&0.0) {
            let at = element.attribute("scale").map_or(element.at, |a| a.at);
            return self.unusable(at, collides, "a scale of zero is not allowed".to_owned());
        }
        let mut path = None;
        if self.meshes != Meshes::Ignore {
            match (self.resolve)(uri) {
                Ok(found) => path = Some(found),
                Err(why) => {
                    let Message { what, hint } = why.into();
                    let diag = match collides {
                        true if self.meshes == Meshes::Mark => {
                            Diag::warning(format!("collision mesh not found: {what}"))
                        }
                        true => Diag::error(format!("collision mesh not found: {what}")),
                        false => Diag::warning(format!("{VISUAL_NOT_FOUND}, it is not shown: {what}")),
                    };
                    self.report(at, diag.maybe_hint(hint));
                }
            }
        }
        Some(Geometry::Mesh(MeshFile { uri: uri.to_owned(), path, scale: scale.into() }))
    }

    /// Collects the colours of all named materials: links may use them before their definition.
    pub(super) fn collect_materials(&mut self, root: &Element) {
        let of_links = root.named("link").flat_map(|link| link.named("visual"));
        let inside = of_links.filter_map(|visual| visual.child("material"));
        for material in inside.chain(root.named("material")) {
            let name = material.attribute("name").map(|a| a.value.clone()).unwrap_or_default();
            if name.is_empty() {
                continue;
            }
            if let Some(color) = self.rgba(material) {
                self.materials.insert(name, color);
            }
        }
    }

    fn color_of(&mut self, material: &Element) -> Option<[f64; 4]> {
        let name = material.attribute("name").map(|a| a.value.as_str()).unwrap_or_default();
        self.rgba(material).or_else(|| self.materials.get(name).copied())
    }

    fn rgba(&self, material: &Element) -> Option<[f64; 4]> {
        let text = &material.child("color")?.attribute("rgba")?.value;
        let values: Vec<f64> = text.split_whitespace().filter_map(|word| word.parse().ok()).collect();
        let values: [f64; 4] = values.try_into().ok()?;
        Some(values.map(|v| if v.is_finite() { v.clamp(0.0, 1.0) } else { 1.0 }))
    }

    pub(super) fn inertial(&mut self, element: &Element) -> Option<Inertial> {
        let origin = self.origin(element);
        let (Some(mass), Some(inertia)) = (element.child("mass"), element.child("inertia")) else {
            self.warn(element.at, "this inertial lacks `mass` or `inertia` and is ignored");
            return None;
        };
        let kilograms = self.number_or(mass, "value", 0.0)?;
        if kilograms < 0.0 {
            let at = mass.attribute("value").map_or(mass.at, |a| a.at);
            self.error(at, format!("a mass of {kilograms} kg"));
        }
        let mut entry = |name: &str| self.number_or(inertia, name, 0.0);
        let [xx, xy, xz] = ["ixx", "ixy", "ixz"].map(&mut entry);
        let [yy, yz, zz] = ["iyy", "iyz", "izz"].map(&mut entry);
        let (xx, xy, xz, yy, yz, zz) = (xx?, xy?, xz?, yy?, yz?, zz?);
        let inertia = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
        Some(Inertial { origin: origin?, mass: kilograms, inertia })
    }
}

/// Returns whether all extents of a shape are zero: vendors write that for links that do not collide.
fn has_no_extent(shape: &Element) -> bool {
    let names: &[&str] = match shape.name.as_str() {
        "box" => &["size"],
        "sphere" => &["radius"],
        "cylinder" | "capsule" => &["radius", "length"],
        _ => return false,
    };
    let zero = |text: &str| text.parse::<f64>() == Ok(0.0);
    let mut extents = names.iter().map(|name| shape.attribute(name).map(|a| a.value.trim()).unwrap_or_default());
    extents.all(|extent| !extent.is_empty() && extent.split_whitespace().all(zero))
}
