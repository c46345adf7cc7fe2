//! What is ordered of a connected arm: to start and end motions, to stop, to recover.

use std::time::Duration;

use super::Options;
use super::protocol::DOF;
use super::protocol::service::{Service, floats, motion, moved};
use super::protocol::state::{generator, mode};
use super::session::{Session, refused};
use dimos_core::arm::Load;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Stop};

/// How long a motion may take to start, and to end after its last command.
const START_LIMIT: Duration = Duration::from_millis(800);
const FINISH_LIMIT: Duration = Duration::from_millis(300);
/// How long a stop may take until the arm is at rest, and a recovery.
const STOP_LIMIT: Duration = Duration::from_millis(900);
const RECOVERY_LIMIT: Duration = Duration::from_secs(3);
/// Setpoints are not sent while no state has come for this time: they would follow a silence.
const MAX_SILENCE: Duration = Duration::from_millis(60);
/// Farthest that a position setpoint may be from where the arm is to be [rad].
const MAX_AHEAD: f64 = 0.3;

impl Session {
    /// Enables the arm: sets what the blueprint says, and starts a motion that holds.
    pub fn activate(&mut self, options: &Options, velocity: bool) -> AdapterResult<()> {
        self.update()?;
        self.fault()?;
        if self.state.mode == mode::GUIDING {
            return Err(AdapterError::Rejected("the arm is guided by hand\nhint: release its guiding button".into()));
        }
        self.foreign = None;
        if self.motion.is_none() {
            self.configure(options)?;
            self.start(velocity)?;
        }
        self.on = true;
        Ok(())
    }

    /// Sets stiffness and collision thresholds, where the blueprint has them.
    fn configure(&mut self, options: &Options) -> AdapterResult<()> {
        if !options.joint_impedance.is_empty() {
            self.set(Service::SetJointImpedance, &floats(&options.joint_impedance))?;
        }
        if !options.collision_torques.is_empty() && !options.collision_forces.is_empty() {
            let (torques, forces) = (&options.collision_torques, &options.collision_forces);
            let values = [torques, torques, torques, torques, forces, forces, forces, forces];
            let values: Vec<f64> = values.into_iter().flatten().copied().collect();
            self.set(Service::SetCollisionBehavior, &floats(&values))?;
        }
        Ok(())
    }

    /// Starts a motion. Its first commands hold the arm where it is to be.
    pub fn start(&mut self, velocity: bool) -> AdapterResult<()> {
        let answer = self.ask(Service::Move, &motion(self.interface, velocity))?;
        if answer.status != moved::STARTED {
            return Err(refused(self.interface, Service::Move, answer.status));
        }
        let expected = if velocity { generator::JOINT_VELOCITY } else { generator::JOINT_POSITION };
        let runs = |session: &mut Self| {
            session.fault()?;
            Ok((session.state.mode == mode::MOVE && session.state.generator == expected).then_some(()))
        };
        match self.wait(START_LIMIT, runs)? {
            Some(()) => {
                self.begin(answer.id, velocity);
                Ok(())
            }
            None => Err(AdapterError::Timeout(format!("the motion did not start within {START_LIMIT:?}"))),
        }
    }

    /// Ends a motion in a regular way: at rest with the flag of a finished motion, otherwise with a stop.
    pub fn finish(&mut self) -> AdapterResult<()> {
        self.update()?;
        let rest = self.at_rest();
        let Some(motion) = self.motion.as_mut().filter(|_| rest) else { return self.stop().map(drop) };
        motion.finishing = true;
        let id = motion.id;
        let ended = |session: &mut Self| Ok((session.state.generator == generator::IDLE).then_some(()));
        if self.wait(FINISH_LIMIT, ended)?.is_none() {
            return self.stop().map(drop);
        }
        self.motion = None;
        match self.wait(FINISH_LIMIT, |session| session.answered(id))? {
            Some(answer) if answer.status != 0 => Err(refused(self.interface, Service::Move, answer.status)),
            _ => Ok(()),
        }
    }

