//! Which of several laws predicts rows best that it has not been fitted to.
//!
//! In: for each law, what it leaves of every row when it is fitted to the other rows. Out: the laws in order, with
//! ranks. Laws whose mean squares differ by less than twice the standard error of their difference, from piece to piece,
//! share a rank; among them the one with fewer parameters comes first.

/// Number of pieces of a recording.
pub const PIECES: usize = 10;

/// A law that is ranked.
#[derive(Clone, Debug)]
pub struct Contender {
    /// Number of its parameters.
    pub parameters: usize,
    /// What it leaves of each row that it has not seen; none if it could not be fitted.
    pub held_out: Option<Vec<f64>>,
}

/// The piece of the recording, of [`PIECES`], to which a row belongs. Rows over time are correlated with their neighbours, so
/// a piece is a run of consecutive rows; the order of steady points means nothing, and a piece is every tenth of them.
pub fn piece(row: usize, rows: usize, steady: bool) -> usize {
    if steady { row % PIECES } else { row * PIECES / rows }
}

/// The contenders in order, each with its rank from 1.
pub fn ranks(contenders: &[Contender], steady: bool) -> Vec<(usize, usize)> {
    let mut order: Vec<usize> = (0..contenders.len()).collect();
    let square = |k: usize| match &contenders[k].held_out {
        Some(rows) => rows.iter().map(|r| r * r).sum::<f64>() / rows.len() as f64,
        None => f64::INFINITY,
    };
    order.sort_by(|a, b| square(*a).total_cmp(&square(*b)));
    let mut out: Vec<(usize, usize)> = Vec::new();
    let mut rest = &order[..];
    while let Some(first) = rest.first() {
        let equal = rest.iter().take_while(|k| *k == first || is_equal(&contenders[*first], &contenders[**k], steady));
        let mut group: Vec<usize> = equal.copied().collect();
        rest = &rest[group.len()..];
        group.sort_by_key(|k| contenders[*k].parameters);
        let rank = out.len() + 1;
        out.extend(group.into_iter().map(|k| (k, rank)));
    }
    out
}

/// How much better one law is than another, piece by piece.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Paired {
    /// Pieces in which it is better, and all.
    pub better: (usize, usize),
    /// By how much its mean square is smaller, as a part of that of the other, with the standard error of it.
    pub gain: (f64, f64),
}

/// Compares two laws on the rows that they have not seen; none if one of them could not be fitted, or if the other law
/// leaves nothing.
pub fn paired(a: &Contender, b: &Contender, steady: bool) -> Option<Paired> {
    let (mean, error, means) = differences(a, b, steady)?;
    let other = b.held_out.as_ref()?;
    let square = other.iter().map(|r| r * r).sum::<f64>() / other.len() as f64;
    let better = means.iter().filter(|m| **m > 0.0).count();
    (square > 0.0).then_some(Paired { better: (better, means.len()), gain: (mean / square, error / square) })
}

fn is_equal(a: &Contender, b: &Contender, steady: bool) -> bool {
    differences(a, b, steady).is_some_and(|(mean, error, _)| mean.abs() <= 2.0 * error)
}

/// By how much the mean square of the first law is smaller in each piece: the mean, its standard error, and each.
fn differences(a: &Contender, b: &Contender, steady: bool) -> Option<(f64, f64, Vec<f64>)> {
    let (Some(a), Some(b)) = (&a.held_out, &b.held_out) else { return None };
    let rows = a.len();
    let mut pieces = [(0.0, 0.0); PIECES];
    for (row, (a, b)) in a.iter().zip(b).enumerate() {
        let (sum, count) = &mut pieces[piece(row, rows, steady)];
        *sum += b * b - a * a;
        *count += 1.0;
    }
    let means: Vec<f64> = pieces.iter().filter(|(_, count)| *count > 0.0).map(|(sum, count)| sum / count).collect();
    let n = means.len() as f64;
    let mean = means.iter().sum::<f64>() / n;
    let variance = means.iter().map(|m| (m - mean) * (m - mean)).sum::<f64>() / (n - 1.0).max(1.0);
    Some((mean, (variance / n).sqrt(), means))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    fn law(parameters: usize, chance: &mut Chance, size: f64) -> Contender {
        let rows = (0..400).map(|_| size * (chance.fraction() - 0.5)).collect();
        Contender { parameters, held_out: Some(rows) }
    }

    /// Clearly different laws keep the order of their errors; equal ones that of their parameters.
    #[test]
    fn order_follows_errors_and_then_parameters() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let steady = seed % 2 == 0;
            let good = law(4, &mut chance, 1.0);
            let mut small = good.clone();
            small.parameters = 2;
            let bad = law(1, &mut chance, 3.0);
            let none = Contender { parameters: 1, held_out: None };
            let ranked = ranks(&[none, bad, good, small], steady);
            assert_eq!(ranked, [(3, 1), (2, 1), (1, 3), (0, 4)], "seed {seed}");
        }
    }

    /// Laws that leave different noise of one size share a rank, but for the chance that two standard errors leave. With
    /// the standard error left out none do.
    #[test]
    fn laws_that_differ_by_chance_share_a_rank() {
        let mut shared = 0;
        for seed in 0..200 {
            let mut chance = Chance(seed);
            let [a, b] = [1, 2].map(|parameters| law(parameters, &mut chance, 1.0));
            shared += usize::from(ranks(&[a, b], seed % 2 == 0) == [(0, 1), (1, 1)]);
        }
        assert!((170..200).contains(&shared), "{shared} of 200");
    }

    /// A law that leaves a known part of what another leaves in each piece is better by the known part of the mean square;
    /// exchanged, it is worse by as much of its own.
    ///
    /// Mutants, each fails: the gain is a part of the first law's mean square; a piece counts where the law is worse.
    #[test]
    fn the_gain_of_a_law_is_that_of_its_squares() {
        for seed in 0..100 {
            let mut chance = Chance(seed);
            let steady = seed % 2 == 0;
            let other = law(3, &mut chance, 1.0);
            let part = chance.between(0.2, 0.9);
            let worse = chance.below(PIECES as u64) as usize;
            let rows = other.held_out.as_ref().unwrap();
            let of = |(row, r): (usize, &f64)| r * if piece(row, rows.len(), steady) < worse { 1.5 } else { part };
            let one = Contender { parameters: 2, held_out: Some(rows.iter().enumerate().map(of).collect()) };
            let square = |of: &Contender| of.held_out.as_ref().unwrap().iter().map(|r| r * r).sum::<f64>();
            let found = paired(&one, &other, steady).unwrap();
            assert_eq!(found.better, (PIECES - worse, PIECES), "seed {seed}");
            let expected = 1.0 - square(&one) / square(&other);
            assert!((found.gain.0 - expected).abs() < 1e-9, "seed {seed}: {found:?}, not {expected}");
            let back = paired(&other, &one, steady).unwrap();
            let ratio = square(&other) / square(&one);
            assert!((back.gain.0 + found.gain.0 * ratio).abs() < 1e-9 * ratio, "seed {seed}: {back:?}, {found:?}");
            assert_eq!(paired(&one, &Contender { parameters: 1, held_out: None }, steady), None);
        }
    }

    #[test]
    fn each_piece_has_its_share_of_rows() {
        for rows in [20, 37, 100, 1001] {
            for steady in [false, true] {
                let mut counts = [0; PIECES];
                (0..rows).for_each(|row| counts[piece(row, rows, steady)] += 1);
                let (least, most) = (counts.iter().min().unwrap(), counts.iter().max().unwrap());
                assert!(most - least <= 1, "{rows}: {counts:?}");
            }
        }
    }
}
