//! The rules of the tick and their version: random sequences of requests and disturbances on a virtual clock, with a
//! digest of every command, phase and event that came of them. A change of any of these makes logs of earlier builds
//! verify differently, so it needs a new `CONFIG_VERSION`; then `DIMOS_REGENERATE=1` writes the digests again.

use std::fmt::Write as _;
use std::hash::Hasher;
use std::path::Path;
use std::time::Duration;

use dimos::arm::{GripperInfo, GripperUnit, Interference, Link};
use dimos::control::config::*;
use dimos::control::request::Request;
use dimos::robot::random::Random;
use dimos::telemetry::{Bound, Phase, TaskView};

use crate::support::rig::*;

/// FNV-1a: the same on every machine and with every compiler.
struct Fnv(u64);

impl Hasher for Fnv {
    fn finish(&self) -> u64 {
        self.0
    }
    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3));
    }
}

impl std::fmt::Write for Fnv {
    fn write_str(&mut self, text: &str) -> std::fmt::Result {
        self.write(text.as_bytes());
        Ok(())
    }
}

/// A stream of targets from a client.
#[derive(Debug, Clone, Default)]
struct Stream {
    ticks: usize,
    /// Positions [rad] or velocities [rad/s], and their change per tick.
    target: Vec<f64>,
    step: f64,
}

struct Scenario {
    rig: Rig,
    random: Random,
    streams: Vec<Stream>,
    motion: u64,
}

/// The tasks: number of joints of each and whether it streams velocities; `None` executes trajectories.
const TASKS: [(u16, u16, Option<bool>, i32); 7] = [
    (0, 3, None, 10),
    (3, 5, None, 10),
    (0, 5, None, 12),
    (0, 2, Some(false), 15),
    (1, 3, Some(true), 15),
    (0, 3, Some(false), 20),
    (3, 5, Some(true), 11),
];

impl Scenario {
    fn new(seed: u64) -> Self {
        let mut random = Random::new(seed);
        let rate = [100.0, 125.0, 250.0][random.below(3)];
        let arms = vec![arm_of("left", 3, &mut random), arm_of("right", 2, &mut random)];
        let tasks = TASKS.iter().enumerate().map(|(i, (from, to, stream, priority))| {
            let kind = match stream {
                None => trajectory(),
                Some(true) => velocity(),
                Some(false) => servo(),
            };
            task(&format!("t{i}"), kind, *from..*to, *priority)
        });
        let mut rig = Rig::new(rate, arms, tasks.collect());
        // What is asked for here need not be sensible: other tests check what commands may never do.
        rig.checked = false;
        for arm in &mut rig.arms {
            arm.q.iter_mut().for_each(|q| *q = random.between(-1.8, 1.8));
            arm.lag = random.between(0.0, 0.06);
            arm.sag = if random.below(3) == 0 { 0.004 } else { 0.0 };
            arm.mode_delay = random.below(3) as u32;
            arm.reports_velocity = random.below(3) > 0;
        }
        Self { rig, random, streams: vec![Stream::default(); TASKS.len()], motion: 0 }
    }

    fn arm_and_joint(joint: u16) -> (usize, usize) {
        if joint < 3 { (0, joint.into()) } else { (1, usize::from(joint) - 3) }
    }

    fn at(&self, joint: u16) -> f64 {
        let (arm, joint) = Self::arm_and_joint(joint);
        let command = &self.rig.commands[arm];
        match command.mode {
            Some(mode) if mode.is_position() => command.values[joint],
            _ => Some(self.rig.arms[arm].q[joint]).filter(|q| q.is_finite()).unwrap_or_default(),
        }
    }

