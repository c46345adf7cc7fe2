//! All arms of a run: their locks, emulators and device threads, brought up and released together.

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::device_lock::{self, DeviceLock, DeviceLockError};
use super::peripherals::{self, ArmPeripherals};
use super::serial_locks::SerialLocks;
use crate::blueprint::{Arm, Blueprint, JointOverride, OnExit, TickClock};
use crate::runtime::StartError;
use dimos_core::arm::{ArmCommand, ArmState};
use dimos_core::clock::MonotonicClock;
use dimos_core::joint::JointLimits;
use dimos_core::message::Message;
use dimos_hardware::adapter::AdapterError;
use dimos_hardware::device::{Connected, Device, DeviceConfig, Note, Setup};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress, SIM};
use dimos_hardware::transport::serial_ports;
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::slot::{SlotReader, SlotWriter, slot};
use dimos_rt::wake::Wake;

/// Timeout for an adapter to connect, with some margin for this computer.
const CONNECT_LIMIT: Duration = Duration::from_millis(3_500);
/// Timeout for enabling an arm.
const ENABLE_LIMIT: Duration = Duration::from_secs(10);
/// Timeout for releasing all arms.
const RELEASE_LIMIT: Duration = Duration::from_secs(2);

/// The arms of a run. Released when dropped.
pub struct Arms {
    /// Their device threads, in the blueprint's order.
    pub devices: Vec<Arc<Device>>,
    /// Per arm, its peripherals. Their threads end after those of the arms.
    pub peripherals: Vec<Arc<ArmPeripherals>>,
    /// Raised with each new state of the arm that clocks the ticks.
    pub pace: Option<Wake>,
    disable: Vec<bool>,
    // Dropped after the device threads; the locks last.
    _emulators: Vec<Box<dyn Emulator>>,
    _locks: Vec<DeviceLock>,
    /// Their serial numbers.
    pub serials: Arc<SerialLocks>,
}

/// The tick's ends of the slots.
#[derive(Default)]
pub struct Slots {
    /// States.
    pub states: Vec<SlotReader<ArmState>>,
    /// Commands.
    pub commands: Vec<SlotWriter<ArmCommand>>,
}

/// Result of connecting.
pub struct BroughtUp {
    /// The arms.
    pub arms: Arms,
    /// The tick's ends of the slots.
    pub slots: Slots,
    /// Information that each arm reported, and its effective limits.
    pub connected: Vec<(Connected, JointLimits)>,
}

