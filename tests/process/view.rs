//! The live view over real sockets, as a browser and as others see it: who gets what, and that its WebSocket is one
//! more connection to the run.

use std::fs;
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Stdio};
use std::time::Duration;

use dimos::rpc::client::view_url;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};
use rustix::process::Signal;
use serde_json::{Value, json};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::HeaderValue;
use tungstenite::{Message, WebSocket};

use crate::support::program::{Ended, Home, Started, TIMEOUT, UP, eventually};

/// An arm with a mesh in two places, one that is missing, and a primitive.
const URDF: &str = r#"<robot name="cell">
  <link name="world"/>
  <joint name="stand" type="fixed"><parent link="world"/><child link="base"/><origin xyz="0 0 0.5"/></joint>
  <link name="base">
    <visual><geometry><mesh filename="part.obj" scale="2 2 2"/></geometry></visual>
    <visual><geometry><mesh filename="package://gone/part.stl"/></geometry></visual>
    <collision><geometry><mesh filename="part.obj"/></geometry></collision>
  </link>
  <joint name="j1" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>
    <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>
  <link name="tip"><collision><geometry><sphere radius="0.1"/></geometry></collision></link>
</robot>"#;
const PART: &str = "v 0 0 0\nv 0.5 0 0\nv 0 0.25 0\nv 0 0 0.125\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
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
      base_pose: {xyz: [1, 0, 0]}
      end_effector_link: tip
      joint_names: [j1]
      joint_name_mapping: {arm_joint1: j1}
      named_poses: {left: [0.5]}
view: {port: 0}
";

/// The page of a run.
pub struct Page {
    /// `127.0.0.1:7000`.
    host: String,
    token: String,
}

type Socket = WebSocket<TcpStream>;

impl Page {
    pub fn of(url: &str) -> Self {
        let (host, token) = url.strip_prefix("http://").unwrap().split_once("/#").unwrap();
        Self { host: host.to_owned(), token: token.to_owned() }
    }

    fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(&self.host).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        stream
    }

    /// Status, headers and content of a reply to a request with these headers, `Host` included.
    fn request(&self, line: &str, headers: &[&str]) -> (u16, String, Vec<u8>) {
        let (mut stream, mut reply) = (self.connect(), Vec::new());
        let headers: String = headers.iter().map(|header| format!("{header}\r\n")).collect();
        stream.write_all(format!("{line} HTTP/1.1\r\n{headers}\r\n").as_bytes()).unwrap();
        stream.read_to_end(&mut reply).unwrap();
        let end = reply.windows(4).position(|four| four == b"\r\n\r\n").unwrap();
        let head = String::from_utf8(reply[..end].to_vec()).unwrap();
        (head.split(' ').nth(1).unwrap().parse().unwrap(), head, reply.split_off(end + 4))
    }

    /// What a browser with this token gets.
    fn get_with(&self, path: &str, token: &str) -> (u16, Vec<u8>) {
        let headers = [format!("Host: {}", self.host), format!("Authorization: Bearer {token}")];
        let (status, _, body) = self.request(&format!("GET {path}"), &[&headers[0], &headers[1]]);
        (status, body)
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        self.get_with(path, &self.token)
    }

    pub fn scene(&self) -> Value {
        serde_json::from_slice(&self.get("/scene.json").1).unwrap()
    }

    /// A WebSocket that has sent a token, and what the server answered.
    fn open(&self, token: &str) -> (Socket, Message) {
        let mut request = format!("ws://{}/rpc", self.host).into_client_request().unwrap();
        let origin = HeaderValue::from_str(&format!("http://{}", self.host)).unwrap();
        request.headers_mut().insert("Origin", origin);
        let (mut socket, _) = tungstenite::client(request, self.connect()).unwrap();
        socket.send(Message::text(json!({"token": token}).to_string())).unwrap();
        let answer = socket.read().unwrap();
        (socket, answer)
    }

    fn accepted(&self) -> Socket {
        let (socket, answer) = self.open(&self.token);
        assert_eq!(answer, Message::text(r#"{"ok":true}"#));
        socket
    }
}

/// The reply to a request over a WebSocket; messages of streams are dropped.
fn call(socket: &mut Socket, request: &str) -> Value {
    socket.send(Message::text(request)).unwrap();
    loop {
        let message: Value = serde_json::from_str(socket.read().unwrap().to_text().unwrap()).unwrap();
        if message.get("stream").is_none() {
            return message;
        }
    }
}

fn closed_with(message: Message) -> Option<u16> {
    match message {
        Message::Close(frame) => frame.map(|frame| frame.code.into()),
        other => panic!("{other}"),
    }
}

/// A content as `gzip` unpacks it.
fn unpacked(content: &[u8]) -> String {
    let piped = || Stdio::piped();
    let mut gzip = Command::new("gzip").arg("-dc").stdin(piped()).stdout(piped()).spawn().unwrap();
    gzip.stdin.take().unwrap().write_all(content).unwrap();
    Ended::from(gzip.wait_with_output().unwrap()).with(0).out
}

#[test]
fn the_page_of_a_run_is_found_by_its_mark() {
    let home = Home::new();
    let mut command = home.as_typed("run yourarm-planner --no-record --set view.port=0");
    let run = Started::of(command.stdin(Stdio::null()));
    run.until(UP);
    let (folder, live) = (home.runs(), home.runs().runs().unwrap().remove(0));
    let at_socket = view_url(&live.name, &live.socket).unwrap();
    assert_eq!(view_url(&live.name, &folder.lasting(&live)).unwrap(), at_socket);
    assert_ne!(folder.lasting(&live), live.socket);
    run.end(Signal::INT);
}

#[test]
fn a_page_with_the_token_sees_and_commands_the_run_and_no_other_does() {
    let home = Home::new();
    home.dimos("view").with(1).says(&["no run of this user is live"]);
    for (name, text) in [("cell.urdf", URDF), ("part.obj", PART), ("cell.yaml", BLUEPRINT)] {
        home.write(name, text);
    }
    let typed = |arguments: &str| Started::of(home.as_typed(arguments).stdin(Stdio::null())).wait().with(0);
    let up = typed("run -d --json --duration 2m cell.yaml").json();
    let url = home.dimos("view").with(0).out.trim().to_owned();
    assert_eq!((up["view"].as_str().unwrap(), &home.dimos("view --json").json()["url"]), (&*url, &url.as_str().into()));
    let page = Page::of(&url);
    let host = format!("Host: {}", page.host);

    // The user's file only has the token: neither status, nor the logs.
    let file = home.path().join("run/dimos/cell.view");
    assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(home.status()["view"], format!("http://{}/", page.host));
    home.dimos("status").with(0).shows(&[&format!("view http://{}/  (`dimos view`", page.host)]);

    let (status, head, content) = page.request("GET /", &[&host]);
    assert_eq!(status, 200, "{head}");
    for header in ["Content-Encoding: gzip", "Content-Security-Policy: default-src 'none'; ", "frame-ancestors 'none'"]
    {
        assert!(head.contains(header), "{head}");
    }
    assert!(unpacked(&content).to_lowercase().starts_with("<!doctype html>"));

    let scene = page.scene();
    let robot = &scene["robots"][0];
    assert_eq!((&scene["kind"], &scene["name"], &scene["simulated"]), (&json!("run"), &json!("cell"), &json!(true)));
    assert_eq!(
        (&robot["root"], &robot["tip"], &robot["joints"]),
        (&json!("world"), &json!("tip"), &json!({"arm_joint1": "j1"}))
    );
    assert_eq!(robot["base"], json!({"xyz": [1.0, 0.0, -0.5], "quat": [0.0, 0.0, 0.0, 1.0]}), "of the root");
    assert_eq!(robot["groups"], json!({"left": [0.5]}));
    assert!(robot["limits"]["arm_joint1"]["upper"].as_f64().unwrap() > 0.5, "{robot}");
    assert_eq!((&scene["arms"][0]["name"], &scene["arms"][0]["joints"]), (&json!("arm"), &json!(["arm_joint1"])));
    let urdf = robot["urdf"].as_str().unwrap();
    let address = urdf.split_once(r#"filename=""#).unwrap().1.split_once('"').unwrap().0;
    assert!(address.starts_with("/mesh/0-") && urdf.contains(r#"" scale="2 2 2""#), "{urdf}");
    assert!(urdf.contains(r#""/mesh/1""#) && !urdf.contains("part."), "{urdf}");

    // Its hash is in its address: a browser keeps it, until the file is another one.
    let bearer = format!("Authorization: Bearer {}", page.token);
    let keeps = |address: &str| {
        let (status, head, stl) = page.request(&format!("GET {address}"), &[&host, &bearer]);
        assert_eq!((status, stl.len(), stl[80]), (200, 84 + 4 * 50, 4), "not scaled, as STL");
        assert!(head.contains("immutable") != head.contains("no-store"), "{head}");
        head.contains("Cache-Control: private, max-age=31536000, immutable")
    };
    assert!(keeps(address) && !keeps("/mesh/0") && !keeps("/mesh/0-0123456789abcdef"));
    home.write("part.obj", &PART.replace("0.125", "0.25"));
    assert!(!keeps(address));

    // The file of an object of the world, and no other one.
    home.dimos(&format!("world add a-part --mesh {} --at 3 0 0", home.path().join("part.obj").display())).with(0);
    let (status, stl) = page.get("/object/a%2Dpart");
    assert_eq!((status, stl.len()), (200, 84 + 4 * 50));
    home.dimos("world add ball --sphere 0.1 --at 3 1 0").with(0);
    for path in ["/object/ball", "/object/none", "/object/", "/messages?topics=/tf", "/pose?q=0"] {
        assert_eq!(page.get(path).0, 404, "{path}");
    }
    let (status, why) = page.get("/mesh/1");
    assert_eq!((status, String::from_utf8_lossy(&why).contains("package://gone")), (404, true));
    for path in ["/mesh/2", "/mesh/", "/mesh/-1", "/mesh/../cell.yaml", "/mesh/%2e%2e/cell.yaml", "/cell.yaml", "//"] {
        assert_eq!(page.get(path).0, 404, "{path}");
    }

    // Without the token, from another site, or by a name that someone else resolves.
    for path in ["/scene.json", "/mesh/0", "/object/ball", "/messages", "/pose"] {
        assert_eq!(page.get_with(path, "").0, 401, "{path}");
        assert_eq!(page.get_with(path, &"0".repeat(32)).0, 401, "{path}");
    }
    let upgrade = [
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    ];
    for (headers, status) in [
        (vec!["Host: evil.test"], 403),
        (vec![host.as_str(), "Origin: http://evil.test"], 403),
        (vec!["Origin: http://127.0.0.1"], 403),
        ([&["Host: evil.test"][..], &upgrade].concat(), 403),
        ([&[host.as_str(), "Origin: http://evil.test"][..], &upgrade].concat(), 403),
        (vec![host.as_str()], 426),
    ] {
        assert_eq!(page.request("GET /rpc", &headers).0, status, "{headers:?}");
    }
    assert_eq!(page.request("POST /", &[&host]).0, 405);
    assert_eq!(page.request("nonsense", &[]).0, 400);
    assert_eq!(page.request("GET /", &[&host, &format!("Cookie: {}", "x".repeat(40_000))]).0, 431);
    for wrong in ["", &"0".repeat(32)] {
        assert_eq!(closed_with(page.open(wrong).1), Some(4401));
    }

    // The same replies as over the run's own socket, streams, refusals, and a stop that holds the arm.
    let mut socket = page.accepted();
    let subscribed =
        call(&mut socket, r#"{"id":1,"method":"subscribe","params":{"stream":"coordinator_joint_state","rate":30}}"#);
    assert_eq!(subscribed, json!({"id": 1, "result": {"subscription": 1}}));
    let state: Value = serde_json::from_str(socket.read().unwrap().to_text().unwrap()).unwrap();
    assert_eq!(state["data"]["name"], json!(["arm_joint1"]));
    let status = call(&mut socket, "{\"id\":\"a\",\n \"method\":\"status\"}");
    assert_eq!((&status["id"], &status["result"]["pid"]), (&json!("a"), &home.status()["pid"]));
    assert_eq!(call(&mut socket, r#"{"id":2,"method":"jump"}"#)["error"]["code"], "UNKNOWN_METHOD");
    let moved = call(&mut socket, r#"{"id":3,"method":"move","params":{"arm":"arm","target":[0.1],"direct":true}}"#);
    assert!(moved["result"]["motion"].is_u64(), "{moved}");
    let other = home.dimos("arm gripper arm open");
    assert!(other.err.contains("arm is commanded by a page of the live view (pid "), "{}", other.err);
    let stopped = call(&mut socket, r#"{"id":4,"method":"stop"}"#);
    assert!(stopped["result"].is_object(), "{stopped}");
    assert_eq!(home.status()["arms"][0]["phase"], "held");

    let mut too_long = page.accepted();
    too_long.send(Message::text(" ".repeat(70_000))).unwrap();
    assert_eq!(closed_with(too_long.read().unwrap()), Some(1009));

    home.dimos("down").with(0);
    let last = std::iter::repeat_with(|| socket.read().unwrap()).find(Message::is_close);
    assert_eq!(closed_with(last.unwrap()), Some(1001));
    assert!(!file.exists());
    for log in fs::read_dir(home.path().join("state/dimos")).unwrap() {
        let bytes = fs::read(log.unwrap().path()).unwrap();
        assert!(!bytes.windows(page.token.len()).any(|text| text == page.token.as_bytes()));
    }
}

#[test]
fn what_cannot_be_shown_is_refused_by_name() {
    let home = Home::new();
    home.write("broken.urdf", "<robot name='r'><link name='a'/><link name='a'/></robot>");
    home.write("not.mcap", "no log");
    home.write("ideal.yaml", "hardware: [{hardware_id: arm, joints: {prefix: arm, count: 1}, adapter_type: mock}]");
    for (arguments, says) in [
        ("gone.mcap", vec!["gone.mcap", "hint: "]),
        ("not.mcap", vec!["not.mcap is not an MCAP file"]),
        ("broken.urdf", vec!["broken.urdf", "has mistakes"]),
        ("builtin:gone", vec!["gone", "hint: "]),
        ("no-such-blueprint", vec!["no-such-blueprint"]),
        ("ideal.yaml", vec!["has no robot model", "hint: "]),
        ("ideal.yaml --run cell", vec!["cannot be used with"]),
        ("ideal.yaml --last", vec!["cannot be used with"]),
        ("yourarm-planner --srdf x", vec!["yourarm-planner is no robot model"]),
        ("--srdf x", vec!["is no robot model"]),
        ("--last", vec!["there is no log yet"]),
    ] {
        home.dimos(&format!("view {arguments}")).with(2).says(&says);
    }
}

#[test]
fn pages_are_bounded_and_one_that_takes_nothing_is_dropped() {
    let folder = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let run = Run::from_name("yourarm-planner").unwrap().name("bounded").record(Record::Off);
    let run = run.view().set("view.port", port).folder(RunDir::closed(folder.path())).start().unwrap();
    let page = Page::of(run.view_url().unwrap());
    assert_ne!(page.host, format!("127.0.0.1:{port}"), "the next free port");

    // One page asks for more than it takes; the others do not notice.
    let mut slow = page.accepted();
    let asking = std::thread::spawn(move || {
        let mut asked = 0;
        // The kernel's buffers take some of it.
        while slow.send(Message::text(r#"{"id":1,"method":"status"}"#)).is_ok() {
            asked += 1;
        }
        asked
    });
    let mut pages: Vec<Socket> = (0..15).map(|_| page.accepted()).collect();
    let (_one_more, answer) = page.open(&page.token);
    assert_eq!(closed_with(answer), Some(4429));
    let silent = page.connect();
    let began = std::time::Instant::now();
    while !asking.is_finished() {
        assert!(began.elapsed() < TIMEOUT, "it is still served");
        assert_eq!(call(&mut pages[0], r#"{"id":1,"method":"motion","params":{"motion":1}}"#)["id"], 1);
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(asking.join().unwrap() > 10);
    eventually("there is room for another page", || page.open(&page.token).1.is_text());
    assert_eq!((&silent).read(&mut [0; 8]).unwrap(), 0, "no request within 5 s");

    assert!(run.stop().troubles.is_empty(), "with pages open");
    let last = std::iter::repeat_with(|| pages[0].read().unwrap()).find(Message::is_close);
    assert_eq!(closed_with(last.unwrap()), Some(1001));
}

#[test]
fn connections_that_say_nothing_keep_no_page_from_its_user() {
    let home = Home::new();
    for (name, text) in [("cell.urdf", URDF), ("part.obj", PART), ("cell.yaml", BLUEPRINT)] {
        home.write(name, text);
    }
    let run = Started::of(home.as_typed("run --no-record cell.yaml").stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    let page = Page::of(home.dimos("view").with(0).out.trim());
    let mut watching = page.accepted();
    let silent: Vec<TcpStream> = (0..200).map(|_| page.connect()).collect();
    let began = std::time::Instant::now();
    assert_eq!(page.get("/scene.json").0, 200);
    assert!(began.elapsed() < Duration::from_secs(2), "{:?}", began.elapsed());
    // A page with the token stays.
    watching.send(Message::text(json!({"id": 1, "method": "status", "params": {}}).to_string())).unwrap();
    assert!(watching.read().is_ok());
    drop(silent);
}
