//! The bytes of a joint state as LCM has them: the type's fingerprint, then the fields, big-endian.

/// Fingerprint of `sensor_msgs.JointState`.
const FINGERPRINT: u64 = 0xccef_a8a4_92b9_67e3;

/// The joints of all arms after a tick, with the names of Python dimos.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct JointState {
    /// Wall-clock time [s since the Unix epoch].
    pub stamp: f64,
    /// The frame's name.
    pub frame_id: String,
    /// Names of the joints.
    pub name: Vec<String>,
    /// Positions [rad].
    pub position: Vec<f64>,
    /// Velocities [rad/s]; empty: unknown.
    pub velocity: Vec<f64>,
    /// Torques [Nm]; empty: unknown.
    pub effort: Vec<f64>,
}

impl JointState {
    /// Returns the bytes of the message.
    pub fn encode(&self) -> Vec<u8> {
        let values = self.position.len() + self.velocity.len() + self.effort.len();
        let mut out = Vec::with_capacity(64 + 24 * self.name.len() + 8 * values);
        out.extend(FINGERPRINT.to_be_bytes());
        for length in [self.name.len(), self.position.len(), self.velocity.len(), self.effort.len()] {
            out.extend((length as i32).to_be_bytes());
        }
        // Header: sequence number, seconds, nanoseconds, frame.
        let seconds = self.stamp.floor();
        let nanoseconds = ((self.stamp - seconds) * 1e9).min(999_999_999.0);
        for part in [0, seconds as i32, nanoseconds as i32] {
            out.extend(part.to_be_bytes());
        }
        put_text(&mut out, &self.frame_id);
        self.name.iter().for_each(|name| put_text(&mut out, name));
        let values = self.position.iter().chain(&self.velocity).chain(&self.effort);
        values.for_each(|value| out.extend(value.to_be_bytes()));
        out
    }
}

/// Writes a string: its length with the zero at its end, its bytes, the zero.
fn put_text(out: &mut Vec<u8>, text: &str) {
    let text = text.split('\0').next().unwrap_or_default();
    out.extend((text.len() as i32 + 1).to_be_bytes());
    out.extend(text.as_bytes());
    out.push(0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_joint_state_has_the_bytes_that_python_dimos_reads() {
        let state = JointState {
            stamp: 1_700_000_000.0,
            frame_id: "coordinator".into(),
            name: vec!["arm/joint1".into(), "arm/joint2".into()],
            position: vec![0.5, -1.0],
            velocity: vec![0.0, 0.0],
            effort: Vec::new(),
        };
        let bytes = state.encode();
        let wanted: &[&[u8]] = &[
            b"\xcc\xef\xa8\xa4\x92\xb9\x67\xe3\0\0\0\x02\0\0\0\x02\0\0\0\x02\0\0\0\0\0\0\0\0\x65\x53\xf1\0\0\0\0\0",
            b"\0\0\0\x0ccoordinator\0\0\0\0\x0barm/joint1\0\0\0\0\x0barm/joint2\0",
            b"\x3f\xe0\0\0\0\0\0\0\xbf\xf0\0\0\0\0\0\0",
            &[0; 16],
        ];
        assert_eq!(bytes, wanted.concat());
        assert_eq!(bytes.len(), 114);
    }
}
