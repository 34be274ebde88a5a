//! Who operates a rig: one page at a time, visible to all.
//!
//! In: pages that come, command, ask, fall silent and go, each with its time. Out: whose commands count. The first command
//! takes a chair that is free. Taking it over asks the page that sits there, which has [`PATIENCE`] to refuse; a page that
//! is silent for that long has left. Stopping a rig needs no chair.

use serde_json::{Value, json};
use std::time::{Duration, Instant};

/// Time in which a request to take over can be refused, and after which a silent page has left.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// The chair of the operator. Pages are known by their numbers.
#[derive(Clone, Default, Debug)]
pub struct Chair {
    /// Who sits there, and when it was heard last.
    holder: Option<(u64, Instant)>,
    /// Who asks for it, since when.
    asks: Option<(u64, Instant)>,
    /// Whose request was refused last.
    refused: Option<u64>,
}

impl Chair {
    /// Who sits there.
    pub fn holder(&self) -> Option<u64> {
        self.holder.map(|(page, _)| page)
    }

    fn sit(&mut self, page: u64, now: Instant) {
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
    pub fn heard(&mut self, page: u64, now: Instant) -> bool {
        let before = self.json();
        if let Some((holder, heard)) = &mut self.holder
            && *holder == page
        {
            *heard = now;
        }
        self.look(now);
        before != self.json()
    }

    /// A page has gone.
    pub fn left(&mut self, page: u64, now: Instant) {
        self.asks = self.asks.filter(|(asks, _)| *asks != page);
        self.holder = self.holder.filter(|(holder, _)| *holder != page);
        self.look(now);
    }

    /// A page commands: it takes a chair that is free.
    ///
    /// # Errors
    /// If another page sits there, in words.
    pub fn command(&mut self, page: u64, now: Instant) -> Result<(), String> {
        self.heard(page, now);
        match self.holder() {
            None => {
                self.sit(page, now);
                Ok(())
            }
            Some(holder) if holder == page => Ok(()),
            Some(holder) => Err(format!("page {holder} operates this rig: take over first. Anybody may stop it")),
        }
    }

    /// A page wants to sit there.
    ///
    /// # Errors
    /// If another one asks already, in words.
    pub fn take(&mut self, page: u64, now: Instant) -> Result<(), String> {
        self.heard(page, now);
        match (self.holder(), self.asks) {
            (None, _) => self.sit(page, now),
            (Some(holder), _) if holder == page => {}
            (Some(_), Some((other, _))) if other != page => return Err(format!("page {other} asks already")),
            (Some(_), Some(_)) => {}
            (Some(_), None) => (self.asks, self.refused) = (Some((page, now)), None),
        }
        Ok(())
    }

    /// The page that sits there answers a request: it stays (`!gives`), or goes.
    ///
    /// # Errors
    /// If it does not sit there, or nobody asks.
    pub fn answer(&mut self, page: u64, gives: bool, now: Instant) -> Result<(), String> {
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

    /// For pages.
    pub fn json(&self) -> Value {
        json!({ "holder": self.holder(), "asks": self.asks.map(|(page, _)| page), "refused": self.refused })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
                let before = chair.holder();
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
                        chair.heard(page, now);
                        Ok(())
                    }
                    2 | 3 => chair.command(page, now),
                    4 => chair.take(page, now),
                    5 => chair.answer(page, false, now),
                    _ => {
                        chair.left(page, now);
                        Ok(())
                    }
                };
                let after = chair.holder();
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
                        assert!(after.is_some_and(|holder| holder != page && why.contains(&format!("page {holder} "))));
                        seen[3] += 1;
                    }
                    (5, Ok(())) => {
                        assert!(before == Some(page) && after == before && chair.json()["asks"].is_null(), "{told}");
                        seen[4] += 1;
                    }
                    _ => seen[5] += 1,
                }
                let asks = chair.json()["asks"].as_u64();
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
        chair.command(1, at(0)).unwrap();
        chair.take(2, at(100)).unwrap();
        assert!(chair.take(3, at(200)).is_err_and(|why| why.contains("page 2 asks already")));
        assert!(chair.answer(3, true, at(300)).is_err() && chair.holder() == Some(1));
        chair.answer(1, false, at(400)).unwrap();
        assert_eq!(chair.json(), json!({ "holder": 1, "asks": null, "refused": 2 }));
        assert!(chair.answer(1, true, at(500)).is_err_and(|why| why.contains("nobody asks")));
        chair.take(3, at(600)).unwrap();
        chair.answer(1, true, at(700)).unwrap();
        assert_eq!(chair.holder(), Some(3));
        // The one that sits there says nothing about it: granted after five seconds, not before.
        chair.take(2, at(1000)).unwrap();
        assert!(!chair.heard(3, at(5990)) && chair.heard(3, at(6000)));
        assert_eq!(chair.holder(), Some(2));
        // The operating page closes: the page that asks need not wait.
        chair.take(1, at(6100)).unwrap();
        chair.left(2, at(6200));
        assert_eq!(chair.holder(), Some(1));
        chair.left(1, at(6300));
        assert_eq!(chair.holder(), None);
    }
}
