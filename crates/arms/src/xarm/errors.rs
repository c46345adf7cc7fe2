//! Texts of the error codes of the controller, the joints and the gripper, with what to do. Numbers as in the vendor's
//! manual; the wording is ours.

/// Returns the text of a controller error of register 15; empty for 0.
pub fn error_text(code: u8) -> &'static str {
    match code {
        0 => "",
        1 => "the E-stop button is pressed; release it, then clear the error",
        2 => "the E-stop input of the control box is open; close it, then clear the error",
        3 => "the button of the three-position switch is pressed; release it, then clear the error",
        10 => "a joint's servo reports an error",
        11 => "the servo of joint 1 reports an error",
        12 => "the servo of joint 2 reports an error",
        13 => "the servo of joint 3 reports an error",
        14 => "the servo of joint 4 reports an error",
        15 => "the servo of joint 5 reports an error",
        16 => "the servo of joint 6 reports an error",
        17 => "the servo of joint 7 reports an error",
        18 => "the force/torque sensor does not answer; is it fitted and plugged in?",
        19 => "the device at the tool flange does not answer; is it fitted, and its baud rate right?",
        21 => "the kinematics have no solution; plan another way",
        22 => "the arm would collide with itself; plan another way",
        23 => "a joint is beyond its limit",
        24 => "a joint is commanded faster than it may go; smooth or slow down the motion",
        25 => "the move cannot be planned; take another way or a lower speed",
        26 => "the controller missed its real-time deadline",
        27 => "a command got no answer inside the controller",
        28 => "the tool board does not answer; switch the control box off and on",
        29 => "an error that the controller does not name",
        30 => "the measured speed is too high",
        31 => "a collision: a motor takes an abnormal current; check the way, the payload and the sensitivity",
        32 => "the arc cannot be computed from its three points",
        33 => "the inputs and outputs of the control box do not answer",
        34 => "the recording of a trajectory took too long",
        35 => "the arm reached its fence",
        36 => "too many delayed commands",
        37 => "abnormal motion in manual mode; check payload and mounting",
        38 => "a joint angle is not believable; switch the control box off",
        39 => "the power board does not answer",
        40 => "the joint trajectory has no solution; take another position",
        41 => "the friction file is not valid; switch the control box off and on",
        42 => "the calibration file is not valid; switch the control box off and on",
        50 => "the force/torque sensor cannot be read",
        51 => "the mode of the force/torque sensor cannot be set",
        52 => "the zero of the force/torque sensor cannot be set",
        53 => "the force/torque sensor is overloaded or out of range",
        60 => "setpoints move the tool faster than its limit; slow down the motion",
        110 => "the base board of the arm does not answer",
        111 => "the device at the control box's RS485 does not answer",
        _ => "an error that the manual does not list",
    }
}

/// Returns the text of a controller warning of register 15; empty for 0.
pub fn warning_text(code: u8) -> &'static str {
    match code {
        0 => "",
        11 => "its command queue is full",
        12 => "a parameter is wrong",
        13 => "it does not know the command",
        14 => "the command has no solution",
        15 => "its queue of RS485 commands is full",
        _ => "a warning that the manual does not list",
    }
}

/// Returns the text of a joint servo's error; empty for 0.
pub fn servo_text(code: u8) -> &'static str {
    match code {
        0 => "",
        10 => "current sensing failed",
        11 => "over-current",
        12 => "over-speed",
        14 => "the position command is too far away",
        15 => "over-temperature",
        16 => "the encoder could not be initialized",
        17 => "single-turn encoder error",
        18 => "multi-turn encoder error",
        19 => "the encoder's battery is low",
        20 => "driver hardware error",
        21 => "the driver could not be initialized",
        22 => "the encoder is not configured",
        23 => "following error too large; is the arm blocked or overloaded?",
        26 => "beyond the upper limit",
        27 => "beyond the lower limit",
        28 => "commanded while disabled",
        33 => "driver overload",
        34 => "motor overload",
        35 => "wrong motor type",
        36 => "wrong driver type",
        39 => "over-voltage",
        40 => "under-voltage",
        49 => "memory error",
        52 => "the motor angle could not be initialized",
        58 => "no torque command came in time",
        _ => "an error that the manual does not list",
    }
}

/// Returns the text of a gripper's error; empty for 0.
pub fn gripper_text(code: u16) -> &'static str {
    match code {
        0 => "",
        9 => "current sensing failed",
        11 => "over-current",
        12 => "over-speed",
        14 => "the position command is too far away",
        15 | 49 => "memory error",
        20 => "driver hardware error",
        21 => "the driver could not be initialized",
        23 => "following error too large; is it blocked?",
        25 => "commanded beyond its limit",
        26 => "beyond its limit",
        33 => "driver overload",
        34 => "motor overload",
        36 => "wrong driver type",
        _ => "an error that the manual does not list",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_of_the_manual_has_a_text() {
        let unknown = "an error that the manual does not list";
        let unknown_warning = "a warning that the manual does not list";
        let controller = (1..=3).chain(10..=19).chain(21..=42).chain(50..=53).chain([60, 110, 111]);
        for code in controller {
            assert!(!error_text(code).is_empty() && error_text(code) != unknown, "error {code}");
        }
        for code in 11..=15 {
            assert!(!warning_text(code).is_empty() && warning_text(code) != unknown_warning, "warning {code}");
        }
        for code in [10, 11, 12, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 26, 27, 28, 33, 34, 35, 36, 39, 40, 49, 52, 58]
        {
            assert_ne!(servo_text(code), unknown, "servo {code}");
        }
        assert_eq!((error_text(0), warning_text(0), servo_text(0), gripper_text(0)), ("", "", "", ""));
        assert_eq!((error_text(4), warning_text(10)), (unknown, unknown_warning));
    }
}
