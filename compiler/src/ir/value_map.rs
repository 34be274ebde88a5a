//! Maps and sets of the values of one function, without hashing.
//!
//! A map has an entry for every value of the function, so it is made once for many small uses and cleared in between:
//! that costs as much as was inserted. [`Bits`] are for data-flow equations, whose sets are copied for each block and
//! joined at each edge.

use super::Value;

/// A map from values.
pub struct ValueMap<T> {
    entries: Vec<Option<T>>,
    keys: Vec<Value>,
}

/// A set of values.
pub type ValueSet = ValueMap<()>;

impl<T: Copy> ValueMap<T> {
    /// An empty map for the values of a function with so many operations.
    pub fn new(operations: usize) -> ValueMap<T> {
        ValueMap { entries: vec![None; operations], keys: Vec::new() }
    }

    /// Inserts or replaces an entry; whether the value had none.
    pub fn insert(&mut self, value: Value, entry: T) -> bool {
        let is_new = self.entries[value.index()].replace(entry).is_none();
        if is_new {
            self.keys.push(value);
        }
        is_new
    }

    /// The entry of a value.
    pub fn get(&self, value: Value) -> Option<T> {
        self.entries[value.index()]
    }

    /// Whether a value has an entry.
    pub fn contains(&self, value: Value) -> bool {
        self.entries[value.index()].is_some()
    }

    /// The values that have entries, in the order in which they came.
    pub fn keys(&self) -> &[Value] {
        &self.keys
    }

    /// Removes all entries.
    pub fn clear(&mut self) {
        self.keys.drain(..).for_each(|value| self.entries[value.index()] = None);
    }
}

impl ValueSet {
    /// A set of these values of a function with so many operations.
    pub fn of(operations: usize, values: impl IntoIterator<Item = Value>) -> ValueSet {
        let mut set = ValueSet::new(operations);
        set.add(values);
        set
    }

    /// Inserts values.
    pub fn add(&mut self, values: impl IntoIterator<Item = Value>) {
        values.into_iter().for_each(|value| _ = self.insert(value, ()));
    }
}

/// A set of numbers below a bound, a bit for each. Sets that are joined have the same bound.
#[derive(Clone)]
pub struct Bits(Vec<u64>);

impl Bits {
    /// The empty set of numbers below a bound.
    pub fn new(bound: usize) -> Bits {
        Bits(vec![0; bound.div_ceil(64)])
    }

    /// Inserts a number below the bound.
    pub fn insert(&mut self, number: usize) {
        self.0[number / 64] |= 1 << (number % 64);
    }

    /// Whether a number, of any size, is a member.
    pub fn contains(&self, number: usize) -> bool {
        self.0.get(number / 64).is_some_and(|word| word >> (number % 64) & 1 != 0)
    }

    /// Removes all members that another set lacks. Returns whether this set has changed.
    pub fn intersect(&mut self, other: &Bits) -> bool {
        self.update(other, |word, other| word & other)
    }

    /// Inserts the members of another set. Returns whether this set has changed.
    pub fn unite(&mut self, other: &Bits) -> bool {
        self.update(other, |word, other| word | other)
    }

    /// Removes the members of another set. Returns whether this set has changed.
    pub fn subtract(&mut self, other: &Bits) -> bool {
        self.update(other, |word, other| word & !other)
    }

    fn update(&mut self, other: &Bits, joined: fn(u64, u64) -> u64) -> bool {
        let words = self.0.iter_mut().zip(&other.0);
        words.fold(false, |changed, (word, other)| {
            let new = joined(*word, *other);
            std::mem::replace(word, new) != new || changed
        })
    }
}
