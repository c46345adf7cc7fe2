//! The bus in memory behaves as the kernel's does, and plays the troubles that no kernel plays on demand.

use std::os::fd::AsFd;

use dimos::hardware::adapter::AdapterError;
use dimos::hardware::transport::can::bus::{Bus, RECEIVE_QUEUE};
use dimos::hardware::transport::can::{CanAddress, CanEvent, CanFilter, CanFrame, CanPort, CanTrouble, open};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

fn frame(id: u16, byte: u8) -> CanFrame {
    CanFrame::new(id, &[byte])
}

fn port(bus: &Bus, filters: &[CanFilter]) -> Box<dyn CanPort> {
    open("arm", &bus.address(), filters).unwrap()
}

/// Everything that has arrived.
fn all(port: &mut (impl CanPort + ?Sized)) -> Vec<CanEvent> {
    std::iter::from_fn(|| port.receive().unwrap()).collect()
}

fn frames(port: &mut (impl CanPort + ?Sized)) -> Vec<CanFrame> {
    let frame = |event| match event {
        CanEvent::Frame(frame) => frame,
        CanEvent::Trouble(trouble) => panic!("{trouble:?}"),
    };
    all(port).into_iter().map(frame).collect()
}

fn readable(port: &(impl CanPort + ?Sized)) -> bool {
    let fd = port.fd();
    let mut fds = [PollFd::from_borrowed_fd(fd.as_fd(), PollFlags::IN)];
    poll(&mut fds, Some(&Timespec { tv_sec: 0, tv_nsec: 0 })).unwrap() == 1
}

#[test]
fn every_port_hears_the_others_and_not_itself() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let (mut one, mut two) = (port(&bus, &[]), port(&bus, &[]));
    assert_eq!(one.send(&[frame(1, 1), frame(2, 2)]), Ok(2));
    assert_eq!(arm.send(&[frame(3, 3)]), Ok(1));
    assert_eq!(frames(&mut arm), [frame(1, 1), frame(2, 2)]);
    assert_eq!(frames(&mut *one), [frame(3, 3)]);
    assert_eq!(frames(&mut *two), [frame(1, 1), frame(2, 2), frame(3, 3)]);
}

#[test]
fn buses_do_not_hear_each_other() {
    let (left, right) = (Bus::new(), Bus::new());
    assert_ne!(left.address(), right.address());
    let (mut a, mut b) = (left.attach().unwrap(), right.attach().unwrap());
    port(&left, &[]).send(&[frame(1, 1)]).unwrap();
    assert_eq!((frames(&mut a).len(), frames(&mut b).len()), (1, 0));
}

#[test]
fn filters_apply_to_frames_and_never_to_trouble() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut port = port(&bus, &[CanFilter { id: 0x2A0, mask: 0x7F0 }, CanFilter { id: 0x251, mask: 0x7FF }]);
    arm.send(&[0x2A1, 0x251, 0x252, 0x151, 0x2AF].map(|id| frame(id, 0))).unwrap();
    bus.trouble(CanTrouble::Passive);
    let ids: Vec<_> = [0x2A1, 0x251, 0x2AF].map(|id| CanEvent::Frame(frame(id, 0))).to_vec();
    assert_eq!(all(&mut *port), [ids, vec![CanEvent::Trouble(CanTrouble::Passive)]].concat());
    assert_eq!(all(&mut arm), [], "the trouble is this computer's alone");
}

#[test]
fn a_port_is_readable_while_something_waits() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut port = port(&bus, &[]);
    assert!(!readable(&*port));
    arm.send(&[frame(1, 1), frame(1, 2)]).unwrap();
    assert!(readable(&*port));
    port.receive().unwrap();
    assert!(readable(&*port), "one is left");
    assert_eq!(all(&mut *port).len(), 1);
    assert!(!readable(&*port));
    bus.trouble(CanTrouble::BusOff);
    assert!(readable(&*port));
}

#[test]
fn a_queue_that_nobody_empties_is_bounded_and_says_so() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut port = port(&bus, &[]);
    for i in 0..RECEIVE_QUEUE as u32 * 2 {
        arm.send(&[CanFrame::new(1, &i.to_be_bytes())]).unwrap();
    }
    let got = all(&mut *port);
    assert_eq!(got.len(), RECEIVE_QUEUE);
    assert_eq!(got.last(), Some(&CanEvent::Trouble(CanTrouble::Overflow)));
    let in_order =
        |(i, event): (usize, &CanEvent)| *event == CanEvent::Frame(CanFrame::new(1, &(i as u32).to_be_bytes()));
    assert!(got.iter().enumerate().take(RECEIVE_QUEUE - 1).all(in_order));
    arm.send(&[frame(2, 2)]).unwrap();
    assert_eq!(frames(&mut *port), [frame(2, 2)], "and continues");
}

#[test]
fn a_full_queue_takes_fewer_frames() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut port = port(&bus, &[]);
    bus.refuse(2);
    assert_eq!(port.send(&[frame(1, 1), frame(2, 2), frame(3, 3)]), Ok(0));
    assert_eq!(port.send(&[frame(4, 4)]), Ok(0));
    assert_eq!(port.send(&[frame(5, 5)]), Ok(1));
    assert_eq!(frames(&mut arm), [frame(5, 5)], "what was refused never comes");
}

