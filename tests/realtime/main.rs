//! Whole runs whose times are judged, on the wire or by what an emulator received. Each runs alone.

#[path = "../support/mod.rs"]
mod support;

#[allow(dead_code, reason = "a library's public parts")]
#[path = "../support/serial_line/mod.rs"]
mod serial;

mod faults;
mod stalls;
mod stalls_soak;
mod wire_first;
mod wire_lies;
mod wire_pauses;
mod wire_stalls;
