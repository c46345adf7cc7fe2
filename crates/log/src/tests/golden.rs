//! Bytes and schemas as other tools write them, and a log's metadata.
//!
//! The bytes were made with PyPI mcap-ros2-support 0.6.0: `serialize_dynamic(name, definition)[name](message).hex()`,
//! with ROS 2's own definitions of the first three types.

use super::*;
use crate::cdr::Encoder;
use crate::messages::{Event as EventMessage, Header, Log, Time, Vector3, Wrench, WrenchStamped};
use crate::wire::Message;

fn hex<M: Message>(message: &M) -> String {
    let mut out = Encoder::default();
    message.put(&mut out);
    out.bytes().iter().map(|b| format!("{b:02x}")).collect()
}

fn header() -> Header {
    Header { stamp: Time::of(1_795_270_590_123_456_789), frame_id: "coordinator".into() }
}

#[test]
fn joint_state() {
    let message = JointState {
        header: header(),
        name: vec!["arm_joint1".into(), "arm_joint10".into()],
        position: vec![0.1, -2.5],
        velocity: vec![],
        effort: vec![f64::NAN, 1e-310],
    };
    let golden = "00010000bea7016b15cd5b070c000000636f6f7264696e61746f7200020000000b00000061726d5f6a6f696e743100000c\
                  00000061726d5f6a6f696e74313000020000009a9999999999b93f00000000000004c000000000020000000000000000\
                  00f87f2be6708b68120000";
    assert_eq!(hex(&message), golden);
}

#[test]
fn log() {
    let message = Log { stamp: header().stamp, level: 30, name: "run".into(), msg: "Größe".into(), ..Log::default() };
    let golden = "00010000bea7016b15cd5b071e0000000400000072756e00080000004772c3b6c39f6500010000000000000001000000\
                  0000000000000000";
    assert_eq!(hex(&message), golden);
}

#[test]
fn wrench() {
    let force = Vector3 { x: 1.0, y: 2.0, z: 3.0 };
    let torque = Vector3 { x: 0.1, y: 0.2, z: 0.3 };
    let message = WrenchStamped { header: header(), wrench: Wrench { force, torque } };
    let golden = "00010000bea7016b15cd5b070c000000636f6f7264696e61746f7200000000000000f03f000000000000004000000000\
                  000008409a9999999999b93f9a9999999999c93f333333333333d33f";
    assert_eq!(hex(&message), golden);
}

#[test]
fn event() {
    let message = EventMessage {
        header: header(),
        tick: 7,
        kind: "request".into(),
        severity: "info".into(),
        request: vec![3],
        status: "ACCEPTED".into(),
        text: "request 3: accepted".into(),
        by: "dimos stop (pid 4242, user ana)".into(),
        ..EventMessage::default()
    };
    let golden = "00010000bea7016b15cd5b070c000000636f6f7264696e61746f72000700000000000000080000007265717565737400\
                  05000000696e666f00000000010000000000000003000000000000000100000000000000010000000000000001000000\
                  000000000900000041434345505445440000000000000000140000007265717565737420333a20616363657074656400\
                  2000000064696d6f732073746f70202870696420343234322c207573657220616e612900";
    assert_eq!(hex(&message), golden);
    let bytes: Vec<u8> =
        (0..golden.len()).step_by(2).map(|i| u8::from_str_radix(&golden[i..i + 2], 16).unwrap()).collect();
    assert_eq!(EventMessage::decode(&bytes).unwrap(), message);
    for length in 0..bytes.len() {
        assert!(EventMessage::decode(&bytes[..length]).is_err(), "{length} bytes decode to a message");
    }
}

#[test]
fn a_schema_is_its_fields_and_then_what_they_need() {
    let line = "=".repeat(80);
    let schema = WrenchStamped::schema_text();
    let without_comments: Vec<_> = schema.lines().filter(|l| !l.starts_with('#')).collect();
    let expected = [
        "std_msgs/Header header",
        "geometry_msgs/Wrench wrench",
        line.as_str(),
        "MSG: std_msgs/Header",
        "builtin_interfaces/Time stamp",
        "string frame_id",
        line.as_str(),
        "MSG: builtin_interfaces/Time",
        "int32 sec",
        "uint32 nanosec",
        line.as_str(),
        "MSG: geometry_msgs/Wrench",
        "geometry_msgs/Vector3 force",
        "geometry_msgs/Vector3 torque",
        line.as_str(),
        "MSG: geometry_msgs/Vector3",
        "float64 x",
        "float64 y",
        "float64 z",
    ];
    assert_eq!(without_comments, expected);
    assert!(schema.contains("# [Nm].\ngeometry_msgs/Vector3 torque\n"), "units are missing");
}

#[test]
fn a_log_names_its_run_and_time_span() {
    let (_folder, path) = folder();
    record(&path, (0..11).flat_map(tick));
    let mut log = LogReader::open(&path).unwrap();
    let info = log.info().clone();
    assert_eq!(info.span, Some((WALL, WALL + 10 * PERIOD)));
    assert!(info.complete);
    assert_eq!((info.metadata["run"].as_str(), info.metadata["tick_rate"].as_str()), ("test", "100"));
    assert!(info.metadata["arms"].contains(r#""right":["right_joint1","right_joint2"]"#));
    assert_eq!(info.metadata["wall_offset_ns"], (WALL - 1_000_000_000).to_string());
    assert_eq!(info.topics["/wrench/right"], "geometry_msgs/msg/WrenchStamped");
    assert!(!info.topics.contains_key("/wrench/left"), "only what there is");
    let selection = Selection { topics: vec!["/dimos/tick".into()], from: WALL + 3 * PERIOD, to: WALL + 5 * PERIOD };
    log.select(selection).unwrap();
    let mut ticks = Vec::new();
    while let Some(entry) = log.next_entry().unwrap() {
        let Payload::Tick(t) = entry.data else { panic!("{}", entry.topic) };
        ticks.push(t.tick);
    }
    assert_eq!(ticks, [3, 4, 5]);
}

#[test]
fn the_page_on_the_format_names_every_topic_and_schema() {
    let page = include_str!("../../../../docs/log-format.md");
    let (_folder, path) = folder();
    record(&path, (0..11).flat_map(tick));
    for (topic, schema) in &LogReader::open(&path).unwrap().info().topics {
        let topic = topic.replace("/left", "/<arm>").replace("/right", "/<arm>");
        assert!(page.contains(&format!("| `{topic}` | {schema} |")), "{topic} with {schema} is not in the page");
    }
}
