//! Names of nodes, topics and services as keys of zenoh: the wire of rmw_zenoh.
//!
//! ```text
//!  data:  DOMAIN/NAME/TYPE/HASH, such as 0/joint_states/sensor_msgs::msg::dds_::JointState_/RIHS01_a13e…
//!  node:  @ros2_lv/DOMAIN/ZID/NODE/NODE/NN/%/NAMESPACE/NODE_NAME
//!  its parts: …/ZID/NODE/ENTITY/MP or SS/%/NAMESPACE/NODE_NAME/NAME/TYPE/HASH/QOS
//! ```
//!
//! The keys of nodes and their parts are tokens of liveliness: of them other nodes make their graph.

use super::types::Type;

/// Name of the node.
pub const NODE: &str = "dimos";
/// The node's number in its session; it has only one.
const NODE_ID: u32 = 0;

/// How a topic is delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Qos {
    /// Reliable, the last ten: also of services.
    Ordinary,
    /// The last one is also delivered to who subscribes later: `transient_local`.
    Latched,
}

impl Qos {
    /// Returns it as tokens have it: what differs from the defaults of rmw_zenoh, which keeps 42.
    const fn token(self) -> &'static str {
        match self {
            Self::Ordinary => "::,10:,:,:,,",
            Self::Latched => ":1:,1:,:,:,,",
        }
    }
}

/// What a node offers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// A publisher.
    Publisher(Qos),
    /// A service.
    Service,
}

/// A node, for its keys.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Names {
    /// Domain of ROS.
    pub domain: u32,
    /// Namespace; empty: none.
    pub namespace: String,
    /// Number of its session.
    pub zid: String,
}

impl Names {
    /// Returns the whole name of a topic or service: `/cell1/joint_states`.
    pub fn whole(&self, name: &str) -> String {
        if self.namespace.is_empty() { format!("/{name}") } else { format!("/{}/{name}", self.namespace) }
    }

    /// Returns the key of a topic or service.
    pub fn data(&self, name: &str, of: Type) -> String {
        format!("{}/{}/{}", self.domain, self.whole(name).trim_start_matches('/'), of.key())
    }

    /// Returns the token of the node.
    pub fn node(&self) -> String {
        self.token(NODE_ID, "NN")
    }

    /// Returns the token of a part of the node. `entity`: its number.
    pub fn part(&self, entity: u32, part: Part, name: &str, of: Type) -> String {
        let (kind, qos) = match part {
            Part::Publisher(qos) => ("MP", qos),
            Part::Service => ("SS", Qos::Ordinary),
        };
        let token = self.token(entity, kind);
        format!("{token}/{}/{}/{}", mangled(&self.whole(name)), of.key(), qos.token())
    }

    fn token(&self, entity: u32, kind: &str) -> String {
        let namespace = mangled(&format!("/{}", self.namespace));
        format!("@ros2_lv/{}/{}/{NODE_ID}/{entity}/{kind}/%/{namespace}/{NODE}", self.domain, self.zid)
    }
}

/// Returns a name as one chunk of a key.
fn mangled(name: &str) -> String {
    name.replace('/', "%")
}

#[cfg(test)]
mod tests {
    use super::super::types::{JOINT_STATE, TEXT};
    use super::*;

    #[test]
    fn keys_are_those_of_rmw_zenoh() {
        let names = Names { domain: 0, namespace: String::new(), zid: "ab12".into() };
        let (joints, text) = (JOINT_STATE.key(), TEXT.key());
        assert_eq!(names.data("joint_states", JOINT_STATE), format!("0/joint_states/{joints}"));
        assert_eq!(names.node(), "@ros2_lv/0/ab12/0/0/NN/%/%/dimos");
        let wanted = format!("@ros2_lv/0/ab12/0/3/MP/%/%/dimos/%joint_states/{joints}/::,10:,:,:,,");
        assert_eq!(names.part(3, Part::Publisher(Qos::Ordinary), "joint_states", JOINT_STATE), wanted);
        let names = Names { domain: 7, namespace: "cell1/left".into(), ..names };
        assert_eq!(names.data("robot_description", TEXT), format!("7/cell1/left/robot_description/{text}"));
        let wanted =
            format!("@ros2_lv/7/ab12/0/4/MP/%/%cell1%left/dimos/%cell1%left%robot_description/{text}/:1:,1:,:,:,,");
        assert_eq!(names.part(4, Part::Publisher(Qos::Latched), "robot_description", TEXT), wanted);
    }
}
