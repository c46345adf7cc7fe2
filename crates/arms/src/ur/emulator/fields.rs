//! RTDE values: their names, their types, and where they come from.

use nalgebra::Isometry3;

use super::controller::{Controller, REGISTERS};
use dimos_hardware::sim::arm::Measured;

/// A value on the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Value {
    Bool(bool),
    U8(u8),
    U32(u32),
    U64(u64),
    I32(i32),
    F64(f64),
    V3([f64; 3]),
    V6([f64; 6]),
    I6([i32; 6]),
}

impl Value {
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Bool(_) => "BOOL",
            Self::U8(_) => "UINT8",
            Self::U32(_) => "UINT32",
            Self::U64(_) => "UINT64",
            Self::I32(_) => "INT32",
            Self::F64(_) => "DOUBLE",
            Self::V3(_) => "VECTOR3D",
            Self::V6(_) => "VECTOR6D",
            Self::I6(_) => "VECTOR6INT32",
        }
    }

    pub fn write(&self, to: &mut Vec<u8>) {
        match self {
            Self::Bool(value) => to.push((*value).into()),
            Self::U8(value) => to.push(*value),
            Self::U32(value) => to.extend(value.to_be_bytes()),
            Self::U64(value) => to.extend(value.to_be_bytes()),
            Self::I32(value) => to.extend(value.to_be_bytes()),
            Self::F64(value) => to.extend(value.to_be_bytes()),
            Self::V3(values) => values.iter().for_each(|value| to.extend(value.to_be_bytes())),
            Self::V6(values) => values.iter().for_each(|value| to.extend(value.to_be_bytes())),
            Self::I6(values) => values.iter().for_each(|value| to.extend(value.to_be_bytes())),
        }
    }
}

/// A measurement, for one packet.
pub(super) struct Frame<'a> {
    pub controller: &'a Controller,
    pub measured: Measured,
    /// Position [m] and rotation vector [rad] of the tool's centre point.
    pub pose: [f64; 6],
}

impl<'a> Frame<'a> {
    /// A frame of which only the types of its values matter.
    pub fn empty(controller: &'a Controller) -> Self {
        let none = [0.0; dimos_core::joint::MAX_DOF];
        let measured = Measured { positions: none, velocities: none, efforts: none };
        Self { controller, measured, pose: [0.0; 6] }
    }
}

impl Frame<'_> {
    fn q(&self) -> [f64; 6] {
        self.measured.positions.first_chunk().copied().unwrap_or_default()
    }

    fn qd(&self) -> [f64; 6] {
        self.measured.velocities.first_chunk().copied().unwrap_or_default()
    }

    fn efforts(&self) -> [f64; 6] {
        self.measured.efforts.first_chunk().copied().unwrap_or_default()
    }

    fn status(&self) -> u32 {
        let controller = self.controller;
        let hidden = controller.paused && controller.hides_paused;
        u32::from(controller.mode >= 5) | u32::from(controller.program.is_some() && !hidden) << 1
    }

    fn safety_bits(&self) -> u32 {
        match self.controller.safety_mode() {
            1 => 1,
            2 => 1 << 1,
            3 => 1 << 2 | 1 << 10,
            4 => 1 << 3,
            5 => 1 << 4 | 1 << 10,
            6 => 1 << 5 | 1 << 7 | 1 << 10,
            7 => 1 << 6 | 1 << 7 | 1 << 10,
            8 => 1 << 8 | 1 << 10,
            9 => 1 << 9 | 1 << 10,
            _ => 1 << 10,
        }
    }

    fn runtime(&self) -> u32 {
        match (&self.controller.program, self.controller.paused) {
            (None, _) => 1,
            (Some(_), false) => 2,
            (Some(_), true) => 4,
        }
    }

    fn joint_mode(&self) -> i32 {
        match self.controller.mode {
            7 => 253,
            4..=6 => 255,
            _ => 239,
        }
    }
}

