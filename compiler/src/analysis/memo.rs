//! Memoisation of expensive results about programs, for the lifetime of the process: after an edit, a check recomputes
//! only results for programs that changed.
//!
//! In: a program and the other values on which the result depends. Out: the result, computed or cached; the same either
//! way.

use crate::ir::hash::HashMap;
use crate::ir::program::Program;
use std::collections::hash_map::DefaultHasher;
use std::hash::{Hash, Hasher};
use std::sync::Mutex;

/// Capacity; when it is exceeded, the memo is cleared.
const MOST: usize = 1024;

/// Memo of one kind of result about programs.
pub struct Memo<T>(Mutex<Option<HashMap<u64, T>>>);

impl<T: Clone> Memo<T> {
    /// An empty memo.
    pub const fn new() -> Memo<T> {
        Memo(Mutex::new(None))
    }

    /// The result for a program, from the memo if it is known. `also`: other values on which it depends.
    pub fn answer(&self, program: &Program, also: &[u64], compute: impl FnOnce() -> T) -> T {
        self.known_or(key(program, also), compute)
    }

    /// The same for a result that depends on the functions of a program and not on the values of its parameters.
    pub fn of_functions(&self, program: &Program, also: &[u64], compute: impl FnOnce() -> T) -> T {
        let mut hasher = DefaultHasher::new();
        functions(program, &mut hasher);
        also.hash(&mut hasher);
        self.known_or(hasher.finish(), compute)
    }

    fn known_or(&self, key: u64, compute: impl FnOnce() -> T) -> T {
        let known = |answers: &Option<HashMap<u64, T>>| answers.as_ref()?.get(&key).cloned();
        // A panic in another thread leaves the map consistent, so a poisoned lock can be used.
        let lock = || self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(known) = known(&lock()) {
            return known;
        }
        let answer = compute();
        let mut guard = lock();
        let answers = guard.get_or_insert_default();
        if answers.len() >= MOST {
            answers.clear();
        }
        answers.insert(key, answer.clone());
        answer
    }
}

impl<T: Clone> Default for Memo<T> {
    fn default() -> Memo<T> {
        Memo::new()
    }
}

/// A hash of everything that a program computes: its functions, its numbers by their bits, its ranges.
fn key(program: &Program, also: &[u64]) -> u64 {
    let mut hasher = DefaultHasher::new();
    functions(program, &mut hasher);
    program.params.iter().for_each(|number| number.to_bits().hash(&mut hasher));
    for quantity in &program.description.quantities {
        (&quantity.path, quantity.range.0.to_bits(), quantity.range.1.to_bits()).hash(&mut hasher);
    }
    also.hash(&mut hasher);
    hasher.finish()
}

/// Hashes the functions of a program, with the places of what they read and write.
fn functions(program: &Program, hasher: &mut DefaultHasher) {
    let functions = [&program.start, &program.outputs, &program.derivatives];
    (functions, &program.tick, &program.transitions).hash(hasher);
    program.description.pool.iter().for_each(|number| number.to_bits().hash(hasher));
    let layout = &program.description.layout;
    (layout.states.range(), layout.derivatives.range(), layout.size()).hash(hasher);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_result_is_computed_once() {
        let answers = Memo::new();
        let program = Program::default();
        let other = Program { params: vec![1.0], ..Program::default() };
        let mut asked = 0;
        for (program, also) in [(&program, 1), (&program, 1), (&program, 2), (&other, 1), (&program, 1)] {
            answers.answer(program, &[also], || asked += 1);
        }
        assert_eq!(asked, 3);
        // What depends on functions alone is the same for all values.
        let mut asked = 0;
        for (program, also) in [(&program, 1), (&other, 1), (&program, 2), (&other, 2)] {
            answers.of_functions(program, &[also, 7], || asked += 1);
        }
        assert_eq!(asked, 2);
    }
}
