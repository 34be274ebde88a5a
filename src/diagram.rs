//! Block diagrams of a model's parts and connections, as text and as SVG.
//!
//! In: the syntax tree of a model. Out: a box for each part with its ports, and wires from outputs to inputs. Knows no
//! files.

use crate::equations::expression;
use grammar::ast::{self, BindValue, DeclarationKind, Expr, Model, Statement, Target};

/// A part, or the environment of the model.
struct DiagramBlock {
    name: String,
    /// `LuGre`, `Friction = LuGre`; empty for the environment.
    kind: String,
    /// Name of each input and the expression it is connected to, as written.
    inputs: Vec<(String, String)>,
    /// Outputs that are read.
    outputs: Vec<String>,
}

/// A connection from the output of a block to the input of another: block and port numbers.
struct Wire {
    from: (usize, usize),
    to: (usize, usize),
}

struct Diagram {
    blocks: Vec<DiagramBlock>,
    wires: Vec<Wire>,
}

/// Paths in an expression, as text.
fn paths(expr: &Expr) -> Vec<String> {
    let text = |path: &ast::Path| {
        let names: Vec<&str> = path.segments.iter().map(|segment| segment.name.text.as_str()).collect();
        names.join(".")
    };
    expr.paths().into_iter().map(text).collect()
}

/// What a statement defines: its name, its value, and whether it is an output.
fn computed(statement: &Statement) -> Option<(String, &Expr, bool)> {
    match statement {
        Statement::Declaration(d) if matches!(d.kind, DeclarationKind::Output | DeclarationKind::Let) => {
            Some((d.name.text.clone(), d.value.as_ref()?, d.kind == DeclarationKind::Output))
        }
        Statement::Equation(equation) => {
            let name = match &equation.target {
                Target::Name(name) => name.text.clone(),
                Target::Derivative { of, along, .. } => format!("d{}/d{}", of.text, along.text),
                Target::Next { name, .. } => format!("next({})", name.text),
            };
            Some((name, &equation.value, false))
        }
        _ => None,
    }
}

fn diagram(model: &Model) -> Diagram {
    let mut blocks = Vec::new();
    let mut reads: Vec<(usize, usize, Vec<String>)> = Vec::new();
    let own_inputs = model.body.iter().filter_map(|statement| match statement {
        Statement::Declaration(d) if d.kind == DeclarationKind::Input => Some(d.name.text.clone()),
        _ => None,
    });
    let outside =
        DiagramBlock { name: String::new(), kind: String::new(), inputs: Vec::new(), outputs: own_inputs.collect() };
    blocks.push(outside);
    for statement in &model.body {
        let Statement::Part(part) = statement else { continue };
        let rotary = if part.instance.rotary { "rotary " } else { "" };
        let is = format!("{rotary}{}", part.instance.model.text);
        let kind = part.slot.as_ref().map_or(is.clone(), |slot| format!("{} = {is}", slot.interface.text));
        let mut block = DiagramBlock { name: part.name.text.clone(), kind, inputs: Vec::new(), outputs: Vec::new() };
        for bind in &part.instance.args {
            let BindValue::Expr(value) = &bind.value else { continue };
            let found = paths(value);
            if found.is_empty() {
                continue; // A number is a parameter.
            }
            reads.push((blocks.len(), block.inputs.len(), found));
            block.inputs.push((bind.name.text.clone(), expression(value)));
        }
        blocks.push(block);
    }
    // The model's own outputs.
    let end = blocks.len();
    let mut leaving =
        DiagramBlock { name: String::new(), kind: String::new(), inputs: Vec::new(), outputs: Vec::new() };
    for (name, value, output) in model.body.iter().filter_map(computed) {
        let found = paths(value);
        let of_a_part = |path: &String| {
            let head = path.split_once('.').map(|(head, _)| head);
            head.is_some_and(|head| blocks.iter().any(|block| block.name == head))
        };
        if output || found.iter().any(of_a_part) {
            reads.push((end, leaving.inputs.len(), found));
            leaving.inputs.push((name, expression(value)));
        }
    }
    blocks.push(leaving);
    let mut wires = Vec::new();
    for (to, input, found) in reads {
        for path in found {
            let (head, port) = path.split_once('.').unwrap_or(("", &path));
            let from = match head {
                "" => blocks[0].outputs.iter().position(|name| name == port).map(|port| (0, port)),
                head => blocks.iter().position(|block| block.name == head && !head.is_empty()).map(|block| {
                    let outputs = &mut blocks[block].outputs;
                    let known = outputs.iter().position(|name| name == port);
                    let port = known.unwrap_or_else(|| {
                        outputs.push(port.to_string());
                        outputs.len() - 1
                    });
                    (block, port)
                }),
            };
            wires.extend(from.map(|from| Wire { from, to: (to, input) }));
        }
    }
    Diagram { blocks, wires }
}

