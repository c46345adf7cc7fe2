//! The section `share`: a run on the network.

use std::collections::BTreeMap;
use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use crate::blueprint::planner_files::file;
use crate::blueprint::resolve::Checker;
use crate::blueprint::ros;
use dimos_core::named::named;
use dimos_yaml::range::positive;
use dimos_yaml::{Diag, Keyed, Located, NodeId, quote};

pub use crate::blueprint::ros::{Distro, RosConfig, RosEntry, is_ros_name};

/// User name of clients without a certificate.
pub const ANYONE: &str = "-";
/// Maximum number of clients: a run has 128 connections, and each client takes two.
const MOST_CLIENTS: usize = 48;

/// The run on a network: `dimos --at PLACE` on other computers. Without this section nothing of the run is on a
/// network. See `docs/many-machines.md`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ShareEntry {
    /// Where it listens: `tls/0.0.0.0:7447`, or `tcp/127.0.0.1:7447` without encryption, for this computer only.
    pub listen: Vec<Located<Endpoint>>,
    /// Routers to join, such as that of a fleet: `tls/router:7447`.
    pub connect: Vec<Located<Endpoint>>,
    /// Allows `tcp/` beyond this computer: not encrypted, and everyone who reaches the port is the user `-`.
    pub insecure: bool,
    /// The certificates of the gateway.
    pub identity: Option<Located<IdentityEntry>>,
    /// Who may do what, by the common name of the certificate. `-` is everyone without a certificate: on `tcp/`.
    pub users: Keyed<Role>,
    /// A commander that is silent for this time is lost, and its leases are free [s].
    #[serde(deserialize_with = "positive")]
    pub client_timeout: f64,
    /// What becomes of the motions of a lost commander.
    pub on_lost: OnLost,
    /// Whether an observer may end motions: `stop`, `cancel`.
    pub observers_stop: bool,
    /// Whether operators may make arms ready again from another computer, where they may not see them: `arm reset`,
    /// `arm enable`, `arm teach`, `arm take-over`.
    pub remote_enable: bool,
    /// Maximum number of clients of each user.
    #[schemars(range(min = 1, max = 48))]
    pub max_clients: Located<usize>,
    /// The run as a node of ROS 2.
    pub ros: Option<Located<RosEntry>>,
}

impl Default for ShareEntry {
    fn default() -> Self {
        Self {
            listen: Vec::new(),
            connect: Vec::new(),
            insecure: false,
            identity: None,
            users: Keyed::default(),
            client_timeout: 1.0,
            on_lost: OnLost::Cancel,
            observers_stop: true,
            remote_enable: false,
            max_clients: 32.into(),
            ros: None,
        }
    }
}

/// The certificates of a gateway, in PEM.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct IdentityEntry {
    /// The authority that signed the certificates of all who may connect, relative to this file.
    pub ca: String,
    /// The gateway's certificate, relative to this file.
    pub cert: String,
    /// Its private key, relative to this file; readable by its owner only.
    pub key: String,
}

named! {
    /// What a client may do; each role includes those before it.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum Role {
        /// Reads, and ends motions: `stop`, `cancel`.
        Observer = "observer",
        /// Plans, changes the world, and may be the run's planner.
        Planner = "planner",
        /// Moves arms.
        Operator = "operator",
        /// Shuts the run down.
        Owner = "owner",
    }
}

named! {
    /// What becomes of the motions of a commander that is lost.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum OnLost {
        /// They are cancelled: the arms decelerate to rest.
        #[default]
        Cancel = "cancel",
        /// They continue to their ends, as those of a local client do.
        Finish = "finish",
    }
}

/// A network address with its protocol: `tls/cell1:7447`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Endpoint {
    /// Whether the connection is encrypted, and both ends show a certificate.
    pub tls: bool,
    /// Name or IP address; an IPv6 address in brackets.
    pub host: String,
    /// Port; 0 for any free one, where something listens.
    pub port: u16,
}

impl Endpoint {
    /// Returns whether only this computer can reach it.
    pub fn is_loopback(&self) -> bool {
        let address = self.host.trim_start_matches('[').trim_end_matches(']');
        self.host == "localhost" || address.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}:{}", if self.tls { "tls" } else { "tcp" }, self.host, self.port)
    }
}

