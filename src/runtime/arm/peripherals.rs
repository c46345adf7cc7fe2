//! Grippers and sensors of the arms with their own connections: started and ended with their arms, homed, reported.

use std::time::{Duration, Instant};

use super::arm_requests::{order, refused};
use super::device_lock::{self, DeviceLock};
use crate::blueprint::{Arm, ArmPeripheral};
use crate::runtime::{Service, StartError, internal};
use dimos_core::arm::Link;
use dimos_core::clock::MonotonicClock;
use dimos_core::message::Message;
use dimos_core::telemetry::Phase;
use dimos_core::telemetry::describe::Severity;
use dimos_hardware::adapter::AdapterError;
use dimos_hardware::device::{Answer, Note, PeripheralConfig, PeripheralDevice, Ports};
use dimos_hardware::peripheral::{Condition, Part, PeripheralInfo};
use dimos_hardware::registry::{Emulator, EmulatorAddress};
use dimos_rpc::api::{self, GripperHomeReply, Reply};
use dimos_rpc::report::PeripheralReport;
use dimos_rpc::{Code, RpcError};

/// Timeout for one to disconnect.
const RELEASE_LIMIT: Duration = Duration::from_secs(1);

/// The peripherals of an arm, in the blueprint's order.
#[derive(Default)]
pub struct ArmPeripherals(Vec<PeripheralDevice>);

/// Answers to orders to connect, each with its place among an arm's peripherals and whether it may fail.
pub type Connecting = Vec<(usize, bool, Answer<PeripheralInfo>)>;

impl ArmPeripherals {
    /// Returns the gripper.
    pub fn gripper(&self) -> Option<&PeripheralDevice> {
        self.0.iter().find(|own| own.part() == Part::Gripper)
    }

    /// Disconnects them; a gripper keeps what it holds.
    pub fn finish(&self) {
        let answers: Vec<_> = self.0.iter().map(PeripheralDevice::finish).collect();
        answers.into_iter().for_each(|answer| drop(answer.wait(RELEASE_LIMIT)));
    }

    /// Orders all to connect.
    pub fn connect(&self) -> Connecting {
        self.0.iter().enumerate().map(|(index, own)| (index, own.waits_for_arm(), own.connect())).collect()
    }
}

/// Locks the devices or starts their emulators, and starts their threads. They do nothing yet.
pub fn start(
    arm: &Arm,
    is_closed: bool,
    (emulators, locks): (&mut Vec<Box<dyn Emulator>>, &mut Vec<DeviceLock>),
    notes: impl Fn(Note) + Clone + Send + 'static,
) -> Result<(ArmPeripherals, Ports), StartError> {
    let (mut own, mut ports) = (ArmPeripherals::default(), Ports::default());
    for peripheral in &arm.peripherals {
        let mut config = peripheral.config(&arm.hardware_id);
        let wrong = |error: AdapterError| failed(arm, peripheral, &error);
        match peripheral.row.emulate {
            Some(emulate) if peripheral.is_simulated() => {
                let emulator = emulate(&config, &EmulatorAddress::InProcess).map_err(wrong)?;
                config.address = emulator.address();
                emulators.push(emulator);
            }
            _ => {
                let lock = device_lock::take(peripheral.row.name, &peripheral.full_address(), is_closed);
                locks.push(lock.map_err(|e| StartError::Hardware {
                    arm: arm.hardware_id.clone(),
                    what: e.to_string(),
                    hint: e.hint().to_owned(),
                })?);
            }
        }
        let device = (peripheral.row.create)(&config).map_err(wrong)?;
        let config = PeripheralConfig {
            arm: arm.hardware_id.clone(),
            part: peripheral.row.part,
            native_rate: peripheral.row.native_rate,
            clock: std::sync::Arc::new(MonotonicClock),
            notes: Box::new(notes.clone()),
        };
        let thread =
            |e| StartError::other(format!("no thread for the {}: {e}", config_name(peripheral)), "see ulimit -u");
        let (device, port) = PeripheralDevice::spawn(config, device).map_err(thread)?;
        match peripheral.row.part {
            Part::Gripper => ports.gripper = Some(port),
            Part::ForceTorque => ports.force_torque = Some(port),
        }
        own.0.push(device);
    }
    Ok((own, ports))
}

fn config_name(peripheral: &ArmPeripheral) -> String {
    format!("{} {}", peripheral.row.part.text(), peripheral.row.name)
}

/// Waits for the answers until `limit`. One that its arm powers may connect later; it is named in the text log.
pub fn connected(arm: &Arm, answers: &mut Connecting, limit: Instant) -> Result<(), StartError> {
    for (index, may_fail, answer) in answers.drain(..) {
        let Some(peripheral) = arm.peripherals.get(index) else { continue };
        match answer.wait(limit.saturating_duration_since(Instant::now())) {
            Ok(_) => {}
            Err(AdapterError::Io(_) | AdapterError::Timeout(_)) if may_fail => tracing::info!(
                "{}: its {} does not answer yet: it is tried again when the arm is enabled",
                arm.hardware_id,
                config_name(peripheral)
            ),
            Err(error) => return Err(failed(arm, peripheral, &error)),
        }
    }
    Ok(())
}

