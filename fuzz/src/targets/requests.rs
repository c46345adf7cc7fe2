//! Lines between clients and a run.

use dimos::rpc::api::{Reply, Request};
use serde_json::Value;

use crate::{Target, bug};

/// Requests, as on a line.
pub const REQUEST: Target = Target {
    name: "request",
    about: "a request that is the same written and read, or an error with code and hint",
    run: request,
    seeds: || {
        [
            r#"{"method":"move","params":{"arm":"left","positions":[0.1,-0.2],"speed":0.5}}"#,
            r#"{"method":"execute","params":{"task":"t","trajectory":{"joint_names":["a"],"points":[{"time_from_start":0,"positions":[0]},{"time_from_start":1,"positions":[1],"velocities":[0]}]}}}"#,
            r#"{"method":"stop","params":{}}"#,
            r#"{"method":"cancel","params":{"arm":"left"}}"#,
            r#"{"method":"servo","params":{"task":"s","positions":[0,1,2]}}"#,
            r#"{"method":"chunk","params":{"task":"c","points":[[0],[1]],"period":0.05,"start":1.5}}"#,
            r#"{"method":"go","params":{"robot":"arm","to":{"pose":{"xyz":[0.3,0,0.2]}},"until":{"force":5}}}"#,
            r#"{"method":"plan","params":{"robot":"arm","joints":[0,0,0],"seed":1}}"#,
            r#"{"method":"world_put","params":{"object":{"name":"box","shape":{"box":[1,1,1]},"xyz":[0,0,0]}}}"#,
            r#"{"method":"gripper","params":{"arm":"left","opening":0.05,"force":10}}"#,
            r#"{"method":"speed","params":{"fraction":0.5}}"#,
            r#"{"method":"arm_payload","params":{"arm":"left","mass":1,"center":[0,0,0.1]}}"#,
        ]
        .map(|text| text.as_bytes().to_vec())
        .into()
    },
};

fn parts(data: &[u8]) -> Option<(String, Value)> {
    let mut value: Value = serde_json::from_slice(data).ok()?;
    let method = value.get("method")?.as_str()?.to_owned();
    Some((method, value.get_mut("params").map(Value::take).unwrap_or_default()))
}

fn request(data: &[u8]) {
    let Some((method, params)) = parts(data) else { return };
    match Request::read(&method, params) {
        Ok(request) => {
            let (name, written) = request.written();
            assert_eq!(name, method);
            let again = Request::read(name, written.clone());
            let again = again.unwrap_or_else(|e| panic!("{name} {written} is not read again: {e}"));
            assert_eq!(again.written().1, written, "another request");
            bug(1, name == "servo" && written.to_string().len() > 60);
            bug(2, name == "move" && written.get("direct") == Some(&Value::Bool(true)));
            bug(3, name == "stop" && written.get("arm").is_some_and(Value::is_string));
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

/// Replies, as a client reads them.
pub const REPLY: Target = Target {
    name: "reply",
    about: "a reply, or an error",
    run: |data| {
        let Some((method, params)) = parts(data) else { return };
        if Reply::read(&method, params).is_ok() {
            bug(1, method == "stop");
            bug(2, method == "move");
            bug(3, method == "speed");
        }
    },
    seeds: || {
        [
            r#"{"method":"move","params":{"motion":1,"duration":0.5}}"#,
            r#"{"method":"stop","params":{"arms":["left"]}}"#,
            r#"{"method":"speed","params":{"fraction":0.5}}"#,
            r#"{"method":"go","params":{"number":3}}"#,
            r#"{"method":"text_log","params":{"lines":["a"]}}"#,
        ]
        .map(|text| text.as_bytes().to_vec())
        .into()
    },
};
