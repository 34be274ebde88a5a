//! Locates the crossings of switching surfaces within a step.
//!
//! In: a [`Step`] and the values of the surfaces along it. Out: brackets in ascending order. At the near end of a
//! bracket every condition has its old value; at its far end some have their new one.

use super::fused::Fused;
use super::step::{Step, System, copy};

/// The bracket of a crossing, in θ of the step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Crossing {
    /// The end before the change.
    pub(crate) near: f64,
    /// The end after the change.
    pub(crate) far: f64,
}

/// The side of each surface, and the values along one step.
pub(crate) struct Surfaces {
    /// −1 or 1; 0 while the model has been on the surface since the last restart.
    sides: Vec<f64>,
    /// Whether a transition or an event depends on the surface: then leaving it is a crossing, too.
    decides: Vec<bool>,
    /// Whether derivatives have at most a kink there, no jump.
    bends: Vec<bool>,
    /// Which surfaces are searched for, and whether there is any.
    sought: Vec<bool>,
    any: bool,
    /// Whether all of these are conditions.
    pub(crate) only_conditions: bool,
    /// Values at the end of the last step, or at the present position of the search within this one.
    here: Vec<f64>,
    /// θ of the points to evaluate, ascending.
    nodes: Vec<f64>,
    /// Values at those points, one after the other.
    values: Vec<f64>,
    /// Values at a trial point, and at the far end of the last bracket.
    trial: Vec<f64>,
    far: Vec<f64>,
    /// Values and sides at the start of the step.
    start: Vec<f64>,
    start_sides: Vec<f64>,
    /// How often each has been met since `forget`.
    met: Vec<u32>,
    x: Vec<f64>,
    /// Bracket width in s.
    width: f64,
}

impl Surfaces {
    /// Searches for the surfaces on which the solution depends, or for those at which only `observed` quantities
    /// change. Brackets will be `width` seconds wide.
    pub(crate) fn new(system: &System, width: f64, observed: bool) -> Surfaces {
        let zeros = || vec![0.0; system.surfaces()];
        let roots = &system.instance.description().roots[..system.surfaces()];
        let sought: Vec<bool> = roots.iter().map(|root| root.observed == observed).collect();
        Surfaces {
            any: sought.contains(&true),
            sought,
            sides: zeros(),
            decides: roots.iter().map(|root| root.decides).collect(),
            bends: roots.iter().map(|root| root.bends).collect(),
            only_conditions: false,
            here: zeros(),
            nodes: Vec::new(),
            values: Vec::new(),
            trial: zeros(),
            far: zeros(),
            start: zeros(),
            start_sides: zeros(),
            met: vec![0; system.surfaces()],
            x: vec![0.0; system.n],
            width,
        }
    }

    /// Sets the sides from the values at (t, x).
    pub(crate) fn restart(&mut self, system: &mut System, t: f64, x: &[f64]) {
        if !self.any {
            return;
        }
        system.roots(t, x, &mut self.here);
        for (side, g) in self.sides.iter_mut().zip(&self.here) {
            *side = sign(*g);
        }
    }

    /// For a step that was too long: approximately where it first crosses, in θ, if it ends beyond a surface.
    pub(crate) fn guess(&mut self, system: &mut System, step: &Step) -> Option<f64> {
        if !self.any || !step.x1.iter().all(|x| x.is_finite()) {
            return None;
        }
        system.roots(step.end, &step.x1, &mut self.trial);
        let mut first = None;
        for i in 0..self.sides.len() {
            if self.sought[i] && self.sides[i] * self.trial[i] < 0.0 {
                self.met[i] += 1;
                let theta = self.here[i] / (self.here[i] - self.trial[i]);
                first = Some(first.map_or(theta, |first: f64| first.min(theta)));
            }
        }
        first
    }

    /// The side of each surface.
    pub(crate) fn sides(&self) -> &[f64] {
        &self.sides
    }

    /// Values at the end of the last step.
    pub(crate) fn here(&self) -> &[f64] {
        &self.here
    }

    /// Steps without a crossing have led to a point with these values.
    pub(crate) fn go_on(&mut self, here: &[f64]) {
        copy(here, &mut self.here);
    }

