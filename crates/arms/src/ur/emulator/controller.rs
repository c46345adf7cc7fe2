//! The emulated controller: power, safety, the running program and its registers. Time is passed in, and nothing here
//! knows of connections' bytes.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::fields::vector;
use super::pace::Segment;
use super::programs::{Build, Program, Reach, pose};
use super::rtde::Rtde;
use super::{PLAYABLE, SimOptions, limits};
use crate::ur::DOF;
use crate::ur::model::Model;
use dimos_core::arm::Load;
use dimos_core::clock::Mono;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{ESTOP, HasArm, SimArm};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::tool_device::ToolSocket;

/// Pose at power-up [rad]: upright, and no joint as another one.
const POSE: [f64; DOF] = [0.3, -1.4, 1.5, -1.7, -1.5, 0.4];
/// Robot modes.
pub(super) const POWER_OFF: i32 = 3;
const POWER_ON: i32 = 4;
const IDLE: i32 = 5;
pub(super) const RUNNING: i32 = 7;
/// Time after a protective stop in which it cannot be released.
const PROTECTED: Duration = Duration::from_secs(5);
/// A program makes at most this many steps at once: a real controller is never late.
const STEPS: u32 = 10;
/// A protective stop: a joint is not where its path is.
const DEVIATES: u16 = 153;
/// Number of registers of a type.
pub(super) const REGISTERS: usize = 48;
/// Messages that are kept for clients of the primary interface.
const KEPT: usize = 64;
/// Positions of servoj that are kept for tests.
pub(super) const SERVOJ_KEPT: usize = 20_000;
/// All digital inputs: 8 standard, 8 configurable, 2 of the tool.
const INPUTS: u64 = (1 << 18) - 1;

/// Registers between clients and the program.
#[derive(Debug, Clone)]
pub(super) struct Registers {
    pub int_in: [i32; REGISTERS],
    pub double_in: [f64; REGISTERS],
    pub int_out: [i32; REGISTERS],
    pub double_out: [f64; REGISTERS],
}

impl Registers {
    fn new() -> Self {
        Self {
            int_in: [0; REGISTERS],
            double_in: [0.0; REGISTERS],
            int_out: [0; REGISTERS],
            double_out: [0.0; REGISTERS],
        }
    }
}

/// Outputs.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Outputs {
    pub digital: u64,
    pub analog: [f64; 2],
    /// Which analog outputs are voltages (bits 0, 1).
    pub voltage: u8,
    pub tool_voltage: i32,
}

/// A client's connection.
pub(super) struct Session {
    /// Characters of a program or a command that is not complete; at the dashboard an answer that is late.
    pub text: String,
    /// Opened in local control: it takes no programs, also later.
    pub read_only: bool,
    /// The controller closes it.
    pub closing: bool,
    /// Number of the next message to send.
    pub next_message: u64,
    /// Reports so far.
    pub reports: u64,
    pub rtde: Rtde,
}

