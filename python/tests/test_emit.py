"""Source for numpy, jax, casadi and sympy computes what the compiler's own code computes, within rounding.

Mutants tried by hand, each fails: a difference on the right of a difference without parentheses; the operands of `<`
exchanged; inputs in the opposite order; a table without its last row; `==` as `<=`.
"""

import importlib.util
import math
import random
import subprocess

import numpy as np
import pytest

import fric
from fric import _fric

DIALECTS = ["numpy", "jax", "casadi", "sympy"]


def imported(dialect):
    """The library of a dialect; without it the test is counted as skipped."""
    found = pytest.importorskip(dialect)
    if dialect == "jax":
        found.config.update("jax_enable_x64", True)
    return found


def library():
    """Models of the library that can stand alone."""
    for name in _fric.library_models():
        try:
            yield fric.model(name)
        except fric.CompileError:
            continue


def within(chance, quantity, around=None):
    """A number in the range of a quantity: near another one, or of any size."""
    low, high = quantity.range
    for _ in range(50):
        size = 10 ** chance.uniform(-6, 1)
        x = chance.choice([-1, 1]) * size if not around or not math.isfinite(around) else around * chance.uniform(0.8, 1.25)
        if around is not None and not math.isfinite(around):
            return around
        if quantity.boolean:
            return float(chance.randrange(2))
        if low <= x <= high:
            return x
    return low if math.isfinite(low) else high if math.isfinite(high) else 0.0


def point(chance, model, made):
    """Time, states, inputs, parameters and regimes."""
    states = [within(chance, model.states[path]) for path in made.STATES]
    inputs = [within(chance, model.inputs[path]) for path in made.INPUTS]
    params = [within(chance, model.params[path], x) if x else x for path, x in zip(made.PARAMS, made.DEFAULTS)]
    regimes = [float(chance.randrange(len(names))) for _, names in getattr(made, "REGIMES", ())]
    return chance.uniform(0, 10), [states, inputs, params, regimes]


def rows(found):
    """Results of any library as flat arrays of doubles."""
    return [np.array(np.asarray(one.full() if hasattr(one, "full") else one).tolist(), dtype=float).ravel() for one in found]


def close(found, expected, scale=0.0):
    with np.errstate(all="ignore"):
        limit = 1e-12 * np.maximum(np.abs(expected), scale) + 1e-300
        return found.shape == expected.shape and np.all(
            (np.abs(found - expected) <= limit) | (found == expected) | (np.isnan(found) & np.isnan(expected))
        )


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_model_of_the_library_has_the_same_values(dialect, seed):
    imported(dialect)
    chance = random.Random(f"{seed} {dialect}")
    count = {"numpy": 40, "jax": 4, "casadi": 20, "sympy": 2}[dialect]
    compared, refused = [], {}
    for model in library():
        try:
            made = model.module(dialect)
        except fric.CompileError as error:
            assert {one.code for one in error.diagnostics if one.severity == "error"} == {"E0911"}, (model, str(error))
            assert all(one.line > 0 for one in error.diagnostics), str(error)
            refused[model.name] = error.diagnostics[0].message
            continue
        points = [point(chance, model, made) for _ in range(count)]
        expected = model._text._inner.evaluate(model.name, [], points)
        for (t, (x, u, p, q)), (rates, outputs, start, after) in zip(points, expected):
            more = (q,) if hasattr(made, "REGIMES") else ()
            dx, y = rows(made.f(t, x, u, p, *more))
            about = (seed, dialect, model.name, t, x, u, p, q)
            # Sums of large terms that cancel have their rounding.
            scale = 0.0 if dialect != "sympy" else max(map(abs, [*rates, *outputs]), default=0.0)
            assert close(dx, np.array(rates), scale), (about, dx, rates)
            assert close(y, np.array(outputs), scale), (about, y, outputs)
            begun = made.start(u, p)
            x0 = rows(begun if isinstance(begun, tuple) else (begun,))[0]
            assert close(x0, np.array(start)), (about, x0, start)
            if more:
                (q1,) = rows((made.transitions(t, x, u, p, *more),))
                assert q1.tolist() == after, (about, q1, after)
        compared.append(model.name)
    print(f"seed {seed}, {dialect}: {len(compared)} models compared at {count} points, {len(refused)} refused")
    assert len(compared) > 30 and {"LuGre", "KarnoppPublished"} <= set(compared) and "Karnopp" in refused


