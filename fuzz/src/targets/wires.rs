//! Wires of arms: what decoders take, what emulators take, and an adapter on a wire that spoils what is on it.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use dimos::arm::{Setpoint, StopPoint};
use dimos::arms;
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::{JointReading, ManipulatorAdapter};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress};
use dimos::hardware::transport::Scan;
use dimos::hardware::wire::Place;
use dimos::joint::joints_of;

use crate::bytes::Bytes;
use crate::{Target, bug};

/// Messages of every protocol, both ways.
pub const DECODER: Target = Target {
    name: "decoder",
    about: "messages, or noise that is skipped; each step gets on, and a mended message is taken",
    run: decoder,
    seeds: || {
        let rows = arms::registry().rows().len() as u8;
        let heads: [&[u8]; 8] = [
            &[0xAA, 0x55, 4, 0, 1, 2, 3, 4, 5, 6],
            &[0, 1, 0, 2, 0, 1, 1, 0, 0],
            &[0xFF, 0xFF, 1, 4, 2, 0x38, 2, 0xBE],
            &[0, 11, 86, 0, 1, 2, 3, 4, 5, 6, 7, 8],
            &[0, 0, 0, 87, 0, 0, 0, 145],
            b"{\"id\":1,\"hello\":{\"version\":2}}\n",
            &[2, 0xA5, 0, 0, 0, 1, 0, 0, 0, 2],
            b"PolyScope 5.11\n",
        ];
        (0..rows).flat_map(|row| heads.iter().map(move |head| [&[row, 0, 1], *head].concat())).collect()
    },
};

fn decoder(data: &[u8]) {
    let mut from = Bytes(data);
    let registry = arms::registry();
    let row = registry.rows()[from.below(registry.rows().len())];
    let Some(wire) = row.wire else { return };
    let connections = (wire.connections)("127.0.0.1");
    let Some((connection, _)) = connections.get(from.below(connections.len())) else { return };
    let place = Place { connection, sent: from.byte() & 1 == 1 };
    let mut rest = from.0;
    let (mut taken, mut named) = (0, 0);
    while !rest.is_empty() {
        let step = match (wire.scan)(place, rest) {
            Scan::More => break,
            // It may skip what has not arrived yet.
            Scan::Skip(n) => n.min(rest.len()),
            Scan::Take(n, message) => {
                taken += 1;
                named += usize::from(!message.name.is_empty());
                let mut bytes = rest.get(..n).expect("it takes what is there").to_vec();
                (wire.mend)(place, &mut bytes);
                assert_eq!(bytes.len(), n, "a mended message has another length");
                n
            }
        };
        assert!(step > 0 && step <= rest.len(), "a step of {step} in {} bytes", rest.len());
        rest = &rest[step..];
    }
    bug(1, row.name == "yourarm" && taken > 1);
    bug(2, row.name == "remote" && named > 1);
    bug(3, row.name == "so101" && taken > 0);
}

/// Arms whose emulators serve one TCP connection.
const TCP: [&str; 2] = ["yourarm", "remote"];

fn row(name: &str) -> AdapterSpec {
    *arms::registry().get(name).expect("a built-in arm")
}

fn config(row: &AdapterSpec, address: String) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address, dof: row.dof.1, options: serde_json::json!({}) }
}

fn emulator(row: &AdapterSpec) -> Box<dyn Emulator> {
    let start = row.emulate.expect("it has an emulator");
    start(&config(row, String::new()), &EmulatorAddress::InProcess).expect("an emulator")
}

/// Bytes to emulators.
pub const CONTROLLER: Target = Target {
    name: "controller",
    about: "an emulated controller answers or refuses, and continues; its arm stays inside its limits",
    run: controller,
    seeds: || {
        vec![vec![0, 0xAA, 0x55, 4, 0, 1, 2, 3, 4, 5, 6], b"\x01{\"hello\":{\"version\":2}}\n{\"read\":{}}\n".to_vec()]
    },
};

/// Arms and their emulators.
type Controllers = Mutex<Vec<(AdapterSpec, Box<dyn Emulator>)>>;

/// Those of this process; each is asked by many inputs.
fn controllers() -> &'static Controllers {
    static ALL: OnceLock<Controllers> = OnceLock::new();
    ALL.get_or_init(|| Mutex::new(TCP.map(row).into_iter().map(|row| (row, emulator(&row))).collect()))
}

