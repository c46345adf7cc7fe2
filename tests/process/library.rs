//! Runs inside of a program, where the examples of docs/library.md say nothing.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use dimos::control::task_spec::TaskTable;
use dimos::rpc::Code;
use dimos::rpc::api::Move;
use dimos::rpc::run_dir::RunDir;
use dimos::rpc::server::streams::{Stream, Subscribe};
use dimos::runtime::{Builder, Ending, Options, Record, Run, StartError};

fn mock(folder: &Path) -> Builder {
    Run::from_name("coordinator-mock").unwrap().record(Record::Off).folder(RunDir::closed(folder))
}

#[test]
fn a_run_that_is_dropped_is_stopped() {
    let folder = tempfile::tempdir().unwrap();
    let run = mock(folder.path()).start().unwrap();
    assert!(run.socket().unwrap().exists());
    let handle = run.handle();
    let motion = handle.move_arm("arm", &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.1).unwrap().motion;
    drop(run);
    assert!(RunDir::closed(folder.path()).runs().unwrap().is_empty());
    // Who still has a handle is refused, and does not wait for ever.
    assert_eq!(handle.move_arm("arm", &[0.0; 7], 0.5).unwrap_err().code, Code::ShuttingDown);
    assert!(handle.wait(motion).map_or_else(|e| e.code == Code::ShuttingDown, |report| report.state == "ABORTED"));
    assert!(handle.stop_arms().is_err());
    // And its name is free.
    mock(folder.path()).start().unwrap().stop();
}

#[test]
fn errors_are_reported_before_anything_is_connected() {
    let Err(error) = Run::from_name("coordinator-mokc") else { panic!("there is none") };
    assert!(error.hint.contains("coordinator-mock"), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let wrong = mock(folder.path()).set("coordinator.tick_rate", -5);
    assert_eq!(wrong.check().errors(), 1);
    match wrong.start() {
        Err(StartError::Blueprint { what, .. }) => assert!(what.contains("tick_rate"), "{what}"),
        other => panic!("{:?}", other.map(|_| ()).err()),
    }
    let first = mock(folder.path()).start().unwrap();
    match mock(folder.path()).start() {
        Err(error @ StartError::Other { .. }) => assert!(error.to_string().contains("live already"), "{error}"),
        other => panic!("{:?}", other.map(|_| ()).err()),
    }
    first.stop();
}

#[test]
fn calls_are_checked_as_over_the_socket() {
    let folder = tempfile::tempdir().unwrap();
    let run = mock(folder.path()).start().unwrap();
    let code = |target: &[f64], speed| run.move_arm("arm", target, speed).unwrap_err().code;
    assert_eq!(code(&[f64::NAN; 7], 0.5), Code::InvalidParams);
    assert_eq!(code(&[], 0.5), Code::InvalidParams);
    assert_eq!(code(&[0.0; 7], 7.0), Code::InvalidParams);
    let unknown = run.reset("amr").unwrap_err();
    assert_eq!((unknown.code, unknown.hint.as_deref()), (Code::UnknownArm, Some("did you mean `arm`?")));
    assert_eq!(run.servo("traj_arm", &[0.0; 7]).unwrap_err().code, Code::WrongTask);
    let stream = Subscribe::to(Stream::Events);
    assert_eq!(run.call(stream).unwrap_err().code, Code::UnknownMethod, "streams are on the socket");
}

#[test]
fn a_handle_may_be_used_on_a_thread_of_an_async_program() {
    let folder = tempfile::tempdir().unwrap();
    let run = mock(folder.path()).start().unwrap();
    let handle = run.handle();
    let asynchronous = tokio::runtime::Builder::new_current_thread().build().unwrap();
    let moved = asynchronous.block_on(async move {
        let target = vec![0.05; 7];
        handle.call(Move::new("arm", target, 1.0))
    });
    assert_eq!(run.wait(moved.unwrap().motion).unwrap().state, "COMPLETED");
}

#[test]
fn waiting_for_a_motion_ends_with_an_error_when_the_tick_hangs() {
    let folder = tempfile::tempdir().unwrap();
    let hung = Arc::new(AtomicBool::new(false));
    let flag = hung.clone();
    let probe = move |_| {
        if flag.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_secs(20));
        }
    };
    let options = Options {
        name: Some(format!("hung-{}", std::process::id())),
        record: Record::Off,
        probe: Some(Box::new(probe)),
        hold_latency: false,
        ..Options::default()
    };
    let loaded = mock(folder.path()).check();
    let run = Run::start(loaded.blueprint.as_ref().unwrap(), options).unwrap();
    let motion = run.move_arm("arm", &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 0.1).unwrap().motion;
    hung.store(true, Ordering::Relaxed);
    let error = run.wait(motion).unwrap_err();
    assert!(error.code == Code::NoAnswer && error.message.contains("no tick for"), "{error}");
}

