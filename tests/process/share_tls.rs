//! A run on a network with certificates: who is let in, as whom, and what others get to read.

use std::process::Stdio;
use std::time::{Duration, Instant};

use dimos::rpc::api::Status;
use serde_json::{Value, json};

use crate::support::certificates::Authority;
use crate::support::network::{CELL, Judge, free_port, is_built};
use crate::support::program::{Ended, Home, Started, eventually};

/// Longest time for a refusal.
const REFUSED_WITHIN: Duration = Duration::from_millis(1500);

/// A run at `localhost` with certificates, and users: alice the operator, bob the observer, carol unlisted.
struct Cell {
    home: Home,
    lab: Authority,
    port: u16,
    run: Started,
}

impl Cell {
    fn start() -> Option<Self> {
        let home = Home::new();
        let lab = Authority::create(&home.path().join("lab"))?;
        lab.sign("cell1", "DNS:localhost,IP:127.0.0.1", 30);
        let port = free_port();
        for user in ["alice", "bob", "carol"] {
            lab.sign(user, &format!("DNS:{user}"), 30);
            lab.give(user, &home.path().join(format!("config/dimos/{user}")));
        }
        let place = |user: &str| format!("{user}: {{at: 'tls/localhost:{port}', identity: {user}}}\n");
        home.write("config/dimos/places.yaml", &["alice", "bob", "carol"].map(place).concat());
        let share = format!(
            "share: {{listen: ['tls/127.0.0.1:{port}'], users: {{alice: operator, bob: observer}},
  identity: {{ca: lab/ca.pem, cert: lab/cell1.pem, key: lab/cell1.key}}}}\n"
        );
        home.write("cell.yaml", &format!("{CELL}{share}"));
        let run = home.run("cell.yaml --no-record");
        let cell = Self { home, lab, port, run };
        eventually("the run is shared", || cell.home.status()["share"].is_object());
        Some(cell)
    }

    fn as_user(&self, place: &str, verb: &str) -> Ended {
        Started::of(self.home.as_typed(&format!("--at {place} {verb}")).stdin(Stdio::null())).wait()
    }

    fn judge(&self, user: &str, speaks_as: &str) -> Option<Judge> {
        let files = json!({"root_ca_certificate": self.lab.file("ca.pem"),
            "connect_certificate": self.lab.file(&format!("{user}.pem")),
            "connect_private_key": self.lab.file(&format!("{user}.key"))});
        Judge::open(&format!("tls/localhost:{}", self.port), speaks_as, files)
    }
}

#[test]
fn n10_what_a_role_does_not_include_is_forbidden_by_name_and_reaches_no_run() {
    if !is_built() {
        return;
    }
    let Some(cell) = Cell::start() else { return };
    cell.as_user("alice", "move arm 0.2 0 0 0 0 0").with(0);
    let before = cell.home.positions("arm");
    let refused = cell.as_user("bob", "move arm 0.5 0 0 0 0 0").with(1);
    refused.says(&["[FORBIDDEN]", "user bob has the role observer here", "`go`", "hint: "]);
    assert_eq!(cell.home.positions("arm"), before);
    cell.as_user("bob", "state").with(0);
    cell.as_user("alice", "arm reset arm").with(1).says(&["[FORBIDDEN]", "share.remote_enable"]);
    cell.as_user("carol", "state").with(1).says(&["answers, but shares no run with carol", "share.users"]);
    cell.as_user("bob", "stop").with(0).shows(&["confirmed"]);
}

#[test]
fn a_run_whose_status_says_where_it_is_shared_listens_there() {
    if !is_built() {
        return;
    }
    let home = Home::new();
    let Some(lab) = Authority::create(&home.path().join("lab")) else { return };
    lab.sign("cell1", "DNS:localhost,IP:127.0.0.1", 30);
    let port = free_port();
    let identity = "{ca: lab/ca.pem, cert: lab/cell1.pem, key: lab/cell1.key}";
    home.write("cell.yaml", &format!("{CELL}share: {{listen: ['tls/127.0.0.1:{port}'], identity: {identity}}}\n"));
    let run = home.run("cell.yaml --no-record");
    let mut client = home.client();
    let end = Instant::now() + Duration::from_secs(20);
    // Without a pause: what is asked here is the moment.
    while client.call(Status {}).unwrap().share.is_none() {
        assert!(Instant::now() < end, "{}", run.err());
    }
    std::net::TcpStream::connect(("127.0.0.1", port)).expect("it listens");
}

