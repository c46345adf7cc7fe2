//! A start that fails, at any of its stages, releases everything that the stages before it took.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

use dimos::hardware::adapter::AdapterError;
use dimos::hardware::registry::AdapterSpec;
use dimos::joint::JointLimits;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Builder, Options, Record, Run, StartError};

use crate::support::program::eventually;
use crate::support::wrapped::{ROW, Wrapped};

static LEFT: LazyLock<Wrapped> = LazyLock::new(Wrapped::new);
static RIGHT: LazyLock<Wrapped> = LazyLock::new(Wrapped::new);
/// Limits that the left arm reports, where they are not its own.
static LIMITS: Mutex<Option<JointLimits>> = Mutex::new(None);
/// A file that appears while the arms are connected.
static APPEARS: Mutex<Option<PathBuf>> = Mutex::new(None);

const SPEC: AdapterSpec = AdapterSpec {
    create: |config| {
        if let Some(path) = APPEARS.lock().unwrap().take() {
            fs::write(path, "").unwrap();
        }
        let arm = if config.hardware_id == "left" { &*LEFT } else { &*RIGHT };
        Ok(Box::new(Wrapped { limits: LIMITS.lock().unwrap().clone(), ..arm.clone() }))
    },
    ..ROW
};

/// Threads of a run begin with one of these.
const THREADS: &[&str] = &["tick", "outcomes", "recorder", "watchdog", "device/", "planner", "rpc", "replan", "view"];

/// The arms are the same in all of these tests.
static ALONE: Mutex<()> = Mutex::new(());

struct Bench {
    _alone: MutexGuard<'static, ()>,
    folder: tempfile::TempDir,
    model: PathBuf,
}

