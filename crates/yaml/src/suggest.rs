//! "Did you mean" hints, and quoting of users' words in messages.

/// Returns the candidate that was probably meant, if one is close enough.
pub fn closest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if word.is_empty() || word.len() > 100 {
        return None;
    }
    let plain = |text: &str| text.to_lowercase().replace(['_', '-', ' ', '/'], "");
    let given = plain(word);
    // One typo in three letters is close; `ip` for `rpy` is not.
    let reach = (given.chars().count() / 3).max(1);
    // `joint7` is not a typo of `joint6`: it continues a count.
    let words = |text: &str| text.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned();
    let counts_on = |candidate: &str| {
        let candidate = plain(candidate);
        let digits = given.len() - words(&given).len();
        candidate != given && words(&candidate) == words(&given) && (1..=2).contains(&digits)
    };
    candidates
        .into_iter()
        .filter(|candidate| !counts_on(candidate))
        .map(|candidate| (strsim::damerau_levenshtein(&given, &plain(candidate)), candidate))
        .filter(|(distance, candidate)| {
            *distance <= reach && (given.chars().count() > 2 || plain(candidate).chars().count() <= 3)
        })
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

/// Returns a hint with the probable candidate, or with all of them if there are few.
pub fn did_you_mean<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>, what: &str) -> Option<String> {
    let all: Vec<&str> = candidates.into_iter().collect();
    if let Some(near) = closest(word, all.iter().copied()) {
        return Some(format!("did you mean `{near}`?"));
    }
    let (shown, rest) = all.split_at(all.len().min(30));
    let list = shown.join(", ");
    match (shown.is_empty(), rest.len()) {
        (true, _) => None,
        (false, 0) => Some(format!("{what}: {list}")),
        (false, more) => Some(format!("{what}: {list} and {more} more")),
    }
}

/// Quotes a user's word for a message: in backticks, shortened, control characters escaped.
pub fn quote(text: &str) -> String {
    let mut shown: String = text.chars().take(60).flat_map(char::escape_debug).collect();
    // `escape_debug` is for Rust literals; quotes need no escape here.
    shown = shown.replace("\\'", "'").replace("\\\"", "\"");
    let more = if text.chars().nth(60).is_some() { "…" } else { "" };
    format!("`{shown}{more}`")
}