EVERYTHING = """
model Everything {
  input  a [1]
  input  on [1]
  param  k = 2 in 1 .. 4
  state  x = 1
  state  y = k / 3
  let    high = a > 0.5 or not (x > y)
  let    small = a / (a ^ 2 + 1)
  output e = exp(a) + log(2 + x ^ 2) + expm1(a) + log1p(a ^ 2) + sin(a) + cos(x) + tan(small) + asin(small) + acos(small)
  output h = atan(a) + atan2(a, x) + hypot(a, x) + sinh(a) + cosh(x) + tanh(y) + (2 + abs(a)) ^ y + sqrt(x ^ 2 + 1)
  output m = min(a, x) + max(x, y) + clamp(a, -1, 1) + sign(on) + floor(a) + (if high then 1 else 2)
  output g = a - (x - (y - k)) - a / ((x ^ 2 + 1) / (k * (y ^ 2 + 1))) * -(a - x) - (a * x) * (x * y)
  dx/dt = (if high and a < x then a - x else -(a + x) / (k + a ^ 2)) / 1 s
  dy/dt = (sine(2, 0.3 Hz) + step(1 s, 2) + square(1, 0.4 Hz) - y + (if on == 1 then 0 else 1)) / 1 s
}
"""


@pytest.mark.parametrize("dialect", DIALECTS)
def test_each_function_and_operator_has_the_same_value(dialect, seed):
    imported(dialect)
    model, chance = fric.loads(EVERYTHING).model(), random.Random(seed)
    made = model.module(dialect)
    points = []
    for _ in range(60):
        numbers = [chance.choice([chance.uniform(-3, 3), float(chance.randint(-2, 2))]) for _ in range(5)]
        points.append((chance.uniform(0, 5), [numbers[:2], numbers[2:4], [chance.uniform(1, 4)], []]))
    for (t, (x, u, p, _)), (rates, outputs, *_) in zip(points, model._text._inner.evaluate(model.name, [], points)):
        dx, y = rows(made.f(t, x, u, p))
        assert close(dx, np.array(rates), 1.0) and close(y, np.array(outputs), 10.0), (seed, t, x, u, p, dx, rates, y, outputs)


@pytest.mark.parametrize("dialect", ["numpy", "jax"])
def test_tables_and_rows_of_arrays(dialect, seed):
    imported(dialect)
    text = fric.loads(
        "table law(v [m/s]) [N] = linear { 0 m/s: 0 N, 0.1 m/s: 2 N, 0.5 m/s: 1 N, 2 m/s: 4 N }\n"
        "table bow(v [m/s]) [N] = smooth { -1 m/s: 0 N, 0.1 m/s: 2 N, 2 m/s: 4 N }\n"
        "model M { input v [m/s]  state x [m] = 0  dx/dt = v  output F [N] = law(abs(v)) - bow(v) }"
    )
    model, chance = text.model(), random.Random(seed)
    made = model.module(dialect)
    v = np.array([0.0, 0.1, 0.5, 2.0, 3.0, -0.2, *(chance.uniform(-3, 3) for _ in range(50))])
    dx, y = made.f(0.0, np.zeros((1, v.size)), v[None, :])
    expected = model._text._inner.evaluate("M", [], [(0.0, [[0.0], [one], [], []]) for one in v])
    assert np.array_equal(np.asarray(dx)[0], v) and close(np.asarray(y)[0], np.array([row[1][0] for row in expected]))


def test_noise_is_the_same():
    model = fric.loads("model M { state x = 0  dx/dt = noise(1, 1 ms, 7) / 1 s }").model()
    f = model.function("numpy")
    for t in np.arange(0, 0.1, 0.0007):
        assert f(t, [0.0], [])[0].tolist() == model._text._inner.evaluate("M", [], [(t, [[0.0], [], [], []])])[0][0]


