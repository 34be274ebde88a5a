//! Points of a curve, thinned to what a picture can show.
//!
//! In: points in the order of time, at any distance. Out: fewer points with the same picture.

/// The points of a window in at most four a column: the first, the last, the least and the greatest (the M4 of Jugel et
/// al., VLDB 2014), so that a polyline through them covers the same pixels. One point on either side of the window is
/// kept, so that the curve reaches its edges.
pub fn window(points: &[(f64, f64)], from: f64, to: f64, columns: usize) -> Vec<(f64, f64)> {
    let begin = points.partition_point(|point| point.0 < from).saturating_sub(1);
    let end = (points.partition_point(|point| point.0 <= to) + 1).min(points.len());
    let inside = &points[begin.min(end)..end];
    if inside.len() <= 4 * columns || to.partial_cmp(&from) != Some(std::cmp::Ordering::Greater) {
        return inside.to_vec();
    }
    // Before the window, in it by columns.
    let column = |x: f64| {
        let place = (x - from) / (to - from) * columns as f64;
        if place < 0.0 { -1 } else { place as i64 }
    };
    let mut out: Vec<(f64, f64)> = Vec::with_capacity(4 * columns);
    let mut rest = inside;
    while let Some(first) = rest.first() {
        let own = column(first.0);
        let n = rest.partition_point(|point| column(point.0) <= own).max(1);
        let (these, others) = rest.split_at(n);
        let by_value = |a: &usize, b: &usize| these[*a].1.total_cmp(&these[*b].1);
        let least = (0..n).min_by(by_value).unwrap_or(0);
        let greatest = (0..n).max_by(by_value).unwrap_or(0);
        let mut kept = [0, least, greatest, n - 1];
        kept.sort_unstable();
        for (i, at) in kept.iter().enumerate() {
            if i == 0 || kept[i - 1] != *at {
                out.push(these[*at]);
            }
        }
        rest = others;
    }
    out
}

/// A path in the plane without the points that fall into the cell of the point before, on a grid of 2048 × 2048 over
/// all of it.
pub fn path(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    const GRID: f64 = 2048.0;
    let finite = |of: fn(&(f64, f64)) -> f64| {
        let values = points.iter().map(of).filter(|value| value.is_finite());
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)))
    };
    let (x, y) = (finite(|point| point.0), finite(|point| point.1));
    let cell = |value: f64, (low, high): (f64, f64)| ((value - low) / (high - low) * GRID).floor();
    let cell = |point: &(f64, f64)| (cell(point.0, x).to_bits(), cell(point.1, y).to_bits());
    let mut last = None;
    let mut out = Vec::new();
    for (i, point) in points.iter().enumerate() {
        let here = Some(cell(point));
        if here != last || i + 1 == points.len() {
            out.push(*point);
        }
        last = here;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_thinned_window_keeps_every_columns_extremes_and_the_order_of_time() {
        let mut state = 7_u64;
        let mut noise = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / (1_u64 << 31) as f64
        };
        let mut t = 0.0;
        let points: Vec<(f64, f64)> = (0..50_000)
            .map(|_| {
                t += 1e-3 * noise();
                (t, noise() - 0.5)
            })
            .collect();
        let (from, to) = (0.3 * t, 0.7 * t);
        let thinned = window(&points, from, to, 300);
        assert!(thinned.len() <= 4 * 302 && thinned.is_sorted_by(|a, b| a.0 <= b.0), "{}", thinned.len());
        let extremes = |points: &[(f64, f64)], i: usize| {
            let edge = |i: usize| from + (to - from) * i as f64 / 300.0;
            let inside = points.iter().filter(|point| (edge(i)..edge(i + 1)).contains(&point.0));
            inside.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), p| (low.min(p.1), high.max(p.1)))
        };
        // Rounding decides to which of two columns a point on their edge belongs.
        let equal = (0..300).filter(|i| extremes(&thinned, *i) == extremes(&points, *i)).count();
        assert!(equal >= 299, "{equal} of 300 columns");
        assert!(thinned[0].0 < from && thinned.last().unwrap().0 > to);
    }

    #[test]
    fn few_points_and_odd_windows_are_left_alone() {
        let points = [(0.0, 1.0), (1.0, 2.0), (1.0, -2.0), (2.0, 0.0)];
        assert_eq!(window(&points, 0.0, 2.0, 100), points);
        assert_eq!(window(&points, 0.5, 0.6, 100), [(0.0, 1.0), (1.0, 2.0)]);
        assert_eq!(window(&points, 5.0, 4.0, 100), [(2.0, 0.0)]);
        assert_eq!(window(&[], 0.0, 1.0, 100), []);
        assert_eq!(window(&points, f64::NAN, f64::NAN, 1).len(), 1);
    }

    #[test]
    fn a_path_keeps_its_corners_and_its_end() {
        let circle: Vec<(f64, f64)> = (0..100_000)
            .map(|i| {
                // Points of a square, dense on its edges.
                let s = f64::from(i) / 25_000.0;
                match s as u32 {
                    0 => (s, 0.0),
                    1 => (1.0, s - 1.0),
                    2 => (3.0 - s, 1.0),
                    _ => (0.0, 4.0 - s),
                }
            })
            .collect();
        let thinned = path(&circle);
        assert!((8000..8300).contains(&thinned.len()), "{}", thinned.len());
        assert_eq!(thinned.last(), circle.last());
        assert_eq!(path(&[(1.0, 1.0); 5]).len(), 2);
    }
}
