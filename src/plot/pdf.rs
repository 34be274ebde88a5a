//! Renders a figure as PDF: lines as lines and text as text, with the letters that it uses embedded, as journals ask.
//!
//! In: the tree of shapes and texts of the SVG. Out: a document of one page of the figure's size. Only what our own SVG
//! contains is drawn: filled and stroked paths, rectangular clips, texts. Source: ISO 32000-1.

use super::png::tree;
use super::{Figure, Look};
use pdf_writer::types::{CidFontType, FontFlags, LineCapStyle, LineJoinStyle, SystemInfo, UnicodeCmap};
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str, TextStr};
use resvg::tiny_skia::{Path, PathSegment, Transform};
use resvg::usvg::{self, Color, Group, Node, Paint, Tree, fontdb};
use std::collections::BTreeMap;
use subsetter::GlyphRemapper;

/// Points of a PDF per px.
const POINTS: f32 = 0.75;
const ROMAN: SystemInfo = SystemInfo { registry: Str(b"Adobe"), ordering: Str(b"Identity"), supplement: 0 };

/// The figure as the bytes of a PDF.
pub fn pdf(figure: &Figure, look: &Look) -> Vec<u8> {
    let tree = tree(figure, look);
    let (width, height) = (tree.size().width() * POINTS, tree.size().height() * POINTS);
    let mut page = Page { content: Content::new(), tree: &tree, fonts: Vec::new() };
    // Coordinates of the SVG: in px, downwards from the top.
    page.content.transform([POINTS, 0.0, 0.0, -POINTS, 0.0, height]);
    page.group(tree.root());
    let Page { content, fonts, .. } = page;

    let mut next = (1..).map(Ref::new);
    let mut id = move || next.next().expect("references do not end");
    let (catalog, pages, sheet, contents, information) = (id(), id(), id(), id(), id());
    let mut pdf = Pdf::new();
    pdf.catalog(catalog).pages(pages);
    pdf.pages(pages).kids([sheet]).count(1);
    pdf.document_info(information).title(TextStr(&figure.title)).creator(TextStr("fric"));
    let ids: Vec<Ref> = fonts.iter().map(|_| id()).collect();
    let mut written = pdf.page(sheet);
    written.media_box(Rect::new(0.0, 0.0, width, height)).parent(pages).contents(contents);
    let mut resources = written.resources();
    let mut named = resources.fonts();
    for (k, id) in ids.iter().enumerate() {
        named.pair(Name(format!("F{k}").as_bytes()), *id);
    }
    named.finish();
    resources.finish();
    written.finish();
    pdf.stream(contents, &content.finish());
    for (font, own) in fonts.iter().zip(ids) {
        font.write(&mut pdf, own, &mut id);
    }
    pdf.finish()
}

/// A font, and the letters of it that are used.
struct Font {
    id: fontdb::ID,
    name: String,
    data: Vec<u8>,
    /// Font units per em, and the widths of all glyphs in font units.
    em: f32,
    widths: Vec<u16>,
    ascent: f32,
    descent: f32,
    glyphs: GlyphRemapper,
    /// For each glyph of the subset, the characters that it stands for.
    texts: BTreeMap<u16, String>,
}

impl Font {
    /// Reads what a descriptor needs from the tables `head`, `hhea` and `hmtx`.
    fn read(id: fontdb::ID, name: &str, data: Vec<u8>) -> Option<Font> {
        let half = |at: usize| Some(u16::from_be_bytes(data.get(at..at + 2)?.try_into().ok()?));
        let table = |tag: &[u8; 4]| {
            (0..usize::from(half(4)?)).find_map(|k| {
                let record = data.get(12 + 16 * k..28 + 16 * k)?;
                (record[..4] == *tag)
                    .then(|| u32::from_be_bytes(record[8..12].try_into().expect("four bytes")) as usize)
            })
        };
        let (head, hhea, hmtx, maxp) = (table(b"head")?, table(b"hhea")?, table(b"hmtx")?, table(b"maxp")?);
        let em = f32::from(half(head + 18)?);
        let (ascent, descent) = (f32::from(half(hhea + 4)? as i16), f32::from(half(hhea + 6)? as i16));
        let (metrics, glyphs) = (half(hhea + 34)?.max(1), half(maxp + 4)?);
        // Glyphs beyond the last metric have its width.
        let width = |k: u16| half(hmtx + 4 * usize::from(k.min(metrics - 1)));
        let widths = (0..glyphs).map(width).collect::<Option<_>>()?;
        let (glyphs, texts) = (GlyphRemapper::new(), BTreeMap::new());
        // Six letters mark a subset.
        let name = format!("FRICAA+{}", name.replace(' ', ""));
        Some(Font { id, name, em, widths, ascent, descent, glyphs, texts, data })
    }

