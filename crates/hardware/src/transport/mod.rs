//! Transports to devices, shared by the arms.

pub mod can;
pub mod capture;
pub mod device_time;
mod incoming;
pub mod line;
pub mod measured;
pub mod modbus;
pub mod pty;
pub mod request_reply;
pub mod serial;
pub mod serial_ports;
pub mod shared_serial;
pub mod tcp;
pub mod udp;

pub use incoming::Scan;
