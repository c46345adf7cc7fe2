//! Runs parts of tests inside a guest Linux that has CAN, whatever the kernel here has.
//!
//! User-mode Linux is a Linux kernel that runs as an ordinary process; Debian's package brings CAN as modules. The
//! guest boots in 2 to 3 seconds, with the files of this computer as its own, a network stack of its own, one
//! processor, and process 1 as root. It cannot withhold acknowledgements as a real bus can; `sch_plug` holds frames
//! back in the queue of an interface, which looks the same to the sender.
//!
//! All of the guest runs on one processor of the host: its kernel traces its programs, and a system call that has to
//! wake another processor, twice, takes ten times as long (on a virtual machine 190 µs instead of 20), too long for the
//! 9 000 a second of an arm at its full rate.
//!
//! A test that needs it is written as usual, with its body handed to [`in_guest`]:
//!
//! ```ignore
//! #[test]
//! fn two_arms_on_two_interfaces() {
//!     uml::in_guest(module_path!(), "two_arms_on_two_interfaces", &uml::Guest::with(uml::VCAN), || {
//!         let left = /* … emulator and adapter on "vcan0" and "vcan1" … */;
//!     });
//! }
//! ```
//!
//! The test then starts its own executable again, inside the guest, for that one test, and the body runs there.
//! The guest boots as long as most tests take: [`parts_in_guest`] makes several in one.
//!
//! [`VCAN`] sets up `vcan0` and `vcan1`; [`VXCAN`] also the pairs `can0`–`sim0` and `can1`–`sim1`: what one end of a
//! pair sends, the other hears. A vendor's SDK that sends without local loopback needs a pair: the SDK on `can0`
//! (`Command::new(".venv/bin/python")` in the body; the checkout is the working directory), the emulator on `sim0`.
//! [`run`] runs a shell script instead. [`sh`] runs a command in the body: `uml::sh("ip link set vcan0 down")`.

use std::fs::{self, File};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

use super::skip::skip_tool;

/// The kernel's modules for CAN, in the order in which they can be loaded.
pub const MODULES: &[&str] = &[
    "net/can/can",
    "net/can/can-raw",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
    "drivers/net/can/vxcan",
    "drivers/net/can/slcan/slcan",
    "net/sched/sch_plug",
];
/// Sets up two separate buses.
pub const VCAN: &str = "
    for i in 0 1; do ip link add vcan$i type vcan; ip link set vcan$i up; done";
/// Sets up two separate buses and two pairs.
pub const VXCAN: &str = "
    for i in 0 1; do ip link add vcan$i type vcan; ip link set vcan$i up; done
    for i in 0 1; do
        ip link add can$i type vxcan peer name sim$i; ip link set can$i up; ip link set sim$i up
    done";

/// Set where the executable runs in the guest.
const INSIDE: &str = "DIMOS_IN_GUEST";
const TOOLS: [&str; 5] = ["linux.uml", "insmod", "ip", "tc", "cansend"];
const FOLDERS: [&str; 6] = ["/usr/local/sbin", "/usr/local/bin", "/usr/sbin", "/usr/bin", "/sbin", "/bin"];
const LIBRARY: &str = "/usr/lib/uml/modules";

/// How the guest is set up.
pub struct Guest<'a> {
    /// Kernel modules below `kernel/`, without `.ko`, in an order in which they can be loaded.
    pub modules: &'a [&'a str],
    /// Shell commands before the test, as root; the first that fails ends the guest.
    pub setup: &'a str,
    /// How long everything may take.
    pub limit: Duration,
}

impl<'a> Guest<'a> {
    /// A guest with CAN and this setup, for 100 s.
    pub fn with(setup: &'a str) -> Self {
        Self { modules: MODULES, setup, limit: Duration::from_secs(100) }
    }
}

/// What ran in a guest.
pub struct Ran {
    /// Exit status of the script.
    pub status: i32,
    /// What it wrote to both outputs.
    pub output: String,
}

