//! What is at the flange: tools, loads, their speed; and the dimensions that an arm itself has.

pub mod kept_kinematics;
pub mod kinematics;
pub(in crate::runtime) mod payloads;
pub(in crate::runtime) mod tcp;
pub(in crate::runtime) mod tool_requests;
pub(in crate::runtime) mod tool_speed;

use std::sync::Mutex;

use nalgebra::Isometry3;

use payloads::HeldLoads;

/// What the arms of a run have at their flanges.
pub(in crate::runtime) struct Tools {
    /// Per task, the tool of its end effector.
    of_tasks: Mutex<Vec<Option<Isometry3<f64>>>>,
    /// Per arm, the objects that it holds and whose mass is known. Locked while a load is set.
    held: Vec<tokio::sync::Mutex<HeldLoads>>,
}

impl Tools {
    /// Begins with the tools of the tasks.
    pub fn new(of_tasks: Vec<Option<Isometry3<f64>>>, arms: usize) -> Self {
        let held = (0..arms).map(|_| tokio::sync::Mutex::default()).collect();
        Self { of_tasks: Mutex::new(of_tasks), held }
    }
}
