//! The bus contract for kinds of buses that need no kernel with CAN.

mod contract;

use contract::Pair;
use runtime::can::sim::{Join, Simulation};
use runtime::can::slcan::Slcan;
use runtime::can::socketcand::{Client, Connection, Server};
use runtime::can::{Bus, Frame, Options, Received};
use runtime::realtime::clock::{Clock, Monotonic};

fn simulated(world: Simulation) -> impl Fn(&Options) -> Pair {
    move |options| {
        let bus = world.bus(&format!("at {} ns", world.now_ns()), 1_000_000);
        let Options { bit_rate, filter, listen_only } = options.clone();
        let (near, far) = (bus.join("near", Join { bit_rate, filter, listen_only }), bus.port("far"));
        let clock = world.clone();
        // Frames of the far end to a listen-only one must be acknowledged.
        let part = move |_| bus.take_down("near");
        Pair {
            near: Box::new(near),
            far: Box::new(far),
            now_ns: Box::new(move || clock.now_ns()),
            part: Box::new(part),
        }
    }
}

#[test]
fn simulated_in_simulated_time() {
    contract::check("sim", &simulated(Simulation::new()));
}

#[test]
fn simulated_in_real_time() {
    contract::check("sim, real time", &simulated(Simulation::real_time()));
}

#[test]
fn serial_over_a_pseudo_terminal() {
    contract::check("slcan", &|options| {
        let clock = Monotonic::new();
        let mut far = Slcan::door(None, clock).expect("a door");
        let path = far.path().expect("a door has a path").to_path_buf();
        let options = Options { bit_rate: Some(1_000_000), ..options.clone() };
        let near = Slcan::open(&path, &options, clock).expect("an adapter");
        // The door is notified that the bus is open.
        assert!(far.wait(clock.now_ns() + 5_000_000_000));
        while far.receive().is_some() {}
        Pair {
            near: Box::new(near),
            far: Box::new(far),
            now_ns: Box::new(move || clock.now_ns()),
            part: Box::new(drop),
        }
    });
}

/// Serves greetings until a client is connected.
fn served(
    server: &mut Server,
    clock: Monotonic,
    open: impl FnOnce() -> Client + Send + 'static,
) -> (Client, Connection) {
    let opening = std::thread::spawn(open);
    let mut connections: Vec<Connection> = Vec::new();
    while !opening.is_finished() {
        connections.extend(server.accept());
        for connection in &mut connections {
            while connection.receive().is_some() {}
        }
    }
    // Frames sent in the pause after the greetings would be lost.
    clock.sleep_until(clock.now_ns() + 30_000_000);
    (opening.join().expect("greeted"), connections.remove(0))
}

#[test]
fn text_over_tcp() {
    contract::check("socketcand", &|options| {
        let clock = Monotonic::new();
        let mut server = Server::listen(0, false, clock).expect("a port");
        let (port, options) = (server.port(), options.clone());
        let open = move || Client::open("127.0.0.1", port, "can0", &options, clock).expect("a gateway");
        let (near, far) = served(&mut server, clock, open);
        Pair {
            near: Box::new(near),
            far: Box::new(far),
            now_ns: Box::new(move || clock.now_ns()),
            part: Box::new(drop),
        }
    });
}

/// A frame that another thread sends arrives, whatever the bus is doing at the moment.
#[test]
fn prepared_frames_arrive() {
    let clock = Monotonic::new();
    let stop = Frame::new(0x201, &[2, 0, 0, 0]);
    let expect = |far: &mut dyn Bus| {
        let until_ns = clock.now_ns() + 5_000_000_000;
        while far.wait(until_ns) {
            while let Some(received) = far.receive() {
                if matches!(received, Received::Frame(frame, _) if frame == stop) {
                    return true;
                }
            }
        }
        false
    };

    let mut door = Slcan::door(None, clock).expect("a door");
    let options = Options { bit_rate: Some(500_000), ..Options::default() };
    let bus = Slcan::open(door.path().expect("a path"), &options, clock).expect("an adapter");
    let prepared = bus.prepare(stop).expect("a terminal can");
    assert!(std::thread::spawn(move || prepared.send()).join().expect("it ends"));
    assert!(expect(&mut door));

    let mut server = Server::listen(0, false, clock).expect("a port");
    let port = server.port();
    let open = move || Client::open("127.0.0.1", port, "can0", &Options::default(), clock).expect("a gateway");
    let opening = std::thread::spawn(open);
    let mut connections: Vec<Connection> = Vec::new();
    while !opening.is_finished() {
        connections.extend(server.accept());
        connections.iter_mut().for_each(|connection| while connection.receive().is_some() {});
    }
    let client = opening.join().expect("greeted");
    let prepared = client.prepare(stop).expect("a stream can");
    assert!(std::thread::spawn(move || prepared.send()).join().expect("it ends"));
    assert!(expect(&mut connections[1]), "on the connection of its own");
    assert!(client.prepare(Frame::remote(0x701, 1)).is_none(), "socketcand knows no remote frames");
}
