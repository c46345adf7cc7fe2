//! Every live run of a user is found and stopped, whatever became of its directory; what is in a directory and was not
//! made by a run is neither believed nor removed. These runs are in the open world, as those of users: each has its own
//! name, and no verb here stops a run without naming it.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use dimos::arms::ur::emulator::UrEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::process::Signal;
use rustix::thread::CapabilitySet;
use serde_json::json;

use crate::support::program::{Ended, Home, Started, UP, eventually};
use crate::support::skip::{skip, skip_privileged};

/// A name that no other run of this computer has.
fn own_name() -> String {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    format!("found-{}-{}", std::process::id(), COUNT.fetch_add(1, Ordering::Relaxed))
}

/// A verb in the open world.
fn open(home: &Home, arguments: &str) -> Command {
    let mut command = home.command(arguments);
    command.env_remove("DIMOS_WORLD").stdin(Stdio::null());
    command
}

/// The same in a shell that has not the folders of the run: as after `su`, in cron, in an old tmux.
fn elsewhere(home: &Home, arguments: &str) -> Ended {
    let mut command = open(home, arguments);
    Started::of(command.env_remove("XDG_RUNTIME_DIR").env("TMPDIR", home.path())).wait()
}

fn up(home: &Home, arguments: &str) -> Started {
    let run = Started::of(&mut open(home, &format!("run {arguments} --no-record")));
    run.until(UP);
    run
}

/// Waits until a path is there: 1 s, and what a busy host needs.
#[track_caller]
fn appears(path: &Path) {
    let began = Instant::now();
    eventually(&path.display().to_string(), || path.exists());
    assert!(began.elapsed() < Duration::from_secs(3), "after {:?}", began.elapsed());
}

#[test]
fn a_run_is_found_from_a_shell_with_other_folders() {
    let (home, name) = (Home::new(), own_name());
    let run = up(&home, &format!("coordinator-yourarm --name {name}"));
    elsewhere(&home, &format!("stop --run {name}")).with(0).shows(&[&name, "confirmed"]);
    elsewhere(&home, &format!("status {name}")).with(0).shows(&[&name, "held"]);
    // No second run of that name, whatever its folder.
    let second = Started::of(open(&home, &format!("run coordinator-mock --name {name}")).env_remove("XDG_RUNTIME_DIR"));
    let refused = second.wait().says(&[&format!("is live already (pid {})", run.pid())]);
    assert_ne!(refused.code, Some(0));
    // A closed world has nothing to do with it.
    home.dimos(&format!("stop --run {name}")).with(2).says(&["no live run is named"]);
    assert!(!home.dimos("status").with(0).out.contains(&name));
    elsewhere(&home, &format!("down {name}")).with(0).says(&["ended"]);
    run.wait().with(0);
}

#[test]
fn who_asks_while_a_run_starts_is_answered() {
    let home = Home::new();
    let run = Started::of(&mut home.command("run coordinator-yourarm --name early --no-record"));
    // It has its name, and no socket yet.
    eventually("the name", || home.path().join("run/dimos/early.lock").exists());
    home.dimos("status early").with(0).shows(&["run early", "ready"]);
    home.dimos("stop").with(0).shows(&["confirmed"]);
    home.dimos("down").with(0);
    run.wait().with(0);
}

#[test]
fn a_run_whose_folder_is_removed_is_stopped_and_listens_again() {
    let (home, name) = (Home::new(), own_name());
    let run = up(&home, &format!("coordinator-yourarm --name {name}"));
    let (folder, socket) = (home.path().join("run/dimos"), format!("{name}.sock"));
    let stop = || Started::of(&mut open(&home, &format!("stop --run {name}"))).wait().with(0).shows(&["confirmed"]);
    fs::remove_dir_all(&folder).unwrap();
    stop();
    appears(&folder.join(&socket));
    assert_eq!(fs::metadata(folder.join(&socket)).unwrap().permissions().mode() & 0o777, 0o600);
    fs::remove_file(folder.join(&socket)).unwrap();
    stop();
    appears(&folder.join(&socket));
    fs::set_permissions(&folder, PermissionsExt::from_mode(0o000)).unwrap();
    stop();
    fs::set_permissions(&folder, PermissionsExt::from_mode(0o700)).unwrap();
    // Where its folder cannot be made again, it uses the state folder.
    fs::remove_dir_all(&folder).unwrap();
    fs::write(&folder, "").unwrap();
    stop();
    appears(&home.path().join("state/dimos/run").join(&socket));
    stop();
    run.end(Signal::INT).with(130);
    assert!(!home.path().join("state/dimos/run").join(&socket).exists(), "it leaves nothing");
}

