//! temp
use crate::ir::Func;
use crate::ir::build::{Build, Env};
use crate::program::Program;
use abi::Slot;
use abi::plan::Method;
/// temp
pub fn step(program: &Program, method: Method) -> Func {
    let mut b = Build::new("step");
    let layout = &program.description.layout;
    let n = layout.states.len as usize;
    let h = b.load(Slot::STEP);
    let t = b.load(Slot::TIME);
    let half = b.real(0.5);
    let h2 = b.mul(h, half);
    let x: Vec<_> = (0..n).map(|k| b.load(layout.states.slot(k))).collect();
    let mut f = |b: &mut Build, t, x: &[crate::ir::Value]| -> Vec<crate::ir::Value> {
        let mut env = Env::new();
        env.insert(Slot::TIME, t);
        for k in 0..n {
            env.insert(layout.states.slot(k), x[k]);
        }
        b.inline(&program.derivatives, &mut env);
        (0..n).map(|k| env[&layout.derivatives.slot(k)]).collect()
    };
    let step = |b: &mut Build, x: &[crate::ir::Value], h, k: &[crate::ir::Value]| -> Vec<_> {
        (0..n).map(|i| { let d = b.mul(h, k[i]); b.add(x[i], d) }).collect()
    };
    let k1 = f(&mut b, t, &x);
    let next = if method == Method::Euler {
        step(&mut b, &x, h, &k1)
    } else {
        let tm = b.add(t, h2);
        let te = b.add(t, h);
        let x2 = step(&mut b, &x, h2, &k1);
        let k2 = f(&mut b, tm, &x2);
        let x3 = step(&mut b, &x, h2, &k2);
        let k3 = f(&mut b, tm, &x3);
        let x4 = step(&mut b, &x, h, &k3);
        let k4 = f(&mut b, te, &x4);
        (0..n).map(|i| {
            let two = b.real(2.0);
            let a = b.add(k2[i], k3[i]);
            let a = b.mul(two, a);
            let a = b.add(k1[i], a);
            let a = b.add(a, k4[i]);
            let six = b.real(6.0);
            let a = b.div(a, six);
            let a = b.mul(h, a);
            b.add(x[i], a)
        }).collect()
    };
    let mut env = Env::new();
    let one = b.real(1.0);
    let c = b.load(Slot::COUNT);
    let c = b.add(c, one);
    let t = b.mul(c, h);
    env.insert(Slot::COUNT, c);
    env.insert(Slot::TIME, t);
    for k in 0..n { env.insert(layout.states.slot(k), next[k]); }
    if let Some(f) = &program.transitions { b.inline(f, &mut env); }
    b.inline(&program.outputs, &mut env);
    b.store_env(&env, |_| true);
    b.finish()
}
