//! The chain from a designed motion to the fitted law on the rig's computer.

use crate::ssh::There;
use crate::{fine, folder, said};
use serde_json::Value;
use std::fs;
use std::path::Path;
use std::process::Command;

/// The chain of `examples/identification`: a motion is designed, a rig with simulated drives follows it, its log is fitted,
/// the fitted law is predicted, and is installed on the rig's computer, which an sshd on this machine stands for. The
/// parameters of the rig lie within four standard deviations.
///
/// Mutant: a stiffness of 28 N·m/rad in the rig, which the fit finds as 28.04 ± 0.22.
#[test]
fn the_chain_finds_what_the_rig_was_given() {
    let example = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/identification");
    let folder = folder("chain");
    for file in fs::read_dir(&example).unwrap() {
        let path = file.unwrap().path();
        if path.is_file() {
            fs::copy(&path, folder.join(path.file_name().unwrap())).unwrap();
        }
    }
    let there = There::new(folder.clone());
    let deploy = there.words("deploy", &[]).split_off(2);
    let mut script = Command::new("sh");
    script.current_dir(&folder).arg("chain.sh").env("FRIC", env!("CARGO_BIN_EXE_fric"));
    script.env("XDG_CONFIG_HOME", folder.join("config")).env("RIG", &there.host).env("DEPLOY", deploy.join(" "));
    let output = script.output().unwrap();
    let said = said(&output);
    assert!(output.status.success(), "{said}");
    // The motion that stands in the example is the one that the script designs.
    let motion = |folder: &Path| fs::read_to_string(folder.join("motion.fric")).unwrap();
    assert_eq!(motion(&folder), motion(&example));
    let answer: Value = serde_json::from_str(&fs::read_to_string(folder.join("out/shaft.json")).unwrap()).unwrap();
    let given = [("fr.sigma0", 26.0), ("fr.sigma1", 0.4), ("fr.sigma2", 0.2), ("fr.Fc", 0.28), ("fr.Fs", 0.42)];
    for (path, value) in given.into_iter().chain([("fr.vs", 0.03)]) {
        let found = answer["parameters"].as_array().unwrap().iter().find(|one| one["path"] == path).unwrap();
        let scale = if found["unit"] == "mrad/s" { 1e-3 } else { 1.0 };
        let [at, sd] = ["value", "sd"].map(|name| scale * found[name].as_f64().unwrap());
        assert!((at - value).abs() < 4.0 * sd && sd < 0.1 * value, "{path} is {at} ± {sd}, not {value}");
    }
    assert!(said.contains("stability") && said.contains("twin"), "{said}");
    // What is installed there is the rig with the fitted law.
    let installed = there.dir.join(there.current().expect("it is installed"));
    let told = fine(&folder, &["inspect", installed.to_str().unwrap()]);
    assert!(told.contains("shaft_rig"), "{told}");
}
