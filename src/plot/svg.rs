//! Renders a figure as a self-contained SVG: no script, no external request, readable in any viewer and in print.

use super::scale::Scale;
use super::{Curve, Figure, GREYS, Lines, Look, PALETTE, Panel, RECORDED, SHADES, decimate};
use std::fmt::{Display, Write};

/// Width of a figure in px.
const WIDTH: f64 = 860.0;
/// Font size in px for which the following sizes hold; they grow with it.
const TEXT: f64 = 13.0;
/// Space left of the axes: numbers and the title of y.
const LEFT: f64 = 84.0;
/// Space right of the axes: half of the last number.
const RIGHT: f64 = 28.0;
/// Space below the axes: numbers and the title of x.
const BELOW: f64 = 50.0;
/// Space between panels, and below the last one.
const GAP: f64 = 14.0;
/// Height of a row of the legend.
const ROW: f64 = 22.0;
/// Least height of axes in a figure of a given size.
const LEAST: f64 = 24.0;

const INK: &str = "#1f2328";
const FAINT: &str = "#59636e";
const GRID: &str = "#e4e7eb";
const DASHES: [&[f64]; 3] = [&[], &[7.0, 4.0], &[2.0, 3.0]];
/// Dash patterns where dashes distinguish the curves.
const PRINT_DASHES: [&[f64]; 6] =
    [&[], &[8.0, 4.0], &[2.0, 3.0], &[10.0, 3.0, 2.0, 3.0], &[14.0, 4.0], &[10.0, 3.0, 2.0, 3.0, 2.0, 3.0]];
/// Dash patterns of a curve that covers one, two or three others, which show through its gaps.
const ON_OTHERS: [&[f64]; 3] = [&[8.0, 8.0], &[4.0, 12.0], &[2.0, 14.0]];

/// The figure as SVG text.
pub fn svg(figure: &Figure, look: &Look) -> String {
    inline(figure, look, look.size.map_or(WIDTH, |(wide, _)| wide), "axes")
}

/// Space around the axes of a panel.
#[derive(Clone, Copy)]
struct Frame {
    left: f64,
    right: f64,
    below: f64,
}

/// What is the same for all panels: font size in relation to [`TEXT`], and what tells curves apart.
#[derive(Clone, Copy)]
struct Pen {
    k: f64,
    lines: Lines,
}

