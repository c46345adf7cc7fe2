//! N12: what anyone may send. Nothing panics, and the work is bounded.

use std::time::{Duration, Instant};

use super::calls::Call;
use super::names::Names;
use super::pickle_reader::{MAX_BYTES, read};
use crate::rpc::report::{ArmStateReport, JointReport, StateReport, StatusReport, TaskReport};

/// `task_invoke("joint_trajectory", "execute", …)` as CPython 3.11 pickles it: a trajectory of two points, one position
/// a number of numpy.
const EXECUTE: &str = "\
80049549020000000000008c106a6f696e745f7472616a6563746f7279948c0765786563757465947d94288c0a7472616a6563746f7279948c2a\
64696d6f732e6d7367732e7472616a6563746f72795f6d7367732e4a6f696e745472616a6563746f7279948c0f4a6f696e745472616a6563746f\
72799493942981944e7d94288c086475726174696f6e94473ff00000000000008c0b6a6f696e745f6e616d6573945d948c0a61726d2f6a6f696e\
743194618c0a6e756d5f6a6f696e7473944b018c0a6e756d5f706f696e7473944b028c06706f696e7473945d94288c2a64696d6f732e6d736773\
2e7472616a6563746f72795f6d7367732e5472616a6563746f7279506f696e74948c0f5472616a6563746f7279506f696e749493942981944e7d\
9428680d4b018c09706f736974696f6e73945d948c166e756d70792e5f636f72652e6d756c74696172726179948c067363616c61729493948c05\
6e756d7079948c0564747970659493948c02663894898887945294284b038c013c944e4e4e4affffffff4affffffff4b00749462430800000000\
0000f03f9486945294618c0f74696d655f66726f6d5f7374617274944700000000000000008c0a76656c6f636974696573945d94470000000000\
000000617586946268132981944e7d9428680d4b0168165d94474000000000000000616826473ff000000000000068275d944700000000000000\
006175869462658c0974696d657374616d7094473ff8000000000000758694628c1163757272656e745f706f736974696f6e73947d94680c473f\
f0000000000000737587947d9486942e";

fn bytes() -> Vec<u8> {
    let digit = |at: usize| u8::from_str_radix(&EXECUTE[at..at + 2], 16).unwrap();
    (0..EXECUTE.len()).step_by(2).map(digit).collect()
}

fn names() -> Names {
    let joints = vec![JointReport { name: "arm_joint1".into(), ..JointReport::default() }];
    let arm = ArmStateReport {
        hardware_id: "arm".into(),
        joints,
        gripper_unit: Some("m".into()),
        ..ArmStateReport::default()
    };
    let state = StateReport { arms: vec![arm], ..StateReport::default() };
    let task = TaskReport { name: "traj".into(), takes: vec!["execute".into()], ..TaskReport::default() };
    let status = StatusReport { tasks: vec![task], ..StatusReport::default() };
    Names::of(&status, &state, &Default::default()).unwrap()
}

fn call(method: &str, payload: &[u8]) -> Result<Call, super::python_error::PythonError> {
    Call::read("ControlCoordinator", method, payload, &names())
}

/// Random numbers from a seed (Marsaglia's xorshift).
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, limit: usize) -> usize {
        (self.next() % limit.max(1) as u64) as usize
    }
}

#[test]
fn what_cpython_pickles_is_read() {
    let Ok(Call::Execute(Ok(execute))) = call("task_invoke", &bytes()) else { panic!("not read") };
    assert_eq!(execute.trajectory.joint_names, ["arm_joint1"]);
    let points = &execute.trajectory.points;
    let read: Vec<_> = points.iter().map(|p| (p.time_from_start, p.positions.clone(), p.velocities.clone())).collect();
    // Velocities that are all zero were filled in.
    assert_eq!(read, [(0.0, vec![1.0], None), (1.0, vec![2.0], None)]);
}

