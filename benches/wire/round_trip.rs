//! Round trip of `adapter_type: remote`: a command to the server, and the state measured after it.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dimos::arm::StopPoint;
use dimos::hardware::adapter::{AdapterResult, JointReading};
use dimos::joint::ControlMode;
use dimos::rt::host;
use dimos::rt::wake::Wake;

use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print, quantile};

/// Joints of the arm behind the server.
const DOF: usize = 6;
/// Timeout of all waits.
const TIMEOUT: Duration = Duration::from_secs(5);

/// An adapter without work, in the form of the guide's skeleton: only the round trip remains.
const IDLE_ARM: &str = "\
class IdleArm:
    def __init__(self, address, dof=6): self.q, self.on, self.mode = [0.0] * dof, False, None
    def connect(self): return True
    def disconnect(self): pass
    def is_connected(self): return True
    def get_dof(self): return len(self.q)
    def get_info(self):
        from types import SimpleNamespace as info
        return info(vendor='none', model='idle', dof=len(self.q), firmware_version=None, serial_number=None)
    def get_limits(self):
        from types import SimpleNamespace as limits
        n = len(self.q)
        return limits(position_lower=[-3.0] * n, position_upper=[3.0] * n, velocity_max=[3.0] * n)
    def set_control_mode(self, mode): self.mode = mode; return True
    def get_control_mode(self): return self.mode
    def read_joint_positions(self): return self.q
    def read_joint_velocities(self): return [0.0] * len(self.q)
    def read_joint_efforts(self): return [0.0] * len(self.q)
    def read_state(self): return {'state': 0, 'mode': 0}
    def read_error(self): return 0, ''
    def read_enabled(self): return self.on
    def write_joint_positions(self, positions, velocity=1.0): self.q = list(positions); return True
    def write_stop(self): return True
    def write_enable(self, enable): self.on = enable; return True
    def write_clear_errors(self): return True
";

/// Measures both servers.
pub fn measure(effort: Effort) -> Result<(), String> {
    let text = |e: dimos::hardware::adapter::AdapterError| e.to_string();
    let folder = tempfile::tempdir().map_err(|e| e.to_string())?;
    let emulator = dimos::arms::emulate("remote", DOF).map_err(text)?;
    let rust = repeats(effort, &emulator.address())?;
    drop(emulator);
    let goal = |p99: Vec<f64>, most| Measure::new("p99", "µs", p99).goal(Goal::AtMost(most));
    print("round trip to the emulator on a loopback port", &[Measure::new("p50", "µs", rust.0), goal(rust.1, 500.0)]);
    let shim = Shim::start(folder.path().to_owned())?;
    let python = repeats(effort, &shim.address)?;
    print("round trip to the Python shim", &[Measure::new("p50", "µs", python.0), goal(python.1, 2000.0)]);
    Ok(())
}

/// A shim that serves the idle arm. Ends when dropped.
struct Shim {
    process: Child,
    address: String,
}

impl Shim {
    fn start(folder: PathBuf) -> Result<Self, String> {
        std::fs::write(folder.join("idle.py"), IDLE_ARM).map_err(|e| e.to_string())?;
        let socket = folder.join("python.sock");
        let shim = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("assets/python/dimos_shim.py");
        let address = format!("unix:{}", socket.display());
        let mut command = Command::new("python3");
        command.arg(shim).args(["idle:IdleArm", "--address", "none", "--at", &address, "--hz", "1000"]);
        command.current_dir(&folder).env("PYTHONPATH", &folder).stdout(Stdio::null()).stderr(Stdio::null());
        let shim = Self { process: command.spawn().map_err(|e| format!("SKIPPED: python3: {e}"))?, address };
        let end = Instant::now() + TIMEOUT;
        while !socket.exists() {
            if Instant::now() > end {
                return Err("the shim did not start in time".into());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        Ok(shim)
    }
}

impl Drop for Shim {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Returns p50 and p99 [µs] of several series.
fn repeats(effort: Effort, address: &str) -> Result<(Vec<f64>, Vec<f64>), String> {
    let (mut p50, mut p99) = (Vec::new(), Vec::new());
    for _ in 0..effort.of(1, 5) {
        let address = address.to_owned();
        let series = std::thread::spawn(move || series(&address, effort.of(30, 2000))).join();
        let times = series.map_err(|_| "the series panicked")?.map_err(|e| e.to_string())?;
        p50.push(quantile(&times, 0.5));
        p99.push(quantile(&times, 0.99));
    }
    Ok((p50, p99))
}

/// Sends commands at 100 Hz and returns the times until the state after each was read [µs].
fn series(address: &str, cycles: usize) -> AdapterResult<Vec<f64>> {
    let mut arm = dimos::arms::create("remote", address, DOF)?;
    arm.connect()?;
    arm.activate()?;
    arm.set_control_mode(ControlMode::ServoPosition)?;
    host::enter_realtime(host::DEVICE_PRIORITY);
    let wake = Wake::new().map_err(|e| dimos::hardware::adapter::AdapterError::Io(e.to_string()))?;
    let mut reading = JointReading::default();
    arm.read_joints(&mut reading)?;
    let hold = reading.position;
    let mut times = Vec::with_capacity(cycles);
    for _ in 0..cycles {
        let (before, began) = (reading.stamp, Instant::now());
        arm.write_joint_positions(hold.get(..DOF).unwrap_or_default(), 1.0)?;
        while reading.stamp == before && began.elapsed() < TIMEOUT {
            if let Some(fd) = arm.state_fd() {
                wake.wait_or_readable(fd, TIMEOUT);
            }
            arm.read_joints(&mut reading)?;
        }
        times.push(began.elapsed().as_secs_f64() * 1e6);
        std::thread::sleep(Duration::from_millis(10).saturating_sub(began.elapsed()));
    }
    arm.deactivate(&StopPoint::default())?;
    arm.disconnect();
    Ok(times)
}
