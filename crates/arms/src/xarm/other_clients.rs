//! What another client of the controller changed, in words. The controller serves any number of clients: the vendor's
//! Studio, its SDK, a teach pendant. What they change is reported and never undone.

use super::mode::is_ready;
use super::session::Session;

impl Session {
    /// What another client changed since this run made the arm ready. `None` also while it is not known yet whether the
    /// device itself is the cause, and when it is: then there is an error.
    pub fn foreign_change(&self) -> Option<&'static str> {
        let ordered = self.foreign?;
        let condition = self.condition();
        if condition.changed || condition.error != 0 {
            return None;
        }
        Some(match (self.motion.state, self.motion.mode) {
            (_, mode) if mode != ordered => changed_mode(mode),
            _ if !self.enabled() => "another client disabled the motors",
            (3, _) => "another client paused the arm (state 3)",
            (5, _) => "another client reset the arm (state 5)",
            (state, _) if is_ready(state) => "another client stopped the arm and made it ready again",
            _ => "another client stopped the arm (state 4)",
        })
    }
}

fn changed_mode(mode: u8) -> &'static str {
    match mode {
        0 => "another client changed the mode to 0 (position)",
        1 => "another client changed the mode to 1 (servo)",
        2 => "another client changed the mode to 2 (manual guiding)",
        4 => "another client changed the mode to 4 (joint velocity)",
        5 => "another client changed the mode to 5 (cartesian velocity)",
        6 => "another client changed the mode to 6 (online joint trajectory)",
        7 => "another client changed the mode to 7 (online cartesian trajectory)",
        _ => "another client changed the mode",
    }
}
