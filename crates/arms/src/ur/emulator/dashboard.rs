//! The dashboard: one line of text asks, one answers.

use super::controller::{Controller, POWER_OFF};
use crate::ur::model::Model;

/// First line on every connection.
pub(super) const GREETING: &[u8] = b"Connected: Universal Robots Dashboard Server\n";

const ROBOT_MODES: [&str; 9] =
    ["DISCONNECTED", "CONFIRM_SAFETY", "BOOTING", "POWER_OFF", "POWER_ON", "IDLE", "BACKDRIVE", "RUNNING", "UPDATING"];
const SAFETY_MODES: [&str; 10] = [
    "UNKNOWN",
    "NORMAL",
    "REDUCED",
    "PROTECTIVE_STOP",
    "RECOVERY",
    "SAFEGUARD_STOP",
    "SYSTEM_EMERGENCY_STOP",
    "ROBOT_EMERGENCY_STOP",
    "VIOLATION",
    "FAULT",
];
/// Requests that an e-Series controller refuses in local control.
const REMOTE: [&str; 9] = [
    "power on",
    "power off",
    "brake release",
    "unlock protective stop",
    "restart safety",
    "play",
    "stop",
    "pause",
    "load",
];

impl Controller {
    /// Answers a line.
    pub(super) fn dashboard(&mut self, request: &str) -> String {
        let cb3 = self.model.is_cb3();
        if !cb3 && !self.remote && REMOTE.iter().any(|word| request.starts_with(word)) {
            return "Command is not allowed due to safety reasons".into();
        }
        let name = |names: &[&'static str], mode: i32| {
            usize::try_from(mode).ok().and_then(|mode| names.get(mode)).copied().unwrap_or("UNKNOWN")
        };
        let known = match request.to_ascii_lowercase().as_str() {
            "power on" => {
                self.power_on(false);
                "Powering on"
            }
            "power off" => {
                self.power_off();
                "Powering off"
            }
            "brake release" => {
                self.power_on(true);
                "Brake releasing"
            }
            "unlock protective stop" => {
                if self.unlock() {
                    "Protective stop releasing"
                } else {
                    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop \
                     before unlocking"
                }
            }
            "close safety popup" => "closing safety popup",
            "close popup" => "closing popup",
            "restart safety" => {
                self.restart_safety();
                "Restarting safety"
            }
            // Also without a program: the vendor's examples begin with it.
            "stop" => {
                self.stop_program();
                "Stopped"
            }
            "play" => "Failed to execute: play",
            "pause" => "Failed to execute: pause",
            "quit" => "Disconnected",
            "robotmode" => return format!("Robotmode: {}", name(&ROBOT_MODES, self.mode)),
            "safetymode" => return format!("Safetymode: {}", name(&SAFETY_MODES, self.safety_mode())),
            "safetystatus" if !cb3 => return format!("Safetystatus: {}", name(&SAFETY_MODES, self.safety_mode())),
            "running" => {
                return format!("Program running: {}", self.program.is_some() && !self.paused && self.mode > POWER_OFF);
            }
            "programstate" => {
                let state = match (&self.program, self.paused) {
                    (None, _) => "STOPPED",
                    (_, false) => "PLAYING",
                    _ => "PAUSED",
                };
                return format!("{state} {}", self.program_name().unwrap_or("<unnamed>"));
            }
            "polyscopeversion" => {
                let [major, minor, bugfix] = self.version();
                return format!("URSoftware {major}.{minor}.{bugfix}.1106628 (Jan 01 2022)");
            }
            "get robot model" => return family(self.model),
            "get serial number" => return self.serial.clone(),
            "is in remote control" if !cb3 => return self.remote.to_string(),
            _ => return format!("could not understand: '{request}'"),
        };
        known.into()
    }
}

/// The model without its series.
fn family(model: Model) -> String {
    model.name().trim_end_matches('e').replace("8Long", "8_LONG")
}