/// The figure as SVG text, `wide` px wide, for a page with several figures: `id` makes its identifiers unique.
pub fn inline(figure: &Figure, look: &Look, wide: f64, id: &str) -> String {
    let pen = Pen { k: look.font / TEXT, lines: look.lines };
    let k = pen.k;
    let mut body = String::new();
    let mut y = if look.size.is_some() { 4.0 * k } else { 18.0 * k };
    let frame = frame(figure, look, k);
    if !figure.title.is_empty() {
        y += 16.0 * k;
        let style = format!("font-size=\"{}\" font-weight=\"500\" fill=\"{INK}\"", tenth(18.0 * k));
        let title = fitted(&figure.title, wide - frame.left - frame.right, 18.0 * k);
        text(&mut body, frame.left, y, "start", &style, &title);
        y += 8.0 * k;
    }
    if !figure.subtitle.is_empty() {
        y += 12.0 * k;
        let shown = fitted(&figure.subtitle, wide - frame.left - frame.right, 12.5 * k);
        let style = format!("font-size=\"{}\" fill=\"{FAINT}\"", tenth(12.5 * k));
        text(&mut body, frame.left, y, "start", &style, &shown);
        y += 8.0 * k;
    }
    y += if look.size.is_some() { 0.0 } else { 8.0 * k };
    let columns = look.columns.clamp(1, figure.panels.len().max(1));
    let cell = wide / columns as f64;
    let rows: Vec<&[Panel]> = figure.panels.chunks(columns).collect();
    let above = |row: &[Panel]| row.iter().map(|panel| above(panel, cell, frame, k)).fold(0.0, f64::max);
    let is_low = |row: &[Panel]| row.iter().all(is_boolean);
    // Heights of the axes of each row. In a given size they share what is left of it.
    let share = look.size.map(|(_, tall)| {
        let taken: f64 = rows.iter().map(|row| above(row) + frame.below).sum();
        let shares: f64 = rows.iter().map(|row| if is_low(row) { 0.25 } else { 1.0 }).sum();
        (tall - y - taken - GAP * k * rows.len().saturating_sub(1) as f64) / shares.max(0.25)
    });
    for (number, row) in rows.iter().enumerate() {
        let tall = match share {
            Some(share) => (share * if is_low(row) { 0.25 } else { 1.0 }).max(LEAST),
            None => (row.iter().map(|panel| height(panel, rows.len())).fold(0.0, f64::max)
                * (cell / WIDTH).sqrt().max(0.6))
            .round(),
        };
        let top = y + above(row);
        for (column, panel) in row.iter().enumerate() {
            let id = format!("{id}{}", number * columns + column);
            let left = cell * column as f64 + frame.left;
            let place =
                PanelPlace { left, top, width: (cell - frame.left - frame.right).max(LEAST), height: tall, frame };
            draw_panel(&mut body, &panel.placed(), &id, place, pen);
        }
        let last = number + 1 == rows.len() && look.size.is_some();
        y = top + tall + frame.below + if last { 0.0 } else { GAP * k };
    }
    let title = escaped(&figure.title);
    let tall = look.size.map_or(y.round(), |(_, tall)| tall);
    // The size of a figure for print is physical: 96 px are an inch.
    let (width, height) = match look.size {
        Some((wide, tall)) => (format!("{:.2}mm", wide * 25.4 / 96.0), format!("{:.2}mm", tall * 25.4 / 96.0)),
        None => (tenth(wide).to_string(), tenth(tall).to_string()),
    };
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {} {}\" \
         role=\"img\" font-family=\"Roboto, 'Helvetica Neue', Arial, sans-serif\" font-size=\"{}\">\n\
         <title>{title}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{body}</svg>\n",
        tenth(wide),
        tenth(tall),
        tenth(look.font),
    )
}

/// Space around the axes: in a figure of a given size only as much as its numbers need.
fn frame(figure: &Figure, look: &Look, k: f64) -> Frame {
    if look.size.is_none() {
        return Frame { left: LEFT * k, right: RIGHT * k, below: BELOW * k };
    }
    let widest = |panel: &Panel| {
        let panel = panel.placed();
        if is_boolean(&panel) {
            return text_width("false", TEXT * k);
        }
        let (_, ys) = panel.bounds().unwrap_or(((0.0, 1.0), (0.0, 1.0)));
        let (low, high) = panel.y.ends(ys, 0.06);
        let scale = panel.y.scale(low, high, 5);
        scale.ticks.iter().map(|tick| text_width(&tick.label, TEXT * k)).fold(0.0, f64::max)
    };
    let numbers = figure.panels.iter().map(widest).fold(0.0, f64::max);
    Frame { left: numbers + 32.0 * k, right: 14.0 * k, below: 40.0 * k }
}

/// Where the axes of a panel are.
#[derive(Clone, Copy)]
struct PanelPlace {
    left: f64,
    top: f64,
    width: f64,
    height: f64,
    frame: Frame,
}

/// Height of a panel's axes.
fn height(panel: &Panel, panels: usize) -> f64 {
    if is_boolean(panel) {
        return 64.0;
    }
    match panels {
        0 | 1 => 360.0,
        2 => 250.0,
        _ => 190.0,
    }
}

fn is_boolean(panel: &Panel) -> bool {
    !panel.curves.is_empty() && panel.curves.iter().all(|curve| curve.boolean)
}

/// Space for title, legend and note above the axes of a panel.
fn above(panel: &Panel, cell: f64, frame: Frame, k: f64) -> f64 {
    let title = if panel.title.is_empty() { 0.0 } else { 18.0 * k };
    let legend = match panel.legend {
        true => entries(panel, cell - frame.left - frame.right, k).last().map_or(4.0, |entry| entry.y / k + 4.0) * k,
        false => 4.0 * k,
    };
    title + legend + 8.0 * k
}

