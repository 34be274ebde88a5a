//! Start values of states that change from run to run without compiling again.
//!
//! In: a flat system and the paths that will change. Out: for each of them that is a state a parameter, from which the
//! state starts: code and lanes then know of nothing but parameters.

use crate::frontend::system::*;
use abi::unit::Angle;

/// The path of the parameter from which a state starts. No declared parameter has such a name.
pub fn path(state: &str) -> String {
    format!("{state}(0)")
}

/// Gives each state among `paths` a parameter for its start value, whose default is the start value as written.
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
        // A parameter follows from others at most; each run gives this one anyway.
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

/// The paths of the parameters that change: of a state that of its start value.
pub fn params(system: &System, paths: &[String]) -> Vec<String> {
    let is_state = |path: &&String| system.vars.iter().any(|var| var.kind == VarKind::State && var.path == **path);
    paths.iter().map(|one| if is_state(&one) { path(one) } else { one.clone() }).collect()
}
