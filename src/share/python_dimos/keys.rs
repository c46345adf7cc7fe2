//! The keys of Python dimos: `dimos/<port>/<type>` of streams, or `dimos-domains/<domain>/…`;
//! `dimos/rpc/<name>/<method>` of calls, in every domain.

use crate::blueprint::share::{PythonDimosConfig, Role, ShareConfig};

/// Methods that read, and those that do nothing or fail.
const READS: [&str; 23] = [
    "add_hardware",
    "add_task",
    "build",
    "describe_task",
    "get_active_tasks",
    "get_joint_positions",
    "get_skills",
    "get_stream_descriptors",
    "get_task",
    "get_tick_count",
    "list_hardware",
    "list_joints",
    "list_tasks",
    "peek_stream",
    "remove_hardware",
    "remove_task",
    "reset_runtime_state",
    "set_activated",
    "set_dry_run",
    "set_module_ref",
    "set_transport",
    "start",
    "stop",
];
/// Methods that end motion.
const ENDS: [&str; 1] = ["cancel_trajectory"];
/// Methods that may begin one.
const MOVES: [&str; 3] = ["execute_trajectory", "set_estop", "task_invoke"];

/// Returns the beginning of the keys of streams.
pub fn prefix(config: &PythonDimosConfig) -> String {
    if config.domain.is_empty() { "dimos/".to_owned() } else { format!("dimos-domains/{}/", config.domain) }
}

/// Returns the key of all streams that are published.
pub fn streams(config: &PythonDimosConfig) -> String {
    format!("{}coordinator_joint_state/**", prefix(config))
}

/// Returns the key of all calls.
pub fn calls(config: &PythonDimosConfig) -> String {
    format!("dimos/rpc/{}/*", config.name)
}

/// Returns the method of a call's key; `None` unless it names exactly one.
pub fn method<'k>(key: &'k str, config: &PythonDimosConfig) -> Option<&'k str> {
    let method = key.strip_prefix("dimos/rpc/")?.strip_prefix(&*config.name)?.strip_prefix('/')?;
    (!method.is_empty() && !method.contains(['*', '$', '/'])).then_some(method)
}

/// Returns the keys of the calls that a role may make.
pub fn calls_of(role: Role, share: &ShareConfig, config: &PythonDimosConfig) -> Vec<String> {
    let ends = share.observers_stop || role > Role::Observer;
    let methods =
        READS.iter().chain(ENDS.iter().filter(|_| ends)).chain(MOVES.iter().filter(|_| role >= Role::Operator));
    methods.map(|method| format!("dimos/rpc/{}/{method}", config.name)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_call_names_one_method_and_roles_have_theirs() {
        let config = PythonDimosConfig::default();
        assert_eq!(method("dimos/rpc/ControlCoordinator/list_joints", &config), Some("list_joints"));
        for wrong in
            ["dimos/rpc/ControlCoordinator/*", "dimos/rpc/*/list_joints", "dimos/**", "dimos/rpc/Other/list_joints"]
        {
            assert_eq!(method(wrong, &config), None, "{wrong}");
        }
        let share = ShareConfig::default();
        let may = |role, method: &str, share: &ShareConfig| {
            calls_of(role, share, &config).contains(&format!("dimos/rpc/ControlCoordinator/{method}"))
        };
        assert!(may(Role::Observer, "list_joints", &share) && may(Role::Observer, "cancel_trajectory", &share));
        assert!(!may(Role::Observer, "task_invoke", &share) && !may(Role::Planner, "execute_trajectory", &share));
        assert!(may(Role::Operator, "task_invoke", &share));
        assert!(!may(Role::Observer, "cancel_trajectory", &ShareConfig { observers_stop: false, ..share }));
    }
}
