//! Parses `--vary`: a grid of values, or a distribution; and the table of `--design`.
//!
//! In: text such as `fr.Fs = 1 N .. 2 N by 0.1 N` or `fr.vs ~ lognormal(1 mm/s, 0.2)`. Out: the value for each run, as
//! a function of its number alone. Random numbers come from a counter-based generator, so a run has the same ones on
//! every machine and in any order.

use crate::compile::{ElementaryFunction, spaced};
use crate::quantity;
use abi::unit::Unit;

/// Most values of a grid.
const MOST_VALUES: usize = 10_000_000;

/// One varied parameter.
#[derive(Clone, PartialEq, Debug)]
pub struct Vary {
    /// As written.
    pub text: String,
    /// Its path; several that take the same values together are separated by commas: `x.k, y.k`.
    pub path: String,
    /// The unit of its values as written.
    pub unit: Unit,
    /// Its grid or distribution.
    pub how: How,
}

/// Values in SI.
#[derive(Clone, PartialEq, Debug)]
pub enum How {
    /// A list of values.
    Values(Vec<f64>),
    /// A column of a design: the columns change together, row by row.
    Design(Vec<f64>),
    /// Normal distribution: mean and standard deviation.
    Normal(f64, f64),
    /// Log-normal distribution: median, and standard deviation of the logarithm.
    Lognormal(f64, f64),
    /// Uniform distribution between two bounds.
    Uniform(f64, f64),
    /// This part of the value in the text to either side: a grid of so many values, or evenly distributed.
    Around(f64, Option<usize>),
    /// Models for a slot, as text.
    Models(String),
}

/// Parses one `--vary`.
///
/// # Errors
/// What is wrong with it, and how to write it.
pub fn parse(text: &str) -> Result<Vary, String> {
    const EXAMPLES: &str = "write it as `fr.Fs = 1 N .. 2 N by 0.1 N`, `fr.Fs = 1 N .. 100 N log 10`, `fr.Fs = 1 N, 2 N`, \
        `fr.Fs = ±20 %`, `x.k, y.k = 1 N/m, 2 N/m` for both together, `fr = LuGre(), Dahl()` for a slot, or `fr.vs ~ normal(1 mm/s, 0.1 mm/s)`, lognormal(median, spread), uniform(from, to)";
    let split = text.find(['=', '~']).ok_or(EXAMPLES)?;
    let (path, rest) = (text[..split].trim(), text[split + 1..].trim());
    if path.is_empty() || rest.is_empty() {
        return Err(EXAMPLES.into());
    }
    let paths: Vec<&str> = path.split(',').map(str::trim).collect();
    if let Some(k) = (0..paths.len()).find(|k| paths[*k].is_empty() || paths[..*k].contains(&paths[*k])) {
        return Err(match paths[k] {
            "" => EXAMPLES.into(),
            twice => format!("`{twice}` stands twice before `=`"),
        });
    }
    let is_drawn = text[split..].starts_with('~');
    let model = rest.trim_start_matches("rotary ").trim_start();
    let (unit, how) = if let Some(share) = rest.strip_prefix('±').or(rest.strip_prefix("+-")) {
        (Unit::none(), around(share, is_drawn)?)
    } else if model.starts_with(|c: char| c.is_ascii_uppercase()) && model.contains('(') && !is_drawn {
        (Unit::none(), How::Models(rest.into()))
    } else if is_drawn {
        drawn(rest, EXAMPLES)?
    } else {
        listed(rest, EXAMPLES)?
    };
    Ok(Vary { text: text.into(), path: paths.join(", "), unit, how })
}

/// `20 %`, `20 % lin 5`.
fn around(text: &str, is_drawn: bool) -> Result<How, String> {
    let (share, count) = match text.split_once(" lin ") {
        Some(_) if is_drawn => {
            return Err("`lin` is for values, which follow `=`; `~ ±20 %` draws between the ends".into());
        }
        Some((share, count)) => (share, Some(count)),
        None => (text, None),
    };
    let (part, unit) = quantity::parse(share)?;
    if unit.text != "%" || part <= 0.0 {
        return Err(format!("`±{}` is no share of the value in the text: write `±20 %`", share.trim()));
    }
    let count = match count.map(|count| count.trim().parse::<usize>()) {
        None => 3,
        Some(Ok(count)) if (2..=MOST_VALUES).contains(&count) => count,
        Some(_) => return Err(format!("`lin` is followed by a number of values: 2 to {MOST_VALUES}")),
    };
    Ok(How::Around(part, (!is_drawn).then_some(count)))
}

