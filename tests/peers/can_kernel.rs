//! CAN interfaces over a real kernel, inside a guest (`support/uml.rs` says how, and how to write more of these).

#![cfg(all(feature = "can", target_os = "linux"))]

use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use dimos::hardware::adapter::AdapterError;
use dimos::hardware::transport::can::socket::SEND_QUEUE;
use dimos::hardware::transport::can::{
    CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble, SlcanPty, open as open_at,
};
use dimos::hardware::transport::serial::Pty;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::support::uml;
use crate::support::uml::{Guest, Part, in_guest, parts_in_guest, sh};

type Port = Box<dyn CanPort>;

/// A bus whose driver echoes a frame when it was transmitted.
const ECHO: &str = "
    rmmod vcan; insmod $(find /usr/lib/uml/modules/$(uname -r) -name vcan.ko) echo=1
    ip link add vcan9 type vcan; ip link set vcan9 up";
/// A bus, and an interface that is down.
const ONE_DOWN: &str = "ip link add vcan0 type vcan; ip link add can7 type vcan; ip link set vcan0 up";

/// Booting a guest takes longer than most of these: one guest makes all.
#[test]
fn interfaces_of_a_real_kernel() {
    let parts = uml::parts! {
        frames_go_both_ways: uml::VCAN;
        filters_are_the_kernels: uml::VCAN;
        error_frames_become_trouble: uml::VCAN;
        a_queue_that_nobody_empties_takes_fewer_frames: uml::VXCAN;
        frames_are_followed_by_the_memory_that_they_take: uml::VXCAN;
        closing_the_port_takes_nothing_back_and_taking_the_interface_down_does: uml::VXCAN;
        an_interface_that_goes_down_breaks_its_ports_for_good: uml::VCAN;
        what_cannot_be_opened_is_refused_with_a_hint: ONE_DOWN;
        an_interface_without_carrier_is_refused: uml::VXCAN;
        two_interfaces_do_not_hear_each_other: uml::VXCAN;
        many_frames_arrive_in_order_and_none_is_lost: uml::VXCAN;
        frames_that_nobody_fetches_in_time_are_reported_lost: uml::VCAN;
        the_kernels_slcan_driver_understands_the_emulated_adapter: "";
        the_kernel_tells_what_a_controller_reports: "";
        // Last: the module keeps its option.
        frames_are_followed_by_their_echoes: ECHO;
    };
    parts_in_guest(module_path!(), "interfaces_of_a_real_kernel", &Guest::with(""), &parts);
}

/// For what should take no time, on a busy machine.
const WAIT: Duration = Duration::from_secs(20);

fn open(name: &str, filters: &[CanFilter]) -> Port {
    open_at("arm", &CanAddress::parse(name).unwrap(), filters).unwrap()
}

fn refusal(name: &str) -> String {
    open_at("arm", &CanAddress::parse(name).unwrap(), &[]).err().expect("it is refused").to_string()
}

fn readable(port: &dyn CanPort, timeout: Duration) -> bool {
    let fd = port.fd();
    let timeout = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos() as i64 };
    poll(&mut [PollFd::from_borrowed_fd(fd.as_fd(), PollFlags::IN)], Some(&timeout)).unwrap() > 0
}

/// Returns exactly this number of events.
fn events(port: &mut Port, count: usize) -> Vec<CanEvent> {
    let mut events = Vec::new();
    while events.len() < count {
        assert!(readable(&**port, WAIT), "{} of {count} events: {events:?}", events.len());
        events.extend(std::iter::from_fn(|| port.receive().unwrap()));
    }
    assert!(!readable(&**port, Duration::from_millis(50)), "more than {count}: {events:?}");
    events
}

fn frames(port: &mut Port, count: usize) -> Vec<CanFrame> {
    let frame = |event| match event {
        CanEvent::Frame(frame) => frame,
        CanEvent::Trouble(trouble) => panic!("{trouble:?}"),
    };
    events(port, count).into_iter().map(frame).collect()
}

fn numbered(count: u32) -> Vec<CanFrame> {
    (0..count).map(|i| CanFrame::new(0x155, &i.to_be_bytes())).collect()
}

