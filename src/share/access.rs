//! Rules of access for zenoh: who may send and receive which keys. What is not allowed is denied, before it reaches any
//! code of ours. The classes of requests are checked in [`class`](super::class), which can answer with the reason.

use serde_json::{Value, json};

use super::keys;
use crate::blueprint::share::{ANYONE, ShareConfig};

/// Returns the rules of a run's gateway.
///
/// A rule lets a message pass if its key includes that of the message. So the rules for what the gateway itself
/// declares, with wildcards, are wide, and those for what clients send name the client's user.
pub fn control(run: &str, config: &ShareConfig) -> Value {
    let mut rules = vec![
        rule("list", "ingress", &["declare_liveliness_subscriber", "liveliness_query"], &[keys::alive("*")]),
        rule("streams", "ingress", &["declare_subscriber"], &[keys::stream(run, "**")]),
        rule("read", "egress", &["put", "liveliness_token", "reply"], &[keys::stream(run, "**"), keys::alive(run)]),
        rule(
            "serve",
            "egress",
            &["declare_queryable", "reply", "declare_subscriber", "declare_liveliness_subscriber", "liveliness_query"],
            &[format!("dimos/{run}/**")],
        ),
    ];
    let (mut subjects, mut policies) = (Vec::new(), Vec::new());
    let mut users: Vec<&str> = config.users.keys().map(String::as_str).collect();
    // Someone without a certificate comes by tcp only; then the role of `-` is that of an observer, unless given.
    let open = config.listen.iter().chain(&config.connect).any(|endpoint| !endpoint.tls);
    users.retain(|user| *user != ANYONE);
    if open {
        users.push(ANYONE);
    }
    for user in users {
        let (from, to, asks) = (format!("from {user}"), format!("to {user}"), format!("asks {user}"));
        rules.push(rule(&from, "ingress", &["declare_subscriber"], &[format!("dimos/{run}/to/{user}/**")]));
        rules.push(rule(&to, "egress", &["put"], &[format!("dimos/{run}/to/{user}/**")]));
        let sent = ["query", "put", "liveliness_token"];
        rules.push(rule(&asks, "ingress", &sent, &[format!("dimos/{run}/by/{user}/**")]));
        subjects.push(match user {
            ANYONE => json!({"id": user, "link_protocols": ["tcp"]}),
            _ => json!({"id": user, "link_protocols": ["tls"], "cert_common_names": [user]}),
        });
        let own = ["list".to_owned(), "streams".into(), "read".into(), "serve".into(), from, to, asks];
        policies.push(json!({"rules": own, "subjects": [user]}));
    }
    json!({"access_control": {
        "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }})
}

fn rule(id: &str, flow: &str, messages: &[&str], key_exprs: &[String]) -> Value {
    json!({"id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": key_exprs})
}