    /// Writes the font as `own`, with further objects: composite font, its one descendant, descriptor, file, letters.
    fn write(&self, pdf: &mut Pdf, own: Ref, id: &mut impl FnMut() -> Ref) {
        let (descendant, descriptor, file, letters) = (id(), id(), id(), id());
        let name = Name(self.name.as_bytes());
        let subset = subsetter::subset(&self.data, 0, &self.glyphs).expect("our own fonts can be cut down");
        let thousandths = |x: f32| 1000.0 * x / self.em;
        pdf.type0_font(own)
            .base_font(name)
            .encoding_predefined(Name(b"Identity-H"))
            .descendant_font(descendant)
            .to_unicode(letters);
        let mut cid = pdf.cid_font(descendant);
        cid.subtype(CidFontType::Type2).base_font(name).system_info(ROMAN).font_descriptor(descriptor);
        cid.cid_to_gid_map_predefined(Name(b"Identity")).default_width(0.0);
        let used = self.glyphs.remapped_gids();
        let width = |glyph: u16| self.widths.get(usize::from(glyph)).copied().unwrap_or(0);
        cid.widths().consecutive(0, used.map(|glyph| thousandths(f32::from(width(glyph)))));
        cid.finish();
        let bounds = Rect::new(-500.0, thousandths(self.descent), 2000.0, thousandths(self.ascent));
        pdf.font_descriptor(descriptor)
            .name(name)
            .flags(FontFlags::SYMBOLIC)
            .bbox(bounds)
            .italic_angle(0.0)
            .ascent(thousandths(self.ascent))
            .descent(thousandths(self.descent))
            .cap_height(thousandths(self.ascent))
            .stem_v(80.0)
            .font_file2(file);
        pdf.stream(file, &subset).pair(Name(b"Length1"), subset.len() as i32);
        let mut map = UnicodeCmap::new(Name(b"Letters"), ROMAN);
        for (glyph, text) in &self.texts {
            map.pair_with_multiple(*glyph, text.chars());
        }
        pdf.cmap(letters, &map.finish());
    }
}

/// A page in the making.
struct Page<'t> {
    content: Content,
    tree: &'t Tree,
    fonts: Vec<Font>,
}

