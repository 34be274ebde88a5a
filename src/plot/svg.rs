//! Renders a figure as a self-contained SVG: no script, no external request, readable in any viewer and in print.

use super::scale::{Scale, padded};
use super::{Curve, Figure, PALETTE, Panel, SHADES, decimate};
use std::fmt::Write;

/// Width of a figure in px.
const WIDTH: f64 = 860.0;
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
/// Font size.
const TEXT: f64 = 13.0;

const INK: &str = "#1f2328";
const FAINT: &str = "#59636e";
const GRID: &str = "#e4e7eb";
const DASHES: [&str; 3] = ["", "7 4", "2 3"];

/// The figure as SVG text.
pub fn svg(figure: &Figure) -> String {
    inline(figure, WIDTH, "axes")
}

/// The figure as SVG text, `wide` px wide, for a page with several figures: `id` makes its identifiers unique.
pub fn inline(figure: &Figure, wide: f64, id: &str) -> String {
    let mut body = String::new();
    let mut y = 18.0;
    if !figure.title.is_empty() {
        y += 16.0;
        text(
            &mut body,
            LEFT,
            y,
            "start",
            &format!("font-size=\"18\" font-weight=\"500\" fill=\"{INK}\""),
            &figure.title,
        );
        y += 8.0;
    }
    if !figure.subtitle.is_empty() {
        y += 12.0;
        let shown = fitted(&figure.subtitle, wide - LEFT - RIGHT, 12.5);
        text(&mut body, LEFT, y, "start", &format!("font-size=\"12.5\" fill=\"{FAINT}\""), &shown);
        y += 8.0;
    }
    y += 8.0;
    for (number, panel) in figure.panels.iter().enumerate() {
        let id = format!("{id}{number}");
        let tall = (height(panel, figure.panels.len()) * (wide / WIDTH).sqrt()).round();
        y = draw_panel(&mut body, &panel.placed(), &id, y, (wide, tall)) + GAP;
    }
    let title = escaped(&figure.title);
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{wide}\" height=\"{y:.0}\" viewBox=\"0 0 {wide} {y:.0}\" \
         role=\"img\" font-family=\"Roboto, 'Helvetica Neue', Arial, sans-serif\" font-size=\"{TEXT}\">\n\
         <title>{title}</title>\n<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n{body}</svg>\n"
    )
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

/// Draws a panel whose top is at `top`; returns its bottom. The size is the width of the figure and the height of the
/// axes.
fn draw_panel(out: &mut String, panel: &Panel, id: &str, top: f64, (wide, height): (f64, f64)) -> f64 {
    let top = legend(out, panel, top, wide) + 8.0;
    let (width, bottom) = (wide - LEFT - RIGHT, top + height);
    let bounds = panel.bounds();
    let (xs, ys) = bounds.unwrap_or(((0.0, 1.0), (0.0, 1.0)));
    let running = panel.curves.iter().all(|curve| curve.points.windows(2).all(|pair| pair[0].0 <= pair[1].0));
    // Time fills the width; a loop in the plane keeps a distance from the frame.
    let marked = panel.curves.iter().any(|curve| curve.marks);
    let xs = if running && !marked { xs } else { padded(xs, 0.04) };
    let x_axis = panel.x.scale(xs.0, xs.1, (width / 90.0) as usize);
    let y_axis = if is_boolean(panel) {
        let mut axis = Scale::new(-0.15, 1.15, 2);
        axis.ticks.retain(|tick| tick.at == 0.0 || tick.at == 1.0);
        axis
    } else {
        let (low, high) = padded(ys, 0.06);
        panel.y.scale(low, high, (height / 38.0) as usize)
    };
    let px = |value: f64| LEFT + width * x_axis.position(value);
    let py = |value: f64| bottom - height * y_axis.position(value);

    let _ = writeln!(
        out,
        "<clipPath id=\"{id}\"><rect x=\"{LEFT}\" y=\"{top:.1}\" width=\"{width}\" height=\"{height}\"/></clipPath>"
    );
    for (band, shade) in panel.bands.iter().zip(SHADES.iter().cycle()) {
        for &(from, to) in &merged(&band.stretches, (xs.1 - xs.0) / width) {
            let (from, to) = (px(from).max(LEFT), px(to).min(LEFT + width));
            let breadth = (to - from).max(0.5);
            let _ = writeln!(
                out,
                "<rect x=\"{from:.1}\" y=\"{top:.1}\" width=\"{breadth:.1}\" height=\"{height}\" fill=\"{shade}\"/>"
            );
        }
    }

    let mut grid = String::new();
    for tick in &x_axis.ticks {
        let x = px(tick.at);
        let _ = write!(grid, "M{x:.1} {top:.1}V{bottom:.1}");
        text(out, x, bottom + 19.0, "middle", &format!("fill=\"{INK}\""), &typographic(&tick.label));
    }
    for tick in &y_axis.ticks {
        let y = py(tick.at);
        let _ = write!(grid, "M{LEFT} {y:.1}H{:.1}", LEFT + width);
        let label = match (is_boolean(panel), tick.at == 0.0) {
            (true, true) => "false".into(),
            (true, false) => "true".into(),
            (false, _) => typographic(&tick.label),
        };
        text(out, LEFT - 9.0, y + 4.5, "end", &format!("fill=\"{INK}\""), &label);
    }
    let _ = writeln!(out, "<path d=\"{grid}\" stroke=\"{GRID}\" fill=\"none\"/>");
    if y_axis.from < 0.0 && y_axis.to > 0.0 && !is_boolean(panel) && !panel.y.logarithmic {
        let y = py(0.0);
        let _ = writeln!(out, "<path d=\"M{LEFT} {y:.1}H{:.1}\" stroke=\"#a8b0b9\" fill=\"none\"/>", LEFT + width);
    }

    let _ = writeln!(
        out,
        "<g clip-path=\"url(#{id})\" fill=\"none\" stroke-width=\"1.7\" stroke-linejoin=\"round\" \
         stroke-linecap=\"round\">"
    );
    for (i, curve) in panel.curves.iter().enumerate() {
        for &(x, y) in curve.points.iter().filter(|(x, y)| curve.marks && x.is_finite() && y.is_finite()) {
            let colour = PALETTE[style(panel, i).0 % PALETTE.len()];
            let _ =
                writeln!(out, "<circle cx=\"{}\" cy=\"{}\" r=\"3\" fill=\"{colour}\"/>", tenth(px(x)), tenth(py(y)));
        }
        let path = path(curve, px, py, width, height);
        if !path.is_empty() {
            let _ = writeln!(out, "<path d=\"{path}\" {}/>", stroke(panel, i));
        }
    }
    out.push_str("</g>\n");

    let _ = writeln!(
        out,
        "<path d=\"M{LEFT} {top:.1}V{bottom:.1}H{:.1}\" stroke=\"{INK}\" stroke-width=\"1.1\" fill=\"none\"/>",
        LEFT + width
    );
    if bounds.is_none() {
        let words = "nothing finite to draw";
        text(out, LEFT + width / 2.0, top + height / 2.0, "middle", &format!("fill=\"{FAINT}\""), words);
    }
    if !x_axis.note.is_empty() {
        let note = typographic(&x_axis.note);
        text(out, LEFT + width, bottom + 40.0, "end", &format!("font-size=\"12\" fill=\"{FAINT}\""), &note);
    }
    if !y_axis.note.is_empty() {
        let note = typographic(&y_axis.note);
        text(out, LEFT - 9.0, top - 8.0, "start", &format!("font-size=\"12\" fill=\"{FAINT}\""), &note);
    }
    let title = fitted(&panel.x.title(), width, TEXT);
    text(out, LEFT + width / 2.0, bottom + 40.0, "middle", &format!("fill=\"{INK}\""), &title);
    let title = if text_width(&panel.y.title(), TEXT) <= height + 30.0 {
        panel.y.title()
    } else if panel.curves.len() > 1 && !panel.y.unit.is_empty() {
        format!("[{}]", panel.y.unit)
    } else {
        fitted(&panel.y.title(), height + 30.0, TEXT)
    };
    let middle = top + height / 2.0;
    let turned = format!("fill=\"{INK}\" transform=\"rotate(-90 22 {middle:.1})\"");
    text(out, 22.0, middle, "middle", &turned, &title);
    bottom + BELOW
}