fn draw_panel(out: &mut String, panel: &Panel, id: &str, place: PanelPlace, pen: Pen) {
    let PanelPlace { left, top, width, height, frame } = place;
    let (k, bottom) = (pen.k, top + height);
    let bounds = panel.bounds();
    let (xs, ys) = bounds.unwrap_or(((0.0, 1.0), (0.0, 1.0)));
    let running = panel.curves.iter().all(|curve| curve.points.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    // Time fills the width; a loop in the plane keeps a distance from the frame.
    let marked = panel.curves.iter().any(|curve| curve.marks);
    let mut xs = panel.x.ends(xs, if running && !marked { 0.0 } else { 0.04 });
    let mut ys = panel.y.ends(ys, 0.06);
    if bounds.is_some() && !running {
        (xs, ys) = equal_scale(panel, xs, ys, width / height);
    }
    // Powers of ten are short.
    let room = if panel.x.logarithmic { 50.0 } else { 90.0 };
    let x_axis = panel.x.scale(xs.0, xs.1, (width / (room * k)).max(2.0) as usize);
    let y_axis = if is_boolean(panel) {
        let mut axis = Scale::new(-0.15, 1.15, 2);
        axis.ticks.retain(|tick| tick.at == 0.0 || tick.at == 1.0);
        axis
    } else {
        panel.y.scale(ys.0, ys.1, (height / (38.0 * k)).max(2.0) as usize)
    };
    let px = |value: f64| left + width * x_axis.position(value);
    let py = |value: f64| bottom - height * y_axis.position(value);

    let (legend_top, legend_width) = (if panel.title.is_empty() { 0.0 } else { 18.0 * k }, width);
    let head = top - above(panel, width + frame.left + frame.right, frame, k);
    if !panel.title.is_empty() {
        let style = format!("font-weight=\"500\" fill=\"{INK}\"");
        text(out, left, head + 14.0 * k, "start", &style, &fitted(&panel.title, width, TEXT * k));
    }

    let _ = writeln!(
        out,
        "<clipPath id=\"{id}\"><rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\"/></clipPath>"
    );
    for (band, shade) in panel.bands.iter().zip(SHADES.iter().cycle()) {
        for &(from, to) in &merged(&band.stretches, (xs.1 - xs.0) / width) {
            let (from, to) = (px(from).max(left), px(to).min(left + width));
            if to < left || from > left + width {
                continue;
            }
            let breadth = (to - from).max(0.5);
            let _ = writeln!(
                out,
                "<rect x=\"{from:.1}\" y=\"{top:.1}\" width=\"{breadth:.1}\" height=\"{height:.1}\" fill=\"{shade}\"/>"
            );
        }
    }

    let mut grid = String::new();
    for tick in &x_axis.ticks {
        let x = px(tick.at);
        let _ = write!(grid, "M{x:.1} {top:.1}V{bottom:.1}");
    }
    for tick in &y_axis.ticks {
        let y = py(tick.at);
        let _ = write!(grid, "M{left:.1} {y:.1}H{:.1}", left + width);
        let label = match (is_boolean(panel), tick.at == 0.0) {
            (true, true) => "false".into(),
            (true, false) => "true".into(),
            (false, _) => typographic(&tick.label),
        };
        text(out, left - 9.0 * k, y + 4.5 * k, "end", &format!("fill=\"{INK}\""), &label);
    }
    // Numbers that would touch the one before are left out.
    let mut free = f64::NEG_INFINITY;
    for tick in &x_axis.ticks {
        let (x, label) = (px(tick.at), typographic(&tick.label));
        let half = text_width(&label, TEXT * k) / 2.0;
        if x - half >= free {
            text(out, x, bottom + 17.0 * k, "middle", &format!("fill=\"{INK}\""), &label);
            free = x + half + 5.0 * k;
        }
    }
    let hair = |width: f64| tenth(width * k.max(0.5));
    let _ = writeln!(out, "<path d=\"{grid}\" stroke=\"{GRID}\" stroke-width=\"{}\" fill=\"none\"/>", hair(1.0));
    if y_axis.from < 0.0 && y_axis.to > 0.0 && !is_boolean(panel) && !panel.y.logarithmic {
        let y = py(0.0);
        let _ = writeln!(
            out,
            "<path d=\"M{left:.1} {y:.1}H{:.1}\" stroke=\"#a8b0b9\" stroke-width=\"{}\" fill=\"none\"/>",
            left + width,
            hair(1.0)
        );
    }

    let _ = writeln!(
        out,
        "<g clip-path=\"url(#{id})\" fill=\"none\" stroke-width=\"{:.2}\" stroke-linejoin=\"round\" \
         stroke-linecap=\"butt\">",
        1.7 * k
    );
    let lines: Vec<Vec<decimate::Line>> = panel.curves.iter().map(|curve| lines_of(curve, px, py, place)).collect();
    let ranks = ranks(panel, &lines, 1.7 * k);
    let (models, recorded): (Vec<usize>, Vec<usize>) =
        (0..panel.curves.len()).partition(|i| !panel.curves[*i].recorded);
    for i in recorded {
        let dots = spaced(&lines[i], 2.6 * k);
        let mut path = String::new();
        for (x, y) in dots {
            let _ = write!(path, "M{} {}h0.01", tenth(x), tenth(y));
        }
        if !path.is_empty() {
            let _ = writeln!(
                out,
                "<path d=\"{path}\" stroke=\"{RECORDED}\" stroke-width=\"{:.2}\" stroke-linecap=\"round\"/>",
                2.6 * k
            );
        }
    }
    for i in models {
        let curve = &panel.curves[i];
        let colour = colour(panel, i, pen);
        let path = path(&lines[i]);
        if !path.is_empty() {
            let _ = writeln!(out, "<path d=\"{path}\" {}/>", stroke(panel, i, ranks[i], pen));
        }
        if curve.marks {
            for &(x, y) in curve.points.iter().filter(|(x, y)| x.is_finite() && y.is_finite()) {
                let (x, y) = (px(x), py(y));
                match pen.lines {
                    Lines::Colour => {
                        let r = tenth(3.0 * k);
                        let _ = writeln!(
                            out,
                            "<circle cx=\"{}\" cy=\"{}\" r=\"{r}\" fill=\"{colour}\"/>",
                            tenth(x),
                            tenth(y)
                        );
                    }
                    Lines::Dashes | Lines::Grey => out.push_str(&marker(i, x, y, colour, k)),
                }
            }
        } else if pen.lines != Lines::Colour && !curve.boolean {
            for (x, y) in along(&lines[i], i, place) {
                out.push_str(&marker(i, x, y, colour, k));
            }
        }
    }
    out.push_str("</g>\n");

    let _ = writeln!(
        out,
        "<path d=\"M{left:.1} {top:.1}V{bottom:.1}H{:.1}\" stroke=\"{INK}\" stroke-width=\"{}\" fill=\"none\"/>",
        left + width,
        hair(1.1)
    );
    if bounds.is_none() {
        let words = "nothing finite to draw";
        text(out, left + width / 2.0, top + height / 2.0, "middle", &format!("fill=\"{FAINT}\""), words);
    }
    let small = format!("font-size=\"{}\" fill=\"{FAINT}\"", tenth(12.0 * k));
    let title_y = bottom + frame.below - 6.0 * k;
    if !x_axis.note.is_empty() {
        text(out, left + width, title_y, "end", &small, &typographic(&x_axis.note));
    }
    if !y_axis.note.is_empty() {
        text(out, left - 9.0 * k, top - 6.0 * k, "start", &small, &typographic(&y_axis.note));
    }
    let title = fitted(&panel.x.title(), width + frame.right, TEXT * k);
    text(out, left + width / 2.0, title_y, "middle", &format!("fill=\"{INK}\""), &title);
    let room = height + 30.0 * k;
    let title = if text_width(&panel.y.title(), TEXT * k) <= room {
        panel.y.title()
    } else if panel.curves.len() > 1 && !panel.y.unit.is_empty() {
        format!("[{}]", panel.y.unit)
    } else {
        fitted(&panel.y.title(), room, TEXT * k)
    };
    let (x, middle) = (left - frame.left + if frame.left < LEFT * k { 13.0 } else { 22.0 } * k, top + height / 2.0);
    let turned = format!("fill=\"{INK}\" transform=\"rotate(-90 {x:.1} {middle:.1})\"");
    text(out, x, middle, "middle", &turned, &title);
    if panel.legend {
        legend(out, panel, &ranks, (left, head + legend_top), legend_width, pen);
    }
}

/// Two lengths of one unit have one scale where that leaves neither axis short: a circle is a circle.
fn equal_scale(panel: &Panel, xs: (f64, f64), ys: (f64, f64), aspect: f64) -> ((f64, f64), (f64, f64)) {
    let (x, y) = (&panel.x, &panel.y);
    let free = !x.logarithmic && !y.logarithmic && x.range.is_none() && y.range.is_none();
    let (wide, tall) = (xs.1 - xs.0, ys.1 - ys.0);
    if !free || x.unit.is_empty() || x.unit != y.unit || !(0.4..=2.5).contains(&(wide / tall)) {
        return (xs, ys);
    }
    let around = |(from, to): (f64, f64), size: f64| {
        let middle = from / 2.0 + to / 2.0;
        (middle - size / 2.0, middle + size / 2.0)
    };
    if wide > tall * aspect { (xs, around(ys, wide / aspect)) } else { (around(xs, tall * aspect), ys) }
}

/// An entry of a legend: its place from the left top of the legend, its name, and its curve; none for a band.
struct LegendEntry {
    x: f64,
    y: f64,
    name: String,
    curve: Option<usize>,
}

/// The entries of a legend, if there are several curves and bands.
fn entries(panel: &Panel, wide: f64, k: f64) -> Vec<LegendEntry> {
    let mut out = Vec::new();
    if panel.curves.len() + panel.bands.len() < 2 {
        return out;
    }
    let curves = panel.curves.iter().enumerate().map(|(i, curve)| (&curve.name, Some(i)));
    let bands = panel.bands.iter().map(|band| (&band.name, None));
    let (mut x, mut y) = (0.0, 14.0 * k);
    for (name, curve) in curves.chain(bands) {
        let name = fitted(name, wide - 30.0 * k, TEXT * k);
        let taken = 30.0 * k + text_width(&name, TEXT * k);
        if x > 0.0 && x + taken > wide {
            x = 0.0;
            y += ROW * k;
        }
        out.push(LegendEntry { x, y, name, curve });
        x += taken + 18.0 * k;
    }
    out
}

/// Names of curves and bands, if there are several.
fn legend(out: &mut String, panel: &Panel, ranks: &[usize], (left, top): (f64, f64), wide: f64, pen: Pen) {
    let k = pen.k;
    let mut shade = SHADES.iter().cycle();
    for LegendEntry { x, y, name, curve } in entries(panel, wide, k) {
        let (x, y) = (left + x, top + y);
        let middle = y - 4.5 * k;
        let _ = match curve {
            Some(i) if panel.curves[i].recorded => writeln!(
                out,
                "<path d=\"M{x:.1} {middle:.1}m{:.1} 0h0.01m{step:.1} 0h0.01m{step:.1} 0h0.01\" fill=\"none\" \
                 stroke=\"{RECORDED}\" stroke-width=\"{:.2}\" stroke-linecap=\"round\"/>",
                4.0 * k,
                3.0 * k,
                step = 7.0 * k,
            ),
            Some(i) => {
                let drawn = writeln!(
                    out,
                    "<path d=\"M{x:.1} {middle:.1}h{:.1}\" fill=\"none\" stroke-width=\"{:.2}\" {}/>",
                    22.0 * k,
                    2.2 * k,
                    stroke(panel, i, ranks[i], pen)
                );
                if pen.lines != Lines::Colour && !panel.curves[i].boolean {
                    out.push_str(&marker(i, x + 11.0 * k, middle, colour(panel, i, pen), k));
                }
                drawn
            }
            None => writeln!(
                out,
                "<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"{:.1}\" height=\"{:.1}\" fill=\"{}\" stroke=\"#c3cad2\" \
                 stroke-width=\"0.7\"/>",
                y - 11.0 * k,
                22.0 * k,
                13.0 * k,
                shade.next().unwrap_or(&GRID)
            ),
        };
        text(out, x + 28.0 * k, y, "start", &format!("fill=\"{INK}\""), &name);
    }
}

/// Numbers of colour and dash pattern of the `i`-th curve: colours repeat with other dash patterns.
fn style(panel: &Panel, i: usize) -> (usize, usize) {
    let before = panel.curves[..i].iter().filter(|curve| !curve.recorded).count();
    let (colour, dashes) = panel.curves[i].style.unwrap_or((before, 0));
    (colour, dashes + colour / PALETTE.len())
}

fn colour(panel: &Panel, i: usize, pen: Pen) -> &'static str {
    let (colour, _) = style(panel, i);
    match pen.lines {
        Lines::Colour | Lines::Dashes => PALETTE[colour % PALETTE.len()],
        Lines::Grey => GREYS[colour % GREYS.len()],
    }
}

