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
                ..Panel::default()
            },
            Panel {
                x: axis("t", "s"),
                y: axis("fr.F", "N"),
                curves: vec![curve("fr.F", 0.0, 40.0, 40_000, f)],
                ..Panel::default()
            },
            Panel {
                x: axis("t", "s"),
                y: axis("fr.stick", ""),
                curves: vec![Curve { boolean: true, ..held }],
                ..Panel::default()
            },
            Panel {
                x: axis("body.v", "mm/s"),
                y: axis("fr.z", "µm"),
                curves: vec![Curve {
                    name: "fr.z".into(),
                    points: (0..3000).map(|i| i as f64 * 0.01).map(|a| (1e-6 * a.cos() * a, 14e-6 * a.sin())).collect(),
                    ..Curve::default()
                }],
                ..Panel::default()
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
            ..Panel::default()
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
    let text = svg::svg(&stick_slip(), &Look::default());
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
        png::png(&figure, &Look::default());
    }
    png::png(&Figure::default(), &Look::default());
}

/// Writes a picture to look at: `FRIC_PICTURES=out cargo test --lib picture`.
#[test]
fn a_picture_has_letters_without_any_system_font() {
    let blank = png::png(&Figure { panels: vec![Panel::default()], ..Figure::default() }, &Look::default());
    let full = png::png(&stick_slip(), &Look::default());
    assert!(full.starts_with(b"\x89PNG") && full.len() > blank.len());
    if let Ok(folder) = std::env::var("FRIC_PICTURES") {
        std::fs::create_dir_all(&folder).unwrap();
        std::fs::write(format!("{folder}/stick_slip.png"), full).unwrap();
        std::fs::write(format!("{folder}/stick_slip.svg"), svg::svg(&stick_slip(), &Look::default())).unwrap();
        println!("{}", terminal(&stick_slip(), 90, false));
    }
}

/// Curves of random sizes with random options: every renderer draws them, and every word that fits is there.
#[test]
fn random_figures_are_drawn_with_all_their_words() {
    let seed = std::env::var("FRIC_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(29);
    let mut random = compiler::ir::random::Random(seed);
    for case in 0..40 {
        let said = format!("seed {seed}, case {case}");
        let number = |random: &mut compiler::ir::random::Random| match random.below(6) {
            0 => [0.0, f64::NAN, f64::INFINITY, 1e300, -1e-300, 1e-12][random.below(6)],
            1 => random.within(0.0, 1.0),
            _ => random.within(-1.0, 1.0) * [1e-6, 1.0, 1e4][random.below(3)],
        };
        let axis = |word: &str, random: &mut compiler::ir::random::Random| Axis {
            name: format!("{word}{case}"),
            unit: ["", "N", "mm/s"][random.below(3)].into(),
            logarithmic: random.below(3) == 0,
            range: (random.below(3) == 0).then(|| {
                let from = random.within(-1.0, 1.0);
                (from, from + random.within(1e-6, 10.0))
            }),
        };
        let panel = |n: usize, random: &mut compiler::ir::random::Random| {
            let curves = (0..random.below(5)).map(|k| Curve {
                name: format!("c{n}-{k}<&"),
                points: (0..random.below(300))
                    .map(|i| (i as f64 * 0.01 + random.within(0.0, 0.02), number(random)))
                    .collect(),
                boolean: random.below(6) == 0,
                marks: random.below(5) == 0,
                recorded: random.below(4) == 0,
                style: None,
            });
            let curves: Vec<Curve> = curves.collect();
            Panel { title: format!("p{n}"), x: axis("x", random), y: axis("y", random), curves, ..Panel::default() }
        };
        let panels: Vec<Panel> = (0..1 + random.below(4)).map(|n| panel(n, &mut random)).collect();
        let sized = random.below(2) == 0;
        let look = Look {
            size: sized.then(|| (random.within(320.0, 700.0), random.within(500.0, 1500.0))),
            font: random.within(8.0, 14.0),
            lines: [Lines::Colour, Lines::Dashes, Lines::Grey][random.below(3)],
            columns: 1 + random.below(2),
        };
        let figure = Figure { title: "title".into(), subtitle: String::new(), panels };
        let text = svg::svg(&figure, &look);
        assert!(!text.contains("NaN") && !text.contains("inf"), "{said}: {text}");
        let shows = |word: &str| text.contains(&format!(">{}<", word.replace('&', "&amp;").replace('<', "&lt;")));
        for panel in &figure.panels {
            assert!(shows(&panel.title) && shows(&panel.x.title()), "{said}: {}", panel.title);
            // The title of y gives way to its unit where several curves leave no room for it.
            assert!(shows(&panel.y.title()) || shows(&format!("[{}]", panel.y.unit)), "{said}: {}", panel.y.title());
            let names = panel.curves.iter().filter(|_| panel.curves.len() > 1);
            names.for_each(|curve| assert!(shows(&curve.name), "{said}: {}", curve.name));
        }
        terminal(&figure, 80, false);
        if case % 6 == 0 {
            assert!(picture(&figure, &look, Kind::Png).starts_with(b"\x89PNG"), "{said}");
        }
        let pdf = picture(&figure, &look, Kind::Pdf);
        assert!(pdf.starts_with(b"%PDF-") && pdf.trim_ascii_end().ends_with(b"%%EOF"), "{said}");
    }
    println!("seed {seed}");
}

#[test]
fn curves_that_agree_do_not_hide_each_other() {
    let panel = |shift: f64| Panel {
        x: axis("t", "s"),
        y: axis("x", "m"),
        curves: vec![curve("a", 0.0, 1.0, 500, f64::sin), curve("b", 0.0, 1.0, 300, |t| t.sin() + shift)],
        ..Panel::default()
    };
    let dashes = |shift: f64| {
        let figure = Figure { panels: vec![panel(shift)], ..Figure::default() };
        svg::svg(&figure, &Look::default()).matches("stroke-dasharray").count()
    };
    // In the axes and in the legend.
    assert_eq!(dashes(0.0), 2);
    assert_eq!(dashes(1e-4), 2);
    assert_eq!(dashes(0.1), 0);
}

#[test]
fn a_figure_for_print_has_its_size() {
    let figure = Figure {
        panels: vec![Panel { curves: vec![curve("a", 0.0, 1.0, 50, f64::sin)], ..Panel::default() }],
        ..Figure::default()
    };
    let look = Look { size: Some((96.0 * 85.0 / 25.4, 96.0 * 60.0 / 25.4)), font: 8.0 / 0.75, ..Look::default() };
    assert!(svg::svg(&figure, &look).contains("width=\"85.00mm\" height=\"60.00mm\""));
    let pdf = picture(&figure, &look, Kind::Pdf);
    let text = String::from_utf8_lossy(&pdf);
    // 85 mm and 60 mm in points.
    assert!(text.contains("/MediaBox [0 0 240.9") && text.contains(" 170.0"), "{}", &text[..800]);
    assert!(text.contains("/FontFile2") && text.contains("/ToUnicode"));
    // A curve that leaves a given range is cut off, and far away parts of it leave no points.
    let zoomed = Panel {
        x: Axis { range: Some((0.5, 0.5001)), ..axis("t", "s") },
        curves: vec![curve("a", 0.0, 1.0, 1_000_000, |t| (1e5 * t).sin())],
        ..Panel::default()
    };
    let figure = Figure { panels: vec![zoomed], ..Figure::default() };
    assert!(svg::svg(&figure, &Look::default()).len() < 12_000);
}
