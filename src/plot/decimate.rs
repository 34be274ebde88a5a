//! Reduces the points of a curve without changing its picture.

/// Points of one uninterrupted line.
pub type Line = Vec<(f64, f64)>;

/// The lines of a curve in a picture of `width` × `height` pixels, in pixel coordinates, with a gap where a point is
/// not finite. If x only increases, each pixel column keeps its first, lowest, highest and last point; otherwise,
/// points with a minimum distance are kept.
pub fn lines(points: &[(f64, f64)], width: f64, height: f64) -> Vec<Line> {
    points
        .split(|(x, y)| !(x.is_finite() && y.is_finite()))
        .filter(|line| !line.is_empty())
        .map(|line| {
            if line.len() as f64 <= 2.0 * width {
                line.to_vec()
            } else if line.windows(2).all(|pair| pair[0].0 <= pair[1].0) {
                columns(line)
            } else {
                apart(line, width * height)
            }
        })
        .collect()
}

/// First, least, greatest and last point of each pixel column, in the order of the line.
fn columns(line: &[(f64, f64)]) -> Line {
    let mut kept = Line::new();
    for column in line.chunk_by(|a, b| a.0.floor() == b.0.floor()) {
        let index = |better: fn(f64, f64) -> bool| {
            let mut best = 0;
            for (i, point) in column.iter().enumerate() {
                if better(point.1, column[best].1) {
                    best = i;
                }
            }
            best
        };
        let mut picks = [0, index(|a, b| a < b), index(|a, b| a > b), column.len() - 1];
        picks.sort_unstable();
        let mut last = None;
        for pick in picks {
            if last != Some(pick) {
                kept.push(column[pick]);
            }
            last = Some(pick);
        }
    }
    kept
}

/// Points at least a fraction of a pixel from the previous one kept. A line that covers the picture repeatedly is
/// thinned further, so that the number of points is bounded.
fn apart(line: &[(f64, f64)], area: f64) -> Line {
    let most = (area / 10.0).clamp(1_000.0, 30_000.0) as usize;
    let mut distance = 0.4;
    loop {
        let mut kept = vec![line[0]];
        let mut last = line[0];
        for &point in &line[1..] {
            if (point.0 - last.0).abs() >= distance || (point.1 - last.1).abs() >= distance {
                kept.push(point);
                last = point;
            }
        }
        kept.extend(line.last().filter(|end| **end != last));
        if kept.len() <= most {
            return kept;
        }
        distance *= 1.5;
        if distance > 4.0 {
            // Jumps all over the picture: thinning by distance does not help.
            let stride = kept.len().div_ceil(most);
            return kept.into_iter().step_by(stride).collect();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spikes_survive_and_size_is_bounded() {
        let mut points: Line = (0..1_000_000).map(|i| (i as f64 * 7e-4, 50.0)).collect();
        points[345_678].1 = 3.0;
        let lines = lines(&points, 700.0, 200.0);
        assert_eq!(lines.len(), 1);
        assert!(lines[0].len() <= 4 * 702, "{}", lines[0].len());
        assert!(lines[0].contains(&points[345_678]));
        assert_eq!((lines[0].first(), lines[0].last()), (points.first(), points.last()));
    }

    #[test]
    fn a_gap_stays_a_gap() {
        assert_eq!(lines(&[(0.0, 1.0), (1.0, f64::NAN), (2.0, 1.0), (3.0, 2.0)], 100.0, 100.0).len(), 2);
        assert!(lines(&[(0.0, f64::INFINITY)], 100.0, 100.0).is_empty());
    }

    #[test]
    fn the_points_of_noise_are_bounded_too() {
        let points: Line = (0..400_000u64).map(|i| ((i * 7919 % 701) as f64, (i * 104_729 % 199) as f64)).collect();
        assert!(lines(&points, 700.0, 200.0)[0].len() <= 30_000);
    }
}
