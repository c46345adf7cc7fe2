//! The loop of jog: keys in, targets out, redraw.

use std::time::{Duration, Instant};

use crossterm::event::{Event, KeyEvent, KeyEventKind};

use super::active_motions::ActiveMotions;
use super::drive::{self, ArmView, Demand, Drives, Kind, Stream, refusal};
use super::fingers::Fingers;
use super::keys::{KeyAction, Motion, meaning};
use super::link::{self, Link};
use super::screen::{self, View};
use super::terminal::Terminal;
use super::watch::{ArmSnapshot, Watch};
use crate::cli::arguments::connect;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::follow::Signals;
use dimos_rpc::api::{Gripper, Lease, Release, State, Stop, TwistFrame};
use dimos_rpc::client::Client;

/// Time between two targets.
const PERIOD: Duration = Duration::from_millis(20);
/// Periods between two redraws.
const PER_DRAWING: u32 = 3;
/// Time at rest after which jog ends its task, so that others may move the joints.
const RELEASE_AFTER: Duration = Duration::from_millis(500);
/// Selectable speeds, as fractions of the maximum.
const SPEEDS: [f64; 9] = [0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0];
/// Initial speed.
const FIRST_SPEED: usize = 4;

/// Settings from the command line.
#[derive(Debug, Clone)]
pub struct Setting {
    /// Name of the run.
    pub run: String,
    /// Name of the arm.
    pub arm: String,
    /// Whether in joint mode.
    pub joint_mode: bool,
    /// Whether motions are along the axes of the tool frame.
    pub tool_frame: bool,
    /// Maximum speed of the end effector [m/s].
    pub linear: f64,
    /// Maximum angular speed of the end effector [rad/s].
    pub angular: f64,
    /// Maximum speed of a joint [rad/s].
    pub joint: f64,
}

/// Returns the names of an arm's joints, in order.
pub fn joints_of(client: &mut Client, arm: &str) -> Result<Vec<String>> {
    let state = client.call(State {})?.arms.into_iter().find(|state| state.hardware_id == arm);
    Ok(state.map(|state| state.joints.into_iter().map(|joint| joint.name).collect()).unwrap_or_default())
}

/// A session of jogging an arm.
pub struct Session {
    client: Client,
    watch: Watch,
    drives: Drives,
    setting: Setting,
    held: ActiveMotions,
    speed: usize,
    /// Index of the selected joint in its task.
    joint: usize,
    stream: Option<Stream>,
    /// When the last motion ended.
    resting: Option<Instant>,
    fingers: Fingers,
    message: Option<(String, bool)>,
    link: Link,
}

impl Session {
    /// Creates a session at rest. Avoids starting in a mode without a task.
    pub fn new(client: Client, watch: Watch, drives: Drives, mut setting: Setting) -> Self {
        let mut message = None;
        if drives.get(setting.joint_mode).is_none() {
            setting.joint_mode = !setting.joint_mode;
            message = Some((missing_task(&setting.arm, !setting.joint_mode), false));
        }
        let (held, speed, fingers) = (ActiveMotions::default(), FIRST_SPEED, Fingers::default());
        let (stream, resting, link) = (None, None, Link::Up);
        Self { client, watch, drives, setting, held, speed, joint: 0, stream, resting, fingers, message, link }
    }

    /// Jogs until the user leaves, a signal arrives, or the terminal or the run is lost. In every case the arm
    /// decelerates to rest and the terminal is restored.
    pub fn run(&mut self, mut terminal: Terminal, signals: &Signals) -> Result {
        let ended = self.follow_keys(&mut terminal, signals);
        self.held.clear();
        let rested = self.rest();
        drop(terminal);
        let exit = ended?;
        rested.map(|()| exit)
    }