fn frames_go_both_ways() {
    let (mut arm, mut one, mut two) = (open("vcan0", &[]), open("vcan0", &[]), open("vcan0", &[]));
    let sent: Vec<_> = (0..=8).map(|n| CanFrame::new(0x7FF - n, &vec![0xA0 + n as u8; n as usize])).collect();
    assert_eq!(one.send(&sent), Ok(9));
    assert_eq!(frames(&mut arm, 9), sent);
    assert_eq!(frames(&mut two, 9), sent);
    assert_eq!(arm.send(&sent[3..5]), Ok(2));
    assert_eq!(frames(&mut one, 2), sent[3..5], "and not what it sent itself");
    assert!(matches!(one.send(&[CanFrame::new(0x800, &[])]), Err(AdapterError::Protocol(_))));
    // What another program sends.
    sh("cansend vcan0 471#0702");
    assert_eq!(frames(&mut arm, 1), [CanFrame::new(0x471, &[7, 2])]);
}

fn filters_are_the_kernels() {
    let filters = [CanFilter { id: 0x2A0, mask: 0x7F0 }, CanFilter { id: 0x251, mask: 0x7FF }];
    let (mut some, mut all, mut arm) = (open("vcan0", &filters), open("vcan0", &[]), open("vcan0", &[]));
    let ids = [0x2A1, 0x251, 0x252, 0x151, 0x2AF];
    arm.send(&ids.map(|id| CanFrame::new(id, &[1]))).unwrap();
    let got: Vec<_> = frames(&mut some, 3).iter().map(|frame| frame.id).collect();
    assert_eq!(got, [0x2A1, 0x251, 0x2AF]);
    assert_eq!(frames(&mut all, 5).len(), 5);
    // Extended identifiers and remote requests match no filter, whatever their lower bits.
    sh("cansend vcan0 000002A1#11; cansend vcan0 2A1#R; cansend vcan0 2A1#22");
    assert_eq!(frames(&mut some, 1), [CanFrame::new(0x2A1, &[0x22])]);
    assert_eq!(frames(&mut all, 1), [CanFrame::new(0x2A1, &[0x22])]);
}

fn error_frames_become_trouble() {
    let mut port = open("vcan0", &[CanFilter { id: 0x2A1, mask: 0x7FF }]);
    // Error classes and data bytes as drivers send them.
    let cases = [
        ("20000040#0000000000000000", CanTrouble::BusOff),
        ("20000020#0000000000000000", CanTrouble::NoAcknowledge),
        ("20000204#0020000000008000", CanTrouble::Passive),
        ("20000100#0000000000000000", CanTrouble::Restarted),
        ("20000004#0001000000000000", CanTrouble::Overflow),
        ("20000001#0000000000000000", CanTrouble::Other(1)),
    ];
    for (frame, expected) in cases {
        sh(&format!("cansend vcan0 {frame}"));
        assert_eq!(events(&mut port, 1), [CanEvent::Trouble(expected)], "{frame}");
    }
}

/// Two bounds apply to what waits: the interface's queue and the socket's own.
fn a_queue_that_nobody_empties_takes_fewer_frames() {
    // Four frames of 16 bytes and a little.
    sh("tc qdisc add dev can0 root plug limit 80; tc qdisc change dev can0 root plug block");
    let (mut port, mut arm) = (open("can0", &[]), open("sim0", &[]));
    let sent = numbered(100);
    let taken = port.send(&sent).unwrap();
    assert!((1..=6).contains(&taken), "ENOBUFS from the interface: {taken}");
    assert_eq!((port.waiting(), port.send(&sent)), (taken, Ok(0)));
    sh("tc qdisc change dev can0 root plug release_indefinite");
    assert_eq!(frames(&mut arm, taken), sent[..taken]);
    assert_eq!(port.waiting(), 0);
    assert_eq!(port.send(&sent[50..52]), Ok(2), "and continues");
    assert_eq!(frames(&mut arm, 2), sent[50..52]);

    sh("tc qdisc change dev can0 root plug limit 100000; tc qdisc change dev can0 root plug block");
    let taken = port.send(&sent).unwrap();
    assert!((SEND_QUEUE / 2..=SEND_QUEUE * 2).contains(&taken), "EAGAIN from the socket: {taken}");
    println!("the socket may have {taken} frames in the kernel, for {SEND_QUEUE} wanted");
    assert_eq!(port.waiting(), taken);
    sh("tc qdisc change dev can0 root plug release_indefinite");
    assert_eq!(frames(&mut arm, taken), sent[..taken]);
}

