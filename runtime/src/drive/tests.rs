//! Tests of the master's side with simulated drives, without a bus between them.

use super::simulated::Behaviour;
use super::state::State;
use super::*;
use crate::can::Frame;
use crate::canopen::object::Entry;
use crate::canopen::{Access, NmtState, Object, Service, Type};
use crate::drive::fault_injection::{self, Hook, Start};
use crate::rng::Chance;
use crate::testing::drives::*;
use crate::testing::generated::seeds;
use abi::rig::{Kind, Mode, Rig, SignalKind};

fn table(rig: &Rig) -> Table {
    Table::new(rig, Some(shaft(0.012, 0.001)), Options::default())
}

fn with(change: impl FnOnce(&mut SimulatedBench)) -> Table {
    let rig = rig(Mode::Torque);
    let mut table = table(&rig);
    change(&mut table.bench);
    table
}

fn config(rig: &mut Rig, node: usize) -> &mut abi::rig::Cia402 {
    match &mut rig.nodes[node].kind {
        Kind::Cia402(config) => config,
        Kind::Frames(_) => unreachable!(),
    }
}

fn troubles(table: &mut Table) -> Vec<(Option<usize>, TroubleKind)> {
    std::iter::from_fn(|| table.fieldbus.trouble()).map(|trouble| (trouble.node, trouble.kind)).collect()
}

#[test]
fn two_drives_start_up_in_order() {
    let mut table = table(&rig(Mode::Torque));
    let mut steps = vec![table.fieldbus.step()];
    while table.fieldbus.step() != Step::AwaitArm {
        match table.fieldbus.step() {
            Step::AwaitEnable => assert!(table.fieldbus.request(Request::Enable)),
            Step::Refused => panic!("{}", table.fieldbus.explain(table.fieldbus.refusal().unwrap())),
            _ => assert!(!table.fieldbus.request(Request::Arm), "not before its time"),
        }
        table.tick();
        if steps.last() != Some(&table.fieldbus.step()) {
            steps.push(table.fieldbus.step());
        }
        assert!(table.now_ns < 20_000_000_000, "stays at {:?}", table.fieldbus.step());
    }
    assert_eq!(steps, Step::ALL[..steps.len()]);
    for node in [LOAD, SERVO] {
        let status = table.fieldbus.status(node).expect("a drive");
        assert_eq!((status.state, status.mode, status.mode_shown), (State::Enabled, 10, Some(10)));
        assert_eq!(status.timeout, Some((5, profiles::Life::Heartbeat)));
        let measured = status.timeout_measured_ns.expect("measured");
        assert!((1_000_000..10_000_000).contains(&measured), "{measured} ns");
        let limits = table.fieldbus.limits(node).expect("a drive");
        assert_eq!((limits.torque, limits.speed, limits.power), (2.0, 200.0, 400.0));
    }
    // The shaft has hardly moved, and stands still.
    let shaft = table.bench.shaft(LOAD);
    assert!(shaft.position.abs() < 0.1 && shaft.speed.abs() < 0.1, "{shaft:?}");
    assert_eq!(troubles(&mut table), []);
}

#[test]
fn no_drive_has_torque_before_the_polarity_check() {
    let mut table = table(&rig(Mode::Torque));
    table.until(Step::AwaitEnable);
    table.fieldbus.request(Request::Enable);
    while table.fieldbus.step() != Step::SignTest {
        table.tick();
        assert_eq!((table.bench.shaft(LOAD).torque, table.bench.shaft(SERVO).torque), (0.0, 0.0));
    }
    // The control word never skips a state.
    let words: Vec<u8> = table
        .log
        .iter()
        .filter(|(_, ours, frame)| *ours && frame.id() == 0x203)
        .map(|(.., frame)| frame.data()[0])
        .collect();
    let mut order = words.clone();
    order.dedup();
    assert_eq!(order[..4], [0x00, 0x06, 0x07, 0x0F]);
}

