//! The arms of the tests of the wire: an emulator, the wire in front of it, and a run of this program at the other end.

use std::any::Any;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use dimos::arms::ur::emulator::UrEmulator;
use dimos::clock::Mono;
use dimos::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Truth};
use dimos::hardware::sim::faults::Fault;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};
use serde_json::{Value, json};

use super::can::CanProxy;
use super::judge::Bounds;
use super::stream::Proxy;
use super::watch::Watch;
use super::{Gate, What, WireCommand, decode, lock};

/// Nothing here takes longer.
pub const TIMEOUT: Duration = Duration::from_secs(20);
/// Period of the tick of all these runs [s].
pub const PERIOD: f64 = 0.01;

/// An arm as the tests need it.
#[derive(Clone, Copy)]
pub struct Arm {
    pub name: &'static str,
    /// Its row, unless it is built-in.
    pub row: Option<&'static AdapterSpec>,
    /// Two poses far apart: from one to the other some joint reaches its top speed [rad].
    pub ends: [&'static [f64]; 2],
    /// What a setpoint is rounded to on the wire [rad].
    pub rounding: f64,
    /// Its controller ends a velocity after this time without a setpoint [s]; `None`: no velocity mode.
    pub time_limit: Option<f64>,
    /// Options of its adapter, as JSON.
    pub options: &'static str,
}

/// The template arm over TCP.
pub const YOURARM: Arm = Arm {
    name: "yourarm",
    row: None,
    ends: [&[-2.7, -0.8, 0.2, -2.5, 0.2, -4.4], &[2.7, 0.4, 1.4, 2.5, 1.4, 4.4]],
    rounding: 1e-6,
    time_limit: Some(0.2),
    options: "{}",
};
/// UFACTORY's arm: setpoints without waiting for replies, reports on ports of their own.
pub const XARM: Arm = Arm {
    name: "xarm",
    row: None,
    ends: [&[-3.6, -0.6, -1.2, -3.6, 0.6, -3.6], &[3.6, 0.6, -0.4, 3.6, 1.6, 3.6]],
    rounding: 1e-6,
    time_limit: Some(0.2),
    options: "{}",
};
/// AgileX's arm on CAN.
pub const PIPER: Arm = Arm {
    name: "piper",
    row: None,
    ends: [&[-2.5, 0.6, -1.6, -1.2, -0.8, -1.7], &[2.5, 1.6, -0.6, 1.2, 0.8, 1.7]],
    rounding: 2e-5,
    time_limit: None,
    options: "{}",
};
/// An arm behind another process; a simple one.
pub const REMOTE: Arm = Arm {
    name: "remote",
    row: None,
    ends: [&[-2.7, -0.8, 0.2, -2.5, 0.2, -2.7], &[2.7, 0.4, 1.4, 2.5, 1.4, 2.7]],
    rounding: 1e-9,
    time_limit: Some(0.5),
    options: "{}",
};

/// Universal Robots' arm: a program on its controller follows registers.
pub const UR: Arm = Arm {
    name: "ur",
    row: None,
    ends: [&[-2.7, -1.4, 1.5, -2.5, -1.5, -2.7], &[2.7, -1.0, 1.9, 2.5, -1.1, 2.7]],
    rounding: 1e-9,
    time_limit: Some(0.2),
    options: "{}",
};

/// Franka Robotics' arm, by UDP datagrams: there is no gate in its wire, and its controller refuses what is too fast.
pub const FRANKA: Arm = Arm {
    name: "franka",
    row: None,
    ends: [&[-2.0, -1.0, -2.0, -2.6, -2.0, 1.0, -2.0], &[2.0, 1.0, 2.0, -0.6, 2.0, 3.6, 2.0]],
    rounding: 1e-6,
    time_limit: None,
    options: r#"{"model": "fr3"}"#,
};
/// Bus servos on a serial line: a goal per servo, one turn each.
pub const SO101: Arm = Arm {
    name: "so101",
    row: None,
    ends: [&[-1.5, -1.3, -1.3, -1.2, -2.2], &[1.5, 1.3, 1.3, 1.2, 2.2]],
    rounding: 2e-3,
    time_limit: None,
    options: "{}",
};

/// An arm on a serial line (`tests/support/serial_line`).
pub fn serial(row: &'static AdapterSpec) -> Arm {
    Arm {
        name: "acme",
        row: Some(row),
        ends: [&[-2.7, -0.8, 0.2, -2.5, 0.2, -2.7], &[2.7, 0.4, 1.4, 2.5, 1.4, 2.7]],
        rounding: 1e-6,
        time_limit: Some(0.2),
        options: "{}",
    }
}

impl Arm {
    /// Age limit of a state [s].
    pub fn stale_after(&self) -> f64 {
        self.spec().stale_after.as_secs_f64()
    }

