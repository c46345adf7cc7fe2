//! Values of joints by their names: from one message of a topic to the next, joints and their order may differ.

/// Returns a joint that is more than once in a message.
pub fn twice(names: &[String]) -> Option<&String> {
    names.iter().enumerate().find(|(at, name)| names.iter().take(*at).any(|other| other == *name)).map(|(_, name)| name)
}

/// Picks the values of some joints out of messages.
#[derive(Debug)]
pub struct Places {
    joints: Vec<String>,
    /// Names in the latest message, and where each joint is among them: computed only when the names change.
    names: Vec<String>,
    at: Vec<Option<usize>>,
}

impl Places {
    /// Creates one for these joints.
    pub fn new(joints: &[String]) -> Self {
        Self { joints: joints.to_vec(), names: Vec::new(), at: vec![None; joints.len()] }
    }

    /// Returns the values of the joints in a list of a message with these names: NaN for a joint that it lacks, or has
    /// more than once.
    pub fn pick<'a>(&'a mut self, names: &[String], list: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        if self.names != names {
            self.names = names.to_vec();
            let at = |joint: &String| {
                let mut found = names.iter().enumerate().filter(|(_, name)| *name == joint).map(|(at, _)| at);
                found.next().filter(|_| found.next().is_none())
            };
            self.at = self.joints.iter().map(at).collect();
        }
        self.at.iter().map(|at| at.and_then(|at| list.get(at)).copied().unwrap_or(f64::NAN))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_follow_their_names_whatever_their_order() {
        let names = |list: &str| list.split(' ').map(str::to_owned).collect::<Vec<_>>();
        let mut places = Places::new(&names("a b c"));
        let mut pick = |list: &str, values: &[f64]| places.pick(&names(list), values).collect::<Vec<_>>();
        assert_eq!(pick("a b c", &[1.0, 2.0, 3.0]), [1.0, 2.0, 3.0]);
        assert_eq!(pick("c x a b", &[3.0, 9.0, 1.0, 2.0]), [1.0, 2.0, 3.0]);
        let lacks = pick("c b b", &[3.0, 2.0, 2.5]);
        assert!(lacks[0].is_nan() && lacks[1].is_nan() && lacks[2] == 3.0, "{lacks:?}");
        assert!(pick("a b c", &[1.0]).iter().filter(|v| v.is_nan()).count() == 2);
        assert_eq!((twice(&names("a b c")), twice(&names("a b a b")).unwrap().as_str()), (None, "a"));
    }
}
