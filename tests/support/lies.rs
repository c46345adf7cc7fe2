//! What lies between a true arm and the coordinator: wrong readings, of which no message says that they are wrong.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use std::collections::VecDeque;

use dimos::arm::ArmState;
use dimos::joint::{Joints, MAX_DOF};
use dimos::robot::random::Random;

/// What is wrong with the readings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Off by a whole turn.
    TurnLost,
    /// Slips at a constant rate, up to a bound.
    Slip,
    /// Slips without end.
    RunAway,
    /// Slips slowly.
    Creep,
    SignFlipped,
    Swapped,
    FrozenPosition,
    FrozenVelocity,
    Frozen,
    Scaled,
    Noise,
    /// What was true 20 to 200 ms ago, as if it were new.
    Late,
    /// The same message several times.
    Repeated,
    /// Zeros of one joint, or of all.
    Zero,
    /// 1e308, NaN, infinite.
    Huge,
    /// A constant offset.
    Offset,
}

pub const KINDS: [Kind; 16] = [
    Kind::TurnLost,
    Kind::Slip,
    Kind::RunAway,
    Kind::Creep,
    Kind::SignFlipped,
    Kind::Swapped,
    Kind::FrozenPosition,
    Kind::FrozenVelocity,
    Kind::Frozen,
    Kind::Scaled,
    Kind::Noise,
    Kind::Late,
    Kind::Repeated,
    Kind::Zero,
    Kind::Huge,
    Kind::Offset,
];

impl Kind {
    /// Returns whether it is the same all the time: begun before the motors came on, no client can see it in positions.
    pub fn is_constant(self) -> bool {
        matches!(self, Self::TurnLost | Self::SignFlipped | Self::Swapped | Self::Scaled | Self::Zero | Self::Offset)
    }
}

/// How long it lasts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Span {
    /// This many readings.
    Readings(u32),
    /// From then on.
    Always,
    /// On and off, by this many readings.
    OnAndOff(u32),
}

/// When it begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Occasion {
    /// After the first reading.
    Start,
    Enabling,
    Idle,
    /// In a motion of the trial's first task.
    Motion,
    Held,
    Stopping,
    Disabled,
}

pub const OCCASIONS: [Occasion; 7] = [
    Occasion::Start,
    Occasion::Enabling,
    Occasion::Idle,
    Occasion::Motion,
    Occasion::Held,
    Occasion::Stopping,
    Occasion::Disabled,
];

/// One lie about one arm.
#[derive(Debug, Clone)]
pub struct Lie {
    pub kind: Kind,
    pub span: Span,
    pub occasion: Occasion,
    /// Bit per joint.
    joints: u32,
    /// The joint that is swapped with the first one.
    other: usize,
    /// Offset [rad], rate [rad/s], factor, or amplitude [rad].
    figure: f64,
    /// Where a slip ends [rad].
    bound: f64,
    /// Whether velocities agree with the positions.
    consistent: bool,
    /// Whether what the controller commands is read with the same error: one of the adapter, not of an encoder.
    pub of_adapter: bool,
    /// How old, in readings; or how often a message is repeated.
    readings: usize,
    begun: bool,
    told: u32,
    elapsed: f64,
    kept: Option<ArmState>,
    past: VecDeque<ArmState>,
}

impl Lie {
    /// Draws a lie for an arm with `dof` joints and readings every `period` [s].
    pub fn draw(kind: Kind, occasion: Occasion, dof: usize, period: f64, random: &mut Random) -> Self {
        let signed = |random: &mut Random, low: f64, high: f64| {
            let size = random.between(low, high);
            if random.below(2) == 0 { size } else { -size }
        };
        let figure = match kind {
            Kind::TurnLost => std::f64::consts::TAU * if random.below(2) == 0 { 1.0 } else { -1.0 },
            Kind::Slip | Kind::RunAway => signed(random, 0.1, 2.5),
            Kind::Creep => signed(random, 0.005, 0.08),
            Kind::Scaled => [0.5, 0.9, 1.1, 2.0, std::f64::consts::PI / 180.0][random.below(5)],
            Kind::Noise => random.between(0.01, 0.4),
            Kind::Offset => signed(random, 0.02, 0.5),
            Kind::Huge => [1e308, -1e308, f64::NAN, f64::INFINITY, f64::NEG_INFINITY][random.below(5)],
            _ => 0.0,
        };
        let first = random.below(dof);
        let joints = match random.below(6) {
            0 => (1 << dof) - 1,
            1 => 1 << first | 1 << random.below(dof),
            _ => 1 << first,
        };
        let span = match random.below(5) {
            0 => Span::Readings([1, 2, 3, 5, 10][random.below(5)]),
            1 => Span::OnAndOff(1 + random.below(20) as u32),
            _ => Span::Always,
        };
        Self {
            kind,
            span,
            occasion,
            joints,
            other: (first + 1 + random.below(dof.max(2) - 1)) % dof,
            figure,
            bound: random.between(0.1, 1.0),
            consistent: random.below(2) == 0,
            of_adapter: random.below(2) == 0,
            readings: (random.between(0.02, 0.2) / period).ceil() as usize,
            begun: false,
            told: 0,
            elapsed: 0.0,
            kept: None,
            past: VecDeque::new(),
        }
    }

