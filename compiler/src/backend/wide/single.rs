//! A single step of one instance in registers, without a frame.
//!
//! In: an expanded step. Out: [`Single`], for steps of which each way through is short.
//!
//! ```text
//! if the count is not 1 and that is asked: go on to the others
//! questions, each as soon as what it compares is there; where a regime changes: go on behind all else
//! then, for each end of its own: everything; what registers have no room for and the step does not read is stored
//! if something fails: go on to the others
//! what it reads is stored, then the rest; return 0
//! ```
//! The others are code for any count. They do the step again, in full and with its status: what it reads is as it was. Where who
//! calls sees to that and nothing of it is stored, what the last question asks for is returned.

use super::body::{Body, Held, Home};
use super::encode::{Assembler, Base, Vectors, instructions};
use super::order::order;
use super::select::{Node, Nodes, Operations, Predicate, SIGN, What, operations};
use crate::backend::prepared::Called;
use crate::backend::unsupported::Unsupported;
use crate::backend::ways::{Way, ways};
use crate::ir::{Func, Op, Value, Write, number_asked};
use abi::Slot;
use std::collections::{HashMap, HashSet};

/// Code with the signature of [`abi::table::Entry`], but for its jumps to the others.
pub struct Single {
    /// Instructions, and constants behind them: to lie at a multiple of 64.
    pub code: Vec<u8>,
    /// Bytes of the instructions.
    pub len: usize,
    /// Where the distances to the others stand, of 32 bits from the end of each.
    pub to_others: Vec<usize>,
}

/// Most operations of a function of which this is tried.
const LARGEST: usize = 250;
/// Most instructions of a way, both sides of each choice counted: of longer ones a jump over a side is worth more.
const LONGEST: usize = 100;
/// Most ways from where a regime changes that stand among the others.
const MOST_AMONG: usize = 8;
/// Most numbers that lie in registers to the end, so that others have room.
const MOST_KEPT: usize = 12;

/// `called`: for how many steps. `read`: what the others read. `avx512`: whether the processor has AVX-512 F and DQ. `rests`:
/// whether a slot was written long before, so that it is read together with the next.
///
/// # Errors
/// If a step is too long, or needs what there are no instructions for: another way is better, or the only one.
pub fn single(
    func: &Func,
    called: Called,
    read: &[Slot],
    avx512: bool,
    rests: impl Fn(Slot) -> bool,
) -> Result<Single, Unsupported> {
    let unsuitable = |what: &str| Unsupported(format!("`{}` {what}", func.name));
    if !may_be(func) {
        return Err(unsuitable("is too long"));
    }
    // Whether there are instructions is known before the ways.
    operations(func, avx512, &func.live(), &func.writes)?;
    let ways = ways(func).ok_or_else(|| unsuitable("has too many ways"))?;
    let mut written = Vec::new();
    ways.begin.each(&mut |way| {
        if let Way::Ends { writes, .. } = way {
            written.extend(writes);
        }
    });
    let Operations { mut nodes, of, indices } =
        operations(&ways.func, avx512, &wanted(&ways.func, &ways.begin), &written)?;
    let indices = written.iter().map(|write| (write.index, write.len)).zip(indices).collect();
    let place = |(number, node): (u32, &What)| match node {
        What::Load(slot) => Some((Node(number), home(*slot))),
        What::Number(entry) => Some((Node(number), Home { base: Base::Pool, begin: 0, index: *entry as usize })),
        _ => None,
    };
    let homes = (0..).zip(&nodes.nodes).filter_map(place).collect();
    let mut to_ends = Vec::new();
    each_to_end(&ways.begin, &mut Vec::new(), &mut |reads| {
        to_ends.push(nodes.needed(reads.iter().map(|value| of[value.index()])));
    });
    nodes.load_pairs(rests, &to_ends);
    let mut code = Assembler::new(Vectors::One);
    let mut to_others = Vec::new();
    if called == Called::Any {
        code.plain(&[0x48, 0x83, 0xfa, 1]); // cmp rdx, 1
        to_others.push(code.jump(&[0x0f, 0x85])); // jne
    }
    let (func, nodes) = (&ways.func, &nodes);
    let mut changes = 0;
    ways.begin.each(&mut |way| changes += usize::from(matches!(way, Way::Changes(_))));
    let (in_rax, is_crowded, is_within, aside) = (None, changes > MOST_AMONG, false, Vec::new());
    // While it divides, the processor goes ahead as far as it can keep track of what it reads. With AVX-512 it keeps track of more.
    let makes = !avx512 && matches!(ways.begin, Way::Ends { .. });
    let mut writer = Writer {
        code,
        func,
        nodes,
        of,
        indices,
        homes,
        read,
        to_others,
        in_rax,
        is_crowded,
        called,
        makes,
        is_within,
        aside,
    };
    writer
        .way(&ways.begin, &vec![false; nodes.nodes.len()], &Held::default())
        .ok_or_else(|| unsuitable("is too long"))?;
    while let Some(Aside { jumps, way, there, held }) = writer.aside.pop() {
        (writer.in_rax, writer.is_within) = (None, false);
        writer.arrive(jumps, way, &there, &held).ok_or_else(|| unsuitable("is too long"))?;
    }
    let len = writer.code.here();
    Ok(Single { code: writer.code.finish(), len, to_others: writer.to_others })
}