#[test]
fn armed_the_shaft_follows_the_torque() {
    let mut table = table(&rig(Mode::Torque));
    table.arm();
    table.ticks(3);
    let before = table.bench.shaft(LOAD).speed;
    table.commands[SERVO].1 = 0.5;
    table.ticks(100);
    let gained = table.bench.shaft(LOAD).speed - before;
    // 0.5 N·m on 0.012 kg·m² for 0.1 s less half a period, dead time and lag: 0.0981 s.
    assert!((gained - 0.5 / 0.012 * 0.0981).abs() < 0.05, "{gained}");
    let told = table.value(LOAD, SignalKind::Speed);
    assert!((told - table.bench.shaft(LOAD).speed).abs() < 0.1, "{told}");
    assert!((table.value(SERVO, SignalKind::Torque) - 0.5).abs() < 0.003);
    assert_eq!(table.value(LOAD, SignalKind::Torque), 0.0);
    let turned = table.value(LOAD, SignalKind::Position) - table.value(SERVO, SignalKind::Position);
    assert!(turned.abs() < 1e-3, "both count from enabling: {turned}");
    assert_eq!((table.value(LOAD, SignalKind::Enabled), table.value(LOAD, SignalKind::Fault)), (1.0, 0.0));
    // It stops on command.
    table.fieldbus.request(Request::QuickStop);
    table.ticks(100);
    assert!(table.fieldbus.at_rest());
    assert!(table.bench.shaft(LOAD).speed.abs() < 0.06);
    assert_eq!(table.fieldbus.status(SERVO).unwrap().state, State::SwitchOnDisabled);
    assert!(!table.fieldbus.request(Request::Arm), "not without the whole start-up");
    assert!(!table.fieldbus.request(Request::Enable), "a stop latches");
}

#[test]
fn torque_mode_4_has_the_rigs_slope() {
    let mut rig = rig(Mode::Torque);
    rig.outputs[SERVO].slew = 20.0;
    let only_4 = Behaviour { modes: Some(0b1000), ..Behaviour::default() };
    let bench = SimulatedBench::with(&rig, Some(shaft(0.012, 0.001)), 7, |_| only_4).unwrap();
    let mut table = Table::with(&rig, bench, Options::default());
    table.arm();
    assert_eq!(table.fieldbus.status(SERVO).unwrap().mode, 4);
    assert_eq!(table.bench.drive(SERVO).unwrap().objects().get(Object(0x6087, 0)), Some(5000));
    table.commands[SERVO].1 = 2.0;
    table.ticks(52);
    let torque = table.bench.shaft(SERVO).torque;
    assert!((torque - 1.0).abs() < 0.05, "20 N·m/s for 50 ms: {torque}");
}

#[test]
fn speed_and_position_are_controlled() {
    let mut speed = rig(Mode::Speed);
    // Alone on the shaft, so that the other drive does not work against it.
    speed.nodes.remove(SERVO);
    speed.outputs.truncate(1);
    speed.predict = None;
    speed.plant.applied.truncate(1);
    speed.plant.seen.truncate(2);
    let mut held = table(&speed);
    held.arm();
    held.commands[0].1 = 12.0;
    held.ticks(400);
    assert!((held.bench.shaft(0).speed - 12.0).abs() < 0.02, "{}", held.bench.shaft(0).speed);

    let mut position = speed.clone();
    config(&mut position, 0).mode = Mode::Position;
    position.outputs[0].signal.what = SignalKind::Position;
    let mut held = table(&position);
    held.arm();
    let before = held.bench.shaft(0).position;
    held.commands[0].1 = 0.3;
    held.ticks(800);
    let turned = held.bench.shaft(0).position - before;
    assert!((turned - 0.3).abs() < 1e-3, "{turned}");
}

