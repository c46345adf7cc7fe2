//! Faults of the process: the tick breaks or stalls, signals, `kill -9`.

use std::io::{BufRead, Write};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::Duration;

use dimos::rpc::api::Move;
use rustix::process::Signal;

use super::*;
use crate::support::program::{Started, UP};

#[test]
fn f20_a_process_that_was_stopped_does_not_catch_up() {
    let home = Home::new();
    let arm = arm();
    let run = home.run(&at(&arm));
    begin_long_move(&home, &arm);
    arm.record();
    run.signal(Signal::STOP);
    std::thread::sleep(Duration::from_millis(500));
    let resumed = now();
    run.signal(Signal::CONT);
    eventually("it is held", || home.status()["arms"][0]["phase"] == "held");
    assert_eq!(home.status()["tasks"][0]["state"], "ABORTED");
    eventually("it is at rest", || arm.joints().1.iter().all(|v| v.abs() < 1e-3));
    let points = setpoints(&arm.trace());
    let late = points.iter().filter(|(at, _)| *at >= resumed).count();
    let burst = points.windows(2).filter(|w| ms(w[0].0, w[1].0) < 1.0).count();
    println!("F20 {late} commands after resuming, {burst} within 1 ms of the one before");
    assert!(burst <= 1, "at most the one that was delayed by the stop");
    let (speed, _) = wire_extremes(&arm.trace());
    assert!(speed <= 1.0 + 1e-9);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    home.dimos("move arm 0 -0.3 0.6 0 0.8 0 --speed 1").with(0);
}

/// A pause of the tick: longer than the heartbeat's timeout, shorter than what holds an arm.
const WAITS: Duration = Duration::from_millis(70);

/// Not a test: a child process that does what `dimos run` does, until its tick breaks.
#[test]
fn child_whose_tick_breaks() {
    let Ok(how) = std::env::var("DIMOS_TEST_CHILD") else { return };
    let (how, address) = how.split_once(' ').map(|(how, address)| (how.to_owned(), address.to_owned())).unwrap();
    let found = dimos::blueprint::find(RUN).ok().unwrap();
    let set = vec![format!("hardware.arm.address={address}")];
    let overrides = dimos::blueprint::Overrides { set, ..Default::default() };
    let loaded = dimos::blueprint::load(&found, &overrides, &dimos::arms::registry().with(&[]));
    let (broken, broke) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (flag, when) = (broken.clone(), broke.clone());
    let probe = move |_| {
        if flag.load(Ordering::Relaxed) {
            when.store(now().0, Ordering::Release);
            match how.as_str() {
                "hang" => loop {
                    std::hint::spin_loop();
                },
                // From outside, a thread that sleeps and one whose processor runs others look the same.
                "wait" => std::thread::sleep(WAITS),
                _ => panic!("a defect of the tick"),
            }
            flag.store(false, Ordering::Relaxed);
        }
    };
    let options = dimos::runtime::Options { probe: Some(Box::new(probe)), ..Default::default() };
    let run = dimos::runtime::Run::start(loaded.blueprint.as_ref().unwrap(), options).unwrap();
    std::thread::spawn(move || {
        let _ = std::io::stdin().lock().read_line(&mut String::new());
        broken.store(true, Ordering::Relaxed);
        while broke.load(Ordering::Acquire) == 0 {
            std::thread::sleep(Duration::from_millis(1));
        }
        println!("broke={}", broke.load(Ordering::Acquire));
    });
    let exit = dimos::cli::run::until_its_end(run, None, false).unwrap();
    std::process::exit(exit as i32);
}

/// A process whose tick breaks at a line on its standard input, in mid-motion, with the wire on record.
fn moving_child(home: &Home, arm: &YourArmEmulator, how: &str) -> Started {
    let mut command = Command::new(std::env::current_exe().unwrap());
    home.settle(command.args(["--exact", "faults::process::child_whose_tick_breaks", "--nocapture"]));
    command.env("DIMOS_TEST_CHILD", format!("{how} {}", arm.address())).stdin(Stdio::piped());
    let child = Started::of(&mut command);
    child.until(UP);
    begin_long_move(home, arm);
    arm.record();
    child
}

/// Breaks the tick in mid-motion. Returns the times until the stop command and until the end of the process [ms].
fn break_the_tick(how: &str, says: &str) -> (f64, f64) {
    let home = Home::new();
    let arm = arm();
    let mut child = moving_child(&home, &arm, how);
    child.stdin().write_all(b"now\n").unwrap();
    let ended = child.wait().with(4).says(&["FAULT: ", says]);
    let gone = now();
    let broke = ended.out.split("broke=").nth(1).and_then(|s| s.lines().next()?.parse().ok()).map(Mono).unwrap();
    let trace = arm.trace();
    let stop = trace.iter().find(|r| r.request == Request::Stop && r.at >= broke).expect("a stop command");
    assert!(!trace.iter().any(|r| r.at > stop.at && r.request.moves()), "nothing moves it after that");
    // The motors are switched off only at rest.
    let off = trace.iter().find(|r| r.request == Request::Enable(false)).expect("the blueprint's arm has brakes");
    assert!(ms(stop.at, off.at) > 30.0, "{} ms", ms(stop.at, off.at));
    (ms(broke, stop.at), ms(broke, gone))
}