def test_gradients_are_those_of_linearise():
    jax = imported("jax")
    model = fric.model("LuGre")
    f = model.function("jax")
    x, u = np.array([3e-6]), np.array([1e-3])
    A, B, C, D = model.linearise({"z": 3e-6, "v": 1e-3})
    made = model.module("jax")
    p = np.array(made.DEFAULTS)
    for k, matrices in ((1, (A, C)), (2, (B, D))):
        found = jax.jacfwd(f, argnums=k)(0.0, x, u, p)
        for one, other in zip(found, matrices):
            assert np.allclose(one, other, rtol=1e-10), (k, one, other)
    many = jax.vmap(f, in_axes=(None, 0, 0, None))(0.0, np.tile(x, (5, 1)), np.tile(u, (5, 1)), p)
    assert many[0].shape == (5, 1)


def test_formulas_are_symbols_of_the_model():
    sympy = imported("sympy")
    model = fric.loads(
        "model Pull { input u [N]  param m = 2 kg  param k = 3 N/m  state x [m] = 0  state v [m/s] = 0\n"
        "dx/dt = v  dv/dt = (u - k * x) / m  output E [J] = m * v ^ 2 / 2 }"
    ).model()
    made = model.module("sympy")
    dx, y = made.f()
    m, k = made.p
    assert str(dx[1]) == "(-k*x + u)/m" and sympy.simplify(y[0] - m * made.x[1] ** 2 / 2) == 0
    assert sympy.latex(sympy.diff(dx[1], k)) == r"- \frac{x}{m}"


@pytest.mark.parametrize(
    "body, word, line",
    [
        ("state x = 0\n state s = 0\n dx/dt = s / 1 s\n every 1 ms {\n next(s) = s + 1 } ", "sampled code", 5),
        ("input u [1]\n state x = 0\n dx/dt = delay(u, 1 s) / 1 s", "`delay`", 4),
        ("state x = 0\n dx/dt = 1 / 1 s\n when x > 1 { reset(x) = 0 }", "an event", 4),
        (
            "input u [1]\n state x = 0\n dx/dt = 1 / 1 s\n output y = x\n mode a initial { go b when x > 1 { reset(x) = 0 } }\n"
            " mode b { go a when u > 0 }",
            "a jump", 6,
        ),
        (
            "input u [1]\n state x = 0\n dx/dt = (if a then 1 else 2) / 1 s\n mode a initial { go b when x crosses 1 }\n"
            " mode b { go a when u > 0 }",
            "a crossing", 5,
        ),
    ],
)  # fmt: skip
def test_what_needs_the_past_is_told_with_its_place(body, word, line):
    model = fric.loads(f"model M {{\n {body}\n}}").model()
    for dialect in DIALECTS:
        with pytest.raises(fric.CompileError, match=word) as told:
            model.emit(dialect)
        (one,) = told.value.diagnostics
        assert one.code == "E0911" and one.line == line and one.help, str(told.value)
    with pytest.raises(fric.UnknownName, match="numpy"):
        model.emit("nunpy")


def test_the_module_is_that_of_the_command(command, tmp_path):
    (tmp_path / "m.fric").write_text("model M { input u [1]  param k = 2  state x = 0  dx/dt = k * u / 1 s }\n")
    told = subprocess.run([command, "build", "m.fric", "--emit", "numpy"], cwd=tmp_path, capture_output=True, text=True)
    assert told.returncode == 0 and told.stdout == fric.load(tmp_path / "m.fric").model().emit("numpy"), told.stderr
    out = subprocess.run(
        [command, "build", "m.fric", "--emit", "numpy", "-o", "made.py"], cwd=tmp_path, capture_output=True, text=True
    )
    assert out.returncode == 0
    spec = importlib.util.spec_from_file_location("made", tmp_path / "made.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    assert made.f(0.0, [1.0], [3.0])[0].tolist() == [6.0]
