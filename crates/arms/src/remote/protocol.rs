//! The protocol as this program speaks it: one JSON object a line, pure encoding and decoding. What comes every cycle
//! is read into fixed arrays and written into a buffer that is used again, so that a cycle allocates nothing.
//! `docs/remote-adapter.md` is the sheet. Units: rad, rad/s, Nm, m, N.

use std::fmt;
use std::io::Write as _;
use std::time::Duration;

use serde::de::{Deserializer, Error as _, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};

use dimos_core::arm::{AfterGap, Bridging, EffortKind, Field, GripperUnit, Impedance, JointSet, Pose, SetpointFields};
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF};
use dimos_hardware::adapter::AdapterError;

/// The version of the protocol, and the oldest that a peer may have: without setpoints that have more than positions.
pub const VERSION: u32 = 2;
pub const OLDEST: u32 = 1;
/// Longest line [bytes].
pub const MAX_LINE: usize = 16 * 1024;
/// Longest text that is kept of a reply [bytes].
const MAX_TEXT: usize = 240;

// --- Requests ---

/// A hello: this program's version of the protocol, and how many joints it expects.
pub fn hello(id: u32, dof: usize, out: &mut Vec<u8>) {
    line(out, &serde_json::json!({ "id": id, "do": "hello", "version": VERSION, "dof": dof }));
}

/// What is asked once, not in every cycle: a method of the adapter.
#[derive(Debug, Clone, PartialEq)]
pub enum Act {
    /// `activate`
    Activate,
    /// `deactivate`
    Deactivate,
    /// `write_enable`
    Enable(bool),
    /// `set_control_mode`
    Mode(ControlMode),
    /// `write_stop`, with the joint positions at which the arm is to rest [rad]; none if nothing was commanded since
    /// the motors came on.
    Stop(Vec<f64>),
    /// `write_clear_errors`
    ClearErrors,
    /// `write_gripper_position` [m or rad]
    Gripper(f64),
    /// `write_cartesian_position`, with a fraction of the top speed.
    Cartesian(WirePose, f64),
}

impl Act {
    /// The method.
    pub fn method(&self) -> &'static str {
        match self {
            Self::Activate => "activate",
            Self::Deactivate => "deactivate",
            Self::Enable(_) => "write_enable",
            Self::Mode(_) => "set_control_mode",
            Self::Stop(_) => "write_stop",
            Self::ClearErrors => "write_clear_errors",
            Self::Gripper(_) => "write_gripper_position",
            Self::Cartesian(..) => "write_cartesian_position",
        }
    }

    fn arguments(&self) -> serde_json::Value {
        match self {
            Self::Enable(on) => serde_json::json!([on]),
            Self::Mode(mode) => serde_json::json!([mode]),
            Self::Gripper(opening) => serde_json::json!([opening]),
            Self::Cartesian(pose, velocity) => serde_json::json!([pose, velocity]),
            Self::Stop(rest) if !rest.is_empty() => serde_json::json!([rest]),
            Self::Activate | Self::Deactivate | Self::Stop(_) | Self::ClearErrors => serde_json::json!([]),
        }
    }
}

/// An act.
pub fn act(id: u32, act: &Act, out: &mut Vec<u8>) {
    line(out, &serde_json::json!({ "id": id, "do": act.method(), "args": act.arguments() }));
}

fn line(out: &mut Vec<u8>, content: &impl Serialize) {
    out.clear();
    // Writing to memory cannot fail, and neither can content without maps that have odd keys.
    let _ = serde_json::to_writer(&mut *out, content);
    out.push(b'\n');
}

/// What a cycle commands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Command<'a> {
    /// How `values` are meant.
    pub mode: ControlMode,
    /// Positions [rad] or velocities [rad/s].
    pub values: &'a [f64],
    /// Fraction of the top speed, where the device plans its way.
    pub velocity: f64,
    /// Since version 2: what else a setpoint has, as far as the peer takes it.
    #[serde(flatten)]
    pub more: More<'a>,
}

