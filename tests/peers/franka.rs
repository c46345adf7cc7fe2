//! The vendor's clients of Franka arms, which others wrote: they command the emulated arm, and their commands are those
//! that the adapter sends for the same setpoints.

use std::net::IpAddr;
use std::path::Path;
use std::process::{Command, Stdio};

use dimos::arms::franka::emulator::{Datagram, Figures, FrankaEmulator};
use dimos::arms::franka::model::Model;
use dimos::arms::franka::protocol::command::{Target, encode, sent};
use dimos::arms::franka::protocol::state::{State, generator};
use dimos::arms::franka::shaping::Shaping;
use dimos::hardware::registry::{AdapterConfig, EmulatorAddress};

use crate::support::python::python_with;

/// Runs `tests/python/franka_client.py` on an emulator at this loopback address. Returns what was sent both ways;
/// `None` where the client is not installed.
fn client(model: &str, address: &str, package: &str) -> Option<(Vec<Datagram>, Figures)> {
    run("franka_client.py", model, model, address, package)
}

/// Runs a script with `what` and this loopback address of an emulator.
fn run(script: &str, what: &str, model: &str, address: &str, package: &str) -> Option<(Vec<Datagram>, Figures)> {
    let python = python_with(&[package])?;
    // Python is no real-time client: the controller waits for its commands.
    let options = serde_json::json!({"model": model, "sim": {"command_wait": 0.1}});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 7, options };
    let place: IpAddr = address.parse().unwrap();
    let emulator = FrankaEmulator::start(&config, &EmulatorAddress::Bind(place)).unwrap();
    emulator.record();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python").join(script);
    let mut command = Command::new(python);
    command.arg(script).args([what, address]).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::null());
    let output = command.output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && out.ends_with("all is as it says\n"), "{out}\n{err}\n{:?}", emulator.figures());
    Some((emulator.traffic(), emulator.figures()))
}

/// What a client commanded in answer to a state.
struct Answer {
    state: State,
    bytes: Vec<u8>,
}

/// Pairs the commands of each motion with the states that they answer.
fn motions(traffic: &[Datagram], model: Model, of: u8) -> Vec<Vec<Answer>> {
    let mut states = std::collections::HashMap::new();
    let (mut found, mut last): (Vec<Vec<Answer>>, u64) = (Vec::new(), 0);
    for datagram in traffic {
        match datagram {
            Datagram::State(bytes) => {
                let state = State::decode(model.interface(), bytes).unwrap();
                states.insert(state.id, state);
            }
            Datagram::Command(bytes) => {
                let id = u64::from_le_bytes(bytes[..8].try_into().unwrap());
                let state = states[&id];
                if state.generator == of {
                    // The script rests between its motions.
                    if id > last + 100 {
                        found.push(Vec::new());
                    }
                    last = id;
                    found.last_mut().unwrap().push(Answer { state, bytes: bytes.clone() });
                }
            }
        }
    }
    found
}

/// Seven numbers of a command.
fn seven(bytes: &[u8], from: usize) -> [f64; 7] {
    std::array::from_fn(|i| f64::from_le_bytes(bytes[from + 8 * i..from + 8 * i + 8].try_into().unwrap()))
}

#[test]
fn pylibfranka_moves_the_emulated_fr3_and_its_commands_are_the_adapters() {
    let Some((traffic, figures)) = client("fr3", "127.48.23.5", "pylibfranka") else { return };
    println!("{figures:?}");
    // It sends what it is given, without filter and limits: every byte is known.
    let none = Shaping::new(1000.0, None);
    for (kind, from) in [(generator::JOINT_POSITION, 8), (generator::JOINT_VELOCITY, 64)] {
        let answers: Vec<Answer> = motions(&traffic, Model::Fr3, kind).into_iter().flatten().collect();
        assert!(answers.len() > 500, "{}", answers.len());
        for Answer { state, bytes } in answers {
            let values = seven(&bytes, from);
            let target = if from == 8 { Target::Positions(values) } else { Target::Velocities(values) };
            let ours = encode(state.id, &none.shape(&target, &state, false, None), bytes[313] != 0);
            assert_eq!(sent(Model::Fr3.interface(), &ours), bytes, "{state:?}");
        }
    }
}

/// Within the limits its commands are the adapter's. Where they bind, the adapter stays 3 % inside.
#[test]
fn libfranka_moves_the_emulated_fer_and_shapes_its_commands_as_the_adapter() {
    let Some((traffic, figures)) = client("fer", "127.48.23.6", "panda_py") else { return };
    println!("{figures:?}");
    let shaping = Shaping::new(100.0, Some(Model::Fer.ranges()));
    let ease = |t: f64| t * t * t * (10.0 - 15.0 * t + 6.0 * t * t);
    let slope = |t: f64| 30.0 * t * t * (1.0 - t) * (1.0 - t);
    let signs = [1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0];
    let eased = |first: &State, t: f64| {
        Target::Positions(std::array::from_fn(|j| first.q_d[j] + 0.15 * signs[j] * ease(t.min(1.0))))
    };
    let speeds = |_: &State, t: f64| {
        let speed = if t >= 1.0 { 0.0 } else { -0.15 * slope(t) };
        Target::Velocities(signs.map(|sign| sign * speed))
    };
    type Setpoints<'a> = &'a dyn Fn(&State, f64) -> Target;
    let positions = motions(&traffic, Model::Fer, generator::JOINT_POSITION);
    let velocities = motions(&traffic, Model::Fer, generator::JOINT_VELOCITY);
    let judged: [(&[Answer], usize, Setpoints); 2] = [(&positions[0], 8, &eased), (&velocities[0], 64, &speeds)];
    for (answers, from, setpoints) in judged {
        let (first, mut shaped) = (&answers[0].state, 0);
        for (i, Answer { state, bytes }) in answers.iter().enumerate() {
            let t = (state.id - first.id) as f64 * 1e-3;
            // The last command is sent until the motion has ended.
            if bytes[313] != 0 {
                break;
            }
            let ours = encode(state.id, &shaping.shape(&setpoints(first, t), state, i == 0, None), false);
            let (a, b) = (seven(&ours, from), seven(bytes, from));
            let apart = a.iter().zip(&b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(apart < 1e-9, "{t} s: {apart}\n{a:?}\n{b:?}\n{state:?}");
            // All else is the same to the bit.
            assert!((0..370).all(|i| (from..from + 56).contains(&i) || ours[i] == bytes[i]));
            shaped += usize::from(state.dq_d != [0.0; 7]);
        }
        assert!(shaped > 300, "{shaped}");
    }
}

/// States go to wherever a client connects from; the names and masses of the description are those that it looks for.
#[test]
fn the_vendors_clients_load_the_model_and_franky_moves_the_arm() {
    for (package, model, address) in [("pylibfranka", "fr3", "127.48.23.7"), ("franky", "fr3", "127.48.23.8")] {
        run("franka_model.py", package, model, address, package);
    }
}

#[test]
fn a_client_that_asks_for_a_compiled_model_is_refused_at_once() {
    run("franka_model.py", "panda_py", "fer", "127.48.23.9", "panda_py");
}
