//! The body of a simulated arm in MuJoCo: masses, friction, contacts, and the inner loop of the drives. A process of
//! Python steps it (`physics/body.py`), in step with the emulator that asks; the joints of the [`Plant`] are then where
//! the controller commands the arm to be, and those of the body where it is.

use std::ffi::OsString;
use std::io::{self, Read, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::adapter::{AdapterError, AdapterResult};
use crate::sim::plant::{Drive, Plant};
use dimos_core::joint::{Joints, MAX_DOF};

const SCRIPT: &str = include_str!("physics/body.py");
/// Names another interpreter than `python3`, such as that of a virtual environment.
const PYTHON: &str = "DIMOS_PYTHON";
/// The script's exit code without MuJoCo.
const MISSING: i32 = 3;
/// Step of the body [s], as in the script.
const STEP: f64 = 0.001;
/// An arm that was not asked for longer is at rest: the rest of that time is left out [s].
const LONGEST: f64 = 2.0;
/// Timeouts of the first answer and of the others.
const TIMEOUTS: (Duration, Duration) = (Duration::from_secs(60), Duration::from_secs(5));
/// A driven joint this far from its reference [rad] for this long [s] is blocked; twice its droop is added.
const BLOCKED: (f64, f64) = (0.06, 0.03);

/// A body with mass behind an emulator, by MuJoCo.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PhysicsOptions {
    /// How the body differs from the model that the controller knows: masses by up to 10 %, their centres by up to 10
    /// mm, friction, inertia of the rotors. 0: not at all.
    pub seed: u64,
    /// The arm and what is around it. A run makes it from its blueprint.
    #[schemars(skip)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scene: Option<Scene>,
}

/// An arm and what is around it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Both in MJCF.
    pub mjcf: String,
    /// Names of the arm's joints there, from the base.
    pub joints: Vec<String>,
    /// Highest efforts of its drives [Nm or N]; 0: not limited.
    pub efforts: Vec<f64>,
}

/// A contact of a link with an object.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Contact(
    /// The link.
    pub String,
    /// The object.
    pub String,
    /// Force [N].
    pub f64,
);

/// Answer of the script to a number of steps.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
struct Answer {
    q: Vec<f64>,
    v: Vec<f64>,
    effort: Vec<f64>,
    contacts: Vec<Contact>,
}

/// The modes of a joint in the script.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    Free = 0,
    Driven = 1,
    Braked = 2,
    Compliant = 3,
}

/// A body, and the process that has it. The process ends when this is dropped.
pub struct Body {
    child: Child,
    to: Option<ChildStdin>,
    from: ChildStdout,
    read: Vec<u8>,
    joints: usize,
    droop: f64,
    /// Joints without power fall; otherwise brakes hold them.
    pub falls: bool,
    state: Answer,
    /// Time since its last step [s].
    since: f64,
    /// For how long each joint has been away from its reference [s].
    away: Joints,
    blocked: Option<usize>,
    /// Why it ended.
    ended: Option<String>,
}

