//! Data between an arm's device thread and the tick: the latest state one way, the latest command the other. Plain
//! data of fixed size, so that neither side ever allocates or waits.

mod controller_pose;
mod factory_kinematics;
mod gripper;
mod io;
mod joint_set;
mod joint_status;
mod load;
mod setpoint;
pub mod test_dh;

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::clock::Mono;
use crate::joint::{ControlMode, Joints, MAX_DOF};
use crate::named::named;

pub use controller_pose::ControllerPose;
pub use factory_kinematics::{Dh, FactoryKinematics};
pub use gripper::{ForceUnit, GripperInfo, GripperUnit};
pub use io::{AnalogUnit, IoInfo, IoState, MAX_ANALOG, MAX_DIGITAL, OutputValue, StopInput, channel};
pub use joint_set::{EffortKind, JointSet};
pub use joint_status::JointStatus;
pub use load::{Load, UPRIGHT};
pub use setpoint::{EffortLimits, Field, Impedance, Setpoint, SetpointFields};

/// Figures with which an arm's measurements and its motion are checked: the adapter's row, overridden by the blueprint.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Supervision {
    /// Largest distance of a joint at rest from its setpoint under load [rad].
    pub accuracy: f64,
    /// Time from a setpoint to the measured motion that follows it [s].
    pub lag: f64,
    /// Age limit of a state.
    pub stale_after: Duration,
    /// Largest distance of a joint from its setpoints of the last `lag` seconds [rad].
    pub tracking_tolerance: f64,
    /// Whether a pose with every joint at exactly zero is accepted without the device's confirmation.
    pub accept_zero_pose: bool,
    /// Largest distance of a joint below its setpoint under load, beyond `accuracy` [rad]: position control without an
    /// integral part.
    #[serde(default)]
    pub droop: f64,
    /// Furthest that the setpoint of a held joint is taken back towards the joint [rad]; 0: the arm's own stop takes
    /// the pressure off a blocked joint.
    #[serde(default)]
    pub relief: f64,
    /// How far outside its range a joint may rest and still be enabled [rad].
    #[serde(default)]
    pub outside: f64,
    /// Longest time without a setpoint that the arm's controller bridges; two periods of setpoints at least.
    #[serde(default)]
    pub gap_tolerance: Duration,
    /// What the controller does beyond it.
    #[serde(default)]
    pub after_gap: AfterGap,
    /// How the reading of each joint counts turns.
    #[serde(default)]
    pub topology: [Topology; MAX_DOF],
}

/// What an arm's controller makes of a gap in its setpoints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Bridging {
    /// Longest time without a setpoint that it bridges.
    pub tolerance: Duration,
    /// What it does beyond it.
    pub after: AfterGap,
}

named! {
    /// What an arm's controller does when no setpoint came for longer than it bridges.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum AfterGap {
        /// The joints go to the last setpoint, and rest there under torque.
        #[default]
        RestsAtSetpoint = "rests_at_setpoint",
        /// The controller decelerates along the motion, and waits where that ends.
        Decelerates = "decelerates",
        /// The controller reports an error, and ends the motion.
        Faults = "faults",
    }
}

named! {
    /// How the reading of a joint counts turns.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum Topology {
        /// The reading is the angle from zero: one that is off by whole turns is a lost turn count.
        #[default]
        MultiTurn = "multi_turn",
        /// The encoder counts one turn, with a seam at which the reading jumps by a whole turn.
        Seamed = "seamed",
        /// The joint turns without end.
        Endless = "endless",
    }
}

/// Where a stop is to bring the arm to rest. Made from setpoints; after silence, which of them reached the arm is
/// measured, within them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct StopPoint {
    /// Joint positions [rad]: the last setpoint of an arm at rest, the end of the braking of one in motion. `None`:
    /// nothing was commanded since the motors came on, so the arm rests where its controller has it.
    pub position: Option<Joints>,
}

/// What an arm's controller itself commands its joints.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Commanded {
    /// Positions [rad].
    pub position: Joints,
    /// Velocities [rad/s].
    pub velocity: Joints,
}

impl Supervision {
    /// Default of `tracking_tolerance` [rad].
    pub const TRACKING_TOLERANCE: f64 = 0.15;

    /// Returns the largest distance of the first setpoint after enabling from the measured position [rad].
    pub fn seed_tolerance(&self) -> f64 {
        self.accuracy.max(0.005)
    }
}

impl Default for Supervision {
    fn default() -> Self {
        Self {
            accuracy: 0.005,
            lag: 0.05,
            stale_after: Duration::from_millis(50),
            tracking_tolerance: Self::TRACKING_TOLERANCE,
            accept_zero_pose: false,
            droop: 0.0,
            relief: 0.0,
            outside: 0.02,
            gap_tolerance: Duration::ZERO,
            after_gap: AfterGap::default(),
            topology: [Topology::default(); MAX_DOF],
        }
    }
}

