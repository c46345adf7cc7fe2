//! The controller's rules, in virtual time.

use super::control::{Control, DOF, IDLE, MOVE, REFLEX};
use super::{SimOptions, judge};
use crate::franka::model::Model;
use dimos_core::clock::Mono;
use dimos_hardware::sim::stream::Controller;

const WHO: (usize, u64) = (0, 1);

/// A controller, its time, and a client that has connected.
struct Bench {
    control: Control,
    now: Mono,
    answers: Vec<u8>,
}

impl Bench {
    fn new(model: Model) -> Self {
        let now = Mono(1_000_000_000);
        let control = Control::new(model, &SimOptions::default(), now).unwrap();
        let mut bench = Self { control, now, answers: Vec::new() };
        let version: u16 = if model == Model::Fer { 5 } else { 10 };
        bench.ask(0, &[version.to_le_bytes(), 9999_u16.to_le_bytes()].concat());
        assert_eq!(bench.status(), Some(0));
        bench
    }

    fn five(&self) -> bool {
        self.control.wide()
    }

    fn ask(&mut self, code: u32, values: &[u8]) {
        let length = 12 + values.len() as u32;
        let request = [&[code, 7, length].map(u32::to_le_bytes).concat()[..], values].concat();
        self.control.serve_client(0, 1, &request, self.now, &mut self.answers);
        self.collect();
    }

    fn collect(&mut self) {
        let mut packet = Vec::new();
        self.control.session_report(WHO.0, WHO.1, self.now, &mut packet);
        self.answers.extend(packet);
    }

    /// The status of the next answer.
    fn status(&mut self) -> Option<u8> {
        let length = u32::from_le_bytes(self.answers.get(8..12)?.try_into().unwrap()) as usize;
        let answer: Vec<u8> = self.answers.drain(..length).collect();
        Some(answer[12])
    }

    fn start(&mut self, generator: u32) {
        let mut values = [0_u32, generator].map(u32::to_le_bytes).concat();
        values.resize(if self.five() { 56 } else { 113 }, 0);
        self.ask(1, &values);
        assert_eq!(self.status(), Some(1), "started");
        assert_eq!((self.control.mode, self.control.generator), (MOVE, generator as u8 + 1));
    }

    fn cycle(&mut self) {
        assert!(self.control.cycle().is_some());
        self.collect();
    }

    /// Answers the newest state.
    fn send(&mut self, values: &[f64; DOF], velocity: bool, finished: bool) {
        self.send_as(self.control.id, values, velocity, finished);
    }

    fn send_as(&mut self, id: u64, values: &[f64; DOF], velocity: bool, finished: bool) {
        let mut bytes = vec![0; if self.five() { 370 } else { 371 }];
        bytes[..8].copy_from_slice(&id.to_le_bytes());
        let at = if velocity { 64 } else { 8 };
        for (i, value) in values.iter().enumerate() {
            bytes[at + 8 * i..at + 8 * i + 8].copy_from_slice(&value.to_le_bytes());
        }
        bytes[313] = u8::from(finished);
        let _ = self.control.take_command(&bytes);
    }

    fn hold(&mut self, cycles: usize) {
        for _ in 0..cycles {
            let q = self.control.q_d;
            self.send(&q, false, false);
            self.cycle();
        }
    }

    fn failed(&mut self, bit: u32) {
        assert_eq!((self.control.mode, self.control.errors), (REFLEX, 1 << bit), "error {bit}");
        let expected = if self.five() { 6 } else { 8 };
        assert_eq!(self.status(), Some(expected));
    }
}

#[test]
fn nineteen_lost_commands_go_on_and_twenty_end_the_motion() {
    for model in [Model::Fer, Model::Fr3] {
        let mut bench = Bench::new(model);
        bench.start(0);
        bench.hold(200);
        assert_eq!(bench.control.success_rate(), 1.0);
        (0..19).for_each(|_| bench.cycle());
        assert_eq!((bench.control.mode, bench.control.lost_in_row), (MOVE, 19));
        assert!((bench.control.success_rate() - 0.81).abs() < 1e-9);
        bench.hold(1);
        (0..19).for_each(|_| bench.cycle());
        assert_eq!(bench.control.mode, MOVE);
        bench.cycle();
        bench.failed(judge::COMMUNICATION);
        assert_eq!(bench.control.figures.lost, 39);
    }
}

