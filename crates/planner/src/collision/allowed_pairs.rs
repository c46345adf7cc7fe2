//! Searches for link pairs that touch in (nearly) every configuration: an error in the description, or pairs that
//! should be allowed. They are reported by name, never silently ignored.

use std::sync::Arc;

use dimos_robot::random::Random;

use super::checker::CollisionChecker;
use super::exact::ExactChecker;
use super::report::Contact;
use super::scene::Scene;
use super::settings::CheckSettings;

/// A pair that touches too often.
#[derive(Debug, Clone, PartialEq)]
pub struct SuspectPair {
    /// The contact at the home configuration.
    pub contact: Contact,
    /// Whether it touches at the home configuration.
    pub at_home: bool,
    /// Part of the samples in which it touches, 0–1.
    pub share: f64,
}

/// Returns the pairs that touch at home or in (nearly) all of `samples` random configurations, the most frequent first.
/// The same seed gives the same result.
pub fn always_touching(scene: &Arc<Scene>, home: &[f64], samples: usize, seed: u64) -> Vec<SuspectPair> {
    let mut checker = ExactChecker::new(scene.clone(), CheckSettings::default());
    let mut random = Random::new(seed);
    let at_home = checker.contacts(home);
    let mut counts = vec![];
    for _ in 0..samples {
        let q: Vec<f64> = scene.limits().iter().map(|l| sample(l.lower, l.upper, &mut random)).collect();
        for contact in checker.contacts(&q) {
            match counts.iter_mut().find(|(seen, _): &&mut (Contact, usize)| seen.pair == contact.pair) {
                Some((_, n)) => *n += 1,
                None => counts.push((contact, 1)),
            }
        }
    }
    let often = |n: usize| n as f64 / samples.max(1) as f64;
    let home = |contact: &Contact| at_home.iter().find(|c| c.pair == contact.pair).cloned();
    let mut suspects: Vec<SuspectPair> = counts
        .iter()
        .map(|(c, n)| SuspectPair {
            contact: home(c).unwrap_or(c.clone()),
            at_home: home(c).is_some(),
            share: often(*n),
        })
        .filter(|s| s.at_home || s.share > 0.99)
        .collect();
    let missed = at_home.iter().filter(|c| !counts.iter().any(|(seen, _)| seen.pair == c.pair));
    suspects.extend(missed.map(|c| SuspectPair { contact: c.clone(), at_home: true, share: 0.0 }));
    suspects.sort_by(|a, b| b.share.total_cmp(&a.share).then(a.contact.pair.cmp(&b.contact.pair)));
    suspects
}

/// Samples a position between limits; a joint without limits within one turn.
pub fn sample(lower: f64, upper: f64, random: &mut Random) -> f64 {
    let turn = std::f64::consts::PI;
    let low = if lower.is_finite() { lower } else { upper.min(turn) - 2.0 * turn };
    let high = if upper.is_finite() { upper } else { low + 2.0 * turn };
    random.between(low, high)
}
