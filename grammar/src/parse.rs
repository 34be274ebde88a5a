//! Parser: text to syntax tree. The only file that uses pest.
//!
//! In: a text. Out: always a tree, and diagnostics in terms of the text. Each item and each statement is parsed
//! separately (`split` finds them), so that one error neither hides nor causes another. For an unreadable declaration
//! or equation the head is kept, with [`ExprKind::Error`] as its value. Knows nothing of meaning.

use std::collections::HashSet;

use pest::Parser;
use pest::error::{ErrorVariant, InputLocation};
use pest::iterators::Pair;

use crate::ast::*;
use crate::diagnostic::{Diagnostic, WordMistake};
use crate::outline::{self, Head};
use crate::slips;
use crate::span::{FileId, Span};
use crate::split::{Piece, Place, Source, begins_item};
use crate::tokens::TokenKind;

/// Limit on the nesting of brackets and conditions.
pub const DEPTH_LIMIT: usize = 256;
/// Limit on the height of an expression tree. It bounds the number of terms of a sum or product, and the depth of a
/// recursion over the tree.
pub const HEIGHT_LIMIT: usize = 1000;
/// Limit on the number of diagnostics for one text.
pub const DIAGNOSTIC_LIMIT: usize = 100;

/// Upper bound on the stack in bytes for one level of brackets, without optimisation.
const STACK_PER_LEVEL: usize = 64 << 10;

/// Result of parsing a text.
#[derive(Clone, PartialEq, Debug)]
pub struct Parsed {
    /// The tree of everything readable.
    pub file: File,
    /// Errors in the order of the text; empty if all of it is readable.
    pub diagnostics: Vec<Diagnostic>,
}

/// Parses a whole text.
pub fn parse(file: FileId, text: &str) -> Parsed {
    let mut reader = Reader::new(file, text);
    let items = reader.items();
    let lost = std::mem::take(&mut reader.lost);
    Parsed { file: File { items, lost }, diagnostics: reader.finish() }
}

/// Parses one item of a text in canonical layout.
pub fn parse_item(file: FileId, text: &str, head: &Head) -> (Option<Item>, Vec<Diagnostic>) {
    let mut reader = Reader::of(Source::of(file, text, head.range.clone()));
    let declared = outline::heads(text).into_iter().filter(|head| outline::declares_for_text(head.word));
    reader.names.file.extend(declared.map(|head| &text[head.name]));
    let item = reader.items().pop();
    (item, reader.finish())
}

/// For the formatter: the offsets of slashes of derivatives, as opposed to divisions.
pub(crate) fn derivatives(text: &str) -> Result<HashSet<usize>, Vec<Diagnostic>> {
    let mut reader = Reader::new(FileId::default(), text);
    reader.items();
    let derivatives = std::mem::take(&mut reader.derivatives);
    let diagnostics = reader.finish();
    if diagnostics.is_empty() { Ok(derivatives) } else { Err(diagnostics) }
}

/// Parses one expression, as on a command line. Outside models `dz/dt` is a division.
pub fn parse_expr(file: FileId, text: &str) -> (Expr, Vec<Diagnostic>) {
    let mut reader = Reader::new(file, text);
    let expr = reader.alone(Rule::one_expr, "an expression").map(|pair| reader.expr(pair));
    let whole = Span::new(file, 0, text.len());
    (expr.unwrap_or(Expr { kind: ExprKind::Error, span: whole }), reader.finish())
}

/// Parses one instance: `LuGre(vd = 10 mm/s)`.
pub fn parse_instance(file: FileId, text: &str) -> (Option<Instance>, Vec<Diagnostic>) {
    let mut reader = Reader::new(file, text);
    let instance = reader.alone(Rule::one_inst, "a model with its arguments").map(|pair| reader.instance(pair));
    (instance, reader.finish())
}

/// Parses one path: `fr.Fs`.
pub fn parse_path(file: FileId, text: &str) -> (Option<Path>, Vec<Diagnostic>) {
    let mut reader = Reader::new(file, text);
    let path = reader.alone(Rule::one_path, "a name").map(|pair| reader.path(pair));
    (path, reader.finish())
}

/// Parses one setting: `fr.Fs = 2 N`.
pub fn parse_setting(file: FileId, text: &str) -> (Option<(Path, Expr)>, Vec<Diagnostic>) {
    let mut reader = Reader::new(file, text);
    let setting = reader.alone(Rule::one_set, "`name = value`").map(|pair| reader.setting(pair));
    (setting, reader.finish())
}

/// Parses statements of an experiment: `expect max(F) < 2 N`, `plot x [mm]`.
pub fn parse_statements(file: FileId, text: &str) -> (Vec<ExperimentStatement>, Vec<Diagnostic>) {
    let mut reader = Reader::new(file, text);
    let whole = Piece { start: 0, end: reader.source.marks.len() };
    let found = reader.runs(Place::Experiment, whole).into_iter().filter_map(|statement| match statement {
        FitStatement::Experiment(statement) => Some(statement),
        FitStatement::Vary(..) | FitStatement::Minimise(..) | FitStatement::Case(_) | FitStatement::Validate(..) => {
            None
        }
    });
    let found = found.collect();
    (found, reader.finish())
}

mod pest_rules {
    #![allow(missing_docs)]
    #[derive(pest_derive::Parser)]
    #[grammar = "../fric.pest"]
    pub struct Fric;
}
use pest_rules::{Fric, Rule};

/// Names that distinguish derivatives from divisions: those of the present model, and those of the file.
#[derive(Default)]
struct Names<'t> {
    in_model: bool,
    states: HashSet<&'t str>,
    model: HashSet<&'t str>,
    file: HashSet<&'t str>,
}

struct Reader<'t> {
    source: Source<'t>,
    names: Names<'t>,
    /// Offset of the present piece in the text.
    base: usize,
    /// Whether the braces do not match.
    braces: bool,
    /// Whether a `;` has been reported.
    semicolon: bool,
    /// Whether the present piece has been reported as too high.
    too_high: bool,
    /// Offsets of the slashes of derivatives.
    derivatives: HashSet<usize>,
    /// Names declared outside of all items or by an unreadable item.
    lost: Vec<String>,
    diagnostics: Vec<Diagnostic>,
}

/// An expression under construction.
struct Built {
    expr: Expr,
    /// Span including surrounding parentheses.
    outer: Span,
    height: usize,
}

/// An expression as a flat list: operands and operators in the order of the text.
enum Flat<'t> {
    Operand(Built),
    /// `dz/dt` with its span and both words: a derivative or a division.
    Ratio(Span, &'t str, &'t str),
    Unary(UnaryOp, Span),
    Binary(BinaryOp, Span),
}

/// Whether a rule is a keyword or a symbol. These are together at the end of the grammar.
fn is_fixed(rule: Rule) -> bool {
    (Rule::open..=Rule::kw_when).contains(&rule)
}

/// The children of a match, without keywords and symbols.
struct Children<'t>(std::iter::Peekable<std::vec::IntoIter<Pair<'t, Rule>>>);

impl<'t> Children<'t> {
    fn of(pair: Pair<'t, Rule>) -> Children<'t> {
        Children(
            pair.into_inner().filter(|child| !is_fixed(child.as_rule())).collect::<Vec<_>>().into_iter().peekable(),
        )
    }

    /// The next child, which the grammar guarantees.
    fn one(&mut self) -> Pair<'t, Rule> {
        self.0.next().expect("the grammar asks for it")
    }

    fn maybe(&mut self, rule: Rule) -> Option<Pair<'t, Rule>> {
        self.0.next_if(|pair| pair.as_rule() == rule)
    }

    fn all(&mut self, rule: Rule) -> Vec<Pair<'t, Rule>> {
        std::iter::from_fn(|| self.maybe(rule)).collect()
    }
}

/// Whether this keyword is a direct child of `pair`.
fn says(pair: &Pair<Rule>, word: Rule) -> bool {
    pair.clone().into_inner().any(|child| child.as_rule() == word)
}

