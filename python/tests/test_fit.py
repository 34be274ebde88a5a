"""Fits: the answers of the command, from recordings in any container, and for other optimisers."""

import importlib.util
import json
import pickle
import random
import subprocess

import numpy as np
import pytest

import fric

SIMULATED = """
import std.friction
experiment moved {
  run    {LAW}(v = 5 mm/s * sin(2*pi * 1 Hz * t) + 0.3 mm/s * sin(2*pi * 13 Hz * t){ARGUMENTS}) for 2 s
  record v, F
}
fit found {
  run      {LAW}(v = data.v)
  data     "bench.csv" (t [s], v [mm/s], F [N])
  vary     {RANGES}
  minimise rms(F - data.F)
  plot     data.F, F against t
}
"""
LAWS = {
    "Coulomb": ["Fc"],
    "CoulombViscous": ["Fc", "Fv"],
    "Dahl": ["Fc", "sigma"],
    "LuGre": ["Fc", "Fs", "sigma0"],
}
UNITS = {"Fc": "N", "Fs": "N", "Fv": "N·s/m", "sigma": "N/m", "sigma0": "N/m"}
TYPICAL = {"Fc": 1.0, "Fs": 1.6, "Fv": 2.0, "sigma": 3e4, "sigma0": 1e5}


def case(seed):
    """A law, its true values, a text, and a noisy recording of it in mm/s and N."""
    chance = random.Random(seed)
    law = chance.choice(list(LAWS))
    true = {path: TYPICAL[path] * chance.uniform(0.8, 1.25) for path in LAWS[law]}
    arguments = "".join(f", {path} = {value!r} {UNITS[path]}" for path, value in true.items())
    # Stiction is never below friction, whatever was drawn.
    ranges = ", ".join(f"{path} in {TYPICAL[path] / 10!r} {UNITS[path]} .. {TYPICAL[path] * 10!r} {UNITS[path]}" for path in true)
    text = SIMULATED.replace("{LAW}", law).replace("{ARGUMENTS}", arguments).replace("{RANGES}", ranges)
    text = fric.loads(text)
    run = text.run("moved", every="1 ms", errors=False)
    noise = np.random.default_rng(seed).normal(0, 0.01, run.t.size)
    data = {"t [s]": run.t, "v [mm/s]": 1e3 * run["v"], "F [N]": run["F"] + noise}
    return law, true, text, data


@pytest.mark.parametrize("seed", range(8))
def test_values_hold_and_residuals_are_those_of_the_model(seed):
    law, true, text, data = case(seed)
    found = text.fit(data=data)
    assert found.converged and found.passed and found.name == "found" and found.law == law
    assert found.names == list(true) == list(found.set)
    for path, value in true.items():
        assert abs(found.values[path] - value) < 4 * found.sd[path], (seed, law, path, found.values, found.sd)
        low, high = found.intervals[path]
        assert low < found.values[path] < high
    assert np.allclose(found.cov, found.cov.T) and np.allclose(np.sqrt(np.diag(found.cov)), list(found.sd.values()))
    assert np.linalg.eigvalsh(found.correlation).min() > 0
    (label, residuals), = found.residuals.items()
    assert label == "F - data.F" and np.allclose(found.times[label], data["t [s]"], rtol=0, atol=1e-12)
    assert 0.009 < residuals.std() < 0.011 and not residuals.flags.writeable
    # The same differences as a function of the unknowns, at the values found and by a run of the model there.
    function = text.residuals(data=data, step=found._inner.steps[0])
    assert np.array_equal(function(found.values), residuals)
    assert np.array_equal(function.split(list(found.values.values()))[label], residuals)
    inputs = {"v": (data["t [s]"], 1e-3 * data["v [mm/s]"])}
    run = fric.model(law, **found.set).simulate(2.0, inputs=inputs, at=data["t [s]"], errors=False)
    assert np.abs(run["F"] - data["F [N]"] - residuals).max() < 2e-3, (seed, law)


@pytest.mark.parametrize("seed", range(3))
def test_every_container_holds_the_same_recording(seed, tmp_path):
    pandas, polars = pytest.importorskip("pandas"), pytest.importorskip("polars")
    _, _, text, data = case(seed)
    values = text.fit(data=data).json["parameters"]
    frame = pandas.DataFrame(data)
    frame.to_csv(tmp_path / "bench.csv", index=False)
    np.savez(tmp_path / "bench.npz", columns=list(data), **{f"c{k}": column for k, column in enumerate(data.values())})
    structured = np.rec.fromarrays(list(data.values()), names=list(data))
    for other in (
        frame,
        frame.set_index("t [s]"),
        polars.DataFrame(data),
        structured,
        {name: list(column) for name, column in data.items()},
        {name.split()[0]: column for name, column in data.items()},
        tmp_path / "bench.csv",
        str(tmp_path / "bench.npz"),
    ):
        assert text.fit(data=other).json["parameters"] == values, (seed, type(other))
    # A run is in SI.
    run = text.run("moved", every="1 ms", errors=False)
    exact = text.fit(data=run)
    same = text.fit(data={"t [s]": run.t, "v [m/s]": run["v"], "F [N]": run["F"]})
    assert exact.json["parameters"] == same.json["parameters"]