#[test]
fn n11_no_user_speaks_as_another() {
    if !is_built() {
        return;
    }
    let Some(cell) = Cell::start() else { return };
    let Some(mut bob) = cell.judge("bob", "bob") else { return };
    let id = bob.opened["id"].as_str().unwrap().to_owned();
    bob.does("announce", json!({}));
    assert!(bob.asks("read", "state", json!({}))["result"].is_object());
    let target = json!({"arm": "arm", "target": [0.3, 0, 0, 0, 0, 0]});
    for user in ["alice", "*", "**", "al$*", "-"] {
        let key = format!("dimos/cell/by/{user}/move/{id}/move");
        let answer = bob.does("raw", json!({"key": key, "payload": target.to_string(), "timeout": 1.0}));
        assert!(answer["result"].is_null(), "{user}: {answer}");
    }
    bob.does("announce", json!({"key": format!("dimos/cell/by/alice/client/{id}")}));
    bob.does("beat", json!({"key": format!("dimos/cell/by/alice/client/{id}/beat")}));
    let status = cell.home.status();
    assert!(!status["share"]["clients"].to_string().contains("alice"), "{}", status["share"]);
    assert!(status["arms"][0]["commander"].is_null(), "one of them moved the arm");
    assert!(cell.home.positions("arm")[0].abs() < 1e-6);
    let Some(mut carol) = cell.judge("carol", "carol") else { return };
    carol.does("announce", json!({}));
    assert_eq!(carol.does("tokens", json!({"key": "dimos/*/alive"})), json!([]));
    assert_eq!(carol.asks_shortly("read", "state")["answers"], 0);
    cell.run.until("share: \"carol\" at 127.0.0.1:");
}

#[test]
fn n17_an_observer_that_takes_all_its_places_takes_none_of_an_operator() {
    if !is_built() {
        return;
    }
    let Some(cell) = Cell::start() else { return };
    let Some(mut bob) = cell.judge("bob", "bob") else { return };
    let ask = |bob: &mut Judge, class: &str, n: u32, method: &str| {
        let key = format!("dimos/cell/by/bob/{class}/f{n}/{method}");
        bob.does("raw", json!({"key": key, "payload": "{}", "timeout": 5.0}))
    };
    let answers: Vec<Value> = (0..40).map(|n| ask(&mut bob, "read", n, "state")).collect();
    let refused = answers.iter().filter(|answer| answer["error"]["code"] == "TOO_MANY_CONNECTIONS").count();
    assert_eq!(refused, 8, "{answers:?}");
    cell.as_user("alice", "move arm 0.2 0 0 0 0 0").with(0);
    cell.as_user("alice", "stop").with(0).shows(&["confirmed"]);
    // Without a place of its own too.
    let stop = ask(&mut bob, "end", 99, "stop");
    assert_eq!(stop["result"]["arms"]["arm"], "confirmed", "{stop}");
}

