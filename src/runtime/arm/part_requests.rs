//! Requests to the optional parts of an arm: inputs and outputs.

use super::arm_requests::{order, refused};
use crate::runtime::{Service, internal};
use dimos_core::arm::{IoInfo, IoState};
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::Severity;
use dimos_hardware::device::Details;
use dimos_log::notes::Note;
use dimos_rpc::api::{self, AnalogReport, IoReport, Reply, StopInputReport};
use dimos_rpc::report::JointStatusReport;
use dimos_rpc::{Code, RpcError};

impl Service {
    /// Reads an arm's inputs and outputs.
    pub(in crate::runtime) async fn io(&self, id: &str) -> Result<IoReport, RpcError> {
        let arm = self.facts.arm_index(id)?;
        let info = self.io_info(arm)?;
        let state = order(self.arms.device(arm)?.read_io()).await;
        let state = state.map_err(|e| refused(id, "did not report its inputs and outputs", &e))?;
        Ok(self.io_report(arm.into(), &info, &state))
    }

    /// Sets outputs in the order of their names, and reads them back.
    pub(in crate::runtime) async fn set_io(&self, call: api::ArmIoSet) -> Result<Reply, RpcError> {
        let arm = self.facts.arm_index(&call.arm)?;
        self.io_info(arm)?;
        let device = self.arms.device(arm)?;
        let values = call.values().map_err(|what| RpcError::new(Code::InvalidParams, what))?;
        let mut done = Vec::new();
        for (value, (name, level)) in values.into_iter().zip(&call.outputs) {
            let set = order(device.set_output(value)).await;
            set.map_err(|e| {
                let before = if done.is_empty() { String::new() } else { format!(" ({} was set)", done.join(", ")) };
                refused(&call.arm, &format!("did not set {name}{before}"), &e)
            })?;
            done.push(name.as_str());
            self.tick.dispatcher().log(Severity::Info, format!("{}: {name} set to {level}", call.arm));
        }
        self.io(&call.arm).await.map(Reply::ArmIoSet)
    }

    fn io_info(&self, arm: u16) -> Result<IoInfo, RpcError> {
        let connected = self.facts.connected.get(arm as usize).ok_or_else(internal)?;
        connected.io.ok_or_else(|| {
            let name = self.facts.names.arm(arm);
            RpcError::new(Code::Unsupported, format!("{name} has no digital or analogue inputs and outputs"))
                .hint("`dimos list-adapters` shows the adapter; its page in docs/arms lists what it supports")
        })
    }

    /// Returns levels as a report.
    pub(in crate::runtime) fn io_report(&self, arm: usize, info: &IoInfo, state: &IoState) -> IoReport {
        let levels =
            |bits: u32, count: u8| (0..count).map(|i| bits.checked_shr(i.into()).unwrap_or(0) & 1 != 0).collect();
        let analog = |values: &[f64], units: &[dimos_core::arm::AnalogUnit]| {
            let channels = values.iter().zip(units);
            channels.map(|(value, unit)| AnalogReport { value: *value, unit: unit.name().to_owned() }).collect()
        };
        let stop = self.facts.blueprint.arms.get(arm).and_then(|arm| arm.setup.stop_input);
        IoReport {
            digital_inputs: levels(state.digital_inputs, info.digital_inputs),
            digital_outputs: levels(state.digital_outputs, info.digital_outputs),
            analog_inputs: analog(&state.analog_inputs, info.analog_inputs),
            analog_outputs: analog(&state.analog_outputs, info.analog_outputs),
            stop_input: stop
                .map(|stop| StopInputReport { input: format!("di{}", stop.input), open: stop.is_open(state) }),
        }
    }

    /// Logs the calibration offsets that the arms reported.
    pub fn log_calibration(&self) {
        for (connected, arm) in self.facts.connected.iter().zip(&self.facts.names.arms) {
            let Some(offsets) = connected.calibration_offsets else { continue };
            let offsets: Vec<_> = offsets.iter().take(arm.joints.len()).map(|v| format!("{v:.4}")).collect();
            let text = format!("{}: calibration offsets {} rad", arm.hardware_id, offsets.join(" "));
            self.tick.dispatcher().log(Severity::Info, text);
        }
    }

    /// Returns the condition of an arm's joints; empty if the device reports none.
    pub(in crate::runtime) fn joint_status(&self, arm: usize, details: &Details) -> Vec<JointStatusReport> {
        let offsets = self.facts.connected.get(arm).and_then(|connected| connected.calibration_offsets);
        let names = self.facts.names.arms.get(arm).map_or(&[][..], |arm| &arm.joints);
        if details.joints.is_none() && offsets.is_none() {
            return Vec::new();
        }
        let joint = |(j, name): (usize, &String)| {
            let status = details.joints.as_ref().and_then(|joints| joints.get(j)).copied().unwrap_or_default();
            JointStatusReport {
                name: name.clone(),
                temperature: status.temperature,
                current: status.current,
                voltage: status.voltage,
                load: status.load,
                error: status.error,
                calibration_offset: offsets.as_ref().and_then(|offsets| offsets.get(j)).copied(),
            }
        };
        names.iter().enumerate().map(joint).collect()
    }

    /// Records the values that the device threads read since the last call.
    pub fn log_details(&self) {
        let mut logged = lock(&self.arms.details_logged);
        for (arm, (device, logged)) in self.arms.devices.iter().zip(logged.iter_mut()).enumerate() {
            let details = device.health().details();
            if details.joints_seq != logged.joints_seq
                && let Some(joints) = details.joints.map(Box::new)
            {
                self.tick.dispatcher().note(Note::JointStatus { arm: arm as u16, stamp: details.joints_stamp, joints });
            }
            if details.payload_seq != logged.payload_seq
                && let Some(load) = details.payload
            {
                self.tick.dispatcher().note(Note::Payload { arm: arm as u16, stamp: details.payload_stamp, load });
            }
            if details.io_seq != logged.io_seq {
                let info = self.facts.connected.get(arm).and_then(|connected| connected.io);
                if let (Some(info), Some(state)) = (info, details.io) {
                    self.tick.dispatcher().note(Note::Io { arm: arm as u16, stamp: details.io_stamp, info, state });
                }
            }
            *logged = details;
        }
    }
}
