//! Address of a CAN bus.

use std::fmt;

use crate::transport::serial::check_path;

/// Default bit rate [bit/s].
pub const BIT_RATE: u32 = 1_000_000;
/// The bit rates of slcan [bit/s]; the command is `S` and the index in this list.
pub const SLCAN_RATES: [u32; 9] = [10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000];
/// The forms of an address, for usage texts.
pub const FORMS: &str = "INTERFACE | slcan:/dev/ttyX[@BITRATE]";

/// Address of an arm's bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum CanAddress {
    /// A CAN interface of the system: `can0`.
    Interface(String),
    /// A serial adapter that speaks slcan: `slcan:/dev/ttyACM0@1000000`.
    Slcan {
        /// The serial device, or a pseudo-terminal.
        path: String,
        /// Bit rate of the CAN bus, not of the serial line [bit/s].
        bit_rate: u32,
    },
    /// A bus in this process: `memory:1`.
    Memory(u32),
}

impl CanAddress {
    /// Parses an address without opening it; the error is a sentence without full stop.
    pub fn parse(text: &str) -> Result<Self, String> {
        if let Some(number) = text.strip_prefix("memory:") {
            let number = number.parse().map_err(|_| format!("{number:?} is not the number of a bus in memory"))?;
            return Ok(Self::Memory(number));
        }
        if let Some(rest) = text.strip_prefix("slcan:") {
            let (path, bit_rate) = match rest.rsplit_once('@') {
                None => (rest, BIT_RATE),
                Some((path, rate)) => {
                    let known = rate.parse().ok().filter(|rate| SLCAN_RATES.contains(rate));
                    let names = || SLCAN_RATES.map(|rate| rate.to_string()).join(", ");
                    (path, known.ok_or_else(|| format!("{rate:?} is not a bit rate of slcan ({})", names()))?)
                }
            };
            check_path(path)?;
            return Ok(Self::Slcan { path: path.to_owned(), bit_rate });
        }
        // The kernel's rule for interface names.
        let bad = |c: char| c == '/' || c == ':' || c.is_whitespace() || c.is_control();
        match text {
            "" => Err("the CAN interface is missing".to_owned()),
            "." | ".." => Err(format!("{text:?} is not the name of a CAN interface")),
            _ if text.starts_with("/dev/") => {
                Err(format!("{text:?} is not the name of a CAN interface; a serial CAN adapter is slcan:{text}"))
            }
            _ if text.contains(bad) => Err(format!("{text:?} is not the name of a CAN interface")),
            _ if text.len() > 15 => Err(format!("{text:?} is too long for an interface (15 characters at most)")),
            _ => Ok(Self::Interface(text.to_owned())),
        }
    }
}

impl fmt::Display for CanAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Interface(name) => f.write_str(name),
            Self::Slcan { path, bit_rate } => write!(f, "slcan:{path}@{bit_rate}"),
            Self::Memory(number) => write!(f, "memory:{number}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_addresses_read_back_in_full() {
        let full = |text: &str| CanAddress::parse(text).map(|address| address.to_string());
        assert_eq!(full("can0"), Ok("can0".into()));
        assert_eq!(full("a23456789012345"), Ok("a23456789012345".into()));
        assert_eq!(full("memory:12"), Ok("memory:12".into()));
        assert_eq!(full("slcan:/dev/ttyACM0"), Ok("slcan:/dev/ttyACM0@1000000".into()));
        assert_eq!(full("slcan:/dev/pts/3@500000"), Ok("slcan:/dev/pts/3@500000".into()));
        for text in ["can0", "memory:0", "slcan:/dev/serial/by-id/usb-x-if00@125000"] {
            assert_eq!(CanAddress::parse(&full(text).unwrap()), CanAddress::parse(text));
        }
    }

    #[test]
    fn bad_addresses_are_refused() {
        let bad = ["", ".", "..", "can 0", "can/0", "can:0", "a234567890123456", "memory:", "memory:-1", "memory:x"];
        let slcan = ["slcan:", "slcan:ttyACM0", "slcan:/dev/ttyACM0@", "slcan:/dev/ttyACM0@9600", "slcan:/dev/", "\n"];
        for text in bad.iter().chain(&slcan) {
            let error = CanAddress::parse(text).expect_err(text);
            assert!(!error.ends_with('.'), "{error}");
        }
        assert!(CanAddress::parse("/dev/ttyACM0").unwrap_err().contains("slcan:/dev/ttyACM0"));
    }
}
