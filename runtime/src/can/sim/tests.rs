//! Tests of the simulated line: times, arbitration and error counters.

use super::*;
use crate::can::{Event, State, frame_length};

const RATE: u32 = 1_000_000;

/// A simulation with one bus and two nodes.
fn pair() -> (Simulation, SimBus, Port, Port) {
    let simulation = Simulation::new();
    let bus = simulation.bus("bench", RATE);
    let (a, b) = (bus.port("a"), bus.port("b"));
    (simulation, bus, a, b)
}

fn frames(port: &mut Port) -> Vec<(Frame, u64)> {
    everything(port)
        .into_iter()
        .filter_map(|got| if let Received::Frame(f, t) = got { Some((f, t)) } else { None })
        .collect()
}

fn everything(port: &mut Port) -> Vec<Received> {
    std::iter::from_fn(|| port.receive()).collect()
}

fn events(port: &mut Port) -> Vec<Event> {
    everything(port)
        .into_iter()
        .filter_map(|got| if let Received::Event(e, _) = got { Some(e) } else { None })
        .collect()
}

#[test]
fn a_frame_takes_its_bits() {
    let (simulation, bus, mut a, mut b) = pair();
    let frame = Frame::new(0x181, &[1, 2, 3, 4, 5, 6, 7, 8]);
    let whole_ns = u64::from(frame_length::bits(&frame)) * 1000;
    a.send(frame).expect("the queue is empty");
    assert!(b.wait(1_000_000) && simulation.now_ns() == whole_ns - 3000, "at {} ns", simulation.now_ns());
    assert_eq!(frames(&mut b), [(frame, whole_ns - 3000)]);
    assert_eq!(frames(&mut a), []);
    // The next frame follows after three bits.
    simulation.run_to(whole_ns - 1000);
    a.send(frame).expect("the queue is empty");
    simulation.run_to(1_000_000);
    assert_eq!(frames(&mut b), [(frame, 2 * whole_ns - 3000)]);
    assert_eq!(bus.busy_ns(), 2 * whole_ns);
}

#[test]
fn the_least_identifier_wins_and_the_loser_follows_at_once() {
    let (simulation, bus, mut a, mut b) = pair();
    let mut c = bus.port("c");
    let (first, second, third) =
        (Frame::new(0x080, &[]), Frame::new(0x181, &[0; 8]), Frame::extended(0x181 << 18, &[1]));
    // Not in the order of their priorities, all at the same time.
    c.send(third).expect("sent");
    b.send(second).expect("sent");
    a.send(first).expect("sent");
    simulation.run_to(1_000_000);
    let mut listener = frames(&mut a);
    assert_eq!(listener.remove(0).0, second);
    let end =
        |frames: &[Frame]| frames.iter().map(|frame| u64::from(frame_length::bits(frame)) * 1000).sum::<u64>() - 3000;
    assert_eq!(frames(&mut c), [(first, end(&[first])), (second, end(&[first, second]))]);
    assert_eq!(listener, [(third, end(&[first, second, third]))]);
}

#[test]
fn a_node_alone_goes_passive_and_no_further() {
    let simulation = Simulation::new();
    let bus = simulation.bus("bench", RATE);
    let mut a = bus.port("a");
    a.send(Frame::new(1, &[])).expect("sent");
    simulation.run_to(100_000_000);
    let health = a.health();
    assert_eq!((health.state, health.transmit_errors), (State::Passive, 128));
    assert_eq!(events(&mut a), [Event::NotAcknowledged, Event::Warning, Event::Passive]);
    // Another node joins: the frame is finally acknowledged.
    let mut b = bus.port("b");
    simulation.run_to(101_000_000);
    assert_eq!(frames(&mut b).len(), 1);
    assert_eq!((a.health().state, a.health().transmit_errors), (State::Active, 127));
}

