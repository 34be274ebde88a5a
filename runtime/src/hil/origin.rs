//! Who gave a command to a rig.
//!
//! In: who spoke. Out: a number for queues, logs and flags, and words for people.

use std::fmt;

/// A page of a panel.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Seat {
    /// Its panel, from 1; 0 where a rig can have only one.
    pub panel: u16,
    /// The number of the page there, from 1.
    pub page: u32,
}

impl fmt::Display for Seat {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.panel {
            0 => write!(f, "page {}", self.page),
            panel => write!(f, "page {} of panel {panel}", self.page),
        }
    }
}

/// Who gave a command.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub enum Origin {
    /// The program itself, by its options: it arms, and its time is over.
    #[default]
    Program,
    /// A line that was typed.
    Prompt,
    /// `fric-rig say`.
    Say,
    /// A signal, such as Ctrl-C.
    Signal,
    /// A page of a panel.
    Page(Seat),
}

impl Origin {
    /// As a number that is not 0.
    pub fn number(self) -> u64 {
        match self {
            Origin::Program => 1,
            Origin::Prompt => 2,
            Origin::Say => 3,
            Origin::Signal => 4,
            Origin::Page(Seat { panel, page }) => 5 | u64::from(panel) << 16 | u64::from(page) << 32,
        }
    }

    /// The one of a number; none if it is of none.
    pub fn of(number: u64) -> Option<Origin> {
        let origin = match number & 0xffff {
            1 => Origin::Program,
            2 => Origin::Prompt,
            3 => Origin::Say,
            4 => Origin::Signal,
            5 => Origin::Page(Seat { panel: (number >> 16) as u16, page: (number >> 32) as u32 }),
            _ => return None,
        };
        (origin.number() == number).then_some(origin)
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Origin::Program => f.write_str("the program"),
            Origin::Prompt => f.write_str("the prompt"),
            Origin::Say => f.write_str("fric-rig say"),
            Origin::Signal => f.write_str("a signal"),
            Origin::Page(seat) => seat.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rng::Chance;

    /// Mutants tried: a page that is cut to 16 bits; a number with bits that nobody reads.
    #[test]
    fn each_origin_has_a_number_of_its_own() {
        let mut random = Chance(1);
        let mut all = vec![Origin::Program, Origin::Prompt, Origin::Say, Origin::Signal];
        for _ in 0..200 {
            let seat = Seat { panel: random.below(1 << 16) as u16, page: random.below(1 << 32) as u32 };
            all.push(Origin::Page(seat));
        }
        for (i, origin) in all.iter().enumerate() {
            assert_eq!(Origin::of(origin.number()), Some(*origin));
            assert!(origin.number() != 0);
            assert!(all.iter().skip(i + 1).all(|other| other == origin || other.number() != origin.number()));
            assert!(all.iter().skip(i + 1).all(|other| other == origin || other.to_string() != origin.to_string()));
        }
        for number in [0, 6, 1 << 16 | 2, 1 << 40 | 1, u64::MAX] {
            assert_eq!(Origin::of(number), None, "{number:x}");
        }
    }
}
