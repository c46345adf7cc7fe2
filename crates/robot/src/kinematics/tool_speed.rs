//! How fast points of an arm move: its flange, its tool centre point, its elbow.

use glamx::{DAffine3, DVec3};

use super::Kinematics;
use super::jacobian::Column;
use dimos_core::joint::MAX_DOF;

/// Speeds of points of an arm; reuses its buffers.
#[derive(Debug, Clone)]
pub struct ToolSpeed {
    kinematics: Kinematics,
    links: Vec<usize>,
    frames: Vec<DAffine3>,
    columns: [Column; MAX_DOF],
}

impl ToolSpeed {
    /// Watches the origins of these links (indices in the kinematics, attached frames included).
    pub fn new(kinematics: Kinematics, links: Vec<usize>) -> Self {
        Self { links, frames: kinematics.frames(), columns: [[0.0; 6]; MAX_DOF], kinematics }
    }

    /// Moves a watched frame that [`Kinematics::attach_frame`] added to `offset` in the frame of `link`. Does not
    /// allocate.
    pub fn move_frame(&mut self, frame: usize, link: usize, offset: &DAffine3) {
        self.kinematics.move_frame(frame, link, offset);
    }

    /// Returns the highest speed of the points [m/s], with the joints at `positions` [rad or m] and `velocities`
    /// [rad/s or m/s]. Does not allocate.
    pub fn at(&mut self, positions: &[f64], velocities: &[f64]) -> f64 {
        self.kinematics.forward(positions, &mut self.frames);
        let mut fastest = 0.0_f64;
        for &link in &self.links {
            self.kinematics.jacobian(link, &self.frames, &mut self.columns);
            let mut velocity = DVec3::ZERO;
            for ([x, y, z, ..], speed) in self.columns.iter().zip(velocities) {
                velocity += DVec3::new(*x, *y, *z) * *speed;
            }
            fastest = fastest.max(velocity.length());
        }
        fastest
    }
}
