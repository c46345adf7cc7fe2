//! Where an arm is when its motors are to come on: the only time at which goals are made of measured positions.

use std::time::Duration;

use super::adapter::So101Adapter;
use super::bus::servo as name_of;
use super::calibration::{NAMES, Range};
use super::protocol::{SERVOS, Servo, TURN};
use super::seam::{LOW_TORQUE, way_back};
use super::{DOF, SPEC};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{AdapterError, AdapterResult};

/// Readings agree for this long before they are believed; where no motion led to them, for longer.
const AGREED: Duration = Duration::from_millis(50);
const LEAPT: Duration = Duration::from_millis(250);
/// How long they may take to do so.
const TIMEOUT: Duration = Duration::from_millis(500);
/// Time between two of them.
const PERIOD: Duration = Duration::from_millis(8);
/// A joint at rest moves by less than this [counts], and is slower than this [counts/s]: encoders flicker, and the hand
/// that holds a limp arm is not quite still.
const SPREAD: i32 = 12;
const SLOW: i32 = 60;
/// A goal this far from the joint is that joint's position [counts].
const SAME: i32 = 3;
/// How far outside its range a joint may rest [counts]: its servo takes it to the end.
const OUTSIDE: i32 = (SPEC.outside * TURN / std::f64::consts::TAU) as i32;
/// Below this the servos answer, but have no force [0.1 V].
const LOWEST_VOLTAGE: u8 = 55;

/// Lowest and highest position of each servo [counts] since a time.
struct Window {
    since: Mono,
    ends: [(i32, i32); SERVOS],
}

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
        for (id, _) in (1..).zip(&servos).filter(|(_, servo)| servo.torque_limit == LOW_TORQUE) {
            self.restore_torque(id)?;
        }
        (self.gripper_goal, self.relieved) = (None, [None; SERVOS]);
        self.write_goals(goals)?;
        self.write_torque(true)
    }

    /// Reads until the positions of the servos whose motors are off agree for a while, at rest. Returns the last state,
    /// and these positions.
    fn agreed(&mut self) -> AdapterResult<([Servo; SERVOS], [i32; SERVOS])> {
        let end = MonotonicClock.now().after(TIMEOUT);
        let mut window: Option<Window> = None;
        let mut odd = None;
        loop {
            let servos = self.fetch()?;
            let (now, positions) = (MonotonicClock.now(), self.seams.positions);
            let open = window.get_or_insert(Window { since: now, ends: positions.map(|at| (at, at)) });
            for ((low, high), at) in open.ends.iter_mut().zip(positions) {
                (*low, *high) = ((*low).min(at), (*high).max(at));
            }
            let ends = open.ends;
            let moves = |j: usize, servo: &Servo| {
                ends.get(j).is_none_or(|(low, high)| high - low > SPREAD) || servo.velocity.abs() > SLOW
            };
            let wrong =
                |(j, servo): &(usize, &Servo)| !servo.on && (moves(*j, servo) || !self.seams.turns(*j).accepted());
            let leapt = servos.iter().enumerate().any(|(j, servo)| !servo.on && self.seams.turns(j).leapt());
            let long = if leapt { LEAPT } else { AGREED };
            match servos.iter().enumerate().find(wrong) {
                Some((j, _)) => (odd, window) = (Some((j, ends.get(j).copied().unwrap_or_default())), None),
                None if now.since(open.since) >= long => {
                    return Ok((servos, ends.map(|(low, high)| (low + high) / 2)));
                }
                None => {}
            }
            if now >= end {
                let (j, (low, high)) = odd.unwrap_or_default();
                return Err(self.disagreement(j, low, high));
            }
            std::thread::sleep(PERIOD);
        }
    }

    /// The readings of servo `j` do not agree: they are between these positions [counts].
    fn disagreement(&self, j: usize, low: i32, high: i32) -> AdapterError {
        let range = self.range(j);
        let degrees = |counts: i32| range.angle(counts).to_degrees();
        AdapterError::Rejected(format!(
            "{} moves, or its positions and its velocity contradict each other ({:.1}° to {:.1}°): not enabled\nhint: \
             keep the arm still; where a position is wrong, look at the cables, and move that joint a little by hand",
            name_of(j as u8 + 1),
            degrees(low),
            degrees(high),
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