impl<'t> Reader<'t> {
    fn new(file: FileId, text: &'t str) -> Reader<'t> {
        Reader::of(Source::new(file, text))
    }

    fn of(mut source: Source<'t>) -> Reader<'t> {
        let mut diagnostics = std::mem::take(&mut source.complaints);
        let braces = !diagnostics.is_empty();
        // A brace inside an unterminated comment is missing because of the comment.
        if source.block_comments.iter().any(|span| !source.text[span.range()].ends_with("*/")) {
            diagnostics.clear();
        }
        diagnostics.extend(slips::block_comment(&source));
        Reader {
            source,
            names: Names::default(),
            base: 0,
            braces,
            semicolon: false,
            too_high: false,
            derivatives: HashSet::new(),
            lost: Vec::new(),
            diagnostics,
        }
    }

    fn finish(mut self) -> Vec<Diagnostic> {
        self.diagnostics.sort_by_key(|diagnostic| diagnostic.span().start);
        let text = self.source.text;
        let word = |d: &Diagnostic| text.get(d.span().range()).unwrap_or_default();
        let of = |mistake: WordMistake| move |d: &&Diagnostic| d.word == Some(mistake);
        let reserved: HashSet<&str> = self.diagnostics.iter().filter(of(WordMistake::Reserved)).map(word).collect();
        let mut seen = HashSet::new();
        let mut blocks = false;
        self.diagnostics.retain(|d| match d.word {
            // An error at each use of the name; reported once.
            Some(mistake @ (WordMistake::ForeignName | WordMistake::Reserved)) => seen.insert((mistake, word(d))),
            // A keyword as a name is reported at its declaration, not at its uses.
            Some(WordMistake::Misfit) => !blocks && !reserved.contains(word(d)),
            // A choice or a loop of another language has several statements; it is reported once, and its end with it.
            Some(WordMistake::Block) => !std::mem::replace(&mut blocks, true),
            Some(WordMistake::BlockEnd) => !blocks,
            None => true,
        });
        self.diagnostics.truncate(DIAGNOSTIC_LIMIT);
        self.diagnostics
    }

    fn report(&mut self, diagnostic: Diagnostic) {
        self.diagnostics.push(diagnostic);
    }

    // ---- parsing pieces by rules

    /// Parses the whole text by one rule.
    fn alone(&mut self, rule: Rule, what: &str) -> Option<Pair<'t, Rule>> {
        let piece = Piece { start: 0, end: self.source.marks.len() };
        if piece.start == piece.end {
            let end = Span::new(self.source.file, self.source.text.len(), self.source.text.len());
            self.report(Diagnostic::error("E0001", format!("expected {what}")).label(end, ""));
            return None;
        }
        self.read(rule, piece)
    }

    /// Parses a piece by one rule; reports its error.
    fn read(&mut self, rule: Rule, mut piece: Piece) -> Option<Pair<'t, Rule>> {
        while piece.end > piece.start + 1 && self.source.is_symbol(piece.end - 1, ";") {
            piece.end -= 1;
            if !std::mem::replace(&mut self.semicolon, true) {
                let span = self.source.span(piece.end);
                self.report(
                    Diagnostic::error("E0001", "a statement ends without `;`")
                        .label(span, "")
                        .help("leave out every `;`: the next statement begins with its own head"),
                );
            }
        }
        if let Some(diagnostic) = slips::brackets(&self.source, piece) {
            self.report(diagnostic);
            return None;
        }
        let (depth, beyond) = slips::depth(&self.source, piece, DEPTH_LIMIT);
        if let Some(beyond) = beyond {
            if self.braces {
                return None;
            }
            self.report(
                Diagnostic::error(
                    "E0001",
                    format!("brackets and conditions lie more than {DEPTH_LIMIT} deep in each other"),
                )
                .label(self.source.span(beyond), "")
                .help("give a part of this a name of its own with `let`"),
            );
            return None;
        }
        let (start, end) = (self.source.marks[piece.start].token.start, self.source.marks[piece.end - 1].token.end);
        (self.base, self.too_high) = (start, false);
        let text = &self.source.text[start..end];
        let rule = match self.source.word(piece.start) {
            "param" | "input" | "output" | "state" | "let" if rule == Rule::one_stmt => Rule::one_decl,
            _ if rule == Rule::one_stmt && matches!(self.source.word(piece.start + 1), "=" | "/") => Rule::one_eq,
            _ => rule,
        };
        // pest's generated rules need many nested calls for each bracket.
        match stacker::maybe_grow(STACK_PER_LEVEL * (depth + 4), STACK_PER_LEVEL * (depth + 4), || {
            Fric::parse(rule, text)
        }) {
            Ok(mut pairs) => pairs.next(),
            Err(error) => {
                let stop = self.stop(piece, &error);
                if self.braces && (stop.at >= piece.end || matches!(self.source.word(stop.at), "{" | "}")) {
                    return None;
                }
                let diagnostic = slips::explain(&self.source, piece, &stop);
                self.report(diagnostic);
                None
            }
        }
    }

    /// Where pest stopped, as a mark, and what it expected, in words.
    fn stop(&self, piece: Piece, error: &pest::error::Error<Rule>) -> slips::Stop {
        let offset = match error.location {
            InputLocation::Pos(at) => at,
            InputLocation::Span((at, _)) => at,
        };
        let place = self.base + offset;
        let at =
            self.source.marks[piece.start..piece.end].partition_point(|mark| mark.token.end <= place) + piece.start;
        let mut expected: Vec<String> = Vec::new();
        if let ErrorVariant::ParsingError { positives, .. } = &error.variant {
            for word in positives.iter().filter_map(|&rule| words(rule)) {
                if !expected.contains(&word) {
                    expected.push(word);
                }
            }
        }
        slips::Stop { at, expected }
    }

    // ---- items

    fn items(&mut self) -> Vec<Item> {
        let pieces = self.source.items();
        for &Piece { start, .. } in &pieces {
            if outline::declares_for_text(self.source.word(start)) {
                self.names.file.insert(self.source.word(start + 1));
            }
        }
        let mut items = Vec::new();
        let mut stray = None;
        for piece in pieces {
            if begins_item(self.source.word(piece.start)) && self.source.kind(piece.start) == Some(TokenKind::Word) {
                match self.item(piece) {
                    Some(item) => items.push(item),
                    None => self.lost.push(self.source.word(piece.start + 1).to_string()),
                }
                stray = None;
                continue;
            }
            for at in piece.start..piece.end {
                if matches!(self.source.word(at), "param" | "input" | "output" | "state" | "let" | "part") {
                    self.lost.push(self.source.word(at + 1).to_string());
                }
            }
            if stray.is_none() {
                stray = Some(piece);
                self.stray(piece);
            }
        }
        items
    }

    /// Reports text outside of all items.
    fn stray(&mut self, piece: Piece) {
        let first = piece.start;
        if self.braces && matches!(self.source.word(first), "{" | "}") {
            return;
        }
        let brace = (first..piece.end).find(|&at| matches!(self.source.word(at), "{" | "}"));
        if let Some(brace) = brace.filter(|&at| self.source.is_symbol(at, "}")) {
            if self.braces {
                return;
            }
            let mut diagnostic = Diagnostic::error("E0002", "one `}` too many").label(self.source.span(brace), "");
            if first > 0 && self.source.is_symbol(first - 1, "}") {
                diagnostic = diagnostic.label(self.source.span(first - 1), "the item ends here");
            }
            return self.report(diagnostic.help("remove one of the two"));
        }
        let word = self.source.word(first);
        let stop = slips::Stop { at: first, expected: vec!["an item".to_string()] };
        let diagnostic = match word {
            "param" | "input" | "output" | "state" | "let" | "require" | "storage" | "part" | "every" | "when"
            | "mode" => Diagnostic::error("E0001", format!("`{word}` stands inside a model"))
                .label(self.source.span(first), "outside of all items")
                .help(if word == "let" || word == "param" {
                    "for the whole file write `const`"
                } else {
                    "move it into a `model Name { ... }`"
                }),
            _ => {
                let mut diagnostic = slips::explain(&self.source, piece, &stop);
                let next = self.source.word(first + 1);
                if diagnostic.help.is_none() && matches!(next, "=" | ".") {
                    self.lost.push(word.to_string());
                    diagnostic = diagnostic.help(
                        "a parameter stands in its model: `model M { param m = 2 kg }`; for the whole file write `const m = 2 kg`",
                    );
                }
                if diagnostic.help.is_none() {
                    diagnostic = diagnostic.help(
                        "a file has items: import, const, fn, table, interface, model, experiment, fit, device, rig",
                    );
                }
                diagnostic
            }
        };
        self.report(diagnostic);
    }

    fn item(&mut self, piece: Piece) -> Option<Item> {
        let block = self.source.block(piece);
        let word = self.source.word(piece.start);
        let place = match word {
            "interface" => Place::Interface,
            "model" if block.is_none() && self.source.word(piece.start + 2) == "=" => return self.plain_item(piece),
            "model" => Place::Model,
            "experiment" => Place::Experiment,
            "fit" => Place::Fit,
            "device" if !(piece.start..piece.end).any(|at| self.source.is_word(at, "from")) || block.is_some() => {
                Place::Device
            }
            "rig" => Place::Rig,
            _ => return self.plain_item(piece),
        };
        let doc = self.source.doc(Piece { start: piece.start, end: block.map_or(piece.end, |(open, _)| open + 1) });
        let span = self.source.span_of(piece);
        let Some((open, inside)) = block else {
            if self.read(Rule::one_item, piece).is_some() {
                let at = self.source.span(piece.end - 1);
                self.report(
                    Diagnostic::error("E0001", "expected `{` here")
                        .label(at, "after this")
                        .help(format!("write `{} {{ ... }}`", self.source.text[span.range()].trim_end())),
                );
            }
            return None;
        };
        let head = self.read(Rule::one_item, Piece { start: piece.start, end: open });
        // A block is parsed even if its head is unreadable, to report the errors in it.
        let name = head.map(|head| self.name(Children::of(head).one()));
        let missing = Name { text: String::new(), span };
        let named = name.is_some();
        let name = name.unwrap_or(missing);
        let item = match place {
            Place::Interface => Item::Interface(Interface { name, ports: self.ports(inside), doc, span }),
            Place::Model => Item::Model(Model { name, body: self.model(inside), doc, span }),
            Place::Experiment => {
                let body = self.runs(place, inside).into_iter().filter_map(|statement| match statement {
                    FitStatement::Experiment(statement) => Some(statement),
                    FitStatement::Vary(..)
                    | FitStatement::Minimise(..)
                    | FitStatement::Case(_)
                    | FitStatement::Validate(..) => None,
                });
                Item::Experiment(Experiment { name, body: body.collect(), doc, span })
            }
            Place::Fit => Item::Fit(Fit { name, body: self.runs(place, inside), doc, span }),
            Place::Device => Item::Device(Device { name, body: self.frames(inside), doc, span }),
            Place::Rig => Item::Rig(Rig { name, body: self.rig(inside), doc, span }),
            Place::Every | Place::Mode | Place::Resets | Place::Hardware | Place::Case => {
                unreachable!("no item")
            }
        };
        named.then_some(item)
    }

