//! Services of the node that end motion, and those that list its controllers and hardware, which MoveIt asks.

use std::path::{Path, PathBuf};
use std::sync::mpsc::Receiver;

use super::node::{Request, encoded};
use super::types;
use crate::blueprint::share::Distro;
use dimos_log::cdr::Encoder;
use dimos_log::node_messages::{
    ComponentBegin, ComponentEnd, ControllerList, ControllerState, HardwareInterface, LifecycleState, TriggerResponse,
};
use dimos_log::wire::Field;
use dimos_rpc::api::{Cancel, Confirmation, State, Status, Stop};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{StateReport, StatusReport, TaskReport};

/// State `active` of a component.
const ACTIVE: u8 = 3;
/// State `inactive` of a component.
const INACTIVE: u8 = 2;
/// What trajectory tasks are to ROS.
const CONTROLLER: &str = "joint_trajectory_controller/JointTrajectoryController";

/// A service.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// Stops all arms.
    Stop,
    /// Ends all motions.
    Cancel,
    /// Lists the trajectory tasks.
    ListControllers,
    /// Lists the arms.
    ListHardware,
}

/// Returns the services that end motion: name below the namespace, and type.
pub const fn of_ends() -> [(&'static str, Service, types::Type); 2] {
    [("dimos/stop", Service::Stop, types::TRIGGER), ("dimos/cancel", Service::Cancel, types::TRIGGER)]
}

/// Returns the services that list.
pub const fn of_lists(distro: Distro) -> [(&'static str, Service, types::Type); 2] {
    [
        ("controller_manager/list_controllers", Service::ListControllers, types::LIST_CONTROLLERS),
        ("controller_manager/list_hardware_components", Service::ListHardware, types::list_hardware(distro)),
    ]
}

/// What the services need.
#[derive(Debug, Clone)]
pub struct Services {
    /// The run.
    pub run: String,
    /// Its socket.
    pub socket: PathBuf,
    /// The distribution.
    pub distro: Distro,
    /// Whether ROS may end motion.
    pub may_end: bool,
}

impl Services {
    /// Answers requests, one after the other, each over a new connection.
    pub fn serve(&self, requests: Receiver<Request<Service>>) {
        for request in requests {
            let service = request.of;
            match self.answer(service) {
                Ok(reply) => request.reply_bytes(reply),
                // A service of ROS has no errors: its client gets no reply.
                Err(error) => tracing::warn!("share: ros: {service:?}: {error}"),
            }
        }
    }

    fn answer(&self, service: Service) -> Result<Vec<u8>, ClientError> {
        let status = || client(&self.run, &self.socket)?.call(Status {});
        Ok(match service {
            Service::Stop => encoded(&self.ended(stop)),
            Service::Cancel => encoded(&self.ended(cancel)),
            Service::ListControllers => encoded(&controllers(&status()?)),
            Service::ListHardware => {
                let mut client = client(&self.run, &self.socket)?;
                let (status, state) = (client.call(Status {})?, client.call(State {})?);
                hardware(&status, &state, self.distro)
            }
        })
    }

    fn ended(&self, end: fn(&Self) -> Result<TriggerResponse, ClientError>) -> TriggerResponse {
        if !self.may_end {
            let message = "the run's owner has taken cancel and stop from observers: share.observers_stop".into();
            return TriggerResponse { success: false, message };
        }
        end(self).unwrap_or_else(|error| TriggerResponse { success: false, message: error.to_string() })
    }
}

fn client(run: &str, socket: &Path) -> Result<Client, ClientError> {
    Client::connect(run, socket)
}

/// Holds all arms; fails if one has not confirmed it.
fn stop(at: &Services) -> Result<TriggerResponse, ClientError> {
    let arms = Client::urgent(None, || client(&at.run, &at.socket), &Stop::default())?.1.arms;
    let said: Vec<String> = arms.iter().map(|(arm, said)| format!("{arm}: {}", said.text())).collect();
    let success = arms.values().all(|said| *said == Confirmation::Confirmed);
    Ok(TriggerResponse { success, message: said.join(", ") })
}

fn cancel(at: &Services) -> Result<TriggerResponse, ClientError> {
    let tasks = Client::urgent(None, || client(&at.run, &at.socket), &Cancel::default())?.1.tasks;
    let cancelled: Vec<&str> =
        tasks.iter().filter(|(_, result)| *result == "CANCELLED").map(|(task, _)| task.as_str()).collect();
    let message = match cancelled.is_empty() {
        true => "no motion was under way".into(),
        false => format!("decelerating to rest: {}", cancelled.join(", ")),
    };
    Ok(TriggerResponse { success: true, message })
}

fn controllers(status: &StatusReport) -> ControllerList {
    let rate = whole(status.tick_rate);
    let controller = |task: &TaskReport| {
        let of = |what: &str| task.joints.iter().map(|joint| format!("{joint}/{what}")).collect::<Vec<_>>();
        ControllerState {
            name: task.name.clone(),
            state: "active".into(),
            r#type: CONTROLLER.into(),
            update_rate: rate,
            claimed_interfaces: of("position"),
            required_command_interfaces: of("position"),
            required_state_interfaces: [of("position"), of("velocity")].concat(),
            ..ControllerState::default()
        }
    };
    ControllerList { controller: status.tasks.iter().filter(|task| task.takes("execute")).map(controller).collect() }
}

fn hardware(status: &StatusReport, state: &StateReport, distro: Distro) -> Vec<u8> {
    let mut encoder = Encoder::default();
    (status.arms.len() as u32).put(&mut encoder);
    for arm in &status.arms {
        let tasks = status.tasks.iter().filter(|task| task.takes("execute"));
        let of_arm = state.arms.iter().filter(|of_arm| of_arm.hardware_id == arm.hardware_id);
        let joints: Vec<&str> = of_arm.flat_map(|arm| &arm.joints).map(|joint| joint.name.as_str()).collect();
        let claimed = |joint: &str| tasks.clone().any(|task| task.joints.iter().any(|own| own == joint));
        let interface = |joint: &str, what: &str, is_claimed| HardwareInterface {
            name: format!("{joint}/{what}"),
            data_type: "double".into(),
            is_available: arm.link == "up",
            is_claimed,
        };
        let begin = ComponentBegin {
            name: arm.hardware_id.clone(),
            r#type: "system".into(),
            is_async: true,
            rw_rate: whole(arm.native_rate_hz),
        };
        begin.put(&mut encoder);
        if distro == Distro::Jazzy {
            arm.adapter.put(&mut encoder);
        }
        let (id, label) = if arm.phase == "ready" { (ACTIVE, "active") } else { (INACTIVE, "inactive") };
        let end = ComponentEnd {
            plugin_name: arm.adapter.clone(),
            state: LifecycleState { id, label: label.into() },
            command_interfaces: joints.iter().map(|joint| interface(joint, "position", claimed(joint))).collect(),
            state_interfaces: joints
                .iter()
                .flat_map(|joint| ["position", "velocity"].map(|what| interface(joint, what, false)))
                .collect(),
        };
        end.put(&mut encoder);
    }
    encoder.bytes().to_vec()
}

/// Returns a rate as ROS has it: a whole number [Hz].
fn whole(rate: f64) -> u16 {
    rate.round().clamp(0.0, f64::from(u16::MAX)) as u16
}