impl FromStr for Endpoint {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{} is no endpoint\nhint: write tls/HOST:PORT or tcp/HOST:PORT", quote(text));
        let (protocol, address) = text.split_once('/').ok_or_else(wrong)?;
        let tls = match protocol {
            "tls" => true,
            "tcp" => false,
            _ => return Err(wrong()),
        };
        let (host, port) = address.rsplit_once(':').ok_or_else(wrong)?;
        let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_' | ':' | '[' | ']');
        let bracketed = host.starts_with('[') && host.ends_with(']');
        if host.is_empty() || !host.chars().all(good) || (host.contains(':') && !bracketed) {
            return Err(wrong());
        }
        Ok(Self { tls, host: host.to_owned(), port: port.parse().map_err(|_| wrong())? })
    }
}

impl TryFrom<String> for Endpoint {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<Endpoint> for String {
    fn from(endpoint: Endpoint) -> Self {
        endpoint.to_string()
    }
}

impl JsonSchema for Endpoint {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Endpoint".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": r"^(tcp|tls)/.+:[0-9]+$" })
    }
}

/// How a run is shared, checked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ShareConfig {
    /// Where it listens.
    pub listen: Vec<Endpoint>,
    /// Routers to join.
    pub connect: Vec<Endpoint>,
    /// Whether it may listen beyond this computer without encryption.
    pub insecure: bool,
    /// Its certificates.
    pub identity: Option<Identity>,
    /// Who may do what, by name.
    pub users: BTreeMap<String, Role>,
    /// A commander that is silent for this time is lost [s].
    pub client_timeout: f64,
    /// What becomes of the motions of a lost commander.
    pub on_lost: OnLost,
    /// Whether an observer may end motions.
    pub observers_stop: bool,
    /// Whether operators may reset and enable arms.
    pub remote_enable: bool,
    /// Maximum number of clients of each user.
    pub max_clients: usize,
    /// The run as a node of ROS 2.
    #[serde(default)]
    pub ros: Option<RosConfig>,
}

/// Certificates in PEM.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity {
    /// The authority that signed the certificates of both sides.
    pub ca: PathBuf,
    /// The certificate.
    pub cert: PathBuf,
    /// Its private key.
    pub key: PathBuf,
}

impl Default for ShareConfig {
    /// Listens nowhere yet; everything else as a blueprint has it by default.
    fn default() -> Self {
        let entry = ShareEntry::default();
        Self {
            listen: Vec::new(),
            connect: Vec::new(),
            insecure: false,
            identity: None,
            users: BTreeMap::new(),
            client_timeout: entry.client_timeout,
            on_lost: entry.on_lost,
            observers_stop: entry.observers_stop,
            remote_enable: entry.remote_enable,
            max_clients: entry.max_clients.value,
            ros: None,
        }
    }
}

impl ShareConfig {
    /// Returns what is wrong with it as a whole, with a hint; `None` if nothing is.
    pub fn mistake(&self) -> Option<(String, &'static str)> {
        if self.listen.is_empty() && self.connect.is_empty() && self.ros.is_none() {
            let hint = "give `listen: [tls/0.0.0.0:7447]`, `connect` to a router, or `ros: {}`";
            return Some(("it listens nowhere".into(), hint));
        }
        let endpoints = || self.listen.iter().chain(&self.connect).chain(self.ros.as_ref().map(|ros| &ros.router));
        if let Some(open) = endpoints().find(|e| !e.tls && !e.is_loopback())
            && !self.insecure
        {
            let text = format!("{open} is open to the network, not encrypted, and asks for no certificate");
            return Some((text, "use tls/ with certificates (docs/many-machines.md), or set `insecure: true`"));
        }
        if let Some(tls) = endpoints().find(|e| e.tls).filter(|_| self.identity.is_none()) {
            return Some((
                format!("{tls} needs certificates"),
                "give `identity: {ca, cert, key}`: docs/many-machines.md",
            ));
        }
        let bad = self.users.keys().find(|name| name.as_str() != ANYONE && !is_user(name));
        if let Some(name) = bad {
            let text = format!("{} cannot be a user", quote(name));
            return Some((text, "use letters, digits, '.', '-', '_' and '@', as in the certificate's common name"));
        }
        None
    }
}