/// Colour and dash pattern of the `i`-th curve, which lies on `rank` others.
fn stroke(panel: &Panel, i: usize, rank: usize, pen: Pen) -> String {
    let (number, dashes) = style(panel, i);
    let pattern = match pen.lines {
        Lines::Colour if rank > 0 && dashes == 0 => ON_OTHERS[(rank - 1).min(ON_OTHERS.len() - 1)],
        Lines::Colour => DASHES[dashes % DASHES.len()],
        Lines::Dashes | Lines::Grey => PRINT_DASHES[(number + dashes) % PRINT_DASHES.len()],
    };
    let colour = colour(panel, i, pen);
    if pattern.is_empty() {
        return format!("stroke=\"{colour}\"");
    }
    let pattern: Vec<String> = pattern.iter().map(|length| tenth(length * pen.k).to_string()).collect();
    format!("stroke=\"{colour}\" stroke-dasharray=\"{}\"", pattern.join(" "))
}

/// A marker of the `i`-th curve.
fn marker(i: usize, x: f64, y: f64, colour: &str, k: f64) -> String {
    let r = 3.2 * k;
    let shape = match i % 6 {
        0 => format!("M{:.1} {y:.1}a{r:.1} {r:.1} 0 1 0 {d:.1} 0a{r:.1} {r:.1} 0 1 0 -{d:.1} 0z", x - r, d = 2.0 * r),
        1 => format!("M{:.1} {:.1}h{d:.1}v{d:.1}h-{d:.1}z", x - 0.9 * r, y - 0.9 * r, d = 1.8 * r),
        2 => format!("M{x:.1} {:.1}l{:.1} {h:.1}h-{:.1}z", y - 1.2 * r, 1.1 * r, 2.2 * r, h = 2.0 * r),
        3 => format!("M{x:.1} {:.1}l{r:.1} {d:.1}l-{r:.1} {d:.1}l-{r:.1} -{d:.1}z", y - 1.3 * r, d = 1.3 * r),
        4 => format!("M{x:.1} {:.1}l{:.1} -{h:.1}h-{:.1}z", y + 1.2 * r, 1.1 * r, 2.2 * r, h = 2.0 * r),
        _ => format!("M{:.1} {:.1}l{d:.1} {d:.1}m0 -{d:.1}l-{d:.1} {d:.1}", x - r, y - r, d = 2.0 * r),
    };
    format!("<path d=\"{shape}\" fill=\"#ffffff\" stroke=\"{colour}\" stroke-width=\"{:.2}\"/>\n", 1.2 * k)
}

