//! What the node publishes: joint states, transforms, the robots' description, diagnostics. Each with its own
//! connection to the run, which is made again when it ends.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::node::{Latched, Node, Topic};
use super::types;
use crate::ros_messages::{diagnostics, joint_state, now, time, transforms};
use dimos_log::messages::Text;
use dimos_rpc::api::{RobotDescription, Status, Transforms};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::server::streams::{Stream, Subscribe};

/// Maximum rate of the joint states [Hz].
const JOINT_STATES: f64 = 100.0;
/// Period of the transforms.
const TRANSFORMS: Duration = Duration::from_millis(40);
/// Period of the diagnostics.
const DIAGNOSTICS: Duration = Duration::from_secs(1);
/// Pause before the run is asked again after an error.
const AGAIN: Duration = Duration::from_millis(200);

/// The run that is published, and whether that has ended.
#[derive(Debug, Clone)]
pub struct Source {
    /// The run.
    pub run: String,
    /// Its socket.
    pub socket: PathBuf,
    /// Whether the node has ended.
    pub ended: Arc<AtomicBool>,
}

impl Source {
    fn has_ended(&self) -> bool {
        self.ended.load(Ordering::Acquire)
    }

    /// Calls `publish` with a connection until the node ends.
    fn repeat(
        self,
        name: &str,
        publish: impl Fn(&Self, Client) -> Result<(), ClientError> + Send + 'static,
    ) -> std::io::Result<()> {
        let serve = move || {
            while !self.has_ended() {
                let published = Client::connect(&self.run, &self.socket).and_then(|client| publish(&self, client));
                if let Err(error) = published {
                    tracing::debug!("share: ros: {error}");
                }
                self.wait(AGAIN);
            }
        };
        std::thread::Builder::new().name(name.into()).spawn(serve).map(drop)
    }

    /// Waits, or until the node ends.
    fn wait(&self, time: Duration) {
        let until = Instant::now() + time;
        while !self.has_ended() && Instant::now() < until {
            std::thread::sleep(AGAIN.min(until.saturating_duration_since(Instant::now())));
        }
    }
}

/// Publishes what a run has.
pub fn publish(node: &Node, source: &Source) -> zenoh::Result<()> {
    let joints = node.topic("joint_states", types::JOINT_STATE)?;
    let (moving, fixed) = (node.topic("tf", types::TRANSFORMS)?, node.latched("tf_static", types::TRANSFORMS)?);
    let description = node.latched("robot_description", types::TEXT)?;
    let condition = node.topic("diagnostics", types::DIAGNOSTICS)?;
    source.clone().repeat("ros-joints", move |source, client| publish_joints(source, client, &joints))?;
    source
        .clone()
        .repeat("ros-tf", move |source, client| publish_transforms(source, client, &description, &fixed, &moving))?;
    source.clone().repeat("ros-condition", move |source, client| publish_condition(source, client, &condition))?;
    Ok(())
}

fn publish_joints(source: &Source, mut client: Client, topic: &Topic) -> Result<(), ClientError> {
    client.call(Subscribe { stream: Stream::CoordinatorJointState, rate: Some(JOINT_STATES), past: false })?;
    while !source.has_ended() {
        match client.next_message() {
            Ok(message) => {
                if let Ok(state) = serde_json::from_value(message.data) {
                    topic.publish(&joint_state(state, String::new()));
                }
            }
            // A blueprint may turn the stream off.
            Err(error) if error.is_timeout() => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Publishes the description of the robots once, then the poses of their links.
fn publish_transforms(
    source: &Source,
    mut client: Client,
    description: &Latched,
    fixed: &Latched,
    moving: &Topic,
) -> Result<(), ClientError> {
    let described = client.call(RobotDescription {})?;
    let Some(urdf) = described.urdf else {
        while !source.has_ended() {
            source.wait(DIAGNOSTICS);
        }
        return Ok(());
    };
    description.publish(&Text { data: urdf });
    fixed.publish(&transforms(described.fixed, now()));
    while !source.has_ended() {
        let reply = client.call(Transforms {})?;
        moving.publish(&transforms(reply.transforms, reply.stamp));
        source.wait(TRANSFORMS);
    }
    Ok(())
}

fn publish_condition(source: &Source, mut client: Client, topic: &Topic) -> Result<(), ClientError> {
    while !source.has_ended() {
        topic.publish(&diagnostics(&client.call(Status {})?, time(now())));
        source.wait(DIAGNOSTICS);
    }
    Ok(())
}