#[test]
fn a_run_in_another_network_namespace_is_found_and_keeps_its_name() {
    let (home, name) = (Home::new(), own_name());
    let may = Command::new("unshare").args(["-n", "true"]).stderr(Stdio::null()).status();
    if !may.is_ok_and(|status| status.success()) {
        return skip_privileged("unshare -n", CapabilitySet::SYS_ADMIN);
    }
    let plain = open(&home, &format!("run coordinator-mock --no-record --name {name}"));
    let mut command = Command::new("unshare");
    command.arg("-n").arg(plain.get_program()).args(plain.get_args()).stdin(Stdio::null());
    home.settle(&mut command).env_remove("DIMOS_WORLD");
    let run = Started::of(&mut command);
    run.until(UP);
    elsewhere(&home, &format!("stop --run {name}")).with(0).shows(&["confirmed"]);
    let second = Started::of(open(&home, &format!("run coordinator-mock --name {name}")).env_remove("XDG_RUNTIME_DIR"));
    second.wait().says(&["is live already"]);
    run.end(Signal::INT).with(130);
}

#[test]
fn a_stop_that_reaches_no_socket_names_the_process() {
    let (home, name) = (Home::new(), own_name());
    let run = up(&home, &format!("coordinator-mock --name {name} --set rpc.enabled=false"));
    let pid = run.pid();
    let not_stopped = format!("error: run {name} (pid {pid}) is not stopped: ");
    let hint = format!("hint: its own stop, or kill -INT {pid}: its arms decelerate to rest");
    elsewhere(&home, &format!("stop --run {name}")).with(1).says(&[&not_stopped, &hint]);
    // Many times: nothing fills up. At once: the run says so itself.
    let began = Instant::now();
    for _ in 0..10 {
        Started::of(&mut open(&home, &format!("stop --run {name}"))).wait().with(1).says(&[&not_stopped]);
    }
    for verb in ["cancel --run", "down"] {
        let refused = elsewhere(&home, &format!("{verb} {name}"));
        assert_ne!(refused.says(&["serves no clients", "hint: "]).code, Some(0), "{verb}");
    }
    assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
    run.end(Signal::INT).with(130);
}

#[test]
fn a_name_that_another_user_has_taken_is_said() {
    let (home, name) = (Home::new(), own_name());
    let mark = format!("dimos/run/{}/{name}", rustix::process::geteuid().as_raw());
    let script = format!(
        "import os, socket, sys; os.setuid(65534); s = socket.socket(socket.AF_UNIX); s.bind('\\0{mark}')\n\
         s.listen(); print('it listens', flush=True); sys.stdin.read()"
    );
    let taken = Started::of(Command::new("python3").args(["-c", &script]).stdin(Stdio::piped()));
    eventually("it listens or may not", || taken.out().contains("it listens") || taken.over());
    if taken.over() {
        return skip_privileged(&format!("another user: {}", taken.err()), CapabilitySet::SETUID);
    }
    let line = format!("run coordinator-mock --no-record --duration 1s --name {name}");
    let refused = Started::of(&mut open(&home, &line)).wait();
    let says = format!("another user has the name \"{name}\" (uid 65534, pid {})", taken.pid());
    assert_ne!(refused.says(&[&says, "hint: choose another name"]).code, Some(0));
    elsewhere(&home, &format!("stop --run {name}")).with(2).says(&["no live run is named"]);
}

