//! Foxglove's WebSocket over real sockets, read by Foxglove's own client (npm `@foxglove/ws-protocol`); its own server
//! (PyPI `foxglove-sdk`) sends the same beside ours, and the client finds no difference. Foxglove and Lichtblick
//! themselves are not run.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::HeaderValue;
use tungstenite::{Message, WebSocket};

use crate::support::program::{Home, Started, TIMEOUT, eventually};
use crate::support::python::python_with;
use crate::support::skip::skip_tool;

const URDF: &str = r#"<robot name="cell">
  <link name="base"><visual><geometry><mesh filename="part.stl"/></geometry></visual></link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <link name="tip"><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
</robot>"#;
const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 1}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
planner:
  robots:
    - name: arm
      model_path: cell.urdf
      base_link: base
      end_effector_link: tip
      joint_names: [j1]
      joint_name_mapping: {arm_joint1: j1}
  world: {table: {shape: {box: [1, 2, 0.1]}, pose: {xyz: [0, 0, -1]}}}
view: {port: 0, foxglove: {origins: ['https://app.foxglove.dev']}}
";
const TOPICS: [&str; 8] = [
    "/joint_states",
    "/tf",
    "/tf_static",
    "/robot_description",
    "/markers",
    "/diagnostics",
    "/dimos/events",
    "/rosout",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// One triangle, as binary STL.
fn part() -> Vec<u8> {
    let corners = [[0f32, 0.0, 1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
    let floats = corners.iter().flatten().flat_map(|value| value.to_le_bytes());
    [&[0; 80][..], &1u32.to_le_bytes()].concat().into_iter().chain(floats).chain([0, 0]).collect()
}

/// A run of the blueprint, and the URL for Foxglove.
fn run(home: &Home, options: &str) -> (Started, String) {
    for (name, text) in [("cell.urdf", URDF), ("cell.yaml", BLUEPRINT)] {
        home.write(name, text);
    }
    std::fs::write(home.path().join("part.stl"), part()).unwrap();
    let run = Started::of(home.as_typed(&format!("run --no-record cell.yaml {options}")).stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    let url = home.dimos("view --foxglove").with(0).out.trim().to_owned();
    assert_eq!(home.dimos("view --json").json()["foxglove"], url);
    (run, url)
}

fn has_client() -> bool {
    let is_there = root().join("tests/readers/node_modules/@foxglove/ws-protocol").exists();
    if !is_there {
        skip_tool("Foxglove's client in tests/readers/node_modules");
    }
    is_there
}

/// Foxglove's client, reading.
fn client(url: &str, subprotocol: &str, orders: &Value) -> Output {
    let script = root().join("tests/readers/read_foxglove.mjs");
    Command::new("node").arg(script).args([url, subprotocol]).arg(orders.to_string()).output().unwrap()
}

/// What Foxglove's client finds.
#[track_caller]
fn found(url: &str, subprotocol: &str, orders: &Value) -> Value {
    let output = client(url, subprotocol, orders);
    let why = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{why}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn base64(bytes: &[u8]) -> String {
    let mut child = Command::new("base64").args(["-w0"]).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(bytes).unwrap();
    String::from_utf8(child.wait_with_output().unwrap().stdout).unwrap()
}

#[test]
fn foxgloves_client_reads_a_run_as_it_reads_foxgloves_own_server() {
    if !has_client() {
        return;
    }
    let home = Home::new();
    let (run, url) = run(&home, "");
    home.dimos(&format!("world add cup --mesh {} --at 0.5 0 0", home.path().join("part.stl").display())).with(0);
    let mesh = "package://dimos/mesh/part.stl";
    let object = "package://dimos/object/cup/part.stl";
    let fetch = [mesh, object, "package://dimos/mesh/cell.urdf", "file:///etc/passwd", "package://dimos/object/table/"];
    let orders = json!({"topics": TOPICS, "fetch": fetch});

    // Events come while it listens.
    let listening = {
        let (url, orders) = (url.clone(), orders.clone());
        std::thread::spawn(move || found(&url, "foxglove.sdk.v1", &orders))
    };
    let mut there = 0.1;
    while !listening.is_finished() {
        home.dimos(&format!("move arm {there} --direct")).with(0);
        there = -there;
    }
    let ours = listening.join().unwrap();
    assert_eq!(ours["protocol"], "foxglove.sdk.v1");
    assert_eq!(
        (&ours["serverInfo"]["name"], &ours["serverInfo"]["capabilities"]),
        (&json!("dimos: cell"), &json!(["assets"]))
    );
    assert_eq!(ours["serverInfo"]["metadata"]["simulated"], "true");
    let message = |topic: &str| &ours["messages"][topic]["data"];
    let joints = message("/joint_states");
    assert_eq!((&joints["name"], joints["position"].as_array().unwrap().len()), (&json!(["arm_joint1"]), 1));
    assert!(joints["position"][0].as_f64().unwrap().abs() <= 0.11, "{joints}");
    let stamp = ours["messages"]["/joint_states"]["timestamp"].as_f64().unwrap() * 1e-9;
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap().as_secs_f64();
    assert!((now - stamp).abs() < 60.0, "{stamp} at {now}");
    let urdf = message("/robot_description")["data"].as_str().unwrap();
    assert!(urdf.contains(mesh) && urdf.contains("arm_joint1"), "{urdf}");
    let frames = |topic: &str| -> Vec<&str> {
        let all = message(topic)["transforms"].as_array().unwrap();
        all.iter().map(|transform| transform["child_frame_id"].as_str().unwrap()).collect()
    };
    assert_eq!((frames("/tf_static"), frames("/tf")[0]), (vec!["base"], "tip"));
    let markers = message("/markers")["markers"].as_array().unwrap();
    let marker = |ns: &str| markers.iter().find(|marker| marker["ns"] == ns).unwrap();
    assert_eq!(marker("world/table")["scale"], json!({"x": 1, "y": 2, "z": 0.1}));
    assert_eq!(marker("world/cup")["mesh_resource"], object);
    assert!(message("/diagnostics")["status"][0]["name"].as_str().unwrap().contains("arm"));
    assert!(!message("/dimos/events")["text"].as_str().unwrap().is_empty());
    assert_eq!(message("/rosout")["name"], "cell");

    // Files of the run, and no others.
    let content = base64(&part());
    for uri in [mesh, object] {
        assert_eq!(
            (&ours["assets"][uri]["status"], &ours["assets"][uri]["data"]),
            (&0.into(), &content.clone().into())
        );
    }
    for uri in &fetch[2..] {
        assert_eq!(ours["assets"][*uri]["status"], 1, "{uri}: {}", ours["assets"][*uri]);
    }

    // The other subprotocol differs in its name only.
    let steady = ["/joint_states", "/tf", "/tf_static", "/robot_description", "/markers", "/diagnostics"];
    let other = found(&url, "foxglove.websocket.v1", &json!({"topics": steady}));
    assert_eq!((&other["protocol"], &other["channels"]), (&"foxglove.websocket.v1".into(), &ours["channels"]));
    for topic in ["/tf_static", "/robot_description", "/markers"] {
        let without_time = |found: &Value| {
            let text = found["messages"][topic]["data"].to_string();
            text.split("\"stamp\":{")
                .map(|part| part.split_once('}').map_or(part, |(_, rest)| rest).to_owned())
                .collect::<Vec<_>>()
        };
        assert_eq!(without_time(&other), without_time(&ours), "{topic}");
    }
    assert_eq!(other["serverInfo"], ours["serverInfo"], "a client that connects again sees the same run");
    assert_eq!(run.end(Signal::INT).code, Some(130));

    // Foxglove's own server, with the same channels and messages.
    let Some(python) = python_with(&["foxglove"]) else { return };
    let script = root().join("tests/readers/foxglove_server.py");
    let mut server = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let channels: Vec<Value> = TOPICS
        .iter()
        .map(|topic| {
            let about = &ours["channels"][*topic];
            json!({"topic": topic, "schemaName": about["schemaName"], "schema": about["schema"], "message": ours["raw"][*topic]})
        })
        .collect();
    let question = json!({"seconds": 60, "channels": channels, "assets": {mesh: content}});
    let mut stdin = server.stdin.take().unwrap();
    writeln!(stdin, "{question}").unwrap();
    let mut port = String::new();
    BufReader::new(server.stdout.take().unwrap()).read_line(&mut port).unwrap();
    let url = format!("ws://127.0.0.1:{}", port.trim());
    let theirs = client(&url, "foxglove.sdk.v1", &json!({"topics": TOPICS, "fetch": [mesh, "package://gone"]}));
    server.kill().unwrap();
    server.wait().unwrap();
    assert!(theirs.status.success(), "{}", String::from_utf8_lossy(&theirs.stderr));
    let theirs: Value = serde_json::from_slice(&theirs.stdout).unwrap();
    assert_eq!((&theirs["channels"], &theirs["raw"]), (&ours["channels"], &ours["raw"]));
    for topic in TOPICS {
        assert_eq!(theirs["messages"][topic]["data"], *message(topic), "{topic}");
    }
    assert_eq!(theirs["assets"][mesh], ours["assets"][mesh]);
    assert_eq!(theirs["assets"]["package://gone"]["status"], ours["assets"]["file:///etc/passwd"]["status"]);
    let keys = |found: &Value| found["serverInfo"].as_object().unwrap().keys().cloned().collect::<Vec<_>>();
    assert!(
        keys(&theirs).iter().all(|key| keys(&ours).contains(key)),
        "{} {}",
        theirs["serverInfo"],
        ours["serverInfo"]
    );
}

#[test]
fn what_would_command_the_run_is_refused() {
    if !has_client() {
        return;
    }
    let home = Home::new();
    let (run, url) = run(&home, "");
    let found = found(&url, "foxglove.sdk.v1", &json!({"topics": ["/joint_states"], "meddle": true}));
    let statuses = found["statuses"].as_array().unwrap();
    for part in [
        "advertise: refused",
        "published data: refused",
        "setParameters: refused",
        "calls of services: refused",
        "channel 1000",
    ] {
        let is_said = |status: &Value| status["level"] == 2 && status["message"].as_str().unwrap().contains(part);
        assert!(statuses.iter().any(is_said), "{part}: {statuses:?}");
    }
    assert_eq!(home.status()["arms"][0]["phase"], "ready");
    run.end(Signal::INT);
}

type Socket = WebSocket<TcpStream>;

/// A WebSocket, or the status code of the refusal.
fn open(url: &str, headers: &[(&'static str, &str)], buffer: Option<usize>) -> Result<Socket, u16> {
    let mut request = url.into_client_request().unwrap();
    for (name, value) in headers {
        request.headers_mut().insert(*name, HeaderValue::from_str(value).unwrap());
    }
    let at: SocketAddr = url.strip_prefix("ws://").unwrap().split_once('/').unwrap().0.parse().unwrap();
    let stream = TcpStream::connect(at).unwrap();
    if let Some(size) = buffer {
        rustix::net::sockopt::set_socket_recv_buffer_size(&stream, size).unwrap();
    }
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    match tungstenite::client(request, stream) {
        Ok((socket, _)) => Ok(socket),
        Err(tungstenite::HandshakeError::Failure(tungstenite::Error::Http(reply))) => Err(reply.status().as_u16()),
        Err(other) => panic!("{other}"),
    }
}

const SDK: (&str, &str) = ("Sec-WebSocket-Protocol", "foxglove.sdk.v1");

#[test]
fn only_listed_sites_and_those_with_a_token_may_read() {
    let home = Home::new();
    let (run, url) = run(&home, "");
    let host = url.strip_prefix("ws://").unwrap().split_once('/').unwrap().0;
    let (bare, page) = (url.split_once('?').unwrap().0, home.dimos("view").with(0).out);
    let own = format!("http://{host}");
    for (headers, status) in [
        (vec![SDK], None),
        (vec![("Sec-WebSocket-Protocol", "other, foxglove.websocket.v1")], None),
        (vec![SDK, ("Origin", "https://app.foxglove.dev")], None),
        (vec![SDK, ("Origin", &own)], None),
        (vec![SDK, ("Origin", "https://evil.test")], Some(403)),
        (vec![SDK, ("Origin", "https://app.foxglove.dev.evil.test")], Some(403)),
        (vec![SDK, ("Origin", "http://app.foxglove.dev")], Some(403)),
        (vec![SDK, ("Host", "evil.test"), ("Origin", "https://app.foxglove.dev")], Some(403)),
        (vec![("Sec-WebSocket-Protocol", "graphql-ws")], Some(400)),
        (vec![], Some(400)),
    ] {
        assert_eq!(open(&url, &headers, None).err(), status, "{headers:?}");
    }
    // The page's token is another one: what a viewer is given commands nothing.
    let token = url.split_once("token=").unwrap().1;
    let page_token = page.trim().split_once('#').unwrap().1;
    assert_ne!(token, page_token);
    for wrong in [bare.to_owned(), format!("{bare}?token="), format!("{bare}?token={page_token}")] {
        assert_eq!(open(&wrong, &[SDK], None).err(), Some(401), "{wrong}");
    }
    let mut stream = TcpStream::connect(host).unwrap();
    write!(stream, "GET /scene.json HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {token}\r\n\r\n").unwrap();
    let mut reply = String::new();
    stream.read_to_string(&mut reply).unwrap();
    assert!(reply.starts_with("HTTP/1.1 401"), "{reply}");
    eventually("the refusal is in the text log", || run.err().contains("Origin: https://evil.test"));
    run.end(Signal::INT);

    for origin in ["https://a.test/page", "app.foxglove.dev", "*", "https://A.test"] {
        let set = format!("check cell.yaml --set view.foxglove.origins=[\"{origin}\"]");
        home.dimos(&set).with(2).says(&["is no origin of web pages", "hint: write its scheme and host"]);
    }
}

/// Resident memory of a process [kB].
fn memory(pid: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse().unwrap()
}

#[test]
fn a_slow_viewer_loses_messages_and_is_informed_and_one_that_takes_nothing_is_dropped() {
    let home = Home::new();
    // Large messages, often: 4 arms with 16 joints of long names.
    let arms: String = (0..4)
        .map(|arm| {
            let prefix = format!("{}{arm}", "a_long_name_of_an_arm".repeat(2));
            format!("  - {{hardware_id: arm{arm}, joints: {{prefix: {prefix}, count: 16}}, adapter_type: mock}}\n")
        })
        .collect();
    home.write("wide.yaml", &format!("coordinator: {{tick_rate: 200}}\nhardware:\n{arms}view: {{port: 0}}\n"));
    let run = Started::of(home.as_typed("run --no-record wide.yaml").stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    let url = home.dimos("view --foxglove").with(0).out.trim().to_owned();
    let subscribed = || {
        let mut socket = open(&url, &[SDK], Some(16 << 10)).unwrap();
        let hello = socket.read().unwrap();
        assert!(hello.to_text().unwrap().contains("\"op\":\"serverInfo\""), "{hello}");
        socket.send(Message::text(r#"{"op":"subscribe","subscriptions":[{"id":1,"channelId":0}]}"#)).unwrap();
        socket
    };
    let (mut slow, mut stalled, before) = (subscribed(), subscribed(), memory(run.pid()));
    let began = Instant::now();
    let lost = loop {
        assert!(began.elapsed() < 2 * TIMEOUT, "it is not informed");
        match slow.read().unwrap() {
            Message::Text(text) if text.contains("\"op\":\"status\"") => break text,
            _ => std::thread::sleep(Duration::from_millis(50)),
        }
    };
    assert!(lost.contains("this viewer is too slow") && lost.contains("\"level\":1"), "{lost}");
    // It still sends: that shows when the other end is closed.
    eventually("the one that takes nothing is dropped", || stalled.send(Message::Ping(Vec::new().into())).is_err());
    assert!(memory(run.pid()) < before + 20_000, "{} kB, before {before} kB", memory(run.pid()));
    assert_eq!(run.end(Signal::INT).code, Some(130));
}

#[test]
fn the_layout_names_topics_that_exist() {
    let layout: PathBuf = root().join("docs/foxglove-layout.json");
    let text = std::fs::read_to_string(layout).unwrap();
    let layout: Value = serde_json::from_str(&text).unwrap();
    for panel in ["3D!", "Plot!", "StateTransitions!", "RosOut!"] {
        assert!(layout["configById"].as_object().unwrap().keys().any(|key| key.starts_with(panel)), "{panel}");
    }
    let mut paths = 0;
    for part in text.split('"').filter(|part| part.starts_with('/')) {
        assert!(TOPICS.iter().any(|topic| part == *topic || part.starts_with(&format!("{topic}."))), "{part}");
        paths += 1;
    }
    assert!(paths >= 5);
}
