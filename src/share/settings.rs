//! Settings of zenoh: all that matters is set here, because the library's defaults listen on all interfaces, announce
//! themselves by multicast, and accept messages of 1 GiB.

use std::time::Duration;

use serde_json::{Value, json};
use zenoh::Config;

use super::access;
use super::place::Place;
use crate::blueprint::share::{Identity, RosConfig, ShareConfig};
use dimos_rpc::error::{Code, RpcError};

/// Largest message that is accepted [bytes]: an answer of a planner.
pub const MAX_MESSAGE: usize = 16 << 20;
/// The environment variable with the threads of zenoh, and its value: one thread both sends and receives. Its TLS
/// connections are used by a sender and a receiver without a lock: on two threads they broke every few seconds at
/// 1 kHz, with "handshake not complete" (1.10.2). To be set before any thread starts.
pub const THREADS: (&str, &str) = ("ZENOH_RUNTIME", "(rx: (worker_threads: 1), tx: (handover: rx))");
/// Silence after which a connection ends [ms]. Each end announces its own.
const LEASE: u64 = 1000;
/// Signs of life in that time.
const KEEP_ALIVE: u64 = 4;
/// Maximum time to open a connection.
pub const OPEN_TIMEOUT: Duration = Duration::from_millis(2000);
/// Messages that each queue of a connection holds: the most that zenoh allows.
const QUEUE: usize = 16;
/// First and longest pause between attempts to connect [ms].
const RETRY: (u64, u64) = (100, 500);
/// Sessions beside those of the clients: routers, and clients that are being refused.
const MORE_SESSIONS: usize = 4;
/// Waits of a message for a congested client before it is dropped [µs]: of a whole one, of one in fragments.
const WAIT_BEFORE_DROP: (u64, u64) = (1000, 5000);

/// Returns what all sessions have in common.
fn common() -> Value {
    json!({
        "scouting": {"multicast": {"enabled": false}},
        "adminspace": {"enabled": false},
        "connect": {"retry": {
            "period_init_ms": RETRY.0, "period_max_ms": RETRY.1, "period_increase_factor": 2,
        }},
        "transport": {
            "shared_memory": {"enabled": false},
            "unicast": {
                "open_timeout": OPEN_TIMEOUT.as_millis() as u64,
                "accept_timeout": OPEN_TIMEOUT.as_millis() as u64,
            },
            "link": {
                "tx": {
                    "lease": LEASE,
                    "keep_alive": KEEP_ALIVE,
                    "queue": {"size": queues(), "congestion_control": {"drop": {
                        "wait_before_drop": WAIT_BEFORE_DROP.0,
                        "max_wait_before_drop_fragments": WAIT_BEFORE_DROP.1,
                    }}},
                },
                "rx": {"max_message_size": MAX_MESSAGE},
            },
        },
    })
}

/// Returns the sizes of the queues of a connection. Where one is full, the thread that receives waits for the one that
/// sends, which is itself ([`THREADS`]): with zenoh's default of 2 for most, it was stalled for 5 s now and then.
fn queues() -> Value {
    json!({
        "control": QUEUE, "real_time": QUEUE, "interactive_high": QUEUE, "interactive_low": QUEUE,
        "data_high": QUEUE, "data": QUEUE, "data_low": QUEUE, "background": QUEUE,
    })
}

/// Returns the settings of a gateway.
pub fn of_gateway(run: &str, config: &ShareConfig) -> Result<Config, RpcError> {
    built(&gateway_values(run, config))
}

fn gateway_values(run: &str, config: &ShareConfig) -> Value {
    let endpoints =
        |list: &[crate::blueprint::share::Endpoint]| list.iter().map(ToString::to_string).collect::<Vec<_>>();
    let mut more = json!({
        "mode": "peer",
        "listen": {"endpoints": endpoints(&config.listen), "exit_on_failure": true},
        "connect": {"endpoints": endpoints(&config.connect), "exit_on_failure": false, "timeout_ms": -1},
        "transport": {"unicast": {"max_sessions": config.max_clients * (config.users.len() + 1) + MORE_SESSIONS}},
    });
    if config.listen.iter().chain(&config.connect).any(|endpoint| endpoint.tls)
        && let Some(identity) = &config.identity
    {
        merge(&mut more, tls(identity));
    }
    merge(&mut more, access::control(run, config));
    with_common(more)
}