#[test]
fn a_closed_world_has_a_folder_and_arms_of_this_computer() {
    let home = Home::new();
    let wrong = |world: &str, verb: &str| Started::of(home.command(verb).env("DIMOS_WORLD", world)).wait();
    for world in ["/nonexistent", "", "/etc/passwd"] {
        for verb in ["status", "stop", "run coordinator-mock --duration 1s --no-record"] {
            let ended = wrong(world, verb).says(&["DIMOS_WORLD=", "is not a directory of this user", "hint: "]);
            assert!(matches!(ended.code, Some(1 | 2)), "{verb}: {:?}", ended.code);
        }
    }
    let far = "coordinator-yourarm --address arm=192.0.2.7";
    home.dimos(&format!("run {far}")).with(3).says(&["outside of DIMOS_WORLD", "hint: unset DIMOS_WORLD"]);
    home.dimos(&format!("check {far}")).with(0).says(&["warning: arm arm at 192.0.2.7 is outside of DIMOS_WORLD"]);
    home.dimos("adapter test yourarm --address 192.0.2.7").with(3).says(&["outside of DIMOS_WORLD"]);
}

#[test]
fn files_that_no_run_made_are_left_alone() {
    let home = Home::new();
    let (folder, kept) = (home.path().join("run/dimos"), home.path().join("project"));
    let files = ["Cargo.lock", "poetry.lock", "notes.view", "my.sock", "src.txt"];
    fs::create_dir(&kept).unwrap();
    for is_link in [false, true] {
        match is_link {
            true => fs::remove_dir_all(&folder).and_then(|()| symlink(&kept, &folder)).unwrap(),
            false => fs::create_dir(&folder).unwrap(),
        }
        fs::set_permissions(&folder, PermissionsExt::from_mode(0o755)).unwrap();
        files.iter().for_each(|file| fs::write(folder.join(file), "precious").unwrap());
        drop(UnixListener::bind(folder.join("other.sock")).unwrap());
        for verb in ["status", "stop", "view", "down x", "run coordinator-mock --duration 1s --no-record"] {
            let ended = home.dimos(verb);
            let says = match verb.split(' ').next().unwrap() {
                "status" => vec![],
                "stop" | "view" => vec!["no run of this user is live", "hint: "],
                "down" => vec!["no live run is named"],
                _ if is_link => vec!["is not a directory of this user", "hint: "],
                _ => vec!["was not made by a run", "hint: "],
            };
            assert_eq!(ended.code == Some(0), says.is_empty(), "{verb}: {:?}", ended.code);
            ended.says(&says);
        }
        let tab = Started::of(home.command("-- dimos status ").env("DIMOS_COMPLETE", "bash")).wait();
        assert!(tab.code.is_some());
        files.iter().for_each(|file| assert_eq!(fs::read(folder.join(file)).unwrap(), b"precious", "{file}"));
        assert_eq!(fs::metadata(&folder).unwrap().permissions().mode() & 0o777, 0o755);
        if !is_link {
            // A run of the name of such a lock does not take it for its own.
            fs::set_permissions(&folder, PermissionsExt::from_mode(0o700)).unwrap();
            let refused = home.dimos("run coordinator-mock --duration 1s --no-record --name Cargo");
            assert_ne!(refused.says(&["Cargo.lock was not made by a run"]).code, Some(0));
            assert_eq!(fs::read(folder.join("Cargo.lock")).unwrap(), b"precious");
            // Nor that of the name of a text: not beside a lock of its own.
            fs::remove_file(folder.join("other.sock")).unwrap();
            for (text, rights) in
                [("precious", 0o600), ("http://127.0.0.1:1/#0 is my arm", 0o600), ("http://a/#b", 0o644)]
            {
                fs::write(folder.join("notes.view"), text).unwrap();
                fs::set_permissions(folder.join("notes.view"), PermissionsExt::from_mode(rights)).unwrap();
                let refused = home.dimos("run coordinator-mock --duration 1s --no-record --name notes");
                assert_ne!(refused.says(&["notes.view was not made by a run"]).code, Some(0));
                assert_eq!(fs::read(folder.join("notes.view")).unwrap(), text.as_bytes());
            }
            // What a run that was killed left is no obstacle.
            fs::write(folder.join("notes.view"), "http://127.0.0.1:1/#0\n").unwrap();
            fs::set_permissions(folder.join("notes.view"), PermissionsExt::from_mode(0o600)).unwrap();
            home.dimos("run coordinator-mock --duration 1s --no-record --name notes").with(0);
            fs::write(folder.join("notes.view"), "precious").unwrap();
        }
    }
}

