//! Modes of the robot and of its safety system, and what they are called.

/// Robot modes.
pub mod robot {
    /// The motors have no power.
    pub const POWER_OFF: i32 = 3;
    /// The motors' supply is on.
    pub const POWER_ON: i32 = 4;
    /// Powered; the brakes hold.
    pub const IDLE: i32 = 5;
    /// Powered; the brakes are released.
    pub const RUNNING: i32 = 7;
}

/// Safety modes.
pub mod safety {
    /// Normal.
    pub const NORMAL: i32 = 1;
    /// Slower, by a safety input or plane.
    pub const REDUCED: i32 = 2;
    /// A protective stop, until it is released.
    pub const PROTECTIVE_STOP: i32 = 3;
    /// Outside the safety limits; only slow motion back.
    pub const RECOVERY: i32 = 4;
    /// A violation of the safety limits.
    pub const VIOLATION: i32 = 8;
    /// A fault of the safety system.
    pub const FAULT: i32 = 9;
}

/// Bits of the robot's status.
pub mod bits {
    /// A program runs. Whether this includes a paused one is not documented.
    pub const PROGRAM_RUNNING: u32 = 1 << 1;
}

/// States of our program.
pub mod program {
    /// Holds.
    pub const HOLDING: i32 = 1;
    /// Decelerates and ends, as ordered.
    pub const STOPPED: i32 = 10;
    /// Decelerates and ends: no orders came.
    pub const SILENT: i32 = 11;
    /// Decelerates and ends: a setpoint was too far away.
    pub const FAR: i32 = 12;
}

/// State of the run time without a program.
pub const STOPPED: u32 = 1;
/// State of the run time of a program that runs.
pub const PLAYING: u32 = 2;
/// State of the run time of a program that is being paused.
pub const PAUSING: u32 = 3;
/// State of the run time of a paused program.
pub const PAUSED: u32 = 4;

/// Returns whether a safety mode lets the arm move.
pub fn moves(mode: i32) -> bool {
    matches!(mode, safety::NORMAL | safety::REDUCED | safety::RECOVERY)
}

/// Returns the name of a robot mode, as the dashboard has it.
pub fn robot_name(mode: i32) -> &'static str {
    match mode {
        -1 => "NO_CONTROLLER",
        0 => "DISCONNECTED",
        1 => "CONFIRM_SAFETY",
        2 => "BOOTING",
        3 => "POWER_OFF",
        4 => "POWER_ON",
        5 => "IDLE",
        6 => "BACKDRIVE",
        7 => "RUNNING",
        8 => "UPDATING_FIRMWARE",
        _ => "UNKNOWN",
    }
}

/// Returns what a safety mode means.
pub fn safety_text(mode: i32) -> &'static str {
    match mode {
        1 => "normal",
        2 => "reduced mode",
        3 => "protective stop",
        4 => "recovery: outside the safety limits",
        5 => "safeguard stop: a safeguard input is open",
        6 => "emergency stop by the system input",
        7 => "emergency stop by the robot's button",
        8 => "violation of a safety limit",
        9 => "fault of the safety system",
        10 => "the joints' identities must be confirmed at the pendant",
        12 => "safeguard stop of the automatic mode",
        13 => "stop by the enabling device of the system",
        14 => "stop by the enabling device of the pendant",
        15..=22 => "stop by a safety interface",
        _ => "unknown safety mode",
    }
}

/// Returns what a known error code means; empty for others, whose text is in the vendor's list.
pub fn code_text(code: i32) -> &'static str {
    match code {
        153 | 157 => "a joint deviates from its commanded motion: collision, or wrong payload",
        204 => "sudden change of the commanded position or velocity",
        210 => "the connection is read-only: the controller is in local mode",
        _ => "",
    }
}
