//! Connecting, reconnecting, enabling and releasing.

use std::sync::atomic::Ordering::Relaxed;

use super::*;
use crate::adapter::AdapterError;
use dimos_core::arm::{Interference, Link};
use dimos_core::joint::joints_of;

#[test]
fn an_arm_with_another_number_of_joints_is_refused_and_released() {
    let mut bench = Bench::new(MockAdapter::new(DOF + 1).connected(false));
    let refused = bench.worker.connect(&mut bench.adapter).unwrap_err();
    assert_eq!(refused.to_string(), "expected an arm with 3 joints, found test double with 4");
    assert_eq!(bench.count("disconnect"), 1);
    assert!(!bench.worker.connected && !bench.worker.should_reconnect);
}

#[test]
fn limits_that_cannot_be_read_release_the_arm() {
    let mut bench = Bench::new(MockAdapter::new(DOF));
    bench.arm.fail("get_limits", AdapterError::Protocol("nonsense".into()));
    assert!(bench.worker.connect(&mut bench.adapter).is_err());
    assert_eq!(bench.count("disconnect"), 1);
}

#[test]
fn an_arm_that_is_slower_than_its_kind_is_read_less_often() {
    let mut bench = Bench::with(MockAdapter::new(DOF), |config| config.native_rate = 20.0);
    let connected = bench.worker.connect(&mut bench.adapter).unwrap();
    assert_eq!(connected.read_period, Duration::from_millis(50));
    let mut bench = Bench::new(MockAdapter::new(DOF));
    let connected = bench.worker.connect(&mut bench.adapter).unwrap();
    assert_eq!((connected.read_period, connected.write_period), (PERIOD, PERIOD));
    assert!(!connected.streams && !connected.has_payload && connected.io.is_none());
    assert_eq!(bench.states.read().seq, 1, "its state is read at once");
}

#[test]
fn attempts_to_reconnect_are_further_and_further_apart() {
    let mut bench = Bench::enabled();
    bench.worker.mark_lost();
    let lost = bench.now();
    assert_eq!(bench.worker.state.link, Link::Faulted);
    let mut attempts = Vec::new();
    for _ in 0..3000 {
        let before = bench.count("connect");
        bench.arm.fail("connect", AdapterError::Io("no route".into()));
        bench.advance(PERIOD);
        bench.cycle();
        if bench.count("connect") > before {
            attempts.push(bench.now().since(lost).as_millis());
        }
    }
    assert_eq!(attempts, [500, 1000, 2000, 4000, 8000, 13000, 18000, 23000, 28000]);
    assert!(bench.worker.state.self_held);
}

#[test]
fn after_a_reconnect_the_arm_is_held_and_the_wait_is_short_again() {
    let mut bench = Bench::enabled();
    bench.worker.mark_lost();
    bench.worker.reconnect.1 = Duration::from_secs(5);
    bench.advance(Duration::from_millis(500));
    let state = bench.cycle();
    assert_eq!((state.link, state.self_held, bench.worker.health.reconnects.load(Relaxed)), (Link::Up, true, 1));
    assert_eq!(bench.worker.reconnect.1, Duration::from_millis(500));
    bench.hold_at(0.0);
    assert!(bench.written().is_empty(), "held until it is enabled");
}

#[test]
fn another_arm_of_the_kind_gets_nothing_until_it_is_accepted() {
    let mut bench = Bench::enabled_with(MockAdapter::new(DOF).serial("A1"));
    bench.arm.clone().serial("B2");
    bench.worker.mark_lost();
    bench.advance(Duration::from_millis(500));
    assert_eq!(bench.cycle().interference, Interference::Identity);
    assert!(bench.worker.health.is_other_arm());
    bench.settle();
    let refused = bench.activate().unwrap_err().to_string();
    assert!(refused.starts_with("another arm answers than the one with which the run began"), "{refused}");
    bench.hold_at(0.0);
    assert!(bench.written().is_empty() && bench.count("activate") == 0);
    let accept = |bench: &Bench| bench.worker.health.with_identity(|identity| identity.accept());
    assert_eq!(accept(&bench), Err(("serial A1".to_owned(), "serial B2".to_owned())));
    assert_eq!(bench.cycle().interference, Interference::Identity, "shown, not accepted");
    assert_eq!(accept(&bench), Ok(()));
    bench.settle();
    assert_eq!(bench.cycle().interference, Interference::None);
    bench.activate().unwrap();
    // The same arm again is no other one.
    bench.worker.mark_lost();
    bench.advance(Duration::from_millis(500));
    assert_eq!(bench.cycle().interference, Interference::None);
}