def test_the_answer_is_that_of_the_command(root, command, tmp_path):
    file = root / "examples/identification/identification.fric"
    text = fric.load(file)
    assert text.fits == ["contact", "sliding"] and text.experiments == []
    for options, how in [
        ([], {}),
        (["--seed", "5", "--starts", "20", "--level", "90%", "--profile", "Fs", "--pieces", "2"],
         {"seed": 5, "starts": 20, "level": 0.9, "profile": "Fs", "pieces": 2}),
        (["--robust", "--set", "Fc=1.05 N"], {"robust": True, "set": {"Fc": 1.05}}),
    ]:  # fmt: skip
        printed = subprocess.run([command, "fit", file, "contact", "--json", *options], capture_output=True, text=True)
        found = text.fit("contact", **how)
        assert json.loads(printed.stdout) == found.json, options
    shown = subprocess.run([command, "fit", file, "contact", "--out", tmp_path / "out"], capture_output=True, text=True).stdout
    found = text.fit("contact")
    # Without the time that the search took, and the names of the files.
    lines = [line for line in shown.splitlines() if " runs in " not in line and "wrote" not in line]
    assert [line for line in str(found).splitlines() if line and " runs in " not in line] == lines
    paths = found.save(tmp_path / "saved")
    assert sorted(path.name for path in paths) == ["contact.csv", "contact.fric", "contact.json", "contact.svg"]
    for path in paths:
        if path.suffix != ".fric":
            assert path.read_bytes() == (tmp_path / "out" / path.name).read_bytes(), path
    assert found.svg().startswith("<svg") and "± sd" in found._repr_html_()


def test_a_saved_fit_stands_with_its_recording(command, tmp_path):
    _, _, text, data = case(5)
    found = text.fit(data=data)
    paths = found.save(tmp_path / "out", page=True)
    assert {path.name for path in paths} == {
        "found_data.csv", "found.fric", "found.json", "found.csv", "found.svg", "found.html",
    }  # fmt: skip
    done = subprocess.run([command, "test", tmp_path / "out/found.fric"], capture_output=True, text=True)
    assert done.returncode == 0 and "1 passed" in done.stdout, done
    with pytest.raises(OSError, match="cannot write"):
        found.save(tmp_path / "out/found.csv")


def test_laws_are_ranked_as_by_the_command(command, tmp_path):
    _, _, text, data = case(3)
    lines = [",".join(data), *(",".join(map(repr, row)) for row in np.column_stack(list(data.values())).tolist())]
    (tmp_path / "bench.csv").write_text("\n".join(lines) + "\n")
    printed = subprocess.run([command, "fit", "bench.csv", "--json"], cwd=tmp_path, capture_output=True, text=True, check=True)
    laws = [json.loads(line) for line in printed.stdout.splitlines()]
    for given in (tmp_path / "bench.csv", data):
        ranked = fric.rank(given)
        assert [found.rank for found in ranked] == [law["rank"] for law in laws]
        assert [found.json["parameters"] for found in ranked] == [law["parameters"] for law in laws]
    some = fric.rank(data, "Coulomb", "LuGre", starts=8)
    assert {found.law for found in some} == {"Coulomb", "LuGre"} and some[0].rank == 1
    with pytest.raises(fric.UnknownName, match="lugre"):
        fric.rank(data, "LuGe")
    with pytest.raises(ValueError, match="heading"):
        fric.rank({"a": [1.0, 2.0], "b": [1.0, 2.0]})


@pytest.mark.parametrize("seed", range(3))
def test_steady_points_keep_their_rows(seed):
    chance = np.random.default_rng(seed)
    text = fric.loads(
        """
import std.friction
fit f { run CoulombViscous(v = data.v)  data "p.csv" (v [m/s], F [N])
  vary Fc in 0.1 N .. 10 N, Fv in 0.1 N·s/m .. 10 N·s/m  minimise rms(F - data.F) }
"""
    )
    v = chance.normal(size=30)
    force = 2 * np.sign(v) + 3 * v + chance.normal(0, 0.01, 30)
    found = text.fit(data={"v": v, "F": force})
    law = found.values["Fc"] * np.sign(v) + found.values["Fv"] * v
    assert np.allclose(found.residuals["F - data.F"], law - force, atol=1e-9)
    order = chance.permutation(30)
    shuffled = text.fit(data={"v": v[order], "F": force[order]})
    assert shuffled.values == found.values
    assert np.array_equal(shuffled.residuals["F - data.F"], found.residuals["F - data.F"][order])


