//! Hash maps and sets whose order is the same in every run, and whose hash of a small key is one multiplication.
//!
//! The keys are numbers of values, slots and expressions, and names of texts whose length is bounded; nobody gains by
//! making them collide. With the hash of the standard library a tenth of the time of compilation is hashing.

/// A map.
pub type HashMap<K, V> = rustc_hash::FxHashMap<K, V>;
/// A set.
pub type HashSet<K> = rustc_hash::FxHashSet<K>;
/// Makes the hash of a single value.
pub type Hasher = rustc_hash::FxBuildHasher;
