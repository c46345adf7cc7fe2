//! The joint states of the run, published for Python dimos with its names, and kept for those who ask.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use zenoh::bytes::ZBytes;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

use super::lcm;
use super::names::Names;
use crate::rpc::client::{Client, ClientError};
use crate::rpc::streams::{JointState, Stream, Subscribe};
use crate::sync::lock;

/// Port and type of the stream.
const STREAM: &str = "coordinator_joint_state/sensor_msgs.JointState";
/// Pause before the run is asked again for its states.
const PAUSE: Duration = Duration::from_millis(200);
/// Age after which a state is no longer the newest.
const STALE_AFTER: Duration = Duration::from_millis(500);

/// The newest state.
#[derive(Debug, Default)]
pub struct States {
    newest: Mutex<Option<(Instant, Arc<lcm::JointState>)>>,
    ticks: AtomicU64,
    ended: AtomicBool,
}

impl States {
    /// Returns the newest state, unless it is old.
    pub fn newest(&self) -> Option<Arc<lcm::JointState>> {
        let newest = lock(&self.newest);
        newest.as_ref().filter(|(at, _)| at.elapsed() < STALE_AFTER).map(|(_, state)| state.clone())
    }

    /// Returns the number of the newest tick.
    pub fn ticks(&self) -> u64 {
        self.ticks.load(Ordering::Acquire)
    }

    /// Publishes no more.
    pub fn end(&self) {
        self.ended.store(true, Ordering::Release);
    }
}

/// Publishes the states of a run below `prefix` in these sessions until [`States::end`].
pub fn publish(
    sessions: &[&Session],
    prefix: &str,
    (run, socket): (&str, PathBuf),
    names: Arc<Names>,
) -> zenoh::Result<Arc<States>> {
    let mut publishers = Vec::new();
    for session in sessions {
        // Dropped for a subscriber that is congested: with `Block` one frozen subscriber stops all others for 5 s.
        let publisher = session.declare_publisher(format!("{prefix}{STREAM}"));
        let publisher = publisher.congestion_control(CongestionControl::Drop).priority(Priority::RealTime);
        publishers.push(publisher.express(true).wait()?);
    }
    let states = Arc::new(States::default());
    let reader = Reader { run: run.to_owned(), socket, names, states: states.clone(), publishers };
    std::thread::Builder::new().name("dimos-states".into()).spawn(move || reader.serve())?;
    Ok(states)
}

struct Reader {
    run: String,
    socket: PathBuf,
    names: Arc<Names>,
    states: Arc<States>,
    publishers: Vec<Publisher<'static>>,
}

impl Reader {
    fn serve(self) {
        while !self.has_ended() {
            if let Err(error) = self.read() {
                tracing::debug!("share: python_dimos: {error}");
                std::thread::sleep(PAUSE);
            }
        }
    }

    fn has_ended(&self) -> bool {
        self.states.ended.load(Ordering::Acquire)
    }

    fn read(&self) -> Result<(), ClientError> {
        let mut client = Client::connect(&self.run, &self.socket)?;
        client.call(Subscribe::to(Stream::CoordinatorJointState))?;
        while !self.has_ended() {
            let message = match client.next_message() {
                Ok(message) => message,
                // A blueprint may turn the stream off.
                Err(error) if error.is_timeout() => continue,
                Err(error) => return Err(error),
            };
            let Ok(state) = serde_json::from_value::<JointState>(message.data) else { continue };
            self.states.ticks.store(state.tick, Ordering::Release);
            let state = translated(state, &self.names);
            if !self.has_ended() {
                let message = ZBytes::from(state.encode());
                self.publishers.iter().for_each(|publisher| drop(publisher.put(message.clone()).wait()));
            }
            *lock(&self.states.newest) = Some((Instant::now(), Arc::new(state)));
        }
        Ok(())
    }
}

/// Returns a state with the names of Python dimos. Leaves out joints whose positions are unknown, as it does.
fn translated(state: JointState, names: &Names) -> lcm::JointState {
    let mut out = lcm::JointState { stamp: state.stamp, frame_id: state.frame_id, ..lcm::JointState::default() };
    let (mut velocities, mut efforts) = (Vec::new(), Vec::new());
    for (at, name) in state.name.iter().enumerate() {
        let (Some(theirs), Some(Some(position))) = (names.theirs(name), state.position.get(at)) else { continue };
        out.name.push(theirs.to_owned());
        out.position.push(*position);
        velocities.push(state.velocity.get(at).copied().flatten());
        efforts.push(state.effort.get(at).copied().flatten());
    }
    out.velocity = known(velocities);
    out.effort = known(efforts);
    out
}

/// Returns the values, NaN for those that are unknown; empty if all are.
fn known(values: Vec<Option<f64>>) -> Vec<f64> {
    if values.iter().all(Option::is_none) {
        return Vec::new();
    }
    values.into_iter().map(|value| value.unwrap_or(f64::NAN)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rpc::report::{ArmStateReport, JointReport, StateReport, StatusReport};

    #[test]
    fn joints_without_a_position_are_left_out_and_unknown_values_are_no_zeros() {
        let joint = |name: &str| JointReport { name: name.into(), ..JointReport::default() };
        let joints = vec![joint("a_joint1"), joint("a_joint2"), joint("b_joint1")];
        let arms = vec![ArmStateReport { hardware_id: "a".into(), joints, ..ArmStateReport::default() }];
        let report = StateReport { arms, ..StateReport::default() };
        let names = Names::of(&StatusReport::default(), &report, &Default::default()).unwrap();
        let state = JointState {
            name: vec!["a_joint1".into(), "a_joint2".into(), "b_joint1".into()],
            position: vec![Some(1.0), None, Some(3.0)],
            velocity: vec![Some(0.1), Some(0.2), None],
            effort: vec![None, Some(2.0), None],
            ..JointState::default()
        };
        let state = translated(state, &names);
        assert_eq!(state.name, ["a/joint1", "b/joint1"]);
        assert_eq!(state.position, [1.0, 3.0]);
        assert!(state.velocity[0] == 0.1 && state.velocity[1].is_nan());
        assert!(state.effort.is_empty());
    }
}
