use super::*;

fn axis(name: &str, unit: &str) -> Axis {
    Axis { name: name.into(), unit: unit.into(), ..Axis::default() }
}

fn curve(name: &str, from: f64, to: f64, n: usize, f: impl Fn(f64) -> f64) -> Curve {
    let points = (0..=n).map(|i| from + (to - from) * i as f64 / n as f64).map(|t| (t, f(t))).collect();
    Curve { name: name.into(), points, ..Curve::default() }
}

/// A stick-slip sawtooth, its friction force, and a loop in the plane.
fn stick_slip() -> Figure {
    let x = |t: f64| (t / 6.36).floor() * 0.6 + 0.6 * ((t / 6.36).fract() * 1.6 - 0.6).max(0.0).powi(3);
    let f = |t: f64| -0.4 + 1.9 * (t / 6.36).fract() * if (t / 6.36).fract() > 0.93 { 0.6 } else { 1.0 };
    let stick = |t: f64| f64::from((t / 6.36).fract() < 0.7);
    let held = curve("fr.stick", 0.0, 40.0, 4000, stick);
    Figure {
        title: "stick_slip".into(),
        subtitle: "Pull(k = 2 N/m), 40 s, rk4 step 10 µs".into(),
        panels: vec![
            Panel {
                x: axis("t", "s"),
                y: axis("x, pulled", "m"),
                curves: vec![curve("x", 0.0, 40.0, 400_000, x), curve("pulled", 0.0, 40.0, 100, |t| 0.1 * t)],
                bands: vec![Band::of("fr.stick", &held.points)],
            },
            Panel {
                x: axis("t", "s"),
                y: axis("fr.F", "N"),
                curves: vec![curve("fr.F", 0.0, 40.0, 40_000, f)],
                bands: vec![],
            },
            Panel {
                x: axis("t", "s"),
                y: axis("fr.stick", ""),
                curves: vec![Curve { boolean: true, ..held }],
                bands: vec![],
            },
            Panel {
                x: axis("body.v", "mm/s"),
                y: axis("fr.z", "µm"),
                curves: vec![Curve {
                    name: "fr.z".into(),
                    points: (0..3000).map(|i| i as f64 * 0.01).map(|a| (1e-6 * a.cos() * a, 14e-6 * a.sin())).collect(),
                    ..Curve::default()
                }],
                bands: vec![],
            },
        ],
    }
}

#[test]
fn a_terminal_plot_has_axes_names_and_units() {
    let figure = Figure {
        panels: vec![Panel {
            x: axis("t", "s"),
            y: axis("x", "m"),
            curves: vec![curve("x", 0.0, 10.0, 1000, |t| t * t / 100.0)],
            bands: vec![Band { name: "slip".into(), stretches: vec![(5.0, 10.0)] }],
        }],
        ..Figure::default()
    };
    let shown = terminal(&figure, 60, false);
    assert!(shown.starts_with("      x [m]\n  1.0 ┤"), "{shown}");
    assert!(shown.ends_with("       0         2         4         6          8        10\n slip                            ▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄▄\n                                                      t [s]\n"), "{shown}");
    assert!(shown.lines().all(|line| line.chars().count() <= 60), "{shown}");
    assert!(!terminal(&figure, 60, false).contains('\x1b'));
    assert!(terminal(&figure, 60, true).contains('\x1b'));
}

#[test]
fn a_figure_of_a_million_points_is_a_small_file() {
    let text = svg(&stick_slip());
    assert!(text.len() < 200_000, "{} bytes", text.len());
    assert!(text.contains(">fr.F [N]<") && text.contains(">t [s]<") && text.contains(">stick_slip<"));
}

#[test]
fn odd_figures_are_drawn_without_complaint() {
    let nan = Curve { points: vec![(f64::NAN, f64::NAN), (0.0, f64::INFINITY)], ..Curve::default() };
    let huge = Curve { points: vec![(0.0, -1e308), (1.0, 1e308), (2.0, 5e-324)], ..Curve::default() };
    let one = Curve { name: "<a & \"b\">\u{1}".into(), points: vec![(1.0, 1.0)], ..Curve::default() };
    for curves in [vec![], vec![nan.clone()], vec![huge.clone()], vec![one.clone()], vec![nan, huge, one]] {
        let panel = Panel { curves, ..Panel::default() };
        let figure = Figure { title: "<&>".into(), panels: vec![panel], ..Figure::default() };
        for width in [0, 10, 80, 1000] {
            terminal(&figure, width, true);
        }
        png(&figure);
    }
    png(&Figure::default());
}

/// Writes a picture to look at: `FRIC_PICTURES=out cargo test --bin fric picture`.
#[test]
fn a_picture_has_letters_without_any_system_font() {
    let blank = png(&Figure { panels: vec![Panel::default()], ..Figure::default() });
    let full = png(&stick_slip());
    assert!(full.starts_with(b"\x89PNG") && full.len() > blank.len());
    if let Ok(folder) = std::env::var("FRIC_PICTURES") {
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(format!("{folder}/stick_slip.png"), full).unwrap();
        std::fs::write(format!("{folder}/stick_slip.svg"), svg(&stick_slip())).unwrap();
        println!("{}", terminal(&stick_slip(), 90, false));
    }
}
