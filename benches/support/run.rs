//! A live run of the real binary, in its own folder.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dimos::rpc::api::{Execute, Point, Shutdown, State, Trajectory};
use dimos::rpc::client::Client;
use dimos::rpc::run_dir::RunDir;

/// Maximum time for a run to be up.
const UP_LIMIT: Duration = Duration::from_secs(10);
/// Maximum time for a run to end.
const END_LIMIT: Duration = Duration::from_secs(10);
/// Name of each run; its folder distinguishes it.
const NAME: &str = "bench";

/// A run that is starting or up. Ends when dropped.
pub struct LiveRun {
    home: tempfile::TempDir,
    child: Child,
    /// Start of the process.
    pub started: Instant,
}

impl LiveRun {
    /// Starts `dimos run BLUEPRINT` with further arguments, without waiting.
    pub fn start(blueprint: &str, arguments: &[&str]) -> std::io::Result<Self> {
        Self::named(blueprint, NAME, arguments)
    }

    /// Same, without a log.
    pub fn unrecorded(blueprint: &str, arguments: &[&str]) -> std::io::Result<Self> {
        Self::spawn(tempfile::tempdir()?, blueprint, NAME, &["--no-record"], arguments)
    }

    /// Same, with a name of its own.
    pub fn named(blueprint: &str, name: &str, arguments: &[&str]) -> std::io::Result<Self> {
        let home = tempfile::tempdir()?;
        let log = home.path().join("log.mcap").display().to_string();
        Self::spawn(home, blueprint, name, &["--record", &log], arguments)
    }

    fn spawn(
        home: tempfile::TempDir,
        blueprint: &str,
        name: &str,
        recording: &[&str],
        arguments: &[&str],
    ) -> std::io::Result<Self> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_dimos"));
        command.args(["run", blueprint, "--name", name]).args(recording).args(arguments);
        command.env("DIMOS_WORLD", home.path()).env("XDG_STATE_HOME", home.path());
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        let started = Instant::now();
        let child = command.spawn()?;
        Ok(Self { home, child, started })
    }

    /// Returns its pid.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Returns the folder used as the user's home.
    pub fn folder(&self) -> &Path {
        self.home.path()
    }

    /// Returns its log.
    pub fn log(&self) -> PathBuf {
        self.home.path().join("log.mcap")
    }

    /// Connects to it as soon as it is up.
    pub fn client(&mut self) -> Result<Client, String> {
        let folder = RunDir::closed(self.home.path().join("dimos"));
        loop {
            if let Some(status) = self.child.try_wait().map_err(|e| e.to_string())? {
                return Err(format!("the run ended during startup: {status}"));
            }
            match Client::find(&folder, None) {
                Ok(client) => return Ok(client),
                Err(e) if self.started.elapsed() > UP_LIMIT => return Err(e.to_string()),
                Err(_) => std::thread::sleep(Duration::from_millis(5)),
            }
        }
    }

    /// Shuts it down and passes its log to `read`.
    pub fn end<T>(mut self, read: impl FnOnce(&Path) -> T) -> Result<T, String> {
        self.client()?.call(Shutdown {}).map_err(|e| e.to_string())?;
        let limit = Instant::now() + END_LIMIT;
        while self.child.try_wait().map_err(|e| e.to_string())?.is_none() {
            if Instant::now() > limit {
                return Err("the run does not shut down".into());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(read(&self.log()))
    }
}

impl Drop for LiveRun {
    fn drop(&mut self) {
        // Only a run that was not shut down is still live; its arm is emulated.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Moves every arm of a run for at least this long [s], each with its own trajectory task. A swing ends at its start,
/// at rest: other trajectories would be rejected.
pub fn keep_moving(client: &mut Client, seconds: f64) -> Result<(), String> {
    let state = client.call(State {}).map_err(|e| e.to_string())?;
    let swings = (seconds / SWING).ceil().max(1.0) as usize;
    for arm in &state.arms {
        let joint_names = arm.joints.iter().map(|j| j.name.clone()).collect();
        let start: Vec<f64> = arm.joints.iter().map(|j| j.command.or(j.position).unwrap_or_default()).collect();
        let points = (0..=swings * STEPS).map(|i| swing(&start, i)).collect();
        let trajectory = Trajectory { joint_names, points };
        client.call(Execute { trajectory, task: None, retraces_to: None }).map_err(|e| e.to_string())?;
    }
    Ok(())
}

/// Duration of a swing out and back [s], and its number of points.
const SWING: f64 = 4.0;
const STEPS: usize = 16;

/// Returns step `i` of joints that swing out from `start` by 0.2 rad and back, at rest at both ends.
fn swing(start: &[f64], i: usize) -> Point {
    let turn = std::f64::consts::TAU / SWING;
    let time = i as f64 * SWING / STEPS as f64;
    let velocity = if i.is_multiple_of(STEPS) { 0.0 } else { 0.1 * turn * (turn * time).sin() };
    Point {
        time_from_start: time,
        positions: start.iter().map(|p| p + 0.1 * (1.0 - (turn * time).cos())).collect(),
        velocities: Some(vec![velocity; start.len()]),
        accelerations: None,
    }
}
