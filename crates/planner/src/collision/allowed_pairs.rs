//! Searches for link pairs that touch in (nearly) every configuration: an error in the description, or pairs that
//! should be allowed. They are reported by name, never silently ignored.

use std::sync::Arc;

use dimos_robot::random::Random;

use super::checker::CollisionChecker;
use super::exact::ExactChecker;
use super::report::{Contact, Pair};
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

/// Pairs that touch in more than this part of the configurations are suspects.
const SHARE: f64 = 0.99;

/// Returns the pairs that touch at home or in (nearly) all of `samples` random configurations, the most frequent first.
/// The same seed gives the same result.
pub fn always_touching(scene: &Arc<Scene>, home: &[f64], samples: usize, seed: u64) -> Vec<SuspectPair> {
    let mut checker = ExactChecker::new(scene.clone(), CheckSettings::default());
    let mut random = Random::new(seed);
    let at_home = checker.contacts(home);
    let is_at_home = |pair: Pair| at_home.iter().any(|contact| contact.pair == pair);
    // For each pair: the configuration in which it touched first, and how often it did.
    let mut seen: Vec<(Pair, Option<Vec<f64>>, usize)> = scene.all_pairs().map(|pair| (pair, None, 0)).collect();
    for number in 0..samples {
        let q: Vec<f64> = scene.limits().iter().map(|l| sample(l.lower, l.upper, &mut random)).collect();
        // What was free too often is no suspect.
        let rare = |touched: usize| ((number - touched) as f64) > (1.0 - SHARE) * samples as f64 + 1.0;
        seen.retain(|(pair, _, touched)| is_at_home(*pair) || !rare(*touched));
        checker.place(&q);
        for (_, first, touched) in seen.iter_mut().filter(|(pair, ..)| checker.touches(*pair)) {
            first.get_or_insert_with(|| q.clone());
            *touched += 1;
        }
    }
    let mut suspects: Vec<SuspectPair> = Vec::new();
    for (pair, first, touched) in seen {
        let share = touched as f64 / samples.max(1) as f64;
        let home = at_home.iter().find(|contact| contact.pair == pair).cloned();
        let at_home = home.is_some();
        let contact = home.or_else(|| {
            checker.place(&first.filter(|_| share > SHARE)?);
            checker.contact(pair)
        });
        suspects.extend(contact.map(|contact| SuspectPair { contact, at_home, share }));
    }
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
