//! The emulated controller without an adapter: what comes back on its ports.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use serde_json::json;

use super::*;

fn start(options: serde_json::Value) -> UrEmulator {
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap()
}

fn connect(emulator: &UrEmulator, service: Service) -> TcpStream {
    let at = SocketAddr::new(emulator.address.ip(), emulator.address.port() + service as u16);
    let stream = TcpStream::connect(at).unwrap();
    stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
    stream
}

fn line(stream: &mut TcpStream) -> String {
    let mut line = Vec::new();
    let mut byte = [0];
    while stream.read(&mut byte).unwrap() == 1 && byte[0] != b'\n' {
        line.push(byte[0]);
    }
    String::from_utf8(line).unwrap()
}

fn ask(stream: &mut TcpStream, request: &str) -> String {
    stream.write_all(format!("{request}\n").as_bytes()).unwrap();
    line(stream)
}

#[test]
fn the_dashboard_switches_power_and_says_what_it_does() {
    let emulator = start(json!({"model": "ur10e"}));
    let mut dashboard = connect(&emulator, Service::Dashboard);
    assert_eq!(line(&mut dashboard), "Connected: Universal Robots Dashboard Server");
    for (request, answer) in [
        ("PolyscopeVersion", "URSoftware 5.11.6.1106628 (Jan 01 2022)"),
        ("get robot model", "UR10"),
        ("is in remote control", "true"),
        ("robotmode", "Robotmode: POWER_OFF"),
        ("safetystatus", "Safetystatus: NORMAL"),
        ("programState", "STOPPED <unnamed>"),
        ("brake release", "Brake releasing"),
        ("fly", "could not understand: 'fly'"),
    ] {
        assert_eq!(ask(&mut dashboard, request), answer);
    }
    let began = std::time::Instant::now();
    while ask(&mut dashboard, "robotmode") != "Robotmode: RUNNING" {
        assert!(began.elapsed() < Duration::from_secs(5));
        std::thread::sleep(Duration::from_millis(5));
    }
    emulator.set_remote_control(false);
    assert_eq!(ask(&mut dashboard, "power off"), "Command is not allowed due to safety reasons");
    assert_eq!(ask(&mut dashboard, "robotmode"), "Robotmode: RUNNING");
    let cb3 = start(json!({"model": "ur5"}));
    let mut dashboard = connect(&cb3, Service::Dashboard);
    line(&mut dashboard);
    assert!(ask(&mut dashboard, "is in remote control").starts_with("could not understand"));
}

/// Sends a packet and returns the content of the answer.
fn packet(stream: &mut TcpStream, kind: u8, content: &[u8]) -> Vec<u8> {
    let length = (content.len() as u16 + 3).to_be_bytes();
    stream.write_all(&[&length[..], &[kind], content].concat()).unwrap();
    let mut head = [0; 3];
    stream.read_exact(&mut head).unwrap();
    assert_eq!(head[2], kind);
    let mut content = vec![0; usize::from(u16::from_be_bytes([head[0], head[1]])) - 3];
    stream.read_exact(&mut content).unwrap();
    content
}

#[test]
fn rtde_agrees_on_values() {
    let emulator = start(json!({}));
    let mut first = connect(&emulator, Service::Rtde);
    assert_eq!(packet(&mut first, b'V', &[0, 2]), [1]);
    assert_eq!(packet(&mut first, b'V', &[0, 3]), [0]);
    let hertz = 125f64.to_be_bytes();
    let outputs = |names: &str| [&hertz[..], names.as_bytes()].concat();
    assert_eq!(packet(&mut first, b'O', &outputs("timestamp,nothing")), b"\0DOUBLE,NOT_FOUND");
    assert_eq!(
        packet(&mut first, b'O', &outputs("timestamp,actual_q,joint_mode,")),
        b"\x01DOUBLE,VECTOR6D,VECTOR6INT32"
    );
    assert_eq!(packet(&mut first, b'I', b"input_int_register_0,standard_digital_output"), b"\x01INT32,UINT8");
    let mut second = connect(&emulator, Service::Rtde);
    assert_eq!(packet(&mut second, b'S', &[]), [0], "without outputs");
    assert_eq!(packet(&mut second, b'I', b"input_int_register_0,input_int_register_1"), b"\0IN_USE,INT32");
    assert_eq!(packet(&mut second, b'I', b"input_int_register_1"), b"\x01INT32");
    assert_eq!(packet(&mut first, b'S', &[]), [1]);
    let (mut times, mut frame) = (Vec::new(), [0; 4 + 8 + 48 + 24]);
    for _ in 0..3 {
        first.read_exact(&mut frame).unwrap();
        assert_eq!(frame[..4], [0, 84, b'U', 1]);
        times.push(f64::from_be_bytes(frame[4..12].try_into().unwrap()));
    }
    let apart = times[2] - times[1];
    assert!(apart > 0.004 && times[0] > 100.0, "125 times a second, {times:?}");
}

#[test]
fn programs_are_started_and_end_and_local_control_refuses_them() {
    let emulator = start(json!({"sim": {"power_time": 0.0}}));
    let mut script = connect(&emulator, Service::Primary);
    script.write_all(b"set robotmode run\n").unwrap();
    let mut seen = Vec::new();
    let mut buffer = [0; 4096];
    let mut until = |script: &mut TcpStream, text: &[u8]| {
        let began = std::time::Instant::now();
        while !seen.windows(text.len()).any(|window| window == text) {
            assert!(began.elapsed() < Duration::from_secs(5), "{}", String::from_utf8_lossy(text));
            let n = script.read(&mut buffer).unwrap();
            seen.extend_from_slice(&buffer[..n]);
        }
    };
    until(&mut script, b"URControl");
    let began = std::time::Instant::now();
    while emulator.with(|controller| controller.mode) != 7 {
        assert!(began.elapsed() < Duration::from_secs(5));
        std::thread::sleep(Duration::from_millis(2));
    }
    script.write_all(b"def hello():\n  textmsg(1)\nend\n").unwrap();
    until(&mut script, b"PROGRAM_XXX_STARTEDhello");
    until(&mut script, b"PROGRAM_XXX_STOPPEDhello");
    // The pendant takes the connection away, and what is opened now stays read-only.
    emulator.set_remote_control(false);
    while script.read(&mut [0; 4096]).unwrap() > 0 {}
    let mut script = connect(&emulator, Service::Primary);
    for remote in [false, true] {
        emulator.set_remote_control(remote);
        script = if remote { script } else { connect(&emulator, Service::Primary) };
        script.write_all(b"def again():\n  textmsg(1)\nend\n").unwrap();
        until(&mut script, &[6, 0, 0, 0, 210]);
        assert_eq!(emulator.program(), None);
    }
}
