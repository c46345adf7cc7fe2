//! What no wire may ever carry, whatever happened to it.

use dimos::clock::Mono;

use super::{What, WireCommand};

/// Limits of an arm, and how its setpoints come.
#[derive(Debug, Clone)]
pub struct Bounds {
    /// Top speeds of the joints [rad/s].
    pub velocity: Vec<f64>,
    /// [rad/s²]
    pub acceleration: Vec<f64>,
    /// The longer of the tick's and the arm's write period [s].
    pub period: f64,
    /// What a setpoint is rounded to on the wire [rad].
    pub rounding: f64,
    /// Age limit of a state [s].
    pub stale_after: f64,
    /// It is stopped by a setpoint this close to where it is [rad], whatever was commanded before.
    pub stopped_within: Option<f64>,
    /// In velocity mode the arm stops after this time without a setpoint [s].
    pub time_limit: Option<f64>,
}

/// The window in which an arm may travel no further than its top speed allows [s].
pub const WINDOW: f64 = 0.05;
/// What is noted of times is this uncertain [s].
const CLOCK: f64 = 1e-3;

/// Setpoints of one kind that follow one another: without a change of mode or new torque between them.
fn chains(commands: &[WireCommand], values: fn(&What) -> Option<&Vec<f64>>) -> Vec<Vec<(Mono, &Vec<f64>)>> {
    let (mut chains, mut mode) = (vec![Vec::new()], None);
    for one in commands {
        let breaks = match &one.what {
            What::Enable(_) | What::Planned(_) => true,
            What::Mode(new) => mode.replace(new.clone()).is_some_and(|old| old != *new),
            _ => false,
        };
        match values(&one.what) {
            Some(values) => chains.last_mut().unwrap().push((one.at, values)),
            None if breaks => chains.push(Vec::new()),
            None => {}
        }
    }
    chains
}

pub fn position(what: &What) -> Option<&Vec<f64>> {
    match what {
        What::Position(values) => Some(values),
        _ => None,
    }
}

pub fn velocity(what: &What) -> Option<&Vec<f64>> {
    match what {
        What::Velocity(values) => Some(values),
        _ => None,
    }
}

/// Where a rule was broken worst.
#[derive(Debug, Clone, Copy, Default)]
struct Worst {
    /// Of what is allowed.
    share: f64,
    joint: usize,
    found: f64,
    allowed: f64,
    at: Mono,
}

impl Worst {
    fn look(&mut self, joint: usize, at: Mono, found: f64, allowed: f64) {
        let share = found / allowed;
        if share > self.share {
            *self = Self { share, joint, found, allowed, at };
        }
    }

    fn verdict(self, rule: &str, unit: &str, since: Mono) -> Result<(), String> {
        let Self { joint, found, allowed, at, .. } = self;
        match self.share <= 1.0 {
            true => Ok(()),
            false => Err(format!(
                "{rule}: joint {}: {found:.4} {unit}, allowed {allowed:.4}, {:.1} ms after the stall began",
                joint + 1,
                at.seconds_since(since) * 1e3
            )),
        }
    }
}