    /// A request of a client, mostly one that makes sense.
    fn request(&mut self) {
        let task = self.random.below(TASKS.len());
        let (from, to, stream, _) = TASKS[task];
        match (self.random.below(40), stream) {
            (0..=30, None) => {
                self.motion += 1;
                let at: Vec<f64> = (from..to).map(|j| self.at(j) + self.random.between(-0.01, 0.01)).collect();
                let goal: Vec<f64> = at.iter().map(|q| q + self.random.between(-0.8, 0.8)).collect();
                let seconds = self.random.between(0.5, 2.0);
                let joints: Vec<u16> = (from..to).collect();
                let motion = motion(self.motion, &joints, &[(0.0, &at), (seconds, &goal)]);
                self.rig.send(Request::Execute { task: task as u16, motion });
            }
            (0..=30, Some(velocities)) => {
                let far = [0.3, 0.1, 0.02, 0.02, 0.02, 0.02][self.random.below(6)];
                let target = (from..to)
                    .map(|j| {
                        if velocities {
                            self.random.between(-2.0, 2.0)
                        } else {
                            self.at(j) + self.random.between(-far, far)
                        }
                    })
                    .collect();
                let step = self.random.between(-1.0, 1.0) * 2.0 / self.rig.config.rate;
                self.streams[task] = Stream { ticks: self.random.below(150), target, step };
            }
            (31..=34, _) => {
                let task = (self.random.below(2) == 0).then_some(task as u16);
                self.rig.send(Request::Cancel { task });
            }
            (35, _) => {
                let arm = [None, Some(0), Some(1), Some(2)][self.random.below(4)];
                self.rig.send(Request::Stop { arm });
            }
            (36, _) => {
                let arm = self.random.below(2);
                self.rig.send(Request::PrepareDisable { arm: arm as u16 });
                self.rig.arms[arm].enabled = self.random.below(2) == 0;
            }
            (37, _) => {
                let arm = self.random.below(3) as u16;
                let force = (self.random.below(2) == 0).then(|| self.random.between(0.0, 50.0));
                self.rig.send(Request::Gripper { arm, opening: self.random.between(-0.01, 0.1), force, speed: None });
            }
            _ => self.enable(),
        }
    }

    /// What an operator does after a hold.
    fn enable(&mut self) {
        for arm in 0..2 {
            self.rig.send(Request::Reset { arm });
            self.rig.arms[arm as usize].enabled = true;
            self.rig.send(Request::Enabled { arm, outside: false });
        }
    }

    /// Something goes wrong at an arm.
    fn disturb(&mut self) {
        let (which, value) = (self.random.below(2), self.random.between(-0.4, 0.4));
        let random = self.random.below(22);
        let arm = &mut self.rig.arms[which];
        match random {
            0 => arm.silent = true,
            1 => arm.deaf = true,
            2 => arm.blocked = true,
            3 => arm.error = 7,
            4 => arm.link = [Link::Down, Link::Stale, Link::Faulted][(value.abs() * 7.0) as usize],
            5 => arm.self_held = true,
            6 => arm.enabled = false,
            7 => arm.q[0] += value,
            8 => arm.q[1] += 0.1 * value,
            9 => arm.sag = value.abs() * 0.2,
            10 => arm.state.interference = Interference::Mode,
            11 => arm.state.interference = Interference::Power,
            12 => arm.state.interference = Interference::Stop,
            13 => arm.age = Duration::from_millis(1 + (value.abs() * 100.0) as u64),
            14 => arm.state.own_delay_ns = (value.abs() * 3e8) as u64,
            15 => arm.q[0] = f64::NAN,
            16 => arm.lag = value.abs(),
            17 => arm.v[1] = f64::INFINITY,
            _ => arm.deaf = true,
        }
    }

    fn repair(&mut self) {
        for arm in &mut self.rig.arms {
            (arm.silent, arm.deaf, arm.blocked, arm.self_held) = (false, false, false, false);
            (arm.error, arm.link, arm.age) = (0, Link::Up, Duration::from_millis(1));
            (arm.state.interference, arm.state.own_delay_ns) = (Interference::None, 0);
            arm.q.iter_mut().filter(|q| !q.is_finite()).for_each(|q| *q = 0.1);
            arm.v.iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
            arm.lag = arm.lag.min(0.05);
            arm.sag = arm.sag.min(0.004);
        }
    }

    fn tick(&mut self) {
        for (task, stream) in self.streams.iter_mut().enumerate().filter(|(_, stream)| stream.ticks > 0) {
            stream.ticks -= 1;
            if TASKS[task].2 == Some(true) {
                self.rig.velocity(task as u16, &stream.target);
            } else {
                stream.target.iter_mut().for_each(|target| *target += stream.step);
                self.rig.servo(task as u16, &stream.target);
            }
        }
        let skipped = match self.random.below(3000) {
            0 => self.random.below(40) as u32,
            1..30 => 1,
            _ => 0,
        };
        let late = [0.0, 0.0, 0.1, 0.8][self.random.below(4)];
        self.rig.late = self.rig.config.period().mul_f64(late * self.random.unit());
        self.rig.tick_after(skipped);
    }