#[test]
fn wrong_drives_are_refused_with_a_message() {
    let set = |index: u16, kind: Type, value: i64| {
        with(|bench| {
            let entry = Entry::number(Object(index, 0), "", kind, Access::ReadOnly, value).mapped();
            bench.drive(SERVO).unwrap().objects().add(entry);
        })
        .refused()
    };
    // This way does not change what a reset of communication restores, but it changes the drive's own objects.
    assert_eq!(
        set(0x6076, Type::U32, 40_000),
        "servo (node 4): its rated torque is 40 N·m (object 6076), the rig says 4 N·m: correct `T_rated`, or the node id"
    );
    assert_eq!(
        set(0x6502, Type::U32, 0b1),
        "servo (node 4): it offers no mode for this command (object 6502 is 0x00000001)"
    );
    assert_eq!(
        set(0x6007, Type::I16, 0),
        "servo (node 4): object 6007:00 could not be written: attempt to write a read only object (abort code 0x06010002)"
    );
    assert_eq!(set(0x605A, Type::I16, 6), "servo (node 4): object 605A:00 was set to 2 (0x2) and holds 6 (0x6)");
    let unmappable = with(|bench| {
        let entry = Entry::number(Object(0x6071, 0), "", Type::I16, Access::ReadWrite, 0);
        bench.drive(LOAD).unwrap().objects().add(entry);
    })
    .refused();
    assert_eq!(
        unmappable,
        "load (node 3): object 1600:02 could not be written: object cannot be mapped to the PDO (abort code 0x06040041)"
    );
    let mut nobody = rig(Mode::Torque);
    let mut bench = SimulatedBench::new(&nobody, None, 1).unwrap();
    config(&mut nobody, LOAD).node = 9;
    assert_eq!(
        Table::with(&nobody, bench.clone(), Options::default()).refused(),
        "node 3, which the rig does not name, is on the bus (frame 0x703): a second master, or a forgotten drive"
    );
    bench.advance(60_000_000, &mut |_, _| {});
    let mut late = Table::with(&nobody, bench, Options::default());
    late.now_ns = 60_000_000;
    assert_eq!(
        late.refused(),
        "load (node 9): it does not answer a reset of communication: is it powered, has it this node id, is the bit \
         rate right?"
    );
    let mut odd = rig(Mode::Torque);
    odd.period_ns = 1_234_567;
    assert_eq!(
        table(&odd).refused(),
        "load (node 3): a period of 1234.567 µs can't be told to it (object 60C2 takes 1 to 255 times a power of ten)"
    );
    let mut boundless = rig(Mode::Torque);
    config(&mut boundless, SERVO).max_speed = None;
    let mut unlimited = table(&boundless);
    unlimited.bench.drive(SERVO).unwrap().objects().remove(Object(0x6080, 0));
    assert_eq!(
        unlimited.refused(),
        "servo (node 4): neither the rig nor the drive says its greatest speed: give `speed_max`"
    );
}

#[test]
fn a_mapping_with_a_wrong_read_back_is_refused() {
    // The simulation continues; the answer to one read-back is falsified on the bus.
    let mut table = table(&rig(Mode::Torque));
    table.until(Step::Configure);
    let mut bent = false;
    while table.fieldbus.refusal().is_none() {
        assert!(table.fieldbus.step() <= Step::Start, "it was not noticed");
        let mut ours = Vec::new();
        table.now_ns += 1_000_000;
        let now_ns = table.now_ns;
        table.fieldbus.end(now_ns, &mut |_, frame| ours.push(frame));
        let mut answers = Vec::new();
        for frame in ours {
            table.bench.receive(0, &frame, now_ns, &mut |_, frame| answers.push(frame));
        }
        for mut frame in answers {
            if frame.id() == 0x584 && frame.data()[..4] == [0x43, 0x00, 0x1A, 0x02] {
                let mut data = [0; 8];
                data.copy_from_slice(frame.data());
                data[6] = 0x78;
                frame = Frame::new(0x584, &data);
                bent = true;
            }
            table.fieldbus.receive(0, &frame, now_ns, &mut |_, _| {});
        }
    }
    assert!(bent);
    let refusal = table.fieldbus.refusal().unwrap();
    assert_eq!(
        table.fieldbus.explain(refusal),
        "servo (node 4): object 1A00:02 was set to 1618411536 (0x60770010) and holds 1618477072 (0x60780010)"
    );
}

