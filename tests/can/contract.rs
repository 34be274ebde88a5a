//! The contract that every kind of bus fulfils: run over simulated ones, terminals, TCP and logs by `kinds.rs`, and
//! over interfaces of a kernel by `kernel.rs`.

use runtime::can::{Bus, Event, Filter, Frame, Options, Received, Refused, State};

/// Two ends of one bus.
pub struct Pair {
    /// Opened with the requested options.
    pub near: Box<dyn Bus>,
    /// The other end.
    pub far: Box<dyn Bus>,
    /// The clock that both ends use.
    pub now_ns: Box<dyn Fn() -> u64>,
    /// Disconnects the far end.
    pub part: Box<dyn FnOnce(Box<dyn Bus>)>,
}

/// Longer than any answer takes; a failing test waits this long.
const PATIENCE_NS: u64 = 5_000_000_000;

/// All frames received so far.
fn drain(bus: &mut dyn Bus) -> Vec<Received> {
    std::iter::from_fn(|| bus.receive()).collect()
}

fn frames(received: &[Received]) -> Vec<Frame> {
    received.iter().filter_map(|got| if let Received::Frame(frame, _) = got { Some(*frame) } else { None }).collect()
}

/// Waits for this many frames.
fn expect(bus: &mut dyn Bus, now_ns: &dyn Fn() -> u64, count: usize) -> Vec<Frame> {
    let until_ns = now_ns() + PATIENCE_NS;
    let mut got = frames(&drain(bus));
    while got.len() < count && bus.wait(until_ns) {
        got.extend(frames(&drain(bus)));
    }
    got
}

/// The k-th of many distinct frames.
fn numbered(k: u32) -> Frame {
    Frame::new(0x180 + k % 3, &k.to_be_bytes())
}

/// Checks one kind; `make` returns two new ends.
pub fn check(kind: &str, make: &dyn Fn(&Options) -> Pair) {
    order_is_kept(kind, make(&Options::default()));
    every_frame_is_carried_whole(kind, make(&Options::default()));
    a_burst_arrives_whole(kind, make(&Options::default()));
    what_is_taken_arrives_or_is_counted(kind, make(&Options::default()));
    a_filter_lets_in_what_it_names(kind, make);
    waiting_ends_in_time(kind, make(&Options::default()));
    who_only_listens_does_not_send(kind, make(&Options { listen_only: true, ..Options::default() }));
    a_peer_that_goes_is_a_fault(kind, make(&Options::default()));
}

fn order_is_kept(kind: &str, mut pair: Pair) {
    let sent: Vec<Frame> = (0..30).map(numbered).collect();
    for &frame in &sent {
        assert_eq!(pair.near.send(frame), Ok(()), "{kind}");
    }
    assert_eq!(expect(&mut *pair.far, &pair.now_ns, 30), sent, "{kind}, to the far end");
    assert_eq!(frames(&drain(&mut *pair.near)), [], "{kind}: own frames don't come back");
    for &frame in &sent {
        assert_eq!(pair.far.send(frame), Ok(()), "{kind}");
    }
    let before_ns = (pair.now_ns)();
    // The first frame may be an answer to what the near end has sent.
    let received = loop {
        assert!(pair.near.wait(before_ns + PATIENCE_NS), "{kind}: no frame comes");
        if let Some(received) = pair.near.receive() {
            break received;
        }
    };
    let Received::Frame(first, stamp_ns) = received else { panic!("{kind}: {received:?} is no frame") };
    assert_eq!(first, sent[0], "{kind}");
    // Stamped at arrival, on the shared clock.
    assert!(stamp_ns <= (pair.now_ns)() && stamp_ns + PATIENCE_NS > before_ns, "{kind}: stamped {stamp_ns}");
    assert_eq!(expect(&mut *pair.near, &pair.now_ns, 29), sent[1..], "{kind}, back");
}

fn every_frame_is_carried_whole(kind: &str, mut pair: Pair) {
    let all = [
        Frame::new(0, &[]),
        Frame::new(0x7FF, &[0xFF; 8]),
        Frame::new(0x080, &[0, 1, 0x0F, 0x10, 0x80]),
        Frame::extended(0, &[0]),
        Frame::extended(0x1FFF_FFFF, &[0; 8]),
        Frame::remote(0x701, 1),
        Frame::remote_extended(0x701, 8),
    ];
    for frame in all {
        // The card emulated by QEMU alters this one.
        if kind == "SJA1000" && frame.is_remote() && frame.is_extended() {
            continue;
        }
        match pair.near.send(frame) {
            Ok(()) => assert_eq!(expect(&mut *pair.far, &pair.now_ns, 1), [frame], "{kind}"),
            Err(refused) => assert!(frame.is_remote() && refused == Refused::Unable, "{kind}: {frame} is {refused:?}"),
        }
    }
}

/// How many frames arrived or are counted as lost.
fn counted(got: &[Received], near: &dyn Bus) -> u64 {
    frames(got).len() as u64 + near.health().lost
}

/// Waits until `count` frames of the far end have arrived or are counted as lost.
fn gather(pair: &mut Pair, got: &mut Vec<Received>, count: u64) {
    let until_ns = (pair.now_ns)() + PATIENCE_NS;
    while counted(got, &*pair.near) < count && (pair.now_ns)() < until_ns {
        // The far end sends its queued frames when it is polled.
        drain(&mut *pair.far);
        pair.near.wait((pair.now_ns)() + 10_000_000);
        got.extend(drain(&mut *pair.near));
    }
}