@pytest.mark.parametrize("seed", range(3))
def test_an_optimiser_of_ones_own_finds_the_same(seed):
    optimize = pytest.importorskip("scipy.optimize")
    _, _, text, data = case(seed)
    found = text.fit(data=data, pieces=1)
    function = text.residuals(data=data, step=found._inner.steps[0])
    begin = np.clip(np.array(list(found.values.values())) * 1.05, *function.bounds)
    other = optimize.least_squares(function, begin, bounds=function.bounds, x_scale=function.scale, diff_step=1e-5)
    sd = np.array(list(found.sd.values()))
    # White noise: least squares are the most likely values.
    assert np.abs((other.x - list(found.values.values())) / sd).max() < 0.05, (seed, other.x, found)
    jacobian = other.jac
    theirs = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)) * (other.fun @ other.fun) / (other.fun.size - sd.size))
    assert np.allclose(theirs, sd, rtol=0.05), (seed, theirs, sd)


def test_what_has_no_answer_says_why():
    _, _, text, data = case(1)
    at_rest = {"t [s]": [0.0, 1.0, 2.0, 3.0], "v [mm/s]": [0.0] * 4, "F [N]": [1.0, 2.0, 3.0, 4.0]}
    for error, match, call in [
        (fric.FitError, "E0906", lambda: text.fit(data=at_rest)),
        (fric.FitError, "E0910", lambda: text.fit(data={name: column[:1] for name, column in data.items()})),
        (fric.CompileError, "E0903", lambda: text.fit()),
        (fric.CompileError, "E0903", lambda: text.fit(data={**data, "F [N]": np.full(data["F [N]"].size, np.nan)})),
        (fric.UnknownName, "did you mean `found`", lambda: text.fit("fond", data=data)),
        (fric.UnknownName, "Fx", lambda: text.residuals(data=data)({"Fx": 1.0})),
        (ValueError, "9 values were given", lambda: text.residuals(data=data)([1.0] * 9)),
        (ValueError, "does not vary `nothing`", lambda: text.fit(data=data, profile="nothing")),
        (ValueError, "from 0.5 to 0.9999", lambda: text.fit(data=data, level=95)),
        (ValueError, "from 1 to 100", lambda: text.fit(data=data, pieces=0)),
        (TypeError, "whole number", lambda: text.fit(data=data, starts=1.5)),
        (ValueError, "column 'F', has the shape|column 'F' has the shape", lambda: text.fit(data={"t": [1.0], "F": [1.0, 2.0]})),
        (TypeError, "not int", lambda: text.fit(data=3)),
        (ValueError, "no recording", lambda: text.fit(data=[])),
        (OSError, "no such file", lambda: fric.rank("nowhere.csv")),
        (ValueError, "adaptive", lambda: text.fit(data=data, tol=1e-6)),
        (fric.UnitError, "a force", lambda: text.fit(data=data, set={"Fc": "1 m"})),
        (fric.UnitError, "needs a unit", lambda: text.fit(data=data, set={"Fc": "1"})),
    ]:
        with pytest.raises(error, match=match):
            call()
    with pytest.raises(TypeError, match="pickle"):
        pickle.dumps(text.fit(data=data, starts=1))


def test_several_laws_of_a_slot():
    _, _, text, data = case(6)
    slots = fric.loads(
        """
import std.friction
import std.interfaces
model Tap { input v [m/s]  part fr : Friction = Coulomb(v = v)  output F [N] = fr.F }
fit found { run Tap(v = data.v)  data "bench.csv" (t [s], v [mm/s], F [N])
  sweep fr = Coulomb(), CoulombViscous()  vary fr.Fc in 0.1 N .. 10 N  minimise rms(F - data.F) }
"""
    )
    ranked = slots.rank(data=data)
    assert len(ranked) == 2 and ranked[0].rank == 1 and {"Coulomb()" in one.law for one in ranked} == {True, False}
    with pytest.raises(ValueError, match="2 laws"):
        slots.fit(data=data)
    with pytest.raises(ValueError, match="several laws"):
        slots.residuals(data=data)


if importlib.util.find_spec("sklearn"):

    class OfFirst(fric.Estimator):
        """Of the first of any number of columns, which the checks choose."""

        def _table(self, X, *others):
            return super()._table(X[:, :1], *others)