/// Whether a step is short enough for this to be tried.
pub fn may_be(func: &Func) -> bool {
    func.ops.len() <= LARGEST
}

/// Where a slot lies.
fn home(slot: Slot) -> Home {
    Home { base: Base::Block, begin: 0, index: slot.index() }
}

/// The operations that some way needs.
fn wanted(func: &Func, begin: &Way) -> Vec<bool> {
    let mut reads = Vec::new();
    begin.each(&mut |way| reads.extend(way.reads()));
    func.live_for(reads.into_iter())
}

/// What is read on each usual way from the beginning to an end, behind what was `read` before.
fn each_to_end(way: &Way, read: &mut Vec<Value>, each: &mut impl FnMut(&[Value])) {
    let before = read.len();
    read.extend(way.reads());
    match way {
        Way::Ends { .. } => each(read),
        Way::Asks(_, sides) => sides.iter().for_each(|side| each_to_end(side, read, each)),
        Way::Changes(_) | Way::Leaves => {}
    }
    read.truncate(before);
}

struct Writer<'a> {
    code: Assembler,
    func: &'a Func,
    nodes: &'a Nodes,
    /// Of each operation.
    of: Vec<Node>,
    /// Of each index of a ring of so many slots, held inside.
    indices: HashMap<(Value, u32), Node>,
    homes: HashMap<Node, Home>,
    /// What the others read.
    read: &'a [Slot],
    to_others: Vec<usize>,
    /// The number of the block that rax holds.
    in_rax: Option<Slot>,
    /// Whether what is rare is so much that it comes behind all else.
    is_crowded: bool,
    called: Called,
    /// Whether constants are made where the processor divides meanwhile.
    makes: bool,
    /// Whether a question has been answered with yes to which no was usual, too.
    is_within: bool,
    /// What comes behind all else.
    aside: Vec<Aside<'a>>,
}

/// A way that is still to be written, and what it finds.
struct Aside<'a> {
    jumps: Vec<usize>,
    way: &'a Way,
    there: Vec<bool>,
    held: Held,
}

impl<'a> Writer<'a> {
    fn at(&self, value: Value) -> Node {
        self.of[value.index()]
    }

    fn index(&self, write: &Write) -> Node {
        self.indices[&(write.index, write.len)]
    }

    /// Writes one way from where some nodes are there; none if it is too long.
    fn way(&mut self, way: &'a Way, there: &[bool], held: &Held) -> Option<()> {
        match way {
            Way::Ends { stores, writes, failed } => self.end(stores, writes, *failed, there, held),
            Way::Asks(asked, sides) => self.question(*asked, sides, there, held),
            Way::Changes(rest) => self.way(rest, there, held),
            Way::Leaves => {
                let jump = self.code.jump(&[0xe9]);
                self.to_others.push(jump);
                Some(())
            }
        }
    }

