//! A queue between two threads that never waits, neither allocates nor locks: how the cycle hears and is heard.
//!
//! In and out: small values. Full is an answer, not a reason to wait.

use rtrb::{Consumer, Producer, RingBuffer};

/// The end into which values go.
pub struct Sender<T>(Producer<T>);

/// The end out of which they come.
pub struct Receiver<T>(Consumer<T>);

/// A queue for so many values.
pub fn queue<T: Copy>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let (sender, receiver) = RingBuffer::new(capacity);
    (Sender(sender), Receiver(receiver))
}

impl<T: Copy> Sender<T> {
    /// Places that are free.
    pub fn free(&self) -> usize {
        self.0.slots()
    }

    /// Whether nobody will take anything any more.
    pub fn is_abandoned(&self) -> bool {
        self.0.is_abandoned()
    }

    /// Hands a value over; false if there is no place for it.
    pub fn push(&mut self, value: T) -> bool {
        self.0.push(value).is_ok()
    }

    /// Hands all of them over, or none: false if there is no place for all.
    pub fn push_all(&mut self, values: &[T]) -> bool {
        self.0.push_entire_slice(values).is_ok()
    }
}

impl<T: Copy> Receiver<T> {
    /// Values that wait.
    pub fn len(&self) -> usize {
        self.0.slots()
    }

    /// Whether none waits.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The first of them, which stays.
    pub fn first(&self) -> Option<T> {
        self.0.peek().ok().copied()
    }

    /// The first of them.
    pub fn pop(&mut self) -> Option<T> {
        self.0.pop().ok()
    }

    /// Appends the first `n` to `out`; false if fewer wait.
    pub fn take(&mut self, n: usize, out: &mut Vec<T>) -> bool {
        let Ok(chunk) = self.0.read_chunk(n) else { return false };
        out.extend(chunk);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_goes_in_comes_out_in_order_and_full_is_an_answer() {
        let (mut sender, mut receiver) = queue(3);
        assert!(sender.push(1) && sender.push_all(&[2, 3]));
        assert!(!sender.push(4) && !sender.push_all(&[4]));
        assert_eq!((receiver.len(), receiver.first(), receiver.pop()), (3, Some(1), Some(1)));
        let mut out = Vec::new();
        assert!(!receiver.take(3, &mut out) && receiver.take(2, &mut out));
        assert_eq!((out, receiver.pop(), sender.free()), (vec![2, 3], None, 3));
        assert!(receiver.is_empty());
    }
}
