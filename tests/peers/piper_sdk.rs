//! The vendor's own SDK (piper_sdk, in its own Python process) against the emulator, over slcan on a
//! pseudo-terminal: the same program that talks to an arm reads the emulator's state and moves it.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use dimos::arms::piper::GripperKind;
use dimos::arms::piper::emulator::{PiperEmulator, SimOptions};
use dimos::hardware::registry::{Emulator, EmulatorAddress};

use crate::support::python::python_with;

/// The longest that the SDK's script may take.
const TIMEOUT: Duration = Duration::from_secs(90);
/// The SDK is Python: it keeps up with this many states a second, also on a busy machine [Hz].
const RATE: f64 = 50.0;

/// Runs `tests/python/NAME` with the SDK; its output, or `None` where the SDK is not installed.
fn python(name: &str, arguments: &[&str]) -> Option<String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = python_with(&["piper_sdk", "serial"])?;
    let mut child = Command::new(python)
        .arg(root.join("tests/python").join(name))
        .args(arguments)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let end = Instant::now() + TIMEOUT;
    while child.try_wait().unwrap().is_none() {
        if Instant::now() > end {
            let _ = child.kill();
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    let output = child.wait_with_output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{name}: {}\n{out}\n{err}", output.status);
    Some(out.into_owned())
}

#[test]
fn the_vendors_sdk_reads_the_emulator_and_moves_it() {
    let options = SimOptions { feedback_hz: RATE, firmware: "S-V1.6-3".into(), ..SimOptions::default() };
    let emulator = PiperEmulator::with(&options, GripperKind::Small, &EmulatorAddress::Pty).unwrap();
    let address = emulator.address();
    let path = address.strip_prefix("slcan:").unwrap().split('@').next().unwrap();
    emulator.record();
    let Some(said) = python("piper_sdk_moves.py", &[path]) else { return };
    assert!(said.ends_with("all is as it says\n"), "{said}");
    // What the SDK believes is also true. It ends with the motors off: the other joints have fallen since.
    let (joints, _) = emulator.joints();
    for (joint, should) in [(0, 20.0), (3, 5.0), (5, -10.0)] {
        assert!((joints[joint].to_degrees() - should).abs() < 0.05, "{joints:?}");
    }
    assert!(!emulator.enabled());
    assert_eq!(emulator.power_drops(), 0);
    let ids: Vec<u16> = emulator.trace().iter().map(|(_, frame)| frame.id).collect();
    for id in [0x472, 0x4AF, 0x471, 0x151, 0x155, 0x156, 0x157, 0x159, 0x475, 0x152, 0x153, 0x154] {
        assert!(ids.contains(&id), "the SDK never sent {id:#x}");
    }
}
