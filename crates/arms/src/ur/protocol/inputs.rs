//! The values that the adapter sends: orders for its program, and outputs. Registers from 24 on are free; a fieldbus
//! uses those below.

use super::rtde::{HEADER, kind};

/// An order for the program.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Order {
    /// Decelerate and hold.
    Hold,
    /// Follow joint positions [rad].
    Servo([f64; 6]),
    /// Keep joint velocities [rad/s].
    Speed([f64; 6]),
    /// Decelerate, and end the program.
    Stop,
}

impl Order {
    /// Its positions or velocities.
    pub fn values(self) -> Option<[f64; 6]> {
        match self {
            Self::Servo(values) | Self::Speed(values) => Some(values),
            Self::Hold | Self::Stop => None,
        }
    }

    /// Its number in the program.
    fn code(self) -> i32 {
        match self {
            Self::Hold => 0,
            Self::Servo(_) => 1,
            Self::Speed(_) => 2,
            Self::Stop => 3,
        }
    }
}

/// Values of the program's orders.
pub const ORDER: &str = "input_int_register_24,input_int_register_25,input_double_register_24,\
input_double_register_25,input_double_register_26,input_double_register_27,input_double_register_28,\
input_double_register_29";
/// Values of the digital outputs.
pub const DIGITAL: &str = "standard_digital_output_mask,standard_digital_output,configurable_digital_output_mask,\
configurable_digital_output,tool_digital_output_mask,tool_digital_output";
/// Values of the analog outputs.
pub const ANALOG: &str =
    "standard_analog_output_mask,standard_analog_output_type,standard_analog_output_0,standard_analog_output_1";
/// Their types.
pub const ORDER_TYPES: &str = "INT32,INT32,DOUBLE,DOUBLE,DOUBLE,DOUBLE,DOUBLE,DOUBLE";
/// See above.
pub const DIGITAL_TYPES: &str = "UINT8,UINT8,UINT8,UINT8,UINT8,UINT8";
/// See above.
pub const ANALOG_TYPES: &str = "UINT8,UINT8,DOUBLE,DOUBLE";

/// Length of an order's packet.
pub const ORDER_LENGTH: usize = HEADER + 1 + 8 + 48;

/// Returns the packet of an order, for the input recipe `id`. `count` differs from that of the order before. An order
/// without values carries `last`, those of the order before: what a step reads while the registers change is no jump.
pub fn order(id: u8, count: i32, order: Order, last: &[f64; 6]) -> [u8; ORDER_LENGTH] {
    let mut packet = [0; ORDER_LENGTH];
    let values = order.values().unwrap_or(*last);
    let numbers = [count, order.code()];
    let content = numbers.iter().flat_map(|n| n.to_be_bytes()).chain(values.iter().flat_map(|v| v.to_be_bytes()));
    let header = (ORDER_LENGTH as u16).to_be_bytes().into_iter().chain([kind::DATA, id]);
    packet.iter_mut().zip(header.chain(content)).for_each(|(to, byte)| *to = byte);
    packet
}

/// Returns the packet that sets digital output `number` (0 to 7 standard, 8 to 15 configurable, 16 and 17 tool) and
/// leaves the others as they are, for the input recipe `id`; `None` for another number.
pub fn digital(id: u8, number: u8, on: bool) -> Option<[u8; HEADER + 7]> {
    let mut packet = [0, HEADER as u8 + 7, kind::DATA, id, 0, 0, 0, 0, 0, 0];
    let (group, bit) = if number < 18 { (usize::from(number / 8), 1 << (number % 8)) } else { return None };
    let at = HEADER + 1 + 2 * group;
    packet.iter_mut().skip(at).zip([bit, if on { bit } else { 0 }]).for_each(|(to, byte)| *to = byte);
    Some(packet)
}

/// Returns the packet that sets analog output `number` (0 or 1) to a fraction of its range, as a voltage (0 to 10 V)
/// or as a current (4 to 20 mA), for the input recipe `id`; `None` for another number or fraction.
pub fn analog(id: u8, number: u8, voltage: bool, fraction: f64) -> Option<[u8; HEADER + 19]> {
    if number > 1 || !(0.0..=1.0).contains(&fraction) {
        return None;
    }
    let mut packet = [0; HEADER + 19];
    let (bit, at) = (1 << number, HEADER + 3 + 8 * usize::from(number));
    let head = [0, HEADER as u8 + 19, kind::DATA, id, bit, if voltage { bit } else { 0 }];
    packet.iter_mut().zip(head).for_each(|(to, byte)| *to = byte);
    packet.iter_mut().skip(at).zip(fraction.to_be_bytes()).for_each(|(to, byte)| *to = byte);
    Some(packet)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn orders_are_registers() {
        let packet = order(1, 0x0102, Order::Servo([1.0, 0.0, 0.0, 0.0, 0.0, -2.0]), &[9.0; 6]);
        assert_eq!(packet[..12], [0, 60, b'U', 1, 0, 0, 1, 2, 0, 0, 0, 1]);
        assert_eq!((&packet[12..20], &packet[52..]), (&1f64.to_be_bytes()[..], &(-2f64).to_be_bytes()[..]));
        let stop = order(1, -1, Order::Stop, &[1.0, 0.0, 0.0, 0.0, 0.0, -2.0]);
        assert_eq!(stop[4..12], [0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 0, 3]);
        assert_eq!(stop[12..], packet[12..], "the values of the order before");
        assert_eq!(ORDER.split(',').count(), ORDER_TYPES.split(',').count());
    }

    #[test]
    fn outputs_leave_the_others_as_they_are() {
        assert_eq!(digital(2, 3, true), Some([0, 10, b'U', 2, 8, 8, 0, 0, 0, 0]));
        assert_eq!(digital(2, 8, false), Some([0, 10, b'U', 2, 0, 0, 1, 0, 0, 0]));
        assert_eq!(digital(2, 17, true), Some([0, 10, b'U', 2, 0, 0, 0, 0, 2, 2]));
        assert_eq!(digital(2, 18, true), None);
        let packet = analog(3, 1, true, 0.5).unwrap();
        assert_eq!(packet[..6], [0, 22, b'U', 3, 2, 2]);
        assert_eq!((&packet[6..14], &packet[14..]), (&[0; 8][..], &0.5f64.to_be_bytes()[..]));
        assert_eq!((analog(3, 2, true, 0.5), analog(3, 0, true, 1.5)), (None, None));
        assert_eq!(DIGITAL.split(',').count(), DIGITAL_TYPES.split(',').count());
        assert_eq!(ANALOG.split(',').count(), ANALOG_TYPES.split(',').count());
    }
}
