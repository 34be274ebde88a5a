//! Who operates a rig: one page of all its panels at a time, visible to all.
//!
//! In: pages that come, command, ask, fall silent and go, each with its time. Out: whose commands count. The first command
//! takes a chair that is free. Taking it over asks the page that sits there, which has [`PATIENCE`] to refuse; a page that
//! is silent for that long has left. Stopping a rig needs no chair.

use super::line::{Line, stamped};
use super::origin::Seat;
use std::fmt;
use std::time::{Duration, Instant};

/// Time in which a request to take over can be refused, and after which a silent page has left.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// The chair of the operator.
#[derive(Clone, Default, Debug)]
pub struct Chair {
    /// Who sits there, and when it was heard last.
    holder: Option<(Seat, Instant)>,
    /// Who asks for it, since when.
    asks: Option<(Seat, Instant)>,
    /// Whose request was refused last.
    refused: Option<Seat>,
}

impl Chair {
    /// Who sits there.
    pub fn holder(&self) -> Option<Seat> {
        self.holder.map(|(page, _)| page)
    }

    fn sit(&mut self, page: Seat, now: Instant) {
        (self.holder, self.refused) = (Some((page, now)), None);
        self.asks = self.asks.filter(|(asks, _)| *asks != page);
    }

    /// What time alone changes.
    fn look(&mut self, now: Instant) {
        if self.holder.is_some_and(|(_, heard)| now.duration_since(heard) > PATIENCE) {
            self.holder = None;
        }
        if let Some((page, since)) = self.asks
            && (self.holder.is_none() || now.duration_since(since) >= PATIENCE)
        {
            self.sit(page, now);
        }
    }

    /// A page shows that it is there. Whether that, or the time, changed who sits there or asks.
    pub fn heard(&mut self, page: Seat, now: Instant) -> bool {
        let before = self.seats();
        if let Some((holder, heard)) = &mut self.holder
            && *holder == page
        {
            *heard = now;
        }
        self.look(now);
        before != self.seats()
    }

    /// A page has gone.
    pub fn left(&mut self, page: Seat, now: Instant) {
        self.asks = self.asks.filter(|(asks, _)| *asks != page);
        self.holder = self.holder.filter(|(holder, _)| *holder != page);
        self.look(now);
    }

    /// A page commands: it takes a chair that is free.
    ///
    /// # Errors
    /// If another page sits there, in words.
    pub fn command(&mut self, page: Seat, now: Instant) -> Result<(), String> {
        self.heard(page, now);
        match self.holder() {
            None => {
                self.sit(page, now);
                Ok(())
            }
            Some(holder) if holder == page => Ok(()),
            Some(holder) => Err(format!("{holder} operates this rig: take over first. Anybody may stop it")),
        }
    }

    /// A page wants to sit there.
    ///
    /// # Errors
    /// If another one asks already, in words.
    pub fn take(&mut self, page: Seat, now: Instant) -> Result<(), String> {
        self.heard(page, now);
        match (self.holder(), self.asks) {
            (None, _) => self.sit(page, now),
            (Some(holder), _) if holder == page => {}
            (Some(_), Some((other, _))) if other != page => return Err(format!("{other} asks already")),
            (Some(_), Some(_)) => {}
            (Some(_), None) => (self.asks, self.refused) = (Some((page, now)), None),
        }
        Ok(())
    }

    /// The page that sits there answers a request: it stays (`!gives`), or goes.
    ///
    /// # Errors
    /// If it does not sit there, or nobody asks.
    pub fn answer(&mut self, page: Seat, gives: bool, now: Instant) -> Result<(), String> {
        self.heard(page, now);
        match (self.holder(), self.asks) {
            (Some(holder), Some((asks, _))) if holder == page => {
                if gives {
                    self.sit(asks, now);
                } else {
                    (self.asks, self.refused) = (None, Some(asks));
                }
                Ok(())
            }
            (Some(holder), None) if holder == page => Err("nobody asks to take over".into()),
            _ => Err("this page does not operate the rig".into()),
        }
    }

    /// Who sits there, who asks for it, and whose request was refused last.
    pub fn seats(&self) -> Seats {
        Seats { holder: self.holder(), asks: self.asks.map(|(page, _)| page), refused: self.refused }
    }
}

/// What all pages see of the chair.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Seats {
    /// Who operates.
    pub holder: Option<Seat>,
    /// Who asks to.
    pub asks: Option<Seat>,
    /// Whose request was refused last.
    pub refused: Option<Seat>,
}

impl fmt::Display for Seats {
    /// As a line: `0.1 - 0.2`.
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let seat = |seat: Option<Seat>| seat.map_or("-".into(), |seat| format!("{}.{}", seat.panel, seat.page));
        write!(f, "{} {} {}", seat(self.holder), seat(self.asks), seat(self.refused))
    }
}

