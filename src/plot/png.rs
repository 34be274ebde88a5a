//! Renders a figure as PNG: its SVG, rasterised with embedded fonts, so that it looks the same on a machine without
//! fonts.

use super::{Figure, svg};
use resvg::tiny_skia::{Pixmap, Transform};
use resvg::usvg::{Options, Tree, fontdb};
use std::sync::Arc;

/// Pixels per px of the SVG: sharp on paper and on high-resolution screens.
const SCALE: f32 = 2.0;

/// The figure as the bytes of a PNG.
pub fn png(figure: &Figure) -> Vec<u8> {
    let mut fonts = fontdb::Database::new();
    fonts.load_font_data(include_bytes!("font/Roboto-Regular.ttf").to_vec());
    fonts.load_font_data(include_bytes!("font/Roboto-Medium.ttf").to_vec());
    let options = Options { fontdb: Arc::new(fonts), font_family: "Roboto".into(), ..Options::default() };
    let tree = Tree::from_str(&svg(figure), &options).expect("our own SVG is well-formed");
    let size = tree.size().to_int_size().scale_by(SCALE).expect("a figure has a size");
    let mut picture = Pixmap::new(size.width(), size.height()).expect("a figure has a size");
    resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut picture.as_mut());
    picture.encode_png().expect("a picture in memory can be encoded")
}