#[test]
fn only_the_answer_to_the_last_state_counts() {
    let mut bench = Bench::new(Model::Fr3);
    bench.start(0);
    bench.hold(1);
    let (q, id) = (bench.control.q_d, bench.control.id);
    for wrong in [id - 1, id + 1, 0, u64::MAX] {
        bench.send_as(wrong, &q, false, false);
    }
    assert!(!bench.control.take_command(&[0; 370]));
    bench.cycle();
    assert_eq!((bench.control.lost_in_row, bench.control.figures.unused), (1, 5));
    bench.send(&q, false, false);
    bench.send(&[0.0; DOF], false, false);
    bench.cycle();
    assert_eq!((bench.control.lost_in_row, bench.control.figures.unused), (0, 6), "the first one counts");
}

#[test]
fn a_lost_command_is_one_of_constant_acceleration() {
    let mut bench = Bench::new(Model::Fer);
    bench.start(1);
    for i in 0..10 {
        bench.send(&[0.001 * f64::from(i * i) * 0.1; DOF], true, false);
        bench.cycle();
    }
    let (v, a, q) = (bench.control.dq_d[0], bench.control.ddq_d[0], bench.control.q_d[0]);
    assert!(a > 0.0);
    bench.cycle();
    assert!((bench.control.dq_d[0] - (v + a * 0.001)).abs() < 1e-12);
    assert!((bench.control.q_d[0] - (q + (v + a * 0.001) * 0.001)).abs() < 1e-12);
}

#[test]
fn what_breaks_a_limit_ends_the_motion() {
    // Starts elsewhere.
    let mut bench = Bench::new(Model::Fr3);
    bench.start(0);
    let mut q = bench.control.q_d;
    q[3] += 0.002;
    bench.send(&q, false, false);
    bench.cycle();
    bench.failed(judge::START_POSE);
    // A jump of the velocity, and one of the acceleration.
    for (step, error) in [(0.02, judge::ACCELERATION), (0.0075, judge::JERK)] {
        let mut bench = Bench::new(Model::Fr3);
        bench.start(1);
        bench.send(&[0.0; DOF], true, false);
        bench.cycle();
        bench.send(&[step; DOF], true, false);
        bench.cycle();
        bench.failed(error);
    }
    // Too fast for its place, and beyond the range: an FER has no slower places.
    for (model, error) in [(Model::Fr3, judge::VELOCITY), (Model::Fer, judge::POSITION)] {
        let mut bench = Bench::new(model);
        bench.start(1);
        let (mut v, mut a) = (0.0, 0.0_f64);
        for _ in 0..4000 {
            a = if v < 0.9 { (a + 0.004).min(5.0) } else { 0.0 };
            v += a * 0.001;
            bench.send(&[0.0, v, 0.0, 0.0, 0.0, 0.0, 0.0], true, false);
            bench.cycle();
            if bench.control.mode != MOVE {
                break;
            }
        }
        bench.failed(error);
        assert!(bench.control.q_d[1] > 1.4);
    }
}

#[test]
fn a_motion_is_finished_at_rest_only() {
    let mut bench = Bench::new(Model::Fr3);
    bench.start(0);
    bench.hold(5);
    let q = bench.control.q_d;
    bench.send(&q, false, true);
    bench.cycle();
    assert_eq!((bench.control.mode, bench.control.generator, bench.status()), (IDLE, 0, Some(0)));
    bench.start(1);
    for i in 0..40 {
        bench.send(&[0.002 * f64::from(i.min(30)); DOF], true, i == 39);
        bench.cycle();
    }
    bench.failed(judge::ACCELERATION);
}

#[test]
fn a_stop_brakes_and_is_answered_at_rest() {
    let mut bench = Bench::new(Model::Fr3);
    bench.start(1);
    for i in 0..100 {
        bench.send(&[0.003 * f64::from(i); DOF], true, false);
        bench.cycle();
    }
    bench.ask(2, &[]);
    assert_eq!(bench.status(), Some(2), "the motion is preempted");
    assert_eq!(bench.status(), None);
    let mut cycles = 0;
    while bench.control.mode == MOVE {
        bench.cycle();
        cycles += 1;
    }
    // 0.297 rad/s at 10 rad/s².
    assert!((29..=32).contains(&cycles), "{cycles}");
    assert_eq!((bench.status(), bench.control.dq_d), (Some(0), [0.0; DOF]));
}

