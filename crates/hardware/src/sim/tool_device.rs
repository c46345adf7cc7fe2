//! What may be behind the RS-485 line at the tool flange of an emulated arm.

/// A device on a line of bytes.
pub trait ToolDevice: Send + 'static {
    /// Takes bytes that came over the line, and puts what it answers into `answer`.
    fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>);
}

/// The line, with at most one device, and the rate at which that runs [bit/s].
#[derive(Default)]
pub struct ToolSocket(Option<(Box<dyn ToolDevice>, u32)>);

impl ToolSocket {
    /// Connects a device that runs at `baud` [bit/s], in the place of the one before.
    pub fn fit(&mut self, device: impl ToolDevice, baud: u32) {
        self.0 = Some((Box::new(device), baud));
    }

    /// Passes bytes to the device. Without one, or at another rate, nothing answers.
    pub fn exchange(&mut self, baud: u32, bytes: &[u8], answer: &mut Vec<u8>) {
        if let Some((device, own)) = &mut self.0
            && *own == baud
        {
            device.exchange(bytes, answer);
        }
    }
}