    /// How far a joint may rest from its setpoint [rad].
    pub fn accuracy(&self) -> f64 {
        self.spec().accuracy
    }

    pub fn dof(&self) -> usize {
        self.ends[0].len()
    }

    /// Options of its adapter and of its emulator.
    fn options(&self, setup: &Setup) -> Value {
        let mut options: Value = serde_json::from_str(self.options).unwrap();
        let start = if setup.start.is_empty() { self.ends[0].to_vec() } else { setup.start.clone() };
        if options["sim"].is_null() {
            options["sim"] = json!({});
        }
        (options["sim"]["initial_positions"], options["sim"]["faults"]) =
            (json!(self.initial(start)), json!(setup.faults));
        options
    }

    /// Servos of a gripper have a position, too.
    fn initial(&self, mut start: Vec<f64>) -> Vec<f64> {
        start.extend((self.name == "so101").then_some(0.5));
        start
    }

    /// The end that is nearer to a pose, and the other.
    pub fn near_and_far(&self, pose: &[f64]) -> [&'static [f64]; 2] {
        let [a, b] = self.ends;
        if furthest(a, pose) < furthest(b, pose) { [a, b] } else { [b, a] }
    }

    fn spec(&self) -> AdapterSpec {
        self.row.copied().unwrap_or_else(|| *dimos::arms::registry().get(self.name).unwrap())
    }
}

/// How an arm of a test differs from one that is well.
#[derive(Debug, Clone, Default)]
pub struct Setup {
    /// Initial positions [rad]; empty: one end of its range.
    pub start: Vec<f64>,
    pub faults: Vec<Fault>,
}

/// An arm and its wire.
pub struct World {
    pub arm: Arm,
    pub gate: Gate,
    /// Where a run finds the arm.
    pub address: String,
    _proxy: Box<dyn Any>,
    emulator: Arc<Mutex<Box<dyn Emulator>>>,
    /// Its program interpolates between the setpoints: what that commands is what moves the arm.
    program: Option<Arc<UrEmulator>>,
}

/// An emulator of which a test also asks what its program does.
struct Shared(Arc<UrEmulator>);

impl Emulator for Shared {
    fn address(&self) -> String {
        self.0.address()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.0.inject(fault)
    }

    fn truth(&self) -> Truth {
        self.0.truth()
    }
}

/// An arm, its wire, and a run that is up. Ends in this order.
pub struct Bed {
    pub run: Run,
    pub gate: Gate,
    pub arm: Arm,
    pub bounds: Bounds,
    world: World,
    _folder: tempfile::TempDir,
}

impl World {
    pub fn new(arm: Arm, setup: &Setup) -> Self {
        let (dof, options) = (arm.dof(), arm.options(setup));
        let config = AdapterConfig { hardware_id: "arm".into(), address: "sim".into(), dof, options };
        let place = EmulatorAddress::InProcess;
        let program = (arm.name == "ur").then(|| Arc::new(UrEmulator::start(&config, &place).unwrap()));
        let emulator = match &program {
            Some(program) => Box::new(Shared(program.clone())),
            None => arm.spec().emulate.unwrap()(&config, &place).unwrap(),
        };
        let address = emulator.address();
        let emulator = Arc::new(Mutex::new(emulator));
        let watched = emulator.clone();
        let gate = Gate::new(Arc::new(move || {
            lock(&watched).true_positions().map(|all| all[..dof].to_vec()).unwrap_or_default()
        }));
        let (proxy, address): (Box<dyn Any>, String) = match arm.name {
            "yourarm" => boxed(Proxy::tcp(&address, &gate, decode::yourarm())),
            "xarm" => boxed(Proxy::xarm(&address, &gate, decode::xarm(6))),
            "ur" => boxed(Proxy::ur(&address, &gate, decode::ur())),
            "remote" => {
                let proxy = Proxy::tcp(address.trim_start_matches("tcp:"), &gate, decode::remote());
                let address = format!("tcp:{}", proxy.address);
                (Box::new(proxy), address)
            }
            "franka" => (Box::new(()), address),
            "so101" => boxed(Proxy::serial(&address, &gate, decode::so101())),
            "piper" => {
                let proxy = CanProxy::start(&address, &gate);
                let address = proxy.address.clone();
                (Box::new(proxy), address)
            }
            _ => boxed(Proxy::serial(&address, &gate, decode::template())),
        };
        Self { arm, gate, address, _proxy: proxy, emulator, program }
    }