#[test]
fn another_thread_can_end_a_run() {
    let folder = tempfile::tempdir().unwrap();
    let run = mock(folder.path()).start().unwrap();
    let endings = run.endings();
    std::thread::spawn(move || endings.send(Ending::Asked));
    assert_eq!(run.wait_for_end(None), Ending::Asked);
    assert!(run.stop().troubles.is_empty());
}

#[path = "../../docs/examples/joystick.rs"]
mod joystick;

#[test]
fn a_task_type_of_another_crate_moves_an_arm_and_its_log_is_verified_with_its_row_only() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("stick.mcap");
    let blueprint = "
hardware:
  - {hardware_id: arm, adapter_type: mock, joints: {prefix: arm, count: 2}}
tasks:
  - {name: stick, type: joystick, joint_names: {hardware: arm}, params: {timeout: 0.5}}
";
    let of = |name: &str| Run::from_yaml(name, blueprint).folder(RunDir::closed(folder.path()));
    match of("without").record(Record::Off).start() {
        Err(StartError::Blueprint { what, .. }) => assert!(what.contains("no task type `joystick`"), "{what}"),
        other => panic!("{:?}", other.map(|_| ()).err()),
    }
    let run = of("with").tasks(&[joystick::SPEC]).record(Record::To(log.clone())).start().unwrap();
    let task = &run.status().tasks[0];
    assert_eq!((task.kind.as_str(), &task.takes[..]), ("joystick", &["velocity".to_owned()][..]));
    assert_eq!(run.servo("stick", &[0.0; 2]).unwrap_err().code, Code::WrongTask);
    for _ in 0..50 {
        run.velocity("stick", &[0.4, 0.0]).unwrap();
        std::thread::sleep(Duration::from_millis(10));
    }
    let moved = run.state().arms[0].joints[0].position.unwrap();
    assert!(moved > 0.02, "{moved}");
    run.stop();
    let found = dimos::replay::verify::verify(&log, &TaskTable::with(&[joystick::SPEC])).unwrap();
    assert_eq!(found.finding, dimos::replay::verify::Finding::Reproducible);
    let refused = dimos::replay::verify::verify(&log, &TaskTable::builtin()).unwrap_err().to_string();
    assert!(refused.contains("no task type `joystick`"), "{refused}");
}

#[test]
fn a_motion_in_several_parts_ends_with_the_first_stop() {
    let folder = tempfile::tempdir().unwrap();
    let run = mock(folder.path()).start().unwrap();
    let parts = run.until_interrupted();
    let first = parts.move_arm("arm", &[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0).unwrap();
    assert_eq!(run.wait(first.motion).unwrap().state, "COMPLETED");
    run.stop_arms().unwrap();
    run.reset("arm").unwrap();
    run.enable("arm").unwrap();
    let refused = parts.move_arm("arm", &[0.0; 7], 1.0).unwrap_err();
    assert_eq!(refused.code, Code::Superseded, "{refused}");
    assert!(refused.message.contains("stopped by an operator"), "{refused}");
    run.move_arm("arm", &[0.0; 7], 1.0).unwrap();
}
