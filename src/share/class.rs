//! Which right a request needs, and who has it.

use crate::blueprint::share::{ANYONE, Role, ShareConfig};
use dimos_rpc::api::Class;
use dimos_rpc::error::{Code, RpcError};

/// The request for a file of the live view.
pub const PAGE: &str = "page";

/// Returns the class of a method, or of the request for a file of the live view; `None` for a method that is not for
/// clients on other computers.
pub fn class_of(method: &str) -> Option<Class> {
    // Answered by the gateway.
    if method == PAGE { Some(Class::Read) } else { Class::of(method) }
}

/// Returns whether a role has this right.
fn includes(role: Role, class: Class, config: &ShareConfig) -> bool {
    match class {
        Class::Read => true,
        Class::End => config.observers_stop || role > Role::Observer,
        Class::Plan => role >= Role::Planner,
        Class::Move => role >= Role::Operator,
        Class::Enable => role >= Role::Operator && config.remote_enable,
        Class::Own => role >= Role::Owner,
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
    if includes(role, class, config) {
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
            assert_eq!(class_of(method).is_none(), OF_GATEWAYS.contains(method), "{method}: give it a class");
        }
        assert_eq!(class_of("mvoe"), None);
    }

    #[test]
    fn what_moves_an_arm_needs_an_operator_and_ending_motion_nobody() {
        let config = config();
        let may = |user: &str, method: &str| permit(user, method, class_of(method).unwrap(), &config).is_ok();
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
