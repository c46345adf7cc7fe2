//! State and refusals of a [`SimArm`] as texts and codes, for emulators whose protocol has none of its own.

use super::arm::{ESTOP, Refusal, SimArm};
use crate::adapter::AdapterError;

impl SimArm {
    /// Returns the state: 0 disabled, 1 stationary, 2 moving, 3 in error.
    pub fn state_code(&self) -> u8 {
        match (self.error(), self.enabled()) {
            (0, false) => 0,
            (0, true) if !self.moving() => 1,
            (0, true) => 2,
            _ => 3,
        }
    }

    /// Returns the text of the error; empty without an error.
    pub fn error_text(&self) -> String {
        match self.error() {
            0 => String::new(),
            ESTOP => "E-stop line open".to_owned(),
            code => format!("scripted error {code}"),
        }
    }

    /// Returns the error as the result of a command that it prevents.
    pub fn fault(&self) -> AdapterError {
        AdapterError::Fault { code: self.error().into(), text: self.error_text() }
    }

    /// Returns a refusal as the result of the command.
    pub fn rejected(&self, refusal: Refusal) -> AdapterError {
        AdapterError::Rejected(match refusal {
            Refusal::InError => return self.fault(),
            Refusal::Disabled => "the motors are disabled".to_owned(),
            Refusal::Moving => "the mode cannot change while the arm moves".to_owned(),
            Refusal::WrongMode => format!("the arm is in {} mode", self.mode().name()),
            Refusal::OutOfRange => "a target is outside the joint limits".to_owned(),
        })
    }
}
