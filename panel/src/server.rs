//! The server: listens on this computer alone, and at an address for others if that is asked for; gives each connection
//! its threads.

use crate::http::{self, Answer};
use crate::key::Key;
use crate::subject::Subject;
pub use crate::viewer::Bell;
use crate::viewer::Viewer;
use std::io::{self, Write};
use std::net::{Ipv4Addr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

/// The port that is tried first.
pub const PORT: u16 = 7420;
/// Ports that are tried, each after the one before.
const PORTS: u16 = 20;
/// Connections that are no sockets with a key.
const CONNECTIONS: usize = 32;
/// Sockets that have not sent the key.
const STRANGERS: usize = 8;
/// Sockets that have, at each address.
const VIEWERS: usize = 32;
/// Bytes of the stack of a thread.
const STACK: usize = 256 << 10;

/// An open panel.
pub struct Panel {
    own: Door,
    /// For others, who look.
    share: Option<Door>,
}

/// An address at which it listens.
struct Door {
    listener: TcpListener,
    shared: Arc<Shared>,
}

struct Shared {
    /// The names under which it is asked for, the first one for its link.
    names: Vec<String>,
    guests: bool,
    key: Key,
    subject: Arc<dyn Subject>,
    bell: Bell,
    connections: AtomicUsize,
    strangers: AtomicUsize,
}

/// Counts as long as it lives.
struct Counted<'a>(&'a AtomicUsize);

impl<'a> Counted<'a> {
    fn new(count: &'a AtomicUsize, most: usize) -> Option<Counted<'a>> {
        let one = Counted(count);
        (count.fetch_add(1, Ordering::Relaxed) < most).then_some(one)
    }
}

impl Drop for Counted<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Panel {
    /// Opens a panel at this port of 127.0.0.1, or at the next free one. `bell` is what the subject rings.
    ///
    /// # Errors
    /// Why it cannot be opened, in words.
    pub fn open(port: u16, subject: Arc<dyn Subject>, bell: Bell) -> Result<Panel, String> {
        let mut last = String::new();
        for port in (0..PORTS).filter_map(|more| port.checked_add(more)) {
            match TcpListener::bind((Ipv4Addr::LOCALHOST, port)) {
                Ok(listener) => {
                    let port = listener.local_addr().map_err(|why| why.to_string())?.port();
                    let names = vec![format!("127.0.0.1:{port}"), format!("localhost:{port}")];
                    return Ok(Panel { own: Door::new(listener, names, false, subject, bell)?, share: None });
                }
                Err(error) if error.kind() == io::ErrorKind::AddrInUse => last = error.to_string(),
                Err(error) => return Err(format!("127.0.0.1:{port}: {error}")),
            }
        }
        Err(format!("127.0.0.1:{port} and the {} ports after it: {last}; choose another --port", PORTS - 1))
    }

    /// Listens for others too, who look and may stop a rig. They have a key of their own.
    ///
    /// # Errors
    /// Why not, in words.
    pub fn shared_at(self, address: SocketAddr) -> Result<Panel, String> {
        if address.ip().is_unspecified() {
            return Err(format!(
                "{address} is no address that a page can have: name one of this computer, as `ip address` shows them"
            ));
        }
        let listener = TcpListener::bind(address).map_err(|why| format!("{address}: {why}; choose another --share"))?;
        let address = listener.local_addr().map_err(|why| why.to_string())?;
        let mut names = vec![address.to_string()];
        if address.port() == 80 {
            // Browsers leave it out.
            names.push(address.to_string().trim_end_matches(":80").into());
        }
        let Shared { subject, bell, .. } = &*self.own.shared;
        let share = Door::new(listener, names, true, subject.clone(), bell.clone())?;
        Ok(Panel { share: Some(share), ..self })
    }

    /// The link that opens it.
    pub fn link(&self) -> String {
        self.own.link()
    }

    /// The link for others.
    pub fn share_link(&self) -> Option<String> {
        self.share.as_ref().map(Door::link)
    }

    /// Serves until the process ends.
    ///
    /// # Errors
    /// Why it can no longer accept connections.
    pub fn serve(self) -> io::Result<()> {
        if let Some(share) = self.share {
            thread::Builder::new().name("panel for others".into()).spawn(move || share.serve())?;
        }
        self.own.serve()
    }
}

impl Door {
    fn new(
        listener: TcpListener,
        names: Vec<String>,
        guests: bool,
        subject: Arc<dyn Subject>,
        bell: Bell,
    ) -> Result<Door, String> {
        let (key, connections, strangers) = (Key::random()?, AtomicUsize::new(0), AtomicUsize::new(0));
        Ok(Door { listener, shared: Arc::new(Shared { names, guests, key, subject, bell, connections, strangers }) })
    }

    fn link(&self) -> String {
        format!("http://{}/#{}", self.shared.names[0], self.shared.key.text())
    }

    fn serve(self) -> io::Result<()> {
        loop {
            let stream = match self.listener.accept() {
                Ok((stream, _)) => stream,
                // The browser went away again, or this process has no file left for now.
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => continue,
                Err(_) => {
                    thread::sleep(Duration::from_millis(100));
                    continue;
                }
            };
            let shared = self.shared.clone();
            // Counted in the order of arrival, and not in that of the threads.
            let room = shared.connections.fetch_add(1, Ordering::Relaxed) < CONNECTIONS;
            let builder = thread::Builder::new().name("panel".into()).stack_size(STACK);
            builder.spawn(move || shared.connection(stream, room))?;
        }
    }
}

impl Shared {
    fn connection(&self, mut stream: TcpStream, room: bool) {
        let (rest, accepted) = {
            let _one = Counted(&self.connections);
            if !room {
                let full = Answer::Refused("503 Service Unavailable", "too many connections");
                let _ = stream.write_all(&http::response(&full));
                return;
            }
            let _ = stream.set_write_timeout(Some(Duration::from_secs(10)));
            let (answer, rest) = match http::head(&mut stream) {
                Ok(Ok(head)) => (http::answer(&head.bytes, &self.names), head.rest),
                Ok(Err(refused)) => (refused, Vec::new()),
                Err(_) => return,
            };
            let accepted = matches!(answer, Answer::Socket(_));
            if stream.write_all(&http::response(&answer)).is_err() {
                return;
            }
            (rest, accepted)
        };
        if accepted {
            self.socket(stream, rest);
        } else {
            // Shuts the writing side first: a reset would take back what the browser has not read yet.
            let _ = stream.shutdown(Shutdown::Write);
        }
    }

    fn socket(&self, stream: TcpStream, rest: Vec<u8>) {
        let Some(stranger) = Counted::new(&self.strangers, STRANGERS) else { return };
        let _ = stream.set_nodelay(true);
        let Ok(writing) = stream.try_clone() else { return };
        let viewer = Arc::new(Viewer::new(self.guests));
        let known = AtomicBool::new(false);
        let mut stranger = Some(stranger);
        let is_known = || known.load(Ordering::Acquire);
        thread::scope(|scope| {
            let writer = thread::Builder::new().name("panel writer".into()).stack_size(STACK);
            let started = writer.spawn_scoped(scope, || viewer.write(writing, &*self.subject, &is_known));
            if started.is_err() {
                return;
            }
            viewer.read(stream, rest, &self.key, &*self.subject, &mut || {
                stranger = None;
                let room = self.bell.add(&viewer, VIEWERS);
                known.store(room, Ordering::Release);
                room
            });
            if known.load(Ordering::Acquire) {
                self.bell.remove(&viewer);
                self.subject.left(viewer.page());
            }
        });
    }
}

#[cfg(test)]
mod tests;