    fn question(&mut self, asked: Value, sides: &'a [Way; 2], there: &[bool], held: &Held) -> Option<()> {
        let (holds, a, b) = match self.func.op(asked) {
            Op::Less(a, b) => (Predicate::Less, a, b),
            Op::LessEqual(a, b) => (Predicate::LessEqual, a, b),
            Op::Equal(a, b) => (Predicate::Equal, a, b),
            _ => unreachable!("it is a comparison of reals"),
        };
        let number = self.number_asked(asked);
        let compared = if number.is_some() { Vec::new() } else { vec![self.at(a), self.at(b)] };
        let order = self.order(&compared, there);
        let mut there = there.to_vec();
        order.iter().for_each(|node| there[node.index()] = true);
        let later = self.later(sides, &there);
        let begin = |body: &mut Body| {
            compared.iter().for_each(|node| body.keep_asked(*node));
            later.iter().for_each(|node| body.keep(*node));
            body.resume(held);
        };
        let mut body = line(&mut self.code, self.nodes, &order, &self.homes, &begin, (&|_| Vec::new(), &[]));
        // The usual side follows. Where all but the last of several questions that must hold do, the last does as a rule.
        let changes = self.is_within && matches!(sides[0], Way::Changes(_));
        let next = if holds == Predicate::Equal || changes { 0 } else { Way::usual(sides) };
        let other = 1 - next;
        let jumps = match number {
            None => body.ask(if next == 0 { holds.not() } else { holds }, compared[0], compared[1]),
            Some(_) => Vec::new(),
        };
        let (held, spilled) = (body.held(), body.spilled());
        let jumps = number.map_or(jumps, |(slot, bits)| vec![self.unless(slot, bits, &sides[1])]);
        if spilled > 0 {
            return None;
        }
        let is_within = number.is_none() && !sides[1].is_rare();
        let in_rax = self.in_rax;
        self.is_within = is_within && next == 0;
        self.way(&sides[next], &there, &held)?;
        self.in_rax = in_rax;
        self.is_within = is_within && other == 0;
        match &sides[other] {
            Way::Leaves => {
                self.to_others.extend(jumps);
                Some(())
            }
            Way::Changes(rest) if self.is_crowded => {
                self.aside.push(Aside { jumps, way: rest, there, held });
                Some(())
            }
            other => self.arrive(jumps, other, &there, &held),
        }
    }

    /// A jump that is taken, to a way, if a number of the block is not this one, which is no NaN. Integers answer that sooner than
    /// reals, whose comparison may find that there is no order.
    fn unless(&mut self, slot: Slot, bits: u64, to: &Way) -> usize {
        let offset = 8 * slot.0 as i32;
        if self.in_rax != Some(slot) {
            self.code.bring_number(offset);
        }
        // Where nothing but its other numbers is asked next, a −0 is left to others in the end.
        if bits == 0 && self.only_asks(to, slot) {
            self.in_rax = Some(slot);
            return self.code.unless_clear();
        }
        self.in_rax = (f64::from_bits(bits) != 0.0).then_some(slot);
        self.code.unless_number(bits)
    }

    /// Whether a way asks for other numbers of a slot of the block until it leaves.
    fn only_asks(&self, way: &Way, slot: Slot) -> bool {
        match way {
            Way::Asks(asked, sides) => {
                self.number_asked(*asked).is_some_and(|(of, _)| of == slot) && self.only_asks(&sides[1], slot)
            }
            way => matches!(way, Way::Leaves),
        }
    }

    /// Writes one way that some jumps lead to.
    fn arrive(&mut self, jumps: Vec<usize>, way: &'a Way, there: &[bool], held: &Held) -> Option<()> {
        let here = self.code.here();
        jumps.into_iter().for_each(|jump| self.code.lead(jump, here));
        self.way(way, there, held)
    }

    /// The slot and the bits, if it is asked whether a number of the block is a constant, as of regimes.
    fn number_asked(&self, asked: Value) -> Option<(Slot, u64)> {
        let (_, slot, bits) = number_asked(self.func.op(asked), |value| self.func.op(value))?;
        (!f64::from_bits(bits).is_nan()).then_some((slot, bits))
    }