#[test]
fn f21_a_tick_that_panics_leaves_the_arm_held_and_ends_the_run() {
    let mut exits = Vec::new();
    within("F21 hold", 50.0, || {
        let (hold, exit) = break_the_tick("panic", "panicked");
        exits.push(exit);
        hold
    });
    judge("F21 exit", 1000.0, exits);
}

#[test]
fn f22_a_tick_that_hangs_leaves_the_arm_held_and_ends_the_run() {
    let mut exits = Vec::new();
    within("F22 hold", 50.0, || {
        let (hold, exit) = break_the_tick("hang", "no tick for");
        exits.push(exit);
        hold
    });
    judge("F22 exit", 1000.0, exits);
}

#[test]
fn a_tick_that_gets_no_processor_for_70_ms_holds_no_arm() {
    for _ in 0..repeats() {
        let home = Home::new();
        let arm = arm();
        let mut child = moving_child(&home, &arm, "wait");
        std::thread::sleep(WAITS);
        child.stdin().write_all(b"now\n").unwrap();
        child.until("broke=");
        std::thread::sleep(3 * WAITS);
        let trace = arm.trace();
        let gap = setpoints(&trace).windows(2).map(|w| ms(w[0].0, w[1].0)).fold(0.0, f64::max);
        assert!(!trace.iter().any(|r| r.request == Request::Stop), "the arm was stopped; longest gap {gap:.0} ms");
        assert!(gap >= 60.0, "the tick waited: {gap:.0} ms");
        assert_eq!(home.status()["arms"][0]["phase"], "ready");
        assert_eq!(home.status()["tasks"][0]["state"], "EXECUTING");
        child.end(Signal::INT).with(130);
    }
}

#[test]
fn f24_what_was_logged_before_kill_9_can_be_read() {
    const KILLS: usize = 6;
    let mut random = random();
    let mut losses = Vec::new();
    for kill in 0..KILLS {
        let home = Home::new();
        let arm = arm();
        arm.record();
        let run = home.run(&format!("{} --record log.mcap", at(&arm)));
        home.client().call(Move::new("arm", [2.5, -0.3, 0.6, 0.0, 0.8, 0.0], 0.3)).unwrap();
        std::thread::sleep(Duration::from_secs_f64(0.05 + 0.9 * random.unit()));
        run.signal(Signal::KILL);
        assert_eq!(run.wait().signal, Some(9));
        let (log, replayed) = played(&home, "log.mcap", "/dimos/tick");
        assert_eq!(replayed.code, Some(5), "kill {kill}: a truncated file is reported\n{}", replayed.err);
        let last = Mono(log.last().unwrap_or(&Value::Null)["data"]["deadline_ns"].as_u64().unwrap_or_default());
        // The emulator recorded the last setpoint, which the log should contain.
        losses.push(ms(last, setpoints(&arm.trace()).last().unwrap().0));
        // The files of the killed run do not block another run; `status` reports the crash.
        assert!(home.runs().runs().unwrap().is_empty());
        assert_eq!(home.status()["crashed"], true);
    }
    losses.sort_by(f64::total_cmp);
    println!("F24 lost at {KILLS} kills: median {:.0} ms, most {:.0} ms", losses[KILLS / 2], losses[KILLS - 1]);
    let within_limit = losses.iter().filter(|l| **l <= 200.0).count();
    // A machine that stalls may delay one flush.
    assert!(within_limit >= KILLS - 1 && losses[KILLS - 1] <= 1000.0, "{losses:.0?}");
}

#[test]
fn f27_signals_in_mid_motion_end_in_a_controlled_stop() {
    for (signal, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let home = Home::new();
        let arm = arm();
        arm.record();
        let run = home.run(&at(&arm));
        begin_long_move(&home, &arm);
        let asked = now();
        run.signal(signal);
        eventually("it is at rest", || arm.joints().1.iter().all(|v| v.abs() < 0.01));
        let still = ms(asked, now());
        // A second signal changes nothing.
        run.signal(signal);
        let ended = run.wait().with(code);
        let gone = ms(asked, now());
        println!("F27 {signal:?}: still after {still:.0} ms, gone after {gone:.0} ms");
        assert!(still <= 2000.0 && gone <= 5000.0);
        assert!(!ended.err.contains("warning"), "{}", ended.err);
        let (speed, change) = wire_extremes(&arm.trace());
        assert!(speed <= 1.0 + 1e-9 && change <= 1.0 + 1e-6, "within limits to the end: {speed} {change}");
        let trace = arm.trace();
        let off = trace.iter().find(|r| r.request == Request::Enable(false)).unwrap();
        assert!(ms(asked, off.at) + 1.0 >= still, "the motors were switched off in motion");
    }
}

#[test]
fn f28_a_terminal_that_hangs_up_ends_the_run_controlled() {
    let home = Home::new();
    let arm = arm();
    let run = home.run(&at(&arm));
    begin_long_move(&home, &arm);
    run.end(Signal::HUP).with(130).says(&["SIGHUP"]);
    assert!(arm.joints().1.iter().all(|v| v.abs() < 0.02));
}