/// What a setpoint has besides positions, one value per joint. What is absent is not commanded.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct More<'a> {
    /// Velocities [rad/s].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub velocities: Option<&'a [f64]>,
    /// Accelerations [rad/s²].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub accelerations: Option<&'a [f64]>,
    /// Efforts beside the arm's own control [Nm].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub efforts: Option<&'a [f64]>,
    /// Stiffness [Nm/rad].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stiffness: Option<&'a [f64]>,
    /// Damping [Nm·s/rad].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub damping: Option<&'a [f64]>,
    /// Time of the tick that made it [ns on this program's steady clock].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at: Option<u64>,
    /// How long it holds from then on [s].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub valid: Option<f64>,
}

impl<'a> More<'a> {
    /// Returns its lists.
    pub fn lists(&self) -> impl Iterator<Item = &'a [f64]> {
        [self.velocities, self.accelerations, self.efforts, self.stiffness, self.damping].into_iter().flatten()
    }
}

/// A cycle: asks for the state, and commands something or nothing. Allocates nothing once `out` has its size.
pub fn cycle(id: u32, command: Option<Command<'_>>, out: &mut Vec<u8>) {
    out.clear();
    let _ = write!(out, r#"{{"id":{id},"do":"cycle""#);
    if let Some(command) = command {
        out.extend_from_slice(br#","command":"#);
        let _ = serde_json::to_writer(&mut *out, &command);
    }
    out.extend_from_slice(b"}\n");
}

// --- Replies ---

/// The reply to any request.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Reply {
    /// The request's number.
    pub id: u32,
    /// Which kind of error kept it from being done.
    #[serde(default)]
    error: Option<Text>,
    /// What the error says, and its code.
    #[serde(default)]
    text: Option<Text>,
    #[serde(default)]
    code: i32,
    /// What a cycle brings.
    #[serde(default)]
    pub state: Option<Measured>,
    /// Why the command of a cycle was not taken.
    #[serde(default)]
    pub refused: Option<Text>,
}

impl Reply {
    /// Reads a line; says what is wrong with it.
    pub fn decode(line: &[u8]) -> Result<Self, String> {
        serde_json::from_slice(line).map_err(|e| e.to_string())
    }

    /// Why the request was not done, if it was not; `peer` says so.
    pub fn trouble(&self, peer: &str) -> Option<AdapterError> {
        let (error, text) = (self.error?, self.text.map(|text| text.to_string()).unwrap_or_default());
        let said = || format!("{peer}: {text}");
        Some(match error.as_str() {
            "unsupported" => AdapterError::Unsupported,
            "fault" => AdapterError::Fault { code: self.code, text },
            "io" => AdapterError::Io(said()),
            "timeout" => AdapterError::Timeout(said()),
            "protocol" => AdapterError::Protocol(said()),
            _ => AdapterError::Rejected(said()),
        })
    }

    /// Returns whether the peer has lost its arm, so that a new connection is needed.
    pub fn lost(&self) -> bool {
        self.error.is_some_and(|error| error.as_str() == "not_connected")
    }

    /// What the error says.
    pub fn text(&self) -> String {
        self.text.map(|text| text.to_string()).unwrap_or_default()
    }
}

/// The state, as a cycle's reply brings it: what the adapter's methods answered. What is absent or null it has not.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Measured {
    /// When the positions were read [ns on the peer's own steady clock].
    pub time: u64,
    /// Joint positions [rad].
    #[serde(rename = "read_joint_positions")]
    pub position: Values,
    /// Joint velocities [rad/s], where they are measured.
    #[serde(default, rename = "read_joint_velocities")]
    pub velocity: Option<Values>,
    /// Joint torques [Nm], where they are measured.
    #[serde(default, rename = "read_joint_efforts")]
    pub effort: Option<Values>,
    /// Whether the motors are on.
    #[serde(default, rename = "read_enabled")]
    pub enabled: Option<bool>,
    /// Whether the peer takes no command before the arm is enabled again.
    #[serde(default)]
    pub held: bool,
    /// The device's error and what it means.
    #[serde(default, rename = "read_error")]
    pub error: Option<(i32, Text)>,
    /// The device's own state and mode codes.
    #[serde(default, rename = "read_state")]
    pub codes: Option<Codes>,
    /// The mode that the device is in.
    #[serde(default, rename = "get_control_mode")]
    pub mode: Option<ControlMode>,
    /// Gripper position [m or rad].
    #[serde(default, rename = "read_gripper_position")]
    pub gripper: Option<f64>,
    /// End-effector pose.
    #[serde(default, rename = "read_cartesian_position")]
    pub pose: Option<WirePose>,
    /// Force [N] and torque [Nm].
    #[serde(default, rename = "read_force_torque")]
    pub wrench: Option<[f64; 6]>,
    /// Joints whose motors do not answer, counted from 0: their values do not count.
    #[serde(default)]
    pub missing: Option<Values>,
    /// The device's own time of the measurement, on its own clock [ns].
    #[serde(default)]
    pub device_time: Option<u64>,
}

