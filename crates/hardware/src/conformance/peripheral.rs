//! The conformance suite of peripherals: what every gripper and sensor with its own connection must do, against its
//! emulator. New rows of the table are tested without further code.

use std::time::{Duration, Instant};

use super::gripper::in_unit;
use crate::adapter::{AdapterError, Gripper};
use crate::peripheral::{Condition, Part, Peripheral, PeripheralSpec};
use crate::registry::{AdapterConfig, Emulator, EmulatorAddress, SIM};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::arm::{GripperInfo, GripperUnit};

/// Time for fingers to arrive and to be homed.
const MOVES: Duration = Duration::from_secs(10);
/// Time in which a device that is silent must count as lost.
const LOST: Duration = Duration::from_secs(3);
/// Period of readings.
const PERIOD: Duration = Duration::from_millis(10);

/// A requirement on every peripheral.
#[derive(Debug, Clone, Copy)]
pub struct PeripheralCheck {
    /// Its name.
    pub name: &'static str,
    /// The requirement in one sentence.
    pub about: &'static str,
    run: fn(&mut Bench) -> Result<(), String>,
}

/// All checks, in reading order.
pub const CHECKS: &[PeripheralCheck] = &[
    check("connects_again", "it connects, disconnects and connects again", connects_again),
    check("nothing_before_connect", "before that it knows nothing and does nothing", nothing_before_connect),
    check("connecting_moves_nothing", "connecting and reading move nothing", connecting_moves_nothing),
    check("unhomed_refuses", "a gripper that is not homed refuses commands, and says what to do", unhomed_refuses),
    check("gripper_moves", "fingers go where they are sent, and nowhere outside of their range", gripper_moves),
    check("damage_is_survived", "a lost or damaged answer is no lost device", damage_is_survived),
    check("silence_is_lost", "a silent device is lost within 3 s, and nothing is known of it", silence_is_lost),
    check("comes_back", "it connects again after a loss of power", comes_back),
];

const fn check(name: &'static str, about: &'static str, run: fn(&mut Bench) -> Result<(), String>) -> PeripheralCheck {
    PeripheralCheck { name, about, run }
}

/// Runs a check on a row, with these options, against its emulator. The error says what is wrong.
pub fn run(row: &PeripheralSpec, options: &serde_json::Value, check: &PeripheralCheck) -> Result<(), String> {
    let mut bench = Bench::new(row, options)?;
    let result = (check.run)(&mut bench);
    bench.device.disconnect();
    result.map_err(|what| format!("{}: {what}", check.name))
}

/// A device and its emulator.
struct Bench {
    part: Part,
    device: Box<dyn Peripheral>,
    emulator: Box<dyn Emulator>,
}

fn require(so: bool, what: impl FnOnce() -> String) -> Result<(), String> {
    if so { Ok(()) } else { Err(what()) }
}

impl Bench {
    fn new(row: &PeripheralSpec, options: &serde_json::Value) -> Result<Self, String> {
        let config = |address: &str| AdapterConfig {
            hardware_id: "arm".into(),
            address: address.into(),
            dof: 0,
            options: options.clone(),
        };
        let text = |e: AdapterError| e.to_string();
        let emulate = row.emulate.ok_or("it has no emulator")?;
        let emulator = emulate(&config(SIM), &EmulatorAddress::InProcess).map_err(text)?;
        let device = (row.create)(&config(&emulator.address())).map_err(text)?;
        Ok(Self { part: row.part, device, emulator })
    }

    fn connect(&mut self) -> Result<(), String> {
        self.device.connect().map(drop).map_err(|e| format!("connect: {e}"))
    }

    fn read(&mut self) -> Result<(), String> {
        self.device.read().map_err(|e| format!("read: {e}"))
    }

    fn gripper(&mut self) -> Result<&mut dyn Gripper, String> {
        self.device.gripper().ok_or_else(|| "it is a gripper and has none".to_owned())
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.emulator.inject(fault)
    }

    /// Reads until something is so.
    fn until(&mut self, what: &str, mut is_so: impl FnMut(&mut Self) -> Result<bool, String>) -> Result<(), String> {
        let limit = Instant::now() + MOVES;
        while !is_so(self)? {
            require(Instant::now() < limit, || format!("not within {MOVES:?}: {what}"))?;
            std::thread::sleep(PERIOD);
            self.read()?;
        }
        Ok(())
    }

    /// Connects, and homes it if it needs that.
    fn ready(&mut self) -> Result<(), String> {
        self.connect()?;
        self.read()?;
        if self.device.condition() == Condition::NotHomed {
            self.device.home().map_err(|e| format!("home: {e}"))?;
            self.until("it is homed", |bench| Ok(bench.device.condition() == Condition::Ready))?;
        }
        Ok(())
    }

    /// Returns whether something is known of its part.
    fn knows(&mut self) -> Result<bool, String> {
        let text = |e: AdapterError| e.to_string();
        if let Some(gripper) = self.device.gripper() {
            return Ok(gripper.read_gripper_position().map_err(text)?.is_some());
        }
        let sensor = self.device.force_torque().ok_or("it has neither a gripper nor a sensor")?;
        Ok(sensor.read_force_torque().map_err(text)?.is_some())
    }
}

