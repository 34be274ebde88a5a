"""The rows of a batch are to the bit those of single instances, for any number of threads."""

import random

import numpy as np
import pytest

import fric


def alone(model, rows, every=1, **how):
    """The same instances one by one; NaN from the step that fails on."""
    out = []
    for own in rows:
        s = model.start(**how)
        try:
            taken = s.follow(own)
        except fric.RunError as error:
            taken = np.full((len(own), *error.rows.shape[1:]), np.nan)
            taken[: len(error.rows) - 1] = error.rows[:-1]
        out.append(taken[every - 1 :: every])
    return np.array(out)


@pytest.mark.parametrize("name", ["LuGre", "Karnopp", "Dahl", "KFM", "MaxwellSlip4", "Coulomb", "BlimanSorine"])
@pytest.mark.parametrize("method", ["euler", "expo"])
def test_a_batch_is_its_instances(name, method, seed):
    model = fric.model(name)
    chance = random.Random(f"{seed} {name} {method}")
    how = {"step": "10 us", "method": method}
    columns = len(model.inputs)
    for n, count, every in [(1, 1, 1), (5, 70, 7), (50, 130, 1), (64, 64, 64)]:
        rows = np.array([[[chance.uniform(-2e-3, 2e-3) for _ in range(columns)] for _ in range(count)] for _ in range(n)])
        expected = alone(model, rows, every, **how)
        for threads in (1, 3):
            found = model.batch(n, threads=threads, **how).follow(rows, every=every)
            assert found.tobytes() == expected.tobytes(), (seed, n, count, threads)
        stepped = model.batch(n, **how)
        last = [stepped.step(rows[:, k]) for k in range(min(count, 5))][-1]
        singles = [model.start(**how) for _ in range(n)]
        assert np.array_equal(last, [s.follow(own[: min(count, 5)])[-1] for s, own in zip(singles, rows)])
        assert np.array_equal(stepped.state, [s.state for s in singles])
        held, single = model.batch(n, **how), model.start(**how)
        assert np.array_equal(held.hold(33, rows[:, 0])[-1], single.hold(33, *rows[-1, 0]))


def test_parameters_differ_from_instance_to_instance():
    model = fric.model("LuGre")
    fc, fs = np.linspace(0.5, 1.0, 30), np.linspace(1.1, 2.0, 30)
    v = np.linspace(0, 5e-3, 40)
    b = model.batch(30, step="10 us", params={"Fc": fc, "Fs": fs})
    found = b.follow(np.tile(v, (30, 1)))
    for k in (0, 7, 29):
        single = fric.model("LuGre", Fc=fc[k], Fs=fs[k]).start(step="10 us")
        assert np.array_equal(found[k], single.follow(v))
    assert np.array_equal(b["Fc"], fc)
    with pytest.raises(fric.RangeError):
        model.batch(2, step="10 us", params={"Fc": [1.0, -1.0]})
    with pytest.raises(fric.UnknownName):
        model.batch(2, step="10 us", params={"Fx": [1.0, 2.0]})
    with pytest.raises(ValueError, match="shape"):
        model.batch(2, step="10 us", params={"Fc": [1.0, 0.9, 0.8]})


def test_one_that_fails_leaves_the_others_alone():
    model = fric.loads(
        "model M { input u [m/s]  state x [m] = 0 in -1 m .. 1 m  dx/dt = u  output y [m] = x }"
    ).model("M")
    speeds = np.array([0.1, 5.0, -0.1, -9.0])
    rows = np.tile(speeds[:, None], (1, 500))
    expected = alone(model, rows, step="1 ms")
    for interpret in (False, True):
        b = model.batch(4, step="1 ms", interpret=interpret)
        found = b.follow(rows)
        assert found.tobytes() == expected.tobytes()
        assert b.failed.tolist() == [False, True, False, True]
        assert "`x` left its range" in b.why(1) and b.why(0) is None
        assert np.isnan(b.step(speeds)[[1, 3]]).all() and not np.isnan(b.step(speeds)[[0, 2]]).any()
        b.reset(mask=b.failed)
        assert not b.failed.any() and b.state[1, 0] == 0 and b.state[0, 0] > 0
        assert b.step(speeds)[1] == pytest.approx(0.005)
        with pytest.raises(IndexError):
            b.why(4)


def test_ranges_may_depend_on_parameters():
    text = """model M { input u [m/s]  param most = 1 m  state x [m] = 0 in -most .. most  dx/dt = u  output y [m] = 2 * x }"""
    model, most = fric.loads(text).model("M"), np.linspace(0.1, 1.0, 30)
    rows = np.tile(np.full(700, 1.0), (30, 1))
    expected = []
    for limit in most:
        expected.append(alone(fric.loads(text).model("M", most=limit), rows[:1], step="1 ms")[0])
    for interpret in (False, True):
        b = model.batch(30, step="1 ms", params={"most": most}, threads=2, interpret=interpret)
        assert b.follow(rows).tobytes() == np.array(expected).tobytes()
        assert b.failed.tolist() == [limit < 0.7 for limit in most]
        assert "range -0.1 .. 0.1 m" in b.why(0) and b.why(29) is None


def test_shapes_are_checked():
    b = fric.model("LuGre").batch(3, step="10 us")
    assert len(b) == 3 and b.step(np.zeros(3)).shape == (3,) and b.step(np.zeros((3, 1))).shape == (3,)
    out = np.zeros(3)
    assert b.step(np.zeros(3), out=out) is out
    for call, kind in [
        (lambda: b.step(np.zeros(4)), ValueError),
        (lambda: b.step(), TypeError),
        (lambda: b.step(np.zeros(3, dtype=np.float32)), TypeError),
        (lambda: b.follow(np.zeros((2, 5))), ValueError),
        (lambda: b.follow(np.zeros((3, 5)), every=2), ValueError),
        (lambda: b.hold(0, np.zeros(3)), ValueError),
        (lambda: b.step(np.zeros(3), out=np.zeros(4)), ValueError),
        (lambda: b.reset(mask=[True]), ValueError),
        (lambda: fric.model("LuGre").batch(0, step="10 us"), ValueError),
        (lambda: fric.model("LuGre").batch(2, step="10 us", threads=0), ValueError),
    ]:
        with pytest.raises(kind):
            call()
    b.state = np.full((3, 1), 1e-6)
    assert b.state.tolist() == [[1e-6]] * 3 and b.states == ["z"]