/// Six places along the lines of a curve, others for each curve so that markers do not cover each other.
fn along(lines: &[decimate::Line], i: usize, place: PanelPlace) -> Vec<(f64, f64)> {
    const MARKERS: usize = 6;
    let inside = |(x, y): &(f64, f64)| {
        (place.left..=place.left + place.width).contains(x) && (place.top..=place.top + place.height).contains(y)
    };
    let step = |pair: &[(f64, f64)]| distance(pair[1].0 - pair[0].0, pair[1].1 - pair[0].1);
    let pairs = || lines.iter().flat_map(|line| line.windows(2)).filter(|pair| inside(&pair[0]) && inside(&pair[1]));
    let length: f64 = pairs().map(step).sum();
    let first = (0.25 + 0.6180339887 * i as f64) % 1.0;
    let mut wanted = (0..MARKERS).map(|n| length * (n as f64 + first) / MARKERS as f64).peekable();
    let (mut out, mut at) = (Vec::new(), 0.0);
    for pair in pairs() {
        let long = step(pair);
        while let Some(next) = wanted.next_if(|next| *next <= at + long && long > 0.0) {
            let part = (next - at) / long;
            out.push((pair[0].0 + part * (pair[1].0 - pair[0].0), pair[0].1 + part * (pair[1].1 - pair[0].1)));
        }
        at += long;
    }
    out
}

