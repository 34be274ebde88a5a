//! Renders a figure as PNG: its SVG, rasterised with embedded fonts, so that it looks the same on a machine without
//! fonts.

use super::{Figure, Look, svg};
use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};
use std::sync::Arc;

/// Pixels per px of the SVG: sharp on high-resolution screens.
const SCALE: f32 = 2.0;
/// The same for a figure of a given size: 600 pixels per inch, as journals ask of line art.
const PRINT_SCALE: f32 = 600.0 / 96.0;
/// Largest side of a picture in pixels.
const LONGEST: f32 = 16_000.0;

/// The figure as a tree of shapes and texts, with the fonts that travel with the program.
pub(super) fn tree(figure: &Figure, look: &Look) -> Tree {
    let mut fonts = fontdb::Database::new();
    fonts.load_font_data(include_bytes!("font/Roboto-Regular.ttf").to_vec());
    fonts.load_font_data(include_bytes!("font/Roboto-Medium.ttf").to_vec());
    let options = Options { fontdb: Arc::new(fonts), font_family: "Roboto".into(), ..Options::default() };
    Tree::from_str(&svg::svg(figure, look), &options).expect("our own SVG is well-formed")
}

/// The figure as the bytes of a PNG.
pub fn png(figure: &Figure, look: &Look) -> Vec<u8> {
    let tree = tree(figure, look);
    let scale = if look.size.is_some() { PRINT_SCALE } else { SCALE };
    let scale = scale.min(LONGEST / tree.size().width().max(tree.size().height()));
    let size = tree.size().to_int_size().scale_by(scale).expect("a figure has a size");
    let mut picture = Pixmap::new(size.width(), size.height()).expect("a figure has a size");
    resvg::render(&tree, Transform::from_scale(scale, scale), &mut picture.as_mut());
    picture.encode_png().expect("a picture in memory can be encoded")
}