    /// Parses an item without statements.
    fn plain_item(&mut self, piece: Piece) -> Option<Item> {
        let pair = self.read(Rule::one_item, piece)?;
        let (doc, span) = (self.source.doc(piece), self.span(&pair));
        let rule = pair.as_rule();
        let mut children = Children::of(pair.clone());
        Some(match rule {
            Rule::import => {
                let source = children.one();
                let source = match source.as_rule() {
                    Rule::string => ImportSource::File(self.string(source)),
                    _ => ImportSource::Library(self.name(source)),
                };
                Item::Import(Import { source, span })
            }
            Rule::constant => Item::Const(Const {
                name: self.name(children.one()),
                unit: self.maybe_unit(&mut children),
                value: self.value(&mut children),
                doc,
                span,
            }),
            Rule::function => Item::Function(Function {
                name: self.name(children.one()),
                args: children.all(Rule::fn_arg).into_iter().map(|arg| self.argument(arg)).collect(),
                unit: self.maybe_unit(&mut children),
                body: self.value(&mut children),
                doc,
                span,
            }),
            Rule::table => {
                let shape = if says(&pair, Rule::kw_linear) { TableShape::Linear } else { TableShape::Smooth };
                let name = self.name(children.one());
                let arg = self.argument(children.one());
                let unit = self.maybe_unit(&mut children);
                children.maybe(Rule::eq);
                let points = match children.maybe(Rule::string) {
                    Some(file) => TablePoints::File(self.string(file)),
                    None => TablePoints::Listed(
                        Children::of(children.one())
                            .all(Rule::point)
                            .into_iter()
                            .map(|point| {
                                let mut children = Children::of(point);
                                (self.value(&mut children), self.value(&mut children))
                            })
                            .collect(),
                    ),
                };
                Item::Table(Table { name, arg, unit, shape, points, doc, span })
            }
            Rule::variant => {
                let name = self.name(children.one());
                children.maybe(Rule::eq);
                Item::Variant(Variant { name, instance: self.instance(children.one()), doc, span })
            }
            Rule::dbc_device => {
                let name = self.name(Children::of(children.one()).one());
                let file = self.string(children.one());
                let messages = children.all(Rule::ident).into_iter().map(|name| self.name(name)).collect();
                Item::Device(Device { name, body: DeviceBody::Dbc { file, messages }, doc, span })
            }
            rule => unreachable!("{rule:?} is no item without statements"),
        })
    }

    /// Reports a statement in a place where it is not allowed.
    fn misplaced(&mut self, piece: Piece, place: Place) {
        if self.braces {
            // A brace is missing somewhere, so the place may be correct.
            return;
        }
        let word = self.source.word(piece.start);
        let what = if self.source.kind(piece.start) == Some(TokenKind::Word) && crate::tokens::is_keyword(word) {
            format!("`{word}` has no place in {}", place.words())
        } else {
            format!("an equation has no place in {}", place.words())
        };
        self.report(Diagnostic::error("E0001", what).label(self.source.span(piece.start), ""));
    }

    fn ports(&mut self, block: Piece) -> Vec<Declaration> {
        let mut ports = Vec::new();
        for piece in self.source.statements(Place::Interface, block) {
            let Some(declaration) = self.declaration_alone(piece, Place::Interface) else { continue };
            match declaration.kind {
                DeclarationKind::Input | DeclarationKind::Output => ports.push(declaration),
                DeclarationKind::Param | DeclarationKind::State | DeclarationKind::Let => {
                    self.misplaced(piece, Place::Interface);
                }
            }
        }
        ports
    }

    /// Parses a statement in a place where only declarations are allowed.
    fn declaration_alone(&mut self, piece: Piece, place: Place) -> Option<Declaration> {
        match self.statement(piece, place)? {
            Statement::Declaration(declaration) => Some(declaration),
            Statement::Equation(_)
            | Statement::Part(_)
            | Statement::Every(_)
            | Statement::Mode(_)
            | Statement::When(_)
            | Statement::Require(_)
            | Statement::Storage(_)
            | Statement::Allow(_) => {
                self.misplaced(piece, place);
                None
            }
        }
    }

    fn model(&mut self, block: Piece) -> Vec<Statement> {
        self.names.in_model = true;
        for at in block.start..block.end {
            let name = self.source.word(at + 1);
            match self.source.word(at) {
                "state" => self.names.states.insert(name) && self.names.model.insert(name),
                "param" | "input" | "output" | "let" | "part" | "mode" => self.names.model.insert(name),
                _ => continue,
            };
        }
        let pieces = self.source.statements(Place::Model, block);
        let body = pieces.into_iter().filter_map(|piece| self.statement(piece, Place::Model)).collect();
        self.names.in_model = false;
        self.names.states.clear();
        self.names.model.clear();
        body
    }

    /// The head of a statement with a block, up to its `{`. Reports a missing block.
    fn head(&mut self, piece: Piece) -> (Option<Pair<'t, Rule>>, Option<Piece>) {
        match self.source.block(piece) {
            Some((open, _)) if open == piece.start => (self.read(Rule::one_stmt, piece), None),
            Some((open, inside)) => (self.read(Rule::one_stmt, Piece { start: piece.start, end: open }), Some(inside)),
            None => {
                let head = self.read(Rule::one_stmt, piece);
                if head.is_some() && self.source.word(piece.start) != "go" {
                    let span = self.source.span(piece.end - 1);
                    self.report(Diagnostic::error("E0001", "expected `{` here").label(span, "after this"));
                }
                (head, None)
            }
        }
    }

    fn statement(&mut self, piece: Piece, place: Place) -> Option<Statement> {
        let span = self.source.span_of(piece);
        match self.source.word(piece.start) {
            "every" => {
                let (head, inside) = self.head(piece);
                let period = head.map(|head| self.value(&mut Children::of(head)));
                let body = inside.map_or(Vec::new(), |inside| self.every(inside));
                Some(Statement::Every(Every { period: period?, body, span }))
            }
            "mode" => {
                let (head, inside) = self.head(piece);
                let head = head.map(|head| {
                    let initial = head.clone().into_inner().find(|pair| pair.as_rule() == Rule::kw_initial);
                    let initial = initial.map(|word| self.span(&word));
                    let whole = self.span(&head);
                    let name = self.name(Children::of(head).one());
                    (Span::new(whole.file, whole.start as usize, name.span.end as usize), name, initial)
                });
                let (equations, transitions) = inside.map_or((Vec::new(), Vec::new()), |inside| self.mode(inside));
                let (head, name, initial) = head?;
                Some(Statement::Mode(Mode { name, initial, equations, transitions, span, head }))
            }
            "when" => {
                let (head, inside) = self.head(piece);
                let condition = head.map(|head| self.value(&mut Children::of(head)));
                let resets = inside.map_or(Vec::new(), |inside| self.resets(inside));
                Some(Statement::When(When { condition: condition?, resets, span }))
            }
            "go" | "reset" => {
                self.misplaced(piece, place);
                None
            }
            _ => {
                let Some(pair) = self.read(Rule::one_stmt, piece) else { return self.rescue(piece) };
                let span = self.span(&pair);
                let rule = pair.as_rule();
                let mut children = Children::of(pair.clone());
                Some(match rule {
                    Rule::decl => Statement::Declaration(self.declaration(pair, piece)),
                    Rule::require => Statement::Require(Require {
                        condition: self.value(&mut children),
                        message: children.maybe(Rule::string).map(|text| self.string(text)),
                        span,
                    }),
                    Rule::storage => Statement::Storage(Storage { energy: self.value(&mut children), span }),
                    Rule::allow => Statement::Allow(self.allow(pair)),
                    Rule::part => Statement::Part(self.part(pair, piece)),
                    Rule::derivative | Rule::equation => Statement::Equation(self.equation(pair)),
                    rule => unreachable!("{rule:?} is no statement"),
                })
            }
        }
    }

    /// Keeps the head of an unreadable statement, so that the name it declares or defines is known.
    fn rescue(&mut self, piece: Piece) -> Option<Statement> {
        let (start, end) = (self.source.marks[piece.start].token.start, self.source.marks[piece.end - 1].token.end);
        let (text, span) = (&self.source.text[start..end], self.source.span_of(piece));
        self.base = start;
        let unknown = Expr { kind: ExprKind::Error, span };
        if let Some(pair) = Fric::parse(Rule::decl_start, text).ok().and_then(|mut pairs| pairs.next()) {
            let kind = declaration_kind(&pair);
            let mut children = Children::of(pair);
            let name = self.name(children.one());
            let unit = self.maybe_unit(&mut children);
            // The text after the name may have been intended as the value.
            let value = Some(unknown);
            return Some(Statement::Declaration(Declaration {
                kind,
                name,
                unit,
                value,
                range: None,
                doc: self.source.doc(piece),
                span,
            }));
        }
        let name = |text: &str, span: Span, skip: usize| Name {
            text: text[skip..].to_string(),
            span: Span::new(span.file, span.start as usize + skip, span.end as usize),
        };
        let (first, word) = (self.source.span(piece.start), self.source.word(piece.start));
        let target = if let Some((whole, of, along)) = slips::spaced_derivative(&self.source, piece) {
            let last = self.source.span(piece.start + 2);
            Target::Derivative { of: name(of, first, 1), along: name(along, last, 1), span: whole }
        } else if let Some(pair) = Fric::parse(Rule::ratio, text).ok().and_then(|mut pairs| pairs.next()) {
            self.target(pair)
        } else if let Some(pair) = Fric::parse(Rule::next, text).ok().and_then(|mut pairs| pairs.next()) {
            self.target(pair)
        } else if self.source.kind(piece.start) == Some(TokenKind::Word)
            && !crate::tokens::is_keyword(word)
            && matches!(self.source.word(piece.start + 1), "=" | ":=" | "==")
        {
            Target::Name(name(word, first, 0))
        } else {
            return None;
        };
        Some(Statement::Equation(Equation { target, value: unknown, span }))
    }