/// Returns whether a user can have this name: it is part of keys, which have separators and wildcards.
pub fn is_user(name: &str) -> bool {
    let good = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
    name != ANYONE
        && (1..=64).contains(&name.len())
        && name.chars().all(|c| good(c) || c == '@')
        && !name.starts_with('@')
}

/// Checks the section, and resolves its paths.
pub(super) fn resolve(checker: &mut Checker<'_>, entry: &Located<ShareEntry>) -> ShareConfig {
    let path = |checker: &Checker<'_>, at: NodeId, path: &str| file(checker, at, path);
    let config = ShareConfig {
        listen: entry.listen.iter().map(|e| e.value.clone()).collect(),
        connect: entry.connect.iter().map(|e| e.value.clone()).collect(),
        insecure: entry.insecure,
        identity: entry.identity.as_ref().map(|identity| Identity {
            ca: path(checker, identity.at, &identity.ca),
            cert: path(checker, identity.at, &identity.cert),
            key: path(checker, identity.at, &identity.key),
        }),
        users: entry.users.0.iter().map(|(name, role)| (name.value.clone(), *role)).collect(),
        client_timeout: entry.client_timeout,
        on_lost: entry.on_lost,
        observers_stop: entry.observers_stop,
        remote_enable: entry.remote_enable,
        max_clients: entry.max_clients.value,
        ros: entry.ros.as_ref().map(|face| ros::resolve(checker, face)),
    };
    if !(1..=MOST_CLIENTS).contains(&config.max_clients) {
        let diag = Diag::error(format!("max_clients is {} (limit {MOST_CLIENTS})", config.max_clients));
        checker
            .error(entry.max_clients.at, diag.hint("a run has 128 connections, which the clients of all users share"));
    }
    // Where a key could not be read, what follows from its absence is no mistake.
    let whole = |list| {
        !checker.tree.is_damaged(list) && !checker.tree.items(list).iter().any(|item| checker.lost.dropped(*item))
    };
    let read = ["listen", "connect", "insecure", "identity", "users", "ros"]
        .iter()
        .all(|key| checker.has(entry.at, key) && checker.tree.get(entry.at, key).is_none_or(whole));
    if let Some((what, hint)) = config.mistake().filter(|_| read) {
        let router = entry.ros.as_ref().map(|ros| &ros.router);
        let endpoints = entry.listen.iter().chain(&entry.connect).chain(router);
        let named = endpoints.filter(|e| what.starts_with(&e.to_string())).map(|e| e.at).next();
        let user = entry.users.0.iter().find(|(name, _)| what.starts_with(&quote(name))).map(|(name, _)| name.at);
        checker.error(named.or(user).unwrap_or(entry.at), Diag::error(what).hint(hint));
    }
    config
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endpoint_has_a_protocol_a_host_and_a_port() {
        for (text, loopback) in [
            ("tcp/127.0.0.1:7447", true),
            ("tls/localhost:0", true),
            ("tcp/[::1]:7447", true),
            ("tls/cell-1.lab:7447", false),
            ("tcp/0.0.0.0:7447", false),
            ("tcp/[::]:7447", false),
            // Not this computer, though it begins like it.
            ("tcp/127.0.0.1.example.org:7447", false),
        ] {
            let endpoint: Endpoint = text.parse().unwrap();
            assert_eq!((endpoint.to_string().as_str(), endpoint.is_loopback()), (text, loopback));
        }
        for wrong in
            ["", "cell1:7447", "udp/cell1:7447", "tcp/cell1", "tcp/:7447", "tcp/a:b:1", "tls/a:70000", "tcp/a#b=c:1"]
        {
            assert!(wrong.parse::<Endpoint>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn users_are_names_that_fit_into_keys() {
        for good in ["alice", "planner-box", "a.b@lab", "x_1"] {
            assert!(is_user(good), "{good}");
        }
        for wrong in ["", "-", "a/b", "*", "a*", "$", "a b", "a?", "a#", "@a", "ä"] {
            assert!(!is_user(wrong), "{wrong}");
        }
    }
}