/// The controller's memory.
pub struct Controller {
    pub(super) model: Model,
    pub(super) software: [u8; 3],
    pub(super) build: Build,
    pub(super) serial: String,
    pub(super) arm: SimArm,
    pub(super) mode: i32,
    /// The robot mode that was ordered, and when the next one on the way to it is reached.
    goal: i32,
    next_mode: Mono,
    power_time: Duration,
    /// When the present protective stop began.
    stopped_at: Option<Mono>,
    /// Argument of its error, where a point of servoj caused it.
    pub(super) stop_argument: i32,
    /// A safety mode other than those that follow from the arm.
    safety: Option<i32>,
    pub(super) program: Option<Program>,
    pub(super) paused: bool,
    next_step: Mono,
    /// Registers as the program has them. Inputs reach it one step after they arrive, and its outputs are reported one
    /// step after it wrote them.
    pub(super) registers: Registers,
    /// Inputs that have arrived, and outputs as they are reported.
    pub(super) exchanged: Registers,
    pub(super) outputs: Outputs,
    /// The tool's line: what is connected, and its rate while it is on [bit/s].
    pub(super) tool: ToolSocket,
    pub(super) tool_rate: Option<u32>,
    /// Digital inputs, and those that a fault pulls low.
    inputs: (u64, u64),
    pub(super) payload: (f64, [f64; 3], [f64; 6]),
    /// Acceleration of the base that balances gravity [m/s²], as programs set it.
    pub(super) gravity: [f64; 3],
    /// Positions [rad] and velocities [rad/s] that the controller commands.
    pub(super) commanded: ([f64; DOF], [f64; DOF]),
    /// Positions that a program gave to servoj, and when.
    pub(super) servoj: VecDeque<(Mono, [f64; DOF])>,
    /// Position of the pendant's speed slider, and how much of that speed the trajectory limiter leaves, 0 to 1.
    pub(super) slider: f64,
    pub(super) scaling: f64,
    pub(super) segment: Option<Segment>,
    pub(super) remote: bool,
    pub(super) refuses_programs: bool,
    pub(super) hangs: bool,
    /// The dashboard closes the connection instead of answering.
    pub(super) breaks_dashboard: bool,
    /// The dashboard sends the answer to this request together with the next one.
    pub(super) late_answer: Option<&'static str>,
    /// A paused program does not count as running in the status bits.
    pub(super) hides_paused: bool,
    pub(super) wrong_model: bool,
    /// Joint positions, and the pose of the tool's centre point there.
    pose: ([f64; DOF], [f64; 6]),
    pub(super) sessions: BTreeMap<(usize, u64), Session>,
    /// Messages of the primary interface, and the number of the first one.
    messages: (u64, Vec<Vec<u8>>),
}

impl Controller {
    /// A controller that was started some time ago; its arm has no power.
    pub fn new(model: Model, options: &SimOptions, now: Mono) -> AdapterResult<Self> {
        let common = options.common().starting_at(&POSE);
        let arm = SimArm::new("ur", &limits(model), &common, PLAYABLE, now)?.without_modes().colliding_as(DEVIATES);
        Ok(Self {
            model,
            software: options.software(model),
            build: Build {
                model,
                reach: Reach(options.kinematics(model)),
                tool: pose(&options.tcp_offset),
                surface: options.surface,
            },
            serial: options.serial.clone(),
            arm,
            mode: POWER_OFF,
            goal: POWER_OFF,
            next_mode: now,
            power_time: Duration::from_secs_f64(options.power_time),
            stopped_at: None,
            stop_argument: 0,
            safety: None,
            program: None,
            paused: false,
            next_step: now,
            registers: Registers::new(),
            exchanged: Registers::new(),
            outputs: Outputs { voltage: 0b11, ..Outputs::default() },
            tool: ToolSocket::default(),
            tool_rate: None,
            inputs: (INPUTS, 0),
            payload: (0.0, [0.0; 3], [0.0; 6]),
            gravity: [0.0, 0.0, 9.82],
            commanded: ([0.0; DOF], [0.0; DOF]),
            servoj: VecDeque::new(),
            slider: options.speed_slider,
            scaling: options.speed_scaling,
            segment: None,
            remote: options.remote_control,
            refuses_programs: false,
            hangs: false,
            breaks_dashboard: false,
            late_answer: None,
            hides_paused: false,
            wrong_model: false,
            pose: ([f64::NAN; DOF], [0.0; 6]),
            sessions: BTreeMap::new(),
            messages: (0, Vec::new()),
        })
    }

    /// Time of one step.
    pub(super) fn step_time(&self) -> f64 {
        1.0 / self.model.rate()
    }

