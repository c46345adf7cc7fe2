//! What a gateway says of itself and of its clients: `register_gateway`, `on_behalf_of`.
//!
//! A gateway (`dimos share`) is a client of the run's socket that speaks for programs on other computers, with one
//! connection for each of them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::{Done, Method};

/// Maximum length of a client's name [bytes].
const MAX_CLIENT: usize = 128;

/// Parameters of `on_behalf_of`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OnBehalfOf {
    /// The client, as people know it: `alice on 10.0.0.5`; printable, at most 128 bytes. `status` and `LEASE_HELD` show
    /// it; nothing is decided by it.
    pub client: String,
    /// Whether motions that begin on this connection are cancelled when it ends.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub cancel_at_end: bool,
}

impl Method for OnBehalfOf {
    const NAME: &'static str = "on_behalf_of";
    type Reply = Done;

    fn check(&self) -> Result<(), String> {
        match self.client.len() {
            0 => Err("client is empty".into()),
            1..=MAX_CLIENT if !self.client.chars().any(char::is_control) => Ok(()),
            1..=MAX_CLIENT => Err("client has a character that cannot be printed".into()),
            length => Err(format!("client has {length} bytes (limit {MAX_CLIENT})")),
        }
    }
}

/// Parameters of `register_gateway`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RegisterGateway {
    /// Where it listens, and the routers that it has joined: `tls/0.0.0.0:7447`.
    pub endpoints: Vec<String>,
    /// Its clients: `alice on 10.0.0.5`.
    #[serde(default)]
    pub clients: Vec<String>,
    /// Its faces to other systems: ROS 2.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub faces: Vec<FaceReport>,
    /// Whether it does not listen yet: it is the run's only gateway already, and not in `status`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub starting: bool,
}

/// A face of the run to another system.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FaceReport {
    /// The system: `ros`.
    pub face: String,
    /// What the run is there: `ControlCoordinator`.
    pub name: String,
    /// Whether it serves.
    pub serves: bool,
    /// Whether its programs may move arms.
    pub command: bool,
    /// Why it does not serve.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

impl Method for RegisterGateway {
    const NAME: &'static str = "register_gateway";
    type Reply = Done;
}

/// The gateway in `status`.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GatewayReport {
    /// Process id; absent if the system does not report it.
    pub pid: Option<i32>,
    /// Where it listens, and the routers that it has joined.
    pub endpoints: Vec<String>,
    /// Its clients.
    pub clients: Vec<String>,
    /// Its faces to other systems.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub faces: Vec<FaceReport>,
}