impl Seats {
    /// What that line says.
    pub fn of(line: &str) -> Option<Seats> {
        let seat = |word: &str| match word.split_once('.') {
            Some((panel, page)) => Some(Some(Seat { panel: panel.parse().ok()?, page: page.parse().ok()? })),
            None => (word == "-").then_some(None),
        };
        let mut words = line.split(' ').map(seat);
        let seats = Seats { holder: words.next()??, asks: words.next()??, refused: words.next()?? };
        words.next().is_none().then_some(seats)
    }
}

/// A line of a page to its rig.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum PageLine<'a> {
    /// `seen`: a page has drawn a picture.
    Seen,
    /// `here PAGE`: it is there.
    Here(u32),
    /// `left PAGE`: it has gone.
    Left(u32),
    /// `NUMBER page PAGE COMMAND`, or `NUMBER page PAGE @NS COMMAND`: a command, and the time that it has seen.
    Command {
        /// Under which it is answered.
        number: u64,
        /// Whose it is.
        page: u32,
        /// When it was given, by the rig's monotonic clock.
        given_ns: Option<u64>,
        /// The command.
        words: &'a str,
    },
}

impl<'a> PageLine<'a> {
    /// Reads a line; none if it is of another kind.
    pub fn read(text: &'a str) -> Option<PageLine<'a>> {
        let (first, rest) = text.split_once(' ').unwrap_or((text, ""));
        match first {
            "seen" if rest.is_empty() => Some(PageLine::Seen),
            "here" => rest.parse().ok().map(PageLine::Here),
            "left" => rest.parse().ok().map(PageLine::Left),
            number => {
                let number = number.parse().ok()?;
                let (page, words) = rest.strip_prefix("page ")?.split_once(' ')?;
                let (given_ns, words) = match stamped(words) {
                    (Some(ns), words) => (Some(ns.parse().ok()?), words),
                    (None, words) => (None, words),
                };
                Some(PageLine::Command { number, page: page.parse().ok()?, given_ns, words })
            }
        }
    }
}

impl Chair {
    /// Whether this is said to the chair alone; then what it does with it.
    pub fn says(&mut self, page: Seat, line: &Line, now: Instant) -> Option<Result<(), String>> {
        match line {
            Line::Take => Some(self.take(page, now)),
            Line::Give => Some(self.answer(page, true, now)),
            Line::Refuse => Some(self.answer(page, false, now)),
            Line::Enable | Line::Arm | Line::Stop | Line::Reset | Line::Set(_) | Line::Mark(_) => None,
            Line::Again | Line::Show | Line::Help | Line::Quit => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn number(seat: Seat) -> u64 {
        u64::from(seat.page)
    }

    fn seat(page: u64) -> Seat {
        Seat { panel: (page % 2) as u16, page: page as u32 }
    }

    /// Random events of four pages, judged by what is remembered of each page alone. Nobody loses the chair but by going,
    /// by silence, by giving it away, or to a page that asked five seconds before and was not refused.
    ///
    /// Mutants tried: a request that is granted at once; `refuse` that keeps the request; a silent page that stays; a
    /// command that takes a chair which is not free.
    #[test]
    fn the_chair_goes_to_another_page_only_for_a_reason() {
        let mut seen = [0_u32; 6];
        for seed in 1..=2000_u64 {
            let mut state = seed;
            let mut below = |n: u64| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) % n
            };
            let (begin, mut at, mut chair) = (Instant::now(), 0, Chair::default());
            let mut heard = [None::<u64>; 4];
            let mut asked = None::<(u64, u64)>;
            for step in 0..60 {
                at += [0, 40, 900, 1500, 3000, 6000][below(6) as usize];
                let (now, page) = (begin + Duration::from_millis(at), below(4));
                let before = chair.holder().map(number);
                let mut reasons = Vec::new();
                let silent =
                    |page: u64, heard: &[Option<u64>]| heard[page as usize].is_none_or(|then| at - then > 5000);
                let what = below(7);
                if what != 6 && before == Some(page) {
                    // A page that sends something is there, however long it was silent before.
                    heard[page as usize] = Some(at);
                }
                if before.is_none_or(|holder| silent(holder, &heard)) {
                    reasons.push("free");
                }
                let waited = asked.filter(|(_, since)| at - since >= 5000).map(|(page, _)| page);
                let result = match what {
                    0 | 1 => {
                        chair.heard(seat(page), now);
                        Ok(())
                    }
                    2 | 3 => chair.command(seat(page), now),
                    4 => chair.take(seat(page), now),
                    5 => chair.answer(seat(page), false, now),
                    _ => {
                        chair.left(seat(page), now);
                        Ok(())
                    }
                };
                let after = chair.holder().map(number);
                let told =
                    format!("seed {seed}, step {step} at {at} ms: page {page}, event {what}, {before:?} {after:?}");
                if what == 6 && before == Some(page) {
                    reasons.push("gone");
                }
                if before.is_some() && after != before {
                    let granted = waited.is_some() && after == waited;
                    assert!(!reasons.is_empty() || granted, "{told}: {reasons:?}");
                    seen[if granted { 0 } else { 1 }] += 1;
                }
                if let Some(holder) = before
                    && silent(holder, &heard)
                {
                    assert_ne!(after, Some(holder), "{told}: a silent page stays");
                }
                match (what, &result) {
                    (2 | 3, Ok(())) => {
                        assert_eq!(after, Some(page), "{told}");
                        seen[2] += 1;
                    }
                    (2 | 3, Err(why)) => {
                        assert!(
                            after
                                .is_some_and(|holder| holder != page && why.starts_with(&format!("{} ", seat(holder))))
                        );
                        seen[3] += 1;
                    }
                    (5, Ok(())) => {
                        assert!(before == Some(page) && after == before && chair.seats().asks.is_none(), "{told}");
                        seen[4] += 1;
                    }
                    _ => seen[5] += 1,
                }
                let asks = chair.seats().asks.map(number);
                asked = match (asks, asked) {
                    (Some(page), Some((other, since))) if page == other => Some((page, since)),
                    (Some(page), _) => Some((page, at)),
                    (None, _) => None,
                };
                if after != before
                    && let Some(holder) = after
                {
                    heard[holder as usize] = Some(at);
                }
            }
        }
        assert!(seen.iter().all(|n| *n > 200), "{seen:?}");
    }