/// What a port has sent is followed until it is transmitted, and never heard by the port itself.
fn followed_until_transmitted(name: &str, peer: &str) {
    let commands = [CanFilter { id: 0x150, mask: 0x7F0 }];
    let (mut port, mut arm) = (open(name, &commands), open(peer, &[CanFilter { id: 0x155, mask: 0x7FF }]));
    sh(&format!("tc qdisc add dev {name} root plug limit 100000; tc qdisc change dev {name} root plug block"));
    let sent = numbered(5);
    assert_eq!((port.send(&sent), port.waiting()), (Ok(5), 5));
    assert_eq!((port.receive(), port.waiting()), (Ok(None), 5));
    assert_eq!(port.discard(), Ok(5), "nothing of it can be taken back");
    assert!((SEND_QUEUE / 2..=SEND_QUEUE).contains(&(5 + port.send(&numbered(100)).unwrap())), "nor does more fit");
    sh(&format!("tc qdisc change dev {name} root plug release_indefinite"));
    assert!(readable(&*arm, WAIT));
    let heard = std::iter::from_fn(|| arm.receive().unwrap()).take(5);
    assert_eq!(heard.collect::<Vec<_>>(), sent.iter().map(|frame| CanEvent::Frame(*frame)).collect::<Vec<_>>());
    assert_eq!((port.receive(), port.waiting(), port.discard()), (Ok(None), 0, Ok(0)));
    let rest = std::iter::from_fn(|| arm.receive().unwrap()).count();
    assert!(rest < SEND_QUEUE, "{rest}");
    for _ in 0..100 {
        assert_eq!(port.send(&sent[..4]), Ok(4), "and continues");
        let began = Instant::now();
        while port.waiting() > 0 && began.elapsed() < WAIT {
            assert_eq!(port.receive(), Ok(None));
        }
        assert_eq!(port.waiting(), 0);
    }
    assert_eq!(frames(&mut arm, 400).len(), 400);
}

/// An interface whose driver does not say when a frame was transmitted: what waits shows in the kernel's memory.
fn frames_are_followed_by_the_memory_that_they_take() {
    followed_until_transmitted("can0", "sim0");
}

/// An interface whose driver echoes a frame when it was transmitted, as those of real controllers do.
fn frames_are_followed_by_their_echoes() {
    followed_until_transmitted("vcan9", "vcan9");
}

/// The arm has lost its power: what is in the kernel's queue goes out when it is back, unless the interface goes down.
fn closing_the_port_takes_nothing_back_and_taking_the_interface_down_does() {
    sh("tc qdisc add dev can0 root plug limit 100000; tc qdisc change dev can0 root plug block");
    let (mut port, mut arm) = (open("can0", &[]), open("sim0", &[]));
    let sent = numbered(5);
    assert_eq!(port.send(&sent), Ok(5));
    drop(port);
    let mut port = open("can0", &[]);
    assert_eq!(port.waiting(), 0, "they are the old socket's");
    assert_eq!(port.send(&[CanFrame::new(0x472, &[1])]), Ok(1));
    assert!(!readable(&*arm, Duration::from_millis(100)));
    sh("tc qdisc change dev can0 root plug release_indefinite");
    let heard = frames(&mut arm, 6);
    assert_eq!(heard[..5], sent, "stale commands come first");
    assert_eq!(heard[5].id, 0x472, "and then what was asked after them");

    sh("tc qdisc change dev can0 root plug block");
    assert_eq!(port.send(&sent), Ok(5));
    sh("ip link set can0 down; ip link set can0 up; tc qdisc change dev can0 root plug release_indefinite");
    let mut port = open("can0", &[]);
    assert_eq!(port.send(&[CanFrame::new(0x472, &[2])]), Ok(1));
    // The arm's end of the pair noticed nothing but lost its carrier.
    assert_eq!(frames(&mut arm, 1), [CanFrame::new(0x472, &[2])]);
}

