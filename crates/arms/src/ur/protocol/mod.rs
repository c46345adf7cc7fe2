//! The controller's protocols: RTDE, the dashboard's texts, the primary interface. All numbers on the wire are
//! big-endian; angles are in rad, lengths in m.

pub mod inputs;
pub mod primary;
pub mod rtde;
pub mod state;
pub mod status;

/// Reads big-endian numbers from the front of some bytes. Past the end everything is zero, and `ok` is false.
#[derive(Debug, Clone, Copy)]
pub struct Reader<'a> {
    bytes: &'a [u8],
    /// Whether all that was read was there.
    pub ok: bool,
}

impl<'a> Reader<'a> {
    /// Starts at the front.
    pub fn new(bytes: &'a [u8]) -> Self {
        Self { bytes, ok: true }
    }

    /// Takes the next bytes.
    pub fn take(&mut self, count: usize) -> &'a [u8] {
        match self.bytes.split_at_checked(count) {
            Some((taken, rest)) => {
                self.bytes = rest;
                taken
            }
            None => {
                self.ok = false;
                &[]
            }
        }
    }

    /// Takes what is left.
    pub fn rest(&mut self) -> &'a [u8] {
        std::mem::take(&mut self.bytes)
    }

    fn array<const N: usize>(&mut self) -> [u8; N] {
        self.take(N).try_into().unwrap_or([0; N])
    }

    /// Takes a byte.
    pub fn u8(&mut self) -> u8 {
        self.array::<1>()[0]
    }

    /// Takes a 32-bit number.
    pub fn u32(&mut self) -> u32 {
        u32::from_be_bytes(self.array())
    }

    /// Takes a signed 32-bit number.
    pub fn i32(&mut self) -> i32 {
        i32::from_be_bytes(self.array())
    }

    /// Takes a 64-bit number.
    pub fn u64(&mut self) -> u64 {
        u64::from_be_bytes(self.array())
    }

    /// Takes a floating-point number.
    pub fn f64(&mut self) -> f64 {
        f64::from_be_bytes(self.array())
    }

    /// Takes several of them.
    pub fn vector<const N: usize>(&mut self) -> [f64; N] {
        std::array::from_fn(|_| self.f64())
    }

    /// Takes several signed 32-bit numbers.
    pub fn integers<const N: usize>(&mut self) -> [i32; N] {
        std::array::from_fn(|_| self.i32())
    }
}