/// Names of the distributions.
const DISTRIBUTIONS: [&str; 3] = ["normal", "lognormal", "uniform"];

fn listed(text: &str, examples: &str) -> Result<(Unit, How), String> {
    if let Some(name) =
        DISTRIBUTIONS.iter().find(|name| text.strip_prefix(**name).is_some_and(|rest| rest.starts_with('(')))
    {
        return Err(format!("a distribution follows `~`, and values follow `=`: write `~ {name}(…)`"));
    }
    let Some((first, rest)) = text.split_once("..") else {
        let (values, unit) = of_one_kind(&text.split(',').collect::<Vec<_>>())?;
        return Ok((unit, How::Values(values)));
    };
    for (word, log) in [(" log ", true), (" lin ", false)] {
        let Some((last, number)) = rest.split_once(word) else { continue };
        let (values, unit) = of_one_kind(&[first, last])?;
        let count = number.trim().parse::<usize>().ok().filter(|count| (2..=MOST_VALUES).contains(count));
        let count = count.ok_or(format!("`{}` is no number of values: 2 to {MOST_VALUES}", number.trim()))?;
        let [first, last] = [values[0], values[1]];
        if log && first * last <= 0.0 {
            return Err("a logarithmic grid has ends of one sign, and neither is 0".into());
        }
        let rounded = |value: &f64| {
            let shown: f64 = format!("{:.11e}", unit.from_si(*value)).parse().unwrap_or(f64::NAN);
            quantity::si(shown, &unit)
        };
        let values = spaced(count, first, last, log).iter().map(rounded).collect();
        return Ok((unit.clone(), How::Values(values)));
    }
    let (last, step) = rest.split_once(" by ").ok_or(examples)?;
    let (values, unit) = of_one_kind(&[first, last, step])?;
    let [first, last, step] = [values[0], values[1], values[2]];
    if step <= 0.0 || last < first {
        return Err("a grid goes from a smaller to a larger value by a positive step".into());
    }
    let count = ((last - first) / step + 1e-9).floor() + 1.0;
    if count > MOST_VALUES as f64 {
        return Err(format!("{count} values are too many; {MOST_VALUES} are possible"));
    }
    // Rounded to twelve digits in the unit as written, without the rounding noise of a sum.
    let value = |k: usize| {
        let shown: f64 = format!("{:.11e}", unit.from_si(first + k as f64 * step)).parse().unwrap_or(f64::NAN);
        quantity::si(shown, &unit)
    };
    Ok((unit.clone(), How::Values((0..count as usize).map(value).collect())))
}

fn drawn(text: &str, examples: &str) -> Result<(Unit, How), String> {
    let (name, rest) = text.split_once('(').ok_or(examples)?;
    let inside = rest.trim_end().strip_suffix(')').ok_or(examples)?;
    let parts: Vec<&str> = inside.split(',').collect();
    let &[first, second] = parts.as_slice() else { return Err(examples.into()) };
    let pair = || of_one_kind(&[first, second]).map_err(|why| format!("{why}; {}", usage(name.trim(), first, second)));
    match name.trim() {
        "normal" => match pair()? {
            (values, unit) if values[1] >= 0.0 => Ok((unit, How::Normal(values[0], values[1]))),
            _ => Err("a standard deviation is not negative".into()),
        },
        "uniform" => match pair()? {
            (values, unit) if values[0] <= values[1] => Ok((unit, How::Uniform(values[0], values[1]))),
            _ => Err("uniform goes from a smaller to a larger value".into()),
        },
        "lognormal" => {
            let ((median, unit), (spread, plain)) = (quantity::parse(first)?, quantity::parse(second)?);
            if !plain.text.is_empty() || spread < 0.0 {
                return Err("the spread of a lognormal distribution is a number such as 0.2: about 20 %".into());
            }
            if median <= 0.0 {
                return Err("the median of a lognormal distribution is positive".into());
            }
            Ok((unit, How::Lognormal(median, spread)))
        }
        other => Err(format!("`{other}` is not a known distribution: normal, lognormal, uniform")),
    }
}

