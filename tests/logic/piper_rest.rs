//! A Piper as recorded: where gravity parks it, 0.035 rad outside the ranges of its joints 2 and 3, and its bus.

use std::collections::BTreeMap;
use std::f64::consts::PI;

use dimos::arm::StopPoint;
use dimos::arms::piper::SPEC;
use dimos::hardware::adapter::ManipulatorAdapter;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::transport::can::{CanAddress, CanEvent, open};

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

/// Frames of 50 ms by identifier: how often each came, and in which 5 ms.
fn cycle(frames: impl Iterator<Item = (f64, u16)>) -> BTreeMap<u16, Vec<usize>> {
    let mut all = BTreeMap::<u16, Vec<usize>>::new();
    for (seconds, id) in frames {
        all.entry(id).or_default().push(((seconds + 1e-4) / 0.005) as usize);
    }
    all
}

/// Joints and pose 200 times a second, motors 100 times, each driver 20 times in its own 10 ms; the bits of a gripper
/// that is off.
#[test]
fn the_emulated_bus_carries_what_was_recorded_on_an_arm() {
    let Some(folder) = shared("recordings") else { return };
    let text = std::fs::read_to_string(folder.join("piper_rest.txt")).unwrap();
    let recorded: Vec<(f64, u16, &str)> = text
        .lines()
        .filter(|line| !line.starts_with('#'))
        .map(|line| {
            let [at, id, data] = line.split(' ').collect::<Vec<_>>()[..] else { panic!("{line}") };
            (at.parse::<f64>().unwrap() * 1e-6, u16::from_str_radix(id, 16).unwrap(), data)
        })
        .collect();
    let expected = cycle(recorded.iter().map(|(at, id, _)| (*at, *id)));
    let (emulator, mut arm) = parked(&[0.0; 6]);
    arm.disconnect();
    let mut port = open("a test", &CanAddress::parse(&emulator.address()).unwrap(), &[]).unwrap();
    let (mut frames, end) = (Vec::new(), std::time::Instant::now() + std::time::Duration::from_secs(5));
    while frames.len() < 3 * recorded.len() {
        assert!(std::time::Instant::now() < end, "{} frames", frames.len());
        match port.receive().unwrap() {
            Some(CanEvent::Frame(frame)) => frames.push(frame),
            _ => std::thread::sleep(std::time::Duration::from_millis(1)),
        }
    }
    // A cycle begins where the driver of joint 4 reports. The emulator may be late: cycles of 5 ms are counted.
    let first = frames.iter().position(|frame| frame.id == 0x264).unwrap();
    let begin = frames[..first].iter().rposition(|frame| frame.id == 0x2A1).unwrap();
    let mut period = -1.0;
    let timed = frames[begin..begin + recorded.len()].iter().map(|frame| {
        period += f64::from(frame.id == 0x2A1);
        (0.005 * period + 0.001, frame.id)
    });
    assert_eq!(cycle(timed), expected);
    let data = |id: u16| frames.iter().find(|frame| frame.id == id).unwrap().data;
    assert_eq!(data(0x2A8)[4..], [0; 4], "no force, and a gripper that is off says no more");
}

/// A moving joint shows its last position in a third of the cycles and steps back in others, as recorded.
#[test]
fn a_moving_joint_of_the_emulator_is_a_staircase() {
    let (_emulator, mut arm) = parked(&[0.0, 0.5, -0.5, 0.0, 0.0, 0.0]);
    arm.activate().unwrap();
    arm.set_control_mode(dimos::joint::ControlMode::Position).unwrap();
    arm.write_joint_positions(&[0.6, 0.5, -0.5, 0.0, 0.0, 0.0], 0.1).unwrap();
    let (mut seen, mut last, mut reading) = (Vec::new(), None, dimos::hardware::adapter::JointReading::default());
    let end = std::time::Instant::now() + std::time::Duration::from_secs(20);
    while reading.position[0] < 0.5 {
        assert!(std::time::Instant::now() < end, "at {} rad", reading.position[0]);
        arm.read_joints(&mut reading).unwrap();
        if reading.stamp != last {
            last = reading.stamp;
            seen.push(reading.position[0]);
        }
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    let moving: Vec<f64> = seen.into_iter().filter(|q| (0.1..0.45).contains(q)).collect();
    let steps: Vec<f64> = moving.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let share = |which: fn(&f64) -> bool| steps.iter().filter(|step| which(step)).count() as f64 / steps.len() as f64;
    assert!(steps.len() > 50 && (0.2..0.5).contains(&share(|step| *step == 0.0)), "{steps:?}");
    assert!((0.02..0.3).contains(&share(|step| *step < 0.0)), "{steps:?}");
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
