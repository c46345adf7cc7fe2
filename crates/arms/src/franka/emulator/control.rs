//! The emulated controller: one cycle every millisecond of its own time. Nothing here knows of sockets.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use nalgebra::Isometry3;

use super::hand::Hand;
use super::wire;
use super::{PLAYABLE, SimOptions};
use crate::franka::model::{JointRange, Model};
use dimos_core::arm::Load;
use dimos_core::clock::Mono;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{ESTOP, HasArm, Measured, SimArm};
use dimos_hardware::sim::delivery::Delivery;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::trace::Trace;

pub(super) const DOF: usize = 7;
/// Length of a cycle [s].
pub(super) const CYCLE: f64 = 0.001;
/// Pose at power-up [rad]: no joint as another one.
const POSE: [f64; DOF] = [0.2, -0.6, 0.1, -1.9, -0.15, 1.7, 0.8];
/// Robot modes.
pub(super) const IDLE: u8 = 1;
pub(super) const MOVE: u8 = 2;
const GUIDING: u8 = 3;
pub(super) const REFLEX: u8 = 4;
pub(super) const USER_STOPPED: u8 = 5;
const RECOVERING: u8 = 6;
/// The error of a joint that something stops.
const JOINT_REFLEX: u16 = 7;
/// A recovery takes this many cycles.
const RECOVERY: u32 = 30;
/// A joint that was moved by hand by more than this has a new desired position [rad].
const BY_HAND: f64 = 1e-4;
/// The vendor's hand, as Desk has it: mass [kg], inertia about its centre [kg·m²], centre in the flange frame [m].
const HAND: [f64; 13] = [0.73, 0.001, 0.0, 0.0, 0.0, 0.0025, 0.0, 0.0, 0.0, 0.0017, -0.01, 0.0, 0.03];

/// A connection: port and number.
pub(super) type Who = (usize, u64);

/// A command that came in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Command {
    pub positions: [f64; DOF],
    pub velocities: [f64; DOF],
    pub finished: bool,
}

/// A motion: who started it, with which command, and whether a command has come.
#[derive(Debug, Clone, Copy)]
pub(super) struct Motion {
    pub owner: Who,
    pub id: u32,
    pub begun: bool,
}

/// A datagram, as tests see it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Datagram {
    /// A state that was sent.
    State(Vec<u8>),
    /// A command that came.
    Command(Vec<u8>),
}

/// What happened so far.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Figures {
    /// Cycles.
    pub cycles: u64,
    /// Cycles of motions, and those without a command in time.
    pub moved: u64,
    /// Cycles of motions without a command in time.
    pub lost: u64,
    /// The most of them in a row.
    pub longest_loss: u32,
    /// Commands that came late, early, twice, or without a motion.
    pub unused: u64,
    /// Cycles that began more than 0.3 ms late, because the computer was busy.
    pub late_wakes: u64,
}

/// The controller's memory.
pub struct Control {
    pub(super) model: Model,
    pub(super) ranges: [JointRange; DOF],
    pub(super) arm: SimArm,
    pub(super) id: u64,
    /// Who gets the states, and where.
    pub(super) client: Option<(Who, SocketAddr)>,
    /// From where each connection comes.
    pub(super) clients_at: Vec<(Who, IpAddr)>,
    pub(super) mode: u8,
    pub(super) generator: u8,
    pub(super) controller: u8,
    pub(super) errors: u64,
    pub(super) reason: u64,
    pub(super) motion: Option<Motion>,
    /// Desired values: the last command, or what replaces a lost one.
    pub(super) q_d: [f64; DOF],
    pub(super) dq_d: [f64; DOF],
    pub(super) ddq_d: [f64; DOF],
    pub(super) command: Option<Command>,
    /// The arm decelerates; a StopMove waits for its end.
    pub(super) braking: bool,
    pub(super) stopping: Option<(Who, u32)>,
    recovery: Option<(Who, u32, u32)>,
    /// Answers that are due.
    pub(super) answers: Vec<(Who, Vec<u8>)>,
    pub(super) lost_in_row: u32,
    pub(super) history: VecDeque<bool>,
    /// Mass, inertia and centre of the end effector that is set up in Desk.
    pub(super) tool: [f64; 13],
    /// Mass, centre and inertia of the load.
    pub(super) load: [f64; 13],
    /// Nominal end effector in the flange's frame, as Desk sets it, and the end effector in that frame, as clients do.
    pub(super) frames: [Isometry3<f64>; 2],
    /// The frame of Cartesian stiffness at the end effector.
    pub(super) stiffness: Isometry3<f64>,
    pub(super) impedance: [f64; DOF],
    /// Lower and upper thresholds of external torques.
    pub(super) thresholds: ([f64; DOF], [f64; DOF]),
    pub(super) external: [f64; DOF],
    pub(super) hand: Hand,
    pub(super) wrong_model: bool,
    /// Time of this cycle: each is as long as any other, however late this computer begins it.
    time: Mono,
    silent_until: Mono,
    /// How the connections end.
    pub(super) cut: Option<Delivery>,
    last_state: Vec<u8>,
    pub(super) figures: Figures,
    pub(super) traffic: Trace<Datagram>,
}