/// How a distribution is written; with its numbers, if its second one is a share of the first.
fn usage(name: &str, first: &str, second: &str) -> String {
    let form = if name == "uniform" { "uniform(from, to)" } else { "normal(mean, standard deviation)" };
    let (Ok((middle, unit)), Ok((share, percent))) = (quantity::parse(first), quantity::parse(second)) else {
        return form.into();
    };
    if percent.text != "%" {
        return form.into();
    }
    let shown = |si: f64| format!("{} {unit}", quantity::significant(unit.from_si(si), 6));
    let pair = match name {
        "uniform" => [middle * (1.0 - share), middle * (1.0 + share)],
        _ => [middle, middle * share],
    };
    format!("{form}: write `{name}({}, {})`", shown(pair[0]), shown(pair[1]))
}

/// Values of one dimension; the unit is that of the first.
fn of_one_kind(texts: &[&str]) -> Result<(Vec<f64>, Unit), String> {
    let read: Vec<(f64, Unit)> = texts.iter().map(|text| quantity::parse(text)).collect::<Result<_, _>>()?;
    let unit = read[0].1.clone();
    for ((_, other), text) in read.iter().zip(texts) {
        if other.dimension != unit.dimension {
            let name = |unit: &Unit| if unit.text.is_empty() { "a pure number".into() } else { format!("in {unit}") };
            return Err(format!("`{}` is {}, `{}` {}", texts[0].trim(), name(&unit), text.trim(), name(other)));
        }
    }
    Ok((read.iter().map(|(value, _)| *value).collect(), unit))
}

/// Reads a design: a line of headings such as `fr.Fs [N]`, and a line for each combination of values.
///
/// # Errors
/// What is wrong, with the line and the column.
pub fn design(text: &str) -> Result<Vec<Vary>, String> {
    const EXAMPLE: &str =
        "the first line names the columns, `fr.Fs [N],m [kg]`, each further line has a value for each";
    let mut reader = csv::ReaderBuilder::new().has_headers(false).trim(csv::Trim::All).from_reader(text.as_bytes());
    let mut columns: Vec<Vary> = Vec::new();
    let mut values: Vec<Vec<f64>> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|error| format!("{error}: {EXAMPLE}"))?;
        let line = record.position().map_or(0, csv::Position::line);
        if columns.is_empty() {
            for heading in &record {
                let (path, unit) = match heading.split_once('[') {
                    Some((path, unit)) => {
                        let unit = unit.strip_suffix(']').ok_or(format!("line {line}: `{heading}` has no `]`"))?.trim();
                        let known = Unit::parse(unit)
                            .map_err(|_| format!("line {line}: `{unit}` in `{heading}` is no unit"))?;
                        (path.trim(), known)
                    }
                    None => (heading, Unit::none()),
                };
                if path.is_empty() || path.parse::<f64>().is_ok() {
                    return Err(format!("line {line}: `{heading}` is no name of a column: {EXAMPLE}"));
                }
                let how = How::Design(Vec::new());
                columns.push(Vary { text: heading.into(), path: path.into(), unit, how });
                values.push(Vec::new());
            }
            continue;
        }
        for ((cell, column), values) in record.iter().zip(&columns).zip(&mut values) {
            let number = cell.parse::<f64>().ok().filter(|number| !number.is_nan());
            let number = number.ok_or(format!("line {line}: `{cell}` in the column `{}` is no number", column.text))?;
            values.push(quantity::si(number, &column.unit));
        }
    }
    match values.first().map_or(0, Vec::len) {
        0 => Err(format!("it has no rows: {EXAMPLE}")),
        rows if rows > MOST_VALUES => Err(format!("{rows} rows are too many; {MOST_VALUES} are possible")),
        _ => {
            columns.iter_mut().zip(values).for_each(|(column, values)| column.how = How::Design(values));
            Ok(columns)
        }
    }
}

/// Number of combinations of all grids and of the design.
pub fn combinations(all: &[Vary]) -> u64 {
    let design = all.iter().find(|vary| matches!(vary.how, How::Design(_))).and_then(Vary::len);
    let grids = all.iter().filter(|vary| !matches!(vary.how, How::Design(_))).filter_map(Vary::len);
    design.into_iter().chain(grids).map(|len| len as u64).product()
}

impl Vary {
    /// Its path, or those that take the same values together.
    pub fn paths(&self) -> impl Iterator<Item = &str> {
        self.path.split(", ")
    }

