//! `--best`: ranks the rows of a table by a measure and keeps the first ones.
//!
//! In: the words of the option. Out: a ranking. With distributions the rows of one point of the grid are ranked together,
//! by a statistic of their values.

use super::Column;

/// Most rows shown.
const MOST: usize = 1000;

/// A ranking.
#[derive(Clone, PartialEq, Debug)]
pub(super) struct Best {
    /// How many rows are shown.
    pub count: usize,
    /// Whether the greatest value is the best.
    pub greatest: bool,
    /// Of the values of one point of the grid.
    pub statistic: Statistic,
    /// As written; the first measure of the experiment if there is none.
    pub measure: Option<String>,
}

/// A number that stands for the values of a distribution.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Statistic {
    Mean,
    /// The quantile of this percentage.
    Percent(u8),
}

impl Statistic {
    /// The statistic of finite values; NaN of none.
    pub(super) fn of(self, values: &[f64]) -> f64 {
        let mut values: Vec<f64> = values.iter().copied().filter(|value| value.is_finite()).collect();
        if values.is_empty() {
            return f64::NAN;
        }
        match self {
            Statistic::Mean => values.iter().sum::<f64>() / values.len() as f64,
            Statistic::Percent(percent) => {
                values.sort_by(f64::total_cmp);
                values[(f64::from(percent) / 100.0 * (values.len() - 1) as f64).round() as usize]
            }
        }
    }

    /// The name as it is typed.
    pub(super) fn name(self) -> String {
        match self {
            Statistic::Mean => "mean".into(),
            Statistic::Percent(percent) => format!("p{percent}"),
        }
    }
}

/// Reads the words of the option; none if it is not given.
///
/// # Errors
/// How to write it.
pub(super) fn read(words: &[String]) -> Result<Option<Best>, String> {
    const HOW: &str = "write --best '5 by rms(e)', '3 by greatest period(x)' or, with distributions, '5 by p95 rms(e)'";
    let text = words.join(" ");
    let mut rest = text.trim();
    if rest.is_empty() {
        return if words.is_empty() { Ok(None) } else { Err(HOW.into()) };
    }
    let mut best = Best { count: 1, greatest: false, statistic: Statistic::Mean, measure: None };
    let (first, more) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
    if let Ok(count) = first.parse::<usize>() {
        if !(1..=MOST).contains(&count) {
            return Err(format!("--best shows 1 to {MOST} rows"));
        }
        best.count = count;
        rest = more.trim_start();
        rest = match rest.strip_prefix("by ") {
            Some(measure) => measure.trim_start(),
            None if rest.is_empty() => "",
            None => return Err(HOW.into()),
        };
        if rest.is_empty() && !more.trim().is_empty() {
            return Err(HOW.into());
        }
    }
    while let Some((word, more)) = rest.split_once(char::is_whitespace) {
        match (word, word.strip_prefix('p').and_then(|percent| percent.parse::<u8>().ok())) {
            ("greatest" | "max", _) => best.greatest = true,
            ("least" | "min", _) => best.greatest = false,
            ("mean", _) => best.statistic = Statistic::Mean,
            ("median", _) => best.statistic = Statistic::Percent(50),
            (_, Some(percent)) if percent <= 100 => best.statistic = Statistic::Percent(percent),
            _ => break,
        }
        rest = more.trim_start();
    }
    best.measure = (!rest.is_empty()).then(|| rest.to_string());
    Ok(Some(best))
}

impl Best {
    /// The index of the column that ranks.
    pub(super) fn column(&self, columns: &[Column]) -> Result<usize, String> {
        let plain = |text: &str| text.split_whitespace().collect::<String>();
        let named = |column: &Column| match &self.measure {
            Some(measure) => plain(&column.axis.name) == plain(measure) || plain(&column.title) == plain(measure),
            None => true,
        };
        columns.iter().position(|column| column.kind.is_measured() && named(column)).ok_or_else(|| {
            match &self.measure {
                Some(measure) => format!("--best: `{measure}` is no measure of the experiment"),
                None => "--best: the experiment has no measure; name one, as in --best '5 by rms(e)'".into(),
            }
        })
    }

    /// Sorts so that the best comes first; values that are not numbers come last.
    pub(super) fn order(&self, a: f64, b: f64) -> std::cmp::Ordering {
        match (a.is_nan(), b.is_nan()) {
            (false, false) if self.greatest => b.total_cmp(&a),
            (false, false) => a.total_cmp(&b),
            (a, b) => a.cmp(&b),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rankings_are_read_as_people_write_them() {
        let read = |text: &str| read(&text.split('|').map(str::to_string).collect::<Vec<_>>());
        let best = |count, greatest, statistic, measure: Option<&str>| {
            Ok(Some(Best { count, greatest, statistic, measure: measure.map(str::to_string) }))
        };
        assert_eq!(read("5|by|rms(e)"), best(5, false, Statistic::Mean, Some("rms(e)")));
        assert_eq!(read("5 by rms(e)"), best(5, false, Statistic::Mean, Some("rms(e)")));
        assert_eq!(read("3 by greatest period(x)"), best(3, true, Statistic::Mean, Some("period(x)")));
        assert_eq!(read("min p95 max(abs(rad))"), best(1, false, Statistic::Percent(95), Some("max(abs(rad))")));
        assert_eq!(read("max(x) - min(x)"), best(1, false, Statistic::Mean, Some("max(x) - min(x)")));
        assert_eq!(read("7"), best(7, false, Statistic::Mean, None));
        assert!(read("5 rms(e)").is_err() && read("0 by x").is_err() && read("5 by").is_err());
    }

    #[test]
    fn what_is_no_number_comes_last() {
        let best = |greatest| Best { count: 1, greatest, statistic: Statistic::Mean, measure: None };
        for (greatest, sorted) in [(false, [1.0, 2.0, 3.0]), (true, [3.0, 2.0, 1.0])] {
            let mut values = [2.0, f64::NAN, 3.0, 1.0];
            values.sort_by(|a, b| best(greatest).order(*a, *b));
            assert!(values[..3] == sorted && values[3].is_nan(), "{values:?}");
        }
        assert_eq!(Statistic::Percent(95).of(&(0..=100).map(f64::from).collect::<Vec<_>>()), 95.0);
    }
}
