//! The messages that only the node speaks; the others are those of a log. Requests without fields have one octet.

use crate::display_messages::{Duration, JointTrajectory, JointTrajectoryPoint, Transform};
use crate::messages::{Header, Time, Vector3};
use crate::wire::{message, sequences};

message! {
    /// A number that no other goal has.
    "unique_identifier_msgs/msg/UUID" "unique_identifier_msgs/UUID" Uuid {
        /// The number.
        uuid: [u8; 16],
    }
}

message! {
    /// A goal.
    "action_msgs/msg/GoalInfo" "action_msgs/GoalInfo" GoalInfo {
        /// Its number.
        goal_id: Uuid,
        /// When it was accepted.
        stamp: Time,
    }
}

message! {
    /// The state of a goal.
    "action_msgs/msg/GoalStatus" "action_msgs/GoalStatus" GoalStatus {
        /// The goal.
        goal_info: GoalInfo,
        /// 1 accepted, 2 executing, 3 canceling, 4 succeeded, 5 canceled, 6 aborted.
        status: i8,
    }
}

message! {
    /// The states of the goals of an action.
    "action_msgs/msg/GoalStatusArray" "action_msgs/GoalStatusArray" GoalStatusArray {
        /// The states.
        status_list: Vec<GoalStatus>,
    }
}

message! {
    /// Asks to cancel: the goal; without one those until the stamp; without either, all.
    "action_msgs/srv/CancelGoal_Request" "action_msgs/CancelGoal_Request" CancelRequest {
        /// Goal and time.
        goal_info: GoalInfo,
    }
}

message! {
    /// Which goals are being cancelled.
    "action_msgs/srv/CancelGoal_Response" "action_msgs/CancelGoal_Response" CancelResponse {
        /// 0 these are cancelled, 1 refused, 2 no such goal, 3 it has ended.
        return_code: i8,
        /// The goals.
        goals_canceling: Vec<GoalInfo>,
    }
}

message! {
    /// How far a joint may deviate. 0: the run's own tolerance; less: none.
    "control_msgs/msg/JointTolerance" "control_msgs/JointTolerance" JointTolerance {
        /// The joint.
        name: String,
        /// [rad].
        position: f64,
        /// [rad/s].
        velocity: f64,
        /// [rad/s²]. Not measured.
        acceleration: f64,
    }
}

message! {
    /// How far a joint with several degrees of freedom may deviate.
    "control_msgs/msg/JointComponentTolerance" "control_msgs/JointComponentTolerance" JointComponentTolerance {
        /// The joint.
        joint_name: String,
        /// The degree of freedom.
        component: u16,
        /// [m or rad].
        position: f64,
        /// [m/s or rad/s].
        velocity: f64,
        /// [m/s² or rad/s²].
        acceleration: f64,
    }
}

message! {
    /// A velocity.
    "geometry_msgs/msg/Twist" "geometry_msgs/Twist" Twist {
        /// [m/s].
        linear: Vector3,
        /// [rad/s].
        angular: Vector3,
    }
}

message! {
    /// A point of a trajectory of joints with several degrees of freedom.
    "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint" "trajectory_msgs/MultiDOFJointTrajectoryPoint" MultiDofPoint {
        /// Poses.
        transforms: Vec<Transform>,
        /// Velocities.
        velocities: Vec<Twist>,
        /// Accelerations.
        accelerations: Vec<Twist>,
        /// Time since the start.
        time_from_start: Duration,
    }
}

message! {
    /// A trajectory of joints with several degrees of freedom, which no arm has.
    "trajectory_msgs/msg/MultiDOFJointTrajectory" "trajectory_msgs/MultiDOFJointTrajectory" MultiDofTrajectory {
        /// Time and frame.
        header: Header,
        /// The joints.
        joint_names: Vec<String>,
        /// The points.
        points: Vec<MultiDofPoint>,
    }
}

message! {
    /// A trajectory, and how exactly it must be followed.
    "control_msgs/action/FollowJointTrajectory_Goal" "control_msgs/FollowJointTrajectory_Goal" FollowGoal {
        /// The trajectory.
        trajectory: JointTrajectory,
        /// Not for arms.
        multi_dof_trajectory: MultiDofTrajectory,
        /// Tolerances on the way.
        path_tolerance: Vec<JointTolerance>,
        /// Not for arms.
        component_path_tolerance: Vec<JointComponentTolerance>,
        /// Tolerances at the end.
        goal_tolerance: Vec<JointTolerance>,
        /// Not for arms.
        component_goal_tolerance: Vec<JointComponentTolerance>,
        /// Time that the joints may take to arrive after the end of the trajectory.
        goal_time_tolerance: Duration,
    }
}

message! {
    /// Asks to execute a goal.
    "control_msgs/action/FollowJointTrajectory_SendGoal_Request" "control_msgs/FollowJointTrajectory_SendGoal_Request"
    SendGoalRequest {
        /// Its number.
        goal_id: Uuid,
        /// The goal.
        goal: FollowGoal,
    }
}

message! {
    /// Whether a goal is accepted.
    "control_msgs/action/FollowJointTrajectory_SendGoal_Response" "control_msgs/FollowJointTrajectory_SendGoal_Response"
    SendGoalResponse {
        /// Whether it is.
        accepted: bool,
        /// When it was.
        stamp: Time,
    }
}

message! {
    /// How a goal ended.
    "control_msgs/action/FollowJointTrajectory_Result" "control_msgs/FollowJointTrajectory_Result" FollowResult {
        /// 0, or the reason as a negative number.
        error_code: i32,
        /// The reason.
        error_string: String,
    }
}

