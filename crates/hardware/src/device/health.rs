//! Counters and texts of a device thread, for status and log. The tick does not read them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU32, AtomicU64, Ordering};
use std::sync::{Mutex, OnceLock};

use super::identity::Identity;
use super::{Details, History};
use crate::adapter::{AdapterError, AdapterResult, RobotState};
use dimos_core::clock::Mono;
use dimos_core::sync::lock;
use dimos_rt::wake::Wake;

/// Number of episodes kept.
const EPISODES: usize = 16;
/// Maximum log lines per episode.
const MAX_LINES_PER_EPISODE: usize = 8;

/// Longest interval between states, in units of their average, that counts in full: the average of a fast arm must not
/// take an outage for its rate.
const MAX_INTERVAL_RATIO: f64 = 10.0;

/// A period during which one kind of trouble lasted.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// When it began.
    pub since: Mono,
    /// When it ended; `None` while it lasts.
    pub until: Option<Mono>,
    /// How often the trouble occurred.
    pub count: u64,
    /// Text of the trouble.
    pub text: String,
}

/// A line for the log.
#[derive(Debug, Clone, PartialEq)]
pub enum Note {
    /// Trouble began.
    Began(String),
    /// The trouble is over.
    Over(String),
}

/// Counters and texts of one device.
#[derive(Debug, Default)]
pub struct Health {
    /// States read.
    pub reads: AtomicU64,
    /// Reads that failed.
    pub read_errors: AtomicU64,
    /// Commands written.
    pub writes: AtomicU64,
    /// Commands not written because they were too far from the last one written, or from the arm.
    pub withheld: AtomicU64,
    /// Writes that failed.
    pub write_errors: AtomicU64,
    /// Reconnects.
    pub reconnects: AtomicU64,
    /// `ArmCommand::stop_seq` of the last stop that the device confirmed.
    pub stop_confirmed: AtomicU32,
    /// `ArmCommand::stop_seq` of the last stop that was sent.
    pub stop_sent: AtomicU32,
    /// Moving average of the time between states [ns]. An average of rates would give short intervals too much weight.
    interval_ns: AtomicU64,
    /// Joint positions of the last 2 s.
    pub(super) history: History,
    text: Mutex<Text>,
    identity: Mutex<Identity>,
    /// Whether another arm answers than the one of the run.
    is_other: AtomicBool,
    codes: Mutex<Option<RobotState>>,
    details: Mutex<Details>,
    /// `ArmCommand::gripper_seq` of the last gripper command that was answered, and the answer.
    gripper: Mutex<Option<(u32, AdapterResult<()>)>>,
    /// Whether the gripper itself reports an object: 0 if it cannot tell, 1 for none, 2 for one.
    gripper_holds: AtomicU8,
    /// Raised when a stop or a gripper command is answered.
    listener: OnceLock<Wake>,
}

#[derive(Debug, Default)]
struct Text {
    error: String,
    episodes: VecDeque<Episode>,
    /// Texts logged since the last time without trouble.
    logged: Vec<String>,
}

impl Health {
    /// Returns which arm this is.
    pub fn identity(&self) -> Identity {
        lock(&self.identity).clone()
    }

    /// Changes which arm this is: at a connection, and when an operator accepts another one.
    pub fn with_identity<T>(&self, act: impl FnOnce(&mut Identity) -> T) -> T {
        let mut identity = lock(&self.identity);
        let result = act(&mut identity);
        self.is_other.store(identity.other.is_some(), Ordering::Release);
        result
    }

    /// Returns whether another arm answers than the one of the run. Never blocks.
    pub(super) fn is_other_arm(&self) -> bool {
        self.is_other.load(Ordering::Acquire)
    }

    /// Returns the rate of new states [Hz].
    pub fn rate(&self) -> f64 {
        match self.interval_ns.load(Ordering::Relaxed) {
            0 => 0.0,
            ns => 1e9 / ns as f64,
        }
    }

    /// Counts a state that arrived this long after the previous one [s].
    pub(super) fn state_came(&self, interval: f64) {
        self.reads.fetch_add(1, Ordering::Relaxed);
        if interval > 0.0 {
            let (old, new) = (self.interval_ns.load(Ordering::Relaxed) as f64, interval * 1e9);
            let mean = if old > 0.0 { old + 0.05 * (new.min(MAX_INTERVAL_RATIO * old) - old) } else { new };
            self.interval_ns.store(mean.max(1.0) as u64, Ordering::Relaxed);
        }
    }

    /// Sets the event to raise whenever a stop or a gripper command is answered. Only the first call has an effect.
    pub fn wake_on_answers(&self, wake: Wake) {
        let _ = self.listener.set(wake);
    }

    /// Returns the answer to the gripper command with this `ArmCommand::gripper_seq`; `None` while it is pending.
    pub fn gripper_answer(&self, order: u32) -> Option<AdapterResult<()>> {
        let last = lock(&self.gripper);
        match last.as_ref()? {
            (answered, result) if *answered == order => Some(result.clone()),
            // Sequence numbers wrap around: the nearer half of them is newer.
            (answered, _) if answered.wrapping_sub(order) < u32::MAX / 2 => {
                Some(Err(AdapterError::Rejected("a newer gripper command replaced it".to_owned())))
            }
            _ => None,
        }
    }

    /// Returns whether the gripper itself reports an object in its grip; `None` if it cannot tell.
    pub fn gripper_holds(&self) -> Option<bool> {
        [None, Some(false), Some(true)].get(usize::from(self.gripper_holds.load(Ordering::Relaxed))).copied().flatten()
    }

