//! A bounded, wait-free queue from one thread to another (SPSC). It neither blocks, allocates nor locks, so the
//! real-time cycle can use it.
//!
//! In and out: small values. A full queue is reported to the sender, which decides what to drop.

use rtrb::{Consumer, Producer, RingBuffer};

/// The sending end.
pub struct Sender<T>(Producer<T>);

/// The receiving end.
pub struct Receiver<T>(Consumer<T>);

/// A queue with room for `capacity` values.
pub fn queue<T: Copy>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let (sender, receiver) = RingBuffer::new(capacity);
    (Sender(sender), Receiver(receiver))
}

impl<T: Copy> Sender<T> {
    /// Number of free places.
    pub fn free(&self) -> usize {
        self.0.slots()
    }

    /// Whether the receiver has been dropped.
    pub fn is_abandoned(&self) -> bool {
        self.0.is_abandoned()
    }

    /// Sends a value; false if the queue is full.
    pub fn push(&mut self, value: T) -> bool {
        self.0.push(value).is_ok()
    }

    /// Sends all values or none; false if there is not room for all.
    pub fn push_all(&mut self, values: &[T]) -> bool {
        self.0.push_entire_slice(values).is_ok()
    }
}

impl<T: Copy> Receiver<T> {
    /// Number of values waiting.
    pub fn len(&self) -> usize {
        self.0.slots()
    }

    /// Whether no value is waiting.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The first value waiting, without removing it.
    pub fn first(&self) -> Option<T> {
        self.0.peek().ok().copied()
    }

    /// Removes and returns the first value waiting.
    pub fn pop(&mut self) -> Option<T> {
        self.0.pop().ok()
    }

    /// Moves the first `n` values to the end of `out`; false, moving none, if fewer are waiting.
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
    fn values_arrive_in_order_and_a_full_queue_is_reported() {
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
