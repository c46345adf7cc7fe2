//! The types of ROS 2 that the node speaks, with the hashes of their definitions: a subscriber with another definition
//! has another key, and receives nothing.
//!
//! The hashes are those that ROS computes (REP 2016, `RIHS01`); a test compares them with those of rosbags.

use crate::blueprint::share::Distro;

/// A type of messages or services.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Type {
    /// Its name: `sensor_msgs/msg/JointState`.
    pub name: &'static str,
    /// SHA-256 of its definition.
    pub hash: &'static str,
}

impl Type {
    const fn new(name: &'static str, hash: &'static str) -> Self {
        Self { name, hash }
    }

    /// Returns name and hash as keys have them: `sensor_msgs::msg::dds_::JointState_/RIHS01_…`.
    pub fn key(self) -> String {
        let (package, name) = self.name.rsplit_once('/').unwrap_or_default();
        format!("{}::dds_::{name}_/RIHS01_{}", package.replace('/', "::"), self.hash)
    }
}

/// Joint states.
pub const JOINT_STATE: Type =
    Type::new("sensor_msgs/msg/JointState", "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e");
/// Transforms.
pub const TRANSFORMS: Type =
    Type::new("tf2_msgs/msg/TFMessage", "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087");
/// A text.
pub const TEXT: Type =
    Type::new("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18");
/// Diagnostics.
pub const DIAGNOSTICS: Type = Type::new(
    "diagnostic_msgs/msg/DiagnosticArray",
    "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
);
/// A service without parameters.
pub const TRIGGER: Type =
    Type::new("std_srvs/srv/Trigger", "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f");
/// List of the controllers.
pub const LIST_CONTROLLERS: Type = Type::new(
    "controller_manager_msgs/srv/ListControllers",
    "4f8e36bb1fa5afdeba45c2d56ae6a2097b1493a253f961dd6290c085033bd189",
);
/// States of the goals of an action.
pub const GOAL_STATUS: Type =
    Type::new("action_msgs/msg/GoalStatusArray", "6c1684b00f177d37438febe6e709fc4e2b0d4248dca4854946f9ed8b30cda83e");
/// Service that cancels goals.
pub const CANCEL_GOAL: Type =
    Type::new("action_msgs/srv/CancelGoal", "573d8b0a534451d7bc2ac8c5ffde8ac14b8593b7001175d0cd6516dcbeb8689a");
/// Service that takes a trajectory.
pub const SEND_GOAL: Type = Type::new(
    "control_msgs/action/FollowJointTrajectory_SendGoal",
    "b13789dddc325a7a962825c45e28c77d37237ec129dd0c34dc5994562938c57f",
);
/// Service that answers when a trajectory has ended.
pub const GET_RESULT: Type = Type::new(
    "control_msgs/action/FollowJointTrajectory_GetResult",
    "e3ceb38e3e1867c8dc0f46014df26e90eb93422f27e9e97f936e07f94be4bc8b",
);

/// Returns the type of the feedback of a trajectory. Since control_msgs 6.3 it has indices of points.
pub const fn feedback(distro: Distro) -> Type {
    let name = "control_msgs/action/FollowJointTrajectory_FeedbackMessage";
    match distro {
        Distro::Jazzy => Type::new(name, "80398fcb9674a79081a9906e2ccf0c804dd7cb15e22e362e606ee87186beab71"),
        Distro::Kilted | Distro::Lyrical => {
            Type::new(name, "95618cc73912d99b9acaa17d2da5e832cb0bfdeede7534fa8ec600feca2a6c4b")
        }
    }
}

/// Returns the type of the list of the hardware. Until ros2_control 5 a component has its class twice.
pub const fn list_hardware(distro: Distro) -> Type {
    let name = "controller_manager_msgs/srv/ListHardwareComponents";
    match distro {
        Distro::Jazzy => Type::new(name, "2ff105e609928671af16413362c0fdd089e1dd50c5a49d830db603ba8e4439c8"),
        Distro::Kilted | Distro::Lyrical => {
            Type::new(name, "da29c2bbff9ec4f28d2815b9906ff51e419cebb6e79e216d4350110459b5164f")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_key_has_the_name_of_dds_and_the_hash() {
        let wanted = format!("std_msgs::msg::dds_::String_/RIHS01_{}", TEXT.hash);
        assert_eq!(TEXT.key(), wanted);
        assert!(SEND_GOAL.key().starts_with("control_msgs::action::dds_::FollowJointTrajectory_SendGoal_/RIHS01_b137"));
    }
}