    /// Stops all motion. The arm stays stopped until it is activated. Confirmed by the controller's answer and a later
    /// state without a motion and at rest.
    pub fn stop(&mut self) -> AdapterResult<Stop> {
        let sent = MonotonicClock.now();
        let running = self.motion.take().is_some() || self.state.generator != generator::IDLE;
        if running || self.state.mode == mode::MOVE {
            // Refused by an arm that has stopped already: the state says it.
            self.ask(Service::StopMove, &[])?;
        }
        let done = |session: &mut Self| {
            let idle = session.state.generator == generator::IDLE && session.at_rest();
            Ok((idle && session.fresh_at > sent).then_some(()))
        };
        Ok(if self.wait(STOP_LIMIT, done)?.is_some() { Stop::Confirmed } else { Stop::Sent })
    }

    /// Disables the arm: its own control holds it, and no command moves it.
    pub fn disable(&mut self) -> AdapterResult<()> {
        self.finish()?;
        self.on = false;
        Ok(())
    }

    /// Clears errors.
    pub fn clear_errors(&mut self) -> AdapterResult<()> {
        self.update()?;
        if self.state.mode == mode::USER_STOPPED {
            let what = "the user stop is pressed\nhint: release the button at the arm";
            return Err(AdapterError::Rejected(what.into()));
        }
        if self.fault().is_ok() {
            return Ok(());
        }
        let id = self.order(Service::AutomaticErrorRecovery, &[])?;
        let late = || AdapterError::Timeout(format!("the error was not cleared within {RECOVERY_LIMIT:?}"));
        let answer = self.wait(RECOVERY_LIMIT, |session| session.answered(id))?.ok_or_else(late)?;
        if answer.status != 0 {
            return Err(refused(self.interface, Service::AutomaticErrorRecovery, answer.status));
        }
        let cleared = |session: &mut Self| Ok(session.fault().is_ok().then_some(()));
        self.wait(START_LIMIT, cleared)?.ok_or_else(late)
    }

    /// Sends or keeps a setpoint.
    pub fn stream(&mut self, goal: &[f64; DOF]) -> AdapterResult<()> {
        self.fault()?;
        if !self.enabled() {
            return Err(AdapterError::Rejected("the arm is disabled".into()));
        }
        let age = self.age();
        if age > MAX_SILENCE {
            return Err(AdapterError::Busy);
        }
        let Some(motion) = self.motion.as_mut() else {
            let why = self.foreign.unwrap_or("the arm was stopped");
            return Err(AdapterError::Rejected(format!("{why}: enable it again")));
        };
        let mut ahead = goal.iter().zip(&self.state.q_d).enumerate();
        if let Some((i, (wanted, q))) =
            ahead.find(|(_, (wanted, q))| !motion.velocity && (*wanted - *q).abs() > MAX_AHEAD)
        {
            let what = format!("joint {}: {wanted:.3} rad is farther than {MAX_AHEAD} rad from {q:.3} rad", i + 1);
            return Err(AdapterError::Rejected(what));
        }
        if let Some(answer) = motion.follower.setpoint(goal, &self.state, age) {
            self.answer(&answer);
        }
        Ok(())
    }

    /// Sets the load. The controller takes one only without a motion: one that holds is ended and started again.
    pub fn set_load(&mut self, load: &Load) -> AdapterResult<()> {
        let running = self.motion.as_ref().map(|motion| motion.velocity);
        if running.is_some() {
            self.finish()?;
        }
        let [xx, xy, xz, yy, yz, zz] = load.inertia;
        let values = [&[load.mass][..], &load.center, &[xx, xy, xz, xy, yy, yz, xz, yz, zz]].concat();
        let set = self.set(Service::SetLoad, &floats(&values));
        if let Some(velocity) = running {
            self.start(velocity)?;
        }
        set?;
        // The state that shows it.
        let shown = |session: &mut Self| Ok(load.agrees_with(&session.state.load).then_some(()));
        self.wait(FINISH_LIMIT, shown).map(drop)
    }
}