    /// It begins with the next reading.
    pub fn begin(&mut self) {
        self.begun = true;
    }

    pub fn has_begun(&self) -> bool {
        self.begun
    }

    /// Returns whether the reading is wrong now.
    pub fn is_told(&self) -> bool {
        self.begun
            && match self.span {
                Span::Readings(n) => self.told <= n,
                Span::Always => true,
                Span::OnAndOff(n) => (self.told / n).is_multiple_of(2),
            }
    }

    /// Returns the rate of a slip that looks like rest [rad/s]; 0 of all else.
    pub fn slow_rate(&self) -> f64 {
        let slips = matches!(self.kind, Kind::Slip | Kind::RunAway | Kind::Creep);
        if slips && self.figure.abs() <= 0.12 { self.figure.abs() } else { 0.0 }
    }

    /// Returns it in words, for a report.
    pub fn text(&self) -> String {
        format!(
            "{:?} {:.4} of joints {:b} (other {}), {:?}, {} readings, bound {:.2}, velocities {}{}",
            self.kind,
            self.figure,
            self.joints,
            self.other,
            self.span,
            self.readings,
            self.bound,
            if self.consistent { "agree" } else { "do not agree" },
            if self.of_adapter { ", of the adapter" } else { "" },
        )
    }

    pub fn first_joint(&self) -> usize {
        self.joints.trailing_zeros() as usize
    }

    /// Returns what is reported instead of a true reading. `dt`: time since the one before [s].
    pub fn tell(&mut self, truth: &ArmState, dt: f64, random: &mut Random) -> ArmState {
        self.past.push_back(*truth);
        if self.past.len() > self.readings + 1 {
            self.past.pop_front();
        }
        if self.begun {
            self.told += 1;
            self.elapsed += dt;
        }
        if !self.is_told() {
            return *truth;
        }
        let mut said = *truth;
        let kept = *self.kept.get_or_insert(*truth);
        match self.kind {
            Kind::Late => {
                if let Some(old) = self.past.front() {
                    (said.position, said.velocity) = (old.position, old.velocity);
                }
            }
            Kind::Repeated => {
                // With a new number and time, or as it was.
                if (self.told as usize).is_multiple_of(self.readings.min(20) + 1) {
                    self.kept = Some(*truth);
                } else {
                    let times = if self.consistent { (truth.seq, truth.stamp) } else { (kept.seq, kept.stamp) };
                    (said.position, said.velocity) = (kept.position, kept.velocity);
                    (said.seq, said.stamp) = times;
                }
            }
            _ => {
                self.change(&mut said.position, &mut said.velocity, &kept, random);
                if self.of_adapter
                    && self.kind.is_constant()
                    && let Some(own) = &mut said.commanded
                {
                    self.change(&mut own.position, &mut own.velocity, &kept, random);
                }
            }
        }
        said
    }

    fn change(&self, q: &mut Joints, v: &mut Joints, kept: &ArmState, random: &mut Random) {
        let (first, truth) = (self.first_joint(), *q);
        if self.kind == Kind::Swapped {
            q.swap(first, self.other);
            v.swap(first, self.other);
            return;
        }
        for j in (0..MAX_DOF).filter(|j| self.joints >> j & 1 == 1) {
            let slipped = self.figure * self.elapsed;
            match self.kind {
                Kind::TurnLost | Kind::Offset => q[j] += self.figure,
                Kind::Slip => {
                    q[j] += slipped.clamp(-self.bound, self.bound);
                    v[j] += if self.consistent && slipped.abs() < self.bound { self.figure } else { 0.0 };
                }
                Kind::RunAway | Kind::Creep => {
                    q[j] += slipped;
                    v[j] += if self.consistent { self.figure } else { 0.0 };
                }
                Kind::SignFlipped => (q[j], v[j]) = (-q[j], -v[j]),
                Kind::FrozenPosition => q[j] = kept.position[j],
                Kind::FrozenVelocity => v[j] = kept.velocity[j],
                Kind::Frozen => (q[j], v[j]) = (kept.position[j], kept.velocity[j]),
                Kind::Scaled => (q[j], v[j]) = (q[j] * self.figure, v[j] * self.figure),
                Kind::Noise => q[j] += random.between(-1.0, 1.0) * self.figure,
                Kind::Zero => (q[j], v[j]) = (0.0, 0.0),
                Kind::Huge => q[j] = self.figure,
                Kind::Late | Kind::Repeated | Kind::Swapped => {}
            }
        }
        // Without velocities that agree: those of a joint at rest.
        if !self.consistent && matches!(self.kind, Kind::SignFlipped | Kind::Scaled) {
            let told = |j: &usize| self.joints >> j & 1 == 1 && q[*j] != truth[*j];
            (0..MAX_DOF).filter(told).for_each(|j| v[j] = 0.0);
        }
    }
}
