//! The servos' settings that survive a power loss, as the follower arm needs them: gentle gains, a gripper that does
//! not crush, answers without delay. The values are those that LeRobot writes.

use super::bus::Bus;
use super::calibration::NAMES;
use super::protocol::register;
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::service;

/// Registers of all settings but the maximum acceleration are read at once: the first one, and how many.
const BLOCK: (u8, usize) = (7, 30);
/// Maximum acceleration.
const MAX_ACCELERATION: u8 = 85;

/// A setting.
struct Setting {
    name: &'static str,
    address: u8,
    /// Two bytes instead of one.
    wide: bool,
    /// The bits that it has of the register.
    mask: u16,
    value: u16,
    /// For the gripper only.
    gripper: bool,
}

impl Setting {
    const fn of_all(name: &'static str, address: u8, value: u16) -> Self {
        Self { name, address, wide: false, mask: 0xFF, value, gripper: false }
    }

    const fn of_gripper(name: &'static str, address: u8, wide: bool, value: u16) -> Self {
        Self { name, address, wide, mask: 0xFFFF, value, gripper: true }
    }
}

/// All settings.
const SETTINGS: [Setting; 10] = [
    Setting::of_all("return delay [2 µs]", 7, 0),
    Setting { mask: 0x10, ..Setting::of_all("positions over several turns", 18, 0) },
    Setting::of_all("P coefficient", 21, 16),
    Setting::of_all("D coefficient", 22, 32),
    Setting::of_all("I coefficient", 23, 0),
    Setting::of_all("control mode", register::MODE, 0),
    Setting::of_all("maximum acceleration [100 counts/s²]", MAX_ACCELERATION, 254),
    Setting::of_gripper("maximum torque [0.1 %]", 16, true, 500),
    Setting::of_gripper("protection current [6.5 mA]", 28, true, 250),
    Setting::of_gripper("overload torque [%]", 36, false, 25),
];

/// The registers of a servo that have settings.
struct Registers {
    block: [u8; BLOCK.1],
    max_acceleration: u8,
}

impl Registers {
    fn read(bus: &mut Bus, id: u8) -> AdapterResult<Self> {
        let [max_acceleration] = bus.read(id, MAX_ACCELERATION)?;
        Ok(Self { block: bus.read(id, BLOCK.0)?, max_acceleration })
    }

    /// Returns the register of a setting.
    fn of(&self, setting: &Setting) -> u16 {
        if setting.address == MAX_ACCELERATION {
            return self.max_acceleration.into();
        }
        let byte = |at: u8| self.block.get(usize::from(at - BLOCK.0)).copied().unwrap_or_default();
        let high = if setting.wide { byte(setting.address + 1) } else { 0 };
        u16::from_le_bytes([byte(setting.address), high])
    }
}

/// Calls `each` for every setting of every servo that has another value than wanted: the servo, the setting, its
/// register.
fn differing(
    bus: &mut Bus,
    mut each: impl FnMut(&mut Bus, u8, &Setting, u16) -> AdapterResult<()>,
) -> AdapterResult<()> {
    let gripper = *bus.ids().end();
    for id in bus.ids() {
        let registers = Registers::read(bus, id)?;
        for setting in SETTINGS.iter().filter(|setting| !setting.gripper || id == gripper) {
            let register = registers.of(setting);
            if register & setting.mask != setting.value {
                each(bus, id, setting, register)?;
            }
        }
    }
    Ok(())
}

/// Returns the settings with other values than wanted.
pub fn check(bus: &mut Bus) -> AdapterResult<Vec<service::Setting>> {
    let mut found = Vec::new();
    differing(bus, |bus, id, setting, register| {
        let motor = bus.index(id).and_then(|i| NAMES.get(i)).copied().unwrap_or_default();
        let Setting { name, address, value: wanted, .. } = *setting;
        found.push(service::Setting { motor, name, register: address.into(), found: register & setting.mask, wanted });
        Ok(())
    })?;
    Ok(found)
}

/// Writes the settings with other values than wanted, and reads them back. The motors must be off.
pub fn write(bus: &mut Bus) -> AdapterResult<()> {
    differing(bus, |bus, id, setting, register| {
        let [low, high] = (register & !setting.mask | setting.value).to_le_bytes();
        bus.unlocked(id, |bus| match setting.wide {
            true => bus.set(id, setting.address, [low, high]).map(drop),
            false => bus.set(id, setting.address, [low]).map(drop),
        })
    })?;
    match check(bus)?.as_slice() {
        [] => Ok(()),
        [first, ..] => Err(AdapterError::Protocol(format!("{}: {} is {} again", first.motor, first.name, first.found))),
    }
}
