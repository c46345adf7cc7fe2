//! Commands over TCP.

use std::net::SocketAddr;

use nalgebra::{Isometry3, Matrix4, try_convert};

use super::control::{Control, DOF, Datagram, IDLE, MOVE, Motion, Who};
use super::urdf;
use super::wire::{self, Ended};
use crate::franka::model::Model;
use dimos_hardware::sim::arm::Delivery;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::transport::Scan;

/// A command, under its number in either interface.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Asked {
    Connect,
    Move,
    Stop,
    Collision,
    Impedance,
    Load,
    /// The end effector in the nominal one's frame.
    EndEffector,
    Recovery,
    Model,
    /// The compiled model, which a real controller has for the client's processor.
    Library,
    /// The frame in which Cartesian stiffness is meant, at the end effector: kept, without effect.
    Stiffness,
    /// Another setter: checked for its length and its mode only.
    Other,
    Unknown,
}

impl Asked {
    /// The command and the length of its values [bytes].
    fn find(code: u32, five: bool) -> (Self, usize) {
        match (code, five) {
            (0, _) => (Self::Connect, 4),
            (1, true) => (Self::Move, 56),
            (1, false) => (Self::Move, 113),
            (2, _) => (Self::Stop, 0),
            (4, true) | (3, false) => (Self::Collision, 416),
            (5, true) | (4, false) => (Self::Impedance, 56),
            (6, true) | (5, false) => (Self::Other, 48),
            (7, true) | (6, false) => (Self::Other, 7),
            (8, true) | (7, false) => (Self::Stiffness, 128),
            (9, true) | (8, false) => (Self::EndEffector, 128),
            (10, true) | (9, false) => (Self::Load, 104),
            (11, true) => (Self::Other, 40),
            (12, true) | (10, false) => (Self::Recovery, 0),
            (13, true) => (Self::Library, 2),
            (11, false) => (Self::Model, 0),
            _ => (Self::Unknown, 0),
        }
    }
}

impl Control {
    /// Processes the command at the front of a connection's bytes.
    pub(super) fn request(&mut self, who: Who, bytes: &[u8]) -> Scan<Delivery> {
        let word = |at: usize| bytes.get(at..at + 4).and_then(|b| b.try_into().ok()).map(u32::from_le_bytes);
        let (Some(code), Some(id), Some(length)) = (word(0), word(4), word(8)) else { return Scan::More };
        let length = length as usize;
        if !(12..=1024).contains(&length) {
            return Scan::Take(bytes.len(), Delivery::HangUp);
        }
        let Some(values) = bytes.get(12..length) else { return Scan::More };
        if self.arm.fault_lasts(FaultKind::Silent) {
            return Scan::Take(length, Delivery::Silent);
        }
        let five = self.wide();
        let (asked, expected) = Asked::find(code, five);
        if asked == Asked::Unknown || values.len() != expected {
            return Scan::Take(length, Delivery::HangUp);
        }
        if let Some((status, rest)) = self.execute(asked, who, id, values) {
            self.answers.push((who, wire::answer(code, id, status, &rest)));
        }
        Scan::Take(length, Delivery::Send)
    }

    /// Executes a command. Returns the answer, unless it comes later.
    fn execute(&mut self, asked: Asked, who: Who, id: u32, values: &[u8]) -> Option<(u8, Vec<u8>)> {
        let status = match asked {
            Asked::Connect => return Some(self.connect(who, values)),
            Asked::Model => return Some((0, urdf::of(self.described(), &self.ranges).into_bytes())),
            // It is a program of the vendor's.
            Asked::Library => 1,
            Asked::Move => self.start(who, id, values),
            Asked::Stop => return self.stop(who, id).map(|status| (status, Vec::new())),
            Asked::Recovery => return self.begin_recovery(who, id).map(|status| (status, Vec::new())),
            // While a motion runs, nothing is set.
            _ if self.mode == MOVE => 1,
            _ => self.set(asked, &wire::floats(values)),
        };
        Some((status, Vec::new()))
    }