#[test]
fn a_push_is_a_reflex_until_it_is_recovered() {
    let mut bench = Bench::new(Model::Fer);
    bench.start(0);
    bench.hold(5);
    bench.control.external[2] = 19.0;
    bench.hold(1);
    bench.failed(6);
    // No motion starts now.
    let mut values = vec![0; 56];
    values[4] = 1;
    bench.ask(1, &values);
    assert_eq!(bench.status(), Some(3));
    bench.control.external[2] = 0.0;
    bench.ask(12, &[]);
    assert_eq!(bench.status(), None, "it takes some time");
    (0..40).for_each(|_| bench.cycle());
    assert_eq!((bench.status(), bench.control.mode, bench.control.errors), (Some(0), IDLE, 0));
    assert_eq!(bench.control.reason, 1 << 6, "what it was is kept");
    bench.start(0);
    bench.hold(5);
}

#[test]
fn nothing_is_set_while_a_motion_runs() {
    let mut bench = Bench::new(Model::Fr3);
    let stiffness = [100.0_f64; DOF].map(f64::to_le_bytes).concat();
    bench.start(0);
    bench.hold(1);
    bench.ask(4, &stiffness);
    assert_eq!(bench.status(), Some(1));
    let q = bench.control.q_d;
    bench.send(&q, false, true);
    bench.cycle();
    bench.status();
    bench.ask(4, &stiffness);
    assert_eq!((bench.status(), bench.control.impedance), (Some(0), [100.0; DOF]));
    bench.ask(4, &[20000.0_f64; DOF].map(f64::to_le_bytes).concat());
    assert_eq!(bench.status(), Some(2), "too stiff");
}

#[test]
fn joints_follow_and_rest() {
    let mut bench = Bench::new(Model::Fr3);
    bench.start(1);
    for i in 0..400 {
        let v = 0.3 * (0.5 - 0.5 * (f64::from(i) * std::f64::consts::TAU / 400.0).cos());
        bench.send(&[v; DOF], true, i == 399);
        bench.cycle();
    }
    assert_eq!(bench.control.mode, IDLE);
    (0..100).for_each(|_| bench.cycle());
    let (q, dq) = bench.control.arm.joints();
    assert!(bench.control.q_d.iter().zip(&q).all(|(a, b)| (a - b).abs() < 1e-4), "{:?} {q:?}", bench.control.q_d);
    assert!((q[0] - 0.26).abs() < 1e-3 && dq[..DOF] == [0.0; DOF], "{q:?}");
}

/// A client need not be at 127.0.0.1: its states go where it connects from. A compiled model is refused at once, and
/// the connection remains.
#[test]
fn states_go_to_where_the_client_connects_from_and_a_compiled_model_is_refused() {
    use std::io::{Read, Write};
    use std::net::{Ipv4Addr, SocketAddrV4, TcpStream, UdpSocket};
    use std::time::Duration;

    use rustix::net::{AddressFamily, SocketType, bind, connect, socket};

    use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};

    let options = serde_json::json!({"model": "fer"});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 7, options };
    let emulator = super::FrankaEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    let server: SocketAddrV4 = emulator.address().parse().unwrap();
    let here = Ipv4Addr::new(127, 48, 24, 7);
    let states = UdpSocket::bind((here, 0)).unwrap();
    states.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
    let client = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
    bind(&client, &SocketAddrV4::new(here, 0)).unwrap();
    connect(&client, &server).unwrap();
    let mut client = TcpStream::from(client);
    client.set_read_timeout(Some(Duration::from_secs(3))).unwrap();
    let mut ask = |code: u32, values: &[u8], more: usize| {
        let head = [code, 1, 12 + values.len() as u32].map(u32::to_le_bytes).concat();
        client.write_all(&[&head[..], values].concat()).unwrap();
        let mut answer = vec![0; 13 + more];
        client.read_exact(&mut answer).unwrap();
        answer[12]
    };
    let port = states.local_addr().unwrap().port();
    assert_eq!(ask(0, &[5_u16.to_le_bytes(), port.to_le_bytes()].concat(), 2), 0);
    assert_eq!(states.recv(&mut [0; 4096]).unwrap(), 2373, "a state");
    assert_eq!(ask(13, &[0, 0], 0), 1, "it has no program of the vendor's");
    assert_eq!(ask(2, &[], 0), 0, "the connection remains");
}