def test_the_estimator_is_one_of_scikit_learn():
    checks = pytest.importorskip("sklearn.utils.estimator_checks")
    ranges = {"Fc": "1e-3 N .. 1e3 N", "Fv": "1e-3 N·s/m .. 1e3 N·s/m"}
    flat = "one input may come without a second dimension"
    results = checks.check_estimator(
        OfFirst("CoulombViscous", ranges, threads=1, starts=4),
        expected_failed_checks={"check_fit1d": flat, "check_fit2d_predict1d": flat},
        on_fail="raise",
        on_skip=None,
    )
    by = [one["status"] for one in results]
    assert by.count("passed") > 45 and by.count("xfail") == 2, results


@pytest.mark.parametrize("seed", range(3))
def test_an_estimator_predicts_what_its_model_does(seed):
    selection, base = pytest.importorskip("sklearn.model_selection"), pytest.importorskip("sklearn.base")
    law, true, text, data = case(seed)
    v, force = 1e-3 * data["v [mm/s]"], data["F [N]"]
    ranges = {path: f"{TYPICAL[path] / 10!r} {UNITS[path]} .. {TYPICAL[path] * 10!r} {UNITS[path]}" for path in true}
    made = fric.Estimator(law, ranges, step="1 ms", starts=16)
    found = base.clone(made).fit(v, force)
    for path, value in true.items():
        assert abs(found.values_[path] - value) < 4 * found.sd_[path], (seed, law, found.values_, found.sd_)
    predicted = found.predict(v)
    assert np.array_equal(predicted - force, found.fit_.residuals["F - data.F"])
    assert np.array_equal(found.predict(v[:1]), predicted[:1]) and found.predict(v.reshape(-1, 1)).shape == v.shape
    again = pickle.loads(pickle.dumps(found))
    assert np.array_equal(again.predict(v), predicted) and not hasattr(again, "fit_")
    assert found.score(v, force) > 0.95
    halves = selection.cross_val_score(made, v.reshape(-1, 1), force, cv=selection.KFold(2))
    assert halves.min() > 0.9
    # Ranges from the data, as for a recording alone.
    assert abs(fric.Estimator(law, step="1 ms").fit(v, force).values_["Fc"] - true["Fc"]) < 0.1


def test_an_estimator_of_several_columns_names_what_is_missing():
    sklearn = pytest.importorskip("sklearn")
    assert sklearn
    text = fric.loads(
        "model M { input a [m]  input b [N]  param k = 1 N/m in 0 N/m .. 9 N/m  output F [N] = k * a + b  output d [m] = a }"
    )
    chance = np.random.default_rng(1)
    X = chance.normal(size=(50, 2))
    y = np.column_stack([2 * X[:, 0] + X[:, 1], X[:, 0]]) + chance.normal(0, 0.01, (50, 2))
    made = fric.Estimator(text.model("M"), {"k": "0.1 N/m .. 9 N/m"})
    found = made.fit(X, y)
    assert abs(found.values_["k"] - 2) < 4 * found.sd_["k"] and found.predict(X).shape == y.shape
    swapped = fric.Estimator(text.model("M"), {"k": "0.1 N/m .. 9 N/m"}, inputs=["b", "a"], outputs=["F"])
    assert abs(swapped.fit(X[:, ::-1], y[:, 0]).values_["k"] - found.values_["k"]) < found.sd_["k"]
    for error, match, call in [
        (ValueError, "y has 1 columns, and 2 are needed: F, d", lambda: made.fit(X, y[:, :1])),
        (ValueError, "X has 3 columns", lambda: made.fit(np.zeros((50, 3)), y)),
        (ValueError, "`b` of `M` is missing", lambda: fric.Estimator(text.model("M"), {"k": "1 N/m .. 2 N/m"}, inputs=["a"]).fit(X, y)),
        (ValueError, "no standard law", lambda: fric.Estimator(text.model("M")).fit(X, y)),
        (ValueError, "argument of the model", lambda: fric.Estimator(text.model("M", k="1 N/m"), {"k": "1 N/m .. 2 N/m"}).fit(X, y)),
        (fric.UnknownName, "Fy", lambda: fric.Estimator(text.model("M"), {"k": "1 N/m .. 2 N/m"}, outputs=["Fy"]).fit(X, y)),
        (fric.CompileError, "E0101", lambda: fric.Estimator(text.model("M"), {"k": "1 N .. 2 N"}).fit(X, y)),
        (TypeError, "range", lambda: fric.Estimator(text.model("M"), {"k": 3.0}).fit(X, y)),
    ]:  # fmt: skip
        with pytest.raises(error, match=match):
            call()