    fn every(&mut self, block: Piece) -> Vec<EveryStatement> {
        let mut body = Vec::new();
        for piece in self.source.statements(Place::Every, block) {
            match self.statement(piece, Place::Every) {
                Some(Statement::Declaration(declaration)) => body.push(EveryStatement::Declaration(declaration)),
                Some(Statement::Equation(equation)) => body.push(EveryStatement::Equation(equation)),
                Some(_) => self.misplaced(piece, Place::Every),
                None => {}
            }
        }
        body
    }

    fn mode(&mut self, block: Piece) -> (Vec<Equation>, Vec<Go>) {
        let (mut equations, mut transitions) = (Vec::new(), Vec::new());
        for piece in self.source.statements(Place::Mode, block) {
            if self.source.is_word(piece.start, "go") {
                let (head, inside) = self.head(piece);
                let head = head.map(|head| {
                    let mut children = Children::of(head);
                    (self.name(children.one()), self.value(&mut children))
                });
                let resets = inside.map_or(Vec::new(), |inside| self.resets(inside));
                let span = self.source.span_of(piece);
                transitions.extend(head.map(|(target, condition)| Go { target, condition, resets, span }));
                continue;
            }
            match self.statement(piece, Place::Mode) {
                Some(Statement::Equation(equation)) => equations.push(equation),
                Some(_) => self.misplaced(piece, Place::Mode),
                None => {}
            }
        }
        (equations, transitions)
    }

    fn resets(&mut self, block: Piece) -> Vec<Reset> {
        let pieces = self.source.statements(Place::Resets, block);
        if pieces.is_empty() {
            let brace = self.source.span(block.start - 1);
            self.report(Diagnostic::error("E0001", "expected `reset(...) = ...` here").label(brace, "after this"));
        }
        let mut resets = Vec::new();
        for piece in pieces {
            if !self.source.is_word(piece.start, "reset") {
                self.report(
                    Diagnostic::error("E0001", "expected `reset(...) = ...` here")
                        .label(self.source.span(piece.start), "")
                        .help("a transition changes states only: write `reset(x) = ...`"),
                );
            } else if let Some(pair) = self.read(Rule::one_stmt, piece) {
                let span = self.span(&pair);
                let mut children = Children::of(pair);
                resets.push(Reset { name: self.name(children.one()), value: self.value(&mut children), span });
            }
        }
        resets
    }

    fn runs(&mut self, place: Place, block: Piece) -> Vec<FitStatement> {
        let mut body = Vec::new();
        for piece in self.source.statements(place, block) {
            let word = self.source.word(piece.start);
            let elsewhere = match place {
                Place::Experiment => matches!(word, "vary" | "minimise" | "validate" | "case"),
                Place::Case => matches!(word, "vary" | "case"),
                _ => false,
            };
            if elsewhere {
                self.report(
                    Diagnostic::error("E0001", format!("`{word}` stands in a `fit`"))
                        .label(self.source.span(piece.start), format!("this is {}", place.words())),
                );
                continue;
            }
            if place == Place::Fit && word == "case" {
                body.extend(self.fit_case(piece).map(FitStatement::Case));
                continue;
            }
            let Some(pair) = self.read(Rule::one_run, piece) else { continue };
            let span = self.span(&pair);
            let rule = pair.as_rule();
            let mut children = Children::of(pair.clone());
            body.push(FitStatement::Experiment(match rule {
                Rule::run => ExperimentStatement::Run(self.run(pair)),
                Rule::solver => ExperimentStatement::Solver(self.solver(pair)),
                Rule::sweep => ExperimentStatement::Sweep(self.sweep(pair)),
                Rule::data => ExperimentStatement::Data(Data {
                    file: self.string(children.one()),
                    more: children.all(Rule::string).into_iter().map(|file| self.string(file)).collect(),
                    columns: children.all(Rule::column).into_iter().map(|column| self.column(column)).collect(),
                    span,
                }),
                Rule::derived => {
                    children.maybe(Rule::kw_data);
                    let name = self.name(children.one());
                    let value = self.value(&mut children);
                    ExperimentStatement::Derived(Derived { name, value, span })
                }
                Rule::plot => {
                    let [last, after, before] =
                        [Rule::kw_against, Rule::kw_after, Rule::kw_before].map(|word| says(&pair, word));
                    let curves = children.all(Rule::curve).into_iter();
                    let mut curves: Vec<Curve> = curves.map(|curve| self.curve(curve)).collect();
                    let against = if last { curves.pop() } else { None };
                    let after = after.then(|| self.value(&mut children));
                    let before = before.then(|| self.value(&mut children));
                    let title = children.maybe(Rule::string).map(|title| self.string(title));
                    ExperimentStatement::Plot(Plot { curves, against, after, before, title, span })
                }
                Rule::tune => ExperimentStatement::Tune(self.tuned(&mut children), span),
                Rule::expect => ExperimentStatement::Expect(self.expect(pair)),
                Rule::shown => {
                    let show = self.shows(&mut children).remove(0);
                    let [after, before] = [Rule::kw_after, Rule::kw_before].map(|word| says(&pair, word));
                    let mut edges: Vec<Expr> =
                        children.all(Rule::expr).into_iter().map(|value| self.expr(value)).collect();
                    let before = if before { edges.pop() } else { None };
                    let after = if after { edges.pop() } else { None };
                    let (value, shows, cases) = (show.value, Some(show.unit), self.cases(&mut children));
                    ExperimentStatement::Expect(Expect { value, near: None, shows, after, before, cases, span })
                }
                Rule::recorded => {
                    let shows = self.shows(&mut children);
                    let every = says(&pair, Rule::kw_every).then(|| self.value(&mut children));
                    ExperimentStatement::Record(Record { shows, every, span })
                }
                Rule::allow => ExperimentStatement::Allow(self.allow(pair)),
                Rule::vary => {
                    let items = children.all(Rule::vary_item).into_iter().map(|item| {
                        let (span, is_known) = (self.span(&item), says(&item, Rule::margin));
                        let [initial, each] = [Rule::kw_initial, Rule::kw_each].map(|word| says(&item, word));
                        let mut children = Children::of(item);
                        let path = self.path(children.one());
                        let start = self.maybe_value(&mut children);
                        let known = is_known.then(|| self.value(&mut children));
                        let range = children.maybe(Rule::range).map(|range| self.range(range));
                        Vary { path, initial, start, known, range, each, span }
                    });
                    let items = items.collect();
                    body.push(FitStatement::Vary(items, span));
                    continue;
                }
                Rule::minimise => {
                    let [after, before] = [Rule::kw_after, Rule::kw_before].map(|word| says(&pair, word));
                    let mut items: Vec<Expr> =
                        children.all(Rule::expr).into_iter().map(|value| self.expr(value)).collect();
                    let before = if before { items.pop() } else { None };
                    let after = if after { items.pop() } else { None };
                    body.push(FitStatement::Minimise(Minimise { items, after, before, span }));
                    continue;
                }
                Rule::validate => {
                    let files = children.all(Rule::string).into_iter().map(|file| self.string(file)).collect();
                    body.push(FitStatement::Validate(files, span));
                    continue;
                }
                rule => unreachable!("{rule:?} is no statement of an experiment"),
            }));
        }
        body
    }

    /// A case of a fit.
    fn fit_case(&mut self, piece: Piece) -> Option<FitCase> {
        let Some((open, inside)) = self.source.block(piece) else {
            if self.read(Rule::one_run, piece).is_some() {
                let span = self.source.span(piece.end - 1);
                self.report(Diagnostic::error("E0001", "expected `{` here").label(span, "after this"));
            }
            return None;
        };
        let head = self.read(Rule::one_run, Piece { start: piece.start, end: open });
        // Its statements are read even if its head is unreadable, to report the errors in them.
        let name = head.map(|head| self.name(Children::of(head).one()));
        let body = self.runs(Place::Case, inside);
        Some(FitCase { name: name?, body, span: self.source.span_of(piece) })
    }

    fn frames(&mut self, block: Piece) -> DeviceBody {
        let (mut params, mut frames) = (Vec::new(), Vec::new());
        for piece in self.source.statements(Place::Device, block) {
            let Some(pair) = self.read(Rule::one_frame, piece) else { continue };
            if pair.as_rule() == Rule::decl {
                params.push(self.declaration(pair, piece));
                continue;
            }
            let (send, start, scale) = (says(&pair, Rule::kw_send), says(&pair, Rule::eq), says(&pair, Rule::kw_scale));
            let span = self.span(&pair);
            let mut children = Children::of(pair);
            let name = self.name(children.one());
            let unit = self.maybe_unit(&mut children);
            let start = start.then(|| self.value(&mut children));
            let (identifier, byte) = (self.value(&mut children), self.value(&mut children));
            let format = self.name(children.one());
            let scale = scale.then(|| self.value(&mut children));
            let doc = self.source.doc(piece);
            frames.push(FrameSignal { send, name, unit, start, identifier, byte, format, scale, doc, span });
        }
        DeviceBody::Frames { params, frames }
    }