fn distance(dx: f64, dy: f64) -> f64 {
    (dx * dx + dy * dy).sqrt()
}

/// Points at least `apart` px from the one before.
fn spaced(lines: &[decimate::Line], apart: f64) -> Vec<(f64, f64)> {
    let mut out: Vec<(f64, f64)> = Vec::new();
    for &point in lines.iter().flatten() {
        if out.last().is_none_or(|last| distance(point.0 - last.0, point.1 - last.1) >= apart) {
            out.push(point);
        }
    }
    out
}

/// For each curve, on how many earlier ones it lies.
fn ranks(panel: &Panel, lines: &[Vec<decimate::Line>], pen: f64) -> Vec<usize> {
    /// More curves than this are not compared: their number of pairs would take longer than drawing them.
    const MOST: usize = 24;
    let mut ranks = vec![0; lines.len()];
    if lines.len() > MOST {
        return ranks;
    }
    let comparable = |i: usize| !panel.curves[i].recorded && !panel.curves[i].boolean && !panel.curves[i].marks;
    for i in (1..lines.len()).filter(|i| comparable(*i)) {
        let below = (0..i).filter(|j| comparable(*j) && covers(&lines[*j], &lines[i], pen));
        ranks[i] = below.map(|j| ranks[j] + 1).max().unwrap_or(0);
    }
    ranks
}