#[test]
fn wrong_signs_and_scales_are_refused() {
    let refused = |text: &str| {
        let rig = rig(Mode::Torque);
        let mut table = table(&rig);
        table.bench.hook(fault_injection::read(text, &rig).unwrap());
        table.refused()
    };
    let words = [
        ("servo torque scale -1 at 0 s", "servo (node 4): it turned against the command"),
        ("load encoder scale -1 at 0 s", "load (node 3): it turned against the command"),
        ("servo speed scale 10 at 0 s", "servo (node 4): by its position it turned by"),
        ("servo torque told scale -1 at 0 s", "servo (node 4): it was told"),
        ("load safe torque off at 0 s", "load (node 3): it stays in \"fault\", error 0x5441: safe torque off"),
        ("load mode 9 at 0 s", "load (node 3): it was given mode 10 and shows mode 9"),
        ("servo no answers at 0 s", "servo (node 4): 99"),
        ("servo torque scale 0 at 0 s", "servo (node 4): it did not move at 0.600"),
    ];
    for (text, start) in words {
        let refusal = refused(text);
        assert!(refusal.starts_with(start), "{text}: {refusal}");
    }
}

#[test]
fn a_drive_that_ignores_our_missing_heartbeat_is_refused() {
    let mut table = table(&rig(Mode::Torque));
    table.until(Step::AwaitEnable);
    // Changed after the configuration: the read-back cannot detect it, but the time-out test does.
    table.bench.drive(LOAD).unwrap().objects().set(Object(0x6007, 0), 0);
    assert_eq!(
        table.refused(),
        "load (node 3): our life sign had stopped for 35 ms and it was still enabled: its time-out does not work"
    );
}

/// However long the watchdog is, and however soon the operator enables: a drive counts from our first life sign after its
/// configuration, and that must come before the drive has torque.
#[test]
fn a_drive_monitors_us_before_it_is_enabled() {
    for seed in seeds(24) {
        println!("FRIC_SEED={seed} repeats it");
        let mut chance = Chance(seed);
        let mut rig = if seed % 3 == 0 { converter() } else { rig(Mode::Torque) };
        let most_ms = [1_000, 10_000][chance.below(2) as usize];
        rig.watchdog_ns = (100 + chance.below(most_ms - 99)) * 1_000_000;
        let steady_ns = chance.below(3_000) * 1_000_000;
        let mut table = Table::new(&rig, Some(shaft(0.012, 0.001)), Options { steady_ns, ..Options::default() });
        table.until(Step::AwaitEnable);
        table.ticks(chance.below(3_000) as usize);
        assert!(table.fieldbus.request(Request::Enable));
        table.until(Step::TimeoutTest);
        table.until(Step::Reenable);
        for node in 0..rig.nodes.len() {
            let Some(status) = table.fieldbus.status(node) else { continue };
            let (limit_ms, _) = status.timeout.expect("it monitors us");
            let measured_ms = status.timeout_measured_ns.expect("tested") / 1_000_000;
            // Not the distance of two life signs less: the last one is sent when the test begins.
            let least_ms = u64::from(limit_ms).saturating_sub(55);
            assert!(measured_ms >= least_ms, "seed {seed}: {measured_ms} ms instead of {limit_ms} ms");
        }
    }
}

