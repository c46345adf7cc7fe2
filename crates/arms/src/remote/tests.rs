//! The protocol against the sheet, and the adapter against the emulator over real sockets.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::time::{Duration, Instant};

use super::SPEC;
use super::address::Address;
use super::emulator::wire;
use super::link::Link;
use super::protocol::{self, Act, Command, Description, More, Reply, WirePose};
use super::session::Session;
use dimos_core::arm::{JointSet, Setpoint, StopPoint};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, joints_of};
use dimos_hardware::adapter::{AdapterError, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::transport::Scan;

/// The lines of the sheet that begin so.
fn sheet(start: &str) -> Vec<&'static str> {
    include_str!("../../../../docs/remote-adapter.md").lines().filter(|line| line.starts_with(start)).collect()
}

fn written(encode: impl FnOnce(&mut Vec<u8>)) -> String {
    let mut out = vec![0xAA; 3];
    encode(&mut out);
    let line = String::from_utf8(out).unwrap();
    line.strip_suffix('\n').unwrap().to_owned()
}

/// Two lines of JSON with the same content.
fn same(a: &str, b: &str) -> bool {
    let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
    value(a) == value(b)
}

#[test]
fn the_requests_of_the_sheet_are_these() {
    let [hello, enable, mode, first, command] = sheet("{\"id\":")[..] else { panic!("five requests") };
    assert!(same(hello, &written(|out| protocol::hello(1, 2, out))));
    assert!(same(enable, &written(|out| protocol::act(2, &Act::Activate, out))));
    assert!(same(mode, &written(|out| protocol::act(3, &Act::Mode(ControlMode::ServoPosition), out))));
    assert_eq!(first, written(|out| protocol::cycle(4, None, out)));
    let (values, velocity) = (&[0.1, -0.30000000000000004][..], 1.0);
    let more = More {
        velocities: Some(&[0.5, 0.0]),
        accelerations: Some(&[0.0, -1.0]),
        efforts: Some(&[2.5, -0.25]),
        at: Some(81_234_000_000_000),
        valid: Some(0.02),
        ..More::default()
    };
    let ours = Command { mode: ControlMode::ServoPosition, values, velocity, more };
    assert_eq!(command, written(|out| protocol::cycle(5, Some(ours), out)));
    // The double reads the same out of them, to the last bit.
    let scanned = |line: &str| match wire::scan(format!("{line}\n").as_bytes()) {
        Scan::Take(n, request) if n == line.len() + 1 => request.unwrap(),
        other => panic!("{other:?}"),
    };
    assert_eq!(scanned(hello).what, "hello");
    let request = scanned(command);
    let read = request.command.unwrap();
    assert_eq!((request.id, read.values.as_slice(), read.at, read.valid), (5, values, more.at, more.valid));
    assert_eq!(read.list("efforts"), Ok(Some(vec![2.5, -0.25])));
    assert_eq!(read.list("stiffness"), Ok(None), "what is not commanded is not sent");
    assert_eq!(wire::scan(command.as_bytes()), Scan::More);
    assert_eq!(wire::scan(b"GET /\n"), Scan::Take(6, Err("a line that is not JSON")));
}

#[test]
fn the_replies_of_the_sheet_are_understood() {
    let [hello, done, refused, state] = sheet("{ \"id\":")[..] else { panic!("four replies") };
    let description = Description::decode(hello.as_bytes(), super::MODES).unwrap();
    assert_eq!((description.dof, description.info.model.as_str(), description.native_rate), (2, "YA2", 250.0));
    assert_eq!(description.limits.velocity_max, [2.5, 2.5]);
    let reply = |line: &str| Reply::decode(line.as_bytes()).unwrap();
    assert_eq!((reply(done).id, reply(done).trouble("peer")), (2, None));
    let expected = AdapterError::Rejected("peer: write_enable() said no (error 2: collision)".to_owned());
    assert_eq!(reply(refused).trouble("peer"), Some(expected));
    let reply = reply(state);
    let measured = reply.state.unwrap();
    assert_eq!(measured.position.joints[..3], [0.1, -0.30000000000000004, 0.0]);
    assert_eq!((measured.time, measured.enabled, measured.gripper), (81_234_567_890_123, Some(true), Some(0.04)));
    assert_eq!(measured.pose.map(WirePose::pose).unwrap().rpy, [0.0, 1.5, -3.0]);
    assert_eq!((measured.check(2), reply.refused), (Ok(()), None));
    assert_eq!((measured.lost(), measured.device_time), (JointSet::of([1]), Some(1_250_000_000)));
    assert!(measured.check(3).unwrap_err().contains("2 values for 3 joints"));
}

