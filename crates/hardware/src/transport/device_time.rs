//! Translates a device's own time to the monotonic clock.

use dimos_core::clock::Mono;

/// Maximum drift of the device's clock against ours, as a fraction: the estimate relaxes at this rate.
const DRIFT: f64 = 1e-4;

/// Offset between a device's clock and ours, from the fastest packets.
///
/// A packet with the device's stamp `d` that arrives at `m` was measured at `d + offset`. Every packet shows that
/// `offset ≤ m − d`, with equality for one without transit time, so the smallest difference is the estimate. Stamps are
/// late by the fastest packet's transit time (loopback: tens of µs), and never early by more.
#[derive(Debug, Clone, Copy, Default)]
pub struct DeviceTime {
    /// Offset [ns], device time [ns] and arrival of the last packet.
    last: Option<(i128, u64, Mono)>,
}

impl DeviceTime {
    /// Returns when the device measured what it stamped `device_ns` [ns on its own clock] and what arrived at
    /// `arrival`. Starts over when the device's clock goes back (a restart).
    pub fn translate(&mut self, device_ns: u64, arrival: Mono) -> Mono {
        let difference = i128::from(arrival.0) - i128::from(device_ns);
        let offset = match self.last {
            // A measurement that is sent again is not newer.
            Some((offset, before, _)) if device_ns == before => {
                return Mono((i128::from(device_ns) + offset).clamp(0, i128::from(arrival.0)) as u64);
            }
            Some((offset, before, then)) if device_ns >= before => {
                let allowance = arrival.since(then).as_nanos() as f64 * DRIFT;
                difference.min(offset + allowance as i128)
            }
            _ => difference,
        };
        self.last = Some((offset, device_ns, arrival));
        Mono((i128::from(device_ns) + offset).clamp(0, i128::from(arrival.0)) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    #[test]
    fn the_fastest_packet_sets_the_offset() {
        let mut time = DeviceTime::default();
        // The device's zero is at 1000 ms of ours; packets take 3, 1, 5 ms.
        assert_eq!(time.translate(10 * MS, Mono(1013 * MS)), Mono(1013 * MS));
        assert_eq!(time.translate(20 * MS, Mono(1021 * MS)), Mono(1021 * MS));
        let late = time.translate(30 * MS, Mono(1035 * MS));
        assert!(late >= Mono(1031 * MS) && late < Mono(1031 * MS + 10_000), "{late:?}");
    }

    #[test]
    fn a_restarted_device_gets_a_new_offset_and_no_stamp_in_the_future() {
        let mut time = DeviceTime::default();
        time.translate(900 * MS, Mono(1000 * MS));
        assert_eq!(time.translate(0, Mono(5000 * MS)), Mono(5000 * MS));
        assert_eq!(time.translate(100 * MS, Mono(5050 * MS)), Mono(5050 * MS));
    }

    #[test]
    fn a_measurement_that_is_sent_again_keeps_its_stamp() {
        let mut time = DeviceTime::default();
        let stamp = time.translate(10 * MS, Mono(1013 * MS));
        for later in 1..1000 {
            assert_eq!(time.translate(10 * MS, Mono((1013 + 10 * later) * MS)), stamp);
        }
        let next = time.translate(10_010 * MS, Mono(11_014 * MS));
        assert!(next <= Mono(11_014 * MS) && next >= Mono(11_013 * MS), "{next:?}");
    }

    #[test]
    fn a_drifting_clock_is_followed() {
        let mut time = DeviceTime::default();
        let mut stamp = Mono::ZERO;
        for i in 0..10_000_u64 {
            // The device runs 50 ppm slow: each of its 10 ms takes 10.0005 of ours.
            stamp = time.translate(i * 10 * MS, Mono(1000 * MS + i * 10_000_500));
        }
        let error = (1000 * MS + 9_999 * 10_000_500) - stamp.0;
        assert!(error < 20_000, "{error} ns");
    }
}