/// State and mode codes, where the device has them.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[allow(missing_docs, reason = "as in RobotState")]
pub struct Codes {
    #[serde(default)]
    pub state: i32,
    #[serde(default)]
    pub mode: i32,
}

/// A pose with the guide's keys [m, rad].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[allow(missing_docs, reason = "as in Pose")]
pub struct WirePose {
    pub x: f64,
    pub y: f64,
    pub z: f64,
    pub roll: f64,
    pub pitch: f64,
    pub yaw: f64,
}

impl WirePose {
    /// From this program's words.
    pub fn of(pose: &Pose) -> Self {
        let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz, pose.rpy);
        Self { x, y, z, roll, pitch, yaw }
    }

    /// In this program's words.
    pub fn pose(self) -> Pose {
        Pose { xyz: [self.x, self.y, self.z], rpy: [self.roll, self.pitch, self.yaw] }
    }
}

impl Measured {
    /// The joints whose motors do not answer.
    pub fn lost(&self) -> JointSet {
        let numbers = self.missing.iter().flat_map(|list| list.joints.iter().take(list.length));
        JointSet::of(numbers.filter(|number| **number >= 0.0).map(|number| *number as usize))
    }

    /// Says which list has not one value per joint.
    pub fn check(&self, dof: usize) -> Result<(), String> {
        let lists = [("position", Some(self.position)), ("velocity", self.velocity), ("effort", self.effort)];
        let wrong = lists.into_iter().find_map(|(name, list)| Some((name, list?.length)).filter(|(_, n)| *n != dof));
        wrong.map_or(Ok(()), |(name, n)| Err(format!("{name} has {n} values for {dof} joints")))
    }
}

/// One value per joint, without allocation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Values {
    /// The values; those past the last joint are zero.
    pub joints: Joints,
    length: usize,
}

impl<'de> Deserialize<'de> for Values {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Numbers;
        impl<'de> Visitor<'de> for Numbers {
            type Value = Values;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "up to {MAX_DOF} numbers")
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Values, A::Error> {
                let mut values = Values { joints: [0.0; MAX_DOF], length: 0 };
                while let Some(value) = list.next_element()? {
                    let place =
                        values.joints.get_mut(values.length).ok_or_else(|| A::Error::custom("too many numbers"))?;
                    *place = value;
                    values.length += 1;
                }
                Ok(values)
            }
        }
        deserializer.deserialize_seq(Numbers)
    }
}

/// A short text without allocation; what is too long is cut.
#[derive(Clone, Copy, PartialEq)]
pub struct Text {
    bytes: [u8; MAX_TEXT],
    length: usize,
}

