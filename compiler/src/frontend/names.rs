//! Suggestions for misspelt names, by edit distance.
//!
//! In: a word and candidates. Out: the nearest candidate, if any is near enough. Knows nothing of scopes.

/// The candidate nearest to `word` within a limit that grows with the length of `word`. Differences of case alone cost
/// nothing; of equally near candidates the first wins.
pub fn nearest<'a>(word: &str, candidates: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let limit = match word.chars().count() {
        // With a limit of 1, every other single letter would match.
        0..=1 => 0,
        2 => 1,
        3..=5 => 2,
        _ => 3,
    };
    candidates
        .into_iter()
        .filter(|candidate| *candidate != word)
        .map(|candidate| {
            let alike = word.eq_ignore_ascii_case(candidate);
            (if alike { 0 } else { strsim::damerau_levenshtein(word, candidate) }, candidate)
        })
        .filter(|(distance, _)| *distance <= limit)
        .min_by_key(|(distance, _)| *distance)
        .map(|(_, candidate)| candidate)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_misspelt_names_and_ignores_unrelated_ones() {
        let names = ["sigma0", "sigma1", "Fc", "v"];
        assert_eq!(nearest("sigma_0", names), Some("sigma0"));
        assert_eq!(nearest("simga1", names), Some("sigma1"));
        assert_eq!(nearest("fc", names), Some("Fc"));
        assert_eq!(nearest("temperature", names), None);
        assert_eq!(nearest("V", names), Some("v"));
        assert_eq!(nearest("x", names), None);
    }
}