fn an_interface_that_goes_down_breaks_its_ports_for_good() {
    let gone = |why: &str| AdapterError::Io(format!("the connection to arm at vcan0 broke: {why}"));
    let (mut reader, mut writer) = (open("vcan0", &[]), open("vcan0", &[]));
    assert!(!readable(&*reader, Duration::ZERO));
    sh("ip link set vcan0 down");
    assert!(readable(&*reader, WAIT), "a waiting thread wakes up");
    assert_eq!(reader.receive(), Err(gone("the interface went down")));
    assert_eq!(writer.send(&numbered(1)), Err(gone("the interface went down")));
    assert!(refusal("vcan0").contains("the interface is down\nhint: ip link set vcan0 up type can bitrate 1000000"));
    sh("ip link set vcan0 up");
    assert_eq!(reader.receive(), Err(gone("the interface went down")), "the old port stays broken");
    assert_eq!(reader.send(&numbered(1)), Err(gone("the interface went down")));
    let (mut reader, mut writer) = (open("vcan0", &[]), open("vcan0", &[]));
    assert_eq!(writer.send(&numbered(3)), Ok(3));
    assert_eq!(frames(&mut reader, 3), numbered(3));
    sh("ip link del vcan0");
    // Down first, then gone: either is the truth.
    let error = reader.receive().unwrap_err();
    assert!([gone("the interface went down"), gone("the interface is gone")].contains(&error), "{error}");
    assert!(matches!(writer.send(&numbered(1)), Err(AdapterError::Io(_))));
    assert!(refusal("vcan0").contains("there is no such interface"));
}

fn what_cannot_be_opened_is_refused_with_a_hint() {
    let start = |name: &str| format!("cannot open CAN interface {name} for arm: ");
    let others = "\nhint: the CAN interfaces here are can7, vcan0";
    assert_eq!(refusal("can1"), format!("{}there is no such interface{others}", start("can1")));
    assert_eq!(refusal("lo"), format!("{}it is no CAN interface{others}", start("lo")));
    let down = "the interface is down\nhint: ip link set can7 up type can bitrate 1000000 (as root; for a virtual \
                interface: ip link set can7 up)";
    assert_eq!(refusal("can7"), start("can7") + down);
    sh("ip link set can7 up");
    open("can7", &[]);
    sh("ip link del can7; ip link del vcan0");
    assert!(refusal("can7").contains("hint: no CAN interface is there"), "{}", refusal("can7"));
}

/// As after bus-off: the kernel swallows what is sent.
fn an_interface_without_carrier_is_refused() {
    sh("ip link set sim0 down");
    let error = refusal("can0");
    assert!(error.starts_with("cannot open CAN interface can0 for arm: it has no carrier: "), "{error}");
    assert!(error.contains("\nhint: ") && error.contains("ip link set can0 down; ip link set can0 up"), "{error}");
    sh("ip link set sim0 up");
    open("can0", &[]);
}

fn two_interfaces_do_not_hear_each_other() {
    let names = ["vcan0", "vcan1", "can0", "can1", "sim0", "sim1"];
    let mut ports = names.map(|name| open(name, &[]));
    for (i, port) in ports.iter_mut().enumerate() {
        assert_eq!(port.send(&[CanFrame::new(0x2A5, &[i as u8])]), Ok(1));
    }
    // The pairs are one bus each, the others have no second port.
    let expected: [&[u8]; 6] = [&[], &[], &[4], &[5], &[2], &[3]];
    for ((port, heard), name) in ports.iter_mut().zip(expected).zip(names) {
        let bytes: Vec<u8> = frames(port, heard.len()).iter().map(|frame| frame.data[0]).collect();
        assert_eq!(bytes, heard, "{name}");
    }
}