    fn rig(&mut self, block: Piece) -> Vec<RigStatement> {
        let pieces = self.source.statements(Place::Rig, block);
        pieces.into_iter().filter_map(|piece| self.rig_statement(piece)).collect()
    }

    fn rig_statement(&mut self, piece: Piece) -> Option<RigStatement> {
        if self.source.is_word(piece.start, "hardware")
            && let Some((open, inside)) = self.source.block(piece).filter(|&(open, _)| open > piece.start)
        {
            let head = self.read(Rule::one_rig, Piece { start: piece.start, end: open });
            let part = head.map(|head| self.name(Children::of(head).one()));
            let wires = self.source.statements(Place::Hardware, inside).into_iter();
            let wires: Vec<_> =
                wires.filter_map(|piece| self.read(Rule::one_wire, piece).map(|pair| self.wire(pair))).collect();
            return Some(RigStatement::Hardware(Hardware { part: part?, wires, span: self.source.span_of(piece) }));
        }
        let pair = self.read(Rule::one_rig, piece)?;
        let span = self.span(&pair);
        let rule = pair.as_rule();
        let mut children = Children::of(pair.clone());
        Some(match rule {
            Rule::run => RigStatement::Run(self.run(pair)),
            Rule::rate => RigStatement::Rate(self.value(&mut children), span),
            Rule::solver => RigStatement::Solver(self.solver(pair)),
            Rule::bus => {
                let name = self.name(children.one());
                children.maybe(Rule::eq);
                let kind = self.name(children.one());
                let args = children.all(Rule::bus_arg).into_iter().map(|arg| {
                    let inner = Children::of(arg).one();
                    match inner.as_rule() {
                        Rule::string => BusArg::Text(self.string(inner)),
                        _ => BusArg::Expr(self.expr(inner)),
                    }
                });
                let args = args.collect();
                RigStatement::Bus(BusDecl { name, kind, args, span })
            }
            Rule::drive => {
                let moves = says(&pair, Rule::kw_drive);
                let name = self.name(children.one());
                children.maybe(Rule::eq);
                let (kind, bus) = (self.name(children.one()), self.name(children.one()));
                let args = children.all(Rule::drive_arg).into_iter().map(|arg| self.drive_argument(arg)).collect();
                RigStatement::Drive(DriveDecl { moves, name, kind, bus, args, span })
            }
            Rule::part => RigStatement::Part(self.part(pair, piece)),
            Rule::hardware_head => {
                let end = self.source.span(piece.end - 1);
                self.report(Diagnostic::error("E0001", "expected `{` here").label(end, "after this"));
                return None;
            }
            Rule::wire => RigStatement::Wire(self.wire(pair)),
            Rule::watchdog => RigStatement::Watchdog(self.value(&mut children), span),
            Rule::overrun => RigStatement::Overrun(children.maybe(Rule::expr).map(|count| self.expr(count)), span),
            Rule::predict => RigStatement::Predict(self.name(children.one()), span),
            Rule::safe => {
                let sets = children.all(Rule::set).into_iter().map(|set| self.setting(set)).collect();
                RigStatement::Safe(sets, span)
            }
            Rule::stop => {
                let condition = self.value(&mut children);
                RigStatement::Stop { condition, why: self.string(children.one()), span }
            }
            Rule::record => RigStatement::Record(self.shows(&mut children), span),
            Rule::curves => {
                let last = says(&pair, Rule::kw_against);
                let mut shows = self.shows(&mut children);
                let against = if last { shows.pop() } else { None };
                RigStatement::Plot(Curves { shows, against, span })
            }
            Rule::tune => RigStatement::Tune(self.tuned(&mut children), span),
            Rule::allow => RigStatement::Allow(self.allow(pair)),
            rule => unreachable!("{rule:?} is no statement of a rig"),
        })
    }

    // ---- parts of statements

    fn span(&self, pair: &Pair<Rule>) -> Span {
        let span = pair.as_span();
        // Blanks and comments after the last token are not part of it.
        let length = pair.as_str().len();
        debug_assert_eq!(length, span.end() - span.start());
        Span::new(self.source.file, self.base + span.start(), self.base + span.end())
    }

    fn name(&self, pair: Pair<Rule>) -> Name {
        Name { text: pair.as_str().to_string(), span: self.span(&pair) }
    }