    fn end(
        &mut self,
        stores: &[(Slot, Value)],
        writes: &[Write],
        failed: Option<Value>,
        there: &[bool],
        held: &Held,
    ) -> Option<()> {
        let stores = stores.iter().map(|(slot, value)| (*slot, self.at(*value)));
        let (mut late, mut early): (Vec<_>, Vec<_>) = stores.partition(|(slot, _)| self.read.contains(slot));
        let writes: Vec<(Slot, Node, Node)> =
            writes.iter().map(|write| (write.base, self.index(write), self.at(write.value))).collect();
        let mut questions = failed.map_or_else(Vec::new, |failed| questions(self.nodes, self.at(failed)));
        // What the last of them leaves behind is returned. That is all if the step can be told or made again then, and if there is
        // one only, its answer is.
        let of_number = matches!(questions.last(), Some(Question::Nothing(_)));
        let tells = writes.is_empty()
            && match self.called {
                Called::OneOrTold => of_number || questions.len() == 1,
                Called::OneOrAgain => of_number && late.is_empty(),
                Called::Any | Called::One => false,
            };
        let returns = tells || writes.is_empty() && of_number;
        let asked = questions.iter().flat_map(Question::operands);
        let written = writes.iter().flat_map(|(_, index, value)| [*index, *value]);
        let mut kept: Vec<Node> = asked.chain(written).chain(late.iter().map(|(_, node)| *node)).collect();
        if kept.len() > MOST_KEPT {
            return None;
        }
        // The next step waits for what it reads: that is stored before all else, if there is room for the rest until then.
        if !late.is_empty() && kept.len() + early.len() <= MOST_KEPT {
            kept.extend(early.iter().map(|(_, node)| *node));
            late.append(&mut early);
        }
        let late: Vec<(Node, Home)> = late.into_iter().map(|(slot, node)| (node, home(slot))).collect();
        let early_nodes: Vec<Node> = early.iter().map(|(_, node)| *node).collect();
        let roots: Vec<Node> = kept.iter().chain(&early_nodes).copied().collect();
        let order = self.order(&roots, there);
        if order.len() > LONGEST {
            return None;
        }
        let makes = self.makes && order.iter().any(|node| self.nodes.nodes[node.index()].divides());
        let lies = |node: &&Node| there[node.index()] || self.nodes.nodes[node.index()].is_leaf();
        let begin = |body: &mut Body| {
            if makes {
                body.make_constants();
            }
            kept.iter().for_each(|node| body.keep(*node));
            early_nodes.iter().filter(lies).for_each(|node| body.keep(*node));
            body.resume(held);
        };
        let to_block =
            |node: Node| early.iter().filter(|(_, value)| *value == node).map(|(slot, _)| home(*slot)).collect();
        let stores = (&to_block as &dyn Fn(Node) -> Vec<Home>, &early_nodes[..]);
        let mut body = line(&mut self.code, self.nodes, &order, &self.homes, &begin, stores);
        let told = if tells { questions.pop() } else { None };
        for question in questions {
            match question {
                Question::Compare(predicate, a, b) => self.to_others.extend(body.ask(predicate, a, b)),
                Question::Beyond(number, bits) => self.to_others.push(body.unless_at_most(number, bits)),
                Question::Nothing(number) => self.to_others.push(body.unless_zero(number)),
                Question::Mask(mask) => self.to_others.push(body.test(mask)),
            }
        }
        body.store_kept(&late, &writes);
        match told {
            Some(Question::Compare(predicate, a, b)) => body.answer(predicate, a, b),
            Some(Question::Beyond(number, bits)) => body.answer_at_most(number, bits),
            Some(Question::Nothing(number) | Question::Mask(number)) => body.bits(number),
            None => {}
        }
        let fits = body.spilled() == 0;
        if !returns {
            self.code.plain(&[0x31, 0xc0]); // xor eax, eax
        }
        self.code.plain(&[0xc3]); // ret
        fits.then_some(())
    }

    /// What roots need that is not there.
    fn order(&self, roots: &[Node], there: &[bool]) -> Vec<Node> {
        let wanted: Vec<bool> = there.iter().map(|there| !there).collect();
        order(self.nodes, roots, &wanted)
    }

