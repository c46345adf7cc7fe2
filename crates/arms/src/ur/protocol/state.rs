//! The state that a controller sends: which values it is asked for, and what they are here.

use super::Reader;
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// The state of an arm, as the controller measured it at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct State {
    /// Time since the controller was started [s].
    pub time: f64,
    /// Joint positions [rad].
    pub position: [f64; 6],
    /// Joint velocities [rad/s].
    pub velocity: [f64; 6],
    /// Joint positions that the controller commands [rad].
    pub target: [f64; 6],
    /// Joint velocities that it commands [rad/s].
    pub target_velocity: [f64; 6],
    /// Motor currents [A].
    pub current: [f64; 6],
    /// Motor voltages [V].
    pub voltage: [f64; 6],
    /// Temperatures of the joints [°C].
    pub temperature: [f64; 6],
    /// Mode codes of the joints.
    pub joint_mode: [i32; 6],
    /// Pose of the active TCP in the base frame: position [m] and rotation vector [rad].
    pub tcp: [f64; 6],
    /// Force and torque at the TCP in the base frame [N, Nm].
    pub wrench: [f64; 6],
    /// The pendant's speed slider, 0 to 1.
    pub slider: f64,
    /// How much the controller slows motion at present, 0 to 1.
    pub scaling: f64,
    /// Payload [kg].
    pub payload: f64,
    /// Its centre of gravity in the flange's frame [m].
    pub payload_cog: [f64; 3],
    /// Its inertia: xx, yy, zz, xy, xz, yz [kg·m²].
    pub payload_inertia: [f64; 6],
    /// Pose of the TCP in the flange's frame: position [m] and rotation vector [rad].
    pub tcp_offset: [f64; 6],
    /// Digital inputs: bits 0 to 7 standard, 8 to 15 configurable, 16 and 17 tool.
    pub digital_in: u64,
    /// Digital outputs, in the same order.
    pub digital_out: u64,
    /// Whether analog inputs 0, 1 (bits 0, 1) and outputs 0, 1 (bits 2, 3) are voltages rather than currents.
    pub analog_kinds: u32,
    /// Analog inputs of the controller [A or V].
    pub analog_in: [f64; 2],
    /// Analog outputs of the controller [A or V].
    pub analog_out: [f64; 2],
    /// Analog inputs of the tool [A or V], and whether they are voltages (bits 0, 1).
    pub tool_analog_in: [f64; 2],
    /// See `tool_analog_in`.
    pub tool_analog_kinds: u32,
    /// Voltage of the tool's supply: 0, 12 or 24 [V].
    pub tool_voltage: i32,
    /// Current of the tool's supply [A].
    pub tool_current: f64,
    /// Temperature of the tool [°C].
    pub tool_temperature: f64,
    /// Count of the last order that our program has taken.
    pub count: i32,
    /// State of our program.
    pub program: i32,
    /// Number of our program.
    pub number: i32,
    /// Robot mode.
    pub robot_mode: i32,
    /// Safety mode.
    pub safety_mode: i32,
    /// Robot status bits.
    pub status: u32,
    /// Safety status bits.
    pub safety: u32,
    /// State of the program's run time.
    pub runtime: u32,
}

/// Type of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Double,
    Vector3,
    Vector6,
    Int,
    Ints,
    Unsigned,
    Long,
}

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Double => "DOUBLE",
            Self::Vector3 => "VECTOR3D",
            Self::Vector6 => "VECTOR6D",
            Self::Int => "INT32",
            Self::Ints => "VECTOR6INT32",
            Self::Unsigned => "UINT32",
            Self::Long => "UINT64",
        }
    }

    fn length(self) -> usize {
        match self {
            Self::Double | Self::Long => 8,
            Self::Vector3 | Self::Ints => 24,
            Self::Vector6 => 48,
            Self::Int | Self::Unsigned => 4,
        }
    }
}

/// A value that the controller is asked for.
struct Field {
    name: &'static str,
    kind: Kind,
    /// Whether the adapter works without it: older software lacks some.
    optional: bool,
    set: fn(&mut State, &mut Reader<'_>),
}

const fn needed(name: &'static str, kind: Kind, set: fn(&mut State, &mut Reader<'_>)) -> Field {
    Field { name, kind, optional: false, set }
}

const fn optional(name: &'static str, kind: Kind, set: fn(&mut State, &mut Reader<'_>)) -> Field {
    Field { name, kind, optional: true, set }
}