type Source = fn(&Frame<'_>) -> Value;

/// Offset of the tool's centre point: software from 3.12.3 and 5.5.1 on has it.
const TCP_OFFSET: &str = "tcp_offset";

/// Returns position [m] and rotation vector [rad] of a pose.
pub(super) fn vector(pose: &Isometry3<f64>) -> [f64; 6] {
    let (at, turn) = (pose.translation.vector, pose.rotation.scaled_axis());
    [at.x, at.y, at.z, turn.x, turn.y, turn.z]
}

/// Values other than registers.
const OUTPUTS: &[(&str, Source)] = &[
    ("timestamp", |f| Value::F64(100.0 + f.controller.arm.uptime().as_secs_f64())),
    ("actual_q", |f| Value::V6(f.q())),
    ("target_q", |f| Value::V6(f.controller.commanded.0)),
    ("actual_qd", |f| Value::V6(f.qd())),
    ("target_qd", |f| Value::V6(f.controller.commanded.1)),
    ("target_qdd", |_| Value::V6([0.0; 6])),
    ("actual_qdd", |_| Value::V6([0.0; 6])),
    ("actual_current", |f| Value::V6(f.efforts().map(|torque| torque / 10.0))),
    ("target_current", |f| Value::V6(f.efforts().map(|torque| torque / 10.0))),
    ("actual_current_window", |_| Value::V6([0.5; 6])),
    ("actual_current_as_torque", |f| Value::V6(f.efforts())),
    ("target_moment", |f| Value::V6(f.efforts())),
    ("joint_control_output", |_| Value::V6([0.0; 6])),
    ("joint_control_current", |_| Value::V6([0.0; 6])),
    ("joint_temperatures", |_| Value::V6([31.0, 32.0, 33.0, 34.0, 35.0, 36.0])),
    ("actual_joint_voltage", |f| Value::V6([if f.controller.mode > 3 { 48.0 } else { 0.0 }; 6])),
    ("joint_mode", |f| Value::I6([f.joint_mode(); 6])),
    ("actual_TCP_pose", |f| Value::V6(f.pose)),
    ("target_TCP_pose", |f| Value::V6(f.pose)),
    ("actual_TCP_speed", |_| Value::V6([0.0; 6])),
    ("target_TCP_speed", |_| Value::V6([0.0; 6])),
    ("actual_TCP_force", |f| {
        let touched = f.controller.build.surface.map_or(0.0, |surface| surface.force(f.pose[2]));
        Value::V6([0.5, -0.25, -4.0 + touched, 0.01, 0.02, -0.03])
    }),
    ("ft_raw_wrench", |_| Value::V6([0.5, -0.25, -4.0, 0.01, 0.02, -0.03])),
    ("tcp_force_scalar", |_| Value::F64(4.0)),
    (TCP_OFFSET, |f| Value::V6(vector(&f.controller.build.tool))),
    ("actual_tool_accelerometer", |_| Value::V3([0.0, 0.0, -9.81])),
    ("elbow_position", |_| Value::V3([0.0; 3])),
    ("elbow_velocity", |_| Value::V3([0.0; 3])),
    ("actual_execution_time", |_| Value::F64(0.4)),
    ("actual_momentum", |_| Value::F64(0.0)),
    ("actual_main_voltage", |_| Value::F64(48.0)),
    ("actual_robot_voltage", |f| Value::F64(if f.controller.mode > 3 { 48.0 } else { 0.0 })),
    ("actual_robot_current", |_| Value::F64(0.6)),
    ("io_current", |_| Value::F64(0.02)),
    ("speed_scaling", |f| Value::F64(f.controller.speed_scaling())),
    ("target_speed_fraction", |f| Value::F64(f.controller.slider)),
    ("payload", |f| Value::F64(f.controller.payload.0)),
    ("payload_cog", |f| Value::V3(f.controller.payload.1)),
    ("payload_inertia", |f| Value::V6(f.controller.payload.2)),
    ("actual_digital_input_bits", |f| Value::U64(f.controller.digital_inputs())),
    ("actual_digital_output_bits", |f| Value::U64(f.controller.outputs.digital)),
    ("analog_io_types", |f| Value::U32(0b11 | u32::from(f.controller.outputs.voltage) << 2)),
    ("standard_analog_input0", |_| Value::F64(1.5)),
    ("standard_analog_input1", |_| Value::F64(2.5)),
    ("standard_analog_output0", |f| Value::F64(f.controller.outputs.analog[0])),
    ("standard_analog_output1", |f| Value::F64(f.controller.outputs.analog[1])),
    ("tool_mode", |_| Value::U32(253)),
    ("tool_analog_input_types", |_| Value::U32(0)),
    ("tool_analog_input0", |_| Value::F64(0.004)),
    ("tool_analog_input1", |_| Value::F64(0.005)),
    ("tool_output_voltage", |f| Value::I32(f.controller.outputs.tool_voltage)),
    ("tool_output_current", |_| Value::F64(0.01)),
    ("tool_temperature", |_| Value::F64(30.0)),
    ("tool_output_mode", |_| Value::U8(0)),
    ("tool_digital_output0_mode", |_| Value::U8(0)),
    ("tool_digital_output1_mode", |_| Value::U8(0)),
    ("robot_mode", |f| Value::I32(f.controller.mode)),
    ("safety_mode", |f| Value::I32(f.controller.safety_mode())),
    ("safety_status", |f| Value::I32(f.controller.safety_mode())),
    ("robot_status_bits", |f| Value::U32(f.status())),
    ("safety_status_bits", |f| Value::U32(f.safety_bits())),
    ("runtime_state", |f| Value::U32(f.runtime())),
    ("script_control_line", |_| Value::U32(0)),
    ("output_bit_registers0_to_31", |_| Value::U32(0)),
    ("output_bit_registers32_to_63", |_| Value::U32(0)),
    ("input_bit_registers0_to_31", |_| Value::U32(0)),
    ("input_bit_registers32_to_63", |_| Value::U32(0)),
    ("joint_position_deviation_ratio", |_| Value::F64(0.0)),
    ("collision_detection_ratio", |_| Value::F64(0.0)),
    ("time_scale_source", |_| Value::I32(0)),
];

/// A value that a client asked for.
#[derive(Clone, Copy)]
pub(super) enum Output {
    Other(Source),
    Int(usize),
    Double(usize),
    Bit,
}

impl Output {
    /// Returns the value of a name, as far as this software has it.
    pub fn find(name: &str, software: [u8; 3]) -> Option<Self> {
        let since = if software[0] < 5 { [3, 12, 3] } else { [5, 5, 1] };
        if name == TCP_OFFSET && software < since {
            return None;
        }
        let number = |prefix: &str| name.strip_prefix(prefix)?.parse().ok().filter(|n: &usize| *n < REGISTERS);
        if let Some(n) = number("output_int_register_") {
            return Some(Self::Int(n));
        }
        if let Some(n) = number("output_double_register_") {
            return Some(Self::Double(n));
        }
        if name.starts_with("output_bit_register_") {
            return Some(Self::Bit);
        }
        OUTPUTS.iter().find(|(known, _)| *known == name).map(|(_, source)| Self::Other(*source))
    }

    pub fn value(self, frame: &Frame<'_>) -> Value {
        let registers = &frame.controller.exchanged;
        match self {
            Self::Other(source) => source(frame),
            Self::Int(n) => Value::I32(registers.int_out.get(n).copied().unwrap_or_default()),
            Self::Double(n) => Value::F64(registers.double_out.get(n).copied().unwrap_or_default()),
            Self::Bit => Value::Bool(false),
        }
    }
}

/// A value that a client sends.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Input {
    Int(usize),
    Double(usize),
    Bit,
    Bits,
    /// Mask and values of the digital outputs, from this bit on.
    DigitalMask(u32),
    Digital(u32),
    AnalogMask,
    AnalogType,
    Analog(usize),
    SliderMask,
    Slider,
    Force,
}

