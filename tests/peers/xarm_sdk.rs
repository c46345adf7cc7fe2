//! The vendor's own client, in its own process, against our emulator at the arm's own ports: it connects,
//! enables, moves, reads, sets velocities, uses the gripper and the force/torque sensor, sees errors and clears them.

use std::net::{IpAddr, Ipv4Addr};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use dimos::arms::xarm::emulator::XArmEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::hardware::sim::tool_device::ToolDevice;
use serde_json::json;

use crate::support::program;
use crate::support::python::python_with;
use crate::support::skip::skip_port_502;

/// An emulator at the arm's own ports of a loopback address; `None` where port 502 cannot be had.
pub fn emulator(last: u8, dof: usize, options: serde_json::Value) -> Option<(XArmEmulator, String)> {
    let ip = IpAddr::V4(Ipv4Addr::new(127, 0, 6, last));
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof, options };
    match XArmEmulator::start(&config, &EmulatorAddress::Bind(ip)) {
        Ok(emulator) => {
            assert_eq!(emulator.address(), format!("{ip}:502:30000"));
            Some((emulator, ip.to_string()))
        }
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains(":502: ") && text.contains("\nhint: "), "{text}");
            assert!(text.contains("net.ipv4.ip_unprivileged_port_start=502"), "{text}");
            skip_port_502();
            None
        }
    }
}

/// The client's process, and the home folder that it may write to.
struct Client {
    child: Child,
    _home: tempfile::TempDir,
}

/// Runs a scenario of `tests/python/xarm_sdk.py` to its end; `None` where the client is not installed.
fn client(scenario: &str, host: &str) -> Option<Client> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = python_with(&["xarm"])?;
    let home = tempfile::tempdir().unwrap();
    let child = Command::new(python)
        .arg(root.join("tests/python/xarm_sdk.py"))
        .args([scenario, host])
        .env("HOME", home.path())
        .env("PYTHONDONTWRITEBYTECODE", "1")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    Some(Client { child, _home: home })
}

/// Waits for the end of a scenario, two minutes at most.
#[track_caller]
fn ends_well(Client { mut child, _home }: Client) {
    let end = std::time::Instant::now() + Duration::from_secs(120);
    while child.try_wait().unwrap().is_none() && std::time::Instant::now() < end {
        std::thread::sleep(Duration::from_millis(20));
    }
    let _ = child.kill();
    let output = child.wait_with_output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && out.ends_with("all is as it should be\n"), "{}\n{out}\n{err}", output.status);
}

#[test]
fn the_vendors_client_moves_reads_and_grips() {
    let Some((emulator, host)) = emulator(2, 6, json!({"gripper": "xarm", "force_torque": true})) else { return };
    let Some(child) = client("session", &host) else { return };
    ends_well(child);
    let (positions, _) = emulator.joints();
    assert!((positions[0] - 0.3).abs() < 0.01, "the plant is where the client left it: {positions:?}");
    assert!((emulator.gripper() - 0.04).abs() < 1e-3, "{}", emulator.gripper());
}

#[test]
fn the_vendors_client_sees_errors_and_clears_them() {
    let Some((emulator, host)) = emulator(3, 7, json!({})) else { return };
    let fault = Fault::new(FaultKind::ErrorCode).code(31).at(3.0);
    emulator.inject(fault).unwrap();
    let Some(child) = client("errors", &host) else { return };
    ends_well(child);
}

#[test]
fn the_vendors_client_sets_reduced_mode_and_meets_its_limits() {
    let Some((_emulator, host)) = emulator(4, 6, json!({})) else { return };
    let Some(child) = client("reduced", &host) else { return };
    ends_well(child);
}

/// Answers in capitals.
struct Capitals;

impl ToolDevice for Capitals {
    fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) {
        answer.extend(bytes.to_ascii_uppercase());
    }
}

#[test]
fn the_vendors_client_reaches_a_device_at_the_tools_line() {
    let Some((emulator, host)) = emulator(5, 6, json!({})) else { return };
    emulator.fit_tool(Capitals, 115_200);
    let Some(child) = client("tool-line", &host) else { return };
    ends_well(child);
}

#[test]
fn every_model_introduces_itself_to_the_vendors_client() {
    let models = [("xarm5", 5), ("xarm7", 7), ("lite6", 6), ("xarm850", 6)];
    for (i, (model, dof)) in models.into_iter().enumerate() {
        let Some((_emulator, host)) = emulator(10 + i as u8, dof, json!({"model": model})) else { return };
        let Some(child) = client(model, &host) else { return };
        ends_well(child);
    }
}

#[test]
fn an_old_firmware_satisfies_the_vendors_client_too() {
    let options = json!({"sim": {"firmware": "1.12.10"}});
    let Some((_emulator, host)) = emulator(20, 6, options) else { return };
    let Some(child) = client("old", &host) else { return };
    ends_well(child);
}

#[test]
fn the_vendors_client_takes_an_arm_over_from_a_run() {
    for (i, spacing) in [0, 5, 200].into_iter().enumerate() {
        let Some((emulator, host)) = emulator(30 + i as u8, 6, json!({})) else { return };
        let home = program::Home::new();
        let gripper = "--set hardware.arm.options.gripper=none";
        let run = home.run(&format!("coordinator-xarm6 --no-record --set hardware.arm.address={host} {gripper}"));
        program::eventually("ready", || home.status()["arms"][0]["phase"] == "ready");
        let start = emulator.joints().0;
        emulator.record();
        let Some(child) = client(&format!("takeover-{spacing}"), &host) else { return };
        ends_well(child);
        program::eventually("the hold", || home.status()["arms"][0]["cause"]["name"] == "mode_changed");
        run.end(rustix::process::Signal::INT);
        // From the client's change of mode on, all orders are the client's; what was on its way is refused.
        let trace = emulator.trace();
        let begin = trace.iter().position(|r| r.register == 19).unwrap();
        let orders = trace[begin..].iter().filter(|r| [11, 12, 16, 19, 21, 23, 30, 81].contains(&r.register));
        let orders: Vec<_> = orders.map(|r| (r.register, r.payload[0])).collect();
        assert!(matches!(orders[..], [(19, 0), (12, 0), (23, _)]), "{spacing} ms: {orders:?}");
        let set_points: Vec<_> = trace[begin..].iter().filter(|r| r.register == 29).collect();
        assert!(
            set_points.len() <= 2 && set_points.iter().all(|r| r.status & 0x58 != 0),
            "{spacing} ms: {set_points:?}"
        );
        let end = emulator.joints().0;
        assert!((0..6).all(|j| (end[j] - start[j] - 0.4).abs() < 1e-3), "{spacing} ms: {start:?} to {end:?}");
    }
}
