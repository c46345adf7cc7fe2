//! Who the controller says it is: registers 1 and 2.

use super::super::model::Identity;

/// A firmware version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Firmware(pub [u16; 3]);

impl Firmware {
    /// Reads `MAJOR.MINOR.REVISION`, with or without a `v` before it.
    pub fn parse(text: &str) -> Option<Self> {
        let mut parts = text.strip_prefix(['v', 'V']).unwrap_or(text).splitn(3, '.').map(|part| {
            let digits = part.split(|c: char| !c.is_ascii_digit()).next().unwrap_or_default();
            digits.parse().ok()
        });
        Some(Self([parts.next()??, parts.next()??, parts.next()??]))
    }

    /// Whether it is this version or a newer one.
    pub fn at_least(self, major: u16, minor: u16, revision: u16) -> bool {
        self >= Self([major, minor, revision])
    }
}

impl std::fmt::Display for Firmware {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self([major, minor, revision]) = self;
        write!(f, "{major}.{minor}.{revision}")
    }
}

/// Decodes register 1: `axes,kind,arm serial,box serial,vMAJOR.MINOR.REVISION`, padded with NUL.
pub fn decode_version(data: &[u8]) -> Option<(Identity, Firmware)> {
    let text = first_text(data)?;
    let mut parts = text.split(',');
    let axes = parts.next()?.trim().parse().ok()?;
    let kind = parts.next()?.trim().parse().ok()?;
    let serial = parts.next()?.trim().to_owned();
    let firmware = Firmware::parse(parts.next_back()?.trim())?;
    Some((Identity { axes, kind, serial }, firmware))
}

/// Decodes register 2: the arm's serial number ends with NUL.
pub fn decode_serial(data: &[u8]) -> Option<String> {
    first_text(data).map(str::trim).filter(|text| !text.is_empty()).map(str::to_owned)
}

fn first_text(data: &[u8]) -> Option<&str> {
    let text = std::str::from_utf8(data.split(|byte| *byte == 0).next()?).ok()?;
    text.is_ascii().then_some(text)
}