/// Connects all arms in parallel. If one fails, the others are released again. In a closed world of runs they are of
/// this computer, and may share serial numbers.
pub fn bring_up(
    blueprint: &Blueprint,
    is_closed: bool,
    beat: &Arc<Heartbeat>,
    note: impl Fn(usize, Note) + Clone + Send + 'static,
) -> Result<BroughtUp, StartError> {
    let period = Duration::from_secs_f64(1.0 / blueprint.coordinator.tick_rate);
    let mut arms = Arms {
        devices: Vec::new(),
        peripherals: Vec::new(),
        pace: None,
        disable: Vec::new(),
        _emulators: Vec::new(),
        _locks: Vec::new(),
        serials: Arc::new(SerialLocks::new(is_closed)),
    };
    let mut slots = Slots::default();
    for (index, arm) in blueprint.arms.iter().enumerate() {
        let config = configure(&blueprint.arms, index, is_closed, &mut arms)?;
        let adapter = (arm.adapter.create)(&config).map_err(|e| unfit(arm, &e))?;
        let address = config.address;
        let (state_writer, state_reader) = slot(ArmState::default());
        let (command_writer, command_reader) = slot(ArmCommand::default());
        let (own, ports) = {
            let (emulators, locks, note) = (&mut arms._emulators, &mut arms._locks, note.clone());
            peripherals::start(arm, is_closed, (emulators, locks), move |what| note(index, what))?
        };
        arms.peripherals.push(Arc::new(own));
        let note = note.clone();
        let clocks = blueprint.coordinator.clock == TickClock::Device(arm.hardware_id.clone());
        if clocks {
            let no_event = |e| StartError::other(format!("no eventfd: {e}"), "see ulimit -n");
            arms.pace = Some(Wake::new().map_err(no_event)?);
        }
        let device = DeviceConfig {
            hardware_id: arm.hardware_id.clone(),
            dof: arm.joints.len(),
            usb: Box::new(move || serial_ports::usb_at(&address)),
            tick_period: period,
            native_rate: arm.adapter.native_rate,
            supervision: arm.supervision,
            setup: Setup {
                tool_velocity: arm.tcp_velocity,
                efforts: arm.effort.as_ref().map(|effort| effort.limits),
                ..arm.setup
            },
            peripherals: ports,
            beat: beat.clone(),
            pace: arms.pace.clone().filter(|_| clocks),
            clock: Arc::new(MonotonicClock),
            notes: Box::new(move |what| note(index, what)),
        };
        let thread = |e| StartError::other(format!("no device thread for {}: {e}", arm.hardware_id), "see ulimit -u");
        arms.devices.push(Arc::new(Device::spawn(device, adapter, state_writer, command_reader).map_err(thread)?));
        // An arm that is not parked is left as one without `on_exit` is.
        let unparked = arm.on_exit == OnExit::Park && arm.adapter.holds_when_disabled;
        arms.disable.push(arm.on_exit == OnExit::Disable || unparked);
        slots.states.push(state_reader);
        slots.commands.push(command_writer);
    }
    let mut own: Vec<_> = arms.peripherals.iter().map(|own| own.connect()).collect();
    let answers: Vec<_> = arms.devices.iter().map(|d| d.connect()).collect();
    let limit = Instant::now() + CONNECT_LIMIT;
    let results: Vec<_> =
        answers.into_iter().map(|a| a.wait(limit.saturating_duration_since(Instant::now()))).collect();
    for (arm, answers) in blueprint.arms.iter().zip(&mut own) {
        peripherals::connected(arm, answers, limit)?;
    }
    let mut connected = Vec::new();
    for (arm, result) in blueprint.arms.iter().zip(results) {
        let brought = result.map_err(|e| hardware(arm, &e)).and_then(|c| {
            let limits = effective_limits(arm, &c.limits)?;
            Ok((c, limits))
        });
        match brought {
            Ok(pair) => {
                if let Some(device) = arms.devices.get(connected.len()) {
                    // Handled before any command: the thread takes its orders in turn.
                    drop(device.set_limits(pair.1.clone()));
                }
                connected.push(pair);
            }
            Err(error) => return Err(error),
        }
    }
    for (index, (arm, (about, _))) in blueprint.arms.iter().zip(&connected).enumerate() {
        let Some(serial) = &about.info.serial_number else { continue };
        arms.serials.take(index, arm, &about.info, serial).map_err(|holder| {
            let (what, hint) = holder.describe(&arm.hardware_id, &blueprint.arms, serial);
            StartError::Hardware { arm: arm.hardware_id.clone(), what, hint: hint.to_owned() }
        })?;
    }
    Ok(BroughtUp { arms, slots, connected })
}