impl Bench {
    fn new() -> Self {
        let _alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = tempfile::tempdir().unwrap();
        let model = folder.path().join("model.urdf");
        fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/robot/robots/yourarm.urdf"), &model).unwrap();
        Self { _alone, folder, model }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A run of two arms, with a planner for the left one.
    fn run(&self, log: &str) -> Builder {
        let pid = std::process::id();
        let model = self.model.display();
        let blueprint = format!(
            "
hardware:
  - {{hardware_id: left, adapter_type: wrapped, address: 'memory:left-{pid}', joints: {{prefix: left, count: 6}}}}
  - {{hardware_id: right, adapter_type: wrapped, address: 'memory:right-{pid}', joints: {{prefix: right, count: 6}}}}
tasks:
  - {{name: traj_left, type: trajectory, joint_names: {{hardware: left}}}}
planner:
  robots:
    - name: left
      model_path: {model}
      end_effector_link: flange
      joint_names: [joint1, joint2, joint3, joint4, joint5, joint6]
      joint_prefix: left_
      coordinator_task_name: traj_left
"
        );
        let run = Run::from_yaml("stages", &blueprint).adapters(&[SPEC]).record(Record::To(self.path(log)));
        run.folder(self.place()).view().set("view.port", 0)
    }

    fn place(&self) -> RunDir {
        RunDir::closed(self.path("runs"))
    }

    /// The start fails with these words, and nothing is left of it: the same run can be started at once.
    fn fails(&self, start: impl FnOnce() -> Result<Run, StartError>, words: &str) {
        match start() {
            Ok(_) => panic!("it started"),
            Err(error) => assert!(error.to_string().contains(words), "{error}"),
        }
        for arm in [&*LEFT, &*RIGHT] {
            let calls = arm.mock.calls();
            let last = calls.iter().map(|call| call.name()).rfind(|name| ["connect", "disconnect"].contains(name));
            assert_ne!(last, Some("connect"), "an arm is still connected");
        }
        let left: Vec<_> = fs::read_dir(self.path("runs")).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert!(left.is_empty(), "socket or lock: {left:?}");
        let files = fs::read_dir("/proc/self/fd").unwrap().filter_map(|fd| fs::read_link(fd.ok()?.path()).ok());
        let logs: Vec<_> = files.filter(|file| file.extension().is_some_and(|e| e == "mcap")).collect();
        assert!(logs.is_empty(), "open: {logs:?}");
        // A device thread answers just before it ends.
        eventually("all threads are gone", || threads().is_empty());
        // With nothing left behind the same run can start.
        let run = self.run("again.mcap").start().unwrap();
        assert!(run.stop().troubles.is_empty());
    }
}

/// The threads of runs in this process; those of other tests in the same process cannot be distinguished.
fn threads() -> Vec<String> {
    if std::env::var_os("NEXTEST").is_none() {
        return Vec::new();
    }
    let tasks = fs::read_dir("/proc/self/task").unwrap().flatten();
    let names = tasks.filter_map(|task| fs::read_to_string(task.path().join("comm")).ok());
    names.filter(|name| THREADS.iter().any(|thread| name.starts_with(thread))).collect()
}

#[test]
fn a_log_that_cannot_be_made() {
    let bench = Bench::new();
    fs::write(bench.path("old.mcap"), "somebody's").unwrap();
    bench.fails(|| bench.run("old.mcap").start(), "cannot create the log");
    assert_eq!(fs::read(bench.path("old.mcap")).unwrap(), b"somebody's");
}

#[test]
fn a_model_that_does_not_load() {
    let bench = Bench::new();
    let blueprint = bench.run("log.mcap").check().blueprint.unwrap();
    let whole = fs::read(&bench.model).unwrap();
    fs::write(&bench.model, "<robot").unwrap();
    let options = Options { folder: bench.place(), record: Record::To(bench.path("log.mcap")), ..Options::default() };
    let start = || {
        let failed = Run::start(&blueprint, options);
        fs::write(&bench.model, whole).unwrap();
        failed
    };
    bench.fails(start, "model.urdf");
}

#[test]
fn a_device_that_another_run_has() {
    let bench = Bench::new();
    let other = "hardware: [{hardware_id: right, adapter_type: wrapped, address: 'memory:right-PID', joints: {prefix: a, count: 6}}]";
    let other = other.replace("PID", &std::process::id().to_string());
    let other = Run::from_yaml("other", &other).adapters(&[SPEC]).record(Record::Off);
    let folder = tempfile::tempdir().unwrap();
    let other = other.folder(RunDir::closed(folder.path())).start().unwrap();
    let start = || {
        let failed = bench.run("log.mcap").start();
        other.stop();
        failed
    };
    bench.fails(start, "in use by process");
}

#[test]
fn an_arm_that_does_not_connect() {
    let bench = Bench::new();
    RIGHT.mock.fail("connect", AdapterError::Io("no route to host".into()));
    bench.fails(|| bench.run("log.mcap").start(), "right: no route to host");
}

#[test]
fn an_arm_with_other_limits_than_its_model() {
    let bench = Bench::new();
    let mut limits = JointLimits::uniform(6, 3.0, 2.0);
    (limits.position_lower[2], limits.position_upper[2]) = (-3.0, -2.0);
    *LIMITS.lock().unwrap() = Some(limits);
    let start = || {
        let failed = bench.run("log.mcap").start();
        *LIMITS.lock().unwrap() = None;
        failed
    };
    bench.fails(start, "joint3");
}

#[test]
fn an_arm_that_is_not_enabled() {
    let bench = Bench::new();
    LEFT.mock.fail("activate", AdapterError::Fault { code: 7, text: "brake".into() });
    bench.fails(|| bench.run("log.mcap").start(), "left: cannot be enabled: fault 7: brake");
}

#[test]
fn a_socket_that_cannot_be_opened() {
    let bench = Bench::new();
    let file = bench.path("runs").join("stages.sock");
    *APPEARS.lock().unwrap() = Some(file.clone());
    let start = || {
        let failed = bench.run("log.mcap").start();
        // No run made it, so none removes it.
        fs::remove_file(&file).unwrap();
        failed
    };
    bench.fails(start, "the socket cannot be opened");
}

#[test]
#[cfg(feature = "view")]
fn a_live_view_that_cannot_be_served_ends_no_start() {
    let bench = Bench::new();
    let elsewhere = bench.run("log.mcap").set("view.host", "192.0.2.1").start().unwrap();
    assert!(elsewhere.view_url().is_none() && elsewhere.status().view.is_none());
    assert!(elsewhere.socket().is_some() && elsewhere.stop().troubles.is_empty());
    // Its file is in the way of another one.
    let (run, file) = (bench.run("other.mcap"), bench.path("runs/stages.view"));
    *APPEARS.lock().unwrap() = Some(file.clone());
    let run = run.start().unwrap();
    assert!(run.view_url().is_none() && run.stop().troubles.is_empty());
    eventually("all threads are gone", || threads().is_empty());
    // No run removes it.
    fs::remove_file(file).unwrap();
    let served = bench.run("again.mcap").start().unwrap();
    assert!(served.view_url().is_some() && bench.path("runs/stages.view").exists());
    assert!(served.stop().troubles.is_empty() && !bench.path("runs/stages.view").exists());
    eventually("all threads are gone", || threads().is_empty());
}

#[test]
fn a_name_that_is_taken() {
    let bench = Bench::new();
    let claim = bench.place().claim("stages").unwrap();
    let start = || {
        let failed = bench.run("log.mcap").start();
        drop(claim);
        failed
    };
    bench.fails(start, "live already");
}