/// With a reader that reads whenever it is woken, nothing is lost. But a virtual interface never reports that it is
/// full, and then its losses are counted.
fn a_burst_arrives_whole(kind: &str, mut pair: Pair) {
    let mut got = Vec::new();
    for k in 0..2000 {
        while let Err(refused) = pair.far.send(numbered(k)) {
            assert_eq!(refused, Refused::Full, "{kind}");
            let until_ns = (pair.now_ns)() + PATIENCE_NS;
            assert!(pair.near.wait(until_ns), "{kind}: full, and nothing comes");
            got.extend(drain(&mut *pair.near));
        }
    }
    gather(&mut pair, &mut got, 2000);
    let got = frames(&got);
    let lost = 2000 - got.len();
    assert_eq!(lost as u64, pair.near.health().lost, "{kind}: {} of 2000", got.len());
    let mut all = (0..2000).map(numbered);
    assert!(got.iter().all(|got| all.any(|sent| sent == *got)), "{kind}: order is kept");
    // A burst fits only if the process may enlarge its buffer beyond the common limit.
    assert!(lost == 0 || kind == "vcan" && std::env::var("GUEST").is_err(), "{kind}: {lost} lost");
}

/// With a reader that sleeps, every missing frame was refused or is counted, and no call blocks.
fn what_is_taken_arrives_or_is_counted(kind: &str, mut pair: Pair) {
    let mut taken = 0;
    for k in 0..20_000 {
        match pair.far.send(numbered(k)) {
            Ok(()) => taken += 1,
            Err(refused) => assert_eq!(refused, Refused::Full, "{kind}"),
        }
    }
    let mut got = drain(&mut *pair.near);
    gather(&mut pair, &mut got, taken);
    assert_eq!(counted(&got, &*pair.near), taken, "{kind}");
    let told: u64 =
        got.iter().map(|got| if let Received::Event(Event::Lost(lost), _) = got { u64::from(*lost) } else { 0 }).sum();
    assert_eq!(told, pair.near.health().lost, "{kind}: each loss is told");
    assert_eq!(pair.far.health().refused, 20_000 - taken, "{kind}: each refusal is counted");
}

fn a_filter_lets_in_what_it_names(kind: &str, make: &dyn Fn(&Options) -> Pair) {
    let sent =
        [Frame::new(0x181, &[1]), Frame::new(0x99, &[]), Frame::extended(0x99, &[]), Frame::extended(0x181, &[])];
    let last = Frame::new(0x7FF, &[]);
    let passes = |filter: Filter| {
        let mut pair = make(&Options { filter, ..Options::default() });
        for frame in sent.into_iter().chain([last]) {
            pair.far.send(frame).expect(kind);
        }
        let until_ns = (pair.now_ns)() + 300_000_000;
        let mut got = Vec::new();
        while !got.ends_with(&[last]) && pair.near.wait(until_ns) {
            got.extend(frames(&drain(&mut *pair.near)));
        }
        got
    };
    let two = passes(Filter::Only(vec![0x181, 0x99 | Filter::EXTENDED, 0x7FF]));
    assert_eq!(two, [sent[0], sent[2], last], "{kind}");
    assert_eq!(passes(Filter::Only(Vec::new())), [], "{kind}: an empty list lets nothing in");
    assert_eq!(passes(Filter::All).len(), 5, "{kind}");
}

fn waiting_ends_in_time(kind: &str, mut pair: Pair) {
    drain(&mut *pair.near);
    let until_ns = (pair.now_ns)() + 20_000_000;
    assert!(!pair.near.wait(until_ns), "{kind}: nothing was sent");
    assert!((pair.now_ns)() >= until_ns, "{kind}");
    assert!(!pair.near.wait(until_ns), "{kind}: a time that has passed is not waited for");
    pair.far.send(numbered(1)).expect(kind);
    assert!(pair.near.wait((pair.now_ns)() + PATIENCE_NS), "{kind}");
    assert!(pair.near.wait(0), "{kind}: it is still there");
}

fn who_only_listens_does_not_send(kind: &str, mut pair: Pair) {
    assert_eq!(pair.near.send(numbered(1)), Err(Refused::Unable), "{kind}");
}

fn a_peer_that_goes_is_a_fault(kind: &str, pair: Pair) {
    let Pair { mut near, far, now_ns, part } = pair;
    part(far);
    let until_ns = now_ns() + PATIENCE_NS;
    let mut events = Vec::new();
    while !events.contains(&Event::Down) && near.wait(until_ns) {
        events.extend(
            drain(&mut *near).iter().filter_map(|got| if let Received::Event(e, _) = got { Some(*e) } else { None }),
        );
    }
    assert!(events.contains(&Event::Down), "{kind}: {events:?}");
    assert_eq!(near.health().state, State::Down, "{kind}");
    // A stream may take a moment to report it.
    let refused = (0..1000).map(|k| near.send(numbered(k))).find(Result::is_err);
    assert_eq!(refused, Some(Err(Refused::Down)), "{kind}");
    assert_eq!(frames(&drain(&mut *near)), [], "{kind}");
}