    #[test]
    fn a_request_is_given_refused_or_granted_by_silence() {
        let begin = Instant::now();
        let at = |ms| begin + Duration::from_millis(ms);
        let mut chair = Chair::default();
        chair.command(seat(1), at(0)).unwrap();
        chair.take(seat(2), at(100)).unwrap();
        assert!(chair.take(seat(3), at(200)).is_err_and(|why| why.contains("page 2 asks already")));
        assert!(chair.answer(seat(3), true, at(300)).is_err() && chair.holder() == Some(seat(1)));
        chair.answer(seat(1), false, at(400)).unwrap();
        assert_eq!(chair.seats().to_string(), "1.1 - 0.2");
        assert!(chair.answer(seat(1), true, at(500)).is_err_and(|why| why.contains("nobody asks")));
        chair.take(seat(3), at(600)).unwrap();
        chair.answer(seat(1), true, at(700)).unwrap();
        assert_eq!(chair.holder(), Some(seat(3)));
        // The one that sits there says nothing about it: granted after five seconds, not before.
        chair.take(seat(2), at(1000)).unwrap();
        assert!(!chair.heard(seat(3), at(5990)) && chair.heard(seat(3), at(6000)));
        assert_eq!(chair.holder(), Some(seat(2)));
        // The operating page closes: the page that asks need not wait.
        chair.take(seat(1), at(6100)).unwrap();
        chair.left(seat(2), at(6200));
        assert_eq!(chair.holder(), Some(seat(1)));
        chair.left(seat(1), at(6300));
        assert_eq!(chair.holder(), None);
    }

    /// Random seats and lines: what is written is read again to the same, and nothing else is read.
    ///
    /// Mutants tried: `refused` left out of the line; a stamp that is no number taken as none.
    #[test]
    fn lines_between_panel_and_rig_are_read_as_written() {
        let mut random = crate::rng::Chance(7);
        for _ in 0..500 {
            let mut one = || {
                (random.below(3) > 0)
                    .then(|| Seat { panel: random.below(9) as u16, page: random.below(1 << 32) as u32 })
            };
            let seats = Seats { holder: one(), asks: one(), refused: one() };
            assert_eq!(Seats::of(&seats.to_string()), Some(seats));
            let (number, page, given_ns) = (random.number(), random.below(1 << 32) as u32, random.number());
            let words = ["stop", "set a = 1 N, b = 2", "mark @ 3 o'clock"][random.below(3) as usize];
            let line = format!("{number} page {page} @{given_ns} {words}");
            assert_eq!(
                PageLine::read(&line),
                Some(PageLine::Command { number, page, given_ns: Some(given_ns), words })
            );
            let line = format!("{number} page {page} {words}");
            assert_eq!(PageLine::read(&line), Some(PageLine::Command { number, page, given_ns: None, words }));
            assert_eq!(PageLine::read(&format!("here {page}")), Some(PageLine::Here(page)));
            assert_eq!(PageLine::read(&format!("left {page}")), Some(PageLine::Left(page)));
        }
        for line in
            ["", "here", "here x", "seen 1", "7 stop", "7 page stop", "7 page 1", "x page 1 stop", "7 page 1 @x stop"]
        {
            assert_eq!(PageLine::read(line), None, "{line}");
        }
        for line in ["", "- -", "- - - -", "1 - -", "1.x - -", "- - 70000.1"] {
            assert_eq!(Seats::of(line), None, "{line}");
        }
    }
}