    /// Advances arm, power and program.
    pub(super) fn advance_to(&mut self, now: Mono) {
        let step = Duration::from_secs_f64(self.step_time());
        let mut steps = 0;
        while self.next_step <= now && steps < STEPS {
            self.arm.advance(self.next_step);
            self.follow_arm();
            (self.exchanged.int_out, self.exchanged.double_out) = (self.registers.int_out, self.registers.double_out);
            self.step_program();
            (self.registers.int_in, self.registers.double_in) = (self.exchanged.int_in, self.exchanged.double_in);
            self.next_step = self.next_step.after(step);
            steps += 1;
        }
        if self.next_step <= now {
            self.next_step = now.after(step);
        }
        self.arm.advance(now);
        self.follow_arm();
        self.follow_power(now);
        self.follow_inputs();
        if self.arm.take_fault(FaultKind::WrongModel).is_some() {
            self.wrong_model = true;
        }
    }

    /// What faults of the arm mean for power and safety.
    fn follow_arm(&mut self) {
        if self.arm.error() == ESTOP {
            if self.mode != POWER_OFF {
                self.power_off();
            }
            if !self.arm.estop_open() {
                // The button is released: nothing else remains of it.
                let _ = self.arm.clear_error();
            }
        } else if self.arm.error() != 0 && self.stopped_at.is_none() {
            self.stopped_at = Some(self.arm.now());
            self.paused = self.program.is_some();
            let argument = if self.arm.error() == 204 { self.stop_argument } else { 0 };
            self.report_error(self.arm.error().into(), argument, 2);
        }
    }

    fn follow_power(&mut self, now: Mono) {
        while self.mode < self.goal && self.next_mode <= now {
            self.mode = match self.mode {
                POWER_OFF => POWER_ON,
                POWER_ON => IDLE,
                _ => RUNNING,
            };
            self.next_mode = self.next_mode.after(self.power_time);
            if self.mode == RUNNING && self.arm.enable(true).is_err() {
                self.power_off();
            }
        }
    }

    /// Plays the fault of a digital input.
    fn follow_inputs(&mut self) {
        self.inputs.1 = 0;
        if let Some(fault) = self.arm.take_fault(FaultKind::InputLow) {
            let bit = 1_u64.checked_shl(fault.input.into()).unwrap_or(0);
            if fault.duration > 0.0 {
                self.inputs.1 = bit;
            } else {
                self.inputs.0 &= !bit;
            }
        }
    }

    /// Digital inputs, bits as in RTDE.
    pub(super) fn digital_inputs(&self) -> u64 {
        self.inputs.0 & !self.inputs.1
    }

    /// Sets the level of a digital input, as the device wired to it does.
    pub(super) fn set_input(&mut self, number: u8, high: bool) {
        let bit = INPUTS & 1_u64.checked_shl(number.into()).unwrap_or(0);
        self.inputs.0 = if high { self.inputs.0 | bit } else { self.inputs.0 & !bit };
    }

    /// Changes between remote control and the pendant, which takes the script's ports away from their clients.
    pub(super) fn set_remote_control(&mut self, remote: bool) {
        self.remote = remote;
        if !remote && !self.model.is_cb3() {
            let scripts = self.sessions.iter_mut().filter(|((port, _), _)| super::takes_scripts(*port));
            scripts.for_each(|(_, session)| session.closing = true);
        }
    }

    /// Switches power on, and releases the brakes if `release`.
    pub(super) fn power_on(&mut self, release: bool) {
        if self.safety_mode() > 4 {
            return;
        }
        let goal = if release { RUNNING } else { IDLE };
        if self.mode < goal && self.goal < goal {
            self.goal = goal;
            self.next_mode = self.arm.now().after(self.power_time);
        }
    }

    /// Switches power off; the brakes hold.
    pub(super) fn power_off(&mut self) {
        self.stop_program();
        (self.mode, self.goal) = (POWER_OFF, POWER_OFF);
        let _ = self.arm.enable(false);
    }

    /// The computer of the controller was off.
    pub(super) fn lose_power(&mut self) {
        self.power_off();
        (self.stopped_at, self.safety, self.program) = (None, None, None);
        self.registers.int_out = [0; REGISTERS];
    }