#[test]
fn another_master_is_refused_or_reported() {
    for (id, at_start) in [(0x080, true), (0x000, true), (0x603, true), (0x705, true), (0x204, true), (0x080, false)] {
        let mut table = table(&rig(Mode::Torque));
        if at_start {
            table.ticks(100);
        } else {
            table.arm();
        }
        table.fieldbus.receive(0, &Frame::new(id, &[1, 0]), table.now_ns, &mut |_, _| {});
        if at_start {
            let refusal = table.refused();
            if id == 0x705 {
                assert!(refusal.starts_with("node 5, which the rig does not name"), "{refusal}");
                continue;
            }
            assert!(refusal.starts_with(&format!("somebody else sends frame 0x{id:03X}")), "{refusal}");
        } else {
            assert_eq!(troubles(&mut table), [(None, TroubleKind::ForeignMaster(id))]);
        }
    }
}

/// Arms the rig and injects a fault one tick later; returns the troubles that the supervisor receives, and the ticks
/// until then.
fn after(text: &str) -> (Vec<(Option<usize>, TroubleKind)>, usize, Table) {
    let rig = rig(Mode::Torque);
    let mut table = table(&rig);
    table.arm();
    let hook: Hook = fault_injection::read(&format!("{text} at 0 s"), &rig).unwrap();
    table.bench.hook(hook);
    for tick in 1..=100 {
        table.tick();
        let heard = troubles(&mut table);
        if !heard.is_empty() {
            return (heard, tick, table);
        }
    }
    (Vec::new(), 100, table)
}

#[test]
fn faults_are_reported_in_time() {
    let emergency =
        |code, register| TroubleKind::Emergency(crate::canopen::service::Emergency { code, register, vendor: [0; 5] });
    let heard = |text: &str| {
        let (heard, ticks, _) = after(text);
        (heard.into_iter().map(|(node, kind)| (node.unwrap(), kind)).collect::<Vec<_>>(), ticks)
    };
    assert_eq!(heard("load emergency 0x4310"), (vec![(LOAD, emergency(0x4310, 1))], 1));
    let (kinds, ticks) = heard("servo fault 0x2310");
    assert_eq!((kinds[0], ticks), ((SERVO, emergency(0x2310, 1)), 1));
    let (kinds, ticks) = heard("servo reset");
    assert!(ticks <= 52 && kinds == [(SERVO, TroubleKind::HeartbeatLost)], "{kinds:?} after {ticks}");
    let (kinds, ticks) = heard("load no heartbeat");
    assert!(ticks <= 72 && kinds == [(LOAD, TroubleKind::HeartbeatLost)], "{kinds:?} after {ticks}");
    let (kinds, ticks) = heard("load mode 9");
    assert_eq!((kinds, ticks <= 2), (vec![(LOAD, TroubleKind::Mode(9))], true));
    let (kinds, ticks) = heard("load ignores commands");
    assert_eq!((kinds, ticks <= 7), (vec![(LOAD, TroubleKind::NotFollowing)], true));
    let (kinds, ticks) = heard("servo safe torque off");
    assert_eq!((kinds[0], ticks), ((SERVO, emergency(0x5441, 1)), 1));
    let (kinds, ticks) = heard("servo pre-operational");
    assert!(ticks <= 21 && kinds[0] == (SERVO, TroubleKind::Nmt(NmtState::PreOperational)), "{kinds:?} {ticks}");
    // Missing answers are detected by their age alone.
    let (kinds, _, table) = after("load no answers");
    assert_eq!(kinds, []);
    let reading = table.fieldbus.reading(abi::rig::Signal { node: LOAD, what: SignalKind::Torque });
    assert_eq!(reading.age, 100);
    let (.., table) = after("load encoder frozen");
    assert_eq!(table.fieldbus.reading(abi::rig::Signal { node: LOAD, what: SignalKind::Position }).age, 0);
}