impl Control {
    /// A controller that has been switched on, with its brakes released.
    pub fn new(model: Model, options: &SimOptions, now: Mono) -> AdapterResult<Self> {
        let common = options.common().starting_at(&POSE);
        let limits = super::limits(model);
        let arm = SimArm::new("franka", &limits, &common, PLAYABLE, now)?.without_modes().colliding_as(JOINT_REFLEX);
        let (positions, _) = arm.joints();
        let mut control = Self {
            model,
            ranges: model.ranges(),
            arm,
            id: 1_000_000,
            client: None,
            clients_at: Vec::new(),
            mode: IDLE,
            generator: 0,
            controller: 3,
            errors: 0,
            reason: 0,
            motion: None,
            q_d: [0.0; DOF],
            dq_d: [0.0; DOF],
            ddq_d: [0.0; DOF],
            command: None,
            braking: false,
            stopping: None,
            recovery: None,
            answers: Vec::new(),
            lost_in_row: 0,
            history: VecDeque::with_capacity(100),
            tool: if options.hand_in_desk { HAND } else { [0.0; 13] },
            load: [0.0; 13],
            frames: [options.end_effector(), Isometry3::identity()],
            stiffness: Isometry3::identity(),
            impedance: [3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0],
            thresholds: ([20.0; DOF], [20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0]),
            external: [0.0; DOF],
            hand: Hand::new(),
            wrong_model: false,
            time: now,
            silent_until: Mono::ZERO,
            cut: None,
            last_state: Vec::new(),
            figures: Figures::default(),
            traffic: Trace::default(),
        };
        control.q_d = std::array::from_fn(|i| positions.get(i).copied().unwrap_or_default());
        Ok(control)
    }

    /// Whether states have f64: those of an FER.
    pub(super) fn wide(&self) -> bool {
        self.model == Model::Fer
    }

    /// Makes one cycle. Returns the state to send, and where to.
    pub fn cycle(&mut self) -> Option<(SocketAddr, Vec<u8>)> {
        self.figures.cycles += 1;
        self.time = self.time.after(Duration::from_secs_f64(CYCLE));
        self.arm.advance(self.time);
        self.see_faults();
        self.step_motion();
        if self.arm.enabled() {
            let _ = self.arm.servo(&self.q_d.map(|q| q));
            if self.motion.is_none() && !self.braking && !self.arm.moving() {
                let _ = self.arm.enable(false);
            }
        } else {
            self.follow_hand();
        }
        self.recover();
        self.hand.play(|kind| self.arm.take_fault(kind));
        let finished = self.hand.advance(CYCLE);
        self.answers.extend(finished);
        self.id += 1;
        let (_, address) = self.client?;
        self.deliver().map(|state| (address, state))
    }

    /// Whether the arm may be moved by hand: without a motion, only brakes or another hand hold it.
    fn follow_hand(&mut self) {
        let (positions, _) = self.arm.joints();
        for i in 0..DOF {
            let (Some(q), Some(q_d)) = (positions.get(i), self.q_d.get(i)) else { continue };
            if (q - q_d).abs() > BY_HAND {
                let q = *q;
                self.q_d.iter_mut().skip(i).take(1).for_each(|q_d| *q_d = q);
            }
        }
    }

    fn see_faults(&mut self) {
        if self.arm.error() == ESTOP {
            if self.arm.estop_open() {
                self.user_stop(true);
            } else {
                let _ = self.arm.clear_error();
                self.user_stop(false);
            }
        } else if self.arm.error() != 0 && self.mode != RECOVERING {
            let bit = u32::from(self.arm.error() - 1).min(40);
            if self.errors >> bit & 1 == 0 {
                self.fail(bit);
            }
        }
        if self.arm.take_fault(FaultKind::WrongModel).is_some() {
            self.wrong_model = true;
        }
        let beyond = self.external.iter().zip(&self.thresholds.1).any(|(torque, most)| torque.abs() > *most);
        if beyond && self.motion.is_some() {
            self.fail(6);
        }
    }

    fn recover(&mut self) {
        let Some((who, id, left)) = self.recovery else { return };
        if left > 0 || self.braking || self.arm.moving() {
            self.recovery = Some((who, id, left.saturating_sub(1)));
            return;
        }
        self.recovery = None;
        let _ = self.arm.clear_error();
        (self.mode, self.errors) = (IDLE, 0);
        self.answer(who, wire::RECOVERY, id, 0);
    }

