//! What is asked of an arm in a trial on the wire: enabled, moved, stopped, reset, and when the lie begins.

use std::time::{Duration, Instant};

use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::hardware::sim::misreading::Misreading;
use dimos::robot::random::Random;

use super::arms::{Bed, furthest};
use super::judge::position;
use super::lock;
use super::lying::{Act, LATE, Occasion, Trial};

impl Trial<'_> {
    fn wait(&mut self, least: f64, most: f64) {
        let seconds = self.random.between(least, most);
        std::thread::sleep(Duration::from_secs_f64(seconds));
    }

    fn phase(&self) -> String {
        self.bed.phase().0
    }

    /// Begins the lie.
    fn tell(&mut self) {
        if !self.told {
            self.told = true;
            self.lie.iter().flatten().for_each(|fault| self.bed.inject(*fault));
        }
    }

    /// How far a reading may be from the one before it [rad].
    fn noise(&self) -> f64 {
        let noisy = |fault: &&Fault| fault.kind == FaultKind::Misread && fault.misread == Misreading::Noise;
        self.lie.iter().flatten().filter(noisy).map(|fault| fault.amount).fold(0.0, f64::max)
    }

    /// What is wrong before the motors come on cannot be seen: the joints may go where they are said to be.
    pub fn place(&mut self) {
        let (said, truth) = (self.bed.measured(), self.bed.truth());
        let (s, l) = (&self.supervision, &self.limits);
        let crept = self.lie.iter().flatten().map(|f| 0.4 * f.amount.abs()).fold(0.0, f64::max).min(0.05);
        let (told, noise) = (self.told, self.noise());
        let extra = |j: usize| {
            let off = (said.get(j).copied().unwrap_or(truth[j]) - truth[j]).abs() + noise;
            let (v, a) = (l.velocity_max[j], l.acceleration_max[j]);
            let off = if off < 0.5 * std::f64::consts::PI { off } else { 0.0 };
            let hidden =
                (2.2 * off).min(2.0 * v * (s.lag + 0.15 + LATE) + v * v / a) + 0.02f64.max(2.0 * s.accuracy) + crept;
            s.droop + if told { hidden } else { 0.0 }
        };
        let mut watched = lock(self.watched);
        watched.judge.placed(&truth, extra);
        // An arm without a stop of its own goes to where it was said to be when its motors came on, also after the lie.
        let enabled_at = self.bed.gate.sent().iter().find_map(|t| position(&t.what).cloned());
        let goes_on = told && matches!(self.bed.arm.name, "piper" | "so101");
        for (j, q) in enabled_at.filter(|_| goes_on).iter().flatten().enumerate() {
            watched.judge.request(j, *q, 0.0);
        }
        watched.placed = true;
    }

    fn fail(&mut self, why: String) {
        self.failures.push(why);
    }

    pub fn script(&mut self, occasion: Occasion, act: Act) {
        self.enable();
        match occasion {
            Occasion::Start => self.motion(act, None),
            Occasion::Enabling | Occasion::Disabled => {
                self.disable();
                if occasion == Occasion::Disabled {
                    self.tell();
                    self.wait(0.05, 0.3);
                }
                let _ = self.bed.run.enable("arm");
                self.until("the motors are on", Bed::motors_on);
                self.place();
                if occasion == Occasion::Enabling {
                    self.wait(0.0, 0.08);
                    self.tell();
                    self.place();
                }
                self.enable();
                self.motion(act, None);
            }
            Occasion::Idle => {
                self.wait(0.05, 0.2);
                self.tell();
                self.wait(0.3, 0.6);
                self.motion(act, None);
            }
            Occasion::Motion => self.motion(act, Some(true)),
            Occasion::Stopping => self.motion(act, Some(false)),
            Occasion::Held => {
                self.stop();
                self.tell();
                self.wait(0.2, 0.5);
                self.stop();
            }
        }
        if self.phase() != "ready" {
            self.again();
        }
        if self.random.below(2) == 0 {
            self.motion(Act::Move, None);
        }
        self.stop();
    }

    /// The operator resets it and enables it, having seen both poses.
    fn again(&mut self) {
        if self.random.below(2) == 0 {
            self.stop();
        }
        // What is asked before the last motion is over would be forgotten with it.
        self.until("it rests", |_| lock(self.watched).judge.rests());
        let (said, truth, noise) = (self.bed.measured(), self.bed.truth(), self.noise());
        let _ = self.bed.run.reset("arm");
        {
            let mut watched = lock(self.watched);
            for (j, q) in truth.iter().enumerate() {
                let said = said.get(j).copied().unwrap_or(*q);
                for past in [-1.0, 1.0] {
                    let off = (said - q).abs() + noise + 0.02;
                    watched.judge.request(j, said + past * off, self.limits.velocity_max[j]);
                }
            }
        }
        self.enable();
    }

    /// An honest arm is ready within three seconds.
    fn enable(&mut self) {
        let began = Instant::now();
        while self.phase() != "ready"
            && began.elapsed() < Duration::from_millis(if self.lie.is_none() { 3000 } else { 700 })
        {
            let _ = self.bed.run.enable("arm");
            std::thread::sleep(Duration::from_millis(30));
        }
        std::thread::sleep(Duration::from_millis(50));
        self.is_ready("enabled");
    }

    fn is_ready(&mut self, when: &str) {
        let (phase, cause) = self.bed.phase();
        if self.lie.is_none() && phase != "ready" {
            self.fail(format!("honest, and {when}: {phase} ({cause})"));
        }
    }

    fn disable(&mut self) {
        let _ = self.bed.run.disable("arm");
        self.until("the motors are off", |bed| !bed.motors_on());
        lock(self.watched).placed = self.bed.motors_on();
        self.wait(0.05, 0.2);
        // An arm without brakes falls.
        let mut before = self.bed.truth();
        self.until("it lies", |bed| {
            std::thread::sleep(Duration::from_millis(40));
            furthest(&std::mem::replace(&mut before, bed.truth()), &bed.truth()) < 1e-4
        });
    }

    /// Waits for at most 8 s: a controller may take no order in a lie.
    fn until(&self, what: &str, mut holds: impl FnMut(&Bed) -> bool) {
        let began = Instant::now();
        while !holds(self.bed) {
            if began.elapsed() > Duration::from_secs(8) {
                println!("{} not: {what}", self.bed.arm.name);
                break;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// An operational stop: the arm is held at once, and rests when it has braked.
    fn stop(&mut self) {
        let stopped = if self.random.below(2) == 0 { self.bed.run.stop_arms() } else { self.bed.run.stop_arm("arm") };
        let phase = self.phase();
        if let Err(error) = &stopped {
            self.fail(format!("a stop is refused: {error}"));
        } else if phase == "ready" || phase == "activating" {
            self.fail(format!("{phase} after a stop"));
        }
        let l = &self.limits;
        let braking = l.velocity_max.iter().zip(&l.acceleration_max).map(|(v, a)| v / a).fold(0.0, f64::max);
        std::thread::sleep(Duration::from_secs_f64(0.5 + braking + 3.0 * self.supervision.lag + LATE));
        let before = self.bed.truth();
        std::thread::sleep(Duration::from_millis(100));
        let moved = furthest(&self.bed.truth(), &before);
        if self.bed.motors_on() && moved > self.supervision.relief + 0.005 {
            self.fail(format!("{moved:.4} rad in 0.1 s, {:.1} s after a stop", 0.5 + braking));
        }
    }

    /// A motion. `event`: the lie begins during it, or (false) it is stopped and the lie begins then.
    fn motion(&mut self, act: Act, event: Option<bool>) {
        if self.phase() != "ready" {
            return;
        }
        let dof = self.bed.arm.dof();
        let last = self.bed.gate.sent().iter().rev().find_map(|t| position(&t.what).cloned());
        let here = last.filter(|q| furthest(q, &self.bed.truth()) < 0.3).unwrap_or_else(|| self.bed.truth());
        let seconds = self.random.between(0.5, 1.0);
        let part = self.random.between(0.15, 0.85);
        let l = self.limits.clone();
        let away = |random: &mut Random, j: usize| {
            let (v, a) = (part * l.velocity_max[j], part * l.acceleration_max[j]);
            (v * seconds / 1.9).min(a * seconds * seconds / 6.0).min(0.9) * random.between(-1.0, 1.0)
        };
        let away: Vec<f64> = (0..dof).map(|j| away(&mut self.random, j)).collect();
        let inside = |j: usize, q: f64| q.clamp(l.position_lower[j] + 0.05, l.position_upper[j] - 0.05);
        let goal: Vec<f64> = (0..dof).map(|j| inside(j, here[j] + away[j])).collect();
        {
            let mut watched = lock(self.watched);
            for j in 0..dof {
                let top = if act == Act::Move { l.velocity_max[j] * part } else { 1.9 * away[j].abs() / seconds };
                watched.judge.request(j, here[j], top);
                watched.judge.request(j, goal[j], top);
                if act == Act::Velocity {
                    // There and back, and what it does until the stream is over.
                    watched.judge.request(j, here[j] + 1.2 * away[j], top);
                    watched.judge.request(j, here[j] - 0.3 * away[j], top);
                }
            }
            watched.active = true;
        }
        let handle = self.bed.run.handle();
        let mut moved = Ok(None);
        if act == Act::Move {
            moved = handle.move_arm("arm", &goal, part).map(|reply| Some(reply.motion));
        }
        let event_at = event.map(|_| self.random.between(0.05, 0.8) * seconds);
        let (began, mut told, mut refused) = (Instant::now(), false, None);
        while began.elapsed().as_secs_f64() < seconds && moved.is_ok() && refused.is_none() {
            let t = began.elapsed().as_secs_f64() / seconds;
            if event_at.is_some_and(|at| began.elapsed().as_secs_f64() >= at) && !told {
                told = true;
                if event == Some(false) {
                    let _ = handle.stop_arms();
                }
                self.tell();
                if event == Some(false) {
                    break;
                }
            }
            let sent = match act {
                Act::Move => Ok(()),
                Act::Servo => {
                    let smooth = t * t * (3.0 - 2.0 * t);
                    let target: Vec<f64> = (0..dof).map(|j| here[j] + smooth * (goal[j] - here[j])).collect();
                    handle.servo("servo_arm", &target)
                }
                Act::Velocity => {
                    let v: Vec<f64> = away.iter().map(|d| d / seconds * if t < 0.6 { 1.0 } else { -1.0 }).collect();
                    handle.velocity("velocity_arm", &v)
                }
            };
            refused = sent.err();
            std::thread::sleep(Duration::from_millis(10));
        }
        if act != Act::Move {
            let _ = handle.cancel();
        }
        self.until_done(moved.as_ref().ok().copied().flatten(), event);
        lock(self.watched).active = false;
        self.wait(0.1, 0.2);
        if self.lie.is_none() && event.is_none() {
            self.is_ready(&format!("after {act:?}"));
            if let Some(error) = moved.err().or(refused) {
                self.fail(format!("honest, and {act:?} is refused: {error}"));
            }
        }
    }

    /// Waits until nothing moves the arm.
    fn until_done(&mut self, motion: Option<u64>, event: Option<bool>) {
        let began = Instant::now();
        let moves =
            |bed: &Bed| bed.run.status().tasks.iter().any(|t| matches!(t.state.as_str(), "EXECUTING" | "CANCELLING"));
        while moves(self.bed) && began.elapsed() < Duration::from_secs(6) {
            std::thread::sleep(Duration::from_millis(5));
        }
        if self.lie.is_none()
            && event.is_none()
            && let Some(report) = motion.and_then(|motion| self.bed.run.motion(motion).ok())
            && report.state != "COMPLETED"
        {
            self.fail(format!("honest, and the motion is {}: {:?}", report.state, report.error));
        }
    }
}