fn controller(data: &[u8]) {
    let mut from = Bytes(data);
    let mut all = controllers().lock().unwrap_or_else(|e| e.into_inner());
    let index = from.below(TCP.len());
    let (row, emulator) = &mut all[index];
    let Ok(mut stream) = TcpStream::connect(emulator.address()) else { panic!("{} does not listen", row.name) };
    let _ = stream.set_read_timeout(Some(Duration::from_millis(20)));
    let _ = stream.write_all(from.0);
    let _ = stream.shutdown(Shutdown::Write);
    let mut answer = Vec::new();
    let _ = (&mut stream).take(64 << 10).read_to_end(&mut answer);
    let truth = emulator.truth().positions.expect("it is there");
    let limits = (row.check)(&config(row, String::new())).map(|checked| checked.limits).unwrap_or_default();
    for (q, (lower, upper)) in truth.iter().zip(limits.position_lower.iter().zip(&limits.position_upper)) {
        assert!((lower - 0.05..=upper + 0.05).contains(q), "{q} rad of {lower} to {upper}");
    }
    bug(1, row.name == "remote" && answer.windows(7).any(|word| word == b"\"error\""));
    bug(2, row.name == "remote" && answer.iter().filter(|byte| **byte == b'\n').count() > 2);
    bug(3, row.name == "yourarm" && answer.len() > 8);
}

/// An adapter at its emulator, on a wire that spoils bytes.
pub const FRAMES: Target = Target {
    name: "frames",
    about: "an adapter gets answers or errors, takes no positions that are not finite, and ends",
    run: frames,
    seeds: || vec![vec![0; 64], vec![1; 64], [vec![1], vec![0; 30], vec![2, 9, 1, 40, 3, 2, 1, 1]].concat()],
};

fn frames(data: &[u8]) {
    let mut from = Bytes(data);
    let row = row(TCP[from.below(TCP.len())]);
    let emulator = emulator(&row);
    let Ok(listener) = TcpListener::bind("127.0.0.1:0") else { return };
    let address = listener.local_addr().map(|at| at.to_string()).unwrap_or_default();
    let script = Arc::new(Mutex::new(from.0.to_vec()));
    let (there, left) = (emulator.address(), script.clone());
    std::thread::spawn(move || relay(&listener, &there, &left));
    let mut adapter = (row.create)(&config(&row, address)).expect("an adapter");
    drive(&mut *adapter, &row);
    adapter.disconnect();
    assert!(!adapter.is_connected());
}

/// What a device thread does, whatever comes of it.
fn drive(adapter: &mut dyn ManipulatorAdapter, row: &AdapterSpec) {
    if adapter.connect().is_err() {
        bug(1, true);
        return;
    }
    let mut reading = JointReading::default();
    let enabled = adapter.activate().is_ok();
    for _ in 0..3 {
        match adapter.read_joints(&mut reading) {
            Ok(()) => assert!(reading.position.iter().all(|q| q.is_finite()), "positions that are not finite"),
            Err(_) => bug(2, enabled),
        }
        let position = joints_of(&reading.position[..row.dof.1.min(7)]);
        let mode = adapter.get_control_mode();
        let _ = adapter.write_setpoint(&Setpoint::new(mode, position, MonotonicClock.now()));
        let _ = adapter.read_error();
    }
    let stopped = adapter.write_stop(&StopPoint { position: Some(reading.position) });
    bug(3, stopped.is_err() && enabled);
}

/// Carries one connection; what comes from the controller is spoilt as the script says, byte by byte.
fn relay(listener: &TcpListener, there: &str, script: &Arc<Mutex<Vec<u8>>>) {
    let Ok((near, _)) = listener.accept() else { return };
    let Ok(far) = TcpStream::connect(there) else { return };
    let (Ok(mut out), Ok(mut commands)) = (near.try_clone(), far.try_clone()) else { return };
    let (mut answers, mut back) = (far, near);
    let forward = std::thread::spawn(move || {
        let _ = std::io::copy(&mut out, &mut commands);
        let _ = commands.shutdown(Shutdown::Both);
    });
    let mut buffer = [0; 4096];
    while let Ok(n @ 1..) = answers.read(&mut buffer) {
        let mut bytes = buffer[..n].to_vec();
        {
            let mut script = script.lock().unwrap_or_else(|e| e.into_inner());
            let mut take = || if script.is_empty() { 0 } else { script.remove(0) };
            match take() {
                1 => bytes.truncate(usize::from(take()) % (n + 1)),
                2 => {
                    let at = usize::from(take()) % n;
                    bytes[at] ^= take();
                }
                3 => {
                    let more: Vec<u8> = (0..take() % 16).map(|_| take()).collect();
                    let at = usize::from(take()) % n;
                    bytes.splice(at..at, more);
                }
                4 => bytes.extend_from_within(..),
                5 => break,
                _ => {}
            }
        }
        if back.write_all(&bytes).is_err() {
            break;
        }
    }
    let _ = back.shutdown(Shutdown::Both);
    let _ = answers.shutdown(Shutdown::Both);
    let _ = forward.join();
}