/// Runs `body` in a guest: here, it starts the guest with the same test; in the guest, it runs the body. `module` is
/// the test's `module_path!()`, `name` the name of its function.
pub fn in_guest(module: &str, name: &str, guest: &Guest, body: impl FnOnce()) {
    if inside() {
        return body();
    }
    let name = module.split_once("::").map_or(name.to_owned(), |(_, inner)| format!("{inner}::{name}"));
    let this = std::env::current_exe().expect("the test's own path");
    let script = format!("{}\nexport {INSIDE}=1\n'{}' --exact '{name}' --nocapture\n", guest.setup, this.display());
    let Some(ran) = run(guest.modules, &script, guest.limit) else { return };
    assert_eq!(ran.status, 0, "in the guest:\n{}", ran.output);
    assert!(ran.output.contains("1 passed"), "no test is named {name}:\n{}", ran.output);
    println!("{}", ran.output);
}

/// What one of several tests in one guest does, after its setup, without the interfaces of the part before.
pub struct Part {
    pub name: &'static str,
    pub setup: &'static str,
    pub body: fn(),
}

/// The table of parts: `name: setup;`, each the name of a function.
#[allow(unused_macros, reason = "each test binary uses a part")]
macro_rules! parts {
    ($($name:ident: $setup:expr;)*) => {
        [$($crate::support::uml::Part { name: stringify!($name), setup: $setup, body: $name }),*]
    };
}
#[allow(unused_imports, reason = "each test binary uses a part")]
pub(crate) use parts;

/// Removes all CAN interfaces. With one end of a pair, the other goes too.
const CLEAR: &str = "
    for link in $(ls /sys/class/net); do case $link in *can*|sim*)
        [ ! -e /sys/class/net/$link ] || ip link del $link || [ ! -e /sys/class/net/$link ];; esac; done\n";

/// Runs parts one after another in one guest, all of them even if one fails. Like [`in_guest`].
pub fn parts_in_guest(module: &str, name: &str, guest: &Guest, parts: &[Part]) {
    in_guest(module, name, guest, || {
        let fails = |part: &&Part| {
            let began = Instant::now();
            println!("--- {}", part.name);
            let made = std::panic::catch_unwind(|| {
                sh(&format!("{CLEAR}{}", part.setup));
                (part.body)();
            });
            println!("{}: {:.1} s", if made.is_ok() { "passed" } else { "FAILED" }, began.elapsed().as_secs_f64());
            made.is_err()
        };
        let failed: Vec<&str> = parts.iter().filter(fails).map(|part| part.name).collect();
        assert!(failed.is_empty(), "{} parts failed: {}", failed.len(), failed.join(", "));
    });
}

/// Whether this is the guest.
pub fn inside() -> bool {
    std::env::var_os(INSIDE).is_some()
}

/// Returns what `test` says when it fails; `None` if it does not, as without tools.
pub fn failure(test: impl FnOnce() + std::panic::UnwindSafe) -> Option<String> {
    let panic = std::panic::catch_unwind(test).err()?;
    Some(*panic.downcast::<String>().expect("a message"))
}

