//! Arms in `status`.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::TcpReport;
use crate::api::{IoReport, LoadReport};
use dimos_core::telemetry::Who;

/// One arm in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmReport {
    /// Its `hardware_id` in the blueprint.
    pub hardware_id: String,
    /// Its adapter's name.
    pub adapter: String,
    /// Address of its device.
    pub address: String,
    /// Whether it is an emulator, or an ideal arm in memory.
    pub simulated: bool,
    /// Whether only a program on the run's own computer can be at its address: an emulator, for example.
    #[serde(default)]
    pub local: bool,
    /// State of the connection: `down`, `up`, `stale`, `faulted`.
    pub link: String,
    /// Its phase: `unknown`, `disabled`, `activating`, `ready`, `held`, `standby`, `led`.
    pub phase: String,
    /// What leads it, while its phase is `led`: `hand` or `controller`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub led_by: Option<String>,
    /// How it may be led by hand (`arm_teach`): `hand_guiding`, or `motors_off`, for which it must be supported;
    /// absent: it cannot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub teach: Option<String>,
    /// Why it is held; absent if it is not.
    pub cause: Option<CauseReport>,
    /// A stop that could not be sent; it is delivered after the reconnect.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub stop_pending: bool,
    /// Whether its motors are enabled.
    pub enabled: bool,
    /// Its control mode.
    pub mode: String,
    /// Fraction of its speed at which its controller runs motions at present (a speed slider, a safety function), 0–1;
    /// absent if it reports none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_fraction: Option<f64>,
    /// State and mode codes of the device, as in its manual; absent if it has none.
    #[serde(default)]
    pub device_state: Option<DeviceState>,
    /// Error of the device; absent without one.
    pub error: Option<DeviceError>,
    /// Age of its latest state [ms]; absent before the first.
    pub state_age_ms: Option<f64>,
    /// Measured rate of new states [Hz].
    pub measured_rate_hz: Option<f64>,
    /// Nominal rate of new states [Hz].
    pub native_rate_hz: f64,
    /// Recent faults, the newest last.
    pub faults: Vec<FaultReport>,
    /// Holder of its lease; absent without one.
    #[serde(default)]
    pub commander: Option<CommanderReport>,
    /// Closed and open position of its gripper [`gripper_unit`]; absent without a gripper, or if the adapter does not
    /// report it.
    #[serde(default)]
    pub gripper_range: Option<[f64; 2]>,
    /// Unit of its gripper's position: `m` of opening, or `rad` of a rotary jaw; absent without a gripper.
    #[serde(default)]
    pub gripper_unit: Option<String>,
    /// Smallest and largest force of a gripper command [`gripper_force_unit`]; absent without force control.
    #[serde(default)]
    pub gripper_force_range: Option<[f64; 2]>,
    /// Whether commands of its gripper may have a speed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub gripper_has_speed: bool,
    /// Unit of its gripper's force: `N`, `Nm` or `%`; absent without a gripper.
    #[serde(default)]
    pub gripper_force_unit: Option<String>,
    /// Measured force of its gripper [`gripper_force_unit`]; absent if it measures none.
    #[serde(default)]
    pub gripper_force: Option<f64>,
    /// Its gripper and its force/torque sensor, where they have their own connections.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub peripherals: Vec<PeripheralReport>,
    /// Its digital and analogue inputs and outputs, as read last; absent without any.
    #[serde(default)]
    pub io: Option<IoReport>,
    /// Condition of its joints, as read last; empty if the device reports none.
    #[serde(default)]
    pub joints: Vec<JointStatusReport>,
    /// The load at the flange that its controller reports, or that was set; absent if it takes none.
    #[serde(default)]
    pub payload: Option<LoadReport>,
    /// The point whose pose `state` reports and pose goals are for; absent if the run has no model of the arm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp: Option<TcpReport>,
    /// Which arm it is: its serial number, or the offsets that its drives keep; absent if it does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub identity: Option<String>,
    /// What is known of how its model fits the arm: factory kinematics, and where model and controller have the flange.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub model_notes: Vec<String>,
    /// What the settings of its controller, such as a reduced mode, left of its limits when the run began; absent if
    /// nothing is known of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits_note: Option<String>,
    /// Lower and upper position limits of its joints [rad], in their order.
    #[serde(default)]
    pub position_limits: Vec<[f64; 2]>,
    /// Behaviour at the end of the run: `hold` or `disable`.
    pub on_exit: String,
    /// Whether it keeps its pose when its motors are disabled; otherwise it falls.
    pub holds_when_disabled: bool,
    /// Counters of the device thread: `reads`, `read_errors`, `writes`, …
    pub counters: BTreeMap<String, u64>,
}