/// Whether most of the lines `upper` lie within the breadth of a pen of `lower`.
fn covers(lower: &[decimate::Line], upper: &[decimate::Line], pen: f64) -> bool {
    const SAMPLES: usize = 50;
    let points: Vec<(f64, f64)> = upper.iter().flatten().copied().collect();
    if points.len() < 2 {
        return false;
    }
    let near = |&(x, y): &(f64, f64)| {
        lower.iter().flat_map(|line| line.windows(2)).any(|pair| {
            let ((ax, ay), (bx, by)) = (pair[0], pair[1]);
            // Most segments are far away.
            if x < ax.min(bx) - pen || x > ax.max(bx) + pen || y < ay.min(by) - pen || y > ay.max(by) + pen {
                return false;
            }
            let (dx, dy) = (bx - ax, by - ay);
            let along = (((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy).max(1e-12)).clamp(0.0, 1.0);
            distance(x - ax - along * dx, y - ay - along * dy) <= pen
        })
    };
    let samples = (0..SAMPLES).map(|n| &points[n * (points.len() - 1) / (SAMPLES - 1)]);
    2 * samples.filter(|point| near(point)).count() > SAMPLES
}

/// The lines of a curve in px, without the parts far outside the axes.
fn lines_of(curve: &Curve, px: impl Fn(f64) -> f64, py: impl Fn(f64) -> f64, place: PanelPlace) -> Vec<decimate::Line> {
    let PanelPlace { left, top, width, height, .. } = place;
    let near = |value: f64, from: f64, size: f64| value.clamp(from - 20.0 * size, from + 21.0 * size);
    let place = |&(x, y): &(f64, f64)| {
        let finite = x.is_finite() && y.is_finite();
        if finite { (near(px(x), left, width), near(py(y), top, height)) } else { (f64::NAN, f64::NAN) }
    };
    let pixels: Vec<(f64, f64)> = curve.corners().iter().map(place).collect();
    // Of points beside the axes only those count that are connected with one inside.
    let side = |x: f64| if x < left { -1 } else { i32::from(x > left + width) };
    let beside = |k: usize| {
        let own = side(pixels[k].0);
        let same = |other: Option<usize>| other.and_then(|k| pixels.get(k)).is_none_or(|point| side(point.0) == own);
        own != 0 && same(k.checked_sub(1)) && same(Some(k + 1))
    };
    let kept: Vec<(f64, f64)> = (0..pixels.len()).filter(|k| !beside(*k)).map(|k| pixels[k]).collect();
    decimate::lines(&kept, width, height)
}

/// Lines as the data of an SVG path.
fn path(lines: &[decimate::Line]) -> String {
    let mut path = String::new();
    for line in lines {
        for (i, (x, y)) in line.iter().enumerate() {
            let _ = write!(path, "{}{} {}", if i == 0 { 'M' } else { 'L' }, tenth(*x), tenth(*y));
        }
        if let [(x, y)] = line[..] {
            // An isolated point: a dot.
            let _ = write!(path, "L{} {}", tenth(x + 0.1), tenth(y));
        }
    }
    path
}

/// Merges intervals that are closer than a picture can show.
fn merged(stretches: &[(f64, f64)], least: f64) -> Vec<(f64, f64)> {
    let mut joined: Vec<(f64, f64)> = Vec::new();
    for &(from, to) in stretches {
        match joined.last_mut() {
            Some(last) if from - last.1 < least => last.1 = to,
            _ => joined.push((from, to)),
        }
    }
    joined
}

/// Displays a number with one decimal, without a trailing `.0`. Paths have thousands of them: no text is allocated.
fn tenth(x: f64) -> impl Display {
    std::fmt::from_fn(move |to| {
        let tenths = 10.0 * x;
        let nearest = tenths.round_ties_even();
        // The product is rounded: near a half, and for large numbers, the exact decimal decides.
        if nearest.abs() > 1e9 || (tenths - nearest).abs() > 0.499_999 || nearest == 0.0 {
            let text = format!("{x:.1}");
            return to.write_str(text.strip_suffix(".0").unwrap_or(&text));
        }
        let (whole, tenth) = (nearest.abs() as u64 / 10, nearest.abs() as u64 % 10);
        if nearest < 0.0 {
            to.write_char('-')?;
        }
        if tenth == 0 { write!(to, "{whole}") } else { write!(to, "{whole}.{tenth}") }
    })
}

fn text(out: &mut String, x: f64, y: f64, anchor: &str, style: &str, words: &str) {
    if !words.is_empty() {
        let words = escaped(words);
        let _ = writeln!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" {style}>{words}</text>");
    }
}

