//! The messages of a log: ROS 2's own where there is one, `dimos_msgs` where there is none.
//!
//! What is not known is absent: an empty list, or NaN where a list needs a value for every joint. Never zero.

use super::wire::message;

message! {
    /// A point in time.
    "builtin_interfaces/msg/Time" "builtin_interfaces/Time" Time {
        /// Whole seconds since the Unix epoch.
        sec: i32,
        /// The rest of the time [ns].
        nanosec: u32,
    }
}

impl Time {
    /// From nanoseconds since the Unix epoch. ROS 2 counts seconds in 32 bits: this type ends in January 2038.
    pub fn of(ns: u64) -> Self {
        let sec = i32::try_from(ns / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (ns % 1_000_000_000) as u32 }
    }
}

message! {
    /// When and in which frame.
    "std_msgs/msg/Header" "std_msgs/Header" Header {
        /// When: the deadline of the tick, in Unix time.
        stamp: Time,
        /// In which frame.
        frame_id: String,
    }
}

message! {
    /// Joint values; each list has one value per name, or is empty.
    "sensor_msgs/msg/JointState" "sensor_msgs/JointState" JointState {
        /// When.
        header: Header,
        /// Joints.
        name: Vec<String>,
        /// [rad], of a gripper [m].
        position: Vec<f64>,
        /// [rad/s].
        velocity: Vec<f64>,
        /// [Nm].
        effort: Vec<f64>,
    }
}

message! {
    /// Text.
    "std_msgs/msg/String" "std_msgs/String" Text {
        /// The text.
        data: String,
    }
}

message! {
    /// A vector in space.
    "geometry_msgs/msg/Vector3" "geometry_msgs/Vector3" Vector3 {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }
}

message! {
    /// A force and a torque.
    "geometry_msgs/msg/Wrench" "geometry_msgs/Wrench" Wrench {
        /// [N].
        force: Vector3,
        /// [Nm].
        torque: Vector3,
    }
}

message! {
    /// A force and a torque at a time.
    "geometry_msgs/msg/WrenchStamped" "geometry_msgs/WrenchStamped" WrenchStamped {
        /// When.
        header: Header,
        /// Force and torque at the sensor.
        wrench: Wrench,
    }
}

message! {
    /// A line of the text log.
    "rcl_interfaces/msg/Log" "rcl_interfaces/Log" Log {
        /// When.
        stamp: Time,
        /// 10 debug, 20 info, 30 warn, 40 error, 50 fatal.
        level: u8,
        /// Who says it: the run.
        name: String,
        /// The line.
        msg: String,
        /// Not used.
        file: String,
        /// Not used.
        function: String,
        /// Not used.
        line: u32,
    }
}

message! {
    /// Timing of a tick. One per tick.
    "dimos_msgs/msg/Tick" "dimos_msgs/Tick" Tick {
        /// When.
        header: Header,
        /// Index of the tick, counted from 0.
        tick: u64,
        /// The tick's deadline in monotonic time [ns].
        deadline_ns: u64,
        /// Wake-up after the deadline [ns].
        late_ns: u64,
        /// Wake-up to the last command handed over [ns].
        compute_ns: u64,
        /// Whole periods skipped before this tick.
        skipped: u32,
        /// The lateness that cost them, of this tick or of the one before [ns].
        overrun_ns: u64,
        /// When the tick took the next one to be due, in monotonic time [ns].
        next_ns: u64,
        /// Samples lost since the last tick in this log because the ring to the recorder was full.
        dropped: u32,
    }
}

message! {
    /// Something happened in a tick.
    "dimos_msgs/msg/Event" "dimos_msgs/Event" Event {
        /// When.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// request, task, preempted, mode_conflict, arm, limited, overrun or degraded.
        kind: String,
        /// info, warn or error.
        severity: String,
        /// Id of the request it answers, as in /dimos/requests; empty if it answers none.
        request: Vec<u64>,
        /// The arm concerned, or empty.
        arm: String,
        /// The task concerned, or empty.
        task: String,
        /// The joint concerned, or empty.
        joint: String,
        /// The status word of the outcome, task state, phase or limit.
        status: String,
        /// The event's numbers, if any.
        values: Vec<f64>,
        /// All of it in a sentence.
        text: String,
    }
}

message! {
    /// How an arm is. At changes, and ten times a second.
    "dimos_msgs/msg/ArmStatus" "dimos_msgs/ArmStatus" ArmStatus {
        /// When.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// unknown, disabled, activating, ready, held or standby.
        phase: String,
        /// Why it is in that phase, e.g. operator_stop, arm_fault, link_lost.
        cause: String,
        /// The same as a sentence; empty if there is nothing to say.
        cause_text: String,
        /// down, up, stale or faulted.
        link: String,
        /// The control mode the arm is in.
        mode: String,
        /// Whether the motors are on.
        enabled: bool,
        /// The arm's own error code, 0 for none.
        error: i32,
        /// What the arm says about that error.
        error_text: String,
        /// Age of the newest joint state [s]; NaN before the first.
        age: f64,
        /// absent, measured or estimated.
        velocity_source: String,
        /// Number of the newest state, 0 before the first.
        seq: u64,
        /// The device thread held the arm by itself.
        self_held: bool,
    }
}

message! {
    /// What a tick read of an arm, besides the values in /joint_states: with those, all of it. On each tick that
    /// read something else than the tick before.
    "dimos_msgs/msg/ArmInput" "dimos_msgs/ArmInput" ArmInput {
        /// When.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// Number of the state, 0 before the first. Its values in /joint_states are NaN while it is 0.
        seq: u64,
        /// When its joint positions were measured, in monotonic time [ns].
        stamp_ns: u64,
        /// absent, measured or estimated. Estimated velocities were computed by the tick, not read.
        velocity_source: String,
        /// Whether the arm reported efforts.
        has_effort: bool,
        /// Gripper opening [m]; empty if not reported.
        gripper: Vec<f64>,
        /// End-effector pose in the arm's base frame: x, y, z [m], roll, pitch, yaw [rad]; empty if not reported.
        pose: Vec<f64>,
        /// Force [N] and torque [Nm] at the sensor; empty if not reported.
        wrench: Vec<f64>,
        /// The control mode the arm is in.
        mode: String,
        /// Whether the motors are on.
        enabled: bool,
        /// The arm's own error code, 0 for none.
        error: i32,
        /// down, up, stale or faulted.
        link: String,
        /// The device thread held the arm by itself.
        self_held: bool,
        /// Number of the newest command that was written to the wire.
        written: u64,
        /// What was seen of the arm that this run did not order: mode, power, or empty.
        interference: String,
        /// Part of the state's age in which the device thread could not run [ns].
        own_delay_ns: u64,
    }
}

message! {
    /// What a tick wants of an arm, besides the values in /joint_commands. On each tick that wants something else
    /// than the tick before.
    "dimos_msgs/msg/ArmOutput" "dimos_msgs/ArmOutput" ArmOutput {
        /// When.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// Number of the command, 0 before the first.
        seq: u64,
        /// The control mode of the command; empty while the arm is left alone.
        mode: String,
        /// Gripper opening [m]; meaningless while gripper_seq is 0.
        gripper: f64,
        /// Counts gripper commands.
        gripper_seq: u32,
        /// Counts requests that the arm stop by its own means.
        stop_seq: u32,
        /// When the tick will read states next, in monotonic time [ns].
        next_tick_ns: u64,
        /// Counts starts of commanded motion: after enabling and after a change of mode.
        start_seq: u32,
    }
}