impl Text {
    /// The text.
    pub fn as_str(&self) -> &str {
        std::str::from_utf8(self.bytes.get(..self.length).unwrap_or_default()).unwrap_or_default()
    }
}

impl fmt::Display for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

impl fmt::Debug for Text {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}", self.as_str())
    }
}

impl<'de> Deserialize<'de> for Text {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Short;
        impl Visitor<'_> for Short {
            type Value = Text;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a text")
            }

            fn visit_str<E>(self, text: &str) -> Result<Text, E> {
                let length = (0..=text.len().min(MAX_TEXT)).rev().find(|n| text.is_char_boundary(*n)).unwrap_or(0);
                let mut bytes = [0; MAX_TEXT];
                bytes.iter_mut().zip(text.bytes().take(length)).for_each(|(to, byte)| *to = byte);
                Ok(Text { bytes, length })
            }
        }
        deserializer.deserialize_str(Short)
    }
}

/// What a peer says of its arm in reply to a hello. Unknown fields are ignored: later versions may say more.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Description {
    /// The peer's version of the protocol.
    pub version: u32,
    /// Number of joints.
    pub dof: usize,
    /// `get_info`
    pub info: Info,
    /// How often the state can be had [Hz].
    pub native_rate: f64,
    /// The modes it can be commanded in; all of this protocol where it does not say.
    #[serde(default)]
    pub modes: Option<Vec<ControlMode>>,
    /// Whether it keeps its pose when its motors are off; not where it does not say.
    #[serde(default)]
    pub holds_when_disabled: Option<bool>,
    /// Whether `write_stop` takes the positions at which the arm is to rest.
    #[serde(default)]
    pub stop_point: bool,
    /// Longest time without a command that the arm bridges, 0 to 1 [s]; nothing where it does not say.
    #[serde(default)]
    pub gap_tolerance: Option<f64>,
    /// What it does beyond that; it rests at its last setpoint where it does not say.
    #[serde(default)]
    pub after_gap: Option<AfterGap>,
    /// What it takes of setpoints besides positions, by the names of [`SetpointFields`]; nothing before version 2.
    #[serde(default)]
    pub fields: Vec<String>,
    /// How it is held in impedance mode, if it has that.
    #[serde(default)]
    pub impedance: Option<Gains>,
    /// Where its efforts come from.
    #[serde(default)]
    pub effort_kind: Option<EffortKind>,
    /// The rate at which its process was asked to deliver states [Hz], where it found that it delivers fewer.
    #[serde(default)]
    pub asked_rate: Option<f64>,
    /// `get_limits` [rad, rad/s, rad/s², rad/s³]
    pub limits: JointLimits,
    /// Position of its gripper when closed and when open [m or rad].
    #[serde(default)]
    pub gripper_range: Option<(f64, f64)>,
    /// Unit of its gripper's position; m where it does not say.
    #[serde(default)]
    pub gripper_unit: Option<GripperUnit>,
    /// The names of the reads that answer something: which optional parts there are.
    #[serde(default)]
    pub parts: Vec<String>,
}

/// Stiffness [Nm/rad] and damping [Nm·s/rad] in impedance mode, one value per joint.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Gains {
    /// With which it is held where nothing else is commanded.
    pub stiffness: Vec<f64>,
    /// The same.
    pub damping: Vec<f64>,
    /// The highest; those above where it does not say.
    #[serde(default)]
    pub stiffness_max: Vec<f64>,
    /// The same.
    #[serde(default)]
    pub damping_max: Vec<f64>,
}

/// What the arm is.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[allow(missing_docs, reason = "as in ManipulatorInfo")]
pub struct Info {
    pub vendor: String,
    pub model: String,
    #[serde(default)]
    pub firmware_version: Option<String>,
    #[serde(default)]
    pub serial_number: Option<String>,
}