    /// Runs it; returns digests of the commands and of what was reported.
    fn run(mut self, ticks: u32) -> (u64, u64) {
        let (mut commands, mut reports) = (Fnv(0xcbf2_9ce4_8422_2325), Fnv(0xcbf2_9ce4_8422_2325));
        self.rig.run(2);
        self.enable();
        let mut disturbed = 0;
        for _ in 0..ticks {
            if self.random.below(45) == 0 {
                self.request();
            }
            if disturbed == 0 && self.random.below(300) == 0 {
                self.disturb();
                disturbed = [8, 60][self.random.below(2)];
                disturbed = self.random.below(disturbed) + 1;
            } else if disturbed == 1 {
                self.repair();
            } else if disturbed == 0
                && self.random.below(30) == 0
                && (0..2).any(|arm| self.rig.phase(arm) == Phase::Held)
            {
                self.enable();
            }
            disturbed = disturbed.saturating_sub(1);
            self.tick();
            for (command, sample) in self.rig.commands.iter().zip(&self.rig.samples) {
                command.values.iter().for_each(|value| commands.write_u64(value.to_bits()));
                let force = command.gripper_force.unwrap_or(f64::NAN);
                let bits = [command.gripper, force].map(f64::to_bits);
                for number in [command.seq, command.next_tick.0, command.at.0].into_iter().chain(bits) {
                    commands.write_u64(number);
                }
                for number in [command.gripper_seq, command.stop_seq, command.start_seq] {
                    commands.write_u32(number);
                }
                let _ = write!(commands, "{:?}", command.mode);
                // No arm here says more of itself: the digests have nothing of that.
                let state = ["effort_kind: Unstated", "missing: JointSet(0)", "inputs: None"]
                    .iter()
                    .fold(format!("{:?}", sample.state), |state, new| state.replace(&format!(", {new}"), ""));
                let _ = write!(reports, "{:?} {:?} {state}", sample.phase, sample.cause);
            }
            for event in self.rig.events.drain(..) {
                let _ = write!(reports, "{event:?}");
            }
            // No task here follows another arm: the digests have nothing of the distance from it.
            // What limits a motion is in `status` only: no log has it.
            let tasks: Vec<_> = self.rig.tasks.iter().map(|t| TaskView { bound: Bound::None, ..*t }).collect();
            let tasks = format!("{tasks:?}").replace(", distance: None", "");
            let _ = write!(reports, "{tasks} {:?}", self.rig.retired);
            self.rig.retired.clear();
        }
        (commands.finish(), reports.finish())
    }
}

fn arm_of(name: &str, dof: usize, random: &mut Random) -> ArmConfig {
    let mut arm = arm(name, dof);
    arm.limits.velocity_max = (0..dof).map(|_| random.between(0.8, 2.0)).collect();
    arm.limits.acceleration_max = (0..dof).map(|_| random.between(2.0, 10.0)).collect();
    arm.limits.jerk_max = (0..dof).map(|_| random.between(10.0, 200.0)).collect();
    arm.gripper = random.below(2) == 0;
    if random.below(2) == 0 {
        arm.gripper_info = GripperInfo { unit: GripperUnit::Radians, ..Default::default() };
    }
    arm.gripper_info.force_range = (random.below(2) == 0).then_some((1.0, 40.0));
    if random.below(2) == 0 {
        arm.own_velocity = vec![2.5; dof];
    }
    if random.below(3) == 0 {
        arm.read_period = Duration::from_millis(20);
        arm.write_period = Duration::from_millis(20);
    }
    if random.below(4) == 0 {
        arm.modes.retain(|mode| mode.is_position());
    }
    arm.supervision.lag = random.between(0.01, 0.08);
    arm.supervision.stale_after = Duration::from_millis(30 + random.below(50) as u64);
    arm.supervision.tracking_tolerance = random.between(0.1, 0.2);
    arm
}

#[test]
fn the_same_input_gives_the_same_commands_as_long_as_the_config_version_is_the_same() {
    let mut found = format!("config version {CONFIG_VERSION}\n");
    for seed in 0..24 {
        let (commands, reports) = Scenario::new(seed).run(2500);
        writeln!(found, "seed {seed:2}: commands {commands:016x}, reports {reports:016x}").unwrap();
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/tick_rules.txt");
    if std::env::var_os("DIMOS_REGENERATE").is_some() {
        std::fs::write(&path, &found).unwrap();
    }
    let expected = std::fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(
        found, expected,
        "the tick decides otherwise than before: raise CONFIG_VERSION and document it in docs/log-format.md, then \
         DIMOS_REGENERATE=1 cargo test --test logic tick_rules"
    );
}