/// Locks the device or starts its emulator. Returns the adapter's configuration.
fn configure(all: &[Arm], index: usize, is_closed: bool, arms: &mut Arms) -> Result<AdapterConfig, StartError> {
    let Some((arm, before)) = all.get(index).zip(all.get(..index)) else {
        return Err(StartError::other("no such arm", "this is a defect of the program"));
    };
    let mut config = AdapterConfig {
        hardware_id: arm.hardware_id.clone(),
        address: arm.address.clone(),
        dof: arm.joints.len(),
        options: arm.options.clone(),
    };
    match arm.adapter.emulate {
        Some(emulate) if arm.address == SIM => {
            let mut whole = config.clone();
            let has_body = embody(arm, &mut whole.options)?;
            let emulator = emulate(&whole, &EmulatorAddress::InProcess).map_err(|error| match &error {
                AdapterError::Rejected(_) if has_body => {
                    let (what, hint) = Message::of(&error).or_hint("run with --sim: joints without mass".to_owned());
                    StartError::Blueprint { what: format!("{}: {what}", arm.hardware_id), hint }
                }
                error => unfit(arm, error),
            })?;
            config.address = emulator.address();
            arms._emulators.push(emulator);
        }
        _ if arm.address.is_empty() || arm.address == SIM => {}
        _ => {
            let address = full_address(arm);
            let is_there = |other: &&Arm| {
                let has_lock = !other.address.is_empty() && other.address != SIM;
                has_lock && device_lock::is_same_place(&full_address(other), &address)
            };
            let same = || before.iter().filter(is_there);
            let beside = |other: &Arm| arm.line.zip(other.line).is_some_and(|(own, line)| own.is_beside(&line));
            if same().next().is_some() && same().all(beside) {
                return Ok(config); // the first arm of the line has its lock
            }
            let lock = device_lock::take(&arm.adapter_type, &address, is_closed).map_err(|e| {
                let (what, hint) = match same().next().filter(|_| matches!(e, DeviceLockError::By { .. })) {
                    Some(same) => {
                        let what =
                            format!("{} at {address} is the arm {} of this run", arm.adapter_type, same.hardware_id);
                        (what, "give each arm its own address")
                    }
                    None => (e.to_string(), e.hint()),
                };
                StartError::Hardware { arm: arm.hardware_id.clone(), what, hint: hint.to_owned() }
            })?;
            arms._locks.push(lock);
        }
    }
    Ok(config)
}

/// Gives the emulator of an arm its body, if it has one. Returns whether it has.
fn embody(arm: &Arm, options: &mut serde_json::Value) -> Result<bool, StartError> {
    let scene = arm.scene().map_err(|what| {
        let hint = format!("see `hardware.{}.model_path`, or run with --sim: joints without mass", arm.hardware_id);
        StartError::Blueprint { what: format!("{} has no body: {what}", arm.hardware_id), hint }
    })?;
    let place = options.pointer_mut("/sim/physics").and_then(|physics| physics.as_object_mut());
    let Some((place, scene)) = place.zip(scene) else { return Ok(false) };
    place.insert("scene".to_owned(), serde_json::json!(scene));
    Ok(true)
}

/// Returns the complete address of an arm's device.
pub fn full_address(arm: &Arm) -> String {
    // The blueprint was checked: an address that cannot be completed stays as it is.
    (arm.adapter.address.check)(&arm.address).unwrap_or_else(|_| arm.address.clone())
}

/// Creates the error of contradictory settings of an arm. No arm was contacted yet, so the hint about power is absent.
fn unfit(arm: &Arm, error: &AdapterError) -> StartError {
    if !matches!(error, AdapterError::Rejected(_)) {
        return hardware(arm, error);
    }
    let id = &arm.hardware_id;
    let general = format!("see `hardware.{id}.joints` and `hardware.{id}.options` in the blueprint");
    let (what, hint) = Message::of(error).or_hint(general);
    StartError::Hardware { arm: id.clone(), what, hint }
}

fn hardware(arm: &Arm, error: &AdapterError) -> StartError {
    let (id, form) = (&arm.hardware_id, arm.adapter.address.form);
    let general = match arm.adapter.emulate {
        Some(_) => format!(
            "is it powered, and is `hardware.{id}.address` right ({form})? To try without it: --address {id}=sim"
        ),
        None => format!("see `hardware.{id}` in the blueprint"),
    };
    let (what, hint) = Message::of(error).or_hint(general);
    StartError::Hardware { arm: id.clone(), what, hint }
}

