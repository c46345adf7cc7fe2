//! Connections that are lost and come back: what watchers, jog and a pulled cable show.

use std::io::Write;
use std::net::TcpStream;
use std::process::Stdio;
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

use crate::support::cable::{CELL, Cable, End};
use crate::support::network::{CELL as BLUEPRINT, Shared, is_built};
use crate::support::program::{Home, Started, TIMEOUT, UP, eventually};
use crate::support::terminal::Terminal;

/// Silence after which a loss is noticed and said, and a margin for a busy computer.
const SAID_WITHIN: Duration = Duration::from_millis(1500 + 500);
/// Time to connect again, and a margin for a busy computer.
const AGAIN_WITHIN: Duration = Duration::from_millis(600 + 900);
/// The keys of a held key.
const HOLD: Duration = Duration::from_millis(40);

fn kill_gateway(shared: &Shared) {
    kill_process(Pid::from_raw(shared.gateway().unwrap()).unwrap(), Signal::KILL).unwrap();
}

/// Waits until something listens at the place.
fn until_it_listens(at: &str) {
    let (address, began) = (at.strip_prefix("tcp/").unwrap(), Instant::now());
    while TcpStream::connect(address).is_err() {
        assert!(began.elapsed() < TIMEOUT, "nothing listens at {at}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn a_watcher_says_what_is_lost_and_goes_on_when_it_is_back() {
    if !is_built() {
        return;
    }
    let mut shared = Shared::start("");
    let mut watch = shared.command("state --watch --json --hz 50");
    let watch = Started::of(watch.stdin(Stdio::null()));
    watch.until("arm_joint1");
    let lines = |watch: &Started| watch.out().lines().count();

    kill_gateway(&shared);
    let killed = Instant::now();
    watch.until("is lost");
    assert!(killed.elapsed() < SAID_WITHIN, "{:?}", killed.elapsed());
    until_it_listens(&shared.at);
    let listens = Instant::now();
    watch.until("connected to run cell at");
    assert!(listens.elapsed() < AGAIN_WITHIN, "{:?}", listens.elapsed());
    let before = lines(&watch);
    eventually("states come again", || lines(&watch) > before + 5);

    // Another run of this name.
    shared.home.dimos("down").with(0);
    watch.until("has ended; waiting for it");
    shared.run = shared.home.run("cell.yaml --no-record");
    let listens = Instant::now();
    eventually("it is connected again", || watch.err().matches("connected to run cell at").count() == 2);
    assert!(listens.elapsed() < AGAIN_WITHIN, "{:?}", listens.elapsed());
    let before = lines(&watch);
    eventually("states come again", || lines(&watch) > before + 5);
    watch.end(Signal::INT);
}

#[test]
fn a_run_without_its_folder_is_reached_from_elsewhere_and_its_end_is_said() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let folder = shared.home.path().join("run/dimos");
    std::fs::remove_dir_all(&folder).unwrap();
    std::fs::write(&folder, "").unwrap();
    shared.there("stop").with(0).shows(&["confirmed"]);
    shared.there("state").with(0);
    let watch = Started::of(shared.command("state --watch --json").stdin(Stdio::null()));
    watch.until("arm_joint1");
    shared.run.signal(Signal::INT);
    watch.until("waiting for it");
    assert!(watch.err().contains("has ended; waiting for it"), "{}", watch.err());
    watch.end(Signal::INT);
}

#[test]
fn every_request_that_is_pending_at_the_end_of_a_run_is_told_of_it() {
    if !is_built() {
        return;
    }
    let shared = Shared::start("");
    let watchers: Vec<Started> =
        (0..12).map(|_| Started::of(shared.command("state --watch --json --hz 1000").stdin(Stdio::null()))).collect();
    watchers.iter().for_each(|watch| watch.until("arm_joint1"));
    shared.home.dimos("down").with(0);
    for watch in watchers {
        watch.until("waiting for it");
        assert!(watch.err().contains("has ended; waiting for it"), "{}", watch.err());
        watch.end(Signal::INT);
    }
}

#[test]
fn jog_survives_a_loss_and_moves_nothing_until_its_user_says_so() {
    if !is_built() {
        return;
    }
    let shared = Shared::start(", users: {'-': operator}");
    let terminal = Terminal::new(100, 30);
    let jog = terminal.start(&shared.home, &format!("--at {} jog arm --joints", shared.at));
    terminal.until("cell");
    let position = || shared.home.positions("arm")[0];
    let hold = |times: usize| {
        for _ in 0..times {
            terminal.keys("+");
            std::thread::sleep(HOLD);
        }
    };
    eventually("a held key moves the arm", || {
        hold(5);
        position() > 0.02
    });
    kill_gateway(&shared);
    terminal.until("is lost");
    // The key is still held when the connection is back.
    terminal.until_with("connected again: Space takes the lease", || hold(1));
    eventually("the arm is at rest", || {
        let before = position();
        std::thread::sleep(Duration::from_millis(50));
        (position() - before).abs() < 1e-6
    });
    let rest = position();
    hold(20);
    assert!((position() - rest).abs() < 1e-6, "it moved by {} rad", position() - rest);
    terminal.keys(" ");
    eventually("it holds the lease again", || shared.commander().is_some());
    eventually("a held key moves the arm again", || {
        hold(5);
        position() > rest + 0.02
    });
    terminal.keys("\x1b");
    jog.wait().with(0);
}

#[test]
fn n03_a_pulled_cable_frees_the_lease_and_is_said_and_mended() {
    if !is_built() {
        return;
    }
    let Some(cable) = Cable::lay() else { return };
    let home = Home::new();
    let at = format!("tcp/{CELL}:7447");
    let share = format!("share: {{listen: ['{at}'], insecure: true, users: {{'-': operator}}}}\n");
    home.write("cell.yaml", &format!("{BLUEPRINT}{share}"));
    let run = Started::of(&mut cable.command(&home, End::Cell, "run cell.yaml --no-record --no-view"));
    run.until(UP);
    eventually("the run is shared", || home.status()["share"].is_object());
    let commander = || home.status()["arms"][0]["commander"]["program"].as_str().map(str::to_owned);
    let elsewhere = |verb: &str| cable.command(&home, End::Laptop, &format!("--at {at} {verb}"));
    let watch = Started::of(&mut elsewhere("state --watch --json --hz 20"));
    watch.until("arm_joint1");
    for (round, pulled) in [End::Cell, End::Laptop].into_iter().enumerate() {
        let mut stream = Started::of(elsewhere("task stream velocity_arm").stdin(Stdio::piped()));
        let mut targets = stream.stdin();
        targets.write_all(b"0 0 0 0 0 0\n").unwrap();
        eventually("it holds the lease", || commander().is_some());

        cable.pull(pulled);
        let began = Instant::now();
        eventually("the lease is free", || commander().is_none());
        let free = began.elapsed();
        eventually("the watcher says so", || watch.err().matches(" is lost").count() > round);
        let said = began.elapsed();
        // Its next target moves nothing.
        let _ = targets.write_all(b"0.5 0 0 0 0 0\n");
        let ended = stream.wait().with(1);
        assert!(home.positions("arm")[0].abs() < 1e-6);
        assert!(ended.err.contains("[LOST]"), "{}", ended.err);
        // `client_timeout` + 0.3 s, and a margin.
        assert!(free < Duration::from_millis(1300 + 500) && said < SAID_WITHIN, "{pulled:?}: {free:?} {said:?}");

        let lines = watch.out().lines().count();
        cable.plug(pulled);
        let plugged = Instant::now();
        eventually("it is connected again", || watch.err().matches("connected to run cell at").count() > round);
        let again = plugged.elapsed();
        // An attempt that has begun just before ends first.
        assert!(again < AGAIN_WITHIN + Duration::from_millis(500), "{pulled:?}: {again:?}");
        eventually("states come again", || watch.out().lines().count() > lines + 5);
        println!("{pulled:?} pulled: lease free {free:?}, said {said:?}, connected again {again:?}");
    }
    watch.end(Signal::INT);
    run.end(Signal::INT).with(130);
}
