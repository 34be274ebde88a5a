//! Hashes of everything that the back ends generate from the library: a refactoring must not change them.
//!
//! One line for each model and method: images for both processors, C, and lanes of each width, as the first twelve
//! digits of SHA-256. Run `cargo bench --bench frozen > before.txt`, and compare with `diff` after the change.

#[path = "../src/project.rs"]
#[allow(dead_code, unused_imports, reason = "the command uses more of it")]
mod project;

mod compile {
    pub use compiler::Sources;
}

use abi::image::{Target, sha256};
use abi::plan::Method;
use compiler::codegen::lanes::{self, Width};
use compiler::codegen::{c, image};
use compiler::{Changes, Sources, load};

/// The step of fixed methods, s.
const STEP: f64 = 1e-3;

fn main() {
    for module in project::Disk.modules() {
        for (name, text) in project::Disk.library(&module).into_iter().flatten() {
            let loaded = load(&name, &text, &project::Disk);
            let models: Vec<String> = loaded.models().iter().map(|model| model.name.text.clone()).collect();
            for model in models {
                for method in Method::ALL {
                    let hashes = match made(&name, &text, &model, method) {
                        Ok(all) => all.iter().map(|bytes| short(bytes)).collect::<Vec<_>>().join(" "),
                        Err(code) => code,
                    };
                    println!("{module} {model} {method:?} {hashes}");
                }
            }
        }
    }
}

/// The output of each back end for a model; or the code of the first error, as for a model with an open slot.
fn made(name: &str, text: &str, model: &str, method: Method) -> Result<Vec<Vec<u8>>, String> {
    let mut loaded = load(name, text, &project::Disk);
    let changes = Changes {
        method: Some(method),
        step: (method != Method::Adaptive).then_some(STEP),
        any_step: true,
        ..Changes::default()
    };
    let built = compiler::build(&mut loaded, &project::Disk, model, &changes, &mut Vec::new());
    let mut built = built.map_err(|found| found.first().map_or_else(String::new, |first| first.code.to_string()))?;
    built.program.size_rings(STEP);
    let program = &built.program;
    let (description, functions) = (&program.description, compiler::functions(program, method));
    let mut all = Vec::new();
    for target in Target::ALL {
        let image = image::image(&functions, description, &program.params, target, &[]);
        all.push(image.map_err(|why| why.to_string())?.to_bytes());
    }
    all.push(c::source(&functions, description, &program.params).into_bytes());
    let step = match method {
        Method::Adaptive => compiler::codegen::tiering::of_lanes(program, method).map(|(_, func)| func),
        _ => Some(compiler::codegen::tiering::step(program, method)),
    };
    for width in Width::ALL {
        let lanes = step
            .as_ref()
            .map(|step| lanes::bytes(step, &description.layout, description.pool.len(), width, width.vectors(), None));
        all.push(match lanes {
            Some(Ok(bytes)) => bytes.code,
            Some(Err(why)) => why.to_string().into_bytes(),
            None => Vec::new(),
        });
    }
    Ok(all)
}

/// The first digits of a hash.
fn short(bytes: &[u8]) -> String {
    sha256(bytes).iter().take(6).map(|byte| format!("{byte:02x}")).collect()
}
