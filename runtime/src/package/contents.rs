//! Contents of a rig's package, decoded and checked as a whole: its programs, its plan, the head of its logs.
//!
//! In: a [`Package`]. Out: its [`Contents`], with each part valid and all parts consistent, or the first error.
//! `check`, `inspect`, `install` and `run` all use this, so that they accept, show and run the same.

use super::{Package, Refusal};
use crate::record::log::Sections;
use abi::encode::Encode;
use abi::image::Image;
use abi::live::Live;
use abi::rig::Rig;
use abi::table::Function;

/// Functions that every program of a rig must have: it is started and stepped, and its outputs are read.
const NEEDED: [Function; 3] = [Function::Start, Function::Outputs, Function::Step];

/// The decoded parts of a package.
#[derive(Debug)]
pub struct Contents {
    /// The system without the part that hardware replaces.
    pub control: Image,
    /// The part that hardware replaces.
    pub plant: Image,
    /// The program that computes the conditions on parameters at run time.
    pub judge: Image,
    /// Parameters that may change at run time, and their conditions.
    pub live: Live,
    /// The rig that connects them.
    pub rig: Rig,
    /// Head of all logs: names and texts.
    pub head: Sections,
}

impl Package {
    /// Decodes a package.
    ///
    /// # Errors
    /// A part that is missing, invalid or inconsistent with the others. Does not check whether this computer can run
    /// it.
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