    pub fn inject(&self, fault: Fault) {
        lock(&self.emulator).inject(fault).unwrap();
    }

    /// Starts a run; or hands the world back, and why the run did not start.
    #[allow(clippy::result_large_err, reason = "a test's own")]
    pub fn run(self) -> Result<Bed, (String, Self)> {
        let folder = tempfile::tempdir().unwrap();
        let arm = self.arm;
        let builder = Run::from_yaml("wire", &blueprint(&arm, &self.address))
            .record(Record::Off)
            .folder(RunDir::closed(folder.path()))
            .adapters(arm.row.map(std::slice::from_ref).unwrap_or_default());
        let run = match builder.start() {
            Ok(run) => run,
            Err(error) => return Err((format!("{error}\n{}", error.hint()), self)),
        };
        let limits = &run.config().arms[0].limits;
        let bounds = Bounds {
            velocity: limits.velocity_max.clone(),
            acceleration: limits.acceleration_max.clone(),
            period: PERIOD,
            rounding: arm.rounding,
            stale_after: arm.stale_after(),
            // Its stop is a target: what was written last, within 0.02 rad of what is measured, which is a little old.
            stopped_within: match arm.name {
                "piper" => Some(0.025),
                // Its program decelerates on its own after 20 ms without a setpoint, and begins where it rests.
                "ur" => Some(0.01),
                _ => None,
            },
            time_limit: arm.time_limit,
        };
        Ok(Bed { run, gate: self.gate.clone(), arm, bounds, world: self, _folder: folder })
    }

    /// Where the joints truly are [rad]; nothing where the emulator does not tell.
    pub fn truth(&self) -> Vec<f64> {
        lock(&self.emulator).true_positions().map(|all| all[..self.arm.dof()].to_vec()).unwrap_or_default()
    }
}

impl Bed {
    #[track_caller]
    pub fn new(arm: Arm, setup: &Setup) -> Self {
        World::new(arm, setup).run().unwrap_or_else(|(why, _)| panic!("{}: {why}", arm.name))
    }

    /// Where the joints truly are [rad]; nothing where the emulator does not tell.
    pub fn truth(&self) -> Vec<f64> {
        self.world.truth()
    }

    /// What reached the arm; where its program interpolates, what that commanded from a little before `began`.
    pub fn delivered(&self, began: Mono) -> Vec<WireCommand> {
        let Some(program) = &self.world.program else { return self.gate.delivered() };
        let recent = program.servoj().into_iter().filter(|(at, _)| at.seconds_since(began) > -0.2);
        let command = |(at, goal): (Mono, [f64; 6])| WireCommand {
            at,
            connection: 0,
            what: What::Position(goal.to_vec()),
            truth: None,
        };
        recent.map(command).collect()
    }

    /// Reports where the joints truly are [rad], and whether all motors are on, from another thread.
    pub fn eyes(&self) -> impl Fn() -> (Vec<f64>, bool) + Send + use<> {
        let (emulator, dof) = (self.world.emulator.clone(), self.arm.dof());
        move || {
            let truth = lock(&emulator).truth();
            (truth.positions.unwrap_or_default()[..dof].to_vec(), truth.motors_on.unwrap_or(true))
        }
    }

    /// Whether all motors are on.
    pub fn motors_on(&self) -> bool {
        self.eyes()().1
    }

    pub fn inject(&self, fault: Fault) {
        self.world.inject(fault);
    }

    /// The phase of the arm, and why it is held.
    pub fn phase(&self) -> (String, String) {
        let arm = &self.run.status().arms[0];
        (arm.phase.clone(), arm.cause.as_ref().map(|c| c.name.clone()).unwrap_or_default())
    }

    /// Measured positions as the run has them [rad].
    pub fn measured(&self) -> Vec<f64> {
        self.run.state().arms[0].joints.iter().filter_map(|j| j.position).collect()
    }