impl Body {
    /// Starts the body of an arm at these positions [rad or m], at rest, with its brakes on. `droop` is how far below
    /// its target a drive without an integral part rests [rad]; 0: its controller compensates the weight.
    pub fn start(options: &PhysicsOptions, position: &[f64], droop: f64) -> AdapterResult<Self> {
        let refuse = |what: String| Err(AdapterError::Rejected(what));
        let Some(scene) = &options.scene else {
            return refuse("physics need a model of the arm\nhint: `dimos run BLUEPRINT --sim=physics`".to_owned());
        };
        let joints = scene.joints.len();
        let Some(position) = position.get(..joints).filter(|_| scene.efforts.len() == joints && joints > 0) else {
            return refuse(format!("the scene has {joints} joints, the arm {}", position.len()));
        };
        let python = std::env::var_os(PYTHON).unwrap_or_else(|| OsString::from("python3"));
        let shown = Path::new(&python).display();
        let mut command = Command::new(&python);
        command.args(["-c", SCRIPT]).env("PYTHONDONTWRITEBYTECODE", "1");
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let started = command.spawn().and_then(|mut child| match (child.stdin.take(), child.stdout.take()) {
            (Some(to), Some(from)) => Ok((child, to, from)),
            _ => Err(io::ErrorKind::BrokenPipe.into()),
        });
        let (child, to, from) = match started {
            Ok(started) => started,
            Err(error) => {
                let hint = format!("install Python 3 with MuJoCo, or set {PYTHON} to one that has it");
                return refuse(format!("physics need Python, and {shown} does not start: {error}\nhint: {hint}"));
            }
        };
        let (read, state, to) = (Vec::new(), Answer::default(), Some(to));
        let (away, blocked, ended) = ([0.0; MAX_DOF], None, None);
        let mut body =
            Self { child, to, from, read, joints, droop, falls: false, state, since: 0.0, away, blocked, ended };
        let first = json!({
            "mjcf": scene.mjcf, "joints": scene.joints, "efforts": scene.efforts,
            "droop": droop, "seed": options.seed, "position": position,
        });
        if let Err(error) = body.ask(&first, TIMEOUTS.0) {
            return match body.last_words() {
                (Some(MISSING), text) => refuse(format!(
                    "physics need MuJoCo, and {shown} has none: {text}\nhint: {shown} -m pip install mujoco, or set \
                     {PYTHON} to a Python that has it"
                )),
                (_, text) => refuse(format!("the physics do not start: {error}: {text}")),
            };
        }
        body.state.q = position.to_vec();
        (body.state.v, body.state.effort) = (vec![0.0; joints], vec![0.0; joints]);
        Ok(body)
    }

    /// Ends the process; returns its exit code, and the last lines that it wrote about that.
    fn last_words(&mut self) -> (Option<i32>, String) {
        self.to = None;
        let began = Instant::now();
        let status = loop {
            match self.child.try_wait() {
                Ok(None) if began.elapsed() < Duration::from_secs(2) => std::thread::sleep(Duration::from_millis(5)),
                Ok(status) => break status,
                Err(_) => break None,
            }
        };
        let _ = self.child.kill();
        let mut text = String::new();
        let _ = self.child.stderr.take().map(|mut errors| errors.read_to_string(&mut text));
        let mut lines: Vec<&str> = text.trim().lines().rev().take(2).collect();
        lines.reverse();
        (status.and_then(|status| status.code()), lines.join("; "))
    }

    /// Sends a line and returns the next one that comes.
    fn ask(&mut self, request: &serde_json::Value, timeout: Duration) -> io::Result<Vec<u8>> {
        let to = self.to.as_mut().ok_or(io::ErrorKind::BrokenPipe)?;
        to.write_all(format!("{request}\n").as_bytes())?;
        to.flush()?;
        let limit = Instant::now() + timeout;
        loop {
            if let Some(end) = self.read.iter().position(|byte| *byte == b'\n') {
                let rest = self.read.split_off(end + 1);
                return Ok(std::mem::replace(&mut self.read, rest));
            }
            let left = Timespec::try_from(limit.saturating_duration_since(Instant::now())).ok();
            if poll(&mut [PollFd::new(&self.from, PollFlags::IN)], left.as_ref())? == 0 {
                return Err(io::ErrorKind::TimedOut.into());
            }
            let mut more = [0; 4096];
            match self.from.read(&mut more)? {
                0 => return Err(io::ErrorKind::UnexpectedEof.into()),
                length => self.read.extend(more.iter().take(length)),
            }
        }
    }