    /// Whether any surface is searched for.
    pub(crate) fn any(&self) -> bool {
        self.any
    }

    /// Whether (t, x) lies on the other side of a surface.
    pub(crate) fn turned(&mut self, system: &mut System, t: f64, x: &[f64]) -> bool {
        system.roots(t, x, &mut self.trial);
        (0..self.sides.len()).any(|i| self.sought[i] && self.sides[i] * self.trial[i] < 0.0)
    }

    /// The surfaces met most often since `forget`.
    pub(crate) fn often(&self) -> impl Iterator<Item = usize> {
        let most = self.met.iter().copied().max().unwrap_or(0);
        (0..self.met.len()).filter(move |&i| self.met[i] > 0 && 4 * self.met[i] >= most)
    }

    /// Restarts the counts.
    pub(crate) fn forget(&mut self) {
        self.met.fill(0);
    }

    /// Returns to the start of the last step.
    pub(crate) fn again(&mut self) {
        copy(&self.start, &mut self.here);
        copy(&self.start_sides, &mut self.sides);
    }

    /// Evaluates the surfaces along a step. A surface that is touched and left again between two points would be
    /// missed, so a parabola through the values gives additional points. After a restart (`fresh`) the model may be a
    /// rounding error beside a surface that it leaves at once, so the beginning gets more points. `known`: the values
    /// in the middle and at the end are already in the block.
    pub(crate) fn begin(&mut self, system: &mut System, step: &Step, fresh: bool, known: Option<&Fused>) {
        let m = self.sides.len();
        self.nodes.clear();
        self.values.clear();
        if !self.any {
            return;
        }
        copy(&self.here, &mut self.start);
        copy(&self.sides, &mut self.start_sides);
        if fresh {
            [1e-6, 1e-4, 1e-2, 0.1].into_iter().for_each(|theta| self.look(system, step, theta));
        }
        [0.25, 0.75].into_iter().for_each(|theta| self.look(system, step, theta));
        match known {
            Some(fused) => {
                for (theta, values) in [0.5, 1.0].into_iter().zip(fused.surfaces(system)) {
                    self.nodes.push(theta);
                    self.values.extend_from_slice(values);
                }
            }
            None => [0.5, 1.0].into_iter().for_each(|theta| self.look(system, step, theta)),
        }
        let first = self.values.len() - 4 * m;
        let [early, late, middle, end] = [0, 1, 2, 3].map(|row| first + row * m);
        for i in 0..m {
            if !self.sought[i] {
                continue;
            }
            let a = self.here[i];
            let [early, late, middle, end] = [early, late, middle, end].map(|row| self.values[row + i]);
            let parts = [(0.0, 1.0, [a, middle, end]), (0.0, 0.5, [a, early, middle]), (0.5, 0.5, [middle, late, end])];
            for (from, width, [a, b, c]) in parts {
                if self.sides[i] * a < 0.0 || self.sides[i] * b <= 0.0 || self.sides[i] * c <= 0.0 {
                    continue;
                }
                // a + θ (4b − 3a − c) + 2 θ² (a − 2b + c), least where its slope is 0.
                let (slope, bend) = (4.0 * b - 3.0 * a - c, 2.0 * (a - 2.0 * b + c));
                let part = -0.5 * slope / bend;
                let least = a + 0.5 * part * slope;
                let near = 0.2 * a.abs().min(b.abs()).min(c.abs());
                let theta = from + width * part;
                if part > 0.0 && part < 1.0 && self.sides[i] * least < near && !self.nodes.contains(&theta) {
                    self.look(system, step, theta);
                }
            }
        }
        // Insertion sort: few nodes, nearly sorted.
        for k in 1..self.nodes.len() {
            let mut k = k;
            while k > 0 && self.nodes[k - 1] > self.nodes[k] {
                self.nodes.swap(k - 1, k);
                let (front, back) = self.values.split_at_mut(k * m);
                front[(k - 1) * m..].swap_with_slice(&mut back[..m]);
                k -= 1;
            }
        }
    }

