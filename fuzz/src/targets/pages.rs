//! The server of the live view: HTTP, the WebSocket of its page, and that of Foxglove.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use dimos::blueprint::planner::ViewConfig;
use dimos::rpc::api::WorldObject;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};
use dimos::view::{MeshFile, Scene, Subject, View};

use crate::bytes::Bytes;
use crate::{Target, bug};

/// What the page shows.
struct Nothing;

impl Subject for Nothing {
    fn scene(&self) -> Scene {
        Scene { json: "{}".to_owned(), meshes: vec![MeshFile::Inside("m.stl".to_owned(), vec![0; 84])] }
    }
    fn object(&self, _: &str) -> Option<WorldObject> {
        None
    }
    fn answer(&self, path: &str, query: &str) -> Option<Result<String, String>> {
        (path == "echo").then(|| Ok(serde_json::to_string(query).unwrap_or_default()))
    }
}

/// The page of a run with an arm in memory: its address and its URL, the same for all inputs of a process.
fn served() -> &'static (String, String) {
    static SERVED: OnceLock<(String, String)> = OnceLock::new();
    SERVED.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a folder").keep();
        let run = Run::from_name("coordinator-mock").expect("a shipped blueprint");
        let run = run.folder(RunDir::closed(&folder)).record(Record::Off).start().expect("a run");
        let config = ViewConfig { port: 0, ..ViewConfig::default() };
        let view = View::through(&config, Arc::new(Nothing), run.socket().expect("a socket")).expect("a page");
        let served = (view.address().to_owned(), view.url().to_owned());
        // Both last as long as the process.
        drop(std::thread::spawn(move || {
            let _kept = (run, view);
            loop {
                std::thread::park();
            }
        }));
        served
    })
}

fn address() -> &'static str {
    served().0.trim_start_matches("http://").trim_end_matches('/')
}

fn ask(bytes: &[u8], wait: Duration) -> Vec<u8> {
    let mut stream = TcpStream::connect(address()).expect("the page is served");
    let _ = stream.set_read_timeout(Some(wait));
    let _ = stream.write_all(bytes);
    let _ = stream.shutdown(Shutdown::Write);
    let mut answer = Vec::new();
    let _ = stream.take(1 << 20).read_to_end(&mut answer);
    answer
}

/// Requests to the server.
pub const HTTP: Target = Target {
    name: "http",
    about: "a reply of HTTP, or an end; the server continues",
    run: http,
    seeds: || {
        let upgrade = |path: &str| {
            format!(
                "GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: \
                 13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
            )
        };
        let get = |path: &str| format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\n\r\n");
        ["/", "/scene.json", "/mesh/0", "/echo?a=b", "/object/a"]
            .iter()
            .map(|p| get(p))
            .chain(["/rpc", "/foxglove"].iter().map(|p| upgrade(p)))
            .map(String::into_bytes)
            .collect()
    },
};

fn http(data: &[u8]) {
    let answer = ask(data, Duration::from_millis(30));
    assert!(
        answer.is_empty() || answer.starts_with(b"HTTP/1.1 "),
        "{:?}",
        String::from_utf8_lossy(&answer[..answer.len().min(80)])
    );
    let status = answer.get(9..12).unwrap_or_default();
    bug(1, status == b"404");
    bug(2, status == b"405" || status == b"400");
    bug(3, status == b"403");
    if data.len().is_multiple_of(16) {
        let page = ask(format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", address()).as_bytes(), Duration::from_secs(5));
        assert!(page.starts_with(b"HTTP/1.1 200"), "the server has ended");
    }
}

/// Messages to the WebSockets, after a correct opening.
pub const FOXGLOVE: Target = Target {
    name: "websocket",
    about: "answers in frames, or a close with its reason; the server and its run continue",
    run: websocket,
    seeds: || {
        [
            r#"0{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}"#,
            r#"0{"op":"unsubscribe","subscriptionIds":[1]}"#,
            r#"0{"op":"fetchAsset","requestId":1,"uri":"package://a/b.stl"}"#,
            r#"1{"id":1,"method":"status"}"#,
            r#"1{"id":1,"method":"subscribe","params":{"stream":"state"}}"#,
            r#"1{"id":2,"method":"lease","params":{"arm":"arm"}}"#,
            r#"1{"id":2,"method":"stop","params":{}}"#,
        ]
        .map(|text| text.as_bytes().to_vec())
        .into()
    },
};

fn websocket(data: &[u8]) {
    let mut from = Bytes(data);
    let foxglove = from.byte() & 1 == 0;
    let token = served().1.split("token=").nth(1).unwrap_or_default();
    let (path, protocol) = match foxglove {
        true => (format!("/foxglove?token={token}"), "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n"),
        false => (format!("/rpc?token={token}"), ""),
    };
    let mut bytes = format!(
        "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: \
         13\r\nSec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n{protocol}\r\n",
        address()
    )
    .into_bytes();
    // Frames: each ends at a zero; its first byte may change the kind.
    for part in from.0.split(|byte| *byte == 0).take(8) {
        let (kind, body) = match part.split_first() {
            Some((first @ 1..=15, body)) => (0x80 | first, body),
            _ => (0x81, part),
        };
        bytes.push(kind);
        match body.len() {
            n @ 0..126 => bytes.push(0x80 | n as u8),
            n => bytes.extend([0x80 | 126, (n >> 8) as u8, n as u8]),
        }
        bytes.extend([0; 4]);
        bytes.extend(body);
    }
    bytes.extend([0x88, 0x80, 0, 0, 0, 0]);
    let answer = ask(&bytes, Duration::from_millis(200));
    assert!(answer.is_empty() || answer.starts_with(b"HTTP/1.1 "), "no HTTP");
    let has = |word: &[u8]| answer.windows(word.len()).any(|part| part == word);
    bug(1, !foxglove && has(b"unknown_method"));
    bug(2, foxglove && has(b"not JSON"));
    bug(3, !foxglove && has(b"\"result\""));
}
