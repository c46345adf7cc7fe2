//! Poses of tool centre points in a log: computed from its joint states, on the recorder's thread.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use glamx::DAffine3;
use nalgebra::Isometry3;

use super::messages::{Point, Pose, Quaternion};
use dimos_robot::kinematics::{Kinematics, pose};

/// Minimum time between two poses of an arm: at most 100 a second, also of an arm with a state every millisecond.
pub(super) const TCP_EVERY: Duration = Duration::from_micros(9_900);

/// From the joints of an arm to its tool centre point.
#[derive(Debug, Clone)]
pub struct TcpChain {
    /// Indices of its joints over all arms' joints, in the order of the kinematics.
    pub joints: Vec<usize>,
    /// The kinematics.
    pub kinematics: Arc<Kinematics>,
    /// Index of the end-effector link in the kinematics.
    pub link: usize,
    /// Pose of the model's root in `map`.
    pub root: DAffine3,
    /// Pose of the tool centre point in the link's frame.
    pub tool: Option<Isometry3<f64>>,
}

/// The chain of each arm; `None` without a model. Shared with the recorder, because tools change during a run.
pub type TcpChains = Arc<Mutex<Vec<Option<TcpChain>>>>;

impl TcpChain {
    /// Returns the pose in `map` at these positions of all arms' joints [rad]; `None` if one is unknown.
    pub(super) fn pose(&self, positions: &[f64]) -> Option<Pose> {
        let position = |joint: &usize| positions.get(*joint).copied().filter(|q| q.is_finite());
        let q: Vec<f64> = self.joints.iter().map(position).collect::<Option<_>>()?;
        let mut frames = self.kinematics.frames();
        self.kinematics.forward_from(&self.root, &q, &mut frames);
        let tcp = pose(&self.kinematics.link_frame(self.link, &frames)) * self.tool.unwrap_or_default();
        let ([x, y, z], turn) = (tcp.translation.vector.into(), tcp.rotation.coords);
        let orientation = Quaternion { x: turn.x, y: turn.y, z: turn.z, w: turn.w };
        Some(Pose { position: Point { x, y, z }, orientation })
    }
}