#[test]
fn what_is_no_file_neither_blocks_a_verb_nor_is_overwritten() {
    let home = Home::new();
    let (folder, victim) = (home.path().join("run/dimos"), home.path().join("victim"));
    fs::create_dir_all(home.path().join("state/dimos")).unwrap();
    fs::create_dir(&folder).unwrap();
    fs::set_permissions(&folder, PermissionsExt::from_mode(0o700)).unwrap();
    fs::write(&victim, "precious").unwrap();
    for fifo in [folder.join("x.lock"), folder.join("y.view"), home.path().join("state/dimos/z.json")] {
        mknodat(CWD, &fifo, FileType::Fifo, Mode::RWXU, 0).unwrap();
    }
    symlink(&victim, folder.join("link.lock")).unwrap();
    home.dimos("status").with(0);
    home.dimos("stop").with(1);
    home.dimos("logs z").with(2);
    for name in ["x", "link"] {
        let refused = home.dimos(&format!("run coordinator-mock --duration 1s --no-record --name {name}"));
        assert_ne!(refused.says(&["was not made by a run", "hint: "]).code, Some(0), "{name}");
    }
    assert_eq!(fs::read(&victim).unwrap(), b"precious");
}

#[test]
fn a_folder_of_another_user_is_not_believed() {
    let home = Home::new();
    let folder = home.path().join("run/dimos");
    fs::create_dir(&folder).unwrap();
    let listener = UnixListener::bind(folder.join("cell.sock")).unwrap();
    let count = std::sync::Arc::new(AtomicU32::new(0));
    let counted = count.clone();
    // Takes connections and closes them, until this process ends.
    std::thread::spawn(move || {
        for _ in listener.incoming() {
            counted.fetch_add(1, Ordering::Relaxed);
        }
    });
    fs::write(folder.join("cell.lock"), std::process::id().to_string()).unwrap();
    let held = fs::File::open(folder.join("cell.lock")).unwrap();
    held.lock().unwrap();
    assert_ne!(home.dimos("stop").code, Some(0), "this user's own folder is believed: nothing answers there");
    let asked = count.load(Ordering::Relaxed);
    assert!(asked > 0);
    if let Err(error) = std::os::unix::fs::chown(&folder, Some(65534), None) {
        return skip_privileged(&format!("a folder of another user: {error}"), CapabilitySet::CHOWN);
    }
    home.dimos("stop").with(1).says(&["no run of this user is live"]);
    assert_eq!(count.load(Ordering::Relaxed), asked, "no verb has connected");
    let refused = home.dimos("run coordinator-mock --duration 1s --no-record");
    assert_ne!(refused.says(&["is not a directory of this user"]).code, Some(0));
}

const TWO: &str = "
hardware:
  - {hardware_id: left, joints: {prefix: left, count: 6}, adapter_type: ur, address: '127.0.0.1:1', options: {model: ur5e}}
  - {hardware_id: right, joints: {prefix: right, count: 6}, adapter_type: ur, address: '127.0.0.1:2', options: {model: ur5e}}
tasks: []
view: {backend: none}
";

