//! Which arm is connected. A run knows an arm by its serial number, or by what its drives keep and the USB device of
//! its port; a new run does not ask.

/// Between the drives' part of an identity and its port's.
pub const PARTS: &str = ", ";

/// The arm of a run, and another one that answered at its address later.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Identity {
    /// The arm with which the run began, or which was accepted since; `None`: it does not say which it is.
    pub accepted: Option<String>,
    /// Another arm that answers now.
    pub other: Option<String>,
    /// Whether it was reported to the operator.
    shown: bool,
}

impl Identity {
    /// Takes who answers at a connection. An arm that no longer says who it is counts as the same: not every part of a
    /// controller answers at once.
    pub fn connected(&mut self, found: Option<String>) {
        let Some(found) = found else { return };
        match &self.accepted {
            None => self.accepted = Some(found),
            Some(accepted) if *accepted == found => (self.other, self.shown) = (None, false),
            Some(_) if self.other.as_ref() == Some(&found) => {}
            Some(_) => (self.other, self.shown) = (Some(found), false),
        }
    }

    /// Returns whether the arm that answers now is the one of another connection of the run: that one's identity, or
    /// its drives at another port. Drives that both arms have in common say nothing.
    pub fn is_exchanged_with(&self, other: &Self) -> bool {
        let drives = |text: &String| text.split_once(PARTS).map(|(drives, _)| drives.to_owned());
        let (Some(found), Some(theirs)) = (&self.other, &other.accepted) else { return false };
        let moved = drives(found).filter(|moved| self.accepted.as_ref().and_then(drives).as_ref() != Some(moved));
        found == theirs || (moved.is_some() && moved == drives(theirs))
    }

    /// Accepts the other arm, if it was shown before; else shows it: returns both.
    pub fn accept(&mut self) -> Result<(), (String, String)> {
        let (Some(accepted), Some(other)) = (&self.accepted, &self.other) else { return Ok(()) };
        if !self.shown {
            self.shown = true;
            return Err((accepted.clone(), other.clone()));
        }
        (self.accepted, self.shown) = (self.other.take(), false);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arms_that_changed_places_are_known_by_their_drives() {
        let arm = |accepted: &str, found: &str| {
            let mut identity = Identity::default();
            [accepted, found].into_iter().for_each(|text| identity.connected(Some(text.to_owned())));
            identity
        };
        let one = |found| arm("offsets 1, USB A", found);
        let other = arm("offsets 2, USB B", "offsets 2, USB B");
        assert!(one("offsets 2, USB B").is_exchanged_with(&other) && one("offsets 2, USB A").is_exchanged_with(&other));
        assert!(!one("offsets 1, USB B").is_exchanged_with(&other), "its own drives at another port");
        assert!(
            !one("offsets 1, USB A").is_exchanged_with(&other) && !one("offsets 3, USB B").is_exchanged_with(&other)
        );
        // Servos as they left the factory are all the same.
        assert!(!one("offsets 1, USB C").is_exchanged_with(&arm("offsets 1, USB B", "offsets 1, USB B")));
        assert!(arm("serial 1", "serial 2").is_exchanged_with(&arm("serial 2", "serial 2")));
    }

    #[test]
    fn another_arm_is_shown_once_and_then_accepted() {
        let some = |text: &str| Some(text.to_owned());
        let mut identity = Identity::default();
        identity.connected(some("1"));
        identity.connected(some("1"));
        identity.connected(None);
        assert_eq!((identity.other.clone(), identity.accept()), (None, Ok(())));
        identity.connected(some("2"));
        assert_eq!(identity.accept(), Err(("1".into(), "2".into())));
        identity.connected(some("2"));
        assert_eq!((identity.accept(), identity.accepted.clone()), (Ok(()), some("2")));
        identity.connected(some("3"));
        assert!(identity.accept().is_err());
        identity.connected(some("4"));
        assert_eq!(identity.accept(), Err(("2".into(), "4".into())), "yet another one is shown too");
        identity.connected(some("2"));
        assert_eq!((identity.other.clone(), identity.accept()), (None, Ok(())), "the right one is back");
    }
}
