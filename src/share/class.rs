//! Which right a request needs, and who has it.

use crate::blueprint::share::{ANYONE, Role, ShareConfig};
use dimos_core::named::named;
use dimos_rpc::error::{Code, RpcError};

/// The request for a file of the live view.
pub const PAGE: &str = "page";

named! {
    /// The right that a request needs; part of its key.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Class {
        /// To read.
        Read = "read",
        /// To end motion.
        End = "end",
        /// To plan, to change the world, to be the planner.
        Plan = "plan",
        /// To move an arm, and to change what its motion depends on.
        Move = "move",
        /// To make an arm ready for motion.
        Enable = "enable",
        /// To end the run.
        Own = "own",
    }
}

impl Class {
    /// Returns the class of a method; `None` for a method that is not for clients on other computers.
    pub fn of(method: &str) -> Option<Self> {
        Some(match method {
            // Answered by the gateway.
            PAGE => Self::Read,
            "status" | "state" | "text_log" | "motion" | "planner" | "planning" | "preview" | "world" | "grip"
            | "arm_io" | "arm_payload" | "arm_tool" | "poses" | "robot_description" | "transforms" | "subscribe"
            | "unsubscribe" => Self::Read,
            "stop" | "cancel" => Self::End,
            "plan" | "ik" | "world_add" | "world_move" | "world_remove" | "attach" | "detach" | "register_planner"
            | "planner_answer" => Self::Plan,
            "lease" | "release" | "move" | "move_native" | "execute" | "execute_plan" | "servo" | "velocity"
            | "chunk" | "twist" | "pose" | "start" | "gripper" | "speed" | "arm_disable" | "arm_io_set"
            | "arm_payload_set" | "arm_tool_set" | "pose_save" | "pose_remove" => Self::Move,
            "arm_reset" | "arm_enable" | "arm_teach" | "arm_take_over" => Self::Enable,
            "shutdown" => Self::Own,
            _ => return None,
        })
    }

    /// Returns whether a role has this right.
    fn is_of(self, role: Role, config: &ShareConfig) -> bool {
        match self {
            Self::Read => true,
            Self::End => config.observers_stop || role > Role::Observer,
            Self::Plan => role >= Role::Planner,
            Self::Move => role >= Role::Operator,
            Self::Enable => role >= Role::Operator && config.remote_enable,
            Self::Own => role >= Role::Owner,
        }
    }
}

/// Returns the role of a user: as configured; someone without a certificate observes. `None`: no one by that name.
pub fn role_of(user: &str, config: &ShareConfig) -> Option<Role> {
    config.users.get(user).copied().or_else(|| (user == ANYONE).then_some(Role::Observer))
}

/// Fails unless a user has the right to a method.
pub fn permit(user: &str, method: &str, class: Class, config: &ShareConfig) -> Result<(), RpcError> {
    let Some(role) = role_of(user, config) else {
        let text = format!("{user} is no user of this run");
        return Err(RpcError::new(Code::Forbidden, text).hint("its owner adds users: `share.users` in the blueprint"));
    };
    if class.is_of(role, config) {
        return Ok(());
    }
    let who = if user == ANYONE { "a client without a certificate".to_owned() } else { format!("user {user}") };
    let text = format!("{who} has the role {} here, which does not include `{method}`", role.name());
    let hint = match class {
        Class::Enable if role >= Role::Operator => {
            "do it on the run's computer, in sight of the arm; or set `share.remote_enable: true`"
        }
        Class::End => "the run's owner has taken `stop` and `cancel` from observers: `share.observers_stop`",
        _ => "the run's owner gives roles: `share.users` in the blueprint",
    };
    Err(RpcError::new(Code::Forbidden, text).hint(hint))
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_rpc::api::METHODS;

    /// What only a gateway says of itself.
    const OF_GATEWAYS: [&str; 2] = ["on_behalf_of", "register_gateway"];

    fn config() -> ShareConfig {
        ShareConfig {
            users: [("op".to_owned(), Role::Operator), ("boss".to_owned(), Role::Owner)].into(),
            ..ShareConfig::default()
        }
    }

    #[test]
    fn every_method_has_a_class() {
        for method in METHODS {
            assert_eq!(Class::of(method).is_none(), OF_GATEWAYS.contains(method), "{method}: give it a class");
        }
        assert_eq!(Class::of("mvoe"), None);
    }

    #[test]
    fn what_moves_an_arm_needs_an_operator_and_ending_motion_nobody() {
        let config = config();
        let may = |user: &str, method: &str| permit(user, method, Class::of(method).unwrap(), &config).is_ok();
        for (method, of) in [
            ("state", ["-", "op", "boss"].as_slice()),
            ("stop", &["-", "op", "boss"]),
            ("plan", &["op", "boss"]),
            ("move", &["op", "boss"]),
            ("arm_enable", &[]),
            ("shutdown", &["boss"]),
        ] {
            let allowed: Vec<&str> =
                ["-", "op", "boss", "mallory"].into_iter().filter(|user| may(user, method)).collect();
            assert_eq!(allowed, of, "{method}");
        }
    }

    #[test]
    fn rights_of_their_own_are_given_and_taken() {
        let config = ShareConfig { remote_enable: true, observers_stop: false, ..config() };
        assert!(permit("op", "arm_enable", Class::Enable, &config).is_ok());
        assert!(permit("-", "arm_enable", Class::Enable, &config).is_err());
        let refused = permit("-", "stop", Class::End, &config).unwrap_err();
        assert!(refused.message.contains("a client without a certificate has the role observer"), "{refused}");
    }
}