#[test]
fn n09_a_certificate_that_cannot_be_used_is_refused_at_once_with_the_reason() {
    if !is_built() {
        return;
    }
    let Some(cell) = Cell::start() else { return };
    let config = cell.home.path().join("config/dimos");
    let tried = |place: &str, says: &[&str]| {
        let began = Instant::now();
        cell.as_user(place, "state").with(3).says(&["[UNREACHABLE]", "hint: "]).says(says);
        assert!(began.elapsed() < REFUSED_WITHIN, "{place}: {:?}", began.elapsed());
    };
    let add = |name: &str, line: &str| {
        let file = config.join("places.yaml");
        let places = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, format!("{places}{name}: {{{line}}}\n")).unwrap();
    };
    let at = format!("at: 'tls/localhost:{}'", cell.port);

    cell.lab.sign("old", "DNS:old", -1);
    cell.lab.give("old", &config.join("old"));
    add("old", &format!("{at}, identity: old"));
    tried("old", &["the certificate expired"]);

    let other = Authority::create(&cell.home.path().join("other")).unwrap();
    other.sign("alice", "DNS:alice", 30);
    other.give("alice", &config.join("foreign"));
    add("foreign", &format!("{at}, identity: foreign"));
    tried("foreign", &["one side refused the certificate of the other"]);
    // The log names the reason; zenoh does not say whose connection it was.
    cell.run.until("share: a connection was refused: the client refused our certificate");
    std::fs::copy(cell.lab.file("ca.pem"), config.join("foreign/ca.pem")).unwrap();
    tried("foreign", &["did not sign it"]);

    cell.lab.give("bob", &config.join("mixed"));
    std::fs::copy(cell.lab.file("alice.key"), config.join("mixed/bob.key")).unwrap();
    add("mixed", &format!("{at}, identity: mixed"));
    tried("mixed", &["it is not the key of"]);

    add("plain", &format!("at: 'tcp/localhost:{}'", cell.port));
    tried("plain", &["does not speak to us", "tls/"]);
    add("nowhere", &format!("at: 'tls/localhost:{}', identity: alice", free_port()));
    tried("nowhere", &["nothing listens at"]);
    add("missing", &format!("{at}, identity: unknown"));
    cell.as_user("missing", "state").with(2).says(&["unknown", "hint: "]);

    let shown = config.join("alice/alice.key");
    std::fs::set_permissions(&shown, std::os::unix::fs::PermissionsExt::from_mode(0o644)).unwrap();
    tried("alice", &["other users can read this private key", "chmod 600"]);

    // No certificate at all.
    let Some(judge) = Judge::open(&format!("tcp/localhost:{}", cell.port), "alice", Value::Null) else { return };
    assert!(judge.opened["refused"].is_string(), "{}", judge.opened);
    cell.run.until("share: a connection was refused: the client speaks no TLS");
    assert!(cell.home.status()["share"].is_object(), "the gateway has ended");
}

#[test]
fn a_busy_connection_with_certificates_lasts() {
    if !is_built() {
        return;
    }
    let Some(cell) = Cell::start() else { return };
    let watch = Started::of(cell.home.as_typed("--at bob state --watch --json --hz 1000").stdin(Stdio::null()));
    watch.until("arm_joint1");
    // As many beginnings of connections; each sends while it receives.
    for _ in 0..60 {
        cell.as_user("bob", "state").with(0);
    }
    std::thread::sleep(Duration::from_secs(3));
    assert!(!watch.err().contains("lost"), "{}", watch.err());
    assert!(watch.out().lines().count() > 1000, "{}", watch.out().lines().count());
    watch.end(rustix::process::Signal::INT);
}

#[test]
fn check_and_doctor_report_certificates_that_cannot_be_used() {
    if !is_built() {
        return;
    }
    let home = Home::new();
    let Some(lab) = Authority::create(&home.path().join("lab")) else { return };
    let check = |name: &str| {
        let identity = format!("{{ca: lab/ca.pem, cert: lab/{name}.pem, key: lab/{name}.key}}");
        let share = format!("share: {{listen: ['tls/0.0.0.0:7447'], identity: {identity}}}\n");
        home.write("cell.yaml", &format!("{CELL}{share}"));
        home.dimos("check cell.yaml")
    };
    for (name, days) in [("good", 30), ("soon", 10), ("old", -1)] {
        lab.sign(name, "DNS:localhost", days);
    }
    check("good").with(0).shows(&["no mistakes"]);
    check("soon").with(0).says(&["warning: ", "soon.pem: expires in", "hint: "]);
    check("old").with(2).says(&["old.pem: the certificate expired", "hint: "]);
    let json = home.dimos("check --json cell.yaml").with(2).json();
    assert_eq!((&json["ok"], &json["errors"]), (&json!(false), &json!(1)));
    assert!(json["diagnostics"][0]["message"].as_str().unwrap().contains("expired"), "{json}");
    std::fs::copy(lab.file("good.key"), lab.file("soon.key")).unwrap();
    check("soon").with(2).says(&["soon.key: it is not the key of"]);
    let key = lab.file("good.key");
    std::fs::set_permissions(&key, std::os::unix::fs::PermissionsExt::from_mode(0o640)).unwrap();
    check("good").with(2).says(&["other users can read this private key (mode 640)", "chmod 600"]);

    lab.give("old", &home.path().join("config/dimos/old"));
    home.write("config/dimos/places.yaml", "cell1: {at: 'tls/localhost:1', identity: old}\n");
    let examined = home.dimos("doctor --json").json();
    let found = examined.as_array().unwrap().iter().find(|finding| finding["check"] == "certificates").unwrap();
    assert_eq!(found["level"], "warn");
    assert!(found["found"].as_str().unwrap().starts_with("place cell1: "), "{found}");
}
