//! What a reading has of the controller's own command: a start continues it.

use std::time::{Duration, Instant};

use serde_json::json;

use super::adapter::FrankaAdapter;
use super::emulator::FrankaEmulator;
use super::protocol::DOF;
use dimos_core::arm::Commanded;
use dimos_core::joint::{ControlMode, joints_of};
use dimos_hardware::adapter::{JointReading, ManipulatorAdapter};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};

fn commanded(adapter: &mut FrankaAdapter) -> Commanded {
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).unwrap();
    reading.commanded.unwrap()
}

#[test]
fn a_reading_has_what_the_controller_commands() {
    let options = json!({"sim": {"command_wait": 0.1}});
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let emulator = FrankaEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    let mut adapter = FrankaAdapter::new(&config).unwrap();
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    let rest = commanded(&mut adapter);
    let q_d = adapter.session.as_ref().unwrap().state.q_d;
    assert_eq!((rest.position, rest.velocity), (joints_of(&q_d), joints_of(&[0.0; DOF])));
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    let began = Instant::now();
    while commanded(&mut adapter).velocity[0] < 0.15 {
        assert!(began.elapsed() < Duration::from_secs(10));
        adapter.write_joint_velocities(&[0.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(commanded(&mut adapter).position[0] > rest.position[0]);
}
