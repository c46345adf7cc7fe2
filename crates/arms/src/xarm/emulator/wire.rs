//! The control port as the controller sees it: requests in, responses out. Written from the vendor's pages a second
//! time, on purpose without `protocol`: an emulator that shared the adapter's encoders would share its mistakes.

use dimos_hardware::transport::tcp::Scan;

/// A request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Request<'a> {
    /// Echoed in the response.
    pub transaction: [u8; 2],
    /// Echoed in the response: 2, or 3 from a client that is watched.
    pub protocol: u8,
    /// What it is about.
    pub register: u8,
    /// What follows.
    pub payload: &'a [u8],
}

/// Returns the length of the request at the front of what has arrived. A sign of life of old clients (protocol 1) is
/// not answered, nor a Modbus request (protocol 0) without a function. `None`: this is no request, so the client is not
/// one of this protocol. What it sends may contain requests, such as the body of a web page's HTTP request.
pub fn scan(bytes: &[u8]) -> Option<Scan<()>> {
    let (high, protocol) = (*bytes.get(2).unwrap_or(&0), *bytes.get(3).unwrap_or(&0));
    if high != 0 || protocol > 3 {
        return None;
    }
    let &[_, _, _, _, l0, l1, ..] = bytes else { return Some(Scan::More) };
    let length = usize::from(l0) << 8 | usize::from(l1);
    if length == 0 || length > 400 {
        return None;
    }
    Some(match bytes.len() >= 6 + length {
        false => Scan::More,
        true if protocol == 1 || (protocol == 0 && length < 2) => Scan::Skip(6 + length),
        true => Scan::Take(6 + length, ()),
    })
}

/// The parts of a request that [`scan`] found.
pub fn parts(frame: &[u8]) -> Option<Request<'_>> {
    match frame {
        [t0, t1, _, protocol, _, _, register, payload @ ..] => {
            Some(Request { transaction: [*t0, *t1], protocol: *protocol, register: *register, payload })
        }
        _ => None,
    }
}

/// The n-th number of a payload after `skip` bytes.
pub fn number(payload: &[u8], skip: usize, n: usize) -> Option<f32> {
    let [a, b, c, d] = *payload.get(skip + 4 * n..)?.first_chunk()?;
    Some(f32::from_bits(u32::from(d) << 24 | u32::from(c) << 16 | u32::from(b) << 8 | u32::from(a)))
}

/// Returns the first N numbers of a payload.
pub fn numbers<const N: usize>(payload: &[u8]) -> Option<[f32; N]> {
    let mut values = [0.0; N];
    for (n, value) in values.iter_mut().enumerate() {
        *value = number(payload, 0, n)?;
    }
    Some(values)
}

/// Adds numbers to a payload.
pub fn put_numbers(out: &mut Vec<u8>, values: impl IntoIterator<Item = f32>) {
    values.into_iter().for_each(|value| out.extend(value.to_bits().to_le_bytes()));
}

/// Begins a response; the state byte and the length are filled in at its end.
pub fn begin(out: &mut Vec<u8>, request: &Request<'_>) {
    out.clear();
    out.extend(request.transaction);
    out.extend([0, request.protocol, 0, 0, request.register, 0]);
}

/// Ends a response.
pub fn end(out: &mut [u8], state: u8) {
    let length = out.len() - 6;
    if let [_, _, _, _, l0, l1, _, status, ..] = out {
        (*l0, *l1, *status) = ((length >> 8) as u8, (length & 0xFF) as u8, state);
    }
}
