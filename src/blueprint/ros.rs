//! The section `share.ros`: the run as a node of ROS 2.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::resolve::Checker;
use super::share::Endpoint;
use dimos_core::named::named;
use dimos_yaml::{Diag, Located, quote};

/// Largest domain of ROS 2.
const MAX_DOMAIN: u32 = 232;

named! {
    /// A distribution of ROS 2. They differ in the definitions of some messages.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum Distro {
        /// Of 2024.
        #[default]
        Jazzy = "jazzy",
        /// Of 2025.
        Kilted = "kilted",
        /// Of 2026.
        Lyrical = "lyrical",
    }
}

/// The run as the node `dimos` of ROS 2 with the middleware rmw_zenoh: joint states, transforms, robot description,
/// diagnostics, and, with `command`, the action `FollowJointTrajectory` of each trajectory task. Needs its router:
/// `ros2 run rmw_zenoh_cpp rmw_zenohd`. See `docs/from-ros.md`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RosEntry {
    /// Router of ROS 2: `tcp/127.0.0.1:7447`.
    pub router: Located<Endpoint>,
    /// Domain: ROS_DOMAIN_ID.
    #[schemars(range(min = 0, max = 232))]
    pub domain: Located<u32>,
    /// Namespace of the node, its topics, services and actions: `cell1`.
    pub namespace: Located<String>,
    /// The distribution of the other nodes: `jazzy`, `kilted`, `lyrical`.
    pub distro: Distro,
    /// Whether ROS may move arms. Every program that reaches the router can then.
    pub command: bool,
}

impl Default for RosEntry {
    fn default() -> Self {
        let config = RosConfig::default();
        Self {
            router: config.router.into(),
            domain: config.domain.into(),
            namespace: config.namespace.into(),
            distro: config.distro,
            command: config.command,
        }
    }
}

/// The run as a node of ROS 2, checked.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RosConfig {
    /// Router of ROS 2.
    pub router: Endpoint,
    /// Domain.
    pub domain: u32,
    /// Namespace, without slashes at its ends; empty: none.
    pub namespace: String,
    /// The distribution of the other nodes.
    pub distro: Distro,
    /// Whether ROS may move arms.
    pub command: bool,
}

impl Default for RosConfig {
    fn default() -> Self {
        let router = Endpoint { tls: false, host: "127.0.0.1".into(), port: 7447 };
        Self { router, domain: 0, namespace: String::new(), distro: Distro::default(), command: false }
    }
}

/// Returns whether it can be a name in ROS 2: parts of letters, digits and `_`, none of which begins with a digit.
pub fn is_ros_name(name: &str) -> bool {
    let good = |part: &str| {
        !part.starts_with(|c: char| c.is_ascii_digit())
            && !part.is_empty()
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    name.len() <= 128 && name.split('/').all(good)
}

/// Checks the section.
pub(super) fn resolve(checker: &mut Checker<'_>, entry: &Located<RosEntry>) -> RosConfig {
    if entry.domain.value > MAX_DOMAIN {
        let diag = Diag::error(format!("domain is {} (limit {MAX_DOMAIN})", entry.domain.value));
        checker.error(entry.domain.at, diag.hint("the value of ROS_DOMAIN_ID of the other nodes"));
    }
    let namespace = entry.namespace.value.trim_matches('/');
    if !namespace.is_empty() && !is_ros_name(namespace) {
        let diag = Diag::error(format!("{} cannot be a namespace of ROS 2", quote(namespace)));
        checker.error(entry.namespace.at, diag.hint("use letters, digits and '_', in parts separated by '/'"));
    }
    RosConfig {
        router: entry.router.value.clone(),
        domain: entry.domain.value,
        namespace: namespace.to_owned(),
        distro: entry.distro,
        command: entry.command,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_ros_have_letters_digits_and_underscores() {
        for good in ["cell1", "a/b", "_x", "traj_arm"] {
            assert!(is_ros_name(good), "{good}");
        }
        for wrong in ["", "1cell", "a//b", "a-b", "a/", "*", "ä", "a b"] {
            assert!(!is_ros_name(wrong), "{wrong}");
        }
    }
}