#[test]
fn an_arm_without_a_number_is_known_by_its_usb_device() {
    let mut bench = Bench::enabled();
    let reconnect = |bench: &mut Bench, usb: &'static str| {
        bench.worker.config.usb = Box::new(move || Some(usb.to_owned()));
        bench.worker.mark_lost();
        bench.advance(Duration::from_millis(500));
        bench.cycle().interference
    };
    assert_eq!(reconnect(&mut bench, "USB 1a86:55d3 serial 5A46"), Interference::None);
    assert_eq!(reconnect(&mut bench, "USB 1a86:55d3 serial 5A47"), Interference::Identity);
    let accept = |bench: &Bench| bench.worker.health.with_identity(|identity| identity.accept());
    let shown = Err(("USB 1a86:55d3 serial 5A46".to_owned(), "USB 1a86:55d3 serial 5A47".to_owned()));
    assert_eq!((accept(&bench), accept(&bench)), (shown, Ok(())));
    assert_eq!(reconnect(&mut bench, "USB 1a86:55d3 serial 5A47"), Interference::None);
}

#[test]
fn another_arm_at_the_address_is_said_once_it_is_found() {
    let mut bench = Bench::enabled();
    bench.worker.mark_lost();
    bench.notes();
    for error in [AdapterError::Io("no route".into()), AdapterError::Rejected("a lite6".into())] {
        bench.arm.fail("connect", error);
        bench.advance(Duration::from_secs(5));
        bench.cycle();
    }
    assert_eq!(bench.notes(), ["cannot reconnect: a lite6"]);
}

#[test]
fn an_arm_that_was_never_connected_is_not_tried() {
    let mut bench = Bench::new(MockAdapter::new(DOF).connected(false));
    bench.advance(Duration::from_secs(60));
    bench.cycle();
    assert_eq!(bench.count("connect"), 0);
}

#[test]
fn motors_come_on_with_plausible_positions_only() {
    let mut bench = Bench::new(MockAdapter::new(DOF).connected(false));
    assert_eq!(bench.activate(), Err(AdapterError::NotConnected));

    let mut bench = Bench::connected();
    bench.arm.clear_calls();
    // Each reading is another pose, a jump away.
    let arm = bench.arm.clone();
    for k in 0..400 {
        if k % 2 == 0 {
            arm.clone().positions(&[0.0; DOF])
        } else {
            arm.clone().positions(&[1.0; DOF])
        };
        bench.advance(Duration::from_millis(1));
        bench.worker.read(&mut bench.adapter);
    }
    bench.arm.fail("read_joint_positions", AdapterError::Timeout("no answer".into()));
    bench.worker.read(&mut bench.adapter);
    for _ in 0..1000 {
        bench.arm.fail("read_joint_positions", AdapterError::Timeout("no answer".into()));
    }
    let began = bench.now();
    let refused = bench.activate().unwrap_err();
    assert!(refused.to_string().contains("missing or inconsistent"), "{refused}");
    assert!(bench.now().since(began) >= Duration::from_secs(1));
    assert_eq!(bench.count("activate"), 0);
}

#[test]
fn motors_that_do_not_come_on_are_an_error() {
    let mut bench = Bench::connected();
    bench.settle();
    let (began, arm) = (bench.now(), bench.arm.clone());
    bench.worker.config.clock = Arc::new(Changing(bench.clock.clone(), move |_| drop(arm.clone().enabled(false))));
    assert_eq!(bench.activate(), Err(AdapterError::Timeout("the motors did not come on within 1 s".into())));
    let waited = bench.now().since(began);
    assert!((Duration::from_secs(1)..Duration::from_millis(1200)).contains(&waited), "{waited:?}");
    assert_eq!(bench.worker.ordered_power, None);
}

#[test]
fn enabling_starts_from_nothing_that_was_before() {
    let mut bench = Bench::connected();
    bench.settle();
    bench.worker.state.self_held = true;
    bench.worker.stop_pending = true;
    bench.worker.write_errors = 2;
    bench.worker.state.interference = Interference::Stop;
    bench.activate().unwrap();
    let worker = &bench.worker;
    assert!(!worker.state.self_held && !worker.stop_pending && worker.write_errors == 0);
    assert_eq!((worker.ordered_power, worker.state.interference), (Some(true), Interference::None));
    assert!(worker.state.enabled, "all values were read");
}

