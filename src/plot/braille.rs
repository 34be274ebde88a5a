//! Renders a figure as text: Braille characters with eight dots per cell, axes with numbers, names beside the curves.

use super::scale::Scale;
use super::{Figure, Panel, decimate};

/// Rows of a single panel, and of one among several.
const ROWS: (usize, usize) = (14, 9);
/// ANSI colours of the curves, similar to the palette of the SVG.
const COLOURS: [u8; 6] = [34, 31, 32, 35, 36, 33];
/// Most columns for the names beside the curves.
const NAME: usize = 20;

/// The figure, `width` columns wide, without its title.
pub fn terminal(figure: &Figure, width: usize, colour: bool) -> String {
    let rows = if figure.panels.len() > 1 { ROWS.1 } else { ROWS.0 };
    let panels: Vec<String> = figure.panels.iter().map(|panel| draw(panel, width, rows, colour)).collect();
    panels.join("\n")
}

fn draw(panel: &Panel, width: usize, rows: usize, colour: bool) -> String {
    let panel = &*panel.placed();
    let Some((xs, ys)) = panel.bounds() else {
        return format!("  {}: nothing finite to draw\n", panel.y.title());
    };
    let boolean = panel.curves.iter().all(|curve| curve.boolean);
    let rows = if boolean { 2 } else { rows };
    let y_axis = if boolean {
        Scale::new(0.0, 1.0, 1)
    } else {
        let (low, high) = panel.y.ends(ys, 0.03);
        panel.y.scale(low, high, rows.div_ceil(3))
    };
    let names = panel.curves.len() > 1;
    let right = if names {
        panel.curves.iter().map(|curve| curve.name.chars().count()).max().unwrap_or(0).min(NAME) + 1
    } else {
        0
    };
    let band_names = panel.bands.iter().map(|band| band.name.chars().count());
    let left = y_axis.ticks.iter().map(|tick| tick.label.chars().count()).chain(band_names).max().unwrap_or(0);
    let left = left.clamp(4, NAME) + 2;
    let columns = width.saturating_sub(left + 2 + right).clamp(20, 160);
    let xs = panel.x.ends(xs, 0.0);
    let x_axis = panel.x.scale(xs.0, xs.1, columns / 10);

    let mut canvas = Canvas::new(columns, rows);
    let (dots_x, dots_y) = ((columns * 2) as f64, (rows * 4) as f64);
    let mut ends: Vec<Option<usize>> = vec![None; panel.curves.len()];
    // A cell has the colour of the first curve in it: recordings come last.
    let (models, recorded): (Vec<usize>, Vec<usize>) =
        (0..panel.curves.len()).partition(|i| !panel.curves[*i].recorded);
    for (i, curve) in models.into_iter().chain(recorded).map(|i| (i, &panel.curves[i])) {
        let place = |&(x, y): &(f64, f64)| {
            if !(x.is_finite() && y.is_finite()) {
                return (f64::NAN, f64::NAN);
            }
            // Clamp points far outside, so that lines to them stay short.
            let near = |position: f64| position.clamp(-4.0, 4.0);
            (near(x_axis.position(x)) * (dots_x - 1.0), near(1.0 - y_axis.position(y)) * (dots_y - 1.0))
        };
        let points: Vec<(f64, f64)> = curve.corners().iter().map(place).collect();
        let lines = decimate::lines(&points, dots_x, dots_y);
        for line in &lines {
            if curve.recorded {
                line.iter().for_each(|point| canvas.line(&[*point], i));
            } else {
                canvas.line(line, i);
            }
        }
        ends[i] = lines.last().and_then(|line| line.last()).map(|(_, y)| (y.max(0.0) / 4.0) as usize);
    }
    let beside = if names { placed(&ends, rows) } else { vec![None; rows] };

    let mut out = String::new();
    if !panel.title.is_empty() {
        out += &format!("{:left$}{}\n", "", panel.title);
    }
    out += &format!("{:left$}{}{}\n", "", panel.y.title(), noted(&y_axis.note));
    let row_of = |value: f64| ((1.0 - y_axis.position(value)) * (dots_y - 1.0) / 4.0) as usize;
    for (row, beside) in beside.iter().enumerate() {
        let tick = y_axis.ticks.iter().find(|tick| row_of(tick.at) == row);
        let (label, edge) = tick.map_or(("", '│'), |tick| (tick.label.as_str(), '┤'));
        out += &format!("{label:>width$} {edge}{}", canvas.row(row, colour), width = left - 1);
        if let Some(i) = *beside {
            let name = cut(&panel.curves[i].name);
            out += &if colour {
                format!(" \x1b[{}m{name}\x1b[0m", COLOURS[i % COLOURS.len()])
            } else {
                format!(" {name}")
            };
        }
        truncate_blanks(&mut out);
        out.push('\n');
    }

    let mut rule: Vec<char> = vec!['─'; columns];
    let mut numbers: Vec<char> = vec![' '; columns + left + 12];
    let mut free = 0;
    for tick in &x_axis.ticks {
        let at = ((x_axis.position(tick.at) * (dots_x - 1.0) / 2.0) as usize).min(columns - 1);
        rule[at] = '┬';
        let start = (left + 1 + at).saturating_sub(tick.label.chars().count() / 2);
        if start >= free {
            free = start + tick.label.chars().count() + 1;
            for (place, c) in numbers[start..].iter_mut().zip(tick.label.chars()) {
                *place = c;
            }
        }
    }
    out += &format!("{:left$}└{}\n", "", rule.into_iter().collect::<String>());
    out += numbers.into_iter().collect::<String>().trim_end();
    out += "\n";
    for band in &panel.bands {
        let mut cells = vec![' '; columns];
        for &(from, to) in &band.stretches {
            let cell = |x: f64| ((x_axis.position(x) * columns as f64) as usize).min(columns - 1);
            cells[cell(from)..=cell(to)].fill('▄');
        }
        let strip: String = cells.into_iter().collect();
        out += format!("{:>width$}  {strip}", cut(&band.name), width = left - 1).trim_end();
        out.push('\n');
    }
    let title = format!("{}{}", panel.x.title(), noted(&x_axis.note));
    out += &format!("{:>width$}\n", title, width = left + 1 + columns);
    out
}

