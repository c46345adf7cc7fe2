//! Samples of whole ticks, packed in memory: most of a sample is as in the one before it, or zero.

use serde::{Deserialize, Serialize};

use dimos_core::clock::Mono;
use dimos_core::telemetry::{ArmSample, Event, Sample, TickSample};

/// Compression level: the fastest. Of samples with noise in their last digits, higher ones save little more.
const LEVEL: i32 = 1;

/// A sample in a block. Events are kept beside, as they are: they are few.
#[derive(Debug, Serialize, Deserialize)]
#[allow(clippy::large_enum_variant, reason = "most are the large one")]
enum Packed {
    Arm(ArmSample),
    Tick(TickSample),
    Event(u64),
}

/// Samples of consecutive ticks, the oldest first.
#[derive(Debug)]
pub(super) struct Block {
    packed: Vec<u8>,
    /// Size of `packed` when it is unpacked [bytes].
    length: usize,
    events: Vec<Event>,
    begin: Mono,
    end: Mono,
}

impl Block {
    /// Packs samples; the last should close a tick.
    pub fn pack(samples: impl IntoIterator<Item = Sample>) -> Self {
        let (mut begin, mut end, mut events) = (None, Mono::ZERO, Vec::new());
        let plain: Vec<Packed> = samples
            .into_iter()
            .map(|sample| match sample {
                Sample::Arm(arm) => Packed::Arm(arm),
                Sample::Tick(tick) => {
                    end = tick.deadline;
                    begin.get_or_insert(end);
                    Packed::Tick(tick)
                }
                Sample::Event(tick, event) => {
                    events.push(event);
                    Packed::Event(tick)
                }
            })
            .collect();
        // Neither fails: both write to memory.
        let plain = postcard::to_allocvec(&plain).unwrap_or_default();
        let mut packed = zstd::bulk::compress(&plain, LEVEL).unwrap_or_default();
        packed.shrink_to_fit();
        Self { packed, length: plain.len(), events, begin: begin.unwrap_or(end), end }
    }

    /// Returns its samples.
    pub fn unpack(self) -> impl Iterator<Item = Sample> {
        let plain = zstd::bulk::decompress(&self.packed, self.length).unwrap_or_default();
        let samples: Vec<Packed> = postcard::from_bytes(&plain).unwrap_or_default();
        let mut events = self.events.into_iter();
        samples.into_iter().filter_map(move |sample| match sample {
            Packed::Arm(arm) => Some(Sample::Arm(arm)),
            Packed::Tick(tick) => Some(Sample::Tick(tick)),
            Packed::Event(tick) => events.next().map(|event| Sample::Event(tick, event)),
        })
    }

    /// Returns its memory [bytes].
    pub fn size(&self) -> usize {
        size_of::<Self>() + self.packed.capacity() + self.events.capacity() * size_of::<Event>()
    }

    /// Returns the deadline of its first tick.
    pub fn begin(&self) -> Mono {
        self.begin
    }

    /// Returns the deadline of its last tick.
    pub fn end(&self) -> Mono {
        self.end
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use dimos_core::arm::{ArmCommand, ArmState, Link};
    use dimos_core::joint::{ControlMode, joints_of};
    use dimos_core::telemetry::{Cause, Outcome, Phase};

    /// A tick of arms with seven joints whose measurements are noise in every digit.
    pub fn tick(tick: u64, deadline: Mono, arms: u16) -> Vec<Sample> {
        let mut at = 1e3 * tick as f64;
        let mut noise = || {
            at += 1.0;
            joints_of(&std::array::from_fn::<f64, 7, _>(|joint| (at * (joint + 2) as f64).sin()))
        };
        let mut samples: Vec<Sample> = (0..arms)
            .map(|arm| {
                let state = ArmState {
                    seq: tick,
                    stamp: deadline,
                    dof: 7,
                    position: noise(),
                    velocity: noise(),
                    effort: Some(noise()),
                    gripper: Some(0.04),
                    enabled: true,
                    link: Link::Up,
                    written: tick,
                    ..ArmState::default()
                };
                let mode = Some(ControlMode::ServoPosition);
                let command = ArmCommand { seq: tick, mode, values: noise(), at: deadline, ..ArmCommand::default() };
                Sample::Arm(ArmSample { arm, state, command, phase: Phase::Ready, cause: Cause::Tracking(3, 0.2) })
            })
            .collect();
        samples.push(Sample::Tick(TickSample { tick, deadline, ..TickSample::default() }));
        samples
    }

    #[test]
    fn a_block_returns_its_samples_bit_for_bit_and_in_order() {
        let mut samples = Vec::new();
        for k in 0..50 {
            if k % 20 == 7 {
                samples.push(Sample::Event(k, Event::Request(k, Outcome::Accepted)));
            }
            samples.extend(tick(k, Mono(1000 + k), 2));
        }
        if let Some(Sample::Arm(arm)) = samples.first_mut() {
            arm.state.position[0] = -0.0;
            arm.state.velocity[1] = f64::INFINITY;
        }
        let block = Block::pack(samples.clone());
        assert_eq!((block.begin(), block.end()), (Mono(1000), Mono(1049)));
        assert!(block.size() < 50 * 700, "{}", block.size());
        let unpacked: Vec<Sample> = block.unpack().collect();
        assert_eq!(format!("{unpacked:?}"), format!("{samples:?}"));
    }
}