/// Returns the settings of a client of a place.
pub fn of_client(place: &Place) -> Result<Config, RpcError> {
    built(&client_values(place))
}

fn client_values(place: &Place) -> Value {
    let mut more = json!({
        "mode": "client",
        "listen": {"endpoints": []},
        "connect": {
            "endpoints": [place.endpoint.to_string()],
            // One attempt: that something listens there is known, and a refused certificate is refused again.
            "timeout_ms": 0,
            "exit_on_failure": true,
        },
    });
    if let Some(identity) = &place.identity {
        merge(&mut more, tls(identity));
    }
    with_common(more)
}

/// Returns the settings of a node of ROS 2: a client of its router, for which it waits.
pub fn of_ros(config: &RosConfig, identity: Option<&Identity>) -> Result<Config, RpcError> {
    built(&ros_values(config, identity))
}

fn ros_values(config: &RosConfig, identity: Option<&Identity>) -> Value {
    let mut more = json!({
        "mode": "client",
        "listen": {"endpoints": []},
        "connect": {"endpoints": [config.router.to_string()], "timeout_ms": -1, "exit_on_failure": false},
        // What later subscribers get is distinguished by its time.
        "timestamping": {"enabled": true},
    });
    if let Some(identity) = identity.filter(|_| config.router.tls) {
        merge(&mut more, tls(identity));
    }
    with_common(more)
}

/// Mutual TLS: both ends show a certificate, and look at that of the other.
fn tls(identity: &Identity) -> Value {
    json!({"transport": {"link": {"tls": {
        "root_ca_certificate": identity.ca,
        "listen_certificate": identity.cert,
        "listen_private_key": identity.key,
        "connect_certificate": identity.cert,
        "connect_private_key": identity.key,
        "enable_mtls": true,
        "verify_name_on_connect": true,
        "close_link_on_expiration": true,
    }}}})
}

fn with_common(more: Value) -> Value {
    let mut all = common();
    merge(&mut all, more);
    all
}

fn built(values: &Value) -> Result<Config, RpcError> {
    let refused = |e: zenoh::Error| RpcError::new(Code::Internal, format!("the settings of the network: {e}"));
    Config::from_json5(&values.to_string()).map_err(refused)
}

/// Merges objects; other values replace those that are there.
fn merge(into: &mut Value, more: Value) {
    match (into, more) {
        (Value::Object(into), Value::Object(more)) => {
            for (key, value) in more {
                merge(into.entry(key).or_insert(Value::Null), value);
            }
        }
        (into, more) => *into = more,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_announced_and_messages_are_bounded() {
        let config = ShareConfig { listen: vec!["tcp/127.0.0.1:7447".parse().unwrap()], ..ShareConfig::default() };
        let place = Place::find("tcp/127.0.0.1:7447").unwrap();
        let (gateway, client) = (gateway_values("cell", &config), client_values(&place));
        for values in [&gateway, &client] {
            assert_eq!(values["scouting"]["multicast"]["enabled"], false);
            assert_eq!(values["transport"]["shared_memory"]["enabled"], false);
            assert_eq!(values["transport"]["link"]["rx"]["max_message_size"], MAX_MESSAGE);
            assert_eq!(values["transport"]["link"]["tx"]["lease"], LEASE);
            assert_eq!(values["connect"]["retry"]["period_max_ms"], RETRY.1);
            // zenoh knows all of these keys.
            built(values).unwrap();
        }
        assert_eq!(gateway["listen"]["endpoints"], json!(["tcp/127.0.0.1:7447"]));
        assert_eq!(client["listen"]["endpoints"], json!([]));
        assert_eq!(gateway["access_control"]["enabled"], true);
        let ros = ros_values(&RosConfig::default(), None);
        assert_eq!((&ros["mode"], &ros["listen"]["endpoints"]), (&json!("client"), &json!([])));
        assert_eq!(ros["scouting"]["multicast"]["enabled"], false);
        built(&ros).unwrap();
        assert_eq!(gateway["access_control"]["default_permission"], "deny");
    }
}