fn noted(note: &str) -> String {
    if note.is_empty() { String::new() } else { format!("   {note}") }
}

fn cut(name: &str) -> String {
    if name.chars().count() <= NAME { name.into() } else { name.chars().take(NAME - 1).chain(['…']).collect() }
}

fn truncate_blanks(out: &mut String) {
    out.truncate(out.trim_end_matches([' ', '\u{2800}']).len());
}

/// For each row the curve whose name is shown there: the row of the curve's end, or the nearest free one.
fn placed(ends: &[Option<usize>], rows: usize) -> Vec<Option<usize>> {
    let mut beside: Vec<Option<usize>> = vec![None; rows];
    for (i, end) in ends.iter().enumerate() {
        let Some(end) = *end else { continue };
        if let Some(row) = (0..rows).filter(|row| beside[*row].is_none()).min_by_key(|row| row.abs_diff(end)) {
            beside[row] = Some(i);
        }
    }
    beside
}

/// Dots, eight per cell, and the first curve drawn in each cell.
struct Canvas {
    columns: usize,
    rows: usize,
    cells: Vec<(u8, usize)>,
}

impl Canvas {
    fn new(columns: usize, rows: usize) -> Canvas {
        Canvas { columns, rows, cells: vec![(0, 0); columns * rows] }
    }

    fn dot(&mut self, x: i64, y: i64, curve: usize) {
        /// Bits of a cell by row and column, in the Unicode numbering of Braille dots.
        const BITS: [[u8; 2]; 4] = [[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]];
        if x < 0 || y < 0 || x >= 2 * self.columns as i64 || y >= 4 * self.rows as i64 {
            return;
        }
        let (x, y) = (x as usize, y as usize);
        let cell = &mut self.cells[y / 4 * self.columns + x / 2];
        if cell.0 == 0 {
            cell.1 = curve;
        }
        cell.0 |= BITS[y % 4][x % 2];
    }

    /// Connects the points, given in dots.
    fn line(&mut self, points: &[(f64, f64)], curve: usize) {
        let round = |(x, y): (f64, f64)| (x.round() as i64, y.round() as i64);
        if let Some(first) = points.first() {
            let (x, y) = round(*first);
            self.dot(x, y, curve);
        }
        for pair in points.windows(2) {
            let ((x0, y0), (x1, y1)) = (round(pair[0]), round(pair[1]));
            let steps = (x1 - x0).abs().max((y1 - y0).abs());
            for k in 1..=steps {
                let along = |a: i64, b: i64| a + ((b - a) * k * 2 + steps).div_euclid(2 * steps);
                self.dot(along(x0, x1), along(y0, y1), curve);
            }
        }
    }

    fn row(&self, row: usize, colour: bool) -> String {
        let cells = &self.cells[row * self.columns..(row + 1) * self.columns];
        let mut out = String::new();
        for run in cells.chunk_by(|a, b| a.0 > 0 && b.0 > 0 && a.1 == b.1) {
            let dots: String = run
                .iter()
                .map(
                    |(bits, _)| if *bits == 0 { ' ' } else { char::from_u32(0x2800 + u32::from(*bits)).unwrap_or(' ') },
                )
                .collect();
            if colour && run[0].0 > 0 {
                out += &format!("\x1b[{}m{dots}\x1b[0m", COLOURS[run[0].1 % COLOURS.len()]);
            } else {
                out += &dots;
            }
        }
        out
    }
}