fn many_frames_arrive_in_order_and_none_is_lost() {
    const COUNT: u32 = 10_000;
    /// The sender waits for a word now and then: buffers are bounded.
    const WORD_EVERY: u32 = 100;
    let (mut port, mut arm) = (open("can0", &[]), open("sim0", &[]));
    let begin = Instant::now();
    let sender = std::thread::spawn(move || {
        for frame in numbered(COUNT) {
            while arm.send(&[frame]).unwrap() == 0 {
                std::thread::yield_now();
            }
            if frame.data[..4] == [0; 4] || u32::from_be_bytes(frame.data[..4].try_into().unwrap()) % WORD_EVERY > 0 {
                continue;
            }
            assert!(readable(&*arm, WAIT), "no word");
            assert!(matches!(arm.receive(), Ok(Some(CanEvent::Frame(_)))));
        }
    });
    let mut next = 0;
    while next < COUNT {
        assert!(readable(&*port, WAIT), "after {next} frames");
        while let Some(event) = port.receive().unwrap() {
            assert_eq!(event, CanEvent::Frame(CanFrame::new(0x155, &next.to_be_bytes())));
            if next > 0 && next % WORD_EVERY == 0 {
                assert_eq!(port.send(&[CanFrame::default()]), Ok(1));
            }
            next += 1;
        }
    }
    let per_frame = begin.elapsed() / COUNT;
    println!("{COUNT} frames, {per_frame:?} each");
    sender.join().unwrap();
}

fn frames_that_nobody_fetches_in_time_are_reported_lost() {
    const COUNT: u32 = 10_000;
    let (mut port, mut arm) = (open("vcan0", &[]), open("vcan0", &[]));
    for frame in numbered(COUNT) {
        assert_eq!(arm.send(&[frame]), Ok(1));
    }
    let got: Vec<_> = std::iter::from_fn(|| port.receive().unwrap()).collect();
    assert_eq!(got.last(), Some(&CanEvent::Trouble(CanTrouble::Overflow)));
    let kept = numbered(got.len() as u32 - 1);
    assert!(kept.len() >= 500, "a Piper's frames of 150 ms fit in any case: {}", kept.len());
    assert!(got.iter().zip(&kept).all(|(event, frame)| *event == CanEvent::Frame(*frame)), "the oldest are kept");
    println!("{} frames fit", kept.len());
    arm.send(&numbered(1)).unwrap();
    assert_eq!(frames(&mut port, 1), numbered(1), "the loss is reported once");
}

/// Runs a command while the adapter does as the kernel's driver says.
fn while_serving(adapter: &mut dyn CanPort, command: &str) {
    std::thread::scope(|scope| {
        let command = scope.spawn(|| sh(command));
        while !command.is_finished() {
            assert_eq!(adapter.receive(), Ok(None));
            readable(adapter, Duration::from_millis(10));
        }
    });
    assert_eq!(adapter.receive(), Ok(None));
}

/// The kernel's own driver for serial CAN adapters takes our double for one.
fn the_kernels_slcan_driver_understands_the_emulated_adapter() {
    let mut adapter = SlcanPty::open().unwrap();
    sh(&format!("slcan_attach -n can0 {}", adapter.path()));
    assert!(refusal("can0").contains("the interface is down\nhint: ip link set can0 up type can bitrate 1000000"));
    // The driver sets the bit rate and opens the channel meanwhile.
    while_serving(&mut adapter, "ip link set can0 up type can bitrate 1000000");
    assert!(adapter.channel_open());
    let mut port = open("can0", &[]);
    let sent = [CanFrame::new(0x471, &[7, 2]), CanFrame::new(0x7FF, &[]), CanFrame::new(0, &[0xAB; 8])];
    assert_eq!(port.send(&sent), Ok(3));
    let mut adapter: Port = Box::new(adapter);
    assert_eq!(frames(&mut adapter, 3), sent);
    assert_eq!(adapter.send(&sent), Ok(3));
    assert_eq!(frames(&mut port, 3), sent);
    while_serving(&mut *adapter, "ip link set can0 down");
    assert!(matches!(port.receive(), Err(AdapterError::Io(_))));
    while_serving(&mut *adapter, "ip link set can0 up");
    assert_eq!(open("can0", &[]).send(&sent), Ok(3));
    assert_eq!(frames(&mut adapter, 3), sent, "and up again");
}