    /// The safety mode.
    pub(super) fn safety_mode(&self) -> i32 {
        match self.safety {
            Some(mode) => mode,
            None if self.arm.error() == ESTOP => 7,
            None if self.arm.error() != 0 => 3,
            None => 1,
        }
    }

    pub(super) fn set_safety(&mut self, mode: Option<i32>) {
        self.safety = mode;
        match mode {
            // A paused program continues.
            None | Some(1 | 2 | 4) => self.paused = false,
            Some(8 | 9) => self.power_off(),
            Some(_) => {
                self.arm.stop();
                self.paused = self.program.is_some();
            }
        }
    }

    /// Whether the arm may move.
    pub(super) fn may_move(&self) -> bool {
        self.mode == RUNNING && matches!(self.safety_mode(), 1 | 2 | 4)
    }

    /// Releases a protective stop, not earlier than 5 s after it began. A paused program continues.
    pub(super) fn unlock(&mut self) -> bool {
        let Some(since) = self.stopped_at else { return true };
        if self.arm.now().since(since) < PROTECTED || self.arm.clear_error().is_err() {
            return false;
        }
        (self.stopped_at, self.paused) = (None, false);
        true
    }

    /// Restarts the safety system after a violation or a fault.
    pub(super) fn restart_safety(&mut self) {
        if matches!(self.safety, Some(8 | 9)) {
            self.safety = None;
        }
    }

    /// Position [m] and rotation vector [rad] of the tool's centre point. Computed only where the joints have moved.
    pub(super) fn pose(&mut self, joints: [f64; DOF]) -> [f64; 6] {
        if self.pose.0 != joints {
            let pose = self.build.reach.forward(&joints) * self.build.tool;
            self.pose = (joints, vector(&pose));
        }
        self.pose.1
    }

    /// Sets the tool's centre point in the flange's frame: position [m] and rotation vector [rad].
    pub(super) fn set_tcp(&mut self, offset: [f64; 6]) {
        (self.build.tool, self.pose.0) = (pose(&offset), [f64::NAN; DOF]);
    }

    // --- Program ---

    pub(super) fn program_name(&self) -> Option<&str> {
        self.program.as_ref().map(Program::name)
    }

    pub(super) fn start_program(&mut self, program: Program) {
        self.stop_program();
        self.announce("PROGRAM_XXX_STARTED", program.name().to_owned());
        (self.program, self.paused, self.segment) = (Some(program), false, None);
    }

    pub(super) fn stop_program(&mut self) {
        if let Some(program) = self.program.take() {
            self.arm.stop();
            (self.paused, self.segment) = (false, None);
            self.announce("PROGRAM_XXX_STOPPED", program.name().to_owned());
        }
    }

    /// Pauses the running program: the arm decelerates to rest.
    pub(super) fn pause_program(&mut self) {
        if self.program.is_some() {
            self.arm.stop();
            self.paused = true;
        }
    }

    // --- Messages ---

    pub(super) fn message(&mut self, message: Vec<u8>) {
        self.messages.1.push(message);
        if self.messages.1.len() > KEPT {
            self.messages.1.remove(0);
            self.messages.0 += 1;
        }
    }

    /// Returns the number of the next message, which a new client begins with.
    pub(super) fn next_message(&self) -> u64 {
        self.messages.0 + self.messages.1.len() as u64
    }

    /// Returns the messages from a number on.
    pub(super) fn messages_from(&self, number: u64) -> impl Iterator<Item = &Vec<u8>> {
        self.messages.1.iter().skip(number.saturating_sub(self.messages.0) as usize)
    }
}

impl HasArm for Controller {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        let (mass, center, inertia) = self.payload;
        truth.load = Some(Load { mass, center, inertia });
    }

    fn advance(&mut self, now: Mono) {
        self.advance_to(now);
    }
}