#[test]
fn n12_pickles_with_changed_bytes_are_read_or_refused() {
    let (sound, mut random) = (bytes(), Random(0x5eed_0015));
    let methods = ["task_invoke", "execute_trajectory", "set_estop", "describe_task", "list_joints", "levitate"];
    let mut executed = 0;
    for round in 0..60_000 {
        let mut changed = sound.clone();
        for _ in 0..=random.below(4) {
            if changed.is_empty() {
                break;
            }
            let at = random.below(changed.len());
            match random.below(4) {
                0 => changed[at] = random.next() as u8,
                1 => changed.truncate(at.max(1)),
                2 => changed.insert(at, random.next() as u8),
                _ => drop(changed.remove(at)),
            }
        }
        let method = methods[round % methods.len()];
        executed += usize::from(matches!(call(method, &changed), Ok(Call::Execute(Ok(_)))));
    }
    // Some changes meet a number only.
    assert!((10..10_000).contains(&executed), "{executed}");
}

#[test]
fn n12_random_opcodes_are_read_or_refused() {
    const OPCODES: &[u8] = b"\x80\x95.(N\x88\x89JKM\x8aG\x8cXCB]})\x85\x86\x87taesu\x94qhj\x93\x81Rb";
    let mut random = Random(0x5eed_0016);
    let mut read_whole = 0;
    for _ in 0..200_000 {
        let length = 1 + random.below(60);
        let mut pickle: Vec<u8> = Vec::with_capacity(2 * length);
        for _ in 0..length {
            pickle.push(OPCODES[random.below(OPCODES.len())]);
            // Lengths and numbers are small mostly.
            if random.below(3) == 0 {
                pickle.push(random.below(4) as u8);
            }
        }
        pickle.push(b'.');
        read_whole += usize::from(read(&pickle).is_ok());
        let _ = call("task_invoke", &pickle);
    }
    assert!(read_whole > 100, "{read_whole}");
}

#[test]
fn n12_nothing_but_a_few_classes_is_accepted() {
    for (module, name) in [("os", "system"), ("builtins", "eval"), ("numpy", "load"), ("dimos.msgs", "JointTrajectory")]
    {
        let mut pickle = vec![0x80, 4];
        for text in [module, name] {
            pickle.extend([0x8c, text.len() as u8]);
            pickle.extend(text.bytes());
        }
        pickle.extend(*b"\x93\x8c\x06id > x\x85R\x85}\x86.");
        let refused = call("execute_trajectory", &pickle).unwrap_err();
        assert_eq!(refused.class, "TypeError");
        assert!(refused.text.contains(&format!("\"{module}.{name}\", which is not accepted")), "{}", refused.text);
    }
    // GLOBAL and INST of older protocols, persistent ids, extensions, out-of-band buffers.
    for opcode in *b"ciPQ\x82\x83\x84\x92\x96\x97\x98" {
        assert!(read(&[0x80, 4, opcode, b'.']).unwrap_err().0.contains("which is not accepted"));
    }
}

#[test]
fn n12_large_and_nested_pickles_are_refused_soon() {
    let fill = |unit: &[u8]| {
        let mut pickle = unit.repeat((MAX_BYTES - 1) / unit.len());
        pickle.push(b'.');
        pickle
    };
    let mut doubled = b"]\x94".to_vec();
    // A list with the list before, twice: 2^n values that are n.
    for level in 0..200u8 {
        doubled.extend([b']', 0x94, b'(', b'h', level, b'h', level, b'e']);
    }
    doubled.push(b'.');
    // Many points that are one, with positions that are one long list.
    let mut aliased = bytes();
    let points = aliased.windows(2).position(|w| w == *b"e\x8c").unwrap();
    let again = [b'h', 0x13].repeat(500_000);
    aliased.splice(points..points, again);
    for (what, pickle) in [
        ("values", fill(b"N")),
        ("lists", fill(b"]")),
        ("marks", fill(b"(")),
        ("a memo", fill(b"N\x94")),
        ("references", [b"N\x94(".to_vec(), fill(b"h\0")].concat()),
        ("appended values", [b"](".to_vec(), fill(b"Ne(")].concat()),
        ("doubled lists", doubled),
        ("aliased points", aliased),
        ("too many bytes", vec![b'N'; MAX_BYTES + 1]),
        ("a string that ends early", b"\x80\x04X\xff\xff\xff\xff.".to_vec()),
    ] {
        let began = Instant::now();
        assert!(!matches!(call("task_invoke", &pickle), Ok(Call::Execute(Ok(_)))), "{what}");
        assert!(began.elapsed() < Duration::from_secs(3), "{what}: {:?}", began.elapsed());
    }
}