/// Names of curves and bands, if there are several; returns the bottom.
fn legend(out: &mut String, panel: &Panel, top: f64, wide: f64) -> f64 {
    if panel.curves.len() + panel.bands.len() < 2 {
        return top + 4.0;
    }
    let curves = panel.curves.iter().enumerate().map(|(i, curve)| (&curve.name, Some(i)));
    let bands = panel.bands.iter().map(|band| (&band.name, None));
    let (mut x, mut y) = (LEFT, top + 14.0);
    let mut shade = SHADES.iter().cycle();
    for (name, curve) in curves.chain(bands) {
        let name = fitted(name, wide - LEFT - RIGHT - 40.0, TEXT);
        let taken = 30.0 + text_width(&name, TEXT);
        if x > LEFT && x + taken > wide - RIGHT {
            x = LEFT;
            y += ROW;
        }
        let middle = y - 4.5;
        let _ = match curve {
            Some(i) => {
                writeln!(
                    out,
                    "<path d=\"M{x:.1} {middle:.1}h22\" fill=\"none\" stroke-width=\"2.4\" {}/>",
                    stroke(panel, i)
                )
            }
            None => writeln!(
                out,
                "<rect x=\"{x:.1}\" y=\"{:.1}\" width=\"22\" height=\"13\" fill=\"{}\" stroke=\"#c3cad2\" \
                 stroke-width=\"0.7\"/>",
                y - 11.0,
                shade.next().unwrap_or(&GRID)
            ),
        };
        text(out, x + 28.0, y, "start", &format!("fill=\"{INK}\""), &name);
        x += taken + 18.0;
    }
    y + 4.0
}

/// Numbers of colour and dash pattern of the `i`-th curve: colours repeat with other dash patterns.
fn style(panel: &Panel, i: usize) -> (usize, usize) {
    let (colour, dashes) = panel.curves[i].style.unwrap_or((i, 0));
    (colour, dashes + colour / PALETTE.len())
}

/// Colour and dash pattern of the `i`-th curve.
fn stroke(panel: &Panel, i: usize) -> String {
    let (colour, dashes) = style(panel, i);
    let colour = PALETTE[colour % PALETTE.len()];
    match DASHES[dashes % DASHES.len()] {
        "" => format!("stroke=\"{colour}\""),
        dashes => format!("stroke=\"{colour}\" stroke-dasharray=\"{dashes}\""),
    }
}

/// A curve as the data of an SVG path.
fn path(curve: &Curve, px: impl Fn(f64) -> f64, py: impl Fn(f64) -> f64, width: f64, height: f64) -> String {
    let place =
        |&(x, y): &(f64, f64)| if x.is_finite() && y.is_finite() { (px(x), py(y)) } else { (f64::NAN, f64::NAN) };
    let pixels: Vec<(f64, f64)> = curve.corners().iter().map(place).collect();
    let mut path = String::new();
    for line in decimate::lines(&pixels, width, height) {
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

/// One decimal, without a trailing `.0`.
fn tenth(x: f64) -> String {
    let text = format!("{x:.1}");
    text.strip_suffix(".0").map_or(text.clone(), str::to_string)
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
