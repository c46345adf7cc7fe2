//! Standard Modbus/TCP (protocol 0) at the control port. The emulated box has no coils and no registers of it; a client
//! gets the exception that Modbus has for this: without any answer, the vendor's waits for hours.

/// Exception: illegal function.
const ILLEGAL_FUNCTION: u8 = 1;

/// Writes the response to a request of protocol 0; `false` if the frame is none.
pub fn refuse(frame: &[u8], out: &mut Vec<u8>) -> bool {
    let [t0, t1, 0, 0, _, _, unit, function, ..] = *frame else { return false };
    out.clear();
    out.extend([t0, t1, 0, 0, 0, 3, unit, function | 0x80, ILLEGAL_FUNCTION]);
    true
}
