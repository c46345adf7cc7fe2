//! tick_loop