    pub(super) fn set_gripper_holds(&self, holds: Option<bool>) {
        self.gripper_holds.store(holds.map_or(0, |holds| 1 + u8::from(holds)), Ordering::Relaxed);
    }

    pub(super) fn answer_gripper(&self, order: u32, result: AdapterResult<()>) {
        *lock(&self.gripper) = Some((order, result));
        self.answered();
    }

    /// Raises the listener's event: a stop or a gripper command was answered.
    pub(super) fn answered(&self) {
        if let Some(listener) = self.listener.get() {
            listener.raise();
        }
    }

    /// Returns the text of the device's present error; empty if there is none.
    pub fn error_text(&self) -> String {
        lock(&self.text).error.clone()
    }

    pub(super) fn set_error_text(&self, text: String) {
        lock(&self.text).error = text;
    }

    /// Returns the device's own state and mode codes; `None` before they were read, and for a device without them.
    pub fn codes(&self) -> Option<RobotState> {
        *lock(&self.codes)
    }

    pub(super) fn set_codes(&self, codes: RobotState) {
        *lock(&self.codes) = Some(codes);
    }

    /// Returns the latest values that change slowly.
    pub fn details(&self) -> Details {
        *lock(&self.details)
    }

    /// Publishes values that change slowly. Never waits for a reader: `false` if one holds them now.
    pub(super) fn publish_details(&self, details: &Details) -> bool {
        self.details.try_lock().is_ok_and(|mut published| {
            *published = *details;
            true
        })
    }

    /// Does something while a reader holds the values that change slowly.
    #[cfg(test)]
    pub(super) fn while_details_are_read(&self, act: impl FnOnce()) {
        let _held = lock(&self.details);
        act();
    }

    /// Returns recent episodes, the newest last.
    pub fn episodes(&self) -> Vec<Episode> {
        lock(&self.text).episodes.iter().cloned().collect()
    }

    /// Counts trouble. Returns whether it is to be logged: each text once until the trouble is over, because on a lost
    /// arm reads and writes fail in turn.
    pub(super) fn trouble(&self, now: Mono, text: &str) -> bool {
        let mut all = lock(&self.text);
        let open = all.episodes.back_mut().filter(|e| e.until.is_none());
        if let Some(open) = open {
            open.count += 1;
            if all.logged.iter().any(|logged| logged == text) || all.logged.len() == MAX_LINES_PER_EPISODE {
                return false;
            }
        }
        all.logged.push(text.to_owned());
        if let Some(before) = all.episodes.back_mut().filter(|e| e.until.is_none()) {
            before.until = Some(now);
        }
        if all.episodes.len() == EPISODES {
            all.episodes.pop_front();
        }
        all.episodes.push_back(Episode { since: now, until: None, count: 1, text: text.to_owned() });
        true
    }

    /// Ends the episode and returns its text.
    pub(super) fn over(&self, now: Mono) -> Option<String> {
        let mut all = lock(&self.text);
        let last = all.episodes.back_mut().filter(|e| e.until.is_none())?;
        last.until = Some(now);
        let text = last.text.clone();
        all.logged.clear();
        Some(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_gripper_command_has_its_own_answer() {
        let (health, wake) = (Health::default(), Wake::new().unwrap());
        health.wake_on_answers(wake.clone());
        assert_eq!(health.gripper_answer(1), None);
        health.answer_gripper(1, Err(AdapterError::Unsupported));
        assert!(wake.wait(std::time::Duration::ZERO));
        assert_eq!(health.gripper_answer(1), Some(Err(AdapterError::Unsupported)));
        assert_eq!(health.gripper_answer(2), None, "the answer to the previous command does not count");
        health.answer_gripper(3, Ok(()));
        assert!(matches!(health.gripper_answer(2), Some(Err(AdapterError::Rejected(_)))), "it never reached the arm");
        health.answer_gripper(u32::MAX, Ok(()));
        assert_eq!(health.gripper_answer(0), None, "numbers wrap around");
    }

    #[test]
    fn an_outage_changes_the_rate_little_and_a_slower_arm_much() {
        let health = Health::default();
        let states = |count: usize, interval: f64| (0..count).for_each(|_| health.state_came(interval));
        states(100, 0.004);
        assert!((health.rate() - 250.0).abs() < 1.0, "{}", health.rate());
        states(1, 60.0);
        assert!(health.rate() > 150.0, "after an outage: {}", health.rate());
        states(150, 1.0);
        assert!((health.rate() - 1.0).abs() < 0.1, "{}", health.rate());
    }

    #[test]
    fn trouble_is_logged_once_per_episode() {
        let health = Health::default();
        let logged = |text: &str| health.trouble(Mono(1), text);
        assert!(logged("no state") && logged("no command"));
        assert!((0..9).all(|_| !logged("no state") && !logged("no command")), "alternating trouble is not new");
        let counts: Vec<u64> = health.episodes().iter().map(|e| e.count).collect();
        assert_eq!(counts, [2, 19], "the first episode, and the second that replaced it");
        assert_eq!(health.over(Mono(2)).as_deref(), Some("no command"));
        assert_eq!(health.over(Mono(3)), None);
        assert!(logged("no state"), "a new episode is logged");
        assert_eq!((0..99).filter(|n| logged(&format!("trouble {n}"))).count(), MAX_LINES_PER_EPISODE - 1);
    }
}