/// Text boxes, one below the other; each output lists the inputs that read it.
pub fn text(model: &Model) -> String {
    let Diagram { blocks, wires } = diagram(model);
    let readers = |block: usize, port: usize| -> String {
        let to = wires.iter().filter(|wire| wire.from == (block, port)).map(|wire| {
            let (block, input) = (&blocks[wire.to.0], &blocks[wire.to.0].inputs[wire.to.1].0);
            if block.name.is_empty() { input.clone() } else { format!("{}.{input}", block.name) }
        });
        to.collect::<Vec<_>>().join(", ")
    };
    let mut out = format!("{}\n", model.name.text);
    if blocks.len() == 2 {
        out += "  has no parts\n";
        return out;
    }
    for (k, port) in blocks[0].outputs.iter().enumerate() {
        out += &format!("  {port} ─▸ {}\n", readers(0, k));
    }
    for (k, block) in blocks.iter().enumerate().filter(|(_, block)| !block.name.is_empty()) {
        let head = format!("{} : {}", block.name, block.kind);
        let inputs = block.inputs.iter().map(|(name, value)| format!("▸ {name} = {value}"));
        let (inputs, outputs): (Vec<String>, &[String]) = (inputs.collect(), &block.outputs);
        let wide = |lines: &[String]| lines.iter().map(|line| line.chars().count()).max().unwrap_or(0);
        let width = (wide(&inputs) + 3 + wide(outputs)).max(head.chars().count() + 2);
        out += &format!("  ┌ {head} {}┐\n", "─".repeat(width - head.chars().count()));
        for row in 0..inputs.len().max(outputs.len()) {
            // Ports are on the border of the box.
            let left = inputs.get(row).map_or("│", String::as_str);
            let right = outputs.get(row).map_or("│".into(), |name| format!("{name} ├─▸ {}", readers(k, row)));
            let inner = outputs.get(row).map_or(0, |name| name.chars().count() + 1);
            let gap = width + 3 - left.chars().count() - inner;
            out += &format!("  {left}{}{right}\n", " ".repeat(gap));
        }
        out += &format!("  └{}┘\n", "─".repeat(width + 2));
    }
    for (name, value) in &blocks[blocks.len() - 1].inputs {
        out += &format!("  {name} = {value}\n");
    }
    out
}

/// Width of a letter, height of a row of ports, and space between boxes.
const LETTER: f64 = 7.4;
const ROW: f64 = 22.0;
const GAP: f64 = 70.0;

