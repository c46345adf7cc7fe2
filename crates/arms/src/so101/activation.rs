//! Where an arm is when its motors are to come on: the only time at which goals are made of measured positions.

use std::time::Duration;

use super::adapter::So101Adapter;
use super::calibration::{NAMES, Range};
use super::protocol::{SERVOS, Servo, TURN};
use super::seam::{LOW_TORQUE, way_back};
use super::turns::Turns;
use super::{DOF, SPEC};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// Readings agree for this long before they are believed; where no motion led to them, for longer.
const AGREED: Duration = Duration::from_millis(50);
const LEAPT: Duration = Duration::from_millis(250);
/// How long they may take to do so.
const TIMEOUT: Duration = Duration::from_millis(500);
/// Time between two of them.
const PERIOD: Duration = Duration::from_millis(8);
/// A goal this far from the joint is that joint's position [counts].
const SAME: i32 = 3;
/// How far outside its range a joint may rest [counts]: its servo takes it to the end.
const OUTSIDE: i32 = (SPEC.outside * TURN / std::f64::consts::TAU) as i32;
/// Below this the servos answer, but have no force [0.1 V].
const LOWEST_VOLTAGE: u8 = 55;

impl So101Adapter {
    /// Switches the motors on where the arm is. A servo goes to its goal when its motor comes on, so each goal is set
    /// before that; motors that are on keep theirs.
    pub(super) fn enable(&mut self) -> AdapterResult<()> {
        let servos = self.fetch()?;
        if servos.iter().all(|servo| servo.on) {
            return Ok(());
        }
        if let Some(servo) = servos.iter().find(|servo| servo.voltage < LOWEST_VOLTAGE) {
            let volts = f64::from(servo.voltage) * 0.1;
            return Err(AdapterError::Rejected(format!(
                "so101: the servos have {volts:.1} V\nhint: switch the arm's power supply on; USB gives them no force"
            )));
        }
        let (servos, positions) = self.agreed()?;
        let mut goals = servos.map(|servo| servo.goal);
        for (j, (goal, servo)) in goals.iter_mut().zip(&servos).enumerate().filter(|(_, (_, servo))| !servo.on) {
            *goal = hold_goal(j, self.range(j), positions.get(j).copied().unwrap_or(servo.position))?;
        }
        for (id, _) in self.bus.ids().zip(&servos).filter(|(_, servo)| servo.torque_limit == LOW_TORQUE) {
            self.restore_torque(id)?;
        }
        (self.gripper_goal, self.relieved) = (None, [None; SERVOS]);
        self.write_goals(goals)?;
        self.write_torque(true)
    }

    /// Reads until all positions of the servos whose motors are off are accepted for a while: what moves is explained
    /// by its velocity, as of an arm that falls. Returns the last state, and these positions.
    fn agreed(&mut self) -> AdapterResult<([Servo; SERVOS], [i32; SERVOS])> {
        let end = MonotonicClock.now().after(TIMEOUT);
        let (mut since, mut odd) = (None, None);
        loop {
            let servos = self.fetch()?;
            let now = MonotonicClock.now();
            let off = |wrong: fn(&Turns) -> bool| {
                let each = servos.iter().enumerate().filter(|(_, servo)| !servo.on);
                { each }.map(|(j, _)| j).find(|j| wrong(&self.seams.turns(*j)))
            };
            let long = if off(Turns::leapt).is_some() { LEAPT } else { AGREED };
            match off(|turns| !turns.accepted()) {
                Some(j) => (odd, since) = (Some((j, self.seams.turns(j).at())), None),
                None if now.since(*since.get_or_insert(now)) >= long => return Ok((servos, self.seams.positions)),
                None => {}
            }
            if now >= end {
                let (j, before) = odd.unwrap_or_default();
                return Err(self.disagreement(j, before));
            }
            std::thread::sleep(PERIOD);
        }
    }

    /// The readings of servo `j`, which was here [counts], do not agree.
    fn disagreement(&self, j: usize, before: i32) -> AdapterError {
        let range = self.range(j);
        let degrees = |counts: i32| range.angle(counts).to_degrees();
        let now = self.seams.positions.get(j).copied().unwrap_or_default();
        AdapterError::Rejected(format!(
            "the positions of {} contradict each other or its velocity ({:.1}° and {:.1}°): not enabled\nhint: keep the \
             arm still, and look at the cables",
            self.bus.servo(self.bus.first() + j as u8),
            degrees(before),
            degrees(now),
        ))
    }
}

/// Returns the goal at which servo `j` stays [counts]. A joint outside its range would go to the end of it; a joint
/// beside its seam could end on the other side.
pub(super) fn hold_goal(j: usize, range: Range, position: i32) -> AdapterResult<i32> {
    let goal = position.max(range.low).min(range.high);
    let at_seam = goal != range.registers.0 && goal != range.registers.1;
    let tolerance = if at_seam { SAME } else { OUTSIDE };
    match way_back(position, range) {
        Some((back, by)) if by > tolerance && j < DOF => Err(AdapterError::Rejected(format!(
            "joint {} ({}) is {:.1}° outside its range{}\nhint: {back} by hand, or calibrate the arm",
            j + 1,
            NAMES.get(j).copied().unwrap_or_default(),
            f64::from(by) * 360.0 / TURN,
            if at_seam { ", beside the seam of its encoder" } else { "" },
        ))),
        _ => Ok(goal),
    }
}
