//! Decoding rates of packets.

use std::hint::black_box;
use std::time::Instant;

use dimos::arms::xarm::protocol::report::Motion;

use crate::support::Effort;
use crate::support::measure::{Goal, Measure, print};

/// Returns the packets per second of a decoder, in thousands.
fn rate(packets: u64, mut decode: impl FnMut(u64)) -> f64 {
    let began = Instant::now();
    (0..packets).for_each(&mut decode);
    packets as f64 / began.elapsed().as_secs_f64() / 1e3
}

/// Measures all decoders.
pub fn measure(effort: Effort) -> Result<(), String> {
    let (repeats, packets) = (effort.of(1, 11), effort.of(10_000, 1_000_000));
    let full = [0_u8; 804];
    let xarm = (0..repeats).map(|_| {
        rate(packets, |_| {
            black_box(Motion::decode_full(black_box(&full)));
        })
    });
    let mut measures =
        vec![Measure::new("xArm reports of port 30000", "k/s", xarm.collect()).goal(Goal::AtLeast(200.0))];
    measures.push(Measure::new("Piper frames, assembled", "k/s", piper(repeats, packets)).goal(Goal::AtLeast(1000.0)));
    print("decoding, one thread", &measures);
    Ok(())
}

/// Decodes the frames of one burst of a Piper repeatedly, and assembles them to the arm's feedback.
fn piper(repeats: usize, packets: u64) -> Vec<f64> {
    use dimos::arms::piper::feedback::Feedback;
    use dimos::arms::piper::protocol::decode;
    use dimos::clock::{Clock, MonotonicClock};
    use dimos::hardware::transport::can::CanFrame;
    let ids = [0x2A1, 0x2A2, 0x2A3, 0x2A4, 0x2A5, 0x2A6, 0x2A7, 0x2A8, 0x251, 0x252, 0x253, 0x254, 0x255, 0x256, 0x261];
    let frames = ids.map(|id| CanFrame::new(id, &[0, 0, 0, 1, 0, 0, 0, 2]));
    let now = MonotonicClock.now();
    let one = || {
        let mut feedback = Feedback::default();
        rate(packets, |k| {
            if let Some(frame) = frames.get(k as usize % frames.len()) {
                feedback.take(decode(black_box(frame)), now);
            }
            black_box(&feedback);
        })
    };
    (0..repeats).map(|_| one()).collect()
}