    fn follow_keys(&mut self, terminal: &mut Terminal, signals: &Signals) -> Result {
        let (mut beat, mut beats) = (Instant::now(), 0_u32);
        loop {
            if let Some(signal) = signals.last() {
                return Ok(Exit::by_signal(signal));
            }
            beat = (beat + PERIOD).max(Instant::now());
            loop {
                let timeout = beat.saturating_duration_since(Instant::now());
                match terminal.event(timeout).map_err(no_terminal)? {
                    Some((Event::Key(key), at)) => match self.key(&key, at) {
                        Ok(Some(exit)) => return Ok(exit),
                        Ok(None) => {}
                        Err(failure) => self.endure(failure)?,
                    },
                    // Without keyboard focus there are no key-ups.
                    Some((Event::FocusLost, _)) => self.held.clear(),
                    _ => {}
                }
                if Instant::now() >= beat {
                    break;
                }
            }
            let seen = self.watch.seen();
            if let Some(lost) = &seen.lost {
                return Err(lost.clone());
            }
            if let Err(failure) = self.keep_the_link(&seen).and_then(|()| self.command(&seen)) {
                self.endure(failure)?;
            }
            beats = beats.wrapping_add(1);
            if beats.is_multiple_of(PER_DRAWING) {
                if !terminal.is_there() {
                    return Err(no_terminal(std::io::ErrorKind::UnexpectedEof.into()));
                }
                let size = terminal.size().map_err(no_terminal)?;
                let lines = screen::lines(&self.view(&seen), size);
                terminal.draw(lines).map_err(no_terminal)?;
            }
        }
    }

    fn key(&mut self, key: &KeyEvent, now: Instant) -> Result<Option<Exit>> {
        let Some(wish) = meaning(key, self.setting.joint_mode) else { return Ok(None) };
        if !matches!(self.link, Link::Up) && !matches!(wish, KeyAction::Leave { .. }) {
            let (resume, stops) = (matches!(wish, KeyAction::Rest), matches!(wish, KeyAction::Stop));
            match &self.link {
                Link::Back if resume => self.resume()?,
                Link::Back if stops => self.stop()?,
                Link::Lost(_) if stops => {
                    let text = "not stopped: the connection is lost; use the arm's own stop, or `dimos stop`";
                    self.message = Some((text.into(), true));
                }
                _ => {}
            }
            return Ok(None);
        }
        match (wish, key.kind) {
            (KeyAction::Move(motion), KeyEventKind::Press) => {
                self.message = None;
                self.held.press(motion, now);
            }
            (KeyAction::Move(motion), KeyEventKind::Repeat) => self.held.repeat(motion, now),
            (KeyAction::Move(motion), KeyEventKind::Release) => self.held.release(motion, now),
            (_, KeyEventKind::Release) => {}
            (KeyAction::Leave { interrupted }, _) => {
                return Ok(Some(if interrupted { Exit::Interrupted } else { Exit::Ok }));
            }
            (KeyAction::Speed(faster), _) => {
                let next = if faster { self.speed + 1 } else { self.speed.saturating_sub(1) };
                self.speed = next.min(SPEEDS.len() - 1);
            }
            (KeyAction::Frame, _) => {
                self.held.clear();
                self.setting.tool_frame = !self.setting.tool_frame;
            }
            (KeyAction::Joint(index), _) => self.choose(index),
            (KeyAction::Step(forward), _) => {
                self.choose(if forward { self.joint + 1 } else { self.joint.saturating_sub(1) });
            }
            (KeyAction::Gripper(open), _) => self.grip(open, now)?,
            (KeyAction::Mode, _) => self.change_mode()?,
            (KeyAction::Rest, _) => self.rest()?,
            (KeyAction::Stop, _) => self.stop()?,
        }
        Ok(None)
    }

    /// Opens or closes the gripper by a step.
    fn grip(&mut self, open: bool, now: Instant) -> Result<()> {
        let refused = match self.fingers.step(open, &self.watch.seen(), now) {
            Ok(None) => return Ok(()),
            Ok(Some(position)) => {
                let arm = self.setting.arm.clone();
                refusal(self.client.call(Gripper { arm, position, ..Gripper::default() }).map(drop))?
            }
            Err(why) => Some(why),
        };
        self.message = refused.map(|text| (text, true));
        Ok(())
    }

    fn choose(&mut self, joint: usize) {
        if self.drives.joints.as_ref().is_some_and(|drive| joint < drive.joints.len()) {
            self.held.clear();
            self.joint = joint;
        }
    }

    fn change_mode(&mut self) -> Result<()> {
        let other = !self.setting.joint_mode;
        if self.drives.get(other).is_none() {
            self.message = Some((missing_task(&self.setting.arm, other), true));
            return Ok(());
        }
        self.rest()?;
        self.message = None;
        self.setting.joint_mode = other;
        Ok(())
    }