fn failed(arm: &Arm, peripheral: &ArmPeripheral, error: &AdapterError) -> StartError {
    let (id, part) = (&arm.hardware_id, peripheral.row.part.name());
    let general = format!(
        "is it powered, and is `hardware.{id}.{part}.address` right ({})? To try without it: --set \
         hardware.{id}.{part}.address=sim",
        peripheral.row.address.form
    );
    let (what, hint) = Message::of(error).or_hint(general);
    StartError::Hardware { arm: id.clone(), what: format!("{}: {what}", config_name(peripheral)), hint }
}

impl Service {
    /// Fails if an arm's gripper has its own connection and cannot take a command now. Nothing has moved then.
    pub(in crate::runtime) fn check_gripper(&self, arm: u16) -> Result<(), RpcError> {
        self.gripper_is_lost(arm.into()).map_or(Ok(()), Err)?;
        let Some(gripper) = self.arms.gripper(arm.into()) else { return Ok(()) };
        gripper.condition().ready(&self.facts.names.arm(arm)).map_err(|error| refusal(&error))
    }

    /// Returns why an arm's gripper with its own connection is lost; `None`: it is not.
    pub(in crate::runtime) fn gripper_is_lost(&self, arm: usize) -> Option<RpcError> {
        let lost = self.arms.gripper(arm)?.lost()?;
        let name = self.facts.names.arm(arm as u16);
        let what = format!("the gripper of {name} is lost: {lost}");
        Some(
            RpcError::new(Code::DeviceRefused, what)
                .hint(format!("check its cable and supply, then: dimos arm reset {name}")),
        )
    }

    /// Begins to home an arm's gripper.
    pub(in crate::runtime) async fn home_gripper(&self, call: api::GripperHome) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        let Some(gripper) = self.arms.gripper(arm.into()) else {
            let (what, hint) = match self.facts.gripper_info(arm.into()) {
                Some(_) => ("needs no homing", "its arm's controller does that, if it is needed"),
                None => ("is not there", "`dimos status -v` shows grippers"),
            };
            let error = RpcError::new(Code::Unsupported, format!("the gripper of {} {what}", call.arm));
            return Err(error.hint(hint));
        };
        // A stop of the arm is a stop of its gripper.
        if self.tick.phase(arm.into()) == Phase::Held {
            let error = RpcError::new(Code::ArmLatched, format!("{} is held", call.arm));
            return Err(error.hint(format!("when it may move again: dimos arm reset {}", call.arm)));
        }
        self.gripper_is_lost(arm.into()).map_or(Ok(()), Err)?;
        let homed = order(gripper.home()).await;
        homed.map_err(|error| match error {
            AdapterError::Unsupported => {
                RpcError::new(Code::Unsupported, format!("the gripper of {} needs no homing", call.arm))
            }
            error => refused(&call.arm, "did not home its gripper", &error),
        })?;
        self.tick.dispatcher().log(Severity::Info, format!("{}: its gripper is being homed", call.arm));
        let condition = gripper.condition().name().to_owned();
        Ok(Reply::GripperHome(GripperHomeReply { arm: call.arm, condition }))
    }

    /// Reconnects an arm's peripherals that are lost, and clears the errors of the others. Returns what is to be said.
    pub(in crate::runtime) async fn reset_peripherals(&self, arm: u16) -> Result<Option<String>, RpcError> {
        let own = self.arms.peripherals.get(usize::from(arm)).ok_or_else(internal)?;
        let mut said = Vec::new();
        for peripheral in &own.0 {
            let (was_lost, part) = (peripheral.link() != Link::Up, peripheral.part().text());
            match order(peripheral.reset()).await {
                Ok(()) if was_lost => said.push(format!("its {part} is connected again")),
                Ok(()) => {}
                Err(error) if was_lost => said.push(format!("its {part} is still lost: {}", Message::of(error).what)),
                Err(error) => said.push(format!("its {part} did not clear its error: {}", Message::of(error).what)),
            }
        }
        Ok(Some(said.join("; ")).filter(|text| !text.is_empty()))
    }

    /// Returns the peripherals of an arm for `status`.
    pub(in crate::runtime) fn peripheral_reports(&self, arm: usize) -> Vec<PeripheralReport> {
        let given = self.facts.blueprint.arms.get(arm).map_or(&[][..], |arm| &arm.peripherals);
        let own = self.arms.peripherals.get(arm).map_or(&[][..], |own| &own.0);
        let report = |(given, own): (&ArmPeripheral, &PeripheralDevice)| {
            let (condition, lost) = (own.condition(), own.lost());
            PeripheralReport {
                part: given.row.part.name().to_owned(),
                adapter: given.row.name.to_owned(),
                address: given.address.clone(),
                simulated: given.is_simulated(),
                link: own.link().name().to_owned(),
                condition: lost.is_none().then(|| condition.name().to_owned()),
                trouble: lost.or(match condition {
                    Condition::Fault(code, text) => Some(format!("fault {code}: {text}")),
                    _ => None,
                }),
                measured_rate_hz: Some(own.health().rate()).filter(|rate| *rate > 0.0),
                native_rate_hz: given.row.native_rate,
            }
        };
        given.iter().zip(own).map(report).collect()
    }
}

/// Returns the refusal of a command as an error.
fn refusal(error: &AdapterError) -> RpcError {
    let Message { what, hint } = Message::of(error);
    let refusal = RpcError::new(Code::DeviceRefused, what);
    match hint {
        Some(hint) => refusal.hint(hint),
        None => refusal,
    }
}
