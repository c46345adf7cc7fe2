//! From the bytes of a setpoint at `dimos proxy xarm` to the coordinator: what the proxy adds to a program of the
//! vendor's SDK. The run is a server of the real socket that notes when each target arrives, and answers it as a tick
//! of 100 Hz does.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dimos::rpc::api::Done;
use dimos::rpc::report::{ArmReport, ArmStateReport, JointReport, StateReport, StatusReport, TaskReport};
use dimos::rpc::run_dir::RunDir;
use dimos::rpc::server::Server;
use dimos::rpc::server::streams::Streams;
use dimos::rpc::{Backend, BoxFuture, Code, Reply, Request, RpcError, Subject};

use super::Effort;
use super::support::measure::{Goal, Measure, print, quantile};

/// Where the proxy listens.
const HOST: &str = "127.0.6.99";
/// Setpoints per second.
const RATE: f64 = 250.0;
/// Period of the tick.
const TICK: Duration = Duration::from_millis(10);
/// Smallest difference of two setpoints [rad]: their number is read from the first joint.
const STEP: f64 = 1e-4;

/// A run with one arm, which notes when targets arrive.
#[derive(Default)]
struct Run {
    streams: Streams,
    arrived: Mutex<Vec<(usize, Instant)>>,
}

fn names() -> Vec<String> {
    (1..=6).map(|i| format!("arm_joint{i}")).collect()
}

impl Backend for Run {
    fn call(&self, request: Request) -> BoxFuture<'_, Result<Reply, RpcError>> {
        let now = Instant::now();
        if let Request::Servo(servo) = &request {
            let number = (servo.positions[0] / STEP).round() as usize;
            self.arrived.lock().unwrap().push((number, now));
        }
        Box::pin(async move {
            Ok(match request {
                Request::Status(_) => Reply::Status(status()),
                Request::State(_) => Reply::State(state()),
                Request::Servo(_) => {
                    tokio::time::sleep(TICK / 2).await;
                    Reply::Servo(Done {})
                }
                _ => return Err(RpcError::new(Code::Unsupported, "not in this measurement")),
            })
        })
    }

    fn arms_of(&self, _: Subject<'_>) -> Vec<String> {
        vec!["arm".into()]
    }

    fn streams(&self) -> &Streams {
        &self.streams
    }
}

fn status() -> StatusReport {
    let arm = ArmReport {
        hardware_id: "arm".into(),
        phase: "ready".into(),
        enabled: true,
        position_limits: vec![[-6.0, 6.0]; 6],
        ..ArmReport::default()
    };
    let takes = vec!["servo".into()];
    let task = TaskReport { name: "servo_arm".into(), takes, joints: names(), ..TaskReport::default() };
    StatusReport { run: "bench".into(), arms: vec![arm], tasks: vec![task], ..StatusReport::default() }
}

fn state() -> StateReport {
    let joint = |name| JointReport { name, position: Some(0.0), velocity: Some(0.0), ..JointReport::default() };
    let joints = names().into_iter().map(joint).collect();
    let arm = ArmStateReport { hardware_id: "arm".into(), joints, ..ArmStateReport::default() };
    StateReport { arms: vec![arm], ..StateReport::default() }
}

/// The proxy's process; killed at the end.
struct Proxy(Child);

impl Drop for Proxy {
    fn drop(&mut self) {
        let _ = (self.0.kill(), self.0.wait());
    }
}

/// Sends a request and waits for its response; returns the state byte.
fn ask(port: &mut TcpStream, register: u8, payload: &[u8]) -> std::io::Result<u8> {
    let length = (payload.len() + 1) as u16;
    let mut frame = vec![0, 1, 0, 2];
    frame.extend(length.to_be_bytes());
    frame.push(register);
    frame.extend(payload);
    port.write_all(&frame)?;
    let mut header = [0; 6];
    port.read_exact(&mut header)?;
    let mut rest = vec![0; usize::from(u16::from_be_bytes([header[4], header[5]]))];
    port.read_exact(&mut rest)?;
    Ok(rest.get(1).copied().unwrap_or_default())
}

/// Measures a stream of setpoints. Port 502 may be closed to this user.
pub fn measure(effort: Effort) -> Result<(), String> {
    let text = |e: std::io::Error| e.to_string();
    let folder = tempfile::tempdir().map_err(text)?;
    let claim = RunDir::closed(folder.path().join("dimos")).claim("bench").map_err(|e| e.to_string())?;
    let run = Arc::new(Run::default());
    let _server = Server::start(claim, run.clone()).map_err(text)?;
    let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
    command.args(["proxy", "xarm", "--listen", HOST]).env("DIMOS_WORLD", folder.path());
    let mut proxy = Proxy(command.stdout(Stdio::piped()).stderr(Stdio::inherit()).spawn().map_err(text)?);
    let mut line = String::new();
    BufReader::new(proxy.0.stdout.take().ok_or("no stdout")?).read_line(&mut line).map_err(text)?;
    if line.is_empty() {
        println!("SKIPPED: the proxy cannot listen at port 502\n");
        return Ok(());
    }
    let mut port = TcpStream::connect((HOST, 502)).map_err(text)?;
    port.set_nodelay(true).map_err(text)?;
    for (register, payload) in [(11, &[8, 1][..]), (19, &[1, 0]), (12, &[0])] {
        ask(&mut port, register, payload).map_err(text)?;
    }
    let count = effort.of(200, 10_000);
    let (mut sent, mut answered) = (Vec::new(), Vec::new());
    let began = Instant::now();
    for i in 0..count {
        let due = began + Duration::from_secs_f64(i as f64 / RATE);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let mut payload = ((i as f64 * STEP) as f32).to_le_bytes().to_vec();
        payload.resize(40, 0);
        let at = Instant::now();
        let state = ask(&mut port, 29, &payload).map_err(text)?;
        if state & 0x58 != 0 {
            return Err(format!("setpoint {i} was refused: state byte {state:#x}"));
        }
        answered.push(at.elapsed().as_secs_f64() * 1e6);
        sent.push(at);
    }
    std::thread::sleep(2 * TICK);
    let arrived = run.arrived.lock().map_err(|e| e.to_string())?.clone();
    let taken = |(number, at): &(usize, Instant)| Some(at.duration_since(*sent.get(*number)?).as_secs_f64() * 1e6);
    let times: Vec<f64> = arrived.iter().filter_map(taken).collect();
    if times.len() != count {
        return Err(format!("{} of {count} setpoints arrived", times.len()));
    }
    let at = |values: &[f64], q| vec![quantile(values, q)];
    print(
        "a setpoint of the vendor's SDK through `dimos proxy xarm`, 250 per second",
        &[
            Measure::new("sent → at the coordinator, p50", "µs", at(&times, 0.5)).goal(Goal::AtMost(1000.0)),
            Measure::new("sent → at the coordinator, p99", "µs", at(&times, 0.99)).goal(Goal::AtMost(1000.0)),
            Measure::new("sent → at the coordinator, highest", "µs", at(&times, 1.0)),
            Measure::new("sent → response of the proxy, p50", "µs", at(&answered, 0.5)),
            Measure::new("sent → response of the proxy, p99", "µs", at(&answered, 0.99)),
        ],
    );
    Ok(())
}