    /// Number of values of a grid; none for a distribution.
    pub fn len(&self) -> Option<usize> {
        match &self.how {
            How::Values(values) | How::Design(values) => Some(values.len()),
            How::Around(_, count) => *count,
            How::Normal(..) | How::Lognormal(..) | How::Uniform(..) | How::Models(_) => None,
        }
    }

    /// What lies around a value, as a grid or a distribution in its unit: `±20 %` of 1 N is 0.8 N, 1 N, 1.2 N.
    pub fn around(&self, middle: f64, unit: &Unit) -> Vary {
        let How::Around(part, count) = self.how else { return self.clone() };
        // Rounded as a grid that is written out.
        let at = |share: f64| {
            let shown: f64 = format!("{:.11e}", unit.from_si(middle * (1.0 + share))).parse().unwrap_or(f64::NAN);
            quantity::si(shown, unit)
        };
        let how = match count {
            Some(count) => How::Values(spaced(count, -part, part, false).into_iter().map(at).collect()),
            None => How::Uniform(at(-part).min(at(part)), at(-part).max(at(part))),
        };
        Vary { text: self.text.clone(), path: self.path.clone(), unit: unit.clone(), how }
    }

    /// A typical value, to check whether the text compiles with it.
    pub fn typical(&self) -> f64 {
        match &self.how {
            How::Values(values) | How::Design(values) => values[values.len() / 2],
            How::Normal(mean, _) => *mean,
            How::Lognormal(median, _) => *median,
            How::Uniform(low, high) => 0.5 * (low + high),
            How::Around(..) | How::Models(_) => f64::NAN,
        }
    }
}

/// A counter-based random generator.
pub struct Dice {
    seed: u64,
    exp: ElementaryFunction,
    log: ElementaryFunction,
}

impl Dice {
    /// Everything drawn depends on the seed alone.
    pub fn new(seed: u64) -> Dice {
        Dice { seed, exp: ElementaryFunction::exp(), log: ElementaryFunction::log() }
    }

    /// The value in SI of a distribution in this draw; `k`: number of the distribution.
    pub fn value(&self, how: &How, draw: u64, k: u64) -> f64 {
        // Never 0 nor 1.
        let bits = word(word(self.seed, draw), k) >> 11;
        let uniform = (bits as f64 + 0.5) / 9_007_199_254_740_992.0;
        match *how {
            How::Normal(mean, deviation) => mean + deviation * self.normal(uniform),
            How::Lognormal(median, spread) => median * self.exp.at(spread * self.normal(uniform)),
            How::Uniform(low, high) => low + (high - low) * uniform,
            How::Values(ref values) | How::Design(ref values) => values[(uniform * values.len() as f64) as usize],
            How::Around(..) | How::Models(_) => unreachable!("it is a grid or a distribution by now"),
        }
    }

    /// Quantile function of the standard normal distribution, to 16 digits. Source: Wichura, Appl. Statist. 37 (1988),
    /// algorithm AS 241, PPND16.
    fn normal(&self, p: f64) -> f64 {
        let ratio = |x: f64, above: &[f64; 8], below: &[f64; 8]| {
            let sum = |c: &[f64; 8]| c.iter().rev().fold(0.0, |sum, c| sum * x + c);
            sum(above) / sum(below)
        };
        let q = p - 0.5;
        if q.abs() <= 0.425 {
            return q * ratio(0.180625 - q * q, &CENTRE.0, &CENTRE.1);
        }
        let r = (-self.log.at(p.min(1.0 - p))).sqrt();
        let size = if r <= 5.0 { ratio(r - 1.6, &SIDE.0, &SIDE.1) } else { ratio(r - 5.0, &TAIL.0, &TAIL.1) };
        if q < 0.0 { -size } else { size }
    }
}

/// SplitMix64's finaliser of seed · 0x9E37… + k, as in the language's `random`.
fn word(seed: u64, k: u64) -> u64 {
    abi::random::finalised(seed.wrapping_mul(abi::random::GAMMA).wrapping_add(k))
}

type Ratio = ([f64; 8], [f64; 8]);