#[test]
fn what_is_no_reply_is_an_error_and_never_a_panic() {
    for bad in ["", "{}", "[]", "null", r#"{"id":-1}"#, r#"{"id":1,"state":{}}"#, "{\"id\":1", "\u{0}\u{ff}"] {
        assert!(Reply::decode(bad.as_bytes()).is_err(), "{bad}");
    }
    let state = |positions: &str| format!(r#"{{"id":1,"state":{{"time":1,"read_joint_positions":{positions}}}}}"#);
    for bad in ["[NaN]", "[1e999]", "[null]", "[\"1\"]", "{}", &format!("[{}0]", "0,".repeat(16))] {
        assert!(Reply::decode(state(bad).as_bytes()).is_err(), "{bad}");
    }
    assert!(Reply::decode(state("[1, 2]").as_bytes()).is_ok());
    // A long text is cut where a letter ends.
    let long = format!(r#"{{"id":1,"error":"io","text":"{}"}}"#, "ä".repeat(500));
    let text = Reply::decode(long.as_bytes()).unwrap().text();
    assert_eq!(text, "ä".repeat(120));
}

fn served(dof: usize) -> (Box<dyn Emulator>, Box<dyn ManipulatorAdapter>) {
    let emulator = crate::emulate("remote", dof).unwrap();
    let adapter = crate::create("remote", &emulator.address(), dof).unwrap();
    (emulator, adapter)
}

fn ready(adapter: &mut dyn ManipulatorAdapter, mode: ControlMode) {
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.set_control_mode(mode).unwrap();
}

/// Waits until `done`, for at most 10 s.
fn until(what: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(10);
    while !done() {
        assert!(Instant::now() < end, "{what}: not within 10 s");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_reply_wakes_and_brings_what_was_commanded() {
    let (_emulator, mut arm) = served(2);
    ready(&mut *arm, ControlMode::ServoPosition);
    let mut reading = JointReading::default();
    until("the setpoint", || {
        arm.write_joint_positions(&[0.01, -0.02], 1.0).unwrap();
        let mut fds = [rustix::event::PollFd::from_borrowed_fd(arm.state_fd().unwrap(), rustix::event::PollFlags::IN)];
        let wait = rustix::event::Timespec { tv_sec: 5, tv_nsec: 0 };
        assert_eq!(rustix::event::poll(&mut fds, Some(&wait)), Ok(1), "the reply makes the descriptor readable");
        arm.read_joints(&mut reading).unwrap();
        reading.position[..2] == [0.01, -0.02]
    });
}

#[test]
fn a_client_that_falls_silent_loses_the_arm() {
    let (_emulator, mut arm) = served(1);
    ready(&mut *arm, ControlMode::Position);
    arm.write_joint_positions(&[2.0], 0.1).unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    let mut position = [0.0];
    arm.read_joint_positions(&mut position).unwrap();
    assert!(position[0] > 0.01 && position[0] < 1.0, "it was on its way and was stopped: {position:?}");
    let refused = arm.write_joint_positions(&[2.0], 0.1).unwrap_err().to_string();
    assert!(refused.contains("enable it again"), "{refused}");
    assert_eq!(arm.read_enabled(), Ok(false));
    arm.activate().unwrap();
    arm.write_joint_positions(&[2.0], 0.1).unwrap();
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
}

#[test]
fn refusals_come_with_the_next_command_and_stale_states_are_said() {
    let (emulator, mut arm) = served(2);
    ready(&mut *arm, ControlMode::Position);
    let limit = arm.get_limits().unwrap().position_upper[0];
    assert!(limit > 6.0 && arm.get_info().model == "simulated");
    emulator.inject(Fault::new(FaultKind::Silent).lasting(60.0)).unwrap();
    let mut reading = JointReading::default();
    until("a late reply", || matches!(arm.read_joints(&mut reading), Err(AdapterError::Timeout(_))));
    assert!(arm.is_connected(), "late is not gone");
    assert!(matches!(arm.write_stop(&StopPoint::default()), Err(AdapterError::Timeout(_))), "no confirmation");
    until("the end", || arm.read_joints(&mut reading).is_err() && !arm.is_connected());
}

/// Serves one client: sends the lines that `answer` returns for each request.
fn scripted(mut answer: impl FnMut(&wire::Request) -> String + Send + 'static) -> Address {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = Address::parse(&listener.local_addr().unwrap().to_string()).unwrap();
    std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        let requests = BufReader::new(stream.try_clone().unwrap());
        for line in requests.lines().map_while(Result::ok) {
            let Scan::Take(_, Ok(request)) = wire::scan(format!("{line}\n").as_bytes()) else { panic!("{line}") };
            stream.write_all(answer(&request).as_bytes()).unwrap();
        }
    });
    address
}

#[test]
fn a_late_refusal_of_an_earlier_act_does_not_fail_the_reads() {
    let [hello, _, refused, state] = sheet("{ \"id\":")[..] else { panic!("four replies") };
    let numbered = |line: &str, id: u64| {
        let mut reply: serde_json::Value = serde_json::from_str(line).unwrap();
        reply["id"] = id.into();
        format!("{reply}\n")
    };
    let mut enable = 0;
    let address = scripted(move |request| match request.what.as_str() {
        "hello" => numbered(hello, request.id),
        "cycle" => numbered(state, request.id),
        "write_enable" => {
            enable = request.id;
            String::new()
        }
        // The late reply to `write_enable` comes first.
        "write_stop" => numbered(refused, enable) + &numbered("{}", request.id),
        other => panic!("{other}"),
    });
    let mut session = Session::open(&address, 2).unwrap();
    assert_eq!(session.act(&Act::Enable(true), Duration::from_millis(20)), Ok(None));
    assert_eq!(session.act(&Act::Stop(Vec::new()), Duration::from_secs(10)), Ok(Some(Ok(()))));
    let state = session.newest();
    assert!(matches!(state, Ok(Ok(_))), "{state:?}");
}

#[test]
fn a_stop_has_its_point_of_rest_only_where_the_peer_takes_one() {
    for takes in [false, true] {
        let [hello, .., state] = sheet("{ \"id\":")[..] else { panic!("four replies") };
        let mut hello: serde_json::Value = serde_json::from_str(hello).unwrap();
        hello["stop_point"] = takes.into();
        let mut state: serde_json::Value = serde_json::from_str(state).unwrap();
        let (said, heard) = std::sync::mpsc::channel();
        let address = scripted(move |request| {
            let reply = match request.what.as_str() {
                "hello" => &mut hello,
                "cycle" => &mut state,
                _ => &mut serde_json::json!({}),
            };
            reply["id"] = request.id.into();
            if request.what == "write_stop" {
                said.send(serde_json::json!(request.arguments).to_string()).unwrap();
            }
            format!("{reply}\n")
        });
        let mut arm = crate::create("remote", &address.to_string(), 2).unwrap();
        arm.connect().unwrap();
        let at = |position: &[f64]| StopPoint { position: Some(joints_of(position)) };
        for point in [at(&[0.1, -0.3]), StopPoint::default(), at(&[0.1, f64::NAN])] {
            assert_eq!(arm.write_stop(&point), Ok(Stop::Confirmed));
        }
        let first = if takes { "[[0.1,-0.3]]" } else { "[]" };
        assert_eq!([(); 3].map(|()| heard.recv().unwrap()), [first, "[]", "[]"]);
    }
}

#[test]
fn a_peer_of_version_1_connects_and_gets_positions_alone() {
    let [hello, .., state] = sheet("{ \"id\":")[..] else { panic!("four replies") };
    for version in [1, 2, 3] {
        let mut hello: serde_json::Value = serde_json::from_str(hello).unwrap();
        hello["version"] = version.into();
        let mut state: serde_json::Value = serde_json::from_str(state).unwrap();
        let (said, heard) = std::sync::mpsc::channel();
        let address = scripted(move |request| {
            let reply = match request.what.as_str() {
                "hello" => &mut hello,
                "cycle" => &mut state,
                _ => &mut serde_json::json!({}),
            };
            reply["id"] = request.id.into();
            if let Some(command) = &request.command {
                drop(said.send(command.lists.keys().cloned().collect::<Vec<_>>()));
            }
            format!("{reply}\n")
        });
        let mut arm = crate::create("remote", &address.to_string(), 2).unwrap();
        let connected = arm.connect();
        if version == 3 {
            let error = connected.unwrap_err().to_string();
            assert!(error.contains("version 3 of the protocol, this program versions 1 to 2"), "{error}");
            continue;
        }
        connected.unwrap();
        arm.set_control_mode(ControlMode::ServoPosition).unwrap();
        let taken = arm.setpoint_fields().unwrap().named().iter().filter(|(_, field)| field.is_taken()).count();
        let setpoint = Setpoint {
            effort: Some(joints_of(&[1.0, 2.0])),
            ..Setpoint::new(ControlMode::ServoPosition, joints_of(&[0.1, -0.3]), Mono(7))
        };
        until("room", || arm.write_setpoint(&setpoint).is_ok());
        let lists = heard.recv_timeout(Duration::from_secs(10)).unwrap();
        match version {
            1 => assert_eq!((taken, lists), (0, vec!["values".to_owned()])),
            _ => assert_eq!((taken, lists), (5, ["efforts", "values", "velocities"].map(str::to_owned).to_vec())),
        }
    }
}

#[test]
fn a_second_client_is_refused_and_the_first_one_goes_on() {
    let (emulator, mut arm) = served(3);
    arm.connect().unwrap();
    let mut second = crate::create("remote", &emulator.address(), 3).unwrap();
    let error = second.connect().unwrap_err().to_string();
    assert!(error.contains("serves another client already"), "{error}");
    assert!(arm.read_joint_positions(&mut [0.0; 3]).is_ok());
    arm.disconnect();
    until("the free place", || second.connect().is_ok());
}

#[test]
fn wrong_configurations_are_refused() {
    let config = |address: &str, dof| AdapterConfig {
        hardware_id: "arm".into(),
        address: address.into(),
        dof,
        options: serde_json::Value::Null,
    };
    for (config, part) in [
        (config("127.0.0.1:7450", 17), "1 to 16 joints, not 17"),
        (config("192.168.1.5:7450", 6), "no authentication"),
        (config("", 6), "has no port"),
    ] {
        let error = (SPEC.create)(&config).err().unwrap().to_string();
        assert!(error.contains(part), "{error}");
    }
    let modes = [ControlMode::Velocity, ControlMode::Position];
    assert_eq!(super::same_modes(&modes), [ControlMode::Position, ControlMode::Velocity]);
    for bits in 0..16usize {
        let given: Vec<_> =
            super::MODES.iter().enumerate().filter(|(i, _)| bits >> i & 1 == 1).map(|(_, m)| *m).collect();
        assert_eq!(super::same_modes(&given), given);
    }
}

#[test]
fn a_connection_ends_when_it_is_closed_also_while_another_process_holds_its_socket() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.sock");
    let listener = std::os::unix::net::UnixListener::bind(&path).unwrap();
    let address = Address::parse(&format!("unix:{}", path.display())).unwrap();
    let link = Link::connect(&address, Duration::from_secs(1)).unwrap();
    let (mut peer, _) = listener.accept().unwrap();
    // As a process that is being started does until it executes.
    let _held = link.fd().try_clone_to_owned().unwrap();
    drop(link);
    peer.set_read_timeout(Some(Duration::from_secs(2))).unwrap();
    assert_eq!(peer.read(&mut [0; 8]).map_err(|error| error.kind()), Ok(0));
}
