//! The device thread and an arm that streams its state.

use std::io::{Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use dimos::clock::MonotonicClock;
use dimos::hardware::adapter::{AdapterResult, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop};
use dimos::testing::MockAdapter;

use crate::device_stops::{LIMIT, spawn};
use crate::support::delegate::delegate;

/// An arm that streams its state: what has arrived waits at the other end of `arrived`.
struct Streaming {
    inner: MockAdapter,
    arrived: UnixStream,
}

impl ManipulatorAdapter for Streaming {
    delegate!(
        inner: connect, disconnect, is_connected, get_info, get_dof, get_limits, set_control_mode, get_control_mode,
        read_state, read_error, read_enabled, write_joint_positions, write_joint_velocities, write_stop, write_enable,
        write_clear_errors
    );

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.arrived.as_fd())
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        let _ = self.arrived.read(&mut [0; 64]);
        self.inner.read_joint_positions(positions)
    }
}

#[test]
fn a_state_that_arrives_is_read_at_once_however_long_the_next_one_takes() {
    let (arrived, mut arm) = UnixStream::pair().unwrap();
    arrived.set_nonblocking(true).unwrap();
    let mock = MockAdapter::new(6);
    // Without that it is read every 10 s.
    let adapter = Streaming { inner: mock.clone(), arrived };
    let (device, ..) = spawn(Box::new(adapter), 0.01, Arc::new(MonotonicClock));
    device.connect().wait(LIMIT).unwrap();
    let reads = || mock.calls().iter().filter(|call| call.name() == "read_joint_positions").count();
    for _ in 0..5 {
        let (before, began) = (reads(), Instant::now());
        arm.write_all(b"state").unwrap();
        while reads() == before {
            assert!(began.elapsed() < Duration::from_secs(4), "it was not read");
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    device.finish(false).wait(LIMIT).unwrap();
    device.join();
}
