//! The metrics of a run, read with Prometheus' own parser of OpenMetrics (PyPI `prometheus_client`) and judged by its
//! `promtool`.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use dimos::rpc::api::{Lease, Move};
use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, Started, TIMEOUT, eventually};
use crate::support::python::python_with;
use crate::support::skip::skip_tool;

const BLUEPRINT: &str = "
hardware:
  - {hardware_id: left, joints: {prefix: left, count: 2}, adapter_type: mock}
  - {hardware_id: right, joints: {prefix: right, count: 2}, adapter_type: mock, auto_enable: false}
tasks:
  - {name: traj_left, type: trajectory, joint_names: {hardware: left}}
metrics: {listen: '127.0.0.1:0'}
";

/// A sample: name, then labels and values as they are written.
type Samples = BTreeMap<String, f64>;

/// Head and content of the reply to a request.
fn request(address: &str, head: &str) -> (String, String) {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(TIMEOUT)).unwrap();
    stream.write_all(format!("{head}\r\n\r\n").as_bytes()).unwrap();
    let mut reply = String::new();
    stream.read_to_string(&mut reply).unwrap();
    let (head, body) = reply.split_once("\r\n\r\n").unwrap();
    (head.to_owned(), body.to_owned())
}

fn status_of(head: &str) -> u16 {
    head.split(' ').nth(1).unwrap().parse().unwrap()
}

/// What the parser finds; its own checks have passed.
fn parsed(python: &Path, text: &str) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/readers/read_metrics.py");
    let mut child = Command::new(python).arg(script).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "not OpenMetrics:\n{text}");
    serde_json::from_slice(&output.stdout).unwrap()
}

/// All samples of families of this type; any with an empty one.
fn samples(families: &Value, kind: &str) -> Samples {
    let of_kind = families.as_object().unwrap().values().filter(|f| kind.is_empty() || f["type"] == kind);
    let all = of_kind.flat_map(|family| family["samples"].as_array().unwrap());
    all.map(|sample| {
        let labels: BTreeMap<String, String> = serde_json::from_value(sample[1].clone()).unwrap();
        let labels: Vec<String> = labels.iter().map(|(name, value)| format!("{name}={value}")).collect();
        (format!("{} {}", sample[0].as_str().unwrap(), labels.join(",")), sample[2].as_f64().unwrap())
    })
    .collect()
}