    /// Begins a recovery, which is answered when it has ended. Returns the status if it is refused.
    pub(super) fn begin_recovery(&mut self, who: Who, id: u32) -> Option<u8> {
        match self.mode {
            REFLEX => {
                self.mode = RECOVERING;
                self.recovery = Some((who, id, RECOVERY));
                None
            }
            USER_STOPPED => Some(if self.wide() { 4 } else { 5 }),
            _ => Some(0),
        }
    }

    /// Presses or releases the user stop: without power, the brakes hold.
    pub(super) fn user_stop(&mut self, pressed: bool) {
        match (pressed, self.mode == USER_STOPPED) {
            (true, false) => {
                self.end_motion(wire::Ended::UserStop);
                (self.dq_d, self.ddq_d, self.braking) = ([0.0; DOF], [0.0; DOF], false);
                self.show_rest(USER_STOPPED);
                let _ = self.arm.enable(false);
            }
            (false, true) => self.mode = IDLE,
            _ => {}
        }
    }

    /// Presses or releases the guiding button.
    pub(super) fn guide(&mut self, on: bool) {
        if on {
            self.end_motion(wire::Ended::Aborted);
            self.show_rest(GUIDING);
        } else if self.mode == GUIDING {
            self.mode = IDLE;
        }
    }

    /// Shows a mode without a motion.
    pub(super) fn show_rest(&mut self, mode: u8) {
        (self.mode, self.generator, self.controller) = (mode, 0, 3);
    }

    /// The controller's computer was off.
    fn lose_power(&mut self) {
        (self.motion, self.client, self.errors, self.stopping) = (None, None, 0, None);
        (self.dq_d, self.ddq_d, self.braking) = ([0.0; DOF], [0.0; DOF], false);
        self.show_rest(IDLE);
        let _ = self.arm.enable(false);
    }

    // --- States ---

    /// Returns the state of this cycle, as faults of the wire leave it.
    fn deliver(&mut self) -> Option<Vec<u8>> {
        match self.arm.delivery() {
            Delivery::Silent => return None,
            Delivery::Stall(time) => self.silent_until = self.time.after(time),
            delivery @ (Delivery::Disconnect(_) | Delivery::PowerLoss(_)) => {
                self.cut = Some(delivery);
                match delivery {
                    Delivery::PowerLoss(_) => self.lose_power(),
                    _ => self.leave(),
                }
                return None;
            }
            delivery => {
                if self.time < self.silent_until {
                    return None;
                }
                if self.arm.take_fault(FaultKind::Frozen).is_some() && !self.last_state.is_empty() {
                    return Some(self.last_state.clone());
                }
                let measured = self.arm.measured();
                let mut state = wire::state(self, &measured);
                self.last_state.clone_from(&state);
                // The highest byte of the first joint's position.
                let spot = if self.wide() { 8 + 148 * 8 - 1 } else { 8 + 148 * 4 - 1 };
                delivery.damage(&mut state, b"\x00noise", spot);
                self.traffic.push(|| Datagram::State(state.clone()));
                return Some(state);
            }
        }
        None
    }

    /// The client has gone: the arm decelerates to rest.
    pub(super) fn leave(&mut self) {
        self.client = None;
        if self.motion.take().is_some() {
            self.braking = true;
        }
        self.stopping = None;
    }

    /// Returns the end-effector pose, column by column.
    pub(super) fn pose(&self, measured: &Measured) -> [f64; 16] {
        let joints = measured.positions.get(..DOF).unwrap_or_default();
        columns(&(Flange.forward(joints) * self.end_effector()))
    }

    /// Returns the end effector in the flange's frame.
    pub(super) fn end_effector(&self) -> Isometry3<f64> {
        self.frames[0] * self.frames[1]
    }
}

/// Returns a pose as the wire has it, column by column.
pub(super) fn columns(pose: &Isometry3<f64>) -> [f64; 16] {
    let matrix = pose.to_homogeneous();
    std::array::from_fn(|i| matrix.get(i).copied().unwrap_or_default())
}

/// The kinematic chain up to the flange.
struct Flange;

impl Chain for Flange {
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        Model::link(joint, position)
    }

    fn end(&self) -> Isometry3<f64> {
        Isometry3::translation(0.0, 0.0, Model::FLANGE)
    }
}

impl HasArm for Control {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.motors_on = None; // the controller releases and applies the brakes
        truth.gripper_position = Some(self.hand.width());
        // With an end effector of Desk it counts both.
        let ([mass, x, y, z, inertia @ ..], [of_tool, ..]) = (self.load, self.tool);
        let [xx, xy, xz, _, yy, yz, _, _, zz] = inertia;
        let load = Load { mass, center: [x, y, z], inertia: [xx, xy, xz, yy, yz, zz] };
        truth.load = (of_tool == 0.0).then_some(load);
    }

    /// The cycle advances the arm.
    fn advance(&mut self, _now: Mono) {}

    fn time(&self, _now: Mono) -> Mono {
        self.time
    }
}
