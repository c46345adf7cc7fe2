//! "Did you mean", and how user's words are shown in messages.

/// The candidate that was probably meant, if any is near enough.
pub fn closest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    if word.is_empty() || word.len() > 100 {
        return None;
    }
    let plain = |text: &str| text.to_lowercase().replace(['_', '-', ' ', '/'], "");
    let given = plain(word);
    // One slip in three letters is near; `ip` for `rpy` is not.
    let reach = (given.chars().count() / 3).max(1);
    // `joint7` is not a slip for `joint6`: it counts on.
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

/// A hint that names the probable candidate, or all of them when there are few.
pub fn did_you_mean<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>, what: &str) -> Option<String> {
    let all: Vec<&str> = candidates.into_iter().collect();
    if let Some(near) = closest(word, all.iter().copied()) {
        return Some(format!("did you mean `{near}`?"));
    }
    let (shown, rest) = all.split_at(all.len().min(20));
    let list = shown.join(", ");
    match (shown.is_empty(), rest.len()) {
        (true, _) => None,
        (false, 0) => Some(format!("{what}: {list}")),
        (false, more) => Some(format!("{what}: {list} and {more} more")),
    }
}

/// A user's word in a message: in backticks, shortened, with control characters made visible.
pub fn quote(text: &str) -> String {
    let mut shown: String = text.chars().take(60).flat_map(char::escape_debug).collect();
    // `escape_debug` is for Rust literals; quotes need no escape here.
    shown = shown.replace("\\'", "'").replace("\\\"", "\"");
    let more = if text.chars().nth(60).is_some() { "…" } else { "" };
    format!("`{shown}{more}`")
}
