//! What is in a package of a rig, read and judged as a whole: its two programs, its plan, the head of its logs.
//!
//! In: a [`Package`]. Out: its [`Contents`], each part sound by itself and all of them fitting each other, or the first
//! thing that does not. `check`, `inspect`, `install` and `run` all go through here, so that what one of them accepts is
//! what the others show and run.

use super::{Package, Refusal};
use crate::record::log::Sections;
use abi::encode::Encode;
use abi::image::Image;
use abi::live::Live;
use abi::rig::Rig;
use abi::table::Function;

/// What every program of a rig must have: it is started, stepped, and its outputs are read.
const NEEDED: [Function; 3] = [Function::Start, Function::Outputs, Function::Step];

/// A package, taken apart.
#[derive(Debug)]
pub struct Contents {
    /// The system with one part crossed out.
    pub control: Image,
    /// The crossed-out part.
    pub plant: Image,
    /// What judges sets of parameters while it runs.
    pub judge: Image,
    /// Which parameters may change then, and the conditions that the judge computes.
    pub live: Live,
    /// What joins them.
    pub rig: Rig,
    /// The head of every log of it: names and texts.
    pub head: Sections,
}

impl Package {
    /// Takes a package apart.
    ///
    /// # Errors
    /// What in it is missing, makes no sense or does not fit the rest. Whether this computer can run it is not asked.
    pub fn contents(&self) -> Result<Contents, Refusal> {
        let program = |name: &str, needed: &[Function]| -> Result<Image, Refusal> {
            let image = Image::read(self.section(name)?);
            let image = image.map_err(|why| Refusal::Malformed(format!("its program `{name}`: {why}")))?;
            let lacks = needed.iter().find(|function| image.entries[**function as usize].is_none());
            match lacks {
                _ if !image.params.iter().all(|value| !value.is_nan()) => {
                    Err(Refusal::Malformed(format!("its program `{name}`: a parameter is no number")))
                }
                Some(function) => {
                    Err(Refusal::Malformed(format!("its program `{name}` has no function `{}`", function.name())))
                }
                None => Ok(image),
            }
        };
        let (control, plant) = (program("control", &NEEDED)?, program("plant", &NEEDED)?);
        let judge = program("judge", &[Function::Outputs])?;
        let conditions = |why: String| Refusal::Malformed(format!("the conditions on its parameters: {why}"));
        let live = Live::from_bytes(self.section("live")?).map_err(|why| conditions(why.to_string()))?;
        let fault = live.fault(control.description.layout.params.range(), judge.description.layout.size());
        if let Some(fault) = fault {
            return Err(conditions(fault));
        }
        let plan = |why: &dyn std::fmt::Display| Refusal::Malformed(format!("the plan of its rig: {why}"));
        let rig = Rig::from_bytes(self.section("rig")?).map_err(|why| plan(&why))?;
        rig.fits(&control.description, &plant.description).map_err(|why| plan(&why))?;
        if rig.name != self.rig {
            return Err(plan(&format!("it is of `{}`, and the package of `{}`", rig.name, self.rig)));
        }
        let about = |why: String| Refusal::Malformed(format!("the head of its logs: {why}"));
        let head = Vec::from_bytes(self.section("head")?).map_err(|why| about(why.to_string()))?;
        let head = Sections(head);
        if head.text("rig") != Some(self.rig.as_str()) {
            return Err(about("it is of another rig".into()));
        }
        Ok(Contents { control, plant, judge, live, rig, head })
    }
}