fn connects_again(bench: &mut Bench) -> Result<(), String> {
    bench.device.disconnect();
    for _ in 0..3 {
        bench.connect()?;
        require(bench.device.is_connected(), || "connected, and not".to_owned())?;
        bench.read()?;
        bench.device.disconnect();
        bench.device.disconnect();
        require(!bench.device.is_connected(), || "disconnected, and still connected".to_owned())?;
    }
    Ok(())
}

fn nothing_before_connect(bench: &mut Bench) -> Result<(), String> {
    require(!bench.device.is_connected(), || "it is connected when it is created".to_owned())?;
    require(bench.device.read().is_err(), || "it reads without a connection".to_owned())?;
    require(!bench.knows()?, || "it knows its state without a connection".to_owned())?;
    match bench.part {
        Part::Gripper => {
            let gripper = bench.gripper()?;
            let open = gripper.get_gripper_range().ok_or("its range is not known before it is connected")?.1;
            require(gripper.write_gripper_position(open).is_err(), || "a command without a connection is taken".into())
        }
        Part::ForceTorque => require(bench.device.force_torque().is_some(), || "it has no sensor".to_owned()),
    }
}

fn connecting_moves_nothing(bench: &mut Bench) -> Result<(), String> {
    let before = bench.emulator.truth();
    bench.connect()?;
    for _ in 0..30 {
        std::thread::sleep(PERIOD);
        bench.read()?;
    }
    require(bench.emulator.truth() == before, || "it has moved".to_owned())
}

fn unhomed_refuses(bench: &mut Bench) -> Result<(), String> {
    bench.connect()?;
    bench.read()?;
    if bench.part != Part::Gripper || bench.device.condition() != Condition::NotHomed {
        return Ok(());
    }
    let before = bench.emulator.truth();
    let open = bench.gripper()?.info().range.map_or(0.0, |(_, open)| open);
    let refused = bench.gripper()?.command(open, None, None);
    let hinted = matches!(&refused, Err(AdapterError::Rejected(text)) if text.contains("\nhint: "));
    require(hinted, || format!("a command gives {refused:?}"))?;
    std::thread::sleep(Duration::from_millis(200));
    require(bench.emulator.truth() == before, || "it has moved".to_owned())
}

fn gripper_moves(bench: &mut Bench) -> Result<(), String> {
    if bench.part != Part::Gripper {
        return Ok(());
    }
    bench.ready()?;
    let info: GripperInfo = bench.gripper()?.info();
    let (closed, open) = info.range.ok_or("its range is unknown")?;
    require(info.unit != GripperUnit::OnOff, || "its fingers are measured, or its unit says not".to_owned())?;
    let same = in_unit(info.unit, 0.001);
    for share in [0.75, 0.25, 1.0, 0.0, 0.5] {
        let target = closed + share * (open - closed);
        bench.gripper()?.command(target, None, None).map_err(|e| format!("to {target}: {e}"))?;
        bench.until("the fingers are there", |bench| {
            let at = bench.gripper()?.read_gripper_position().map_err(|e| e.to_string())?;
            Ok(at.is_some_and(|at| (at - target).abs() < same))
        })?;
        let truth = bench.emulator.truth().gripper_position.unwrap_or(target);
        require((truth - target).abs() < 2.0 * same, || format!("sent to {target}, truly at {truth}"))?;
    }
    let away = (open - closed) / 2.0;
    for wrong in [closed - away, open + away, f64::NAN] {
        let taken = bench.gripper()?.command(wrong, None, None);
        require(taken.is_err(), || format!("a position of {wrong} is taken"))?;
    }
    let force = bench.gripper()?.command(closed, Some(info.force_range.map_or(1.0, |(_, most)| most * 1.1)), None);
    require(force.is_err(), || "a force outside the range is taken".to_owned())
}

fn damage_is_survived(bench: &mut Bench) -> Result<(), String> {
    bench.connect()?;
    for kind in [FaultKind::Silent, FaultKind::Garbage, FaultKind::Corrupt, FaultKind::Truncated] {
        if bench.inject(Fault::new(kind)).is_err() {
            continue;
        }
        // One of two readings may fail.
        let read = (0..2).any(|_| bench.device.read().is_ok());
        require(read && bench.device.is_connected(), || format!("{} is a lost device", kind.name()))?;
    }
    Ok(())
}

fn silence_is_lost(bench: &mut Bench) -> Result<(), String> {
    bench.connect()?;
    bench.inject(Fault::new(FaultKind::Silent).lasting(60.0))?;
    let limit = Instant::now() + LOST;
    while bench.device.is_connected() {
        require(bench.device.read().is_err(), || "it reads what was not sent".to_owned())?;
        require(Instant::now() < limit, || "it counts as connected".to_owned())?;
    }
    bench.device.disconnect();
    require(!bench.knows()?, || "its last state counts as known".to_owned())
}

fn comes_back(bench: &mut Bench) -> Result<(), String> {
    bench.connect()?;
    bench.inject(Fault::new(FaultKind::PowerLoss).lasting(1.0))?;
    while bench.device.read().is_ok() {}
    bench.device.disconnect();
    let limit = Instant::now() + MOVES;
    while bench.device.connect().is_err() {
        require(Instant::now() < limit, || format!("not within {MOVES:?}"))?;
    }
    bench.read()
}
