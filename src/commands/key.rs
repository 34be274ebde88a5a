//! `fric key new`: generates a key pair to sign packages with.

use super::End;
use crate::args::KeyNew;
use crate::terminal::Terminal;
use crate::{project, signing};

pub fn new(args: &KeyNew, terminal: &mut Terminal) -> End {
    let secret = args.name.with_extension("key");
    let public = args.name.with_extension("pub");
    for path in [&secret, &public] {
        if path.exists() {
            terminal.error(&format!("{} is there already: a key is not written over", path.display()));
            return End::Failed;
        }
    }
    let (secret_text, public_text) = match signing::new_pair() {
        Ok(pair) => pair,
        Err(why) => {
            terminal.error(&format!("cannot make keys: {why}"));
            return End::Failed;
        }
    };
    let written = project::write_secret(&secret, secret_text.as_bytes())
        .and_then(|()| project::write(&public, public_text.as_bytes()));
    if let Err(error) = written {
        terminal.error(&format!("cannot write {}: {error}", secret.display()));
        return End::Failed;
    }
    terminal.line(&format!(
        "wrote {}: keep it to yourself; `fric build --sign {}` signs with it\n\
         wrote {}: `fric deploy --sign` registers it on a rig that trusts no key yet; else it goes into {} there",
        secret.display(),
        secret.display(),
        public.display(),
        runtime::package::signature::TRUSTED
    ));
    End::Fine
}