#[test]
fn the_shaft_stops_when_the_master_dies() {
    let mut table = table(&rig(Mode::Torque));
    table.arm();
    table.commands[SERVO].1 = 1.0;
    table.ticks(50);
    let died = table.now_ns;
    assert!(table.bench.shaft(SERVO).speed > 1.0);
    // We send nothing any more.
    let mut states = Vec::new();
    while table.now_ns < died + 100_000_000 {
        table.now_ns += 100_000;
        let now_ns = table.now_ns;
        table.bench.advance(now_ns, &mut |_, _| {});
        let both = [LOAD, SERVO].map(|node| table.bench.drive(node).unwrap().state());
        if states.last() != Some(&(both)) {
            states.push(both);
            assert!(now_ns - died <= 6_000_000 || states.len() > 1, "{states:?}");
        }
    }
    assert_eq!(states.first(), Some(&[State::Enabled; 2]));
    assert_eq!(states.get(1), Some(&[State::QuickStop; 2]));
    assert_eq!(states.last(), Some(&[State::SwitchOnDisabled; 2]));
    assert!(table.bench.shaft(SERVO).speed.abs() < 0.06);
}

#[test]
fn prepared_frames_stop_both_drives() {
    let mut table = table(&rig(Mode::Torque));
    table.arm();
    table.commands[LOAD].1 = 1.0;
    table.ticks(50);
    let frames = table.fieldbus.stop_frames(0).to_vec();
    let texts: Vec<String> = frames.iter().map(|frame| frame.to_string()).collect();
    assert_eq!(texts, ["204#02000000", "220#00", "203#02000000", "080#"], "the emulating drive after the other");
    for frame in frames {
        table.bench.receive(0, &frame, table.now_ns, &mut |_, _| {});
    }
    assert_eq!([LOAD, SERVO].map(|node| table.bench.drive(node).unwrap().state()), [State::QuickStop; 2]);
    for frame in table.fieldbus.off_frames(0).to_vec() {
        table.bench.receive(0, &frame, table.now_ns, &mut |_, _| {});
    }
    assert_eq!([LOAD, SERVO].map(|node| table.bench.drive(node).unwrap().state()), [State::SwitchOnDisabled; 2]);
}

#[test]
fn a_device_is_read_and_commanded() {
    let rig = rig(Mode::Torque);
    let mut table = table(&rig);
    table.bench.hook(fault_injection::read("panel.enable = 0 at 500 ms for 100 ms", &rig).unwrap());
    let enable = abi::rig::Signal { node: PANEL, what: SignalKind::Field(0, 0) };
    assert_eq!(table.fieldbus.reading(enable).age, Reading::NEVER);
    table.ticks(499);
    assert_eq!(table.fieldbus.reading(enable).value, 1.0);
    table.ticks(2);
    let reading = table.fieldbus.reading(enable);
    assert!(reading.value == 0.0 && reading.age <= 1, "{reading:?}");
    table.ticks(100);
    assert_eq!(table.fieldbus.reading(enable).value, 1.0);
    // The lamp: sent on change, and every 100 ms.
    table.arm();
    table.log.clear();
    table.commands[PANEL].1 = 1.0;
    table.ticks(250);
    let lamps = table.log.iter().filter(|(_, ours, frame)| *ours && frame.id() == 0x220).count();
    assert!((3..=4).contains(&lamps), "{lamps}");
    assert_eq!(table.bench.value(PANEL, 1, 0), Some(1.0));
}

#[test]
fn synchronous_commands_wait_for_sync() {
    let mut rig = rig(Mode::Torque);
    config(&mut rig, SERVO).at_sync = true;
    rig.nodes[SERVO].delay = 0.0;
    rig.nodes[SERVO].lag = 0.0;
    let mut table = table(&rig);
    table.arm();
    table.commands[SERVO].1 = 1.0;
    table.tick();
    assert_eq!(table.bench.shaft(SERVO).torque, 0.0, "sent, but no SYNC since");
    table.tick();
    assert_eq!(table.bench.shaft(SERVO).torque, 1.0);
}

