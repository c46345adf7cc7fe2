//! slcan against bytes written by hand after LAWICEL's description, and both ends against each other.

use std::time::{Duration, Instant};

use rustix::event::PollFlags;

use super::super::slcan::{encode, open};
use super::*;
use crate::adapter::AdapterError;
use crate::transport::can::CanFilter;
use crate::transport::serial::wait;

const WAIT: Duration = Duration::from_secs(10);

fn text(frame: &CanFrame) -> String {
    let (line, len) = encode(frame).unwrap();
    String::from_utf8(line[..len].to_vec()).unwrap()
}

/// Frames beside their lines.
fn golden() -> [(CanFrame, &'static str); 4] {
    [
        (CanFrame::new(0x155, &[0x00, 0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD]), "t15580001234567 89ABCD\r"),
        (CanFrame::new(0x7FF, &[]), "t7FF0\r"),
        (CanFrame::new(0x000, &[0xF0]), "t0001F0\r"),
        (CanFrame::new(0x471, &[0x07, 0x02]), "t47120702\r"),
    ]
}

#[test]
fn frames_and_their_lines() {
    for (frame, line) in golden() {
        let line = line.replace(' ', "");
        assert_eq!(text(&frame), line);
        assert_eq!(decode(line.trim_end().as_bytes()), Some(frame));
        assert_eq!(decode(line.trim_end().to_lowercase().as_bytes()), Some(frame), "small digits");
        assert_eq!(decode(format!("{}1A2B", line.trim_end()).as_bytes()), Some(frame), "with a time stamp");
    }
    assert!(encode(&CanFrame::new(0x800, &[])).is_none());
}

#[test]
fn other_lines_are_no_frames() {
    let lines = [
        "",
        "t",
        "t1",
        "t155",
        "t1559",
        "t15590011223344556677 8",
        "t1552F",
        "t1552F00",
        "t1552F0G0",
        "tG550",
        "t8000",
        "T000001551FF",
        "r1558",
        "z",
        "Z",
        "V1013",
        "F00",
        "t1552F0001",
        "t1552+1+2",
        "\u{fffd}\u{fffd}\u{fffd}",
    ];
    for line in lines {
        assert_eq!(decode(line.as_bytes()), None, "{line:?}");
    }
}

#[test]
fn anything_may_arrive_and_nothing_panics() {
    use proptest::prelude::*;
    proptest!(|(line in prop::collection::vec(any::<u8>(), 0..40))| {
        if let Some(frame) = decode(&line) {
            prop_assert!(frame.id <= 0x7FF && frame.len <= 8);
        }
    });
    proptest!(|(id in 0u16..0x800, bytes in prop::collection::vec(any::<u8>(), 0..=8))| {
        let frame = CanFrame::new(id, &bytes);
        prop_assert_eq!(decode(text(&frame).trim_end().as_bytes()), Some(frame));
    });
}

/// Everything that a client writes within a moment, as text.
fn heard(pty: &Pty, until: &str) -> String {
    let (mut all, mut room) = (String::new(), [0; 256]);
    let start = Instant::now();
    while !all.ends_with(until) {
        assert!(start.elapsed() < WAIT, "heard {all:?}, waited for {until:?}");
        let n = pty.read(&mut room, Duration::from_millis(100)).unwrap();
        all.push_str(&String::from_utf8_lossy(&room[..n]));
    }
    all
}

fn events(port: &mut impl CanPort, count: usize) -> Vec<CanFrame> {
    let start = Instant::now();
    let mut frames = Vec::new();
    while frames.len() < count {
        assert!(start.elapsed() < WAIT, "{} of {count} frames", frames.len());
        match port.receive().unwrap() {
            Some(CanEvent::Frame(frame)) => frames.push(frame),
            Some(CanEvent::Trouble(trouble)) => panic!("{trouble:?}"),
            None => std::thread::yield_now(),
        }
    }
    assert_eq!(port.receive(), Ok(None));
    frames
}

#[test]
fn a_port_opens_its_channel_and_closes_it() {
    let pty = Pty::open().unwrap();
    let mut port = open("arm", pty.path(), 1_000_000, &[]).unwrap();
    assert_eq!(heard(&pty, "O\r"), "\rC\rS8\rO\r");
    let frames = golden().map(|(frame, _)| frame);
    assert_eq!(port.send(&frames), Ok(4));
    let lines = golden().map(|(_, line)| line.replace(' ', "")).concat();
    assert_eq!(heard(&pty, "t47120702\r"), lines);
    drop(port);
    assert_eq!(heard(&pty, "C\r"), "C\r");
    let slow = open("arm", pty.path(), 125_000, &[]).unwrap();
    assert_eq!(heard(&pty, "O\r"), "\rC\rS4\rO\r");
    drop(slow);
    let error = open("arm", pty.path(), 123_456, &[]).err().unwrap().to_string();
    assert!(error.ends_with("slcan has no bit rate 123456"), "{error}");
}

#[test]
fn a_port_finds_frames_among_replies_noise_and_pieces() {
    let pty = Pty::open().unwrap();
    let filters = [CanFilter { id: 0x2A0, mask: 0x7F0 }];
    let mut port = open("arm", pty.path(), 1_000_000, &filters).unwrap();
    for piece in ["\r\rz\r\x07", "t2A5", "21234", "\rt151100\r", "t2A", "610", "7\r", "\u{1}\u{2}t2A71AA\rt2A80\r"] {
        pty.write(piece.as_bytes()).unwrap();
    }
    // The line behind the noise is lost with it; 0x151 is not wanted.
    let expected = [CanFrame::new(0x2A5, &[0x12, 0x34]), CanFrame::new(0x2A6, &[0x07]), CanFrame::new(0x2A8, &[])];
    assert_eq!(events(&mut port, 3), expected);
    pty.write(&[b'x'; 3000]).unwrap();
    pty.write(b"\rt2A01FF\r").unwrap();
    assert_eq!(events(&mut port, 1), [CanFrame::new(0x2A0, &[0xFF])], "after a flood of noise");
}

#[test]
fn a_frame_behind_many_replies_is_found() {
    let pty = Pty::open().unwrap();
    let mut port = open("arm", pty.path(), 1_000_000, &[]).unwrap();
    pty.write(format!("{}t0001F0\r", "z\r".repeat(1000)).as_bytes()).unwrap();
    let found = loop {
        assert!(wait(port.fd(), PollFlags::IN, WAIT).unwrap(), "a received frame must not wait for further bytes");
        if let Some(event) = port.receive().unwrap() {
            break event;
        }
    };
    assert_eq!(found, CanEvent::Frame(CanFrame::new(0, &[0xF0])));
}

#[test]
fn a_peer_that_reads_nothing_gets_whole_lines_later() {
    let pty = Pty::open().unwrap();
    let mut port = open("arm", pty.path(), 1_000_000, &[]).unwrap();
    let frame = |i: u32| CanFrame::new(0x100, &i.to_be_bytes());
    let burst: Vec<_> = (0..10_000).map(frame).collect();
    let taken = port.send(&burst).unwrap();
    assert!(taken > 0 && taken < burst.len(), "{taken}");
    let full = port.send(&burst).unwrap();
    assert_eq!(full, 0, "no room is left");
    let mut room = vec![0; 1 << 20];
    let mut text = String::new();
    let mut sent_again = false;
    let start = Instant::now();
    while !text.ends_with("t7FF0\r") {
        assert!(start.elapsed() < WAIT);
        let n = pty.read(&mut room, Duration::from_millis(1)).unwrap();
        text.push_str(&String::from_utf8_lossy(&room[..n]));
        sent_again = sent_again || port.send(&[CanFrame::new(0x7FF, &[])]).unwrap() == 1;
    }
    let frames: Vec<_> = text.split('\r').filter_map(|line| decode(line.as_bytes())).collect();
    let lines = text.split('\r').filter(|line| line.starts_with('t')).count();
    assert_eq!(frames.len(), lines, "no line is torn");
    let begun: Vec<_> = frames.into_iter().filter(|frame| frame.id == 0x100).collect();
    assert_eq!(begun, burst[..taken], "what was taken arrives, and nothing else");
}

#[test]
fn both_ends_understand_each_other() {
    let mut adapter = SlcanPty::open().unwrap();
    assert_eq!(adapter.send(&[CanFrame::new(1, &[1])]), Ok(1), "lost: no client has opened the channel");
    let CanAddress::Slcan { path, bit_rate } = adapter.address() else { panic!() };
    let mut port = open("arm", &path, bit_rate, &[]).unwrap();
    let frames = golden().map(|(frame, _)| frame);
    assert_eq!(port.send(&frames), Ok(4));
    assert_eq!(events(&mut adapter, 4), frames);
    assert!(adapter.channel_open());
    assert_eq!(adapter.send(&frames), Ok(4));
    assert_eq!(events(&mut port, 4), frames);
    drop(port);
    assert_eq!(adapter.receive(), Ok(None));
    assert!(!adapter.channel_open());
}

#[test]
fn the_adapter_replies_as_a_real_one_does() {
    let mut adapter = SlcanPty::open().unwrap();
    let client = crate::transport::serial::open_line("test", adapter.path(), 115_200).unwrap();
    let mut ask = |text: &str| {
        rustix::io::write(&client, text.as_bytes()).unwrap();
        let event = adapter.receive().unwrap();
        let mut room = [0; 64];
        let n = rustix::io::read(&client, &mut room).unwrap_or(0);
        (event.is_some(), String::from_utf8_lossy(&room[..n]).into_owned())
    };
    let said = |text: &str| (false, text.to_owned());
    assert_eq!(ask("t1551AA\r"), said("\x07"), "the channel is closed");
    assert_eq!(ask("C\r"), said("\r"));
    assert_eq!(ask("S8\r"), said("\r"));
    assert_eq!(ask("S9\r"), said("\x07"));
    assert_eq!(ask("O\r"), said("\r"));
    assert_eq!(ask("S8\r"), said("\x07"), "not while the channel is open");
    assert_eq!(ask("O\r"), said("\r"), "a second opening");
    assert_eq!(ask("hello\r"), said("\x07"));
    assert_eq!(ask("t1551AA\r"), (true, "z\r".to_owned()));
    assert_eq!(ask("t155"), said(""), "half a line");
    assert_eq!(ask("0\r"), (true, "z\r".to_owned()));
}

#[test]
fn an_unplugged_adapter_is_an_io_error() {
    let adapter = SlcanPty::open().unwrap();
    let mut port = open("arm", adapter.path(), 1_000_000, &[]).unwrap();
    drop(adapter);
    assert!(matches!(port.receive(), Err(AdapterError::Io(_))));
    assert!(matches!(port.send(&[CanFrame::default()]), Err(AdapterError::Io(_))));
    drop(port);
    let error = open("arm", "/dev/ttyACM77", 1_000_000, &[]).err().unwrap().to_string();
    assert!(error.contains("there is no such device\nhint: "), "{error}");
}

#[test]
fn a_discard_closes_the_channel_and_opens_it_again() {
    let pty = Pty::open().unwrap();
    let mut port = open("arm", pty.path(), 500_000, &[]).unwrap();
    assert_eq!(heard(&pty, "O\r"), "\rC\rS6\rO\r");
    let frames = golden().map(|(frame, _)| frame);
    assert_eq!(port.send(&frames), Ok(4));
    assert_eq!(port.discard(), Ok(0));
    assert_eq!(port.send(&frames[3..]), Ok(1));
    // What is still in this computer is flushed; a channel that is closed and opened again empties the adapter, too.
    let heard = heard(&pty, "O\rt47120702\r");
    assert!(heard.ends_with("\rC\rS6\rO\rt47120702\r"), "{heard:?}");
}

#[test]
fn frames_without_a_reply_are_counted_where_the_adapter_replies() {
    let pty = Pty::open().unwrap();
    let mut port = open("arm", pty.path(), 1_000_000, &[]).unwrap();
    let frames = golden().map(|(frame, _)| frame);
    port.send(&frames).unwrap();
    assert_eq!(port.waiting(), 0, "nothing is known of an adapter that has not replied yet");
    pty.write(b"z\r").unwrap();
    let start = Instant::now();
    while port.waiting() != 3 {
        assert!(start.elapsed() < WAIT && port.receive() == Ok(None));
    }
    port.send(&frames[..2]).unwrap();
    assert_eq!(port.waiting(), 5);
    pty.write(b"z\rz\rt0001F0\rZ\r").unwrap();
    assert_eq!(events(&mut port, 1), [CanFrame::new(0, &[0xF0])]);
    assert_eq!(port.waiting(), 2);
    // A reply was lost: an adapter that passes on later frames has processed everything.
    std::thread::sleep(Duration::from_millis(250));
    pty.write(b"t0001F0\r").unwrap();
    assert_eq!(events(&mut port, 1).len(), 1);
    assert_eq!(port.waiting(), 0);
}