impl Page<'_> {
    fn group(&mut self, group: &Group) {
        let clipped = group.clip_path();
        if let Some(clip) = clipped {
            self.content.save_state();
            for node in clip.root().children() {
                if let Node::Path(path) = node {
                    self.outline(path.data(), path.abs_transform());
                }
            }
            self.content.clip_nonzero().end_path();
        }
        for node in group.children() {
            match node {
                Node::Group(group) => self.group(group),
                Node::Path(path) => self.path(path),
                Node::Text(text) => self.text(text),
                Node::Image(_) => {}
            }
        }
        if clipped.is_some() {
            self.content.restore_state();
        }
    }

    fn outline(&mut self, path: &Path, transform: Transform) {
        let Some(path) = path.clone().transform(transform) else { return };
        let mut last = (0.0, 0.0);
        for segment in path.segments() {
            match segment {
                PathSegment::MoveTo(p) => {
                    self.content.move_to(p.x, p.y);
                    last = (p.x, p.y);
                }
                PathSegment::LineTo(p) => {
                    self.content.line_to(p.x, p.y);
                    last = (p.x, p.y);
                }
                PathSegment::QuadTo(c, p) => {
                    // A parabola as a cubic.
                    let toward = |a: f32, b: f32| a + 2.0 / 3.0 * (b - a);
                    let [x1, y1] = [toward(last.0, c.x), toward(last.1, c.y)];
                    self.content.cubic_to(x1, y1, toward(p.x, c.x), toward(p.y, c.y), p.x, p.y);
                    last = (p.x, p.y);
                }
                PathSegment::CubicTo(a, b, p) => {
                    self.content.cubic_to(a.x, a.y, b.x, b.y, p.x, p.y);
                    last = (p.x, p.y);
                }
                PathSegment::Close => {
                    self.content.close_path();
                }
            }
        }
    }

    fn path(&mut self, path: &usvg::Path) {
        if let Some(fill) = path.fill() {
            let [r, g, b] = rgb(fill.paint());
            self.content.set_fill_rgb(r, g, b);
            self.outline(path.data(), path.abs_transform());
            self.content.fill_nonzero();
        }
        if let Some(stroke) = path.stroke() {
            let [r, g, b] = rgb(stroke.paint());
            let cap = match stroke.linecap() {
                usvg::LineCap::Butt => LineCapStyle::ButtCap,
                usvg::LineCap::Round => LineCapStyle::RoundCap,
                usvg::LineCap::Square => LineCapStyle::ProjectingSquareCap,
            };
            let join = match stroke.linejoin() {
                usvg::LineJoin::Round => LineJoinStyle::RoundJoin,
                usvg::LineJoin::Bevel => LineJoinStyle::BevelJoin,
                usvg::LineJoin::Miter | usvg::LineJoin::MiterClip => LineJoinStyle::MiterJoin,
            };
            let dashes = stroke.dasharray().map(<[f32]>::to_vec).unwrap_or_default();
            self.content
                .set_stroke_rgb(r, g, b)
                .set_line_width(stroke.width().get())
                .set_line_cap(cap)
                .set_line_join(join)
                .set_dash_pattern(dashes, stroke.dashoffset());
            self.outline(path.data(), path.abs_transform());
            self.content.stroke();
        }
    }

    fn text(&mut self, text: &usvg::Text) {
        for span in text.layouted() {
            let Some(fill) = &span.fill else { continue };
            let [r, g, b] = rgb(fill.paint());
            self.content.set_fill_rgb(r, g, b).begin_text();
            for glyph in &span.positioned_glyphs {
                let Some(k) = self.font(glyph.font) else { continue };
                let font = &mut self.fonts[k];
                let own = font.glyphs.remap(glyph.id.0 as u16);
                font.texts.entry(own).or_insert_with(|| glyph.text.clone());
                // Glyphs are in font units, upright; the size of the font is 1 em.
                let place = text.abs_transform().pre_concat(glyph.outline_transform()).pre_scale(font.em, font.em);
                self.content
                    .set_font(Name(format!("F{k}").as_bytes()), 1.0)
                    .set_text_matrix([place.sx, place.ky, place.kx, place.sy, place.tx, place.ty])
                    .show(Str(&own.to_be_bytes()));
            }
            self.content.end_text();
        }
    }

    /// The number of a font among those used.
    fn font(&mut self, id: fontdb::ID) -> Option<usize> {
        if let Some(known) = self.fonts.iter().position(|font| font.id == id) {
            return Some(known);
        }
        let fonts = self.tree.fontdb();
        let name = &fonts.face(id)?.post_script_name;
        let data = fonts.with_face_data(id, |data, _| data.to_vec())?;
        self.fonts.push(Font::read(id, name, data)?);
        Some(self.fonts.len() - 1)
    }
}

/// Red, green and blue. Our own SVG has plain colours only.
fn rgb(paint: &Paint) -> [f32; 3] {
    let Color { red, green, blue } = match paint {
        Paint::Color(colour) => *colour,
        Paint::LinearGradient(_) | Paint::RadialGradient(_) | Paint::Pattern(_) => Color::black(),
    };
    [red, green, blue].map(|part| f32::from(part) / 255.0)
}
