//! The part of the conformance suite that is for devices that stream their state: an arm that does it
//! right, and arms that do it wrong in one way each.

use std::io::{Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::thread::JoinHandle;
use std::time::Duration;

use dimos::arms::mock;
use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::adapter::*;
use dimos::hardware::conformance::{Outcome, checks, run};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec};

use crate::support::delegate::delegate;

/// What is wrong with an adapter.
const NOTHING: u8 = 0;
const NEVER_WAKES: u8 = 1;
const READS_ONE_PACKET: u8 = 2;
const STAMPS_ANEW: u8 = 3;
const WAITS_FOR_NEWS: u8 = 4;
const GIVES_NO_STAMP: u8 = 5;

/// How often it sends.
const PERIOD: Duration = Duration::from_millis(5);

/// An arm in memory with a device that sends a time stamp over a socket, as often as a real one sends its state.
struct Pushed<const MISTAKE: u8> {
    inner: Box<dyn ManipulatorAdapter>,
    wire: Option<(UnixStream, JoinHandle<()>)>,
    /// A descriptor on which nothing ever comes.
    deaf: (UnixStream, UnixStream),
    stamp: Option<Mono>,
}

impl<const MISTAKE: u8> Pushed<MISTAKE> {
    const SPEC: AdapterSpec = AdapterSpec {
        name: "pushed",
        dof: (6, 6),
        native_rate: 200.0,
        create: |config: &AdapterConfig| {
            let inner = (mock::SPEC.create)(config)?;
            Ok(Box::new(Self { inner, wire: None, deaf: UnixStream::pair().unwrap(), stamp: None }))
        },
        ..mock::SPEC
    };

    /// Takes up one packet; `false` when none is there.
    fn take(&mut self) -> AdapterResult<bool> {
        let (wire, _) = self.wire.as_mut().ok_or(AdapterError::NotConnected)?;
        let mut packet = [0; 8];
        match wire.read_exact(&mut packet) {
            Ok(()) => {
                self.stamp = Some(Mono(u64::from_le_bytes(packet)));
                Ok(true)
            }
            Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => Ok(false),
            Err(e) => Err(AdapterError::Io(e.to_string())),
        }
    }
}

impl<const MISTAKE: u8> ManipulatorAdapter for Pushed<MISTAKE> {
    delegate!(
        inner: get_dof, get_limits, set_control_mode, get_control_mode, read_joint_positions, read_state, read_error,
        read_enabled, write_joint_positions, write_stop, write_enable, write_clear_errors
    );

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.inner.connect()?;
        let (near, mut far) = UnixStream::pair().unwrap();
        near.set_nonblocking(true).unwrap();
        let device = std::thread::spawn(move || {
            while far.write_all(&MonotonicClock.now().0.to_le_bytes()).is_ok() {
                std::thread::sleep(PERIOD);
            }
        });
        self.wire = Some((near, device));
        while !self.take()? {
            std::thread::sleep(Duration::from_millis(1));
        }
        Ok(())
    }

    fn disconnect(&mut self) {
        self.inner.disconnect();
        if let Some((wire, device)) = self.wire.take() {
            drop(wire);
            device.join().unwrap();
        }
        self.stamp = None;
    }

    fn is_connected(&self) -> bool {
        self.wire.is_some()
    }

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo { native_rate: 200.0, ..self.inner.get_info() }
    }

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        match MISTAKE {
            NEVER_WAKES => Some(self.deaf.0.as_fd()),
            _ => self.wire.as_ref().map(|(wire, _)| wire.as_fd()),
        }
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let mut news = self.take()?;
        while MISTAKE == WAITS_FOR_NEWS && !news {
            std::thread::sleep(Duration::from_micros(100));
            news = self.take()?;
        }
        while MISTAKE != READS_ONE_PACKET && self.take()? {}
        self.inner.read_joints(reading)?;
        reading.stamp = match MISTAKE {
            STAMPS_ANEW => Some(MonotonicClock.now()),
            GIVES_NO_STAMP => None,
            _ => self.stamp,
        };
        Ok(())
    }
}

fn outcome(row: &AdapterSpec, name: &str) -> Outcome {
    run(row, checks().find(|check| check.name == name).unwrap(), None)
}

#[test]
fn a_device_that_sends_by_itself_passes() {
    for name in ["state_wakes_its_reader", "reads_take_all_that_came", "reads_never_wait", "connecting_changes_nothing"]
    {
        assert_eq!(outcome(&Pushed::<NOTHING>::SPEC, name), Outcome::Passed, "{name}");
        println!("{name}: passed");
    }
}

#[test]
fn each_mistake_is_found_by_the_check_for_it() {
    for (row, name) in [
        (Pushed::<NEVER_WAKES>::SPEC, "state_wakes_its_reader"),
        (Pushed::<GIVES_NO_STAMP>::SPEC, "state_wakes_its_reader"),
        (Pushed::<READS_ONE_PACKET>::SPEC, "reads_take_all_that_came"),
        (Pushed::<STAMPS_ANEW>::SPEC, "reads_never_wait"),
        (Pushed::<WAITS_FOR_NEWS>::SPEC, "reads_never_wait"),
    ] {
        let outcome = outcome(&row, name);
        assert!(matches!(outcome, Outcome::Failed(_)), "{name}: {outcome:?}");
        println!("{name}: {outcome:?}");
    }
}
