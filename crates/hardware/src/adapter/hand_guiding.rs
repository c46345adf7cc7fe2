//! Guiding by hand.

use super::AdapterResult;

/// Guiding by hand with the motors on: the controller compensates gravity, and the arm follows a hand. The adapter
/// usually implements it itself, and [`ManipulatorAdapter::hand_guiding`](super::ManipulatorAdapter::hand_guiding)
/// returns `Some(self)`.
pub trait HandGuiding {
    /// Lets the arm be guided by hand. Moves nothing. `Rejected` while it moves, and while the change is under way: the
    /// device thread then asks again in the next cycle. `write_stop` and `activate` end the guiding; both hold the arm
    /// where it is.
    fn begin_hand_guiding(&mut self) -> AdapterResult<()>;
}
