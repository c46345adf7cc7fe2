//! Faults that the coordinator must withstand, on a virtual clock. A test's name begins with the id of its fault in
//! `docs/faults.md`. The rig also checks every command of every test: finite, within the limits of position, velocity
//! and acceleration, no motion without power, modes changed only at rest.

mod arbitration;
mod limits;
mod states;
mod ticks;
