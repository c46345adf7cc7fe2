//! Everything that talks to an arm: the adapter protocol, the table of adapters, the arms, one device thread each.

pub mod arms;
<<<<<<< HEAD
pub mod device;
=======
pub mod conformance;
>>>>>>> a2ab1216a726c40627daf8c4bfc14b6f17b4ca91
pub mod registry;
pub mod sim;
pub mod spec;
pub mod transport;
