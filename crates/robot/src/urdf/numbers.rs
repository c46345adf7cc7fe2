//! Numbers, vectors and poses in attributes: each finite, in the required count.

use nalgebra::{Isometry3, Quaternion, UnitQuaternion};

use super::Reader;
use crate::xml::{Attribute, Element};
use dimos_core::pose::from_xyz_rpy;
use dimos_yaml::{Diag, quote};

impl Reader<'_> {
    /// Returns `N` finite numbers from an attribute.
    pub(super) fn numbers<const N: usize>(&mut self, attribute: &Attribute) -> Option<[f64; N]> {
        let words: Vec<&str> = attribute.value.split_whitespace().collect();
        if words.len() != N {
            let many = |n: usize| if n == 1 { "1 number".to_owned() } else { format!("{n} numbers") };
            let what = format!("`{}` takes {}, found {}", attribute.name, many(N), words.len());
            self.error(attribute.at, what);
            return None;
        }
        let mut values = [0.0; N];
        for (value, word) in values.iter_mut().zip(words) {
            match word.parse::<f64>() {
                Ok(number) if number.is_finite() => *value = number,
                Ok(_) => {
                    self.error(
                        attribute.at,
                        format!("`{}` is {word}: only finite numbers are allowed", attribute.name),
                    );
                    return None;
                }
                Err(_) => {
                    self.error(attribute.at, format!("`{}`: {} is not a number", attribute.name, quote(word)));
                    return None;
                }
            }
        }
        Some(values)
    }

    /// Returns a required vector.
    pub(super) fn vector(&mut self, element: &Element, name: &str) -> Option<[f64; 3]> {
        self.needed(element, name)?;
        element.attribute(name).and_then(|a| self.numbers(a))
    }

    /// Returns a number, or a default if it is absent.
    pub(super) fn number_or(&mut self, element: &Element, name: &str, otherwise: f64) -> Option<f64> {
        match element.attribute(name) {
            Some(attribute) => self.numbers::<1>(attribute).map(|[value]| value),
            None => Some(otherwise),
        }
    }

    /// Returns the pose of an `origin` child; identity without one. Quaternions count from version 1.1 on.
    pub(super) fn origin(&mut self, element: &Element) -> Option<Isometry3<f64>> {
        let Some(origin) = element.child("origin") else { return Some(Isometry3::identity()) };
        let three = |reader: &mut Self, name: &str| match origin.attribute(name) {
            Some(attribute) => reader.numbers::<3>(attribute),
            None => Some([0.0; 3]),
        };
        let xyz = three(self, "xyz");
        let quaternion = origin.attribute("quat_xyzw");
        if let Some(quaternion) = quaternion.filter(|_| self.version < 1) {
            self.quaternions.push(quaternion.at);
        } else if let Some(quaternion) = quaternion {
            if let Some(rpy) = origin.attribute("rpy") {
                let diag = Diag::error("an origin has either `rpy` or `quat_xyzw`, not both");
                self.report(quaternion.at, diag.also(rpy.at.label()));
                return None;
            }
            let [x, y, z, w] = self.numbers::<4>(quaternion)?;
            let Some(rotation) = UnitQuaternion::try_new(Quaternion::new(w, x, y, z), 1e-9) else {
                self.error(quaternion.at, "this quaternion is zero");
                return None;
            };
            return Some(Isometry3::from_parts(xyz?.into(), rotation));
        }
        let rpy = three(self, "rpy");
        Some(from_xyz_rpy(xyz?, rpy?))
    }
}
