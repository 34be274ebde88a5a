"""Habits of Python: arrays of all kinds, threads, units of others, and stubs that say what is there.

Mutants tried by hand, each fails: a name left out of the stubs; a list where they say an array.
"""

import random
import subprocess
import sys
import threading

import numpy as np
import pytest

import fric


class Own(np.ndarray):
    """A subclass."""


def test_each_kind_of_array_is_read_or_refused_and_never_written(tmp_path):
    v = 1e-3 * np.sin(np.arange(24.0))
    model = fric.model("LuGre")
    expected = model.start(step="10 us").follow(v)
    frozen = v.copy()
    frozen.flags.writeable = False
    np.save(tmp_path / "v.npy", v)
    kinds = [
        frozen, v.view(Own), v.reshape(24, 1).view(np.matrix), np.load(tmp_path / "v.npy", mmap_mode="r"), memoryview(v),
        np.asfortranarray(np.tile(v, (2, 1)).T)[:, :1], np.broadcast_to(v[:, None], (24, 1)), [float(x) for x in v], tuple(v),
    ]  # fmt: skip
    for given in kinds:
        before = np.array(given, dtype=float).tobytes()
        found = model.start(step="10 us").follow(given)
        assert type(found) is np.ndarray and np.array_equal(found, expected), type(given)
        assert np.array(given, dtype=float).tobytes() == before
    ints = np.array([0, 1, 0, -1])
    assert np.array_equal(model.start(step="1 us").follow(ints), model.start(step="1 us").follow(ints.astype(float)))
    for wrong, kind, word in [
        (np.float64(1.0), ValueError, "shape"), (np.array(1.0), ValueError, "shape"), (v.astype("f4"), TypeError, "float32"),
        (v.astype(complex), TypeError, "complex"), (np.array(["1"]), TypeError, "astype"), (v.reshape(2, 12), ValueError, "shape"),
    ]:  # fmt: skip
        with pytest.raises(kind, match=word):
            model.start(step="10 us").follow(wrong)
    empty = np.zeros((0, 1))
    assert model.start(step="10 us").follow(empty).shape == (0,)
    assert model.batch(2, step="10 us").follow(np.zeros((2, 0))).shape == (2, 0)


def test_results_go_where_they_should():
    model, v = fric.model("LuGre"), np.full(10, 1e-3)
    s = model.start(step="10 us")
    out = np.full(10, 7.0)
    address = out.__array_interface__["data"][0]
    assert s.follow(v, out=out) is out and out.__array_interface__["data"][0] == address and not (out == 7).any()
    frozen = np.zeros(10)
    frozen.flags.writeable = False
    for wrong in (frozen, np.zeros(20)[::2], np.zeros(10, dtype="f4"), [0.0] * 10, np.zeros(9)):
        with pytest.raises((ValueError, TypeError), match="out"):
            s.follow(v, out=wrong)
        with pytest.raises((ValueError, TypeError), match="out"):
            model.batch(10, step="10 us").step(v, out=wrong)
    assert not frozen.any()
    kept = s.follow(v)
    copy = kept.copy()
    del s
    assert np.array_equal(kept, copy), "results belong to nobody else"


NAMES = ["LuGre", "Dahl", "Karnopp", "KFM", "MaxwellSlip4", "Coulomb", "BlimanSorine", "GMS"]


def test_eight_threads_step_eight_models(seed):
    """Each makes the bits that it makes alone, while others compile, copy and drop; one that is shared says so."""
    def work(name, number, out):
        chance = random.Random(f"{seed} {name} {number}")
        model = models[name]
        s = model.start(step="10 us", method="euler")
        b = model.batch(9, step="10 us", method="euler", threads=1 + number % 2)
        columns = len(model.inputs)
        sums = []
        for _ in range(30):
            rows = np.array([[chance.uniform(-2e-3, 2e-3) for _ in range(columns)] for _ in range(60)])
            sums.append(s.follow(rows).tobytes())
            sums.append(b.follow(np.tile(rows, (9, 1, 1))).tobytes())
            sums.append(np.array(s.copy().hold(1500, *rows[0])).tobytes())
            s.state = s.state
        out[number] = sums

    models = {name: fric.model(name) for name in NAMES}
    alone, together = {}, {}
    for number, name in enumerate(NAMES):
        work(name, number, alone)
    shared, met, over = models["LuGre"].start(step="10 us"), [], threading.Event()

    def meddle():
        while not over.is_set():
            try:
                shared.hold(2000, 1e-3)
            except RuntimeError as error:
                met.append(str(error))

    meddlers = [threading.Thread(target=meddle) for _ in range(2)]
    workers = [threading.Thread(target=work, args=(name, number, together)) for number, name in enumerate(NAMES)]
    for one in meddlers + workers:
        one.start()
    for one in workers:
        one.join()
    over.set()
    for one in meddlers:
        one.join()
    assert alone == together
    assert all("borrowed" in one for one in met)


def test_units_go_to_pint_and_back():
    xarray, pint = pytest.importorskip("xarray"), pytest.importorskip("pint")
    text = fric.loads(
        "model M { state x [mm] = 1 mm  state phi [rad] = 0.5 rad  state n [rev] = 1 rev  output F [N] = x * 2 N/mm\n"
        "output d [N*s/m] = 3 N*s/m  output w [rad/s] = 2 rad/s  output E [J] = F * x  output R [Ohm] = 2 Ohm\n"
        "dx/dt = x / 1 s  dphi/dt = w  dn/dt = 1 rev / 1 s }\n"
        "experiment e { run M() for 1 s  record x, phi, n, F, d, w, E, R }"
    )
    run = text.run("e", errors=False)
    data, registry = run.to_xarray(), pint.UnitRegistry()
    assert isinstance(data, xarray.Dataset)
    for label, unit in run.units.items():
        si, theirs = data[label].values, data[label].attrs["units"]
        quantity = registry.Quantity(si, theirs)
        back = registry.Quantity(quantity.to(theirs).magnitude, theirs)
        assert np.array_equal(back.magnitude, run[label]), label
        if label == "x":
            assert np.allclose(quantity.to("mm").magnitude, run.in_unit("x"), rtol=1e-14)
        if label == "E":
            assert quantity.check("[energy]"), unit
    # A quantity of pint is an argument.
    model = fric.model("LuGre", Fs=registry.Quantity(2000, "mN"))
    assert model.params["Fs"].default == pytest.approx(2.0, rel=1e-15)
    with pytest.raises(fric.UnitError):
        fric.model("LuGre", Fs=registry.Quantity(2, "m"))


def test_stubs_say_what_is_there(tmp_path):
    pytest.importorskip("mypy")
    # Of the package that is installed, not of the sources beside these tests.
    command = [sys.executable, "-m", "mypy.stubtest", "fric", "--allowlist", "allowed"]
    # scikit-learn gives it to each of its estimators.
    (tmp_path / "allowed").write_text("fric._estimator.Estimator.set_score_request\n")
    told = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert told.returncode == 0, told.stdout + told.stderr
