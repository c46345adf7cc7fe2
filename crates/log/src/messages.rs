//! The messages of a log: ROS 2's own types where they exist, otherwise `dimos_msgs`.
//!
//! Unknown values are absent: an empty list, or NaN where a list needs a value for every joint. Never zero.

use super::wire::message;

message! {
    /// A point in time.
    "builtin_interfaces/msg/Time" "builtin_interfaces/Time" Time {
        /// Whole seconds since the Unix epoch.
        sec: i32,
        /// Nanoseconds within the second [ns].
        nanosec: u32,
    }
}

impl Time {
    /// Converts from nanoseconds since the Unix epoch. ROS 2 counts seconds in 32 bits: this type ends in January 2038.
    pub fn of(ns: u64) -> Self {
        let sec = i32::try_from(ns / 1_000_000_000).unwrap_or(i32::MAX);
        Self { sec, nanosec: (ns % 1_000_000_000) as u32 }
    }
}

message! {
    /// Time and frame.
    "std_msgs/msg/Header" "std_msgs/Header" Header {
        /// Deadline of the tick, in Unix time.
        stamp: Time,
        /// Name of the frame.
        frame_id: String,
    }
}

message! {
    /// Joint values; each list has one value per name, or is empty.
    "sensor_msgs/msg/JointState" "sensor_msgs/JointState" JointState {
        /// Time.
        header: Header,
        /// Joint names.
        name: Vec<String>,
        /// [rad], of a gripper [m, or rad if it is rotary].
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
    /// A point in space.
    "geometry_msgs/msg/Point" "geometry_msgs/Point" Point {
        /// Along x [m].
        x: f64,
        /// Along y [m].
        y: f64,
        /// Along z [m].
        z: f64,
    }
}

message! {
    /// An orientation, of length 1.
    "geometry_msgs/msg/Quaternion" "geometry_msgs/Quaternion" Quaternion {
        /// First component of the axis part.
        x: f64,
        /// Second component.
        y: f64,
        /// Third component.
        z: f64,
        /// Cosine of half the angle.
        w: f64,
    }
}

message! {
    /// A position and an orientation.
    "geometry_msgs/msg/Pose" "geometry_msgs/Pose" Pose {
        /// Position.
        position: Point,
        /// Orientation.
        orientation: Quaternion,
    }
}

message! {
    /// A pose at a time.
    "geometry_msgs/msg/PoseStamped" "geometry_msgs/PoseStamped" PoseStamped {
        /// Time, and the frame of the pose.
        header: Header,
        /// Pose of a tool centre point.
        pose: Pose,
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
        /// Time.
        header: Header,
        /// Force and torque at the sensor.
        wrench: Wrench,
    }
}

message! {
    /// Mass, centre and inertia of a body.
    "geometry_msgs/msg/Inertia" "geometry_msgs/Inertia" Inertia {
        /// Mass [kg].
        m: f64,
        /// Centre of mass [m].
        com: Vector3,
        /// Inertia about the centre of mass [kg·m²].
        ixx: f64,
        /// [kg·m²].
        ixy: f64,
        /// [kg·m²].
        ixz: f64,
        /// [kg·m²].
        iyy: f64,
        /// [kg·m²].
        iyz: f64,
        /// [kg·m²].
        izz: f64,
    }
}

message! {
    /// Mass, centre and inertia of a body at a time.
    "geometry_msgs/msg/InertiaStamped" "geometry_msgs/InertiaStamped" InertiaStamped {
        /// Time.
        header: Header,
        /// The body, in the flange frame.
        inertia: Inertia,
    }
}

message! {
    /// A line of the text log.
    "rcl_interfaces/msg/Log" "rcl_interfaces/Log" Log {
        /// Time.
        stamp: Time,
        /// 10 debug, 20 info, 30 warn, 40 error, 50 fatal.
        level: u8,
        /// Name of the run.
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
        /// Time.
        header: Header,
        /// Index of the tick, counted from 0.
        tick: u64,
        /// The tick's deadline in monotonic time [ns].
        deadline_ns: u64,
        /// Wake-up after the deadline [ns].
        late_ns: u64,
        /// Wake-up to the last command passed to the device threads [ns].
        compute_ns: u64,
        /// Whole periods skipped before this tick.
        skipped: u32,
        /// Lateness that caused the skip, of this tick or of the previous one [ns].
        overrun_ns: u64,
        /// Assumed deadline of the next tick, in monotonic time [ns].
        next_ns: u64,
        /// Samples lost since the last tick in this log because the ring to the recorder was full.
        dropped: u32,
    }
}

message! {
    /// An event of a tick.
    "dimos_msgs/msg/Event" "dimos_msgs/Event" Event {
        /// Time.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// request, task, preempted, mode_conflict, arm, limited, overrun or degraded.
        kind: String,
        /// info, warn or error.
        severity: String,
        /// Id of the request it answers, as in /dimos/requests; empty if none.
        request: Vec<u64>,
        /// The arm concerned, or empty.
        arm: String,
        /// The task concerned, or empty.
        task: String,
        /// The joint concerned, or empty.
        joint: String,
        /// Status word of the outcome, task state, phase or limit.
        status: String,
        /// The event's numbers, if any.
        values: Vec<f64>,
        /// The event as a sentence.
        text: String,
        /// Who asked for it: program, process, user, or the client over the network; empty if no request did.
        by: String,
    }
}

message! {
    /// Status of an arm. On changes, and ten times a second.
    "dimos_msgs/msg/ArmStatus" "dimos_msgs/ArmStatus" ArmStatus {
        /// Time.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// unknown, disabled, activating, ready, held or standby.
        phase: String,
        /// Reason for the phase, e.g. operator_stop, arm_fault, link_lost.
        cause: String,
        /// The reason as a sentence; empty if there is none.
        cause_text: String,
        /// down, up, stale or faulted.
        link: String,
        /// The arm's control mode.
        mode: String,
        /// Whether the motors are on.
        enabled: bool,
        /// The arm's own error code, 0 for none.
        error: i32,
        /// The arm's text for that error.
        error_text: String,
        /// Age of the newest joint state [s]; NaN before the first.
        age: f64,
        /// absent, measured or estimated.
        velocity_source: String,
        /// Number of the newest state, 0 before the first.
        seq: u64,
        /// The device thread held the arm on its own.
        self_held: bool,
    }
}

message! {
    /// What a tick read of an arm, besides the values in /joint_states. On each tick in which it changed.
    "dimos_msgs/msg/ArmInput" "dimos_msgs/ArmInput" ArmInput {
        /// Time.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// Number of the state, 0 before the first. Its values in /joint_states are NaN while it is 0.
        seq: u64,
        /// Measurement time of its joint positions, in monotonic time [ns].
        stamp_ns: u64,
        /// absent, measured or estimated. Estimated velocities were computed by the tick, not read.
        velocity_source: String,
        /// Whether the arm reported efforts.
        has_effort: bool,
        /// Gripper position [m, or rad for a rotary gripper]; empty if not reported.
        gripper: Vec<f64>,
        /// The device's pose, of its flange in its base: x, y, z [m], roll, pitch, yaw [rad]; empty if not reported.
        pose: Vec<f64>,
        /// Force [N] and torque [Nm] at the sensor; empty if not reported.
        wrench: Vec<f64>,
        /// The arm's control mode.
        mode: String,
        /// Whether the motors are on.
        enabled: bool,
        /// The arm's own error code, 0 for none.
        error: i32,
        /// down, up, stale or faulted.
        link: String,
        /// The device thread held the arm on its own.
        self_held: bool,
        /// Number of the newest command that was written to the wire.
        written: u64,
        /// A change of the arm that this run did not order: mode, power, or empty.
        interference: String,
        /// Part of the state's age during which the device thread could not run [ns].
        own_delay_ns: u64,
        /// The arm's stop input is open.
        stop_input_open: bool,
        /// The device's own time of the measurement, on its own clock [ns]; empty if not reported.
        device_ns: Vec<u64>,
        /// Measured force of the gripper, in the unit in coordinator.json; empty if not reported.
        gripper_force: Vec<f64>,
        /// Positions that the arm's controller itself commands its joints [rad]; empty if not reported.
        commanded_position: Vec<f64>,
        /// Velocities that it commands [rad/s]; empty if not reported.
        commanded_velocity: Vec<f64>,
        /// Number of the newest setpoint that was refused; 0: none.
        refused: u64,
        /// Fraction of its speed at which the arm's controller runs motions, 0 to 1; empty if not reported.
        speed_fraction: Vec<f64>,
        /// Levels of the digital inputs, bit i is input i; empty if they were not read with the state.
        inputs: Vec<u32>,
        /// Where its efforts come from: measured, from_current, or empty if it does not say.
        effort_kind: String,
        /// Joints whose motors do not answer, counted from 0: their values are the last known ones.
        missing: Vec<u8>,
    }
}

message! {
    /// Levels of an arm's digital and analogue inputs and outputs, in the order of their numbers. On changes.
    "dimos_msgs/msg/ArmIo" "dimos_msgs/ArmIo" ArmIo {
        /// When they were read.
        header: Header,
        /// Digital inputs di0, di1, …: 0 low, 1 high.
        digital_inputs: Vec<u8>,
        /// Digital outputs do0, do1, …: 0 low, 1 high.
        digital_outputs: Vec<u8>,
        /// Analogue inputs ai0, ai1, …, in their units.
        analog_inputs: Vec<f64>,
        /// Analogue outputs ao0, ao1, …, in their units.
        analog_outputs: Vec<f64>,
        /// Units of the analogue inputs: V or A.
        analog_input_units: Vec<String>,
        /// Units of the analogue outputs: V or A.
        analog_output_units: Vec<String>,
    }
}

message! {
    /// Condition of an arm's joints. About twice a second, where the device reports any.
    "dimos_msgs/msg/JointStatus" "dimos_msgs/JointStatus" JointStatus {
        /// When it was read.
        header: Header,
        /// Joint names. Each list below has one value per name, NaN if it is unknown, or is empty.
        name: Vec<String>,
        /// Temperature of the motor or its driver [°C].
        temperature: Vec<f64>,
        /// Motor current [A].
        current: Vec<f64>,
        /// Supply voltage [V].
        voltage: Vec<f64>,
        /// Load as a fraction of the rated torque, signed.
        load: Vec<f64>,
        /// Error codes of the drives, 0 for none; empty unless every joint reports one.
        error: Vec<i32>,
    }
}

message! {
    /// What a tick commands an arm, besides the values in /joint_commands. On each tick in which it changed.
    "dimos_msgs/msg/ArmOutput" "dimos_msgs/ArmOutput" ArmOutput {
        /// Time.
        header: Header,
        /// Index of the tick.
        tick: u64,
        /// Number of the command, 0 before the first.
        seq: u64,
        /// The control mode of the command; empty if the arm is not commanded.
        mode: String,
        /// Gripper position [m, or rad for a rotary gripper]; meaningless while gripper_seq is 0.
        gripper: f64,
        /// Counts gripper commands.
        gripper_seq: u32,
        /// Number of stops ordered from the arm's controller.
        stop_seq: u32,
        /// Time of the tick's next read, in monotonic time [ns].
        next_tick_ns: u64,
        /// Number of starts of commanded motion: after enabling and after a change of mode.
        start_seq: u32,
        /// Largest force of the gripper command, in the unit in coordinator.json; empty: the device's own.
        gripper_force: Vec<f64>,
        /// Speed of the gripper command, as a fraction of the gripper's top speed; empty: the device's own.
        gripper_speed: Vec<f64>,
        /// Stiffness of the joints in impedance mode [Nm/rad or N/m]; otherwise empty.
        stiffness: Vec<f64>,
        /// Damping of the joints in impedance mode [Nm·s/rad or N·s/m]; otherwise empty.
        damping: Vec<f64>,
    }
}