#[test]
fn an_arm_is_stopped_and_only_disabled_if_it_shall_be() {
    let finish = |disable: bool, prepare: fn(&mut Bench)| {
        let mut bench = Bench::enabled();
        prepare(&mut bench);
        let result = bench.stepping(Duration::from_millis(1), |b| b.worker.finish(&mut b.adapter, disable));
        let calls = ["deactivate", "write_enable", "disconnect"].map(|name| bench.count(name));
        assert_eq!(bench.states.read().link, Link::Down);
        assert!(!bench.worker.connected && !bench.worker.should_reconnect);
        (result.map_err(|e| e.to_string()), calls)
    };
    assert_eq!(finish(false, |_| {}), (Ok(()), [1, 0, 1]));
    assert_eq!(finish(true, |_| {}), (Ok(()), [1, 1, 1]));
    let refuse = |b: &mut Bench| b.arm.fail("deactivate", AdapterError::Rejected("no".into()));
    assert_eq!(finish(true, refuse), (Err("no".into()), [1, 1, 1]), "its motors are disabled all the same");

    let lost = |b: &mut Bench| b.worker.mark_lost();
    assert_eq!(
        finish(true, lost).0,
        Err("the connection is lost: neither a stop nor a disable reached the arm".into())
    );
    assert_eq!(finish(false, lost).0, Err("the connection is lost: no stop reached the arm".into()));
    let taken = |b: &mut Bench| b.worker.state.interference = Interference::Mode;
    let text = "another program commands it: it was neither stopped nor disabled";
    assert_eq!(finish(true, taken), (Err(text.into()), [0, 0, 1]));
    let stopped = |b: &mut Bench| b.worker.state.interference = Interference::Stop;
    assert_eq!(finish(false, stopped), (Ok(()), [1, 0, 1]));
}

#[test]
fn motors_go_off_when_the_arm_is_at_rest_or_after_a_second() {
    let wait = |speed: f64| {
        let mut bench = Bench::enabled();
        let (began, arm) = (bench.now(), bench.arm.clone());
        let at = move |now: Mono| drop(arm.clone().positions(&[1.0 + speed * now.seconds_since(Mono::ZERO), 0.0, 0.0]));
        bench.worker.config.clock = Arc::new(Changing(bench.clock.clone(), at));
        bench.stepping(Duration::from_millis(2), |b| b.worker.wait_for_standstill(&mut b.adapter));
        bench.now().since(began)
    };
    let at_rest = wait(0.0);
    assert!((Duration::from_millis(30)..Duration::from_millis(400)).contains(&at_rest), "{at_rest:?}");
    let moving = wait(1.0);
    assert!((Duration::from_secs(1)..Duration::from_millis(1200)).contains(&moving), "{moving:?}");
}

/// A clock with something that happens whenever it is asked.
struct Changing<F>(TestClock, F);

impl<F: Fn(Mono) + Send + Sync> Clock for Changing<F> {
    fn now(&self) -> Mono {
        let now = self.0.now();
        self.1(now);
        now
    }
}

#[test]
fn errors_of_the_connection_end_it_and_others_do_not() {
    let mut bench = Bench::enabled();
    bench.worker.after_error(&mut bench.adapter, &AdapterError::Rejected("no".into()));
    assert!(bench.worker.connected);
    bench.worker.after_error(&mut bench.adapter, &AdapterError::NotConnected);
    assert!(!bench.worker.connected && bench.states.read().link == Link::Faulted);

    let mut bench = Bench::enabled();
    drop(bench.arm.clone().connected(false));
    bench.worker.after_error(&mut bench.adapter, &AdapterError::Timeout("no answer".into()));
    assert!(!bench.worker.connected);
    assert!(!bench.worker.plausible.stable(bench.worker.state.stamp));

    // The third failed write faults the link before the next reading.
    let mut bench = Bench::enabled();
    for (failures, link) in [(2, Link::Up), (3, Link::Faulted)] {
        bench.worker.write_errors = failures;
        bench.worker.after_error(&mut bench.adapter, &AdapterError::Rejected("no".into()));
        assert_eq!(bench.states.read().link, link);
    }
}

#[test]
fn an_arm_that_is_lost_with_its_first_reading_counts_as_no_reconnect() {
    let mut bench = Bench::enabled();
    bench.worker.mark_lost();
    bench.worker.trouble("lost");
    bench.arm.fail("read_joint_positions", AdapterError::NotConnected);
    bench.advance(Duration::from_millis(500));
    bench.cycle();
    assert_eq!((bench.count("connect"), bench.worker.connected), (1, false));
    assert_eq!(bench.worker.health.reconnects.load(Relaxed), 0);
    assert!(!bench.notes().iter().any(|note| note.starts_with("over")));
}

#[test]
fn a_stop_is_given_the_point_of_rest_and_after_silence_where_the_arm_is_within_what_it_may_have_followed() {
    let mut bench = Bench::enabled();
    let rest = joints_of(&[0.3, 0.0, 0.0]);
    bench.tick(|command| command.rest = Some(rest));
    assert_eq!(bench.worker.stop_point().position, Some(rest), "not where it is read");
    bench.tick(|command| command.unheard = Some([joints_of(&[0.1, -0.1, 0.0]), joints_of(&[0.2, 0.1, 0.0])]));
    assert_eq!(bench.worker.stop_point().position, Some(joints_of(&[0.1, 0.0, 0.0])));
    bench.tick(|command| command.unheard = Some([joints_of(&[0.5, -0.1, 0.0]), joints_of(&[0.6, 0.1, 0.0])]));
    assert_eq!(bench.worker.stop_point().position, Some(rest), "it is read nowhere near what it may have followed");
}