#[test]
fn a_short_circuit_causes_bus_off_until_a_restart() {
    let (simulation, bus, mut a, mut b) = pair();
    bus.short(0, 20_000_000);
    a.send(Frame::new(1, &[])).expect("sent");
    simulation.run_to(30_000_000);
    assert_eq!(a.health().state, State::BusOff);
    assert_eq!(events(&mut a), [Event::Warning, Event::Passive, Event::BusOff]);
    assert_eq!(a.send(Frame::new(1, &[])), Err(Refused::Down));
    assert_eq!(frames(&mut b), []);
    bus.restart("a");
    simulation.run_to(30_000_000 + 128 * 11_000);
    assert_eq!(everything(&mut a), [Received::Event(Event::Restarted, 30_000_000 + 128 * 11_000)]);
    a.send(Frame::new(2, &[])).expect("active again");
    simulation.run_to(40_000_000);
    assert_eq!(frames(&mut b).len(), 1, "and the old frame is gone");
    assert_eq!(a.health().refused, 1);
}

#[test]
fn another_bit_rate_is_an_error_on_both_sides() {
    let (simulation, bus, mut a, _b) = pair();
    let wrong = bus.join("wrong", Join { bit_rate: Some(500_000), ..Join::default() });
    a.send(Frame::new(1, &[])).expect("sent");
    simulation.run_to(1_000_000);
    assert!(a.health().transmit_errors > 0 && wrong.health().receive_errors > 0);
    simulation.run_to(100_000_000);
    assert_eq!(a.health().state, State::BusOff);
}

#[test]
fn a_disturbed_frame_is_counted_and_retransmitted() {
    let (simulation, bus, mut a, mut b) = pair();
    bus.plant("a", Fault::new(BusFaultKind::Disturb).times(3));
    a.send(Frame::new(1, &[7])).expect("sent");
    simulation.run_to(1_000_000);
    assert_eq!(frames(&mut b).len(), 1);
    // Three times 8 up and once 1 down; three times 1 up and once 1 down.
    assert_eq!((a.health().transmit_errors, b.health().receive_errors), (23, 2));
}

#[test]
fn two_different_frames_of_one_identifier_destroy_each_other() {
    let (simulation, _bus, mut a, mut b) = pair();
    a.send(Frame::new(1, &[1])).expect("sent");
    b.send(Frame::new(1, &[2])).expect("sent");
    simulation.run_to(10_000_000);
    assert!(a.health().transmit_errors + b.health().transmit_errors > 0, "both drove the line");
}

#[test]
fn planted_faults_do_what_they_say() {
    let got = |fault: Fault, count: u8| {
        let (simulation, bus, mut a, mut b) = pair();
        bus.plant("a", fault);
        let sent = (0..count).map(|k| a.send(Frame::new(1, &[k]))).filter(Result::is_ok).count();
        simulation.run_to(10_000_000);
        (sent, frames(&mut b).iter().map(|(frame, _)| frame.data()[0]).collect::<Vec<_>>())
    };
    assert_eq!(got(Fault::new(BusFaultKind::Drop).times(1), 3), (3, vec![1, 2]));
    assert_eq!(got(Fault::new(BusFaultKind::Duplicate).times(1), 2), (2, vec![0, 0, 1]));
    assert_eq!(got(Fault::new(BusFaultKind::Reorder).times(1), 3), (3, vec![1, 0, 2]));
    assert_eq!(got(Fault::new(BusFaultKind::Delay(1_000_000)).times(1), 3), (3, vec![1, 2, 0]));
    assert_eq!(got(Fault::new(BusFaultKind::Full).times(2), 3), (1, vec![2]));
    assert_eq!(got(Fault::new(BusFaultKind::Drop).id(2), 2), (2, vec![0, 1]));
    assert_eq!(got(Fault::new(BusFaultKind::Drop).from(1), 2), (2, vec![0, 1]));
    let (_, corrupt) = got(Fault::new(BusFaultKind::Corrupt), 1);
    assert!(corrupt.len() == 1 && corrupt[0].count_ones() == 1, "one bit of 0 is wrong: {corrupt:?}");
    let (_, half) = got(Fault::new(BusFaultKind::Drop).chance(0.5), 60);
    assert!((15..45).contains(&half.len()), "{} of 60", half.len());
    assert_eq!(got(Fault::new(BusFaultKind::Drop).chance(0.5), 60).1, half, "the same seed, the same losses");
}