    /// What is there, or lies in memory from the beginning, and one of several ways reads.
    fn later(&self, ways: &[Way], there: &[bool]) -> Vec<Node> {
        let mut roots = Vec::new();
        for way in ways {
            way.each(&mut |way| {
                roots.extend(way.reads().map(|value| self.at(value)));
                if let Way::Ends { writes, .. } = way {
                    roots.extend(writes.iter().map(|write| self.index(write)));
                }
            });
        }
        let (mut seen, mut later) = (HashSet::new(), Vec::new());
        while let Some(node) = roots.pop() {
            if !seen.insert(node) {
                continue;
            }
            if there[node.index()] || self.nodes.nodes[node.index()].is_leaf() {
                later.push(node);
            } else {
                roots.extend(self.nodes.nodes[node.index()].operands());
            }
        }
        later
    }
}

/// Writes a line of single numbers; `begin` tells what is kept and held, `stores` and `rest` are those of [`Body::write`]. It is
/// written twice, the first time to see what it loads: an operation that waits for its own load waits longer than one whose
/// load stands some operations before.
fn line<'a>(
    code: &'a mut Assembler,
    nodes: &'a Nodes,
    order: &'a [Node],
    homes: &'a HashMap<Node, Home>,
    begin: &dyn Fn(&mut Body),
    (stores, rest): (&dyn Fn(Node) -> Vec<Home>, &[Node]),
) -> Body<'a> {
    let mut scratch = Assembler::new(Vectors::One);
    let mut trial = Body::new(&mut scratch, nodes, order, homes, Vectors::One, 1, 0);
    begin(&mut trial);
    trial.write(stores, rest);
    let loads = trial.loads();
    let mut body = Body::new(code, nodes, order, homes, Vectors::One, 1, 0);
    begin(&mut body);
    body.load_sooner(loads);
    body.write(stores, rest);
    body
}

/// What ends a step with a status.
enum Question {
    /// Whether numbers are in an order.
    Compare(Predicate, Node, Node),
    /// Whether a number less itself is not 0: then it is NaN. Integers answer that, and the answer is the status too.
    Nothing(Node),
    /// Whether a number that is not below 0, or NaN, is not at most one of these bits: integers answer that, too.
    Beyond(Node, u64),
    /// Whether a mask is set.
    Mask(Node),
}

impl Question {
    fn operands(&self) -> Vec<Node> {
        match self {
            Question::Compare(_, a, b) => vec![*a, *b],
            Question::Nothing(node) | Question::Beyond(node, _) | Question::Mask(node) => vec![*node],
        }
    }
}

/// One of them suffices. Whether all is finite comes last, since what answers that is the status.
fn questions(nodes: &Nodes, failed: Node) -> Vec<Question> {
    let mut open = vec![failed];
    let mut questions = Vec::new();
    while let Some(node) = open.pop() {
        match nodes.nodes[node.index()] {
            What::Two(instructions::OR, _, a, b) => open.extend([a, b]),
            What::Compare(Predicate::NotLessEqual, a, b) if a == b && is_nothing(nodes, a) => {
                questions.push(Question::Nothing(a))
            }
            What::Compare(Predicate::NotLessEqual, a, b)
                if let (true, What::Constant(bits)) = (is_size(nodes, a), nodes.nodes[b.index()])
                    && bits <= f64::INFINITY.to_bits() =>
            {
                questions.push(Question::Beyond(a, bits));
            }
            What::Compare(predicate, a, b) if predicate.is_of_order() => {
                questions.push(Question::Compare(predicate, a, b));
            }
            _ => questions.push(Question::Mask(node)),
        }
    }
    questions.sort_by_key(|question| matches!(question, Question::Nothing(_)));
    questions
}

/// Whether a node is a number less itself: +0 or NaN.
fn is_nothing(nodes: &Nodes, node: Node) -> bool {
    matches!(nodes.nodes[node.index()], What::Two(instructions::SUB, _, a, b) if a == b)
}

/// Whether a node is +0, above it or NaN.
fn is_size(nodes: &Nodes, node: Node) -> bool {
    match nodes.nodes[node.index()] {
        What::Two(instructions::SIZE, ..) => true,
        What::Two(instructions::AND, _, a, b) => {
            [a, b].iter().any(|part| nodes.nodes[part.index()] == What::Constant(!SIGN))
        }
        What::Two(instructions::ADD | instructions::MAX, _, a, b) => is_size(nodes, a) && is_size(nodes, b),
        _ => is_nothing(nodes, node),
    }
}
