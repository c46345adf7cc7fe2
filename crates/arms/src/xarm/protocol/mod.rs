//! The wire format of the controller: pure encoding and decoding, no I/O, no units but the wire's own (rad, mm, Nm).
//! Only the gripper's pulses are made of metres here, and back.
//!
//! Encoders write into the caller's buffer. Decoders answer `None` or skip for whatever bytes come; none allocates on
//! the way of a cycle, none panics.

pub mod commands;
pub mod frame;
pub mod gripper;
pub mod identity;
pub mod reduced;
pub mod report;
#[cfg(test)]
mod tests;

/// Takes numbers from fixed places of a packet; `None` beyond its end.
pub(super) mod take {
    /// Returns N bytes at an offset.
    pub fn bytes<const N: usize>(packet: &[u8], at: usize) -> Option<[u8; N]> {
        packet.get(at..)?.first_chunk().copied()
    }

    /// A little-endian f32, which must be finite.
    pub fn float(packet: &[u8], at: usize) -> Option<f64> {
        let value = f32::from_le_bytes(bytes(packet, at)?);
        value.is_finite().then_some(f64::from(value))
    }

    /// Returns N f32 values at an offset.
    pub fn floats<const N: usize>(packet: &[u8], at: usize) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for (i, value) in values.iter_mut().enumerate() {
            *value = float(packet, at + 4 * i)?;
        }
        Some(values)
    }
}