/// The values. Those that can be checked come last: a packet whose end is missing is recognized by them.
const FIELDS: &[Field] = &[
    needed("timestamp", Kind::Double, |s, r| s.time = r.f64()),
    needed("actual_q", Kind::Vector6, |s, r| s.position = r.vector()),
    needed("actual_qd", Kind::Vector6, |s, r| s.velocity = r.vector()),
    needed("target_q", Kind::Vector6, |s, r| s.target = r.vector()),
    needed("target_qd", Kind::Vector6, |s, r| s.target_velocity = r.vector()),
    needed("actual_current", Kind::Vector6, |s, r| s.current = r.vector()),
    optional("actual_joint_voltage", Kind::Vector6, |s, r| s.voltage = r.vector()),
    needed("joint_temperatures", Kind::Vector6, |s, r| s.temperature = r.vector()),
    needed("joint_mode", Kind::Ints, |s, r| s.joint_mode = r.integers()),
    needed("actual_TCP_pose", Kind::Vector6, |s, r| s.tcp = r.vector()),
    needed("actual_TCP_force", Kind::Vector6, |s, r| s.wrench = r.vector()),
    needed("target_speed_fraction", Kind::Double, |s, r| s.slider = r.f64()),
    needed("speed_scaling", Kind::Double, |s, r| s.scaling = r.f64()),
    optional("payload", Kind::Double, |s, r| s.payload = r.f64()),
    optional("payload_cog", Kind::Vector3, |s, r| s.payload_cog = r.vector()),
    optional("payload_inertia", Kind::Vector6, |s, r| s.payload_inertia = r.vector()),
    optional("tcp_offset", Kind::Vector6, |s, r| s.tcp_offset = r.vector()),
    needed("actual_digital_input_bits", Kind::Long, |s, r| s.digital_in = r.u64()),
    needed("actual_digital_output_bits", Kind::Long, |s, r| s.digital_out = r.u64()),
    needed("analog_io_types", Kind::Unsigned, |s, r| s.analog_kinds = r.u32()),
    needed("standard_analog_input0", Kind::Double, |s, r| s.analog_in[0] = r.f64()),
    needed("standard_analog_input1", Kind::Double, |s, r| s.analog_in[1] = r.f64()),
    needed("standard_analog_output0", Kind::Double, |s, r| s.analog_out[0] = r.f64()),
    needed("standard_analog_output1", Kind::Double, |s, r| s.analog_out[1] = r.f64()),
    optional("tool_analog_input_types", Kind::Unsigned, |s, r| s.tool_analog_kinds = r.u32()),
    optional("tool_analog_input0", Kind::Double, |s, r| s.tool_analog_in[0] = r.f64()),
    optional("tool_analog_input1", Kind::Double, |s, r| s.tool_analog_in[1] = r.f64()),
    optional("tool_output_voltage", Kind::Int, |s, r| s.tool_voltage = r.i32()),
    optional("tool_output_current", Kind::Double, |s, r| s.tool_current = r.f64()),
    optional("tool_temperature", Kind::Double, |s, r| s.tool_temperature = r.f64()),
    needed("output_int_register_24", Kind::Int, |s, r| s.count = r.i32()),
    needed("output_int_register_25", Kind::Int, |s, r| s.program = r.i32()),
    needed("output_int_register_26", Kind::Int, |s, r| s.number = r.i32()),
    needed("robot_mode", Kind::Int, |s, r| s.robot_mode = r.i32()),
    needed("safety_mode", Kind::Int, |s, r| s.safety_mode = r.i32()),
    needed("robot_status_bits", Kind::Unsigned, |s, r| s.status = r.u32()),
    needed("safety_status_bits", Kind::Unsigned, |s, r| s.safety = r.u32()),
    needed("runtime_state", Kind::Unsigned, |s, r| s.runtime = r.u32()),
];

/// Largest joint position that can be true [rad]: two turns and some more; of wrist 3, which may be endless, any that
/// a program still takes.
const FARTHEST: [f64; 6] = [15.0, 15.0, 15.0, 15.0, 15.0, 1e4];
/// Largest joint velocity that can be true [rad/s].
const FASTEST: f64 = 150.0;

/// Which values a controller sends, and in which packets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Recipe {
    /// Which of the fields are in it, one bit for each.
    chosen: u64,
    /// Its number on this connection.
    pub id: u8,
}

impl Default for Recipe {
    fn default() -> Self {
        Self { chosen: (1 << FIELDS.len()) - 1, id: 0 }
    }
}

impl Recipe {
    fn fields(self) -> impl Iterator<Item = (usize, &'static Field)> {
        FIELDS.iter().enumerate().filter(move |(i, _)| self.chosen >> i & 1 == 1)
    }

    /// Returns the names, joined by commas.
    pub fn names(self) -> String {
        self.fields().map(|(_, field)| field.name).collect::<Vec<_>>().join(",")
    }

    /// Returns whether the controller sends a value.
    pub fn has(self, name: &str) -> bool {
        self.fields().any(|(_, field)| field.name == name)
    }