    /// Decelerates to rest and ends the task.
    fn rest(&mut self) -> Result<()> {
        self.held.clear();
        self.resting = None;
        let Some(stream) = self.stream.take() else { return Ok(()) };
        // A task that refuses rest is at rest already; end it all the same.
        let refused = refusal(stream.rest(&mut self.client))?;
        self.message =
            refusal(stream.end(&mut self.client))?.or(refused).map(|text| (text, true)).or(self.message.take());
        Ok(())
    }

    /// Latched operational stop. Releases the lease, which the reset of the arm needs.
    fn stop(&mut self) -> Result<()> {
        self.held.clear();
        (self.stream, self.resting) = (None, None);
        let arm = self.setting.arm.clone();
        let stop = Stop { arm: Some(arm.clone()) };
        let run = &self.setting.run;
        let text = match self.client.call_urgently(|| connect(Some(run)), &stop) {
            Ok(reply) => {
                let result = reply.arms.get(&arm).map_or("unknown", |confirmation| confirmation.text());
                format!("stop of {arm}: {result}; next: `dimos arm reset {arm}`, `dimos arm enable {arm}`")
            }
            Err(error) => refusal(Err(error))?.unwrap_or_default(),
        };
        self.message = Some((text, true));
        self.release_lease()
    }

    fn release_lease(&mut self) -> Result<()> {
        let released = self.client.call(Release { arm: Some(self.setting.arm.clone()) }).map(|_| ());
        refusal(released).map(|_| ())
    }

    /// Survives the loss of a connection to another computer: the arm is brought to rest there, and nothing moves it
    /// again without the user. Other failures end jog.
    fn endure(&mut self, failure: Failure) -> Result<()> {
        if !link::is_loss(&failure) {
            return Err(failure);
        }
        self.held.clear();
        (self.stream, self.resting) = (None, None);
        self.message = Some((format!("{}; the arm decelerates to rest; connecting again", failure.what), true));
        self.link = Link::lost(&self.setting.run);
        Ok(())
    }

    /// Notices a loss while nothing is sent, and that the run is back.
    fn keep_the_link(&mut self, seen: &ArmSnapshot) -> Result<()> {
        match &self.link {
            Link::Up => seen.away.clone().map_or(Ok(()), Err),
            Link::Lost(connecting) => {
                if seen.away.is_none()
                    && let Some(client) = connecting.back()
                {
                    (self.client, self.link) = (client, Link::Back);
                    self.message = Some(("connected again: Space takes the lease of the arm again".into(), true));
                }
                Ok(())
            }
            Link::Back => Ok(()),
        }
    }

    /// Takes the lease again after a loss.
    fn resume(&mut self) -> Result<()> {
        let leased = self.client.call(Lease { arm: Some(self.setting.arm.clone()) }).map(drop);
        match refusal(leased)? {
            None => (self.link, self.message) = (Link::Up, None),
            Some(refused) => self.message = Some((format!("{refused}; Space tries again"), true)),
        }
        Ok(())
    }

    /// Sends the next target, or brings a moving arm to rest.
    fn command(&mut self, seen: &ArmSnapshot) -> Result<()> {
        if !matches!(self.link, Link::Up) {
            return Ok(());
        }
        let now = Instant::now();
        match self.demand(now) {
            Some(demand) => self.go(demand, seen, now),
            None => self.fade_out(now),
        }
    }

    fn go(&mut self, demand: Demand, seen: &ArmSnapshot, now: Instant) -> Result<()> {
        let Some(drive) = self.drives.get(self.setting.joint_mode).cloned() else { return Ok(()) };
        self.resting = None;
        let mut stream = match self.stream.take() {
            Some(stream) if *stream.drive() == drive => stream,
            _ => Stream::new(drive),
        };
        let view = ArmView { state: seen.state.as_ref(), arm: seen.arm.as_ref() };
        match refusal(stream.send(&mut self.client, demand, view, now))? {
            None => self.stream = Some(stream),
            Some(refused) => {
                self.held.clear();
                self.message = Some((refused, true));
                // The cause of the hold may need the lease to be fixed.
                self.release_lease()?;
            }
        }
        Ok(())
    }