/// A controller in trouble, by way of the kernel's driver for serial CAN adapters: its adapters tell their state as `s`
/// lines (state, counters) and errors as `e` lines.
fn the_kernel_tells_what_a_controller_reports() {
    let pty = Pty::open().unwrap();
    sh(&format!("slcan_attach -s8 -o -n can0 {}; ip link set can0 up", pty.path()));
    let mut port = open("can0", &[CanFilter { id: 1, mask: 0x7FF }]);
    let mut report = |line: &str| {
        pty.write(line.as_bytes()).unwrap();
        match events(&mut port, 1)[..] {
            [CanEvent::Trouble(trouble)] => trouble,
            ref other => panic!("{line:?}: {other:?}"),
        }
    };
    assert_eq!(report("sw097003\r"), CanTrouble::Other(0x204), "a warning, with its counters");
    assert_eq!(report("sp003129\r"), CanTrouble::Passive);
    assert_eq!(report("e1a\r"), CanTrouble::NoAcknowledge);
    assert_eq!(report("e1o\r"), CanTrouble::Overflow);
    assert_eq!(report("sa000000\r"), CanTrouble::Restarted);
    assert_eq!(report("sb000256\r"), CanTrouble::BusOff);
    assert_eq!(port.send(&numbered(2)), Ok(2), "swallowed without a word");
    assert!(refusal("can0").contains("it has no carrier: its controller is bus-off"));
    sh("ip link set can0 down; ip link set can0 up");
    let mut port = open("can0", &[]);
    let mut room = [0; 256];
    while pty.read(&mut room, Duration::from_millis(50)).unwrap() > 0 {}
    assert_eq!(port.send(&[CanFrame::new(0x472, &[1])]), Ok(1));
    let n = pty.read(&mut room, WAIT).unwrap();
    assert_eq!(room[..n], *b"t472101\r", "and nothing from before");
}

/// A test in a guest that could not fail would be worth nothing.
#[test]
fn a_guest_tells_how_its_script_ended() {
    let limit = Duration::from_secs(100);
    let Some(ran) = uml::run(&[], "echo one; sh -c 'exit 7'; echo two", limit) else { return };
    assert_eq!((ran.status, ran.output.as_str()), (7, "one\n"), "the first failure ends it");
    let text = |panic: Box<dyn std::any::Any + Send>| *panic.downcast::<String>().expect("a message");
    let late = std::panic::catch_unwind(|| uml::run(&[], "sleep 1000", Duration::from_secs(1)));
    assert!(text(late.err().expect("too late")).starts_with("the guest did not end within 1s"));
    let missing = uml::run(&["net/can/none"], "true", limit).expect("tools");
    assert_ne!(missing.status, 0, "a module that is not there");
}

/// Nor would one that runs nothing, or hides a part that fails.
#[test]
fn a_part_that_fails_in_a_guest_fails_its_test() {
    let nothing = || in_guest(module_path!(), "no_such_test", &Guest::with(""), || {});
    let parts = [
        Part { name: "fails", setup: "", body: || panic!("a part that fails") },
        Part { name: "passes", setup: uml::VCAN, body: || sh("ip link show vcan1") },
        Part { name: "is_cleared", setup: "", body: || sh("! ip link show vcan1") },
        Part { name: "cannot_begin", setup: "false", body: || {} },
    ];
    let name = "a_part_that_fails_in_a_guest_fails_its_test";
    let failing = || parts_in_guest(module_path!(), name, &Guest::with(""), &parts);
    if uml::inside() {
        return failing();
    }
    let Some(said) = uml::failure(nothing) else { return };
    assert!(said.starts_with("no test is named can_kernel::no_such_test"), "{said}");
    let said = uml::failure(failing).expect("it fails");
    assert!(said.contains("--- passes\n") && said.contains("2 parts failed: fails, cannot_begin"), "{said}");
}