    fn look(&mut self, system: &mut System, step: &Step, theta: f64) {
        step.at(theta, &mut self.x);
        let from = self.values.len();
        self.values.resize(from + self.sides.len(), 0.0);
        system.roots(step.time(theta), &self.x, &mut self.values[from..]);
        self.nodes.push(theta);
    }

    /// The first crossing after θ = `from`, the present position of the search; none up to the end of the step.
    pub(crate) fn first(&mut self, system: &mut System, step: &Step, from: f64) -> Option<Crossing> {
        let m = self.sides.len();
        let mut near = from;
        for k in 0..self.nodes.len() {
            if self.nodes[k] <= near {
                continue;
            }
            copy(&self.values[k * m..(k + 1) * m], &mut self.far);
            if self.crossed(&self.far) {
                return Some(self.bracket(system, step, near, self.nodes[k]));
            }
            self.pass(false);
            near = self.nodes[k];
        }
        None
    }

    /// The surfaces crossed by the last bracket.
    pub(crate) fn changed(&self) -> impl Iterator<Item = usize> {
        (0..self.sides.len()).filter(|&i| self.crosses(i, self.far[i]))
    }

    /// Whether a transition or an event depends on one of them.
    pub(crate) fn decided(&self) -> bool {
        self.changed().any(|i| self.decides[i])
    }

    /// Whether derivatives have at most a kink at all of them.
    pub(crate) fn bend(&self) -> bool {
        self.changed().all(|i| self.bends[i] && !self.decides[i])
    }

    /// Whether a transition or an event depends on any surface.
    pub(crate) fn has_conditions(&self) -> bool {
        self.decides.contains(&true)
    }

    /// Continues after the last bracket, on the new sides.
    pub(crate) fn pass(&mut self, crossed: bool) {
        for (side, g) in self.sides.iter_mut().zip(&self.far) {
            if crossed || *side == 0.0 {
                *side = if *g == 0.0 { *side } else { sign(*g) };
            }
        }
        copy(&self.far, &mut self.here);
    }

    fn crossed(&self, g: &[f64]) -> bool {
        g.iter().enumerate().any(|(i, g)| self.crosses(i, *g))
    }

    /// Whether the value g of surface i is a crossing.
    fn crosses(&self, i: usize, g: f64) -> bool {
        if !self.sought[i] || self.only_conditions && !self.decides[i] {
            return false;
        }
        self.sides[i] * g < 0.0 || (self.decides[i] && self.sides[i] == 0.0 && g != 0.0 && !g.is_nan())
    }

    /// Narrows a bracket around the first crossing by the secant method, aimed half a width beside the zero on
    /// alternate sides, so that both ends close in; with bisection where that is slow.
    fn bracket(&mut self, system: &mut System, step: &Step, mut near: f64, mut far: f64) -> Crossing {
        let width = self.width.max(4.0 * f64::EPSILON * step.t) / step.h;
        let (mut slow, mut aim) = (0, -0.5);
        while far - near > width {
            let zero = |i: usize| near + (far - near) * (self.here[i] / (self.here[i] - self.far[i]));
            let first = self.changed().map(zero).fold(far, f64::min);
            let theta = if slow == 2 { 0.5 * (near + far) } else { first + aim * width };
            // If the secant is not a number, because the values are not, bisect.
            let theta = if theta > near && theta < far { theta } else { 0.5 * (near + far) };
            let theta = theta.clamp(near + 0.25 * width, far - 0.25 * width);
            step.at(theta, &mut self.x);
            system.roots(step.time(theta), &self.x, &mut self.trial);
            let before = far - near;
            if self.crossed(&self.trial) {
                far = theta;
                std::mem::swap(&mut self.far, &mut self.trial);
                aim = -0.5;
            } else {
                near = theta;
                std::mem::swap(&mut self.here, &mut self.trial);
                aim = 0.5;
            }
            slow = if far - near > 0.5 * before && slow < 2 { slow + 1 } else { 0 };
        }
        for i in 0..self.sides.len() {
            self.met[i] += u32::from(self.crosses(i, self.far[i]));
        }
        Crossing { near, far }
    }
}

fn sign(g: f64) -> f64 {
    if g > 0.0 {
        1.0
    } else if g < 0.0 {
        -1.0
    } else {
        0.0
    }
}