#[test]
fn what_a_run_does_is_counted_and_read_by_prometheus() {
    let Some(python) = python_with(&["prometheus_client"]) else { return };
    let home = Home::new();
    home.write("cell.yaml", BLUEPRINT);
    let run = Started::of(home.as_typed("run cell.yaml").stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    let url = home.status()["metrics"].as_str().unwrap().to_owned();
    assert!(run.err().contains(&format!("metrics    {url}")), "{}", run.err());
    let address = url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap();
    let get = format!("GET /metrics HTTP/1.1\r\nHost: {address}");

    let (head, first) = request(address, &get);
    assert!(head.contains("Content-Type: application/openmetrics-text; version=1.0.0; charset=utf-8"), "{head}");
    let families = parsed(&python, &first);
    for (name, kind, unit) in [
        ("dimos_tick_lateness_seconds", "histogram", "seconds"),
        ("dimos_arm_reading_age_seconds", "gauge", "seconds"),
        ("dimos_arm_phase", "stateset", ""),
        ("dimos_log_written_bytes", "counter", "bytes"),
        ("dimos_log_disk_free_bytes", "gauge", "bytes"),
        ("dimos_build", "info", ""),
    ] {
        assert_eq!((&families[name]["type"], &families[name]["unit"]), (&kind.into(), &unit.into()), "{name}");
    }
    let all = samples(&families, "");
    let run_info = "dimos_run_info blueprint=cell,run=cell,simulated=true";
    assert_eq!((all.get(run_info), all["dimos_arm_phase arm=left,dimos_arm_phase=ready"]), (Some(&1.0), 1.0));
    assert_eq!(all["dimos_arm_phase arm=right,dimos_arm_phase=disabled"], 1.0);
    assert!((0.0..1.0).contains(&all["dimos_arm_reading_age_seconds arm=left"]), "{first}");
    assert!(all["dimos_log_disk_free_bytes "] > 1e8 && all["dimos_log_written_bytes_total "] > 0.0, "{first}");
    assert!(
        !first.contains("dimos_arm_holds")
            && !first.contains("dimos_commands_refused")
            && !first.contains("dimos_motions"),
        "nothing has happened:\n{first}"
    );

    // A motion that arrives, one that is refused, a stop by an operator, and one that is refused for that.
    home.dimos("move left 0.1 0").with(0);
    home.dimos("move left 100 0").with(1);
    home.dimos("stop left").with(0);
    home.dimos("move left 0 0").with(1);
    let mut second = String::new();
    eventually("the events are counted", || {
        second = request(address, &get).1;
        second.contains("dimos_arm_holds_total{arm=\"left\",cause=\"operator_stop\"} 1")
            && second.contains("dimos_motions_total{task=\"traj_left\",outcome=\"COMPLETED\"} 1")
            && second.contains("dimos_commands_refused_total{method=\"move\",code=\"ARM_LATCHED\"} 1")
            && second.contains("dimos_commands_refused_total{method=\"move\",code=\"OUT_OF_LIMITS\"} 1")
    });
    let (before, after) = (samples(&families, "counter"), parsed(&python, &second));
    let (counters, after) = (samples(&after, "counter"), samples(&after, ""));
    for (name, value) in before.iter().chain(&samples(&families, "histogram")) {
        assert!(after[name] >= *value, "{name} has decreased");
    }
    assert!(counters["dimos_ticks_total "] > before["dimos_ticks_total "]);
    let ticks = after["dimos_tick_lateness_seconds_bucket le=+Inf"];
    assert!(ticks > 0.0 && (ticks - counters["dimos_ticks_total "]).abs() <= 2.0, "a duration for each tick");
    assert_eq!(after["dimos_arm_phase arm=left,dimos_arm_phase=held"], 1.0);

    // The run's own figures.
    let status = home.status();
    let p50 = status["ticks"]["compute_us"]["p50"].as_f64().unwrap() * 1e-6;
    let below: f64 = after
        .iter()
        .filter_map(|(name, count)| Some((name.strip_prefix("dimos_tick_compute_seconds_bucket le=")?, count)))
        .filter(|(limit, _)| limit.parse::<f64>().unwrap() >= p50)
        .map(|(_, count)| *count)
        .fold(f64::MAX, f64::min);
    assert!(below >= 0.4 * ticks, "{below} of {ticks} are up to the median, {p50} s");

    // To programs by address, and to no page.
    let evil = format!("GET /metrics HTTP/1.1\r\nHost: evil.test\r\nX: {address}");
    for (head, status) in [
        (evil, 403),
        (format!("{get}\r\nOrigin: https://evil.test"), 403),
        (get.replace("GET", "POST"), 405),
        (get.replace("/metrics", "/"), 404),
        ("nonsense".to_owned(), 400),
    ] {
        assert_eq!(status_of(&request(address, &head).0), status, "{head}");
    }
    // A connection that says nothing delays no one.
    let _silent: Vec<TcpStream> = (0..8).map(|_| TcpStream::connect(address).unwrap()).collect();
    assert_eq!(status_of(&request(address, &get).0), 200);
    assert_eq!(run.end(Signal::INT).code, Some(130));
}

/// What is refused before the run is asked: an arm that another client commands, and wrong parameters.
#[test]
fn refusals_for_leases_and_parameters_are_counted() {
    let home = Home::new();
    home.write("cell.yaml", BLUEPRINT);
    let run = Started::of(home.as_typed("run --no-record cell.yaml").stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    let url = home.status()["metrics"].as_str().unwrap().to_owned();
    let address = url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap();
    let mut commander = home.client();
    commander.call(Lease { arm: Some("left".into()) }).unwrap();
    home.dimos("move left 0.1 0").with(1).says(&["[LEASE_HELD]"]);
    home.dimos("move left 0.1 0").with(1).says(&["[LEASE_HELD]"]);
    home.dimos("arm disable left").with(1).says(&["[LEASE_HELD]"]);
    let mut other = home.client();
    other.call(Lease { arm: None }).unwrap_err();
    other.call(Move::new("left", [], 7.0)).unwrap_err();
    let mut socket = UnixStream::connect(home.path().join("run/dimos/cell.sock")).unwrap();
    socket.write_all(b"{\"id\": 1, \"method\": \"made_up\"}\n").unwrap();
    let mut reply = String::new();
    BufReader::new(socket).read_line(&mut reply).unwrap();
    assert!(reply.contains("UNKNOWN_METHOD"), "{reply}");
    let text = request(address, &format!("GET /metrics HTTP/1.1\r\nHost: {address}")).1;
    let refused: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("dimos_commands_refused_total")).collect();
    let wanted = [
        "{method=\"arm_disable\",code=\"LEASE_HELD\"} 1",
        "{method=\"lease\",code=\"LEASE_HELD\"} 1",
        "{method=\"move\",code=\"INVALID_PARAMS\"} 1",
        "{method=\"move\",code=\"LEASE_HELD\"} 2",
    ];
    assert_eq!(refused, wanted, "{text}");
    run.end(Signal::INT);
}

/// Of the run's own planner, and of one that is attached from another process.
#[test]
fn plans_are_counted_in_the_process_that_plans() {
    let Some(python) = python_with(&["prometheus_client"]) else { return };
    let (home, own) = (Home::new(), "metrics: {listen: '127.0.0.1:0'}\n");
    home.write("both.yaml", &format!("include: [yourarm-planner]\n{own}"));
    home.write("planner.yaml", &format!("name: lab\ninclude: [yourarm-planner]\n{own}"));
    let plan_and_read = |address: &str| {
        home.dimos("plan arm 0.3 -0.3 0.6 0 0.8 0").with(0);
        home.dimos("plan arm --pose 3 0 0.3").with(1);
        let (_, text) = request(address, &format!("GET /metrics HTTP/1.1\r\nHost: {address}"));
        let all = samples(&parsed(&python, &text), "");
        for (outcome, count) in [("PLANNED", 1.0), ("FAILED", 1.0), ("CANCELLED", 0.0)] {
            assert_eq!(all[&format!("dimos_plans_total outcome={outcome}")], count, "{text}");
        }
        assert_eq!(all["dimos_planning_seconds_bucket le=+Inf"], 2.0, "{text}");
        all
    };
    let address = |url: &str| url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap().to_owned();
    let run = home.run("both.yaml --no-record");
    let of_run = plan_and_read(&address(home.status()["metrics"].as_str().unwrap()));
    assert!(of_run.contains_key("dimos_ticks_total "), "{of_run:?}");
    run.end(Signal::INT).with(130);

    let run = home.run("coordinator-yourarm --no-record");
    let planner = home.start("run planner.yaml");
    planner.until("Press Ctrl-C");
    let said = planner.err();
    let url = said.lines().find_map(|line| line.trim().strip_prefix("metrics ")).unwrap_or_else(|| panic!("{said}"));
    let at = address(url.trim());
    let of_planner = plan_and_read(&at);
    let info = "dimos_planner_info blueprint=lab,planner=lab,run=coordinator-yourarm";
    assert_eq!((of_planner[info], of_planner["dimos_planner_attached "]), (1.0, 1.0));
    assert!((0.0..5.0).contains(&of_planner["dimos_planner_state_age_seconds "]), "{of_planner:?}");
    assert_eq!(of_planner["dimos_planner_lost_runs_total "], 0.0);
    run.end(Signal::INT).with(130);
    planner.until("the run is gone");
    let text = request(&at, &format!("GET /metrics HTTP/1.1\r\nHost: {at}")).1;
    assert!(
        text.contains("dimos_planner_attached 0\n") && text.contains("dimos_planner_lost_runs_total 1\n"),
        "{text}"
    );
    planner.end(Signal::INT).with(130);
}

/// One blueprint may start the run and, beside it, the planner: that finds its address taken by the run.
#[test]
fn an_attached_planner_leaves_the_runs_address_to_the_run() {
    let home = Home::new();
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let metrics = format!("metrics: {{listen: '{free}'}}\n");
    home.write("cell.yaml", &format!("include: [coordinator-yourarm]\n{metrics}"));
    home.write("lab.yaml", &format!("include: [yourarm-planner]\n{metrics}"));
    let run = home.run("cell.yaml --no-record");
    let planner = home.start("run lab.yaml");
    planner.until("Press Ctrl-C");
    let says = "that address is the run's: --set metrics.listen=127.0.0.1:PORT";
    assert!(planner.err().contains(says), "{}", planner.err());
    planner.end(Signal::INT).with(130);
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = taken.local_addr().unwrap();
    home.dimos(&format!("run lab.yaml --set metrics.listen={at}"))
        .with(1)
        .says(&[&format!("the metrics cannot be served at {at}"), "hint: another run may have it"]);
    run.end(Signal::INT).with(130);
}

#[test]
fn promtool_finds_nothing_wrong_with_the_text_format() {
    let promtool = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/promtool");
    if !promtool.exists() {
        return skip_tool("promtool");
    }
    let home = Home::new();
    home.write("cell.yaml", BLUEPRINT);
    let run = Started::of(home.as_typed("run --no-record cell.yaml").stdin(Stdio::null()));
    run.until("Press Ctrl-C");
    home.dimos("move left 0.1 0").with(0);
    let url = home.status()["metrics"].as_str().unwrap().to_owned();
    let address = url.strip_prefix("http://").unwrap().strip_suffix("/metrics").unwrap();
    let get = format!("GET /metrics HTTP/1.1\r\nHost: {address}\r\nAccept: text/plain");
    // Events reach the counts within 50 ms.
    eventually("the motion is counted", || request(address, &get).1.contains("dimos_motions_total{"));
    let (head, text) = request(address, &get);
    assert!(head.contains("Content-Type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
    assert!(!text.contains("dimos_log_"), "no log, no figures of it:\n{text}");
    let mut command = Command::new(promtool);
    let mut child = command
        .args(["check", "metrics"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
    let judged = child.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&judged.stdout) + String::from_utf8_lossy(&judged.stderr);
    assert!(judged.status.success() && said.is_empty(), "{said}\n{text}");
    run.end(Signal::INT);
}

#[test]
fn an_address_that_is_taken_ends_the_start_before_an_arm_is_connected() {
    let home = Home::new();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let at = taken.local_addr().unwrap();
    home.write("cell.yaml", &BLUEPRINT.replace("127.0.0.1:0", &at.to_string()));
    let says = [&*format!("the metrics cannot be served at {at}"), "hint: another run may have it"];
    home.dimos("run cell.yaml").with(1).says(&says);
    assert_eq!(home.logs(), Vec::<PathBuf>::new());
    for (listen, says) in [("localhost:9464", "is no address"), ("127.0.0.1", "is no address")] {
        home.dimos(&format!("check cell.yaml --set metrics.listen={listen}"))
            .with(2)
            .says(&[says, "hint: write an IP"]);
    }
    let open = home.dimos("check cell.yaml --set metrics.listen=0.0.0.0:9464").with(0);
    assert!(open.err.contains("the metrics are open to the network"), "{}", open.err);
}