/// With a minus sign in place of a hyphen.
fn typographic(number: &str) -> String {
    number.replace('-', "−")
}

fn escaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            // XML does not allow control characters, not even as references.
            c if c.is_control() => out.push(' '),
            c => out.push(c),
        }
    }
    out
}

/// Approximate width of a text in px, accurate enough to lay out a legend.
fn text_width(text: &str, size: f64) -> f64 {
    let em = |c: char| match c {
        'i' | 'j' | 'l' | '.' | ',' | ':' | ';' | '|' | '\'' | 'I' | ' ' | '·' => 0.27,
        'f' | 't' | 'r' | '(' | ')' | '[' | ']' | '/' | '-' => 0.36,
        'm' | 'w' | 'M' | 'W' | '%' | '@' => 0.87,
        'A'..='Z' | '+' | '=' | '<' | '>' | '~' => 0.66,
        _ => 0.565,
    };
    text.chars().map(em).sum::<f64>() * size
}

/// The text, truncated to a width.
fn fitted(text: &str, width: f64, size: f64) -> String {
    if text_width(text, size) <= width {
        return text.into();
    }
    let mut kept = text.to_string();
    while !kept.is_empty() && text_width(&kept, size) > width - size {
        kept.pop();
    }
    kept + "…"
}

#[cfg(test)]
mod tests {
    use super::tenth;

    /// A mutant that rounds the product alone fails at the first halves.
    #[test]
    fn tenths_are_rounded_as_by_the_standard_library() {
        let mut state = 1;
        for case in 0..400_000 {
            let bits = abi::random::next(&mut state);
            let number = (bits >> 40) as i64 - (1 << 23);
            // Twentieths, whose halves are rounded, and numbers of all sizes.
            let x = match case % 2 {
                0 => 0.05 * number as f64,
                _ => format!("{number}e{}", (bits % 20) as i32 - 12).parse().unwrap(),
            };
            let expected = format!("{x:.1}");
            assert_eq!(tenth(x).to_string(), expected.strip_suffix(".0").unwrap_or(&expected), "case {case}: {x:e}");
        }
    }
}
