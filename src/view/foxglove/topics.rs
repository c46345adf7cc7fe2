//! The channels: topics and schemas of a log.

use dimos_log::cdr::Encoder;
use dimos_log::display_messages::{DiagnosticArray, MarkerArray, TFMessage};
use dimos_log::messages::{Event, JointState, Log, Text};
use dimos_log::wire::Message;

/// A channel; its index in [`Topic::ALL`] is its id.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// Positions, velocities, efforts of all joints.
    JointStates,
    /// Poses of links that move.
    Tf,
    /// Poses of links that do not.
    TfStatic,
    /// The robots as one URDF.
    RobotDescription,
    /// Objects of the world.
    Markers,
    /// Condition of arms and tick.
    Diagnostics,
    /// Events.
    Events,
    /// Events as lines of the text log.
    Rosout,
}

impl Topic {
    /// All channels.
    pub const ALL: [Self; 8] = [
        Self::JointStates,
        Self::Tf,
        Self::TfStatic,
        Self::RobotDescription,
        Self::Markers,
        Self::Diagnostics,
        Self::Events,
        Self::Rosout,
    ];

    /// Returns its name, and name and text of its schema.
    pub fn channel(self) -> (&'static str, &'static str, String) {
        fn of<M: Message>(topic: &'static str) -> (&'static str, &'static str, String) {
            (topic, M::SCHEMA, M::schema_text())
        }
        match self {
            Self::JointStates => of::<JointState>("/joint_states"),
            Self::Tf => of::<TFMessage>("/tf"),
            Self::TfStatic => of::<TFMessage>("/tf_static"),
            Self::RobotDescription => of::<Text>("/robot_description"),
            Self::Markers => of::<MarkerArray>("/markers"),
            Self::Diagnostics => of::<DiagnosticArray>("/diagnostics"),
            Self::Events => of::<Event>("/dimos/events"),
            Self::Rosout => of::<Log>("/rosout"),
        }
    }
}

/// Returns a message as its channel has it.
pub fn encoded(message: &impl Message) -> Vec<u8> {
    let mut encoder = Encoder::default();
    message.put(&mut encoder);
    encoder.bytes().to_vec()
}