#[allow(clippy::excessive_precision, reason = "as published")]
const CENTRE: Ratio = (
    [
        3.3871328727963666080e0,
        1.3314166789178437745e2,
        1.9715909503065514427e3,
        1.3731693765509461125e4,
        4.5921953931549871457e4,
        6.7265770927008700853e4,
        3.3430575583588128105e4,
        2.5090809287301226727e3,
    ],
    [
        1.0,
        4.2313330701600911252e1,
        6.8718700749205790830e2,
        5.3941960214247511077e3,
        2.1213794301586595867e4,
        3.9307895800092710610e4,
        2.8729085735721942674e4,
        5.2264952788528545610e3,
    ],
);

#[allow(clippy::excessive_precision, reason = "as published")]
const SIDE: Ratio = (
    [
        1.42343711074968357734e0,
        4.63033784615654529590e0,
        5.76949722146069140550e0,
        3.64784832476320460504e0,
        1.27045825245236838258e0,
        2.41780725177450611770e-1,
        2.27238449892691845833e-2,
        7.74545014278341407640e-4,
    ],
    [
        1.0,
        2.05319162663775882187e0,
        1.67638483018380384940e0,
        6.89767334985100004550e-1,
        1.48103976427480074590e-1,
        1.51986665636164571966e-2,
        5.47593808499534494600e-4,
        1.05075007164441684324e-9,
    ],
);

