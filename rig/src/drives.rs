//! `fric-rig drives`: simulated drives and devices of a packed rig, on buses that other programs can reach.
//!
//! In: a verified package, doors. Out: frames, and reports of state changes. The plant behind the drives is the
//! package's own compiled program.

use crate::packed::Open;
use crate::words;
use runtime::drive::serve::{Doors, Refused, Served};
use runtime::hil::emergency;

/// Serves them until Ctrl-C, or for this time, s; returns the exit code.
///
/// # Errors
/// The reason why they cannot be served.
pub fn drives(open: &Open, doors: &Doors, duration: Option<f64>, quiet: bool) -> Result<u8, String> {
    let rig = &open.contents.rig;
    let served = match Served::open(rig, Some(open.program("plant")?), doors) {
        Ok(served) => served,
        Err(Refused::Misused(why)) => {
            words::error(&why);
            return Ok(2);
        }
        Err(Refused::Failed(why)) => return Err(why),
    };
    emergency::guard();
    words::report(&format!("{}\n", served.describe(rig)));
    let mut told = |line: &str| {
        if !quiet {
            words::print(&format!("{line}\n"));
        }
    };
    served.serve(rig, duration, &|| emergency::requested_stop().is_some(), &mut told);
    Ok(0)
}
