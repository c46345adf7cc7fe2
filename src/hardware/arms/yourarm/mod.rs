#[cfg(test)]
mod golden;
pub mod protocol;