/// Runs a shell script in a guest, as root, in the checkout; the first command that fails ends it. `None`, and a word
/// about it, when this computer lacks the tools. Panics when the guest does not come to the script's end in time.
pub fn run(modules: &[&str], script: &str, limit: Duration) -> Option<Ran> {
    let Some(library) = library() else {
        skip_tool("user-mode-linux");
        return None;
    };
    let folder = tempfile::tempdir().expect("a folder for the guest");
    let at = |name: &str| folder.path().join(name);
    fs::write(at("init"), init(folder.path(), &library, modules, script)).expect("the guest's script");
    fs::set_permissions(at("init"), fs::Permissions::from_mode(0o755)).expect("an executable script");
    let mut guest = Kernel(start(folder.path()));
    let deadline = Instant::now() + limit;
    let status = loop {
        // The file appears whole, under this name.
        if let Ok(text) = fs::read_to_string(at("status")) {
            break text.trim().parse::<i32>().ok();
        }
        if Instant::now() > deadline || guest.0.try_wait().is_ok_and(|ended| ended.is_some()) {
            break fs::read_to_string(at("status")).ok().and_then(|text| text.trim().parse().ok());
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    if status.is_some() {
        guest.end();
    }
    drop(guest);
    let text = |name| String::from_utf8_lossy(&fs::read(at(name)).unwrap_or_default()).into_owned();
    let output = text("output");
    let Some(status) = status else {
        panic!("the guest did not end within {limit:?}; it wrote:\n{output}\nits console:\n{}", text("console"));
    };
    Some(Ran { status, output })
}

/// Runs a command with the shell; it must succeed.
pub fn sh(command: &str) {
    let status = Command::new("sh").args(["-ec", command]).status().expect("a shell");
    assert!(status.success(), "{command}: {status}");
}

/// What process 1 of the guest does.
fn init(folder: &Path, library: &Path, modules: &[&str], script: &str) -> String {
    let (folder, library) = (folder.display(), library.display());
    let (path, checkout) = (FOLDERS.join(":"), env!("CARGO_MANIFEST_DIR"));
    let load: String = modules.iter().map(|module| format!("insmod {library}/{module}.ko\n")).collect();
    format!(
        "#!/bin/sh
export PATH={path} HOME=/root XDG_RUNTIME_DIR=/run
(
set -e
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t tmpfs tmpfs /run
mkdir -p /dev/pts /dev/shm
mount -t devpts devpts /dev/pts
mount -t tmpfs tmpfs /dev/shm
ip link set lo up
{load}
cd '{checkout}'
{script}
) >'{folder}/output' 2>&1 </dev/null
echo $? >'{folder}/status.part'
mv '{folder}/status.part' '{folder}/status'
halt -f
"
    )
}

fn start(folder: &Path) -> Child {
    let console = File::create(folder.join("console")).expect("a file for the console");
    let preloaded = whole_state(folder);
    let folder = folder.display();
    let mut guest = Command::new(tool("linux.uml").expect("looked for before"));
    guest
        .args(["mem=256M", "rootfstype=hostfs", "rootflags=/", "rw", "con=null", "con0=fd:0,fd:1"])
        .args([format!("init={folder}/init"), format!("uml_dir={folder}"), "umid=guest".to_owned()])
        .stdin(Stdio::null())
        .stderr(console.try_clone().expect("the same file"))
        .stdout(console)
        .envs(preloaded.map(|library| ("LD_PRELOAD", library)))
        .process_group(0);
    on_one_processor(|| guest.spawn()).expect("user-mode Linux starts")
}

/// Compiles what lets the guest's kernel run on processors with more state than it knows: see the file.
fn whole_state(folder: &Path) -> Option<PathBuf> {
    let (source, library) = (folder.join("xstate.c"), folder.join("xstate.so"));
    fs::write(&source, include_str!("uml_xstate.c")).ok()?;
    let compiled = Command::new("gcc").args(["-O2", "-shared", "-fPIC", "-o"]).args([&library, &source]).status();
    compiled.is_ok_and(|status| status.success()).then_some(library)
}

/// Runs `f` on one processor: what it starts stays there.
fn on_one_processor<T>(f: impl FnOnce() -> T) -> T {
    let before = sched_getaffinity(None).expect("the processors of this thread");
    let mut one = CpuSet::new();
    one.set((0..CpuSet::MAX_CPU).rfind(|cpu| before.is_set(*cpu)).expect("a processor"));
    sched_setaffinity(None, &one).expect("one of them");
    let result = f();
    sched_setaffinity(None, &before).expect("all of them again");
    result
}

/// The guest's kernel, which is a group of processes. It ends with the test, however that ends.
struct Kernel(Child);

impl Kernel {
    /// Waits up to 5 s until the kernel has halted.
    fn end(&mut self) {
        let deadline = Instant::now() + Duration::from_secs(5);
        while Instant::now() < deadline && self.0.try_wait().is_ok_and(|ended| ended.is_none()) {
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

impl Drop for Kernel {
    fn drop(&mut self) {
        if self.0.try_wait().is_ok_and(|ended| ended.is_none()) {
            let group = rustix::process::Pid::from_child(&self.0);
            let _ = rustix::process::kill_process_group(group, rustix::process::Signal::KILL);
            let _ = self.0.wait();
        }
    }
}

fn tool(name: &str) -> Option<PathBuf> {
    FOLDERS.iter().map(|folder| Path::new(folder).join(name)).find(|path| path.exists())
}

/// The folder of the guest kernel's modules, if all the tools are there.
fn library() -> Option<PathBuf> {
    if !TOOLS.iter().all(|name| tool(name).is_some()) {
        return None;
    }
    let mut versions: Vec<_> = fs::read_dir(LIBRARY).ok()?.flatten().map(|entry| entry.path().join("kernel")).collect();
    versions.retain(|path| path.join("net/can/can.ko").exists());
    versions.sort();
    versions.pop()
}