/// A gripper or a sensor with its own connection in `status`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PeripheralReport {
    /// The part of the arm that it is: `gripper` or `force_torque`.
    pub part: String,
    /// Its adapter's name.
    pub adapter: String,
    /// Its address.
    pub address: String,
    /// Whether it is an emulator.
    pub simulated: bool,
    /// State of the connection: `up`, or `faulted` while it is lost.
    pub link: String,
    /// Whether it can be used: `ready`, `not_homed`, `homing` or `fault`; absent while it is lost.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub condition: Option<String>,
    /// Why it is lost, or what fault it reports.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trouble: Option<String>,
    /// Measured rate of new states [Hz].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured_rate_hz: Option<f64>,
    /// Nominal rate of new states [Hz].
    pub native_rate_hz: f64,
}

impl PeripheralReport {
    /// Returns the part with its words apart.
    pub fn part_text(&self) -> &'static str {
        if self.part == "force_torque" { "force/torque sensor" } else { "gripper" }
    }

    /// Returns what needs attention, and what to do. `arm`: the arm's `hardware_id`.
    pub fn attention(&self, arm: &str) -> Option<(String, String)> {
        let (part, adapter, address) = (self.part_text(), &self.adapter, &self.address);
        let home = || format!("dimos arm gripper {arm} home, which moves its fingers");
        let trouble = self.trouble.as_deref().unwrap_or("unknown");
        match self.condition.as_deref() {
            None => Some((
                format!("the {part} of {arm} ({adapter} at {address}) is lost: {trouble}"),
                format!("check its cable and supply, then: dimos arm reset {arm}"),
            )),
            Some("not_homed") => Some((format!("the {part} of {arm} is not homed"), home())),
            Some("fault") => Some((format!("the {part} of {arm} reports {trouble}"), home())),
            Some(_) => None,
        }
    }
}

/// Condition of one joint in `status`; null: the device does not report it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct JointStatusReport {
    /// Its name.
    pub name: String,
    /// Temperature of the motor or its driver [°C].
    pub temperature: Option<f64>,
    /// Motor current [A].
    pub current: Option<f64>,
    /// Supply voltage [V].
    pub voltage: Option<f64>,
    /// Load as a fraction of the rated torque, signed.
    pub load: Option<f64>,
    /// Error code of the drive; 0 = none.
    pub error: Option<i32>,
    /// Offset that the device's calibration subtracts from its encoder [rad].
    pub calibration_offset: Option<f64>,
}

/// The lease holder of an arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CommanderReport {
    /// Process id; absent if the system does not report it.
    pub pid: Option<i32>,
    /// Name of the program: `python3 policy.py`.
    pub program: String,
    /// Time since it took the lease [s].
    pub held_for: f64,
}

/// Why an arm is held.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CauseReport {
    /// For programs: `operator_stop`.
    pub name: String,
    /// For people.
    pub text: String,
    /// Who stopped it, if a client did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<Who>,
}

/// State and mode codes of a device.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceState {
    /// State code.
    pub state: i32,
    /// Mode code.
    pub mode: i32,
}

/// Error of a device.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct DeviceError {
    /// Error code of the device.
    pub code: i32,
    /// What it means.
    pub text: String,
}

/// A fault of an arm; repeated occurrences count as one.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FaultReport {
    /// Time since it began [s].
    pub since: f64,
    /// Whether it is over.
    pub over: bool,
    /// Number of occurrences.
    pub count: u64,
    /// Description.
    pub text: String,
}

impl ArmReport {
    /// Returns what is known of its model and of its limits: each with what it is about.
    pub fn notes(&self) -> impl Iterator<Item = (&'static str, &String)> {
        let about = |what: &'static str| move |note| (what, note);
        self.model_notes.iter().map(about("model")).chain(self.limits_note.iter().map(about("limits")))
    }
}

/// `led_by` of an arm that is moved by its own controller.
pub const LED_BY_CONTROLLER: &str = "controller";

/// Returns how to end the leading of an arm that is led by `led_by`.
pub fn end_of_lead(arm: &str, led_by: &str) -> String {
    match led_by {
        LED_BY_CONTROLLER => "wait for it, or end it with `dimos cancel`".to_owned(),
        _ => format!("hold it still, then: dimos arm enable {arm}"),
    }
}