    /// Advances the controller's reference and the body by `dt` [s]. Joints without power take the reference with them.
    pub fn advance(&mut self, plant: &mut Plant, dt: f64) {
        let mut left = if dt.is_finite() { dt.clamp(0.0, LONGEST) } else { 0.0 };
        let mut steps: Vec<f64> = Vec::new();
        while left >= STEP - self.since {
            plant.advance(STEP - self.since);
            left -= STEP - self.since;
            self.since = 0.0;
            let (q, v) = (plant.positions(), plant.velocities());
            steps.extend(q.iter().take(self.joints).chain(v.iter().take(self.joints)).copied());
        }
        plant.advance(left);
        self.since += left;
        if steps.is_empty() || self.ended.is_some() {
            return;
        }
        let modes: Vec<Mode> = (0..self.joints).map(|joint| self.mode(plant, joint)).collect();
        let forces: Vec<_> = (0..self.joints).map(|joint| plant.force(joint)).collect();
        let of = |value: fn(&crate::sim::weight::Drive) -> f64| forces.iter().map(value).collect::<Vec<f64>>();
        let request = json!({
            "steps": steps, "mode": modes.iter().map(|mode| *mode as u8).collect::<Vec<_>>(),
            "effort": of(|force| force.effort), "stiffness": of(|force| force.stiffness),
            "damping": of(|force| force.damping),
        });
        let answer = self.ask(&request, TIMEOUTS.1);
        let answer = answer.and_then(|line| serde_json::from_slice::<Answer>(&line).map_err(io::Error::other));
        match answer {
            Ok(answer) if answer.q.len() == self.joints && answer.v.len() == self.joints => self.state = answer,
            wrong => {
                let what = wrong.err().map_or("it answers for other joints".to_owned(), |error| error.to_string());
                let (_, text) = self.last_words();
                let _ = writeln!(
                    io::stderr(),
                    "warning: the physics of an emulated arm ended, it is silent: {what}: {text}"
                );
                self.ended = Some(format!("{what}: {text}"));
                return;
            }
        }
        self.compare(plant, &modes, steps.len() as f64 / (2 * self.joints) as f64 * STEP);
    }

    /// Places joints without power, and finds those that are blocked.
    fn compare(&mut self, plant: &mut Plant, modes: &[Mode], time: f64) {
        let reference = plant.positions();
        let joints = self.state.q.iter().zip(&self.state.v).zip(modes).zip(&mut self.away).zip(&reference);
        for (joint, ((((q, v), mode), away), reference)) in joints.enumerate() {
            if *mode != Mode::Driven {
                plant.place(joint, *q, *v);
            }
            let is_off = *mode == Mode::Driven && (q - reference).abs() > BLOCKED.0 + 2.0 * self.droop;
            *away = if is_off { *away + time } else { 0.0 };
            if *away > BLOCKED.1 {
                *away = 0.0;
                self.blocked = Some(joint);
            }
        }
    }

    fn mode(&self, plant: &Plant, joint: usize) -> Mode {
        match plant.drive() {
            _ if !plant.motor(joint) => {
                if self.falls {
                    Mode::Free
                } else {
                    Mode::Braked
                }
            }
            Drive::Disabled => Mode::Braked,
            Drive::Compliant => Mode::Compliant,
            _ => Mode::Driven,
        }
    }

    /// Returns the joint that was found blocked since the last call (index from 0).
    pub fn take_blocked(&mut self) -> Option<usize> {
        self.blocked.take()
    }

    /// Returns where the joint is [rad or m], its velocity, and the effort of its drive; `None` beyond its joints.
    pub fn joint(&self, joint: usize) -> Option<(f64, f64, f64)> {
        let Answer { q, v, effort, .. } = &self.state;
        Some((*q.get(joint)?, *v.get(joint)?, *effort.get(joint)?))
    }

    /// Returns the present contacts.
    pub fn contacts(&self) -> &[Contact] {
        &self.state.contacts
    }

    /// Returns why its process has ended; then the arm has no body any longer.
    pub fn ended(&self) -> Option<&str> {
        self.ended.as_deref()
    }
}

impl Drop for Body {
    fn drop(&mut self) {
        self.to = None;
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
