//! Parameters and replies of the methods for arms: stop, reset, enable, disable, leases, gripper.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::motion::{default_speed, valid_speed};
use crate::api::planner::PoseSpec;
use crate::api::{Method, finite};
use dimos_core::arm::GripperUnit;

/// Parameters of `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Stop {
    /// The arm to stop; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Reply to `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StopReply {
    /// Confirmation per arm.
    pub arms: BTreeMap<String, Confirmation>,
}

/// Whether an arm has received a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Confirmation {
    /// The device confirmed the stop.
    Confirmed,
    /// It was sent, but the device did not confirm it in time, or cannot.
    SentNotConfirmed,
    /// The device could not be reached.
    NotSent,
}

impl Confirmation {
    /// Returns the text for tables and messages.
    pub fn text(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::SentNotConfirmed => "sent, not confirmed",
            Self::NotSent => "not sent: the arm cannot be reached",
        }
    }
}

/// Parameters of `arm_reset`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmReset {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_enable`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmEnable {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Whether the arm may rest outside its position limits: it is held there, to be led or moved inward.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub outside: bool,
}

impl ArmEnable {
    /// Creates a request for an arm inside its limits.
    pub fn new(arm: impl Into<String>) -> Self {
        Self { arm: arm.into(), outside: false }
    }
}

/// Parameters of `arm_teach`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmTeach {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Somebody holds the arm: required for one that is led with its motors off.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub support_the_arm: bool,
}

/// Parameters of `arm_take_over`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmTakeOver {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `move_native`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MoveNative {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Pose of the tool centre point in `map`; in a run without a model of the arm, and with `controller_frame`, the
    /// pose that the controller itself reports. Without an orientation it keeps the present one.
    pub pose: PoseSpec,
    /// The pose is the controller's own, in its own base frame.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub controller_frame: bool,
    /// Fraction of the controller's top speed, 0.01–1; the speed override scales it when the motion begins.
    #[serde(default = "default_speed")]
    pub speed: f64,
    /// Required if the run has a planner: the motion is not collision-checked.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub direct: bool,
}

impl MoveNative {
    pub(crate) fn valid(&self) -> Result<(), String> {
        self.pose.valid("pose")?;
        valid_speed(self.speed)
    }
}

/// Reply to `move_native`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NativeReply {
    /// The motion's number, for `motion`.
    pub motion: u64,
    /// Fraction of the top speed that the controller was given.
    pub speed: f64,
    /// Distance of the pose that the controller reports from the tool centre point [m], by which the goal was
    /// converted: right if that is its tool, wrong by a difference of the base frames. Absent if nothing was converted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<f64>,
}

/// Parameters of `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmDisable {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Disables the motors at once, even while the arm moves; default: the arm decelerates to rest first.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub now: bool,
}

/// Reply to `arm_reset`, `arm_enable`, `arm_teach`, `arm_take_over` and `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ArmReply {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Its phase now.
    pub phase: String,
    /// Further information for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Parameters of `lease`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Lease {
    /// The arm; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Parameters of `release`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Release {
    /// The arm; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Reply to `lease` and `release`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct LeaseReply {
    /// The arms that this connection now holds, or has released.
    pub arms: Vec<String>,
}

impl Method for Lease {
    const NAME: &'static str = "lease";
    type Reply = LeaseReply;
}

impl Method for Release {
    const NAME: &'static str = "release";
    type Reply = LeaseReply;
}

/// Parameters of `gripper`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gripper {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Position: the opening [m], or the angle [rad] of a rotary gripper (`gripper_unit` in `status`).
    pub position: f64,
    /// Largest force [`gripper_force_unit` in `status`]; default: the one set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Fraction of the gripper's top speed, 0.01–1; default: the speed set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// Time for the outcome that `grip` reports [s], at most 600; default: 20.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub timeout: Option<f64>,
}