    fn connect(&mut self, who: Who, values: &[u8]) -> (u8, Vec<u8>) {
        let word = |at: usize| values.get(at..at + 2).and_then(|b| b.try_into().ok()).map_or(0, u16::from_le_bytes);
        let (version, port) = (word(0), word(2));
        // A wrong FER is an FR3, which has another version.
        let own: u16 = if self.wide() != (self.wrong_model && self.model == Model::Fer) { 5 } else { 10 };
        let same = version == own;
        if same {
            self.leave();
            self.client = Some((who, SocketAddr::new(self.address_of(who), port)));
        }
        (u8::from(!same), own.to_le_bytes().to_vec())
    }

    /// Which robot the description is of.
    fn described(&self) -> &'static str {
        if self.wrong_model { "fp3" } else { "fr3" }
    }

    fn start(&mut self, who: Who, id: u32, values: &[u8]) -> u8 {
        let word =
            |at: usize| values.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(u32::MAX, u32::from_le_bytes);
        let (controller, generator) = (word(0), word(4));
        let asynchronous = !self.wide() && values.get(56) != Some(&0);
        let (impossible, invalid) = if self.wide() { (3, 5) } else { (5, 7) };
        if controller > 2 || generator > 4 {
            return invalid;
        }
        // Torques and Cartesian motions are not emulated.
        if self.mode != IDLE
            || self.braking
            || self.motion.is_some()
            || controller == 2
            || generator > 1
            || asynchronous
        {
            return impossible;
        }
        if self.arm.enable(true).is_err() {
            return impossible;
        }
        self.motion = Some(Motion { owner: who, id, begun: false });
        (self.mode, self.generator, self.controller) = (MOVE, generator as u8 + 1, controller as u8);
        (self.lost_in_row, self.reason, self.command) = (0, 0, None);
        self.history.clear();
        1
    }

    fn stop(&mut self, who: Who, id: u32) -> Option<u8> {
        if self.motion.is_none() {
            return Some(if self.mode == IDLE { 0 } else { 1 });
        }
        self.end_motion(Ended::Preempted);
        self.braking = true;
        self.stopping = Some((who, id));
        None
    }

    fn set(&mut self, asked: Asked, values: &[f64]) -> u8 {
        let inside = |least: f64, most: f64| values.iter().all(|value| (least..=most).contains(value));
        match asked {
            Asked::Impedance if !inside(0.0, 14250.0) => return 2,
            Asked::Impedance => self.impedance = values.first_chunk().copied().unwrap_or(self.impedance),
            Asked::Collision if !inside(0.0, f64::MAX) => return 2,
            Asked::Collision => {
                // The nominal ones: lower, then upper.
                let of = |from: usize| values.get(from..).and_then(<[f64]>::first_chunk::<DOF>).copied();
                if let (Some(lower), Some(upper)) = (of(14), of(21)) {
                    self.thresholds = (lower, upper);
                }
            }
            Asked::Load if !values.first().is_some_and(|mass| (0.0..=10.0).contains(mass)) => return 2,
            Asked::EndEffector => match pose(values) {
                Some(pose) => self.frames[1] = pose,
                None => return 2,
            },
            Asked::Stiffness => match pose(values) {
                Some(pose) => self.stiffness = pose,
                None => return 2,
            },
            Asked::Load => self.load = values.first_chunk().copied().unwrap_or(self.load),
            _ => {}
        }
        0
    }

    /// Answers a command that was not answered at once.
    pub(super) fn answer(&mut self, who: Who, (ten, five): (u32, u32), id: u32, status: u8) {
        let code = if self.wide() { five } else { ten };
        self.answers.push((who, wire::answer(code, id, status, &[])));
    }

    /// Takes a datagram: a command counts if it answers the state that was sent last. Returns whether it does.
    pub(super) fn take_command(&mut self, bytes: &[u8]) -> bool {
        self.traffic.push(|| Datagram::Command(bytes.to_vec()));
        match wire::command(bytes, self.wide()) {
            Some((id, command)) if id == self.id && self.motion.is_some() && self.command.is_none() => {
                self.command = Some(command);
                return true;
            }
            _ => self.figures.unused += 1,
        }
        false
    }
}

/// Reads a pose, column by column; `None` for a matrix that is none.
fn pose(values: &[f64]) -> Option<Isometry3<f64>> {
    let matrix = Matrix4::from_column_slice(values.first_chunk::<16>()?);
    try_convert(matrix)
}