/// Returns the arm's own limits, narrowed by the blueprint, with defaults for missing ones.
fn effective_limits(arm: &Arm, own: &JointLimits) -> Result<JointLimits, StartError> {
    let mut limits = own.clone().with_defaults();
    let narrow = |list: &mut Vec<f64>, j: usize, value: Option<f64>, higher: bool| {
        if let (Some(old), Some(new)) = (list.get_mut(j), value) {
            *old = if higher { old.max(new) } else { old.min(new) };
        }
    };
    for (j, JointOverride { position_lower, position_upper, velocity, acceleration, jerk, .. }) in
        arm.limits.iter().enumerate()
    {
        narrow(&mut limits.position_lower, j, *position_lower, true);
        narrow(&mut limits.position_upper, j, *position_upper, false);
        narrow(&mut limits.velocity_max, j, *velocity, false);
        // Where the arm states no acceleration or jerk, the blueprint's replaces the default.
        for (list, stated, value) in [
            (&mut limits.acceleration_max, own.acceleration_max.is_empty(), *acceleration),
            (&mut limits.jerk_max, own.jerk_max.is_empty(), *jerk),
        ] {
            match (list.get_mut(j), value) {
                (Some(old), Some(new)) if stated => *old = new,
                (Some(old), Some(new)) => *old = old.min(new),
                _ => {}
            }
        }
    }
    let usable = (0..arm.joints.len()).all(|j| {
        let at = |list: &[f64]| list.get(j).copied().filter(|v| v.is_finite());
        let range = at(&limits.position_lower).zip(at(&limits.position_upper)).is_some_and(|(l, u)| l < u);
        range
            && [&limits.velocity_max, &limits.acceleration_max, &limits.jerk_max]
                .iter()
                .all(|l| at(l).is_some_and(|v| v > 0.0))
    });
    if usable {
        return Ok(limits);
    }
    Err(StartError::Hardware {
        arm: arm.hardware_id.clone(),
        what: "the joint limits it reports leave no room to move".to_owned(),
        hint: format!("`dimos check` shows them; see `hardware.{}.limits`", arm.hardware_id),
    })
}

impl Arms {
    /// Enables the given arms in parallel. Returns the first error.
    pub fn enable(&self, blueprint: &Blueprint, which: impl Iterator<Item = usize>) -> Result<(), StartError> {
        let answers: Vec<_> = which.filter_map(|i| Some((i, self.devices.get(i)?.activate()))).collect();
        for (i, answer) in answers {
            if let (Err(e), Some(arm)) = (answer.wait(ENABLE_LIMIT), blueprint.arms.get(i)) {
                let id = &arm.hardware_id;
                let general = format!(
                    "clear the arm's own error, or start without motors: --set hardware.{id}.auto_enable=false"
                );
                let (what, hint) = Message::of(format!("cannot be enabled: {e}")).or_hint(general);
                return Err(StartError::Hardware { arm: id.clone(), what, hint });
            }
        }
        Ok(())
    }

    /// Disables this arm when it is released: it is parked.
    pub fn disable_at_release(&mut self, arm: usize) {
        self.disable.iter_mut().skip(arm).take(1).for_each(|disable| *disable = true);
    }

    /// Ends commanded motion, disables arms with `on_exit: disable` and those that are parked, disconnects. Returns the
    /// problems, each with the name of its arm.
    pub fn release(&mut self) -> Vec<(String, String)> {
        let answers: Vec<_> = self.devices.iter().zip(&self.disable).map(|(d, disable)| d.finish(*disable)).collect();
        let limit = Instant::now() + RELEASE_LIMIT;
        let mut troubles = Vec::new();
        for (device, answer) in self.devices.iter().zip(answers) {
            if let Err(e) = answer.wait(limit.saturating_duration_since(Instant::now())) {
                let name = device.hardware_id();
                troubles.push((name.to_owned(), format!("{name}: could not be released as planned: {e}")));
            }
        }
        self.devices.clear();
        self.peripherals.drain(..).for_each(|own| own.finish());
        troubles
    }
}

impl Drop for Arms {
    fn drop(&mut self) {
        for (_, trouble) in self.release() {
            tracing::warn!("{trouble}");
        }
    }
}