impl Input {
    /// Returns the value of a name.
    pub fn find(name: &str) -> Option<Self> {
        let number = |prefix: &str| name.strip_prefix(prefix)?.parse().ok().filter(|n: &usize| *n < REGISTERS);
        if let Some(n) = number("input_int_register_") {
            return Some(Self::Int(n));
        }
        if let Some(n) = number("input_double_register_") {
            return Some(Self::Double(n));
        }
        Some(match name {
            "standard_digital_output_mask" => Self::DigitalMask(0),
            "standard_digital_output" => Self::Digital(0),
            "configurable_digital_output_mask" => Self::DigitalMask(8),
            "configurable_digital_output" => Self::Digital(8),
            "tool_digital_output_mask" => Self::DigitalMask(16),
            "tool_digital_output" => Self::Digital(16),
            "standard_analog_output_mask" => Self::AnalogMask,
            "standard_analog_output_type" => Self::AnalogType,
            "standard_analog_output_0" => Self::Analog(0),
            "standard_analog_output_1" => Self::Analog(1),
            "speed_slider_mask" => Self::SliderMask,
            "speed_slider_fraction" => Self::Slider,
            "external_force_torque" => Self::Force,
            "input_bit_registers0_to_31" | "input_bit_registers32_to_63" => Self::Bits,
            name if name.starts_with("input_bit_register_") => Self::Bit,
            _ => return None,
        })
    }

    pub fn kind(self) -> &'static str {
        match self {
            Self::Int(_) => "INT32",
            Self::Double(_) | Self::Analog(_) | Self::Slider => "DOUBLE",
            Self::Bit => "BOOL",
            Self::Bits | Self::SliderMask => "UINT32",
            Self::Force => "VECTOR6D",
            Self::DigitalMask(_) | Self::Digital(_) | Self::AnalogMask | Self::AnalogType => "UINT8",
        }
    }

    pub fn length(self) -> usize {
        match self.kind() {
            "INT32" | "UINT32" => 4,
            "DOUBLE" => 8,
            "VECTOR6D" => 48,
            _ => 1,
        }
    }
}
