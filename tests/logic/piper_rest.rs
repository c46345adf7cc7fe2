//! A Piper where gravity parks it, 0.035 rad outside the ranges of its joints 2 and 3, as recorded on an arm.

use std::f64::consts::PI;

use dimos::arm::StopPoint;
use dimos::hardware::adapter::ManipulatorAdapter;
use dimos::hardware::arms::piper::SPEC;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};

use crate::support::shared::shared;

/// The joints of the recording [rad]: two big-endian numbers [0.001°] in each of 0x2A5 to 0x2A7.
fn recorded() -> Option<Vec<f64>> {
    let text = std::fs::read_to_string(shared("recordings")?.join("piper_rest.txt")).unwrap();
    let frames = text.lines().filter(|line| !line.starts_with('#'));
    let mut joints = vec![0.0; 6];
    for frame in frames {
        let [_, id, data] = frame.split(' ').collect::<Vec<_>>()[..] else { panic!("{frame}") };
        let Some(pair) = ["2A5", "2A6", "2A7"].iter().position(|own| *own == id) else { continue };
        for half in 0..2 {
            let wire = u32::from_str_radix(&data[8 * half..8 * half + 8], 16).unwrap() as i32;
            joints[2 * pair + half] = f64::from(wire) / 180_000.0 * PI;
        }
    }
    Some(joints)
}

fn parked(joints: &[f64]) -> (Box<dyn Emulator>, Box<dyn ManipulatorAdapter>) {
    let options = serde_json::json!({ "sim": { "initial_positions": joints } });
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let emulator = SPEC.emulate.unwrap()(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    let mut adapter = (SPEC.create)(&config).unwrap();
    adapter.connect().unwrap();
    (emulator, adapter)
}

#[test]
fn a_piper_is_enabled_where_gravity_parks_it() {
    let Some(joints) = recorded() else { return };
    assert!((joints[1] + 0.0349).abs() < 1e-3 && (joints[2] - 0.0344).abs() < 1e-3, "{joints:?}");
    let (emulator, mut arm) = parked(&joints);
    arm.activate().unwrap();
    assert_eq!((arm.read_enabled(), arm.read_error()), (Ok(true), Ok((0, String::new()))));
    // This controller refuses targets outside its range: the way in is slow.
    let way: Vec<f64> = (0..60)
        .map(|_| {
            std::thread::sleep(std::time::Duration::from_millis(20));
            emulator.true_positions().unwrap()[1]
        })
        .collect();
    let steps = way.windows(2).map(|pair| (pair[1] - pair[0]) / 0.02).fold(0.0, f64::max);
    assert!(steps < 0.5 && way.last().unwrap().abs() < 1e-3, "{steps} rad/s to {:?}", way.last());
    arm.write_stop(&StopPoint::default()).unwrap();
    assert_eq!(arm.read_enabled(), Ok(true));
}
