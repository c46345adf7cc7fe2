//! The socket of a run, from outside: what it answers, refuses, bounds, and leaves behind.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::Shutdown as Half;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{UnixListener, UnixStream};
use std::time::Duration;

use dimos::clock::Mono;
use dimos::rpc::Code;
use dimos::rpc::api::{MAX_CONNECTIONS, MAX_LINE, MAX_SUBSCRIPTIONS, Move, RESERVED_CONNECTIONS, State, Status};
use dimos::rpc::client::{Client, ClientError};
use dimos::rpc::run_dir::{RunDir, RunDirError};
use dimos::rpc::server::Server;
use dimos::rpc::server::streams::{EventReport, JointState, Stream, Subscribe, Unsubscribe};
use serde_json::{Value, json};

use crate::support::fake_run::{FakeBackend, start};
use crate::support::program::eventually;

/// A client that can say anything.
struct Raw(BufReader<UnixStream>);

impl Raw {
    fn connect(server: &Server) -> Self {
        let stream = UnixStream::connect(server.socket()).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        Self(BufReader::new(stream))
    }

    fn send(&mut self, text: &[u8]) {
        self.0.get_mut().write_all(text).unwrap();
    }

    fn read(&mut self) -> Value {
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line:?}"))
    }

    fn ask(&mut self, line: &str) -> Value {
        self.send(line.as_bytes());
        self.send(b"\n");
        self.read()
    }

    fn is_closed(&mut self) -> bool {
        let mut rest = Vec::new();
        self.0.read_to_end(&mut rest).is_ok_and(|n| n == 0) // a reset connection is an error here
    }
}

fn code(reply: &Value) -> &str {
    reply["error"]["code"].as_str().unwrap_or_else(|| panic!("no error: {reply}"))
}

#[test]
fn requests_are_answered_in_order_with_their_ids() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let mut raw = Raw::connect(&server);
    raw.send(b"{\"id\":1,\"method\":\"state\"}\n{\"id\":\"b\",\"method\":\"status\",\"params\":{}}\n\n");
    let state = raw.read();
    assert_eq!(state["id"], json!(1));
    assert_eq!(state["result"]["arms"][0]["joints"][0]["position"], json!(1.5));
    let status = raw.read();
    assert_eq!((&status["id"], &status["result"]["arms"][0]["phase"]), (&json!("b"), &json!("held")));

    let mut client = Client::connect("test", server.socket()).unwrap();
    let begun = client.call(Move::new("arm", [0.3, -0.2], 1.0)).unwrap();
    assert_eq!((begun.motion, begun.target), (7, vec![0.3, -0.2]));
}