named! {
    /// A change of the arm's condition that this run did not order: made at its panel, by hand guiding, or by another
    /// program.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum Interference {
        /// None was seen.
        #[default]
        None = "",
        /// The arm is in another mode than the one that was ordered.
        Mode = "mode",
        /// The motors were enabled.
        Power = "power",
        /// The arm was stopped, paused or reset.
        Stop = "stop",
        /// Another arm than the one of the run answers.
        Identity = "identity",
        /// The controller's limits have become narrower than those of the run.
        Limits = "limits",
        /// A gripper with its own connection is lost, with what it holds.
        Tool = "tool",
    }
}

named! {
    /// Where a velocity came from.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum VelocitySource {
        /// Not known at all (yet).
        #[default]
        Absent = "absent",
        /// The arm measured it.
        Measured = "measured",
        /// Filtered finite differences of its positions.
        Estimated = "estimated",
    }
}

named! {
    /// How the device thread's connection to the arm is doing.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum Link {
        /// Not connected.
        #[default]
        Down = "down",
        /// Connected; states arrive.
        Up = "up",
        /// Connected, but three reads in a row failed or the last one is too old.
        Stale = "stale",
        /// The arm reports an error, or its connection broke.
        Faulted = "faulted",
    }
}

/// Position and orientation of a frame in another one.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Pose {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad]: fixed axes, R = Rz(yaw)·Ry(pitch)·Rx(roll).
    pub rpy: [f64; 3],
}

/// Latest known state of an arm. Device thread → tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ArmState {
    /// Counts the states published by the device thread; 0 = none yet.
    pub seq: u64,
    /// When the joint positions were measured (or, where the arm gives no time, received).
    pub stamp: Mono,
    /// Number of joints.
    pub dof: usize,
    /// Joint positions [rad].
    pub position: Joints,
    /// Joint velocities [rad/s]; meaningless when `velocity_source` is `Absent`.
    pub velocity: Joints,
    /// Whether and how the velocities are known.
    pub velocity_source: VelocitySource,
    /// Joint efforts [Nm or N], where the arm reports them.
    pub effort: Option<Joints>,
    /// Where they come from.
    #[serde(default)]
    pub effort_kind: EffortKind,
    /// Joints that this state lacks: their motors do not answer. Their positions are the last known ones.
    #[serde(default)]
    pub missing: JointSet,
    /// Gripper position [m, or rad for a rotary gripper], where there is a gripper.
    pub gripper: Option<f64>,
    /// Measured force of the gripper, in its force unit, where it measures one.
    pub gripper_force: Option<f64>,
    /// Pose of the arm's end by its controller, where it states one.
    pub pose: Option<ControllerPose>,
    /// Force and torque at the sensor [N, N, N, Nm, Nm, Nm], where there is one, less what was tared.
    pub wrench: Option<[f64; 6]>,
    /// The mode the arm is in.
    pub mode: ControlMode,
    /// Whether the motors are enabled.
    pub enabled: bool,
    /// The arm's own error code; 0 = none. Its text is in the device status.
    pub error: i32,
    /// State of the connection.
    pub link: Link,
    /// The device thread saw no heartbeat of the tick and held the arm on its own.
    pub self_held: bool,
    /// `ArmCommand::seq` of the newest command that was written to the wire.
    pub written: u64,
    /// Change of the arm's condition that this run did not order; cleared with the errors.
    pub interference: Interference,
    /// Part of this state's age during which this host's device thread could not run [ns].
    pub own_delay_ns: u64,
    /// The arm's stop input is open; false if the blueprint names none.
    pub stop_input_open: bool,
    /// The device's own time of the measurement, on its own clock [ns], where it reports one.
    pub device_ns: Option<u64>,
    /// Fraction of its speed at which the arm's controller runs motions at present (a slider, a safety function), 0 to
    /// 1, where it reports that. All times of its motion are longer by it: the path stays the same.
    #[serde(default)]
    pub speed_fraction: Option<f64>,
    /// What the arm's controller itself commands, where it reports that.
    #[serde(default)]
    pub commanded: Option<Commanded>,
    /// `ArmCommand::seq` of the newest setpoint that the adapter, or the last check before it, refused; 0 = none.
    #[serde(default)]
    pub refused: u64,
    /// Levels of the digital inputs, bit i is input i; `None`: they are not read with every state.
    #[serde(default)]
    pub inputs: Option<u32>,
}