/// Reply to `gripper`: what was commanded.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GripperReply {
    /// Position [`unit`].
    pub position: f64,
    /// Unit of the position: `m` of opening, or `rad` of a rotary jaw.
    pub unit: String,
    /// Largest force [`force_unit`]; absent: the one set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Unit of the force: `N`, `Nm` or `%`; absent without a force.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force_unit: Option<String>,
    /// Fraction of the gripper's top speed; absent: the speed set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed: Option<f64>,
    /// The command's number, for `grip`.
    #[serde(default)]
    pub order: u32,
}

impl Gripper {
    pub(crate) fn valid(&self) -> Result<(), String> {
        finite("position", &[self.position])?;
        finite("force", self.force.as_slice())?;
        self.speed.map_or(Ok(()), valid_speed)?;
        match self.timeout.filter(|timeout| !(*timeout > 0.0 && *timeout <= 600.0)) {
            Some(timeout) => Err(format!("timeout is {timeout} s, must be above 0, at most 600")),
            None => Ok(()),
        }
    }
}

/// Parameters of `gripper_home`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GripperHome {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Reply to `gripper_home`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GripperHomeReply {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// The gripper's condition now: `homing`. `peripherals` in `status` shows the end.
    pub condition: String,
}

/// Parameters of `grip`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Grip {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Number of the command, from the reply to `gripper`; default: the latest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub order: Option<u32>,
}

/// How a gripper command ended, judged from what was measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GripOutcome {
    /// At the commanded position, which is fully open.
    Open,
    /// At the commanded position, which is closed: nothing is between the fingers.
    Closed,
    /// At the commanded position.
    Reached,
    /// Stopped while closing, and holds an object.
    Holding,
    /// Stopped before the commanded position, without an object in its grip.
    Blocked,
    /// The device confirms the order. Nothing measures the fingers, nor whether they hold something.
    Ordered,
}

/// Returns a gripper's position in its unit as text.
pub fn gripper_text(position: f64, unit: &str) -> String {
    match unit == GripperUnit::OnOff.name() {
        true if position == 0.0 => "closed (as ordered)".to_owned(),
        true => "open (as ordered)".to_owned(),
        false => format!("{position:.4} {unit}"),
    }
}

impl GripReport {
    /// Returns the outcome with its figures as text.
    pub fn text(&self) -> String {
        let on_off = self.unit == GripperUnit::OnOff.name();
        let outcome = match self.outcome {
            Some(GripOutcome::Open) => "open at",
            Some(GripOutcome::Closed) => "closed at",
            Some(GripOutcome::Reached) => "reached",
            Some(GripOutcome::Holding) => "holding an object at",
            Some(GripOutcome::Blocked) => "blocked at",
            Some(GripOutcome::Ordered) if self.target == 0.0 => "ordered to close, which nothing measures",
            Some(GripOutcome::Ordered) => "ordered to open, which nothing measures",
            None => "without an outcome at",
        };
        let force = self.force.map_or_else(String::new, |force| format!(", force {force:.2} {}", self.force_unit));
        let place = match on_off {
            true => outcome.trim_end_matches(" at").to_owned(),
            false => format!("{outcome} {:.4} {}", self.position, self.unit),
        };
        format!("gripper {place}{force}, after {:.2} s", self.elapsed)
    }
}

/// Reply to `grip`: progress or outcome of a gripper command.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GripReport {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Number of the command.
    pub order: u32,
    /// Whether it is over.
    pub done: bool,
    /// How it ended; absent before, and after an error.
    pub outcome: Option<GripOutcome>,
    /// Commanded position [`unit`].
    pub target: f64,
    /// Measured position [`unit`].
    pub position: f64,
    /// Unit of positions: `m` of opening, or `rad` of a rotary jaw.
    pub unit: String,
    /// Measured force [`force_unit`]; absent if the gripper measures none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Unit of the force: `N`, `Nm` or `%`.
    pub force_unit: String,
    /// Time from the command to the last motion of the fingers [s]; before the end, to now.
    pub elapsed: f64,
    /// Why it has no outcome.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}