#[test]
fn unacknowledged_frames_wait_even_when_the_port_closes() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut first = port(&bus, &[]);
    bus.withhold(3);
    assert_eq!(first.send(&[frame(1, 1), frame(1, 2), frame(1, 3), frame(1, 4)]), Ok(3));
    assert_eq!(first.waiting(), 3);
    assert_eq!(arm.send(&[frame(9, 9)]), Ok(1), "an arm without power does not notice");
    assert_eq!((all(&mut arm), all(&mut *first)), (vec![], vec![]));
    drop(first);
    let mut second = port(&bus, &[]);
    assert_eq!((second.waiting(), second.send(&[frame(1, 5)])), (0, Ok(0)), "still full of the other's");
    assert_eq!(bus.acknowledge(), 3);
    assert_eq!(frames(&mut arm), [frame(1, 1), frame(1, 2), frame(1, 3)]);
    assert_eq!(second.send(&[frame(1, 6)]), Ok(1));
    assert_eq!(frames(&mut arm), [frame(1, 6)]);
}

#[test]
fn a_port_takes_back_its_own_frames_where_the_bus_lets_it() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let (mut one, mut two) = (port(&bus, &[]), port(&bus, &[]));
    bus.withhold(8);
    one.send(&[frame(1, 1), frame(1, 2)]).unwrap();
    two.send(&[frame(2, 1)]).unwrap();
    assert_eq!((one.discard(), one.waiting(), two.waiting()), (Ok(0), 0, 1));
    one.send(&[frame(1, 3)]).unwrap();
    bus.keep_waiting(true);
    assert_eq!((one.discard(), one.waiting()), (Ok(1), 1), "as on an interface of the system");
    assert_eq!(bus.acknowledge(), 2);
    assert_eq!(frames(&mut arm), [frame(2, 1), frame(1, 3)]);
    assert_eq!((one.discard(), two.discard()), (Ok(0), Ok(0)));
}

#[test]
fn an_interface_that_went_down_breaks_its_ports_for_good() {
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut old = port(&bus, &[]);
    bus.withhold(8);
    old.send(&[frame(1, 1)]).unwrap();
    bus.set_up(false);
    assert!(readable(&*old), "a waiting thread wakes up");
    let broken = AdapterError::Io(format!("the connection to arm at {} broke: the interface went down", bus.address()));
    assert_eq!(old.receive(), Err(broken.clone()));
    assert_eq!(old.send(&[frame(1, 1)]), Err(broken.clone()));
    let closed = open("arm", &bus.address(), &[]).err().unwrap().to_string();
    assert!(closed.ends_with("the interface is down"), "{closed}");
    arm.send(&[frame(2, 2)]).unwrap();
    bus.set_up(true);
    assert_eq!(old.receive(), Err(broken), "the old port stays broken");
    assert_eq!(bus.acknowledge(), 0, "nothing survives in the queue");
    let mut new = port(&bus, &[]);
    arm.send(&[frame(3, 3)]).unwrap();
    assert_eq!(frames(&mut *new), [frame(3, 3)]);
    new.send(&[frame(4, 4)]).unwrap();
    assert_eq!(frames(&mut arm), [frame(4, 4)]);
}

#[test]
fn a_bus_ends_with_its_owner() {
    let bus = Bus::new();
    let address = bus.address();
    let mut port = port(&bus, &[]);
    drop(bus);
    assert!(readable(&*port));
    assert_eq!(
        port.receive(),
        Err(AdapterError::Io(format!("the connection to arm at {address} broke: the bus is gone")))
    );
    let late = open("arm", &address, &[]).err().unwrap().to_string();
    assert_eq!(late, format!("cannot reach arm at {address}: this process has no such bus in memory"));
    assert!(open("arm", &CanAddress::Memory(u32::MAX), &[]).is_err());
}

#[test]
fn frames_cross_threads_in_order_and_none_is_lost() {
    const COUNT: u32 = 20_000;
    let bus = Bus::new();
    let mut arm = bus.attach().unwrap();
    let mut port = port(&bus, &[]);
    let sender = std::thread::spawn(move || {
        for i in 0..COUNT {
            // The other side is waited for now and then: the queue is bounded.
            arm.send(&[CanFrame::new(1, &i.to_be_bytes())]).unwrap();
            while i % 1000 == 999 && arm.receive().unwrap().is_none() {
                std::thread::yield_now();
            }
        }
    });
    let mut next = 0;
    while next < COUNT {
        assert!(readable_within(&*port, 30), "after {next} frames");
        for frame in frames(&mut *port) {
            assert_eq!(frame, CanFrame::new(1, &next.to_be_bytes()));
            next += 1;
            if next % 1000 == 0 {
                port.send(&[CanFrame::default()]).unwrap();
            }
        }
    }
    sender.join().unwrap();
}

fn readable_within(port: &(impl CanPort + ?Sized), seconds: i64) -> bool {
    let fd = port.fd();
    let mut fds = [PollFd::from_borrowed_fd(fd.as_fd(), PollFlags::IN)];
    poll(&mut fds, Some(&Timespec { tv_sec: seconds, tv_nsec: 0 })).unwrap() == 1
}
