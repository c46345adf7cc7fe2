//! The controller's errors: one flag each in a state.

/// Number of error flags.
pub const ERRORS: usize = 41;

/// The vendor's names, in the order of the flags.
const NAMES: [&str; ERRORS] = [
    "joint_position_limits_violation",
    "cartesian_position_limits_violation",
    "self_collision_avoidance_violation",
    "joint_velocity_violation",
    "cartesian_velocity_violation",
    "force_control_safety_violation",
    "joint_reflex",
    "cartesian_reflex",
    "max_goal_pose_deviation_violation",
    "max_path_pose_deviation_violation",
    "cartesian_velocity_profile_safety_violation",
    "joint_position_motion_generator_start_pose_invalid",
    "joint_motion_generator_position_limits_violation",
    "joint_motion_generator_velocity_limits_violation",
    "joint_motion_generator_velocity_discontinuity",
    "joint_motion_generator_acceleration_discontinuity",
    "cartesian_position_motion_generator_start_pose_invalid",
    "cartesian_motion_generator_elbow_limit_violation",
    "cartesian_motion_generator_velocity_limits_violation",
    "cartesian_motion_generator_velocity_discontinuity",
    "cartesian_motion_generator_acceleration_discontinuity",
    "cartesian_motion_generator_elbow_sign_inconsistent",
    "cartesian_motion_generator_start_elbow_invalid",
    "force_controller_desired_force_tolerance_violation",
    "start_elbow_sign_inconsistent",
    "communication_constraints_violation",
    "power_limit_violation",
    "cartesian_motion_generator_joint_position_limits_violation",
    "cartesian_motion_generator_joint_velocity_limits_violation",
    "cartesian_motion_generator_joint_velocity_discontinuity",
    "cartesian_motion_generator_joint_acceleration_discontinuity",
    "cartesian_position_motion_generator_invalid_frame",
    "controller_torque_discontinuity",
    "joint_p2p_insufficient_torque_for_planning",
    "tau_j_range_violation",
    "instability_detected",
    "joint_move_in_wrong_direction",
    "cartesian_spline_motion_generator_violation",
    "joint_via_motion_generator_planning_joint_limit_violation",
    "base_acceleration_initialization_timeout",
    "base_acceleration_invalid_reading",
];

/// Code of a reflex whose state names no error.
const UNNAMED: i32 = 90;
/// Code of a pressed user stop.
pub const USER_STOP: i32 = 91;

/// Returns the code of the first of these errors, from 1; 0 without an error. The vendor has names and no codes.
pub fn code(errors: u64) -> i32 {
    if errors == 0 { 0 } else { errors.trailing_zeros() as i32 + 1 }
}

/// Returns the code of a reflex.
pub fn reflex_code(errors: u64) -> i32 {
    if errors == 0 { UNNAMED } else { code(errors) }
}

/// Returns the names of errors.
pub fn names(errors: u64) -> String {
    let set = NAMES.iter().enumerate().filter(|(bit, _)| errors >> bit & 1 == 1).map(|(_, name)| *name);
    set.collect::<Vec<_>>().join(", ")
}
