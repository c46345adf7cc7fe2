//! `docs/rpc.md` is true: each of its examples is played to a real run, and nothing is missing in it.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;

use dimos::rpc::Code;
use dimos::rpc::api::{ArmEnable, ArmReset, Going, METHODS, Planner, State, Status};
use dimos::rpc::client::Client;
use dimos::rpc::report::TaskReport;
use dimos::rpc::server::streams::Stream;
use serde_json::Value;

use crate::support::program::{Home, TIMEOUT, eventually};
use crate::support::wire::watch::Watch;

const PAGE: &str = include_str!("../../docs/rpc.md");

/// One message of an example.
struct Step {
    /// Which connection: the ordinary one, or another.
    who: String,
    sent: bool,
    message: Value,
}

/// The examples, each a list of steps.
fn examples() -> Vec<Vec<Step>> {
    let blocks = PAGE.split("\n```rpc\n").skip(1).map(|rest| rest.split("\n```").next().unwrap());
    blocks.map(read).collect()
}

fn read(block: &str) -> Vec<Step> {
    let mut texts: Vec<(String, bool, String)> = Vec::new();
    for line in block.lines() {
        match line.split_once(['→', '←']) {
            Some((who, text)) if !line.starts_with(' ') => {
                texts.push((who.trim().to_owned(), line.contains('→'), text.to_owned()));
            }
            _ => texts.last_mut().expect("an example begins with an arrow").2.push_str(line),
        }
    }
    let parse = |text: &str| serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"));
    texts.into_iter().map(|(who, sent, text)| Step { who, sent, message: parse(&text) }).collect()
}

/// The same keys and types, at every depth; a list is like its first element, and null matches anything. Words by
/// which programs decide are the same.
fn differs(shown: &Value, real: &Value, at: &str) -> Option<String> {
    match (shown, real) {
        (Value::Null, _) | (_, Value::Null) => None,
        (Value::Bool(_), Value::Bool(_)) | (Value::Number(_), Value::Number(_)) => None,
        (Value::String(a), Value::String(b)) => {
            let word = at.rsplit('.').next().unwrap_or_default();
            let decides = ["code", "stream", "kind", "level", "phase", "state", "hint"].contains(&word)
                || at.starts_with(".result.tasks.")
                || at.starts_with(".result.arms.");
            (decides && a != b).then(|| format!("{at}: {a:?} is shown, {b:?} came"))
        }
        (Value::Array(a), Value::Array(b)) => match (a.first(), b.first()) {
            (Some(a), Some(b)) => differs(a, b, &format!("{at}[]")),
            _ => None,
        },
        (Value::Object(a), Value::Object(b)) => {
            let keys =
                |o: &serde_json::Map<String, Value>| o.keys().cloned().collect::<std::collections::BTreeSet<_>>();
            if keys(a) != keys(b) {
                return Some(format!("{at}: {:?} are shown, {:?} came", keys(a), keys(b)));
            }
            a.iter().find_map(|(key, value)| differs(value, &b[key], &format!("{at}.{key}")))
        }
        _ => Some(format!("{at}: {shown} is shown, {real} came")),
    }
}

/// A connection that says what an example says.
struct Player(BufReader<UnixStream>);

impl Player {
    fn connect(home: &Home) -> Self {
        let stream = UnixStream::connect(home.path().join("run/dimos/streams.sock")).unwrap();
        stream.set_read_timeout(Some(TIMEOUT)).unwrap();
        Self(BufReader::new(stream))
    }

    fn send(&mut self, message: &Value) {
        self.0.get_mut().write_all(format!("{message}\n").as_bytes()).unwrap();
    }

    /// The next message of the kind that is shown: a reply, or one of the same stream and kind of event.
    fn like(&mut self, shown: &Value) -> Value {
        loop {
            let mut line = String::new();
            let read = self.0.read_line(&mut line).unwrap_or_else(|e| panic!("{e}: no {shown}"));
            assert!(read > 0, "closed before {shown}");
            let real: Value = serde_json::from_str(&line).unwrap();
            let kind = |v: &Value| (v.get("stream").cloned(), v["data"].get("kind").cloned(), v.get("id").cloned());
            if kind(&real) == kind(shown) {
                return real;
            }
        }
    }
}

/// A run, and the numbers of the last motion and the last plan: as the page shows them, and as this run gave them.
struct Stage {
    home: Home,
    watcher: Client,
    motion: (Value, Value),
    plan: (Value, Value),
    /// The number of the last `go`.
    going: u64,
}

impl Stage {
    /// Until all is at rest, so that an example begins where the one before it ended.
    fn comes_to_rest(&mut self) {
        eventually("all is at rest", || {
            let tasks = self.watcher.call(Status {}).unwrap().tasks;
            let busy = |t: &TaskReport| matches!(t.state.as_str(), "EXECUTING" | "CANCELLING") && t.kind != "velocity";
            let joints = self.watcher.call(State {}).unwrap().arms.remove(0).joints;
            !tasks.iter().any(busy) && joints.iter().all(|j| j.velocity.is_some_and(|v| v.abs() < 1e-4))
        });
    }