#[test]
fn an_overrun_is_reported_and_counted() {
    let (simulation, bus, mut a, mut b) = pair();
    bus.plant("b", Fault::new(BusFaultKind::Overrun).times(2));
    for k in 0..3 {
        a.send(Frame::new(1, &[k])).expect("sent");
    }
    simulation.run_to(1_000_000);
    assert_eq!(b.health().lost, 2);
    assert_eq!(events(&mut b), [Event::Lost(2)]);
}

#[test]
fn a_babbling_node_starves_the_others() {
    let (simulation, bus, mut a, mut b) = pair();
    let _idiot = bus.port("idiot");
    bus.babble("idiot", Frame::new(0, &[]), 0, 0, 5_000_000);
    a.send(Frame::new(0x100, &[])).expect("sent");
    simulation.run_to(4_900_000);
    assert!(frames(&mut b).iter().all(|(frame, _)| frame.id() == 0));
    simulation.run_to(6_000_000);
    assert_eq!(frames(&mut b).last().map(|(frame, _)| frame.id()), Some(0x100));
}

#[test]
fn an_unplugged_node_neither_receives_nor_is_received() {
    let (simulation, bus, mut a, mut b) = pair();
    let mut c = bus.port("c");
    bus.unplug("c", 1_000, 5_000_000);
    simulation.run_to(2_000);
    a.send(Frame::new(1, &[])).expect("sent");
    c.send(Frame::new(2, &[])).expect("taken");
    simulation.run_to(4_000_000);
    assert_eq!((frames(&mut b).len(), frames(&mut a).len()), (1, 0));
    assert_eq!((events(&mut c)[0], c.health().state), (Event::NotAcknowledged, State::Passive));
    simulation.run_to(6_000_000);
    assert_eq!(frames(&mut b).len(), 1, "plugged in again, its frame comes");
}

#[test]
fn a_filter_lets_in_what_it_names() {
    let (simulation, bus, mut a, _b) = pair();
    let mut only =
        bus.join("only", Join { filter: Filter::Only(vec![0x181, 0x99 | Filter::EXTENDED]), ..Join::default() });
    let sent = [Frame::new(0x181, &[]), Frame::new(0x99, &[]), Frame::extended(0x99, &[]), Frame::extended(0x181, &[])];
    sent.iter().for_each(|&frame| a.send(frame).expect("sent"));
    simulation.run_to(1_000_000);
    assert_eq!(frames(&mut only).iter().map(|(frame, _)| *frame).collect::<Vec<_>>(), [sent[0], sent[2]]);
}

/// Answers each SYNC after a delay.
struct Answers {
    port: Port,
    after_ns: u64,
    due_ns: Option<u64>,
}

impl Actor for Answers {
    fn act(&mut self, now_ns: u64) -> u64 {
        while let Some(got) = self.port.receive() {
            if let Received::Frame(_, at_ns) = got {
                self.due_ns = Some(at_ns + self.after_ns);
            }
        }
        if self.due_ns.take_if(|due_ns| *due_ns <= now_ns).is_some() {
            self.port.send(Frame::new(0x181, &[1; 8])).expect("the queue is empty");
        }
        self.due_ns.unwrap_or(u64::MAX)
    }
}

#[test]
fn an_actor_answers_while_the_master_waits() {
    let (simulation, bus, mut master, _b) = pair();
    simulation.attend(Box::new(Answers { port: bus.port("drive"), after_ns: 100_000, due_ns: None }));
    for cycle in 0..10 {
        let begin_ns = cycle * 1_000_000;
        simulation.sleep_until(begin_ns);
        let sync = Frame::new(0x080, &[]);
        master.send(sync).expect("the queue is empty");
        assert!(master.wait(begin_ns + 450_000), "cycle {cycle}");
        let (answer, at_ns) = frames(&mut master)[0];
        let bits = u64::from(frame_length::bits(&sync) + frame_length::bits(&answer)) - 6;
        assert_eq!(at_ns - begin_ns, bits * 1000 + 100_000);
    }
}

#[test]
fn real_time_advances_by_itself() {
    let simulation = Simulation::real_time();
    let bus = simulation.bus("bench", RATE);
    let (mut a, mut b) = (bus.port("a"), bus.port("b"));
    a.send(Frame::new(1, &[])).expect("sent");
    assert!(b.wait(simulation.now_ns() + 5_000_000_000));
    assert_eq!(frames(&mut b).len(), 1);
}