#[allow(clippy::excessive_precision, reason = "as published")]
const TAIL: Ratio = (
    [
        6.65790464350110377720e0,
        5.46378491116411436990e0,
        1.78482653991729133580e0,
        2.96560571828504891230e-1,
        2.65321895265761230930e-2,
        1.24266094738807843860e-3,
        2.71155556874348757815e-5,
        2.01033439929228813265e-7,
    ],
    [
        1.0,
        5.99832206555887937690e-1,
        1.36929880922735805310e-1,
        1.48753612908506148525e-2,
        7.86869131145613259100e-4,
        1.84631831751005468180e-5,
        1.42151175831644588870e-7,
        2.04426310338993978564e-15,
    ],
);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grids_lists_and_distributions_are_read() {
        let grid = parse("fr.Fs = 1 N .. 2 N by 0.1 N").unwrap();
        let How::Values(values) = &grid.how else { panic!("{grid:?}") };
        assert_eq!((grid.path.as_str(), values.len(), values[3], values[10]), ("fr.Fs", 11, 1.3, 2.0));
        let How::Values(values) = parse("rate = 1 N/s .. 100 N/s log 5").unwrap().how else { panic!() };
        let ratio = |k: usize| values[k + 1] / values[k];
        assert_eq!((values.len(), values[0], values[2], values[4]), (5, 1.0, 10.0, 100.0));
        assert!((0..4).all(|k| (ratio(k) / 10_f64.sqrt() - 1.0).abs() < 1e-10), "{values:?}");
        assert_eq!(parse("k = 0 N/m .. 4 N/m lin 3").unwrap().how, How::Values(vec![0.0, 2.0, 4.0]));
        assert_eq!(parse("k=1 N/m, 2 N/m").unwrap().how, How::Values(vec![1.0, 2.0]));
        let vs = parse("fr.vs ~ lognormal(1 mm/s, 0.2)").unwrap();
        assert_eq!((vs.unit.text.as_str(), vs.how), ("mm/s", How::Lognormal(1e-3, 0.2)));
        assert_eq!(parse("m~uniform(1kg, 2kg)").unwrap().how, How::Uniform(1.0, 2.0));
        assert_eq!(parse("m ~ normal(1 kg, 50 g)").unwrap().how, How::Normal(1.0, 0.05));
        let both = parse("x.k ,y.k = 1 N/m, 2 N/m").unwrap();
        assert_eq!((both.path.as_str(), both.paths().count()), ("x.k, y.k", 2));
        let newton = Unit::parse("N").unwrap();
        let around = |text: &str| parse(text).unwrap().around(2.0, &newton).how;
        assert_eq!(around("Fs = ±20 %"), How::Values(vec![1.6, 2.0, 2.4]));
        assert_eq!(around("Fs = +-10% lin 5"), How::Values(vec![1.8, 1.9, 2.0, 2.1, 2.2]));
        assert_eq!(around("Fs ~ ±50 %"), How::Uniform(1.0, 3.0));
        assert_eq!(parse("fr = LuGre(Fs = 2 N), Dahl()").unwrap().how, How::Models("LuGre(Fs = 2 N), Dahl()".into()));
    }

    #[test]
    fn mistakes_are_reported() {
        let told = |text: &str| parse(text).unwrap_err();
        assert!(told("fr.Fs").contains("fr.Fs = 1 N .. 2 N by 0.1 N"));
        assert!(told("fr.Fs = 1 N .. 2 N").contains("by 0.1 N"));
        assert_eq!(told("m = 1 kg .. 2 N by 1 kg"), "`1 kg` is in kg, `2 N` in N");
        assert!(told("m = 2 kg .. 1 kg by 1 kg").contains("smaller to a larger"));
        assert!(told("m ~ gauss(1 kg, 1 kg)").contains("normal, lognormal, uniform"));
        assert!(told("m ~ lognormal(1 kg, 0.1 kg)").contains("such as 0.2"));
        assert!(told("m = 1 kg .. 2 kg by 1 ng").contains("too many"));
        assert!(told("m = 0 kg .. 2 kg log 5").contains("neither is 0"));
        assert!(told("m = 1 kg .. 2 kg log 1.5").contains("no number of values"));
        assert!(told("m = ±1 kg").contains("no share"));
        assert!(told("m, m = 1 kg, 2 kg").contains("twice"));
        assert!(told("m ~ ±5 % lin 3").contains("follow `=`"));
    }

    #[test]
    fn a_design_is_read_in_its_units_and_mistakes_have_a_line() {
        let read = design("fr.Fs [N], m [g],k\n1,200,3\n 2.5 ,1e3,-4\n").unwrap();
        let columns: Vec<(&str, &How)> = read.iter().map(|vary| (vary.path.as_str(), &vary.how)).collect();
        let of = |values: &[f64]| How::Design(values.to_vec());
        assert_eq!(columns, [("fr.Fs", &of(&[1.0, 2.5])), ("m", &of(&[0.2, 1.0])), ("k", &of(&[3.0, -4.0]))]);
        assert_eq!(combinations(&[read, vec![parse("x = 1 N, 2 N, 3 N").unwrap()]].concat()), 6);
        for (text, words) in [
            ("", "no rows"),
            ("m [kg]\n", "no rows"),
            ("1,2\n3,4\n", "line 1: `1` is no name of a column"),
            ("m [kg\n1\n", "line 1: `m [kg` has no `]`"),
            ("m [kgg]\n1\n", "line 1: `kgg` in `m [kgg]` is no unit"),
            ("m [kg],k\n1,2\n3\n", "line: 3"),
            ("m [kg],k\n1,2\n3,x\n", "line 3: `x` in the column `k` is no number"),
            ("m [kg],k\n1,2\n3,\n", "line 3: `` in the column `k` is no number"),
            ("m [kg]\nnan\n", "is no number"),
        ] {
            let why = design(text).unwrap_err();
            assert!(why.contains(words), "{text:?}: {why}");
        }
    }

    #[test]
    fn the_normal_distribution_has_its_quantiles() {
        let dice = Dice::new(1);
        for (p, expected) in [
            (0.5, 0.0),
            (0.975, 1.959963984540054),
            (0.001, -3.090232306167813),
            (1e-10, -6.361340902404056),
            (0.841344746068543, 1.0),
        ] {
            let found = dice.normal(p);
            assert!((found - expected).abs() < 1e-13 * (1.0 + f64::abs(expected)), "{p}: {found}");
        }
    }

    #[test]
    fn draws_have_their_moments_and_do_not_depend_on_order() {
        let dice = Dice::new(7);
        let draws: Vec<f64> = (0..20_000).map(|draw| dice.value(&How::Normal(3.0, 2.0), draw, 0)).collect();
        let mean = draws.iter().sum::<f64>() / 2e4;
        let square = draws.iter().map(|x| (x - mean) * (x - mean)).sum::<f64>() / 2e4;
        assert!((mean - 3.0).abs() < 0.05 && (square.sqrt() - 2.0).abs() < 0.05, "{mean} {square}");
        assert_eq!(dice.value(&How::Normal(3.0, 2.0), 17, 0), draws[17]);
        assert_ne!(dice.value(&How::Uniform(0.0, 1.0), 0, 0), dice.value(&How::Uniform(0.0, 1.0), 0, 1));
        assert!((0..1000).all(|n| dice.value(&How::Lognormal(1.0, 1.0), n, 0) > 0.0));
    }
}
