//! The primary interface's packets.

use super::controller::Controller;
use super::programs::Program;
use crate::ur::model::Model;
use dimos_core::arm::Dh;

/// A packet with its size.
fn packet(kind: u8, content: &[u8]) -> Vec<u8> {
    [&(content.len() as i32 + 5).to_be_bytes()[..], &[kind], content].concat()
}

/// A part of a state with its size.
fn part(to: &mut Vec<u8>, kind: u8, content: &[u8]) {
    to.extend((content.len() as u32 + 5).to_be_bytes());
    to.push(kind);
    to.extend(content);
}

impl Controller {
    fn said(&self, kind: u8, body: &[u8]) -> Vec<u8> {
        let time = self.arm.uptime().as_micros() as u64;
        packet(20, &[&time.to_be_bytes()[..], &[0xFD, kind], body].concat())
    }

    /// The first packet of a connection.
    pub(super) fn introduction(&self) -> Vec<u8> {
        let [major, minor, bugfix] = self.version();
        let numbers = [i32::from(bugfix), 0].map(i32::to_be_bytes).concat();
        self.said(3, &[b"\x09URControl", &[major, minor][..], &numbers, b"01-01-2022, 00:00:00"].concat())
    }

    /// Reports an error C{code}A{argument}.
    pub(super) fn report_error(&mut self, code: i32, argument: i32, level: i32) {
        let message =
            self.said(6, &[[code, argument, level, 0, 0].map(i32::to_be_bytes).concat(), Vec::new()].concat());
        self.message(message);
    }

    /// Reports that a program was started or has stopped.
    pub(super) fn announce(&mut self, title: &str, name: String) {
        let body = [&[0; 8][..], &[title.len() as u8], title.as_bytes(), name.as_bytes()].concat();
        let message = self.said(7, &body);
        self.message(message);
    }

    /// Reports that a program failed.
    pub(super) fn report_exception(&mut self, line: i32, text: &str) {
        let message = self.said(10, &[&[line, 1].map(i32::to_be_bytes).concat()[..], text.as_bytes()].concat());
        self.message(message);
    }

    /// Puts the state into `to`.
    pub(super) fn primary_state(&self, to: &mut Vec<u8>) {
        let mut parts = Vec::new();
        let running = self.program.is_some();
        let (estop, stop) = (self.safety_mode() == 7, self.safety_mode() == 3);
        let mut mode = (self.arm.uptime().as_micros() as u64).to_be_bytes().to_vec();
        mode.extend([true, true, self.mode > 3, estop, stop, running, self.paused].map(u8::from));
        mode.extend([self.mode as u8, 0]);
        [self.slider, self.speed_scaling(), 1.0].iter().for_each(|v: &f64| mode.extend(v.to_be_bytes()));
        mode.push(0);
        part(&mut parts, 0, &mode);
        let mut joints = Vec::new();
        let (positions, velocities) = self.arm.joints();
        for (q, qd) in positions.iter().zip(&velocities).take(6) {
            [*q, *q, *qd].iter().for_each(|v| joints.extend(v.to_be_bytes()));
            [0.1_f32, 48.0, 31.0, 0.0].iter().for_each(|v| joints.extend(v.to_be_bytes()));
            joints.push(253);
        }
        part(&mut parts, 1, &joints);
        part(&mut parts, 5, &self.kinematics());
        part(&mut parts, 6, &self.configuration());
        to.extend(packet(16, &parts));
    }

    /// Checksums, theta, a, d, alpha of all joints, and that they are calibrated.
    fn kinematics(&self) -> Vec<u8> {
        let mut body = Vec::new();
        let all = self.build.reach.0;
        let sum =
            |dh: &Dh| [dh.theta, dh.a, dh.d, dh.alpha].iter().fold(0, |sum, v| sum ^ v.to_bits() ^ v.to_bits() >> 32);
        all.iter().for_each(|dh| body.extend((sum(dh) as u32).to_be_bytes()));
        for value in [|dh: &Dh| dh.theta, |dh: &Dh| dh.a, |dh: &Dh| dh.d, |dh: &Dh| dh.alpha] {
            all.iter().for_each(|dh| body.extend(value(dh).to_be_bytes()));
        }
        body.extend(0_u32.to_be_bytes());
        body
    }

    fn configuration(&self) -> Vec<u8> {
        let (limits, mut body) = (self.model.limits(), Vec::new());
        let mut put = |value: f64| body.extend(value.to_be_bytes());
        limits
            .position_lower
            .iter()
            .zip(&limits.position_upper)
            .for_each(|(low, high)| [*low, *high].map(&mut put).into_iter().collect());
        limits.velocity_max.iter().for_each(|speed| [*speed, 40.0].map(&mut put).into_iter().collect());
        [1.05, 1.4, 0.25, 1.2, 0.2].into_iter().for_each(&mut put);
        let dh = self.model.dh();
        dh.iter().for_each(|dh| put(dh.a));
        dh.iter().for_each(|dh| put(dh.d));
        dh.iter().for_each(|dh| put(dh.alpha));
        [0.0; 6].into_iter().for_each(put);
        let kind = match self.wrong_model {
            true if self.model.kind() == Model::Ur10e.kind() => Model::Ur5e.kind(),
            true => Model::Ur10e.kind(),
            false => self.model.kind(),
        };
        [1, 1, kind, 0].iter().for_each(|number: &u32| body.extend(number.to_be_bytes()));
        body
    }

    /// Starts a program, or reports why it does not run.
    pub(super) fn run(&mut self, program: Program) {
        if self.refuses_programs {
            self.report_exception(1, "compile_error_name_not_found:dimos:");
        } else if self.may_move() {
            self.start_program(program);
        }
    }
}