message! {
    /// Asks for the result of a goal.
    "control_msgs/action/FollowJointTrajectory_GetResult_Request" "control_msgs/FollowJointTrajectory_GetResult_Request"
    ResultRequest {
        /// The goal.
        goal_id: Uuid,
    }
}

message! {
    /// The result of a goal.
    "control_msgs/action/FollowJointTrajectory_GetResult_Response"
    "control_msgs/FollowJointTrajectory_GetResult_Response" ResultResponse {
        /// Its state, as in `GoalStatus`.
        status: i8,
        /// The result.
        result: FollowResult,
    }
}

message! {
    /// Where a motion is, without indices of points: control_msgs before 6.3.
    "control_msgs/action/FollowJointTrajectory_FeedbackMessage" "control_msgs/FollowJointTrajectory_FeedbackMessage"
    Feedback {
        /// The goal.
        goal_id: Uuid,
        /// Time.
        header: Header,
        /// The joints.
        joint_names: Vec<String>,
        /// The trajectory.
        desired: JointTrajectoryPoint,
        /// What is measured.
        actual: JointTrajectoryPoint,
        /// Desired less actual values.
        error: JointTrajectoryPoint,
    }
}

message! {
    /// The rest of the feedback: joints with several degrees of freedom, which no arm has.
    "control_msgs/action/FollowJointTrajectory_FeedbackRest" "control_msgs/FollowJointTrajectory_FeedbackRest"
    FeedbackRest {
        /// The joints: none.
        multi_dof_joint_names: Vec<String>,
        /// The trajectory.
        multi_dof_desired: MultiDofPoint,
        /// What is measured.
        multi_dof_actual: MultiDofPoint,
        /// Their difference.
        multi_dof_error: MultiDofPoint,
    }
}

message! {
    /// Outcome of a service that triggers something.
    "std_srvs/srv/Trigger_Response" "std_srvs/Trigger_Response" TriggerResponse {
        /// Whether it was done.
        success: bool,
        /// What was done, or why not.
        message: String,
    }
}

message! {
    /// To which other controller a controller is chained.
    "controller_manager_msgs/msg/ChainConnection" "controller_manager_msgs/ChainConnection" ChainConnection {
        /// The controller.
        name: String,
        /// Its references.
        reference_interfaces: Vec<String>,
    }
}

message! {
    /// A controller: one of the run's trajectory tasks.
    "controller_manager_msgs/msg/ControllerState" "controller_manager_msgs/ControllerState" ControllerState {
        /// Name of the task.
        name: String,
        /// `active`.
        state: String,
        /// The class of controllers of ROS that does the same.
        r#type: String,
        /// Whether it runs in its own thread.
        is_async: bool,
        /// Its rate [Hz].
        update_rate: u16,
        /// The commands that it has now.
        claimed_interfaces: Vec<String>,
        /// The commands that it needs.
        required_command_interfaces: Vec<String>,
        /// The states that it needs.
        required_state_interfaces: Vec<String>,
        /// Whether others may be chained to it.
        is_chainable: bool,
        /// Whether one is.
        is_chained: bool,
        /// For chained ones.
        exported_state_interfaces: Vec<String>,
        /// For chained ones.
        reference_interfaces: Vec<String>,
        /// For chained ones.
        chain_connections: Vec<ChainConnection>,
    }
}

message! {
    /// The controllers.
    "controller_manager_msgs/srv/ListControllers_Response" "controller_manager_msgs/ListControllers_Response"
    ControllerList {
        /// The controllers.
        controller: Vec<ControllerState>,
    }
}

message! {
    /// State of a component.
    "lifecycle_msgs/msg/State" "lifecycle_msgs/State" LifecycleState {
        /// 1 unconfigured, 2 inactive, 3 active.
        id: u8,
        /// The same as a word.
        label: String,
    }
}

message! {
    /// A value that is commanded or measured.
    "controller_manager_msgs/msg/HardwareInterface" "controller_manager_msgs/HardwareInterface" HardwareInterface {
        /// `JOINT/position`.
        name: String,
        /// `double`.
        data_type: String,
        /// Whether it has a value.
        is_available: bool,
        /// Whether a controller commands it.
        is_claimed: bool,
    }
}

message! {
    /// Name, kind and rate of an arm as a hardware component.
    "controller_manager_msgs/msg/HardwareComponentStateBegin" "controller_manager_msgs/HardwareComponentStateBegin"
    ComponentBegin {
        /// Name of the arm.
        name: String,
        /// `system`.
        r#type: String,
        /// Whether it is read and written in its own thread.
        is_async: bool,
        /// Rate of reading and writing [Hz].
        rw_rate: u16,
    }
}

message! {
    /// The rest of an arm as a hardware component.
    "controller_manager_msgs/msg/HardwareComponentStateEnd" "controller_manager_msgs/HardwareComponentStateEnd"
    ComponentEnd {
        /// Name of the adapter.
        plugin_name: String,
        /// Its state.
        state: LifecycleState,
        /// What is commanded.
        command_interfaces: Vec<HardwareInterface>,
        /// What is measured.
        state_interfaces: Vec<HardwareInterface>,
    }
}

sequences! {
    GoalInfo => "action_msgs/GoalInfo[]";
    GoalStatus => "action_msgs/GoalStatus[]";
    JointTolerance => "control_msgs/JointTolerance[]";
    JointComponentTolerance => "control_msgs/JointComponentTolerance[]";
    Transform => "geometry_msgs/Transform[]";
    Twist => "geometry_msgs/Twist[]";
    MultiDofPoint => "trajectory_msgs/MultiDOFJointTrajectoryPoint[]";
    ChainConnection => "controller_manager_msgs/ChainConnection[]";
    ControllerState => "controller_manager_msgs/ControllerState[]";
    HardwareInterface => "controller_manager_msgs/HardwareInterface[]";
}