    /// Plays an example; says what was different.
    fn play(&mut self, example: &[Step]) -> Result<(), String> {
        let mut players: BTreeMap<&str, Player> = BTreeMap::new();
        for Step { who, sent, message } in example {
            let player = players.entry(who).or_insert_with(|| Player::connect(&self.home));
            if *sent {
                let mut message = message.clone();
                if let Some(number) = message.pointer_mut("/params/motion").filter(|m| **m == self.motion.0) {
                    *number = self.motion.1.clone();
                }
                if let Some(number) = message.pointer_mut("/params/plan").filter(|p| **p == self.plan.0) {
                    *number = self.plan.1.clone();
                }
                if let Some(number) = message.pointer_mut("/params/going") {
                    *number = self.going.into();
                    let going = Going { going: self.going };
                    eventually("it is over", || self.watcher.call(going).unwrap().done);
                }
                if message["method"] == "planning" {
                    eventually("planning ends", || self.watcher.call(Planner {}).unwrap().state != "PLANNING");
                }
                player.send(&message);
                continue;
            }
            let real = player.like(message);
            if let Some(difference) = differs(message, &real, "") {
                return Err(format!("{difference}\nshown: {message}\ncame:  {real}"));
            }
            if let (Some(shown), Some(number)) = (message.pointer("/result/motion"), real.pointer("/result/motion")) {
                self.motion = (shown.clone(), number.clone());
            }
            if let Some(number) = real.pointer("/result/going").and_then(Value::as_u64) {
                self.going = number;
            }
            if let (Some(shown), Some(number)) = (message.pointer("/result/plan"), real.pointer("/result/plan")) {
                self.plan = (shown.clone(), number.clone());
            }
        }
        Ok(())
    }

    /// Makes an arm ready again that a stall of this computer held; returns whether there was one.
    fn recovers(&mut self) -> bool {
        let arm = self.watcher.call(Status {}).unwrap().arms.remove(0);
        let held = arm.cause.is_some_and(|cause| cause.name != "operator_stop");
        if held {
            self.watcher.call(ArmReset { arm: arm.hardware_id.clone() }).unwrap();
            self.watcher.call(ArmEnable::new(arm.hardware_id)).unwrap();
        }
        held
    }
}

#[test]
fn every_example_is_what_a_run_says() {
    let home = Home::new();
    home.write("streams.yaml", include_str!("../fixtures/streams.yaml"));
    let _run = home.run("streams.yaml --no-record");
    let watcher = home.client();
    let mut stage = Stage { home, watcher, motion: (Value::Null, Value::Null), plan: Default::default(), going: 0 };
    let examples = examples();
    assert!(examples.len() > 10, "examples are not found");
    let host = Watch::of_processors();
    for example in &examples {
        host.unless_stalled(|| {
            stage.comes_to_rest();
            let played = stage.play(example);
            if let Err(difference) = &played {
                assert!(stage.recovers(), "{difference}");
            }
            played
        });
    }
}

#[test]
fn the_blueprint_of_the_page_is_the_one_that_is_run() {
    let block = PAGE.split("```yaml\n").nth(1).unwrap().split("```").next().unwrap();
    let home = Home::new();
    home.write("page.yaml", block);
    home.write("streams.yaml", include_str!("../fixtures/streams.yaml"));
    let tasks = |name: &str| home.dimos(&format!("check {name} --json")).with(0).json()["blueprint"]["tasks"].take();
    assert_eq!(tasks("page.yaml"), tasks("streams.yaml"));
}

#[test]
fn every_method_stream_and_code_is_on_the_page() {
    for method in METHODS {
        assert!(PAGE.contains(&format!("# `{method}`\n")), "no heading for {method}");
        let asked = format!("\"method\": \"{method}\"");
        assert!(*method == "shutdown" || PAGE.contains(&asked), "no example of {method}");
    }
    for stream in Stream::ALL {
        assert!(PAGE.contains(&format!("| `{}` |", stream.name())), "{stream:?}");
    }

    let table = PAGE.split("## Errors").nth(1).unwrap();
    let variants = include_str!("../../crates/rpc/src/error.rs").split("pub enum Code {").nth(1).unwrap();
    let variants = variants.split("\n}").next().unwrap().lines().filter_map(|l| l.trim().strip_suffix(','));
    let mut known = 0;
    for variant in variants {
        let mut name = String::new();
        for c in variant.chars() {
            name.extend((c.is_uppercase() && !name.is_empty()).then_some('_').into_iter().chain(c.to_uppercase()));
        }
        assert!(table.contains(&format!("`{name}`")), "no row for {name}");
        assert_eq!(serde_json::from_value::<Code>(Value::from(name.as_str())).unwrap().name(), name);
        known += 1;
    }
    assert!(known > 20, "codes are not found");
}
