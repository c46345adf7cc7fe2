//! The words of a command line as people type them, in the form that the parser expects.

use std::ffi::OsString;

/// Returns the words for the parser.
pub fn as_parsed(typed: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut waypoints = false;
    let spelled = separated(typed).into_iter().map(|word| {
        waypoints = word == "--through" || waypoints && !is_option(&word);
        spelled_out(word, waypoints)
    });
    place_first(spelled.collect())
}

/// Options whose numbers may also be separated by commas, as those of `--goal`.
const LISTS: [&str; 4] = ["--pose", "--rpy", "--quat", "--at"];

/// Separates numbers behind one of [`LISTS`] that were typed with commas: `--pose 0.3,0.1,0.4`.
fn separated(arguments: impl Iterator<Item = OsString>) -> Vec<OsString> {
    let mut words: Vec<OsString> = Vec::new();
    for argument in arguments {
        let in_list = words.last().is_some_and(|last| LISTS.iter().any(|list| last == *list));
        let parts = argument.to_str().filter(|text| in_list && text.contains(','));
        match parts.map(|text| text.split(',').map(|part| part.trim().to_owned()).collect::<Vec<_>>()) {
            Some(parts) if parts.iter().all(|part| part.parse::<f64>().is_ok()) => {
                words.extend(parts.into_iter().map(OsString::from));
            }
            _ => words.push(argument),
        }
    }
    words
}

/// Six or seven numbers behind `--pose`: the last ones are the orientation, which has an option.
pub fn pose_hint(words: &[OsString]) -> Option<String> {
    let at = words.iter().position(|word| word == "--pose" || word == "--by")?;
    let number = |word: &&OsString| word.to_str().is_some_and(|text| text.parse::<f64>().is_ok());
    let numbers: Vec<&str> = words.iter().skip(at + 1).take_while(number).filter_map(|word| word.to_str()).collect();
    let option = match numbers.len() {
        6 => "--rpy",
        7 => "--quat",
        _ => return None,
    };
    let (xyz, turn) = numbers.split_at_checked(3)?;
    let pose = words.get(at)?.to_str()?;
    Some(format!("{pose} takes x y z, the orientation follows: {pose} {} {option} {}", xyz.join(" "), turn.join(" ")))
}

/// Moves `--at PLACE` before the verb, where the parser expects it. `--at` before a number is a position of `world`.
fn place_first(mut words: Vec<OsString>) -> Vec<OsString> {
    let end = words.iter().position(|word| word == "--").unwrap_or(words.len());
    let is_place = |word: &OsString| word.to_str().is_some_and(|text| text.parse::<f64>().is_err());
    let found = words.iter().take(end).enumerate().skip(2).find_map(|(at, word)| {
        let one_word =
            word.to_str().and_then(|text| text.strip_prefix("--at=")).is_some_and(|p| p.parse::<f64>().is_err());
        let two_words = word == "--at" && words.get(at + 1).filter(|_| at + 1 < end).is_some_and(is_place);
        (one_word || two_words).then_some(at..at + 1 + usize::from(two_words))
    });
    if let Some(range) = found {
        let place: Vec<OsString> = words.drain(range).collect();
        words.splice(1..1, place);
    }
    words
}

/// Returns whether a word is the name of an option: a dash, and no number behind it.
fn is_option(word: &OsString) -> bool {
    word.to_str()
        .and_then(|text| text.strip_prefix('-'))
        .is_some_and(|rest| !rest.starts_with(|c: char| c == '.' || c.is_ascii_digit()))
}

/// Negative numbers in plain decimals: of `-0.5`, `-.5` and `-5e-1` the parser takes only the first for a number. A
/// waypoint that begins with a minus gets a space: it would be an option.
fn spelled_out(argument: OsString, waypoint: bool) -> OsString {
    let Some(text) = argument.to_str().filter(|text| text.starts_with('-')) else { return argument };
    match text.parse::<f64>() {
        Ok(number) if number.is_finite() => number.to_string().into(),
        Err(_) if waypoint && text.split(',').all(|part| part.trim().parse::<f64>().is_ok()) => {
            format!(" {text}").into()
        }
        _ => argument,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_a_pose_may_be_separated_by_commas() {
        let read = |line: &str| -> Vec<OsString> { separated(line.split(' ').map(OsString::from)) };
        let words = |line: &str| line.split(' ').map(OsString::from).collect::<Vec<_>>();
        assert_eq!(read("move a --pose 0.3,-.1,0.4 --rpy 0 1 0"), words("move a --pose 0.3 -.1 0.4 --rpy 0 1 0"));
        for same in ["move a --pose 0.3,x,0.4", "move a 0.3,0.1", "move --goal a=0.1,0.2", "run --set x=1,2"] {
            assert_eq!(read(same), words(same));
        }
    }

    #[test]
    fn the_orientation_has_its_own_option() {
        let hint = |line: &str| pose_hint(&line.split(' ').map(OsString::from).collect::<Vec<_>>());
        let rpy = hint("dimos move arm --pose 0.3 0 -0.4 3.14 0 0 --speed 1").unwrap();
        assert!(rpy.ends_with(": --pose 0.3 0 -0.4 --rpy 3.14 0 0"), "{rpy}");
        assert!(hint("dimos plan arm --pose 0.3 0 0.4 0 0 0 1").unwrap().ends_with("--quat 0 0 0 1"));
        assert_eq!(hint("dimos move arm --pose 0.3 0 0.4 --rpy 3.14 0 0"), None);
    }

    #[test]
    fn a_place_may_follow_the_verb_and_is_no_position() {
        let moved = |line: &str| {
            let words = place_first(line.split(' ').map(OsString::from).collect());
            words.iter().map(|word| word.to_string_lossy()).collect::<Vec<_>>().join(" ")
        };
        assert_eq!(moved("dimos state --at cell1 --watch"), "dimos --at cell1 state --watch");
        assert_eq!(moved("dimos state --at=tls/cell1:1"), "dimos --at=tls/cell1:1 state");
        assert_eq!(
            moved("dimos world add cup --at 0.3 -0.1 0.4 --at cell1"),
            "dimos --at cell1 world add cup --at 0.3 -0.1 0.4"
        );
        for same in
            ["dimos --at cell1 state", "dimos world move cup --at 1 2 3", "dimos x -- --at cell1", "dimos state --at"]
        {
            assert_eq!(moved(same), same);
        }
    }

    #[test]
    fn negative_numbers_are_spelled_out() {
        for (typed, meant) in [("-.5", "-0.5"), ("-1e-3", "-0.001"), ("-0.30000000000000004", "-0.30000000000000004")] {
            assert_eq!(spelled_out(typed.into(), false), meant);
        }
        assert_eq!(spelled_out("-0.5,-.1,1e-3".into(), true), " -0.5,-.1,1e-3");
        let read = |line: &str| as_parsed(line.split(' ').map(OsString::from)).join(&OsString::from("|"));
        assert_eq!(read("dimos plan a --through -1,2 home -3,4"), "dimos|plan|a|--through| -1,2|home| -3,4");
        assert_eq!(read("dimos plan a --through -1,2 --seed -3,4"), "dimos|plan|a|--through| -1,2|--seed|-3,4");
        assert_eq!(read("dimos move a -1,2"), "dimos|move|a|-1,2");
        for same in ["-a,b", "-0.5,", "0.5,-1", "-0.5", "-0", "-x", "-.", "--", ".5", "1e-3", "-inf", "-nan"] {
            assert_eq!(spelled_out(same.into(), true), same);
        }
    }
}
