//! The servo vendor's own SDK: it uses the emulated servos of an SO-101, and its bytes are the adapter's.

use std::path::Path;
use std::process::{Command, Stdio};

use dimos::arms::so101::protocol::{Instruction, MAX_INSTRUCTION, SERVOS, encode};

use crate::support::program::Home;
use crate::support::python::python_with;

/// Runs `tests/python/feetech_sdk.py`; `None` where the SDK is not installed.
fn sdk(argument: &str) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/feetech_sdk.py");
    let mut command = Command::new(python_with(&["scservo_sdk"])?);
    let output = command.arg(script).arg(argument).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::null()).output();
    let output = output.unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}");
    Some(out.into_owned())
}

#[test]
fn the_vendors_sdk_uses_the_emulated_servos() {
    let home = Home::new();
    let emulator = home.start("adapter emulate so101 --pty");
    emulator.until("check it");
    let said = emulator.out() + &emulator.err();
    let path = said.split_whitespace().find(|word| word.starts_with("/dev/pts/")).expect("its line");
    let Some(said) = sdk(path) else { return };
    assert_eq!(said, "all is as it says\n");
}

#[test]
fn the_adapters_instructions_are_the_sdks() {
    let Some(theirs) = sdk("frames") else { return };
    let goals: Vec<u8> = (1..=SERVOS as u16).flat_map(|servo| (100 * servo).to_le_bytes()).collect();
    let ours = [
        Instruction::Ping(1),
        Instruction::Read(3, 9, 4),
        Instruction::ReadAll(1, 40, 31),
        Instruction::ReadAll(1, 56, 2),
        Instruction::WriteAll(1, 42, 2, &goals),
    ];
    let ours = ours.map(|instruction| {
        let mut frame = [0; MAX_INSTRUCTION];
        encode(instruction, &mut frame).iter().map(|byte| format!("{byte:02x}")).collect::<String>()
    });
    assert_eq!(theirs.lines().collect::<Vec<_>>(), ours);
}