/// Boxes from left to right; feedback wires run below them. An input that no part drives shows its expression.
pub fn svg(model: &Model) -> String {
    let Diagram { blocks, wires } = diagram(model);
    let letters = |text: &str| text.chars().count() as f64 * LETTER;
    let is_wired = |block: usize, row: usize| wires.iter().any(|wire| wire.to == (block, row));
    let before = |k: usize, block: &DiagramBlock| -> Vec<(usize, String)> {
        let loose = block.inputs.iter().enumerate().filter(|(row, _)| !block.name.is_empty() && !is_wired(k, *row));
        loose.map(|(row, (_, value))| (row, value.clone())).collect()
    };
    // A box has ports; an output of the model is an equation.
    let shown = |block: &DiagramBlock, (name, value): &(String, String)| match block.name.is_empty() {
        true => format!("{name} = {value}"),
        false => name.clone(),
    };
    let mut x = 20.0;
    let mut places = Vec::new();
    let mut deepest: f64 = 0.0;
    for (k, block) in blocks.iter().enumerate() {
        x += before(k, block).iter().map(|(_, value)| letters(value)).fold(0.0, f64::max);
        let ports = |names: &mut dyn Iterator<Item = f64>| names.fold(0.0, f64::max);
        let inputs = ports(&mut block.inputs.iter().map(|input| letters(&shown(block, input))));
        let outputs = ports(&mut block.outputs.iter().map(|name| letters(name)));
        let width = (inputs + outputs + 40.0).max(letters(&block.name).max(letters(&block.kind)) + 24.0);
        let rows = block.inputs.len().max(block.outputs.len()) as f64;
        let height = 48.0 + ROW * rows;
        places.push((x, width, height));
        deepest = deepest.max(height);
        x += width + GAP;
    }
    let top = 50.0;
    let port = |row: usize| top + 48.0 + ROW * (row as f64 + 0.4);
    let lanes = wires.len() as f64;
    let (wide, high) = (x - GAP + 20.0, top + deepest + 20.0 + 9.0 * lanes + 20.0);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {wide:.0} {high:.0}\" width=\"{wide:.0}\" \
         height=\"{high:.0}\" font-family=\"Roboto, sans-serif\" font-size=\"13\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#fff\"/>\n\
         <text x=\"20\" y=\"28\" font-size=\"17\" font-weight=\"bold\">{}</text>\n",
        escaped(&model.name.text)
    );
    for (lane, wire) in wires.iter().enumerate() {
        let lane = lane as f64;
        let (from, to) = (places[wire.from.0], places[wire.to.0]);
        let (x0, y0) = (from.0 + from.1, port(wire.from.1));
        let (x1, y1) = (to.0, port(wire.to.1));
        let (out_x, in_x) = (x0 + 8.0 + 5.0 * (lane % 10.0), x1 - 8.0 - 5.0 * (lane % 10.0));
        let path = if wire.to.0 == wire.from.0 + 1 {
            format!("M{x0:.1} {y0:.1} H{out_x:.1} V{y1:.1} H{x1:.1}")
        } else {
            let y = top + deepest + 20.0 + 9.0 * lane;
            format!("M{x0:.1} {y0:.1} H{out_x:.1} V{y:.1} H{in_x:.1} V{y1:.1} H{x1:.1}")
        };
        out += &format!(
            "<path d=\"{path}\" fill=\"none\" stroke=\"#0072b2\" stroke-width=\"1.3\"/>\n\
             <path d=\"M{:.1} {:.1} l-7 -3.5 v7 z\" fill=\"#0072b2\"/>\n",
            x1, y1
        );
    }
    for (k, (block, (x, width, height))) in blocks.iter().zip(&places).enumerate() {
        if !block.name.is_empty() {
            out += &format!(
                "<rect x=\"{x:.1}\" y=\"{top}\" width=\"{width:.1}\" height=\"{height:.1}\" rx=\"4\" fill=\"#f5f7fa\" \
                 stroke=\"#333\"/>\n<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" font-weight=\"bold\">{}</text>\n\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\" fill=\"#666\">{}</text>\n",
                x + width / 2.0,
                top + 18.0,
                escaped(&block.name),
                x + width / 2.0,
                top + 35.0,
                escaped(&block.kind)
            );
        }
        for (row, input) in block.inputs.iter().enumerate() {
            let text = escaped(&shown(block, input));
            out += &format!("<text x=\"{:.1}\" y=\"{:.1}\">{text}</text>\n", x + 6.0, port(row) + 4.0);
        }
        for (row, value) in before(k, block) {
            let y = port(row);
            out += &format!(
                "<path d=\"M{x:.1} {y:.1} l-7 -3.5 v7 z\" fill=\"#666\"/>\n<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" \
                 fill=\"#666\">{}</text>\n",
                x - 12.0,
                y + 4.0,
                escaped(&value)
            );
        }
        for (row, name) in block.outputs.iter().enumerate() {
            let (x, y) = (x + width - 6.0, port(row) + 4.0);
            out += &format!("<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"end\">{}</text>\n", escaped(name));
        }
    }
    out + "</svg>\n"
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use grammar::ast::Item;
    use grammar::span::FileId;

    fn model(text: &str) -> Model {
        let parsed = grammar::parse::parse(FileId(0), text);
        assert!(parsed.diagnostics.is_empty(), "{:?}", parsed.diagnostics);
        match parsed.file.items.into_iter().next() {
            Some(Item::Model(model)) => model,
            other => panic!("{other:?}"),
        }
    }

    const SERVO: &str = "model Servo {
  input  r [m] = 0
  part   pid : Controller = PID(r = r, y = body.x, Kp = 2 N/m)
  part   fr : Friction = LuGre(v = body.v)
  part   body = Axis(F_motor = pid.u, F_load = fr.F)
  output x [m] = body.x
}";

    #[test]
    fn boxes_show_ports_and_who_reads_them() {
        let shown = text(&model(SERVO));
        let expected = "\
Servo
  r ─▸ pid.r
  ┌ pid : Controller = PID ──┐
  ▸ r = r                  u ├─▸ body.F_motor
  ▸ y = body.x               │
  └──────────────────────────┘
  ┌ fr : Friction = LuGre ──┐
  ▸ v = body.v            F ├─▸ body.F_load
  └─────────────────────────┘
  ┌ body : Axis ──────────┐
  ▸ F_motor = pid.u     x ├─▸ pid.y, x
  ▸ F_load = fr.F       v ├─▸ fr.v
  └───────────────────────┘
  x = body.x
";
        assert_eq!(shown, expected, "\n{shown}");
    }

    #[test]
    fn an_unconnected_input_shows_its_expression() {
        let picture = svg(&model(
            "model Loop {\n  state v [m/s] = 0\n  part fr = LuGre(v = v)\n  dv/dt = (1 N - fr.F) / 1 kg\n}",
        ));
        assert_eq!(picture.matches(">v</text>").count(), 2, "{picture}");
        assert!(picture.contains(">dv/dt = (1 N − fr.F) / (1 kg)</text>"), "{picture}");
    }

    #[test]
    fn the_picture_has_a_box_a_part_and_an_arrow_a_wire() {
        let picture = svg(&model(SERVO));
        assert_eq!(picture.matches("<rect x=").count(), 3);
        assert_eq!(picture.matches("fill=\"none\"").count(), 6);
        assert!(picture.contains(">F_motor</text>") && picture.ends_with("</svg>\n"));
    }
}