impl Description {
    /// Reads the reply to a hello; says what is wrong with it. `modes` are those that can be had.
    pub fn decode(line: &[u8], modes: &[ControlMode]) -> Result<Self, String> {
        let description: Self = serde_json::from_slice(line).map_err(|e| format!("its description: {e}"))?;
        let (dof, limits) = (description.dof, &description.limits);
        if !(0.1..=10_000.0).contains(&description.native_rate) {
            return Err(format!("its description: a native_rate of {} Hz", description.native_rate));
        }
        if !(0.0..=1.0).contains(&description.gap_tolerance.unwrap_or_default()) {
            return Err("its description: gap_tolerance must be 0 to 1 s".to_owned());
        }
        let unusable = |own: &Vec<ControlMode>| own.is_empty() || own.iter().any(|mode| !modes.contains(mode));
        if description.modes.as_ref().is_some_and(unusable) {
            return Err(
                "its description: modes must be some of position, servo_position, velocity, impedance".to_owned()
            );
        }
        let gains = description.impedance.as_ref();
        let compliant = description.modes.iter().flatten().any(|mode| *mode == ControlMode::Impedance);
        if compliant && gains.is_none() {
            return Err("its description: the mode impedance needs stiffness and damping in `impedance`".to_owned());
        }
        let usable = |list: &Vec<f64>| list.iter().all(|gain| gain.is_finite() && *gain >= 0.0);
        let whole = |list: &&Vec<f64>| list.len() == dof && usable(list);
        let most = |list: &&Vec<f64>| list.is_empty() || whole(list);
        if gains.is_some_and(|g| {
            ![&g.stiffness, &g.damping].iter().all(whole) || ![&g.stiffness_max, &g.damping_max].iter().all(most)
        }) {
            return Err(format!("its description: impedance must have {dof} values each, none below 0"));
        }
        let needed = [&limits.position_lower, &limits.position_upper, &limits.velocity_max];
        let optional = [&limits.acceleration_max, &limits.jerk_max];
        if needed.iter().any(|l| l.len() != dof) || optional.iter().any(|l| !l.is_empty() && l.len() != dof) {
            return Err(format!("its description: limits must have {dof} values each"));
        }
        Ok(description)
    }

    /// What it takes of setpoints.
    pub fn setpoint_fields(&self) -> SetpointFields {
        if self.version < VERSION {
            return SetpointFields::each_as(Field::Withheld("its server process speaks version 1 of the protocol"));
        }
        let field = |name: &str| match self.fields.iter().any(|own| own == name) {
            true => Field::Taken,
            false => Field::Refused("its server process does not take it (`fields` of its hello)"),
        };
        SetpointFields {
            velocity: field("velocity"),
            acceleration: field("acceleration"),
            effort: field("effort"),
            stiffness: field("stiffness"),
            damping: field("damping"),
            at: field("at"),
            expires: field("expires"),
        }
    }

    /// How it is held in impedance mode.
    pub fn impedance(&self) -> Option<Impedance> {
        let gains = self.impedance.as_ref()?;
        let joints = |list: &[f64], otherwise: &[f64]| {
            dimos_core::joint::joints_of(if list.is_empty() { otherwise } else { list })
        };
        Some(Impedance {
            stiffness: joints(&gains.stiffness, &[]),
            damping: joints(&gains.damping, &[]),
            stiffness_max: joints(&gains.stiffness_max, &gains.stiffness),
            damping_max: joints(&gains.damping_max, &gains.damping),
        })
    }

    /// What it says of gaps in its commands.
    pub fn bridging(&self) -> Option<Bridging> {
        if self.gap_tolerance.is_none() && self.after_gap.is_none() {
            return None;
        }
        let tolerance = Duration::from_secs_f64(self.gap_tolerance.unwrap_or_default());
        Some(Bridging { tolerance, after: self.after_gap.unwrap_or_default() })
    }
}