impl Default for ArmState {
    fn default() -> Self {
        Self {
            seq: 0,
            stamp: Mono::ZERO,
            dof: 0,
            position: [0.0; MAX_DOF],
            velocity: [0.0; MAX_DOF],
            velocity_source: VelocitySource::Absent,
            effort: None,
            effort_kind: EffortKind::Unstated,
            missing: JointSet::NONE,
            gripper: None,
            gripper_force: None,
            pose: None,
            wrench: None,
            mode: ControlMode::Position,
            enabled: false,
            error: 0,
            link: Link::Down,
            self_held: false,
            written: 0,
            interference: Interference::None,
            own_delay_ns: 0,
            stop_input_open: false,
            device_ns: None,
            speed_fraction: None,
            commanded: None,
            refused: 0,
            inputs: None,
        }
    }
}

/// Command of the tick to an arm. Tick → device thread.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ArmCommand {
    /// Counts the commands of this arm; 0 = none yet.
    pub seq: u64,
    /// Control mode of `values`; `None`: the arm is not commanded (disabled, in an unknown state, or released).
    pub mode: Option<ControlMode>,
    /// Joint positions [rad] or velocities [rad/s], by `mode`.
    pub values: Joints,
    /// Gripper position [m, or rad for a rotary gripper]; written when `gripper_seq` changes.
    pub gripper: f64,
    /// Largest force of the gripper, in its force unit; `None`: the one set in the device.
    pub gripper_force: Option<f64>,
    /// Fraction of the gripper's top speed (0–1]; `None`: the speed set in the device.
    pub gripper_speed: Option<f64>,
    /// Counts the gripper commands; 0 = none yet.
    pub gripper_seq: u32,
    /// Counts the stops ordered from the arm's controller, e.g. when a latched hold is entered.
    pub stop_seq: u32,
    /// When the tick will read states next: the device thread reads shortly before.
    pub next_tick: Mono,
    /// The tick's time of this command.
    pub at: Mono,
    /// Counts the starts of commanded motion: after enabling and after a change of mode. The first setpoint of each is
    /// compared with the measured pose before it is written.
    pub start_seq: u32,
    /// The arm is led: a hand or its own controller may move it, and it gets no setpoints.
    pub led: bool,
    /// Counts the times that the arm began to be led: an order to begin belongs to one of them.
    pub lead_seq: u32,
    /// Velocities of position setpoints [rad/s].
    #[serde(default)]
    pub velocity: Joints,
    /// Accelerations of position setpoints [rad/s²].
    #[serde(default)]
    pub acceleration: Joints,
    /// Efforts beside the arm's own control [Nm or N]; `None`: not commanded.
    #[serde(default)]
    pub effort: Option<Joints>,
    /// Stiffness [Nm/rad or N/m] and damping [Nm·s/rad or N·s/m] in impedance mode; `None`: not commanded.
    #[serde(default)]
    pub gains: Option<[Joints; 2]>,
    /// Where the arm is at rest after braking from this command within its limits [rad]; `None`: nothing was commanded
    /// since the motors came on.
    #[serde(default)]
    pub rest: Option<Joints>,
    /// Lowest and highest setpoint that the arm may have followed since it was last heard [rad], after silence: which
    /// of them reached it is unknown. A stop is then where the arm is within that, if it is read near it.
    #[serde(default)]
    pub unheard: Option<[Joints; 2]>,
}

impl ArmCommand {
    /// Returns the stop point of an arm that is heard again at `position` [rad]: within what it may have followed. A
    /// reading that is farther from that than an arm is from its setpoints is no place to stop at, and gives `None`.
    pub fn rest_within_unheard(&self, position: &Joints, dof: usize, supervision: &Supervision) -> Option<Joints> {
        let [low, high] = self.unheard?;
        let most = supervision.tracking_tolerance + supervision.droop;
        let mut rest = *position;
        for (joint, (q, (low, high))) in rest.iter_mut().zip(low.iter().zip(&high)).enumerate() {
            if joint < dof && !(low - most..=high + most).contains(q) {
                return None;
            }
            // `max` and `min` also replace a value that is not a number.
            *q = q.max(*low).min(*high);
        }
        Some(rest)
    }
}

impl Default for ArmCommand {
    fn default() -> Self {
        Self {
            seq: 0,
            mode: None,
            values: [0.0; MAX_DOF],
            gripper: 0.0,
            gripper_force: None,
            gripper_speed: None,
            gripper_seq: 0,
            stop_seq: 0,
            next_tick: Mono::ZERO,
            at: Mono::ZERO,
            start_seq: 0,
            led: false,
            lead_seq: 0,
            velocity: [0.0; MAX_DOF],
            acceleration: [0.0; MAX_DOF],
            effort: None,
            gains: None,
            rest: None,
            unheard: None,
        }
    }
}