#[test]
fn a_simulated_vlt_has_its_scale_and_refresh() {
    let mut rig = rig(Mode::Torque);
    config(&mut rig, SERVO).profile = "vlt5000".to_string();
    let refused = Fieldbus::new(&rig, Options::default()).unwrap_err();
    assert!(refused.contains("DeviceNet"), "{refused}");
    rig.watchdog_ns = 5_000_000;
    let options = Options { simulated: true, ..Options::default() };
    let mut table = Table::new(&rig, Some(shaft(0.012, 0.001)), options);
    table.arm();
    table.log.clear();
    table.commands[SERVO].1 = 2.0;
    table.ticks(20);
    let told = table.log.iter().rev().find(|(_, ours, frame)| *ours && frame.id() == 0x204).unwrap().2;
    assert_eq!(told.data(), [0x0F, 0, 0x00, 0x20], "half of 0x4000");
    assert!((table.value(SERVO, SignalKind::Torque) - 2.0).abs() < 0.01);
    // Its answers change only in every other tick.
    let speeds: Vec<_> = table
        .log
        .iter()
        .filter(|(_, ours, frame)| !*ours && frame.id() == 0x184)
        .map(|(.., frame)| frame.data()[4..8].to_vec())
        .collect();
    let changes = speeds.windows(2).filter(|pair| pair[0] != pair[1]).count();
    assert!((8..=10).contains(&changes), "{changes} of {}", speeds.len());
    assert_eq!(table.fieldbus.status(SERVO).unwrap().timeout.unwrap().0, 1000, "the least it can");
}

/// One drive whose profile has node guarding alone.
fn converter() -> Rig {
    let mut rig = rig(Mode::Speed);
    rig.nodes.remove(SERVO);
    rig.outputs.truncate(1);
    rig.predict = None;
    rig.plant.applied.truncate(1);
    rig.plant.seen.truncate(2);
    let own = config(&mut rig, 0);
    own.profile = "fc302".to_string();
    own.speed_unit = std::f64::consts::PI / 30.0;
    rig
}

#[test]
fn a_converter_of_the_fc302_kind_uses_node_guarding() {
    let rig = converter();
    let mut table = table(&rig);
    table.arm();
    let status = table.fieldbus.status(0).unwrap();
    assert_eq!(status.mode, 2);
    assert!(matches!(status.timeout, Some((100..=102, profiles::Life::Guarding))), "{status:?}");
    table.commands[0].1 = 50.0;
    table.ticks(600);
    assert!((table.bench.shaft(0).speed - 50.0).abs() < 0.2);
    let guards = table.log.iter().filter(|(.., frame)| Service::of(frame) == Service::GuardRequest(3)).count();
    assert!(guards > 10, "{guards}");
}

#[test]
fn hooks_are_parsed_or_refused_with_a_message() {
    let rig = rig(Mode::Torque);
    let read = |text: &str| fault_injection::read(text, &rig);
    let hook = read("servo encoder frozen when load.speed > 10 rad/s for 20 ms").unwrap();
    assert_eq!((hook.node, hook.effect, hook.lasts_ns), (SERVO, Effect::EncoderFrozen, Some(20_000_000)));
    let signal = abi::rig::Signal { node: LOAD, what: SignalKind::Speed };
    assert_eq!(hook.start, Start::When { signal, above: true, level: 10.0 });
    assert_eq!(read("load answers late 2 ms at 1 s").unwrap().effect, Effect::AnswersLate(2_000_000));
    assert_eq!(read("load fault 0x2310 at 3 s of run").unwrap().start, Start::OfRun(3_000_000_000));
    for (text, word) in [
        ("load fault 0x2310", "it doesn't say when"),
        ("load fault 2310 at 1 s", "`2310` is no code such as 0x2310"),
        ("lode fault 0x2310 at 1 s", "the rig has no `lode`, only load, servo, panel"),
        ("load burns at 1 s", "nothing is known of `burns`"),
        ("panel.enabel = 0 at 1 s", "`panel` has no signal `enabel`"),
        ("load.speed = 0 at 1 s", "only signals of devices can be set"),
        ("panel reset at 1 s", "`panel` is a device"),
        ("load reset at 1 parsec", "`1 parsec` is no time"),
        ("load reset at soon", "its unit is missing"),
    ] {
        let error = read(text).unwrap_err();
        assert!(error.contains(word), "{text}: {error}");
    }
}

