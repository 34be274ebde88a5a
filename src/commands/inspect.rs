//! `fric inspect`: the contents of a package, verified.

use super::End;
use crate::args::Inspect;
use crate::project;
use crate::quantity::{count, significant};
use crate::terminal::{Style, Terminal};
use abi::foreign::shown;
use abi::image::Image;
use abi::live::{Live, Tunable};
use abi::rig::Rig;
use abi::{Description, Function};
use runtime::format::utc;
use runtime::package::signature::{Signer, Trusted, beside};
use runtime::package::{MOST_BYTES, Package, hash};
use std::fs;

pub fn inspect(args: &Inspect, terminal: &mut Terminal) -> End {
    match words(args, terminal) {
        Ok(text) => {
            terminal.print(&text);
            End::Fine
        }
        Err(why) => {
            terminal.error(&why);
            End::Failed
        }
    }
}

fn words(args: &Inspect, terminal: &Terminal) -> Result<String, String> {
    let path = &args.package;
    let about = |why: &dyn std::fmt::Display| format!("{}: {why}", path.display());
    if fs::metadata(path).map_err(|error| about(&error))?.len() > MOST_BYTES {
        return Err(about(&"it is larger than any package"));
    }
    let bytes = fs::read(path).map_err(|error| about(&error))?;
    let package = Package::read(&bytes).map_err(|why| about(&why))?;
    let contents = package.contents().map_err(|why| about(&why))?;
    let signature = fs::read_to_string(beside(path)).ok();
    let signed = match &args.trusted {
        Some(folder) => {
            let keys = Trusted::in_folder(folder)?;
            match keys.signer(&bytes, signature.as_deref()).map_err(|why| about(&why))? {
                Some(Signer { name, signed_s: Some(at) }) => format!("signed by {name} at {}", utc(at)),
                Some(Signer { name, signed_s: None }) => format!("signed by {name}"),
                None => return Err(format!("{} has no public key", folder.display())),
            }
        }
        None if signature.is_some() => "signed; --trusted DIR says by whom".into(),
        None => "not signed".into(),
    };
    let Package { fric, target, rig, sections } = &package;
    let mut out = format!(
        "{}\n  whole: {} bytes, SHA-256 {}\n  for {target}, made by fric {fric}; {signed}\n\n",
        terminal.styled(Style::Bold, rig),
        count(bytes.len() as u64),
        hash(&bytes)
    );
    let width = sections.iter().map(|section| section.name.chars().count()).max().unwrap_or(0);
    for section in sections {
        let size = count(section.bytes.len() as u64);
        out += &format!("  {:width$}  {size:>9} bytes  {}\n", section.name, &hash(&section.bytes)[..16]);
    }
    let programs = [("control", &contents.control), ("plant", &contents.plant), ("judge", &contents.judge)];
    for (name, image) in programs {
        out += &format!("\n  {name}: {}\n", program(image));
    }
    out += &format!("\n  {}\n", planned(&contents.rig));
    for set in contents.head.text("set").unwrap_or_default().lines() {
        out += &format!("  set {}\n", shown(set));
    }
    out += &settable(&contents.live);
    if args.sources {
        for section in sections {
            if let Some(name) = section.name.strip_prefix("source/") {
                out += &format!("\n--- {name}\n{}", shown(&String::from_utf8_lossy(&section.bytes)));
            }
        }
    }
    if let Some(folder) = &args.extract {
        for section in sections {
            let path = folder.join(safe(&section.name));
            project::write(&path, &section.bytes)
                .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        }
        out += &format!("\n  wrote {} files to {}\n", sections.len(), folder.display());
    }
    Ok(out)
}

/// The parameters that may change during a run.
fn settable(live: &Live) -> String {
    let (mut may, mut start) = (String::new(), String::new());
    for param in &live.params {
        match &param.place {
            Tunable::Live(..) => may += &format!(" {}", shown(&param.path)),
            Tunable::Start(why) => start += &format!("\n    {}: {}", shown(&param.path), shown(why)),
        }
    }
    let nothing = || " nothing".to_string();
    let [may, start] = [may, start].map(|names| if names.is_empty() { nothing() } else { names });
    format!("\n  may be set while it runs:{may}\n  only a start reads:{start}\n")
}

/// The plan of a rig: period, buses, nodes.
fn planned(rig: &Rig) -> String {
    let mut out = format!("rig: {} Hz", significant(1e9 / rig.period_ns as f64, 6));
    for (at, bus) in rig.buses.iter().enumerate() {
        let nodes: Vec<&str> = rig.nodes.iter().filter(|node| node.bus == at).map(|node| node.name.as_str()).collect();
        out += &format!("; bus {} on {}: {}", bus.name, bus.address, nodes.join(", "));
    }
    out
}

/// A summary of a program in one line.
fn program(image: &Image) -> String {
    let Description { name, layout, .. } = &image.description;
    let functions: Vec<&str> = Function::ALL
        .into_iter()
        .zip(&image.entries)
        .filter(|(_, entry)| entry.is_some())
        .map(|(function, _)| function.name())
        .collect();
    let features: Vec<&str> = image.features.iter().map(|feature| feature.name()).collect();
    let with = if features.is_empty() { String::new() } else { format!(" with {}", features.join(", ")) };
    format!(
        "{name}, {} states, {} parameters; {} bytes of code for {}{with}: {}",
        layout.states.len,
        layout.params.len,
        count(image.code.len() as u64),
        image.target.name(),
        functions.join(", ")
    )
}

/// The name of a section as a file name that cannot leave its folder.
fn safe(name: &str) -> std::path::PathBuf {
    name.split('/').filter(|part| !matches!(*part, "" | "." | "..")).collect()
}

#[test]
fn no_section_leaves_its_folder() {
    assert_eq!(safe("source/../../etc/passwd"), std::path::Path::new("source/etc/passwd"));
    assert_eq!(safe("/control"), std::path::Path::new("control"));
}
