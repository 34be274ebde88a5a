//! Maps and sets of the values of one function, without hashing.
//!
//! A map has an entry for every value of the function, so it is made once for many small uses and cleared in between:
//! that costs as much as was inserted.

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