    /// Returns the length of a packet with these values.
    pub fn length(self) -> usize {
        super::rtde::HEADER + 1 + self.fields().map(|(_, field)| field.kind.length()).sum::<usize>()
    }

    /// Processes the reply to a request for these values: `Ok(None)` when it is complete, and the recipe without the
    /// values that the controller does not know. An error names the ones that the adapter needs.
    pub fn agreed(&mut self, id: u8, types: &str) -> AdapterResult<Option<Self>> {
        let mut rest = *self;
        let mut count = 0;
        for ((i, field), found) in self.fields().zip(types.split(',')) {
            count += 1;
            match found {
                found if found == field.kind.name() => {}
                "NOT_FOUND" if field.optional => rest.chosen &= !(1 << i),
                found => {
                    return Err(AdapterError::Protocol(format!(
                        "the controller's software has no usable RTDE value {} ({found}): it is too old",
                        field.name
                    )));
                }
            }
        }
        if count != self.fields().count() {
            return Err(AdapterError::Protocol(format!(
                "the controller answers {count} types of RTDE values: {types}"
            )));
        }
        self.id = id;
        Ok((rest.chosen != self.chosen).then_some(rest))
    }

    /// Decodes the values of a packet; `None` for values that no controller sends. Never allocates.
    pub fn decode(self, content: &[u8]) -> Option<State> {
        let (mut state, mut reader) = (State::default(), Reader::new(content));
        for (_, field) in self.fields() {
            (field.set)(&mut state, &mut reader);
        }
        (reader.ok && state.is_possible()).then_some(state)
    }
}

impl State {
    fn is_possible(&self) -> bool {
        let near = |joints: &[f64; 6]| joints.iter().zip(FARTHEST).all(|(q, farthest)| q.abs() < farthest);
        let slow = |joints: &[f64; 6]| joints.iter().all(|v| v.abs() < FASTEST);
        near(&self.position)
            && near(&self.target)
            && slow(&self.velocity)
            && slow(&self.target_velocity)
            && (0.0..1e12).contains(&self.time)
            && self.slider.is_finite()
            && self.scaling.is_finite()
            && (-1..=20).contains(&self.robot_mode)
            && (0..=40).contains(&self.safety_mode)
            && self.status < 1 << 8
            && self.runtime < 1 << 4
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn older_software_lacks_some_values() {
        let mut recipe = Recipe::default();
        assert!(recipe.names().starts_with("timestamp,actual_q,") && recipe.names().len() < 2048);
        let types = |recipe: Recipe, missing: &str| {
            let kind =
                |(_, field): (usize, &Field)| if field.name == missing { "NOT_FOUND" } else { field.kind.name() };
            recipe.fields().map(kind).collect::<Vec<_>>().join(",")
        };
        let all = recipe.length();
        let mut fewer = recipe.agreed(1, &types(recipe, "tcp_offset")).unwrap().expect("one is missing");
        assert!(!fewer.names().contains("tcp_offset"));
        assert_eq!(fewer.length(), all - 48);
        assert_eq!(fewer.agreed(3, &types(fewer, "")), Ok(None));
        assert_eq!(fewer.id, 3);
        let error = recipe.agreed(1, &types(recipe, "actual_q")).unwrap_err().to_string();
        assert!(error.contains("actual_q (NOT_FOUND)"), "{error}");
        assert!(recipe.agreed(1, "DOUBLE").is_err());
    }

    #[test]
    fn values_that_no_controller_sends_are_refused() {
        let recipe = Recipe::default();
        let mut bytes = vec![0; recipe.length() - 4];
        bytes[..8].copy_from_slice(&41.5_f64.to_be_bytes());
        bytes[8..16].copy_from_slice(&(-1.25_f64).to_be_bytes());
        let state = recipe.decode(&bytes).unwrap();
        assert_eq!((state.time, state.position[0]), (41.5, -1.25));
        assert_eq!(recipe.decode(&bytes[1..]), None, "too short");
        for (at, byte) in [(8, 0x40 ^ 0xBF), (bytes.len() - 20, 0x40), (bytes.len() - 4, 0x40), (0, 0xC0)] {
            let mut wrong = bytes.clone();
            wrong[at] ^= byte;
            assert_eq!(recipe.decode(&wrong), None, "byte {at}");
        }
        // Each scales motions or times somewhere.
        let good = bytes.clone();
        for name in ["actual_q", "speed_scaling", "target_speed_fraction"] {
            let before = recipe.fields().take_while(|(_, field)| field.name != name);
            let at: usize = before.map(|(_, field)| field.kind.length()).sum();
            bytes.clone_from(&good);
            bytes[at..at + 8].copy_from_slice(&f64::NAN.to_be_bytes());
            assert_eq!(recipe.decode(&bytes), None, "{name} at {at}");
        }
    }
}
