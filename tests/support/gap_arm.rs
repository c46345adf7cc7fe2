//! What each arm's controller does while no setpoint comes, from the vendors' protocols, in steps of a millisecond.
//! Shares nothing with `dimos::control`. Without noise and droop: what it does beside the path is its reaction.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use super::arm_rows::Row;

/// Step [s].
pub const STEP: f64 = 0.001;
/// Lost commands of a millisecond that Franka's controller extrapolates; the next one ends the motion.
const FRANKA_LOST: f64 = 0.019;
/// The arm's own limit of acceleration, beside that of the row: 10 to 7 rad/s².
const FRANKA_MARGIN: f64 = 1.43;
/// How our program on a UR controller decelerates after its tolerance [rad/s²].
const UR_DECELERATION: f64 = 8.0;

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Silence {
    /// Franka: constant acceleration, then it brakes each joint and reports an error.
    Extrapolates,
    /// UR: keeps the velocity, then decelerates along it, and waits.
    KeepsVelocity,
    /// xArm, YourArm, remote: at the last point. Piper, SO-101: continues to the last goal, which is the same
    /// for setpoints of one period.
    Rests,
}

#[derive(Debug, Clone)]
pub struct GapArm {
    pub silence: Silence,
    /// Longest silence that a UR bridges, counted from a setpoint [s].
    bridges: f64,
    period: f64,
    /// Time constant of the drives, the same for all [s].
    tau: f64,
    brake: Vec<f64>,
    /// The controller's own command.
    pub r: Vec<f64>,
    pub v: Vec<f64>,
    a: Vec<f64>,
    /// Velocity of the setpoints.
    pace: Vec<f64>,
    from: Vec<f64>,
    to: Vec<f64>,
    /// The joints.
    pub q: Vec<f64>,
    pub dq: Vec<f64>,
    since: f64,
    pub error: i32,
}

impl GapArm {
    /// Behind setpoints every `period` [s], at rest.
    pub fn new(row: &Row, q: &[f64], period: f64) -> Self {
        let silence = match row.name {
            "franka" => Silence::Extrapolates,
            "ur" => Silence::KeepsVelocity,
            _ => Silence::Rests,
        };
        Self {
            silence,
            bridges: row.arm.supervision.gap_tolerance.as_secs_f64().max(2.0 * period),
            period,
            tau: 0.4 * row.arm.supervision.lag,
            brake: row.arm.limits.acceleration_max.clone(),
            r: q.to_vec(),
            v: vec![0.0; q.len()],
            a: vec![0.0; q.len()],
            pace: vec![0.0; q.len()],
            from: q.to_vec(),
            to: q.to_vec(),
            q: q.to_vec(),
            dq: vec![0.0; q.len()],
            since: 1.0,
            error: 0,
        }
    }

    /// A setpoint arrives. The controller is there a period later.
    pub fn write(&mut self, values: &[f64]) {
        for (j, value) in values.iter().enumerate() {
            let v = (value - self.r[j]) / self.period;
            self.a[j] = (v - self.pace[j]) / self.period;
            self.pace[j] = v;
            // Others follow at once.
            if self.silence != Silence::Extrapolates {
                self.v[j] = v;
            }
        }
        self.from.copy_from_slice(&self.r);
        self.to.copy_from_slice(values);
        self.since = 0.0;
    }

    /// The controller's own stop: it decelerates where it is.
    pub fn stop(&mut self) {
        self.to.copy_from_slice(&self.r);
        self.from.copy_from_slice(&self.r);
        self.v.fill(0.0);
    }

    pub fn is_at_rest(&self) -> bool {
        self.v.iter().all(|v| v.abs() < 1e-6) && self.dq.iter().all(|v| v.abs() < 1e-3)
    }

    pub fn step(&mut self) {
        self.since += STEP;
        let silent = self.since - self.period;
        if silent <= 1e-9 && self.error == 0 {
            let part = (self.since / self.period).min(1.0);
            for j in 0..self.r.len() {
                let at = self.from[j] + part * (self.to[j] - self.from[j]);
                if self.silence == Silence::Extrapolates {
                    self.follow_within_limits(j, at);
                } else {
                    self.r[j] = at;
                }
            }
        } else {
            self.silent_step(silent);
        }
        let share = 1.0 - (-STEP / self.tau.max(1e-4)).exp();
        for j in 0..self.q.len() {
            let step = share * (self.r[j] - self.q[j]);
            self.q[j] += step;
            self.dq[j] = step / STEP;
        }
    }

    /// Franka's client limits each joint on its own: one that cannot stop at its setpoint passes it and returns.
    fn follow_within_limits(&mut self, j: usize, at: f64) {
        let error = at - self.r[j];
        let a = FRANKA_MARGIN * self.brake[j];
        let most = self.pace[j].abs() + (2.0 * a * error.abs()).sqrt();
        let wanted = (error / STEP).clamp(-most, most);
        let change = a * STEP;
        self.v[j] += (wanted - self.v[j]).clamp(-change, change);
        self.r[j] += self.v[j] * STEP;
    }

    fn silent_step(&mut self, silent: f64) {
        match self.silence {
            Silence::Rests => {
                self.r.copy_from_slice(&self.to);
                self.v.fill(0.0);
            }
            Silence::Extrapolates if self.error == 0 && self.v.iter().all(|v| v.abs() < 1e-9) => {}
            Silence::Extrapolates if silent <= FRANKA_LOST + 1e-9 && self.error == 0 => {
                for j in 0..self.r.len() {
                    self.v[j] += self.a[j] * STEP;
                    self.r[j] += self.v[j] * STEP;
                }
            }
            Silence::Extrapolates => {
                self.error = 1;
                for j in 0..self.r.len() {
                    let change = self.brake[j] * STEP;
                    self.v[j] -= self.v[j].clamp(-change, change);
                    self.r[j] += self.v[j] * STEP;
                }
            }
            Silence::KeepsVelocity => {
                // Along the motion: all joints by the same share, the fastest by the deceleration.
                let fastest = self.v.iter().fold(0.0f64, |most, v| most.max(v.abs()));
                let less = (UR_DECELERATION * STEP / fastest.max(1e-12)).min(1.0);
                let share = if self.since <= self.bridges + 1e-9 { 1.0 } else { 1.0 - less };
                for j in 0..self.r.len() {
                    self.v[j] *= share;
                    self.r[j] += self.v[j] * STEP;
                }
            }
        }
    }
}
