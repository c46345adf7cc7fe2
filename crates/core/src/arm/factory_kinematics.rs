//! The dimensions of one arm, as its maker measured them and its controller has them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Denavit-Hartenberg parameters of a joint: Rz(theta + q) · Tz(d) · Tx(a) · Rx(alpha).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Dh {
    /// Offset of the joint's position [rad].
    #[serde(default)]
    pub theta: f64,
    /// Length of the link along its x axis [m].
    pub a: f64,
    /// Offset along the joint's axis [m].
    pub d: f64,
    /// Angle between this joint's axis and the next one [rad].
    pub alpha: f64,
}

/// The kinematics of one arm, measured at the factory. The axes of joints that are parallel by design are not quite
/// parallel: their common normal, and with it the parameters `a`, `d` and `theta`, may then be metres away from the
/// arm. Only the product of all joints means anything.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct FactoryKinematics {
    /// Parameters of each joint by design: those of the model.
    pub nominal: Vec<Dh>,
    /// Parameters of each joint of this arm; `None`: the controller does not report them.
    pub actual: Option<Vec<Dh>>,
    /// The controller's checksum of them, in hexadecimal; empty without them.
    pub checksum: String,
}
