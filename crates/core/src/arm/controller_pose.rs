//! The pose of an arm's end, as the arm's controller states it: of its own tool centre point, in its own reference
//! frame. The flange follows from the tool offset and the base offset that are set at the controller.

use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use super::Pose;
use crate::pose::{from_xyz_rpy, to_xyz_rpy};

/// What a controller states of the end of its arm.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct ControllerPose {
    /// Pose of the controller's tool centre point in the controller's reference frame.
    pub tcp: Pose,
    /// Pose of that point in the frame of the flange; `None`: the controller does not report it.
    pub tool: Option<Pose>,
    /// Pose of the arm's base in the reference frame; `None`: the controller does not report it.
    pub base: Option<Pose>,
}

impl ControllerPose {
    /// Returns the pose of a controller that states that of its flange, in the arm's base.
    pub fn of_flange(pose: Pose) -> Self {
        Self { tcp: pose, tool: Some(Pose::default()), base: Some(Pose::default()) }
    }

    /// Returns the pose of the flange in the arm's base; `None` where an offset is not reported.
    pub fn flange(&self) -> Option<Pose> {
        let (tool, base) = (self.tool?, self.base?);
        // Without offsets the controller's own numbers are kept as they are.
        if tool == Pose::default() && base == Pose::default() {
            return Some(self.tcp);
        }
        let flange = base.isometry().inverse() * self.tcp.isometry() * tool.isometry().inverse();
        Some(Pose::from(&flange))
    }

    /// Returns the pose of the controller's tool centre point in its reference frame for a pose of the flange in the
    /// arm's base: what the controller is given as a goal. `None` where an offset is not reported.
    pub fn tcp_at(&self, flange: &Isometry3<f64>) -> Option<Isometry3<f64>> {
        Some(self.base?.isometry() * flange * self.tool?.isometry())
    }

    /// Returns which offset is not reported, so that the flange is not known.
    pub fn missing(&self) -> Option<&'static str> {
        match (self.tool, self.base) {
            (None, _) => Some("tool offset"),
            (_, None) => Some("base offset"),
            _ => None,
        }
    }
}

impl Pose {
    /// Returns it as a transform.
    pub fn isometry(&self) -> Isometry3<f64> {
        from_xyz_rpy(self.xyz, self.rpy)
    }
}

impl From<&Isometry3<f64>> for Pose {
    fn from(pose: &Isometry3<f64>) -> Self {
        let (xyz, rpy) = to_xyz_rpy(pose);
        Self { xyz, rpy }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_are_taken_out_and_put_back() {
        let flange = Pose { xyz: [0.3, -0.2, 0.5], rpy: [0.4, -0.3, 2.0] };
        let (tool, base) =
            (Pose { xyz: [0.0, 0.01, 0.172], rpy: [0.0, 0.2, 0.1] }, Pose { xyz: [1.0; 3], rpy: [3.0; 3] });
        let tcp = base.isometry() * flange.isometry() * tool.isometry();
        let stated = ControllerPose { tcp: Pose::from(&tcp), tool: Some(tool), base: Some(base) };
        let off = stated.flange().unwrap().isometry().inverse() * flange.isometry();
        assert!(off.translation.vector.norm() < 1e-12 && off.rotation.angle() < 1e-7, "{off}");
        let back = stated.tcp_at(&flange.isometry()).unwrap().inverse() * tcp;
        assert!(back.translation.vector.norm() < 1e-12 && back.rotation.angle() < 1e-7, "{back}");
        assert_eq!(ControllerPose { tool: None, ..stated }.flange(), None, "not assumed to be zero");
        assert_eq!(ControllerPose { tool: None, ..stated }.missing(), Some("tool offset"));
        assert_eq!(ControllerPose { base: None, ..stated }.missing(), Some("base offset"));
        assert_eq!(ControllerPose::of_flange(flange).flange(), Some(flange), "without a rounding error");
    }
}