    /// Waits until `holds`.
    #[track_caller]
    pub fn until(&self, what: &str, mut holds: impl FnMut(&Self) -> bool) {
        let began = Instant::now();
        while !holds(self) {
            assert!(
                began.elapsed() < TIMEOUT,
                "{}: not within {TIMEOUT:?}: {what}: {:?}, {:?}",
                self.arm.name,
                self.phase(),
                self.run.status().tasks
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// Waits until the arm has stood for 0.1 s and the run hears of it.
    #[track_caller]
    pub fn rest(&self) {
        let (mut last, mut since) = (self.place(), Instant::now());
        self.until("it is at rest", |bed| {
            let here = bed.place();
            if here.iter().zip(&last).any(|(a, b)| (a - b).abs() > 1e-4) {
                (last, since) = (here, Instant::now());
            }
            let report = &bed.run.status().arms[0];
            // A link over which a write failed is faulted until the arm is reset, though states come again.
            let heard = report.state_age_ms.is_some_and(|age| age < 100.0);
            heard && since.elapsed() > Duration::from_millis(100)
        });
    }

    fn place(&self) -> Vec<f64> {
        let truth = self.truth();
        if truth.is_empty() { self.measured() } else { truth }
    }

    /// Makes the arm ready again, whatever held it.
    #[track_caller]
    pub fn ready(&self) {
        self.until("it is ready", |bed| match bed.phase().0.as_str() {
            "ready" => true,
            "activating" => false,
            _ => {
                let _ = bed.run.reset("arm");
                let _ = bed.run.enable("arm");
                false
            }
        });
    }

    /// Goes from one end to the other as fast as the arm can, and returns in the middle of the way.
    #[track_caller]
    pub fn at_full_speed(&self) {
        Watch::shared().unless_stalled(|| {
            self.ready();
            let fast = self.try_full_speed();
            fast.map_err(|why| format!("{}: it does not reach its full speed: {why}", self.arm.name))
        });
    }

    fn try_full_speed(&self) -> Result<(), String> {
        let [near, far] = self.arm.near_and_far(&self.measured());
        let go = |to: &[f64]| self.run.move_arm("arm", to, 1.0).map(|m| m.motion).map_err(|e| e.to_string());
        if furthest(near, &self.measured()) > 0.2 {
            let motion = go(near)?;
            let began = Instant::now();
            let there = loop {
                let report = self.run.motion(motion).map_err(|e| e.to_string())?;
                if report.done {
                    break report;
                }
                if began.elapsed() > TIMEOUT {
                    let last = self.gate.sent().last().map(|t| (super::now().since(t.at), t.what.clone()));
                    panic!(
                        "{}: it does not arrive: {report:?}, {last:?}, {:?}",
                        self.arm.name,
                        self.run.status().arms[0]
                    );
                }
                std::thread::sleep(Duration::from_millis(5));
            };
            if there.state != "COMPLETED" {
                return Err(format!("{:?}", there.error));
            }
        }
        self.gate.forget();
        go(far)?;
        self.until("it moves at full speed, or is held", |bed| bed.is_fast() || bed.phase().0 != "ready");
        if self.is_fast() { Ok(()) } else { Err(format!("{:?}", self.phase())) }
    }

    pub fn is_fast(&self) -> bool {
        let speed = self.gate.speed(PERIOD);
        speed.iter().zip(&self.bounds.velocity).any(|(v, most)| v.abs() > 0.9 * most)
    }
}

/// How far the joint that is furthest from another pose is from it [rad].
pub fn furthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

fn boxed(proxy: Proxy) -> (Box<dyn Any>, String) {
    let address = proxy.address.clone();
    (Box::new(proxy), address)
}

fn blueprint(arm: &Arm, address: &str) -> String {
    let row = arm.spec();
    let options: Value = serde_json::from_str(arm.options).unwrap();
    let velocity = row.modes.contains(&dimos::joint::ControlMode::Velocity);
    let mut tasks = vec![
        json!({ "name": "traj_arm", "type": "trajectory", "joint_names": { "hardware": "arm" } }),
        json!({ "name": "servo_arm", "type": "servo", "joint_names": { "hardware": "arm" }, "priority": 15 }),
    ];
    tasks.extend(velocity.then(
        || json!({ "name": "velocity_arm", "type": "velocity", "joint_names": { "hardware": "arm" }, "priority": 15 }),
    ));
    let hardware: Value = json!([{
        "hardware_id": "arm", "joints": { "prefix": "arm", "count": arm.dof() }, "adapter_type": arm.name,
        "address": address, "options": options,
    }]);
    // JSON is YAML.
    json!({ "name": "wire", "hardware": hardware, "tasks": tasks }).to_string()
}