/// The start-up over a bus with its bit times: here the frames take time.
#[test]
fn two_drives_start_up_over_a_bus() {
    use crate::can::sim::Simulation;
    use crate::can::{Bus, Received};
    use crate::realtime::clock::Clock;
    let rig = rig(Mode::Torque);
    let simulation = Simulation::new();
    let bus = simulation.bus("can0", 1_000_000);
    let mut master = bus.port("fric");
    let bench = SimulatedBench::new(&rig, Some(shaft(0.012, 0.001)), 7).unwrap();
    let bench = attend(&simulation, &[bus], &rig, bench);
    let mut fieldbus = Fieldbus::new(&rig, Options::default()).unwrap();
    let (mut tick, mut late) = (0, 0);
    while fieldbus.step() != Step::Armed {
        tick += 1;
        assert!(tick < 20_000, "stays at {:?}", fieldbus.step());
        let start_ns = tick * rig.period_ns;
        simulation.sleep_until(start_ns);
        fieldbus.begin(&mut |_, frame| master.send(frame).unwrap());
        for share in [60, 95] {
            simulation.sleep_until(start_ns + rig.period_ns * share / 100);
            while let Some(received) = master.receive() {
                let Received::Frame(frame, stamp_ns) = received else { panic!("{received:?}") };
                late +=
                    u64::from(share == 95 && fieldbus.step() == Step::AwaitArm && (0x180..0x300).contains(&frame.id()));
                fieldbus.receive(0, &frame, stamp_ns, &mut |_, frame| master.send(frame).unwrap());
            }
            if share == 60 {
                for output in &rig.outputs {
                    fieldbus.command(output.signal, fieldbus.wanted(output.signal));
                }
                fieldbus.end(simulation.now_ns(), &mut |_, frame| master.send(frame).unwrap());
            }
        }
        match fieldbus.step() {
            Step::AwaitEnable => _ = fieldbus.request(Request::Enable),
            Step::AwaitArm => _ = fieldbus.request(Request::Arm),
            Step::Refused => panic!("{}", fieldbus.explain(fieldbus.refusal().unwrap())),
            _ => {}
        }
    }
    assert_eq!(late, 0, "all answers come in the first 0.6 of the period");
    assert_eq!(bench.borrow().shaft(LOAD).torque, 0.0);
    assert_eq!(master.health().lost, 0);
}

#[test]
fn a_speed_drive_turns_a_torque_drive_for_its_polarity_check() {
    let mut rig = rig(Mode::Torque);
    config(&mut rig, SERVO).mode = Mode::Speed;
    rig.outputs[SERVO].signal.what = SignalKind::Speed;
    (rig.outputs[LOAD].low, rig.outputs[LOAD].high) = (-1.0, 1.0);
    table(&rig).arm();
    let mut table = table(&rig);
    table.bench.hook(fault_injection::read("load speed scale -1 at 0 s", &rig).unwrap());
    let refusal = table.refused();
    assert!(refusal.starts_with("load (node 3): by its position it turned by"), "{refusal}");
}

#[test]
fn the_polarity_check_respects_the_limit_of_the_rig() {
    let mut rig = rig(Mode::Torque);
    (rig.outputs[LOAD].low, rig.outputs[LOAD].high) = (-0.1, 0.5);
    let mut table = table(&rig);
    table.until(Step::AwaitEnable);
    table.fieldbus.request(Request::Enable);
    let mut most = 0.0f64;
    while table.fieldbus.step() != Step::AwaitArm {
        table.tick();
        most = most.max(table.fieldbus.wanted(rig.outputs[LOAD].signal).abs());
    }
    assert!((0.005..=0.03).contains(&most), "{most} N·m");
}