impl Bounds {
    /// The position setpoints that follow one another. One that stops the arm where it is begins a new sequence.
    fn positions<'a>(&self, commands: &'a [WireCommand]) -> Vec<Vec<(Mono, &'a Vec<f64>)>> {
        let stops = |one: &WireCommand| match (position(&one.what), &one.truth, self.stopped_within) {
            (Some(commands), Some(truth), Some(most)) => commands.iter().zip(truth).all(|(a, b)| (a - b).abs() <= most),
            _ => false,
        };
        // Its stop at full speed may be measured by frames that waited in the stall: then the last setpoint of all goes
        // back towards the arm, and stays.
        let last = commands.iter().rev().find_map(|one| position(&one.what));
        let stays = |one: &WireCommand| {
            let after = commands.iter().filter(|later| later.at >= one.at).filter_map(|later| position(&later.what));
            position(&one.what).is_some() && after.into_iter().all(|values| Some(values) == last)
        };
        let nearer =
            |before: &WireCommand, one: &WireCommand| match (position(&before.what), position(&one.what), &one.truth) {
                (Some(from), Some(to), Some(truth)) if self.stopped_within.is_some() => {
                    let mut joints = from.iter().zip(to).zip(truth);
                    joints.all(|((from, to), truth)| (to - truth).abs() <= (from - truth).abs() + self.rounding)
                }
                _ => false,
            };
        let mut all = Vec::new();
        for part in commands.chunk_by(|one, next| !(stops(next) || (nearer(one, next) && stays(next)))) {
            all.extend(chains(part, position));
        }
        all
    }

    /// Neighbouring setpoints: at most two periods at top speed apart; in velocity mode, at most acceleration.
    pub fn neighbours(&self, commands: &[WireCommand], since: Mono) -> Result<(), String> {
        let mut worst = Worst::default();
        for chain in self.positions(commands) {
            for pair in chain.windows(2) {
                for (j, (a, b)) in pair[0].1.iter().zip(pair[1].1).enumerate() {
                    let most = self.velocity[j] * self.period * 2.0 + self.rounding;
                    worst.look(j, pair[1].0, (b - a).abs(), most);
                }
            }
        }
        worst.verdict("neighbouring setpoints", "rad", since)?;
        let mut worst = Worst::default();
        for chain in chains(commands, velocity) {
            for pair in chain.windows(2) {
                // An arm that its controller has stopped meanwhile may begin at rest.
                let silence = pair[1].0.seconds_since(pair[0].0);
                let stopped = self.time_limit.is_some_and(|limit| silence > limit);
                for (j, (a, b)) in pair[0].1.iter().zip(pair[1].1).enumerate() {
                    let most = self.acceleration[j] * self.period * 2.0 + self.rounding;
                    worst.look(j, pair[1].0, if stopped { b.abs().min((b - a).abs()) } else { (b - a).abs() }, most);
                }
            }
        }
        worst.verdict("neighbouring velocities", "rad/s", since)
    }

    /// The way within any 50 ms: at top speed, and two periods.
    pub fn windows(&self, delivered: &[WireCommand], since: Mono) -> Result<(), String> {
        let mut worst = Worst::default();
        for chain in self.positions(delivered) {
            let steps: Vec<(Mono, Vec<f64>)> = chain
                .windows(2)
                .map(|pair| (pair[1].0, pair[0].1.iter().zip(pair[1].1).map(|(a, b)| (b - a).abs()).collect()))
                .collect();
            for (i, (end, _)) in steps.iter().enumerate() {
                let inside = steps[..=i].iter().rev().take_while(|(at, _)| end.seconds_since(*at) < WINDOW - CLOCK);
                let mut way = vec![0.0; self.velocity.len()];
                inside.for_each(|(_, step)| way.iter_mut().zip(step).for_each(|(sum, s)| *sum += s));
                for (j, way) in way.into_iter().enumerate() {
                    let most = self.velocity[j] * (WINDOW + 2.0 * self.period) + 10.0 * self.rounding;
                    worst.look(j, *end, way, most);
                }
            }
        }
        worst.verdict("the way within 50 ms", "rad", since)
    }

    /// How far an arm may still go after the last setpoint before a stall that it is held for [rad].
    pub fn stopping(&self, joint: usize, delay: f64) -> f64 {
        let (v, a) = (self.velocity[joint], self.acceleration[joint]);
        v * (delay + 2.0 * self.period) + v * v / (2.0 * a)
    }

    /// Where setpoints go after a stall that the arm is held for.
    pub fn travel(&self, delivered: &[WireCommand], began: Mono) -> Result<(), String> {
        let mut worst = Worst::default();
        let last = delivered.iter().rev().filter(|t| t.at < began).find_map(|t| Some((t.at, position(&t.what)?)));
        let Some((at, last)) = last else { return Ok(()) };
        // Counted from where the setpoints were when the stall began, after the last of them.
        let delay = self.stale_after + began.seconds_since(at).min(self.period);
        for one in delivered.iter().filter(|t| t.at >= began) {
            for (j, (a, b)) in last.iter().zip(position(&one.what).unwrap_or(last)).enumerate() {
                worst.look(j, one.at, (b - a).abs(), self.stopping(j, delay) + self.rounding);
            }
        }
        worst.verdict("the way after a stall", "rad", began)
    }

    /// How long after a moment setpoints still moved [s].
    pub fn moved_for(&self, sent: &[WireCommand], began: Mono) -> f64 {
        let points: Vec<(Mono, &Vec<f64>)> = sent.iter().filter_map(|t| Some((t.at, position(&t.what)?))).collect();
        let moves = |pair: &[(Mono, &Vec<f64>)]| pair[0].1.iter().zip(pair[1].1).any(|(a, b)| (a - b).abs() > 1e-4);
        let last = points.windows(2).rev().find(|pair| moves(pair));
        last.map_or(0.0, |pair| pair[1].0.seconds_since(began))
    }

    /// How far the arm itself went.
    pub fn went(&self, from: &[f64], to: &[f64], delay: f64, slack: f64, since: Mono) -> Result<(), String> {
        let mut worst = Worst::default();
        for (j, (a, b)) in from.iter().zip(to).enumerate() {
            worst.look(j, since, (b - a).abs(), self.stopping(j, delay) + slack);
        }
        worst.verdict("the way of the arm itself", "rad", since)
    }
}
