//! Dynamics as stored in a log, so that a run can be replayed without its robot description.

use glamx::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

use super::{Dynamics, Inertia};
use crate::kinematics::Kinematics;

/// Mass [kg], mass times centre [kg·m], and the columns of the second moments about the frame's origin [kg·m²].
type StoredInertia = [f64; 13];

/// Stored form of [`Dynamics`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Stored {
    kinematics: Kinematics,
    inertias: Vec<StoredInertia>,
    /// In the frame of the root [m/s²].
    gravity: [f64; 3],
    /// The link that carries a load, and its body's index.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    load: Option<(usize, StoredInertia)>,
}

fn put(inertia: &Inertia) -> StoredInertia {
    let mut all = [0.0; 13];
    let columns = inertia.second.to_cols_array();
    let values = [inertia.mass].into_iter().chain(inertia.first.to_array()).chain(columns);
    all.iter_mut().zip(values).for_each(|(to, from)| *to = from);
    all
}

fn get(stored: &StoredInertia) -> Result<Inertia, String> {
    if stored.iter().any(|v| !v.is_finite()) {
        return Err("an inertia is not finite".to_owned());
    }
    let [mass, x, y, z, second @ ..] = *stored;
    Ok(Inertia { mass, first: DVec3::new(x, y, z), second: DMat3::from_cols_array(&second) })
}

impl From<Dynamics> for Stored {
    fn from(from: Dynamics) -> Self {
        Self {
            inertias: from.inertias.iter().map(put).collect(),
            gravity: (-from.upwards).to_array(),
            load: from.load.map(|(body, load)| (body, put(&load))),
            kinematics: from.kinematics,
        }
    }
}

impl TryFrom<Stored> for Dynamics {
    type Error = String;

    fn try_from(from: Stored) -> Result<Self, String> {
        let inertias = from.inertias.iter().map(get).collect::<Result<Vec<_>, _>>()?;
        if inertias.len() != from.kinematics.bodies.len() || from.gravity.iter().any(|v| !v.is_finite()) {
            return Err(format!("{} inertias do not fit the bodies of the robot", inertias.len()));
        }
        let load = from.load.map(|(body, load)| get(&load).map(|load| (body, load))).transpose()?;
        let mut made = Self::of_inertias(from.kinematics, inertias);
        made.set_gravity(from.gravity);
        made.load = load;
        Ok(made)
    }
}