#[test]
fn what_is_no_request_is_refused_and_the_connection_lives() {
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    let mut raw = Raw::connect(&server);
    let mut refused = |line: &str, expected: &str| {
        let reply = raw.ask(line);
        assert_eq!(code(&reply), expected, "{line}: {reply}");
        reply
    };
    assert_eq!(refused("{\"id\":1,", "MALFORMED")["id"], Value::Null);
    refused("[]", "MALFORMED");
    refused("\u{1}\u{2}", "MALFORMED");
    refused(r#"{"id":{},"method":"state"}"#, "MALFORMED");
    assert_eq!(refused(r#"{"id":5}"#, "MALFORMED")["id"], json!(5));
    refused(r#"{"id":5,"method":"state","parms":{}}"#, "MALFORMED");
    refused(r#"{"id":6,"method":"move","params":{"arm":"arm","target":[1e999]}}"#, "MALFORMED");
    refused(r#"{"id":6,"method":"move","params":{"arm":"arm","target":[NaN]}}"#, "MALFORMED");
    refused(&format!("{}{}", "[".repeat(5000), "]".repeat(5000)), "MALFORMED");
    let reply = refused(r#"{"id":7,"method":"stats"}"#, "UNKNOWN_METHOD");
    assert!(reply["error"]["hint"].as_str().unwrap().contains("`status`"), "{reply}");
    refused(r#"{"id":8,"method":"move","params":{"arm":"arm","target":[1],"sped":0.5}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"move","params":{"arm":"arm","target":["1"]}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"move","params":{"arm":"arm","target":[1],"speed":7}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"move","params":{"arm":"arm","target":[]}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"state","params":{"x":1}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"subscribe","params":{"stream":"joints"}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"subscribe","params":{"stream":"events","rate":0}}"#, "INVALID_PARAMS");
    refused(r#"{"id":8,"method":"unsubscribe","params":{"subscription":9}}"#, "UNKNOWN_SUBSCRIPTION");
    let points = r#"[{"time_from_start":0,"positions":[1,2]}]"#;
    let execute =
        format!(r#"{{"method":"execute","params":{{"trajectory":{{"joint_names":["a"],"points":{points}}}}}}}"#);
    let reply = refused(&execute, "INVALID_PARAMS");
    assert!(reply["error"]["message"].as_str().unwrap().contains("points[0].positions"), "{reply}");
    assert!(backend.asked().is_empty(), "nothing of that may reach the run");
    assert_eq!(raw.ask(r#"{"id":9,"method":"state"}"#)["id"], json!(9));
}

#[test]
fn infinities_from_within_the_process_are_refused() {
    let bad = Move::new("arm", [f64::INFINITY], 0.5);
    assert!(dimos::rpc::Method::check(&bad).unwrap_err().contains("not finite"));
}

#[test]
fn an_oversize_line_is_refused_and_ends_the_connection() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let mut raw = Raw::connect(&server);
    let mut line = vec![b' '; 1 << 20];
    line.push(b'\n');
    raw.send(&line);
    let reply = raw.read();
    assert_eq!((code(&reply), &reply["id"]), ("TOO_LARGE", &Value::Null));
    assert!(raw.is_closed());
    // The longest line allowed is answered.
    let mut raw = Raw::connect(&server);
    let request = r#"{"id":1,"method":"state"}"#;
    raw.send(" ".repeat(MAX_LINE - request.len() - 1).as_bytes());
    assert_eq!(raw.ask(request)["id"], json!(1));
}

#[test]
fn a_half_closed_connection_still_gets_its_replies() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let mut raw = Raw::connect(&server);
    raw.send(b"{\"id\":1,\"method\":\"state\"}\n{\"id\":2,\"method\":\"state\"}\n{\"id\":3,\"meth");
    raw.0.get_mut().shutdown(Half::Write).unwrap();
    assert_eq!((raw.read()["id"].clone(), raw.read()["id"].clone()), (json!(1), json!(2)));
    assert!(raw.is_closed(), "half a line is no request");
}

#[test]
fn a_defect_of_the_backend_ends_one_connection_only() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let mut other = Raw::connect(&server);
    let mut raw = Raw::connect(&server);
    raw.send(b"{\"id\":1,\"method\":\"velocity\",\"params\":{\"task\":\"t\",\"velocities\":[0]}}\n");
    assert!(raw.is_closed());
    assert_eq!(other.ask(r#"{"id":1,"method":"state"}"#)["id"], json!(1));
}

#[test]
fn an_unanswered_request_times_out() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let mut raw = Raw::connect(&server);
    let reply = raw.ask(r#"{"id":1,"method":"servo","params":{"task":"t","positions":[0]}}"#);
    assert_eq!(code(&reply), "NO_ANSWER");
}

#[test]
fn subscriptions_deliver_what_is_published_until_they_end() {
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    let mut client = Client::connect("test", server.socket()).unwrap();
    let states = client.call(Subscribe::to(Stream::CoordinatorJointState)).unwrap().subscription;
    let events = client.call(Subscribe::to(Stream::Events)).unwrap().subscription;
    backend.streams.publish_joint_state(Mono::ZERO, &JointState { tick: 1, effort: vec![None], ..Default::default() });
    backend.streams.publish_event(&EventReport { text: "held".into(), ..Default::default() });
    let mut messages = [client.next_message().unwrap(), client.next_message().unwrap()];
    messages.sort_by_key(|m| m.subscription);
    let [state, event] = messages;
    assert_eq!((state.subscription, state.stream.as_str(), state.lost), (states, "coordinator_joint_state", 0));
    assert_eq!(serde_json::from_value::<JointState>(state.data).unwrap().effort, [None]);
    assert_eq!((event.subscription, &event.data["text"]), (events, &json!("held")));

    client.call(Unsubscribe { subscription: states }).unwrap();
    backend.streams.publish_joint_state(Mono::ZERO, &JointState::default());
    backend.streams.publish_event(&EventReport { text: "after".into(), ..Default::default() });
    assert_eq!(client.next_message().unwrap().data["text"], json!("after"));
}

#[test]
fn a_later_subscriber_gets_the_past_if_it_asks() {
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    for tick in 0..1000 {
        // 100 Hz: one in 20 is kept.
        let now = Mono(1).after(Duration::from_millis(10 * tick));
        backend.streams.publish_joint_state(now, &JointState { tick, ..Default::default() });
        backend.streams.publish_event(&EventReport { tick, ..Default::default() });
    }
    let mut client = Client::connect("test", server.socket()).unwrap();
    let states = Subscribe { stream: Stream::CoordinatorJointState, rate: Some(0.01), past: true };
    let events = Subscribe { past: true, ..Subscribe::to(Stream::Events) };
    let ticks = |client: &mut Client, most: usize| -> Vec<u64> {
        (0..most)
            .map(|_| client.next_message().unwrap())
            .inspect(|message| assert!(message.past && message.lost == 0))
            .map(|message| message.data["tick"].as_u64().unwrap())
            .collect()
    };
    client.call(states).unwrap();
    assert_eq!(ticks(&mut client, 50), (0..1000).step_by(20).collect::<Vec<_>>());
    client.call(events).unwrap();
    assert_eq!(ticks(&mut client, 200), (800..1000).collect::<Vec<_>>());
    // Then what is published from now on, once.
    backend.streams.publish_event(&EventReport { tick: 1000, ..Default::default() });
    let next = client.next_message().unwrap();
    assert_eq!((next.past, next.data["tick"].as_u64()), (false, Some(1000)));
}

#[test]
fn a_rate_thins_a_stream_out() {
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    let mut client = Client::connect("test", server.socket()).unwrap();
    // One message in 100 s: of a burst only the first gets through, however slow the machine is.
    client.call(Subscribe { stream: Stream::CoordinatorJointState, rate: Some(0.01), past: false }).unwrap();
    client.call(Subscribe::to(Stream::Events)).unwrap();
    for tick in 0..50 {
        backend.streams.publish_joint_state(Mono::ZERO, &JointState { tick, ..Default::default() });
    }
    assert_eq!(client.next_message().unwrap().data["tick"], json!(0));
    client.call(State {}).unwrap(); // the burst has been read by now
    backend.streams.publish_event(&EventReport::default());
    assert_eq!(client.next_message().unwrap().stream, "events");
}

#[test]
fn a_slow_reader_loses_its_own_messages_only_and_is_told() {
    const BURST: u64 = 20_000;
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    let subscribe = Subscribe::to(Stream::CoordinatorJointState);
    let mut slow = Client::connect("test", server.socket()).unwrap();
    slow.call(subscribe.clone()).unwrap();
    let mut quick = Client::connect("test", server.socket()).unwrap();
    quick.call(subscribe).unwrap();
    for tick in 0..BURST {
        backend
            .streams
            .publish_joint_state(Mono::ZERO, &JointState { tick, name: vec!["j".repeat(100)], ..Default::default() });
        let message = quick.next_message().unwrap();
        assert_eq!((message.data["tick"].as_u64(), message.lost), (Some(tick), 0));
    }
    // The slow reader reads now: what it got and what it reports as lost is everything, in order.
    let (mut expected, mut lost) = (0, 0);
    while expected < BURST {
        let message = slow.next_message().unwrap();
        lost += message.lost;
        expected += message.lost;
        assert_eq!(message.data["tick"].as_u64(), Some(expected));
        expected += 1;
    }
    assert!(lost > 0, "the burst was meant to be longer than all buffers");
}

#[test]
fn a_client_that_never_reads_holds_up_nobody() {
    let folder = tempfile::tempdir().unwrap();
    let (server, backend) = start(folder.path(), "test", FakeBackend::default());
    let mut mute = UnixStream::connect(server.socket()).unwrap();
    mute.set_nonblocking(true).unwrap();
    // Asks until nothing more goes in and nothing more is taken out: what the server keeps is bounded.
    let line = b"{\"id\":1,\"method\":\"status\"}\n".repeat(50);
    let mut full = || mute.write(&line).is_err();
    eventually("the server no longer reads", || {
        if !(0..1000).any(|_| full()) {
            return false;
        }
        let asked = backend.asked().len();
        std::thread::sleep(Duration::from_millis(200));
        full() && backend.asked().len() == asked
    });
    let mut client = Client::connect("test", server.socket()).unwrap();
    assert_eq!(client.call(Status {}).unwrap().run, "test");
    drop(server);
}

#[test]
fn connections_and_subscriptions_are_bounded() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    let subscribe = r#"{"id":1,"method":"subscribe","params":{"stream":"events"}}"#;
    // Who subscribes is not closed to make room.
    let mut taken: Vec<Raw> = (0..MAX_CONNECTIONS).map(|_| Raw::connect(&server)).collect();
    for raw in &mut taken {
        assert_eq!(raw.ask(subscribe)["id"], json!(1));
    }
    for _ in 0..300 {
        let mut refused = Raw::connect(&server);
        assert_eq!(code(&refused.ask(r#"{"id":1,"method":"state"}"#)), "TOO_MANY_CONNECTIONS");
        assert!(refused.is_closed());
    }
    let error = Client::connect("test", server.socket()).unwrap().call(State {}).unwrap_err();
    assert!(matches!(error, ClientError::Refused(e) if e.code == Code::TooManyConnections));
    // What always gets through does, however many have come and said nothing.
    let _silent: Vec<Raw> = (0..3 * RESERVED_CONNECTIONS).map(|_| Raw::connect(&server)).collect();
    for method in ["stop", "cancel", "status", "shutdown"] {
        let reply = Raw::connect(&server).ask(&format!(r#"{{"id":7,"method":"{method}"}}"#));
        assert!(reply["result"].is_object(), "{reply}");
    }
    taken.pop();
    eventually("a place that was given up is free", || {
        Client::connect("test", server.socket()).unwrap().call(State {}).is_ok()
    });

    let raw = taken.first_mut().unwrap();
    for _ in 1..MAX_SUBSCRIPTIONS {
        let reply = raw.ask(r#"{"id":1,"method":"subscribe","params":{"stream":"events"}}"#);
        assert!(reply["result"]["subscription"].is_u64(), "{reply}");
    }
    let reply = raw.ask(r#"{"id":1,"method":"subscribe","params":{"stream":"events"}}"#);
    assert_eq!(code(&reply), "TOO_MANY_SUBSCRIPTIONS");
    raw.ask(r#"{"id":1,"method":"unsubscribe","params":{"subscription":3}}"#);
    let reply = raw.ask(r#"{"id":1,"method":"subscribe","params":{"stream":"events"}}"#);
    assert!(reply["result"]["subscription"].is_u64(), "{reply}");
}

#[test]
fn socket_and_folder_are_for_the_owner_only() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("dimos");
    std::fs::create_dir(&path).unwrap();
    std::fs::set_permissions(&path, PermissionsExt::from_mode(0o777)).unwrap();
    let (server, _) = start(&path, "test", FakeBackend::default());
    let mode = |p: &std::path::Path| std::fs::metadata(p).unwrap().permissions().mode() & 0o777;
    assert_eq!((mode(&path), mode(server.socket())), (0o700, 0o600));
    assert_eq!(mode(&path.join("test.lock")), 0o600);
}

#[test]
fn a_folder_that_is_a_link_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (real, link) = (folder.path().join("real"), folder.path().join("link"));
    std::fs::create_dir(&real).unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    assert!(matches!(RunDir::closed(&link).claim("test"), Err(RunDirError::NotOurs(_))));
}

#[test]
fn a_name_is_taken_once_and_given_back_at_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let place = RunDir::closed(folder.path());
    let (server, _) = start(folder.path(), "test", FakeBackend::default());
    match place.claim("test") {
        Err(RunDirError::Taken { run, pid }) => assert_eq!((run.as_str(), pid), ("test", std::process::id())),
        other => panic!("{other:?}"),
    }
    let (other, _) = start(folder.path(), "other", FakeBackend::default());
    let names = |place: &RunDir| place.runs().unwrap().into_iter().map(|r| r.name).collect::<Vec<_>>();
    assert_eq!(names(&place), ["other", "test"]);
    assert!(matches!(Client::find(&place, None), Err(ClientError::SeveralRuns(runs)) if runs.len() == 2));
    let error = Client::find(&place, Some("tset")).unwrap_err();
    assert!(error.hint().unwrap().contains("`test`"), "{:?}", error.hint());
    drop(other);
    assert_eq!(Client::find(&place, None).unwrap().run(), "test");
    drop(server);
    assert!(matches!(Client::find(&place, None), Err(ClientError::NoRun)));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "nothing is left behind");
    for bad in ["", "a/b", "../x", ".hidden", "a b", &"x".repeat(65)] {
        assert!(matches!(place.claim(bad), Err(RunDirError::BadName(_))), "{bad:?}");
    }
}

#[test]
fn what_dead_runs_left_is_removed_by_the_next_run_of_that_name() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::set_permissions(folder.path(), PermissionsExt::from_mode(0o700)).unwrap();
    let place = RunDir::closed(folder.path());
    // As after `kill -9`: the socket and the lock file stay, no process holds the lock.
    let leave = |name: &str, lock: bool| {
        drop(UnixListener::bind(folder.path().join(format!("{name}.sock"))).unwrap());
        if lock {
            std::fs::write(folder.path().join(format!("{name}.lock")), "999999").unwrap();
        }
    };
    leave("dead", true);
    leave("orphan", false);
    std::fs::write(folder.path().join("note.txt"), "").unwrap();
    assert_eq!(place.runs().unwrap(), []);
    let files = || {
        let all = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
        all.collect::<std::collections::BTreeSet<_>>()
    };
    let left = files();
    assert_eq!(
        left,
        ["dead.lock", "dead.sock", "note.txt", "orphan.sock"].map(str::to_owned).into(),
        "readers remove none"
    );

    leave("again", true);
    let (server, _) = start(folder.path(), "again", FakeBackend::default());
    assert_eq!(Client::find(&place, Some("again")).unwrap().call(Status {}).unwrap().run, "test");
    for name in ["dead", "orphan"] {
        drop(start(folder.path(), name, FakeBackend::default()));
    }
    drop(server);
    assert_eq!(files(), ["note.txt".to_owned()].into(), "nothing is left behind, and what is not ours stays");
}

#[test]
fn one_of_many_that_want_a_name_gets_it() {
    let folder = tempfile::tempdir().unwrap();
    for _ in 0..10 {
        let place = &RunDir::closed(folder.path());
        let won = std::thread::scope(|scope| {
            let claims: Vec<_> = (0..8).map(|_| scope.spawn(|| place.claim("test").ok())).collect();
            let listing = scope.spawn(|| place.runs().unwrap());
            let won: Vec<_> = claims.into_iter().filter_map(|c| c.join().unwrap()).collect();
            listing.join().unwrap();
            won
        });
        assert_eq!(won.len(), 1);
    }
}
