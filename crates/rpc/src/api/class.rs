//! The right that a method needs when its client is on another computer.

use dimos_core::named::named;

named! {
    /// The right that a request needs; part of its key on the network.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Class {
        /// To read.
        Read = "read",
        /// To end motion.
        End = "end",
        /// To plan, to change the world, to be the planner.
        Plan = "plan",
        /// To move an arm, and to change what its motion depends on.
        Move = "move",
        /// To make an arm ready for motion.
        Enable = "enable",
        /// To end the run.
        Own = "own",
    }
}

impl Class {
    /// Returns the class of a method, one of the table or one that the connection itself answers; `None` for a method
    /// that is not for clients on other computers.
    pub fn of(method: &str) -> Option<Self> {
        super::class_of(method).or(match method {
            "subscribe" | "unsubscribe" => Some(Self::Read),
            "register_planner" | "planner_answer" => Some(Self::Plan),
            "lease" | "release" => Some(Self::Move),
            _ => None,
        })
    }
}