    fn fade_out(&mut self, now: Instant) -> Result<()> {
        let Some(stream) = &self.stream else { return Ok(()) };
        match self.resting {
            None => {
                self.resting = Some(now);
                let refused = refusal(stream.rest(&mut self.client))?;
                self.message = refused.map(|text| (text, true)).or(self.message.take());
                // The next motion of a servo task starts at the arm's position.
                if stream.drive().kind == Kind::Servo {
                    self.stream = self.stream.take().map(|stream| Stream::new(stream.drive().clone()));
                }
            }
            Some(since) if now.saturating_duration_since(since) > RELEASE_AFTER => self.rest()?,
            Some(_) => {}
        }
        Ok(())
    }

    /// Returns the motion of the held keys.
    fn demand(&mut self, now: Instant) -> Option<Demand> {
        let alive = self.held.alive(now);
        if alive.is_empty() {
            return None;
        }
        let speed = SPEEDS.get(self.speed).copied().unwrap_or(0.0);
        let signed = |up: bool, strength: f64| if up { strength * speed } else { -strength * speed };
        let (mut axes, mut single) = ([0.0; 6], 0.0);
        for (motion, strength) in alive {
            match motion {
                Motion::Axis { axis, up } => {
                    if let Some(value) = axes.get_mut(axis) {
                        *value += signed(up, strength);
                    }
                }
                Motion::Joint { up } => single += signed(up, strength),
            }
        }
        if self.setting.joint_mode {
            return Some(Demand::Joint(self.joint, single * self.setting.joint));
        }
        let [x, y, z, roll, pitch, yaw] = axes;
        let frame = if self.setting.tool_frame { TwistFrame::Tool } else { TwistFrame::Base };
        let linear = [x, y, z].map(|v: f64| v * self.setting.linear);
        Some(Demand::Tool(linear, [roll, pitch, yaw].map(|v: f64| v * self.setting.angular), frame))
    }

    fn view<'a>(&'a mut self, seen: &'a ArmSnapshot) -> View<'a> {
        let moving = self.demand(Instant::now()).map(|demand| in_words(&demand)).unwrap_or_default();
        let share = SPEEDS.get(self.speed).copied().unwrap_or(0.0);
        let percent = share * 100.0;
        let speed = match self.setting.joint_mode {
            true => format!("{percent:.0} %: {:.3} rad/s", share * self.setting.joint),
            false => {
                let (linear, angular) = (share * self.setting.linear, share * self.setting.angular);
                format!("{percent:.0} %: {linear:.3} m/s, {angular:.3} rad/s")
            }
        };
        let joint = self.drives.joints.as_ref().and_then(|drive| drive.joints.get(self.joint));
        View {
            run: &self.setting.run,
            arm: &self.setting.arm,
            seen,
            since: seen.at.map(|at| at.elapsed()),
            joint_mode: self.setting.joint_mode,
            tool_frame: self.setting.tool_frame,
            task: self.drives.get(self.setting.joint_mode).map(|drive| drive.task.as_str()),
            joint: joint.map(String::as_str),
            speed,
            moving,
            message: self.message.as_ref().map(|(text, bad)| (text.as_str(), *bad)),
            releases: self.held.knows_releases(),
        }
    }
}

fn no_terminal(error: std::io::Error) -> Failure {
    Failure::new(Exit::Failed, format!("the terminal was closed: {error}"))
}

/// Returns why a mode is unavailable.
fn missing_task(arm: &str, joint_mode: bool) -> String {
    let what = if joint_mode { "single joints" } else { "the end effector" };
    format!("no task of the run moves {what} of {arm}; add to `tasks`: {}", drive::line(arm, joint_mode))
}

/// Returns a motion as text: `+x -yaw`.
fn in_words(demand: &Demand) -> String {
    let sign = |v: f64| if v < 0.0 { '-' } else { '+' };
    match demand {
        Demand::Joint(_, speed) => format!("{}{:.3} rad/s", sign(*speed), speed.abs()),
        Demand::Tool(linear, angular, _) => {
            let named = linear.iter().chain(angular).zip(super::keys::AXES);
            let parts = named.filter(|(v, _)| **v != 0.0).map(|(v, (_, _, name))| format!("{}{name}", sign(*v)));
            parts.collect::<Vec<_>>().join(" ")
        }
    }
}