#[test]
fn an_arm_is_commanded_once_whatever_its_addresses() {
    let home = Home::new();
    let emulator = |serial: &str| {
        let options = json!({"model": "ur5e", "sim": {"serial": serial}});
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
        UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap()
    };
    let (serial, other) = (format!("31{:09}", std::process::id()), format!("32{:09}", std::process::id()));
    let (left, right, third) = (emulator(&serial), emulator(&serial), emulator(&other));
    home.write("two.yaml", TWO);
    let both = |left: &UrEmulator, right: &UrEmulator| {
        let place = |arm: &str, emulator: &UrEmulator| format!("--address {arm}={}", emulator.address());
        format!("two.yaml {} {}", place("left", left), place("right", right))
    };
    let same = home.dimos(&format!("check {}", both(&left, &left))).with(2);
    same.says(&["two arms have the address", "first used here"]);
    let one_arm = format!("left and right are one arm: serial {serial}");
    let refused = Started::of(&mut open(&home, &format!("run {} --no-record", both(&left, &right)))).wait();
    refused.with(3).says(&[&one_arm]);
    let port = left.address().rsplit_once(':').unwrap().1.to_owned();
    let spelled = format!("two.yaml --address left=127.0.0.1:{port} --address right=localhost:{port}");
    home.dimos(&format!("run {spelled} --no-record")).with(3).says(&["is the arm left of this run"]);
    // In a closed world emulators may have the same one.
    home.run(&format!("{} --no-record", both(&left, &right))).end(Signal::INT).with(130);

    let (first, second) = (own_name(), own_name());
    let alone = |name: &str, emulator: &UrEmulator| {
        format!("coordinator-ur5e --name {name} --address arm={}", emulator.address())
    };
    let run = up(&home, &alone(&first, &left));
    let taken = format!("(serial {serial}) is commanded by process {}", run.pid());
    let refused = Started::of(&mut open(&home, &format!("run {} --no-record", alone(&second, &right)))).wait();
    refused.with(3).says(&[&taken, "hint: "]);
    // The arm of another run appears at the address of this one's: its reset does not take it.
    let run_two = up(&home, &alone(&second, &third));
    let verb = |text: &str| Started::of(&mut open(&home, text)).wait();
    third.set_serial(&serial);
    third.inject(Fault::new(FaultKind::Disconnect)).unwrap();
    eventually("another arm is seen", || {
        verb(&format!("status {second} --json")).json()["arms"][0]["cause"]["name"] == "identity_changed"
    });
    for _ in 0..2 {
        verb(&format!("arm reset arm --run {second}")).with(1).says(&[&taken]);
    }
    run.end(Signal::INT).with(130);
    verb(&format!("arm reset arm --run {second}")).with(1).says(&["another arm answers as arm"]);
    verb(&format!("arm reset arm --run {second}")).with(0);
    run_two.end(Signal::INT).with(130);
}

#[test]
fn the_python_client_finds_the_same_runs() {
    let (home, name) = (Home::new(), own_name());
    let client = concat!(env!("CARGO_MANIFEST_DIR"), "/assets/python");
    let script = format!(
        "import dimos_client as d; c = d.Client.connect({name:?}); print(c.status()['run'], d.runs()[{name:?}])"
    );
    let python = |world: Option<&Path>| {
        let mut command = Command::new("python3");
        home.settle(command.args(["-c", &script]).env("PYTHONPATH", client).stdin(Stdio::null()));
        command.env_remove("XDG_RUNTIME_DIR").env("TMPDIR", home.path()).env("PYTHONDONTWRITEBYTECODE", "1");
        match world {
            Some(world) => command.env("DIMOS_WORLD", world),
            None => command.env_remove("DIMOS_WORLD"),
        };
        Started::of(&mut command).wait()
    };
    if Command::new("python3").arg("--version").output().is_err() {
        return skip("no python3");
    }
    let run = up(&home, &format!("coordinator-mock --name {name}"));
    let socket = home.path().join(format!("run/dimos/{name}.sock"));
    python(None).with(0).shows(&[&format!("{name} {}", socket.display())]);
    fs::remove_dir_all(home.path().join("run/dimos")).unwrap();
    mknodat(CWD, home.path().join("run/x.lock"), FileType::Fifo, Mode::RWXU, 0).unwrap();
    python(None).with(0).shows(&[&name]);
    let world = home.path().join("run");
    python(Some(&world)).with(1).says(&["no run of this user is live"]);
    run.end(Signal::INT).with(130);
    let inside = home.run(&format!("coordinator-mock --no-record --name {name}"));
    python(Some(&world)).with(0).shows(&[&name]);
    inside.end(Signal::INT).with(130);
}
