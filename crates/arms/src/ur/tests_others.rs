//! Other programs, the pendant, and connections that break.

use std::io::Write;
use std::net::TcpStream;
use std::time::{Duration, Instant};

use serde_json::json;

use super::DOF;
use super::adapter::UrAdapter;
use super::emulator::UrEmulator;
use super::tests::{arm, positions, ready, stream, text, until};
use dimos_core::arm::StopPoint;
use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator};
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// Starts a program of another client, that of `ur_rtde`, which does nothing unless it is ordered to.
fn start_foreign_program(emulator: &UrEmulator) -> TcpStream {
    let address = emulator.address();
    let (host, first) = address.rsplit_once(':').unwrap();
    let mut script = TcpStream::connect((host, first.parse::<u16>().unwrap() + 2)).unwrap();
    script.write_all(b"def rtde_control():\n  sync()\nend\n").unwrap();
    let began = Instant::now();
    while emulator.program().as_deref() != Some("rtde_control") {
        assert!(began.elapsed() < Duration::from_secs(5));
        std::thread::sleep(Duration::from_millis(2));
    }
    script
}

#[test]
fn enabling_ends_no_program_of_another_client() {
    let (mut adapter, emulator) = ready(json!({}));
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    until(&mut adapter, |_| emulator.program().is_none());
    let _script = start_foreign_program(&emulator);
    for paused in [false, true] {
        if paused {
            emulator.press_pause();
        }
        until(&mut adapter, |adapter| adapter.state().unwrap().runtime == if paused { 4 } else { 2 });
        let refused = text(adapter.activate().unwrap_err());
        assert!(
            refused.starts_with("another program is on the controller")
                && refused.contains("\nhint: end it first: `dimos stop`"),
            "{refused}"
        );
        assert_eq!(emulator.program().as_deref(), Some("rtde_control"));
    }
    // An operator's stop ends it.
    adapter.write_stop(&StopPoint::default()).unwrap();
    until(&mut adapter, |_| emulator.program().is_none());
    adapter.activate().unwrap();
}

#[test]
fn a_program_that_a_lost_connection_left_ends_and_the_arm_is_enabled() {
    let (mut adapter, emulator) = ready(json!({}));
    adapter.disconnect();
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    stream(&mut adapter, 0.05);
}

#[test]
fn disabling_leaves_an_arm_that_another_program_has_taken_over() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.press_stop();
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    let _script = start_foreign_program(&emulator);
    until(&mut adapter, |adapter| adapter.state().unwrap().runtime == 2);
    assert_eq!(adapter.deactivate(&StopPoint::default()), Ok(()));
    let refused = text(adapter.write_enable(false).unwrap_err());
    assert_eq!(refused, "another program commands the arm\nhint: `dimos arm reset`, then disable it");
    assert_eq!((emulator.program().as_deref(), adapter.read_enabled()), (Some("rtde_control"), Ok(true)));
    adapter.write_clear_errors().unwrap();
    adapter.write_enable(false).unwrap();
    assert_eq!((emulator.program(), adapter.read_enabled()), (None, Ok(false)));
}

#[test]
fn a_paused_program_is_ended_before_a_protective_stop_is_released_whatever_bit_shows_it() {
    let (mut adapter, emulator) = ready(json!({}));
    stream(&mut adapter, 0.1);
    emulator.hide_paused_programs(true);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(153)).unwrap();
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 != 0);
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"));
    let mut cleared = Err(AdapterError::Busy);
    until(&mut adapter, |adapter| {
        cleared = adapter.write_clear_errors();
        cleared != Err(AdapterError::Busy)
    });
    cleared.unwrap();
    assert_eq!(emulator.program(), None, "it would continue");
}

#[test]
fn a_paused_program_is_reported_as_such() {
    let (mut adapter, emulator) = ready(json!({}));
    for hidden in [false, true] {
        emulator.hide_paused_programs(hidden);
        emulator.press_pause();
        until(&mut adapter, |adapter| adapter.foreign_change().is_some());
        assert_eq!(adapter.foreign_change(), Some("the program on the controller was paused"));
        adapter.write_stop(&StopPoint::default()).unwrap();
        until(&mut adapter, |_| emulator.program().is_none());
        adapter.activate().unwrap();
    }
}

#[test]
fn the_pendant_takes_control_and_the_arm_stops_with_its_state_still_read() {
    let (mut adapter, emulator) = ready(json!({}));
    stream(&mut adapter, 0.1);
    let began = Instant::now();
    emulator.set_remote_control(false);
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    let what = adapter.foreign_change().unwrap();
    assert_eq!(what, "the pendant took control, or the controller closed the primary interface");
    until(&mut adapter, |_| emulator.program().is_none());
    assert!(began.elapsed() < Duration::from_millis(700), "stopped by order, not by silence: {:?}", began.elapsed());
    assert!(adapter.is_connected());
    positions(&mut adapter);
    emulator.set_remote_control(true);
    adapter.activate().unwrap();
    stream(&mut adapter, 0.05);
}

#[test]
fn a_broken_dashboard_costs_neither_the_connection_nor_the_stop() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.break_dashboard(true);
    emulator.hang_program(true);
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed), "by the primary interface");
    assert_eq!(emulator.program(), None);
    assert!(adapter.is_connected());
    let refused = adapter.activate().unwrap_err();
    assert!(matches!(refused, AdapterError::Rejected(_) | AdapterError::Timeout(_)), "{refused:?}");
    assert!(adapter.is_connected());
    // It is not needed for a connection, either.
    adapter.disconnect();
    adapter.connect().unwrap();
    assert_eq!(adapter.get_info().serial_number, None);
}

#[test]
fn a_late_answer_of_the_dashboard_is_not_that_of_the_next_request() {
    let (mut adapter, emulator) = arm(json!({}));
    adapter.connect().unwrap();
    emulator.answer_late("close safety popup");
    let failed = adapter.activate().unwrap_err();
    assert!(matches!(failed, AdapterError::Timeout(_)), "{failed:?}");
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!((adapter.read_state().unwrap().state, adapter.is_connected()), (3, true), "power is off");
    adapter.activate().unwrap();
}

#[test]
fn the_outputs_are_claimed_only_when_one_is_set() {
    let (mut first, emulator) = ready(json!({}));
    let config =
        AdapterConfig { hardware_id: "other".into(), address: emulator.address(), dof: DOF, options: json!({}) };
    let mut second = UrAdapter::new(&config).unwrap();
    second.connect().unwrap();
    second.set_digital_output(3, true).unwrap();
    assert_eq!(emulator.outputs().0, 1 << 3);
    let refused = text(first.set_digital_output(1, true).unwrap_err());
    assert!(refused.starts_with("another RTDE client has the outputs\nhint: "), "{refused}");
    assert!(first.is_connected());
    second.disconnect();
    until(&mut first, |first| first.set_digital_output(1, true).is_ok());
    assert_eq!(emulator.outputs().0, 1 << 3 | 1 << 1);
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"));
}
