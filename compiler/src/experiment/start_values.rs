//! Start values of states that vary from run to run without recompilation.
//!
//! In: a flat system and the paths that vary. Out: for each state among them a parameter that holds its start value.
//! Generated code and lanes then need to handle parameters only.

use crate::frontend::system::*;
use abi::unit::Angle;

/// The path of the parameter for a state's start value. No declared parameter can have such a name.
pub fn path(state: &str) -> String {
    format!("{state}(0)")
}

/// Adds a parameter for the start value of each state among `paths`. Its default is the start value as written.
pub fn open(system: &mut System, paths: &[String]) {
    for state in system.var_ids() {
        let var = system.var(state);
        let initial = match var.definition {
            Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. } => initial,
            Definition::Missing | Definition::Free | Definition::Value(..) | Definition::Held { .. } => continue,
        };
        if !paths.contains(&var.path) {
            continue;
        }
        let place = system.span(initial);
        let param = VarId(system.vars.len() as u32);
        let mut start = system.var(state).clone();
        (start.path, start.kind) = (path(&start.path), VarKind::Param);
        (start.range, start.range_span) = (VarRange::default(), None);
        // A parameter may depend only on other parameters. Other start values default to 0, since each run sets them.
        let value = match crate::analysis::parameter_checks::moving(system, initial) {
            None => initial,
            Some(_) => system.push(Node::Number { value: 0.0, dimension: None, angle: Angle::Silent }, place),
        };
        start.definition = Definition::Value(value, Origin::Default);
        system.vars.push(start);
        let own = system.push(Node::Var(param), place);
        match &mut system.vars[state.0 as usize].definition {
            Definition::Continuous { initial, .. } | Definition::Sampled { initial, .. } => *initial = own,
            _ => unreachable!("it is a state"),
        }
    }
}

/// The paths of the varying parameters; for a state, that of its start value.
pub fn params(system: &System, paths: &[String]) -> Vec<String> {
    let is_state = |path: &&String| system.vars.iter().any(|var| var.kind == VarKind::State && var.path == **path);
    paths.iter().map(|one| if is_state(&one) { path(one) } else { one.clone() }).collect()
}