    fn tuned(&mut self, children: &mut Children<'t>) -> Vec<Tuned> {
        let one = |item: Pair<'t, Rule>| {
            let (span, limited) = (self.span(&item), says(&item, Rule::dots));
            let mut children = Children::of(item);
            let path = self.path(children.one());
            let range = limited.then(|| (self.value(&mut children), self.value(&mut children)));
            Tuned { path, range, span }
        };
        children.all(Rule::tuned).into_iter().map(one).collect()
    }

    fn string(&self, pair: Pair<Rule>) -> Text {
        let quoted = pair.as_str();
        Text { text: quoted[1..quoted.len() - 1].to_string(), span: self.span(&pair) }
    }

    fn maybe_unit(&self, children: &mut Children) -> Option<UnitText> {
        children.maybe(Rule::unit_decl).map(|unit| self.unit(Children::of(unit).one()))
    }

    fn unit(&self, pair: Pair<Rule>) -> UnitText {
        UnitText { text: pair.as_str().to_string(), span: self.span(&pair) }
    }

    fn argument(&self, pair: Pair<Rule>) -> Argument {
        let mut children = Children::of(pair);
        Argument { name: self.name(children.one()), unit: self.maybe_unit(&mut children) }
    }

    fn column(&self, pair: Pair<Rule>) -> Column {
        let hold = says(&pair, Rule::kw_hold);
        let mut children = Children::of(pair);
        let (name, unit) = (self.name(children.one()), self.maybe_unit(&mut children));
        children.maybe(Rule::eq);
        Column { name, unit, hold, heading: children.maybe(Rule::string).map(|heading| self.string(heading)) }
    }

    fn curve(&mut self, pair: Pair<'t, Rule>) -> Curve {
        let (range, log) = (says(&pair, Rule::kw_in), says(&pair, Rule::kw_log));
        let mut children = Children::of(pair);
        let show = self.shows(&mut children).remove(0);
        let label = children.maybe(Rule::string).map(|label| self.string(label));
        let range = range.then(|| (self.value(&mut children), self.value(&mut children)));
        Curve { show, label, range, log }
    }

    /// The next expression, after an optional equals sign.
    fn value(&mut self, children: &mut Children<'t>) -> Expr {
        children.maybe(Rule::eq);
        let pair = children.one();
        self.expr(pair)
    }

    fn maybe_value(&mut self, children: &mut Children<'t>) -> Option<Expr> {
        children.maybe(Rule::eq).map(|_| self.value(children))
    }

    fn declaration(&mut self, pair: Pair<'t, Rule>, piece: Piece) -> Declaration {
        let (kind, span) = (declaration_kind(&pair), self.span(&pair));
        let mut children = Children::of(pair);
        let name = self.name(children.one());
        let unit = self.maybe_unit(&mut children);
        let value = self.maybe_value(&mut children);
        let range = children.maybe(Rule::range).map(|range| self.range(range));
        Declaration { kind, name, unit, value, range, doc: self.source.doc(piece), span }
    }

    fn range(&mut self, pair: Pair<'t, Rule>) -> Range {
        let mut children = Children::of(pair);
        if let Some(bound) = children.maybe(Rule::bound) {
            let mut children = Children::of(bound);
            let operator = binary(children.one().as_str());
            return Range::Bound(operator, self.value(&mut children));
        }
        Range::Between(self.value(&mut children), self.value(&mut children))
    }

    fn allow(&mut self, pair: Pair<Rule>) -> Allow {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        Allow { lint: self.name(children.one()), reason: self.string(children.one()), span }
    }

    fn part(&mut self, pair: Pair<'t, Rule>, piece: Piece) -> Part {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let name = self.name(children.one());
        let repeat = children.maybe(Rule::repeat).map(|repeat| {
            let span = self.span(&repeat);
            let mut children = Children::of(repeat);
            let index = self.name(children.one());
            Repeat { index, first: self.value(&mut children), last: self.value(&mut children), span }
        });
        let slot = children.maybe(Rule::slot).map(|slot| SlotType {
            rotary: says(&slot, Rule::kw_rotary),
            interface: self.name(Children::of(slot).one()),
        });
        children.maybe(Rule::eq);
        let instance = children.one();
        Part { name, repeat, slot, instance: self.instance(instance), doc: self.source.doc(piece), span }
    }

    fn instance(&mut self, pair: Pair<'t, Rule>) -> Instance {
        stacker::maybe_grow(2 * STACK_PER_LEVEL, 32 * STACK_PER_LEVEL, || self.roomy_instance(pair))
    }

    fn roomy_instance(&mut self, pair: Pair<'t, Rule>) -> Instance {
        let (rotary, span) = (says(&pair, Rule::kw_rotary), self.span(&pair));
        let mut children = Children::of(pair);
        let model = self.name(children.one());
        let args = children.all(Rule::bind).into_iter().map(|bind| {
            let span = self.span(&bind);
            let mut children = Children::of(bind);
            let path = self.path(children.one());
            children.maybe(Rule::eq);
            let value = children.one();
            let value = match value.as_rule() {
                Rule::inst => BindValue::Instance(self.instance(value)),
                _ => BindValue::Expr(self.expr(value)),
            };
            let name = path.segments[0].name.clone();
            let inner = if path.single().is_some() { None } else { Some(path) };
            Bind { name, inner, value, span }
        });
        let args = args.collect();
        Instance { rotary, model, args, span }
    }

    fn equation(&mut self, pair: Pair<'t, Rule>) -> Equation {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let target = children.one();
        let target = self.target(target);
        Equation { target, value: self.value(&mut children), span }
    }

    fn target(&mut self, pair: Pair<Rule>) -> Target {
        let span = self.span(&pair);
        if pair.as_rule() == Rule::ratio {
            self.derivatives.extend(pair.as_str().find('/').map(|stroke| span.start as usize + stroke));
        }
        match pair.as_rule() {
            Rule::ratio => {
                let mut children = Children::of(pair);
                Target::Derivative { of: self.name(children.one()), along: self.name(children.one()), span }
            }
            Rule::next => Target::Next { name: self.name(Children::of(pair).one()), span },
            _ => Target::Name(self.name(pair)),
        }
    }

    fn run(&mut self, pair: Pair<'t, Rule>) -> Run {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let instance = children.one();
        let instance = self.instance(instance);
        Run { instance, duration: children.maybe(Rule::expr).map(|duration| self.expr(duration)), span }
    }

    fn solver(&mut self, pair: Pair<'t, Rule>) -> Solver {
        let (tolerance, span) = (says(&pair, Rule::kw_tol), self.span(&pair));
        let mut children = Children::of(pair);
        let method = self.name(children.one());
        let value = children.maybe(Rule::expr).map(|value| self.expr(value));
        let (step, tol) = if tolerance { (None, value) } else { (value, None) };
        Solver { method, step, tol, span }
    }

    fn sweep(&mut self, pair: Pair<'t, Rule>) -> Sweep {
        let spacing = [Rule::kw_by, Rule::kw_lin, Rule::kw_log].into_iter().find(|word| says(&pair, *word));
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let path = children.one();
        let path = self.path(path);
        let also = children.all(Rule::path).into_iter().map(|path| self.path(path)).collect();
        children.maybe(Rule::eq);
        let instances = children.all(Rule::inst);
        let over = if let Some(word) = spacing {
            let (first, last) = (self.value(&mut children), self.value(&mut children));
            let value = self.value(&mut children);
            let spacing = match word {
                Rule::kw_lin => Spacing::Lin(value),
                Rule::kw_log => Spacing::Log(value),
                _ => Spacing::By(value),
            };
            SweepOver::Grid { first, last, spacing }
        } else if instances.is_empty() {
            SweepOver::Values(children.all(Rule::expr).into_iter().map(|value| self.expr(value)).collect())
        } else {
            SweepOver::Instances(instances.into_iter().map(|instance| self.instance(instance)).collect())
        };
        Sweep { path, also, over, span }
    }

    fn shows(&mut self, children: &mut Children<'t>) -> Vec<Show> {
        let shows = children.all(Rule::show).into_iter();
        shows
            .map(|show| {
                let span = self.span(&show);
                let mut children = Children::of(show);
                Show { value: self.value(&mut children), unit: self.maybe_unit(&mut children), span }
            })
            .collect()
    }

    fn expect(&mut self, pair: Pair<'t, Rule>) -> Expect {
        let (after, before, span) = (says(&pair, Rule::kw_after), says(&pair, Rule::kw_before), self.span(&pair));
        let mut children = Children::of(pair);
        let mut values: Vec<Expr> = children.all(Rule::expr).into_iter().map(|value| self.expr(value)).collect();
        let cases = self.cases(&mut children);
        let before = if before { values.pop() } else { None };
        let after = if after { values.pop() } else { None };
        let tolerance = if values.len() == 3 { values.pop() } else { None };
        let near = tolerance.and_then(|tolerance| values.pop().map(|target| (target, tolerance)));
        let value = values.pop().expect("the grammar asks for a condition");
        Expect { value, near, shows: None, after, before, cases, span }
    }

    /// `for v = 0.3 m/s, fr = LuGre()`
    fn cases(&mut self, children: &mut Children<'t>) -> Vec<Case> {
        let Some(cases) = children.maybe(Rule::cases) else { return Vec::new() };
        let one = |case: Pair<'t, Rule>| {
            let span = self.span(&case);
            let mut children = Children::of(case);
            let path = children.one();
            let path = self.path(path);
            children.maybe(Rule::eq);
            let value = match children.maybe(Rule::inst) {
                Some(instance) => BindValue::Instance(self.instance(instance)),
                None => BindValue::Expr(self.value(&mut children)),
            };
            Case { path, value, span }
        };
        Children::of(cases).all(Rule::one_case).into_iter().map(one).collect()
    }

    fn drive_argument(&mut self, pair: Pair<'t, Rule>) -> (Name, DriveArg) {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let name = match children.maybe(Rule::ident) {
            Some(name) => self.name(name),
            // `mode` is a keyword that is allowed as a name here.
            None => {
                Name { text: "mode".into(), span: Span::new(span.file, span.start as usize, span.start as usize + 4) }
            }
        };
        let first = self.value(&mut children);
        match children.maybe(Rule::expr) {
            Some(last) => (name, DriveArg::Range(first, self.expr(last))),
            None => (name, DriveArg::Expr(first)),
        }
    }

    fn wire(&mut self, pair: Pair<'t, Rule>) -> Wire {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let path = children.one();
        let (path, value) = (self.path(path), self.value(&mut children));
        let limit = children.maybe(Rule::limit).map(|limit| {
            let mut children = Children::of(limit);
            (self.value(&mut children), self.value(&mut children))
        });
        let slew = children.maybe(Rule::slew).map(|slew| self.value(&mut Children::of(slew)));
        Wire { path, value, limit, slew, span }
    }

    fn setting(&mut self, pair: Pair<'t, Rule>) -> (Path, Expr) {
        let mut children = Children::of(pair);
        let path = children.one();
        (self.path(path), self.value(&mut children))
    }

    fn path(&mut self, pair: Pair<Rule>) -> Path {
        let span = self.span(&pair);
        let mut segments: Vec<Segment> = Vec::new();
        for child in pair.into_inner() {
            if child.as_rule() == Rule::index {
                let index = child.as_str().parse().unwrap_or_else(|_| {
                    self.report(Diagnostic::error("E0001", "this index is too large").label(self.span(&child), ""));
                    0
                });
                segments.last_mut().expect("a name stands first").index = Some(index);
            } else {
                segments.push(Segment { name: self.name(child), index: None });
            }
        }
        Path { segments, span }
    }

    // ---- expressions

    fn expr(&mut self, pair: Pair<'t, Rule>) -> Expr {
        self.build(pair).expr
    }

    fn build(&mut self, pair: Pair<'t, Rule>) -> Built {
        stacker::maybe_grow(2 * STACK_PER_LEVEL, 32 * STACK_PER_LEVEL, || self.roomy_build(pair))
    }

    fn roomy_build(&mut self, pair: Pair<'t, Rule>) -> Built {
        let start = self.span(&pair);
        let inner: Vec<Pair<'t, Rule>> = pair.into_inner().collect();
        if let [only] = inner.as_slice()
            && only.as_rule() == Rule::conditional
        {
            let mut children = Children::of(only.clone());
            let [condition, then, otherwise] = [(); 3].map(|_| {
                let branch = children.one();
                self.build(branch)
            });
            let height = 1 + condition.height.max(then.height).max(otherwise.height);
            let span = Span { end: otherwise.outer.end, ..start };
            let kind = ExprKind::If(Box::new(condition.expr), Box::new(then.expr), Box::new(otherwise.expr));
            return self.limited(Built { expr: Expr { kind, span }, outer: span, height });
        }
        let flat = inner.into_iter().map(|pair| self.flat(pair)).collect();
        let flat = self.splice(flat);
        self.climb(flat)
    }

    /// One operand or operator.
    fn flat(&mut self, pair: Pair<'t, Rule>) -> Flat<'t> {
        let span = self.span(&pair);
        let leaf = |kind: ExprKind| Flat::Operand(Built { expr: Expr { kind, span }, outer: span, height: 1 });
        match pair.as_rule() {
            Rule::neg => Flat::Unary(UnaryOp::Negate, span),
            Rule::kw_not => Flat::Unary(UnaryOp::Not, span),
            Rule::infix | Rule::logic => Flat::Binary(binary(pair.as_str()), span),
            Rule::ratio => {
                let (upper, lower) = pair.as_str().split_once('/').expect("a ratio has a stroke");
                Flat::Ratio(span, upper, lower)
            }
            Rule::group => {
                let inner = Children::of(pair).one();
                let built = self.build(inner);
                Flat::Operand(Built { outer: span, ..built })
            }
            Rule::call => Flat::Operand(self.call(pair)),
            Rule::quantity => leaf(self.quantity(pair)),
            Rule::path => {
                let path = self.path(pair);
                let time = self.names.in_model
                    && path.single().is_some_and(|name| {
                        name.text == "time" && !self.names.model.contains("time") && !self.names.file.contains("time")
                    });
                if time {
                    self.report(
                        Diagnostic::error("E0204", "there is no `time`: time is called `t`")
                            .label(span, "not declared")
                            .help("write `t`"),
                    );
                    return leaf(ExprKind::Error);
                }
                leaf(ExprKind::Path(path))
            }
            Rule::hole => leaf(ExprKind::Hole),
            rule => unreachable!("{rule:?} is no operand"),
        }
    }

    fn call(&mut self, pair: Pair<'t, Rule>) -> Built {
        let span = self.span(&pair);
        let mut children = Children::of(pair);
        let function = self.name(children.one());
        let args: Vec<Built> = children.all(Rule::expr).into_iter().map(|arg| self.build(arg)).collect();
        let mut height = 1 + args.iter().map(|arg| arg.height).max().unwrap_or(0);
        let mut window = Window { after: None, before: None };
        let mut word = Rule::kw_after;
        let edges = children.all(Rule::window).into_iter().flat_map(Pair::into_inner).collect::<Vec<_>>();
        for edge in edges {
            match edge.as_rule() {
                Rule::expr => {
                    let built = self.build(edge);
                    height = height.max(1 + built.height);
                    let place = if word == Rule::kw_after { &mut window.after } else { &mut window.before };
                    *place = Some(built.expr);
                }
                other => word = other,
            }
        }
        let window = (window.after.is_some() || window.before.is_some()).then(|| Box::new(window));
        if let ("der", [Built { expr: Expr { kind: ExprKind::Path(path), .. }, .. }]) =
            (function.text.as_str(), args.as_slice())
            && let Some(of) = path.single().filter(|_| !self.names.file.contains("der"))
        {
            self.report(
                Diagnostic::error("E0001", "a derivative is written as on paper")
                    .label(span, "")
                    .help(format!("write `d{}/dt`", of.text)),
            );
            return Built { expr: Expr { kind: ExprKind::Error, span }, outer: span, height: 1 };
        }
        let kind = ExprKind::Call { function, args: args.into_iter().map(|arg| arg.expr).collect(), window };
        self.limited(Built { expr: Expr { kind, span }, outer: span, height })
    }

    fn quantity(&mut self, pair: Pair<'t, Rule>) -> ExprKind {
        let span = self.span(&pair);
        let mut children = pair.into_inner();
        let number = children.next().expect("a quantity has a number");
        let digits = number.as_str();
        let value = match digits.strip_prefix("0x") {
            Some(hex) => {
                hex.chars().filter_map(|c| c.to_digit(16)).fold(0.0, |value, digit| value * 16.0 + f64::from(digit))
            }
            None => digits.parse().unwrap_or(f64::INFINITY),
        };
        if !value.is_finite() {
            self.report(
                Diagnostic::error("E0001", "this number is too large")
                    .label(self.span(&number), "more than 1.8e308")
                    .help("without a bound write `inf`"),
            );
            return ExprKind::Error;
        }
        let unit = children.next().map(|unit| self.unit(unit));
        match &unit {
            Some(unit) if self.names.in_model => match self.no_unit(digits, unit) {
                Some(diagnostic) => {
                    self.report(diagnostic.label(Span { start: unit.span.start, ..span }, "reads as a unit"));
                    ExprKind::Error
                }
                None => ExprKind::Number { value, unit: Some(unit.clone()) },
            },
            _ => ExprKind::Number { value, unit },
        }
    }

    /// Reports a name of the model, or a derivative, in a place where a unit is read.
    fn no_unit(&self, digits: &str, unit: &UnitText) -> Option<Diagnostic> {
        let text = unit.text.as_str();
        if let Some((upper, lower)) = text.split_once('/')
            && self.is_derivative(upper, lower)
            && !slips::is_unit(upper)
        {
            let message = format!("there is no unit `{upper}`");
            return Some(
                Diagnostic::error("E0102", message).help(format!("for the derivative write `{digits} * {text}`")),
            );
        }
        (self.names.model.contains(text) && !slips::is_unit(text)).then(|| {
            Diagnostic::error("E0111", format!("an operator is missing before `{text}`"))
                .help(format!("to multiply write `{digits} * {text}`"))
        })
    }

    /// Whether two words form a derivative here: of a state of this model, with respect to time or a name of the model.
    fn is_derivative(&self, upper: &str, lower: &str) -> bool {
        let (Some(of), Some(along)) = (upper.strip_prefix('d'), lower.strip_prefix('d')) else { return false };
        self.names.in_model && self.names.states.contains(of) && (along == "t" || self.names.model.contains(along))
    }

    /// Decides for each ratio whether it is a derivative. Replaces a division by its operands and operator in the list.
    fn splice(&mut self, flat: Vec<Flat<'t>>) -> Vec<Flat<'t>> {
        if !flat.iter().any(|item| matches!(item, Flat::Ratio(..))) {
            return flat;
        }
        let mut spliced: Vec<Flat<'t>> = Vec::with_capacity(flat.len() + 2);
        let mut rest = flat.into_iter().peekable();
        while let Some(item) = rest.next() {
            let Flat::Ratio(span, upper, lower) = item else {
                spliced.push(item);
                continue;
            };
            let (start, stroke) = (span.start as usize, span.start as usize + upper.len());
            let part = |from: usize, to: usize| Span::new(span.file, from, to);
            let name = |text: &str, span: Span| Name { text: text.to_string(), span };
            let leaf =
                |kind: ExprKind, span: Span| Flat::Operand(Built { expr: Expr { kind, span }, outer: span, height: 1 });
            if !self.is_derivative(upper, lower) {
                let whole = |text: &str, span: Span| {
                    leaf(
                        ExprKind::Path(Path { segments: vec![Segment { name: name(text, span), index: None }], span }),
                        span,
                    )
                };
                spliced.push(whole(upper, part(start, stroke)));
                spliced.push(Flat::Binary(BinaryOp::Divide, part(stroke, stroke + 1)));
                spliced.push(whole(lower, part(stroke + 1, span.end as usize)));
                continue;
            }
            self.derivatives.insert(stroke);
            let (of, along) = (&upper[1..], &lower[1..]);
            let visible = |word: &str| self.names.model.contains(word) || self.names.file.contains(word);
            let before = spliced.iter().rev().find(|item| !matches!(item, Flat::Unary(..)));
            let divided = matches!(before, Some(Flat::Binary(BinaryOp::Divide, _)));
            let raised = matches!(rest.peek(), Some(Flat::Binary(BinaryOp::Power, _)));
            let exponent = matches!(before, Some(Flat::Binary(BinaryOp::Power, _)));
            let complaint = if visible(upper) && visible(lower) {
                let also = if along == "t" {
                    format!("so is the state `{of}`")
                } else {
                    format!("so are the state `{of}` and `{along}`")
                };
                Some(
                    Diagnostic::error("E0209", format!("`{upper}/{lower}` can be a derivative or a division"))
                        .label(span, format!("`{upper}` and `{lower}` are declared, and {also}"))
                        .help(format!(
                            "for the division write `{upper} / {lower}`, with spaces;\nfor the derivative give `{upper}` or `{lower}` another name"
                        )),
                )
            } else if divided || raised || exponent {
                let (what, write) = if raised {
                    ("raised to a power", format!("({upper}/{lower})^..."))
                } else if exponent {
                    ("used as an exponent", format!("^({upper}/{lower})"))
                } else {
                    ("divided by", format!("/ ({upper}/{lower})"))
                };
                Some(
                    Diagnostic::error("E0212", format!("a derivative that is {what} stands in parentheses"))
                        .label(span, format!("the derivative of `{of}`"))
                        .help(format!("write `{write}`")),
                )
            } else {
                None
            };
            let kind = match complaint {
                Some(diagnostic) => {
                    self.report(diagnostic);
                    ExprKind::Error
                }
                None => ExprKind::Derivative {
                    of: name(of, part(start + 1, stroke)),
                    along: name(along, part(stroke + 2, span.end as usize)),
                },
            };
            spliced.push(leaf(kind, span));
        }
        spliced
    }

    /// Builds the tree of a flat list by operator precedence, without recursion (Dijkstra's shunting-yard algorithm,
    /// 1961).
    fn climb(&mut self, flat: Vec<Flat<'t>>) -> Built {
        enum Pending {
            Unary(UnaryOp, Span),
            Binary(BinaryOp, Span),
        }
        let strength = |pending: &Pending| match pending {
            Pending::Unary(operator, _) => operator.binds(),
            Pending::Binary(operator, _) => operator.binds(),
        };
        let mut operands: Vec<Built> = Vec::new();
        let mut pending: Vec<Pending> = Vec::new();
        let mut items = flat.into_iter();
        loop {
            let item = items.next();
            let incoming = match &item {
                Some(Flat::Binary(operator, _)) => operator.binds(),
                None => 0,
                Some(Flat::Operand(_) | Flat::Ratio(..) | Flat::Unary(..)) => u8::MAX,
            };
            // Powers are right-associative, all other operators left-associative.
            let waits = |top: &Pending| {
                strength(top) > incoming || strength(top) == incoming && incoming != BinaryOp::Power.binds()
            };
            while incoming != u8::MAX && pending.last().is_some_and(waits) {
                let top = pending.pop().expect("just looked at");
                let right = operands.pop().expect("an operand stands behind every operator");
                let built = match top {
                    Pending::Unary(operator, span) => {
                        let whole = span.to(right.outer);
                        let kind = ExprKind::Unary(operator, Box::new(right.expr));
                        Built { expr: Expr { kind, span: whole }, outer: whole, height: right.height + 1 }
                    }
                    Pending::Binary(operator, span) => {
                        let left = operands.pop().expect("an operand stands before every operator");
                        let whole = left.outer.to(right.outer);
                        let height = 1 + left.height.max(right.height);
                        let kind = match &item {
                            Some(Flat::Binary(second, place)) if compares(*second) && compares(operator) => {
                                self.chained(&left, operator, span, &right, *second, *place);
                                ExprKind::Error
                            }
                            _ => ExprKind::Binary(operator, span, Box::new(left.expr), Box::new(right.expr)),
                        };
                        Built { expr: Expr { kind, span: whole }, outer: whole, height }
                    }
                };
                operands.push(self.limited(built));
            }
            match item {
                Some(Flat::Operand(built)) => operands.push(built),
                Some(Flat::Ratio(..)) => unreachable!("decided before"),
                Some(Flat::Unary(operator, span)) => pending.push(Pending::Unary(operator, span)),
                Some(Flat::Binary(operator, span)) => pending.push(Pending::Binary(operator, span)),
                None => return operands.pop().expect("an expression has an operand"),
            }
        }
    }

    fn chained(&mut self, left: &Built, first: BinaryOp, span: Span, middle: &Built, second: BinaryOp, place: Span) {
        let text = |span: Span| &self.source.text[span.range()];
        // The operand after the second operator has not been read yet; its first words suffice.
        let behind = self.source.marks.partition_point(|mark| mark.token.start < place.end as usize);
        let (a, b, c) = (text(left.outer), text(middle.outer), slips::operand_at(&self.source, behind));
        let short = a.len() + b.len() < 60 && !a.contains('\n') && !b.contains('\n') && first != BinaryOp::Equal;
        let help = if short {
            format!("write `{a} {} {b} and {b} {} {c}`", first.text(), second.text())
        } else {
            "write two comparisons with `and` between them".to_string()
        };
        self.report(
            Diagnostic::error("E0004", "comparisons cannot be chained")
                .label(place, "a second comparison")
                .label(span, "the first")
                .help(help),
        );
    }

    /// Replaces a tree that exceeds [`HEIGHT_LIMIT`] by an error.
    fn limited(&mut self, built: Built) -> Built {
        if built.height <= HEIGHT_LIMIT {
            return built;
        }
        if std::mem::replace(&mut self.too_high, true) {
            return Built { expr: Expr { kind: ExprKind::Error, span: built.outer }, outer: built.outer, height: 1 };
        }
        self.report(
            Diagnostic::error("E0001", format!("this expression has more than {HEIGHT_LIMIT} operations in a row"))
                .label(self.first_line(built.outer), "")
                .help("give a part of it a name of its own with `let`"),
        );
        Built { expr: Expr { kind: ExprKind::Error, span: built.outer }, outer: built.outer, height: 1 }
    }

    /// The part of a span on its first line.
    fn first_line(&self, span: Span) -> Span {
        let text = &self.source.text[span.range()];
        let length = text.find('\n').unwrap_or(text.len());
        Span::new(span.file, span.start as usize, span.start as usize + length)
    }
}

fn compares(operator: BinaryOp) -> bool {
    operator.binds() == BinaryOp::Less.binds()
}

fn binary(text: &str) -> BinaryOp {
    const ALL: [BinaryOp; 16] = [
        BinaryOp::Add,
        BinaryOp::Subtract,
        BinaryOp::Multiply,
        BinaryOp::Divide,
        BinaryOp::Power,
        BinaryOp::Less,
        BinaryOp::LessEqual,
        BinaryOp::Greater,
        BinaryOp::GreaterEqual,
        BinaryOp::Equal,
        BinaryOp::NotEqual,
        BinaryOp::And,
        BinaryOp::Or,
        BinaryOp::Crosses,
        BinaryOp::Rises,
        BinaryOp::Falls,
    ];
    ALL.into_iter().find(|operator| operator.text() == text).expect("the grammar knows no other operator")
}

fn declaration_kind(pair: &Pair<Rule>) -> DeclarationKind {
    let word = pair.clone().into_inner().next().expect("a declaration begins with its kind");
    match word.as_rule() {
        Rule::kw_param => DeclarationKind::Param,
        Rule::kw_input => DeclarationKind::Input,
        Rule::kw_output => DeclarationKind::Output,
        Rule::kw_state => DeclarationKind::State,
        _ => DeclarationKind::Let,
    }
}

/// A description of a rule for messages, if there is a helpful one.
fn words(rule: Rule) -> Option<String> {
    if rule == Rule::kw_rotary {
        return Some("a model with its arguments, such as `LuGre()`".to_string());
    }
    let sign = match rule {
        Rule::open => "(",
        Rule::close => ")",
        Rule::comma => ",",
        Rule::dots => "..",
        Rule::colon => ":",
        Rule::near => "~=",
        Rule::margin => "+-",
        _ => "",
    };
    if is_fixed(rule) {
        let name = format!("{rule:?}");
        return Some(format!("`{}`", name.strip_prefix("kw_").unwrap_or(sign)));
    }
    let word = match rule {
        Rule::expr
        | Rule::atom
        | Rule::call
        | Rule::called
        | Rule::window
        | Rule::quantity
        | Rule::path
        | Rule::hole
        | Rule::ratio
        | Rule::number
        | Rule::conditional
        | Rule::group
        | Rule::neg => "a value",
        Rule::infix | Rule::logic => "an operator",
        Rule::ident | Rule::module => "a name",
        Rule::upper_ident => slips::CAPITAL,
        Rule::lint_name => "the name of a warning",
        Rule::string => "a text in quotes",
        Rule::eq => "`=`",
        Rule::unit_decl => "a unit in brackets",
        Rule::unit | Rule::one => "a unit",
        Rule::range => "a range with `in`",
        Rule::bound | Rule::bound_op => "a bound such as `> 0`",
        Rule::inst | Rule::inst_arg => "a model with its arguments, such as `LuGre()`",
        Rule::bind | Rule::drive_arg | Rule::set | Rule::one_case => "`name = value`",
        Rule::points => "points in braces",
        Rule::fn_arg | Rule::column => "a name",
        Rule::EOI => "the next statement",
        _ => return None,
    };
    Some(word.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether `rule` matches all of `text`.
    fn takes(rule: Rule, text: &str) -> bool {
        Fric::parse(rule, text).is_ok_and(|mut pairs| pairs.next().is_none_or(|pair| pair.as_str() == text))
    }

    fn rule(name: &str) -> Rule {
        let found = Rule::all_rules().iter().find(|rule| format!("{rule:?}") == name);
        *found.unwrap_or_else(|| panic!("no rule {name}"))
    }

    /// The grammar spells its keywords by their first letters. Checks that it accepts no word beyond the lists: neither
    /// words that differ from a listed one only in their last letters, nor any run of letters in the grammar.
    #[test]
    fn the_word_lists_agree_with_the_grammar() {
        use crate::tokens::{CONTEXT_WORDS, KEYWORDS, is_context_word, is_keyword};
        let pieces = include_str!("../fric.pest").split(|c: char| !c.is_ascii_lowercase());
        let mut words: HashSet<String> = pieces.map(str::to_string).collect();
        for word in KEYWORDS.iter().chain(&CONTEXT_WORDS) {
            let letters = (b'a'..=b'z').map(char::from);
            words.extend(
                (1..word.len()).flat_map(|end| letters.clone().map(move |last| format!("{}{last}", &word[..end]))),
            );
            words.insert(format!("{word}x"));
        }
        for word in words.iter().filter(|word| !word.is_empty()) {
            let taken = (takes(Rule::keyword, word), takes(Rule::context_kw, word), takes(Rule::ident, word));
            assert_eq!(taken, (is_keyword(word), is_context_word(word), !is_keyword(word)), "{word}");
            assert!(!is_context_word(word) || !takes(Rule::unit, word), "{word} as a unit");
        }
    }

    #[test]
    fn rules_accept_their_ok_lines_and_reject_their_no_lines() {
        let (mut cases, mut count) = (Vec::new(), 0);
        for line in include_str!("../fric.pest").lines() {
            if let Some(text) = line.strip_prefix("// ok: ") {
                cases.push((text, true));
            } else if let Some(text) = line.strip_prefix("// no: ") {
                cases.push((text, false));
            } else if !line.starts_with("//") {
                for (text, wanted) in cases.drain(..) {
                    let name = line.split(' ').next().unwrap_or("");
                    assert_eq!(takes(rule(name), text), wanted, "{name}: {text}");
                    count += 1;
                }
            }
        }
        assert!(cases.is_empty() && count > 80, "{count} lines");
    }

    #[test]
    fn keywords_and_symbols_are_the_last_rules() {
        const SIGNS: [&str; 7] = ["open", "close", "comma", "dots", "colon", "near", "margin"];
        for rule in Rule::all_rules() {
            let name = format!("{rule:?}");
            assert_eq!(is_fixed(*rule), name.starts_with("kw_") || SIGNS.contains(&name.as_str()), "{name}");
        }
    }

    #[test]
    fn the_whole_file_rule_accepts_the_samples() {
        for entry in std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data")).unwrap() {
            let path = entry.unwrap().path();
            if path.is_file() {
                let text = std::fs::read_to_string(&path).unwrap();
                if let Err(error) = Fric::parse(Rule::file, &text) {
                    panic!("{}: {error}", path.display());
                }
            }
        }
    }
}
