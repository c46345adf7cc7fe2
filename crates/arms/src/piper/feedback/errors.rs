//! Error codes and texts from the arm's feedback.

use super::super::protocol::{DOF, Driver, Status, arm_text, driver_text, gripper_text};
use super::Feedback;

impl Feedback {
    /// Returns the most severe error: 1–15 and above a state of the arm, 201–206 a joint that does not answer, 101–106
    /// a joint beyond its limits, 3jb bit b of the driver of joint j, 40b bit b of the gripper; 0 = none.
    pub fn error_code(&self) -> i32 {
        let bit = |bits: u8| bits.trailing_zeros() as i32 + 1;
        let Status { arm, limits, silent, .. } = self.status;
        if !matches!(arm, 0 | 11..=13) {
            return arm.into();
        }
        if silent != 0 {
            return 200 + bit(silent);
        }
        if limits != 0 {
            return 100 + bit(limits);
        }
        let driver = self.driver_errors().map(|(joint, bit, _)| 300 + 10 * joint as i32 + i32::from(bit)).next();
        driver.or_else(|| self.gripper_errors().next().map(|(bit, _)| 400 + i32::from(bit))).unwrap_or(0)
    }

    /// Returns the text of all errors; empty without an error.
    pub fn error_text(&self) -> String {
        if self.error_code() == 0 {
            return String::new();
        }
        let mut parts = Vec::new();
        if !matches!(self.status.arm, 0 | 11..=13) {
            parts.push(arm_text(self.status.arm).to_owned());
        }
        for joint in 1..=DOF {
            let has = |bits: u8| bits & (1 << (joint - 1)) != 0;
            if has(self.status.silent) {
                parts.push(format!("joint {joint} does not answer"));
            }
            if has(self.status.limits) {
                parts.push(format!("joint {joint} beyond its limits"));
            }
        }
        parts.extend(self.driver_errors().map(|(joint, bit, driver)| {
            let what = driver_text(bit).unwrap_or_default();
            match bit {
                0 => format!("joint {joint}: {what} ({:.1} V)", f64::from(driver.voltage) / 10.0),
                1 => format!("joint {joint}: {what} ({} °C)", driver.motor_temperature),
                3 => format!("joint {joint}: {what} ({} °C)", driver.driver_temperature),
                _ => format!("joint {joint}: {what}"),
            }
        }));
        parts.extend(self.gripper_errors().map(|(_, what)| format!("gripper: {what}")));
        parts.join("; ")
    }

    /// Returns joint (from 1), bit and driver of every error that a driver reports.
    fn driver_errors(&self) -> impl Iterator<Item = (usize, u8, &Driver)> {
        self.drivers.iter().enumerate().flat_map(|(i, driver)| {
            let errors = (0..8).filter(|bit| driver.status & (1 << bit) != 0 && driver_text(*bit).is_some());
            errors.map(move |bit| (i + 1, bit, driver))
        })
    }

    /// Returns bit and text of every error of the gripper, if it is used.
    pub fn gripper_errors(&self) -> impl Iterator<Item = (u8, &'static str)> {
        let status = self.gripper.filter(|_| self.gripper_used).map_or(0, |gripper| gripper.status);
        (0..8).filter(move |bit| status & (1 << bit) != 0).filter_map(|bit| Some((bit, gripper_text(bit)?)))
    }
}
