"""Runs have the results of ``fric run --json`` to the bit, and arrays are what they promise to be."""

import json
import subprocess

import numpy as np
import pytest

import fric

STICK_SLIP = "examples/stick-slip/stick_slip.fric"


def of_command(command, root, *arguments):
    """The objects of ``fric run --json``, without what depends on the moment."""
    found = subprocess.run([command, "run", *arguments, "--json"], cwd=root, capture_output=True, text=True)
    assert found.stdout, found.stderr
    return [timeless(json.loads(line)) for line in found.stdout.splitlines()]


def timeless(one):
    return {key: value for key, value in one.items() if key not in ("wall_seconds", "compile_seconds", "file")}


def test_a_run_is_that_of_the_command(command, root, monkeypatch):
    monkeypatch.chdir(root)
    text = fric.load(STICK_SLIP)
    ours = [timeless(text.run(name).json) for name in text.experiments]
    assert ours == of_command(command, root, STICK_SLIP)
    changed = text.run("stick_slip", set={"fr.Fs": "1.6 N", "vp": 0.2}, solver="expo", step="1 ms", errors=False)
    same = of_command(
        command, root, STICK_SLIP, "stick_slip", "--set", "fr.Fs=1.6 N", "--set", "vp=0.2 m/s",
        "--solver", "expo", "--step", "1ms", "--no-error",
    )  # fmt: skip
    assert [timeless(changed.json)] == same


def test_a_step_or_a_tolerance_has_an_effect_or_is_refused():
    text = fric.load(STICK_SLIP)
    for solver in [None, "adaptive", "euler", "rk4", "expo", "implicit"]:
        fixed = solver not in (None, "adaptive")
        wrong = {"tol": 1e-5} if fixed else {"step": "1 ms"}
        with pytest.raises(ValueError, match=r"tolerance is for|step is for"):
            text.run("stick_slip", solver=solver, duration="1 s", errors=False, **wrong)
        right = {"step": "10 us"} if fixed else {"tol": 1e-5}
        assert text.run("stick_slip", solver=solver, duration="10 ms", errors=False, **right).steps > 0


def test_rows_are_those_of_the_data(command, root, tmp_path):
    text = fric.load(root / STICK_SLIP)
    run = text.run("stick_slip")
    table = tmp_path / "x.csv"
    subprocess.run([command, "run", STICK_SLIP, "stick_slip", "--data", str(table), "-q"], cwd=root, check=True)
    head = table.read_text(encoding="utf-8").splitlines()[0].split(",")
    numbers = np.loadtxt(table, delimiter=",", skiprows=1)
    frame = run.to_pandas()
    assert [name.strip('"') for name in head] == list(frame.columns)
    assert numbers.tobytes() == frame.to_numpy().tobytes(), "to the bit"
    assert run.steps == len(run.t) - 1 or len(run.t) >= run.steps


def test_arrays_are_read_only_and_stay(root):
    run = fric.load(root / STICK_SLIP).run("stick_slip", errors=False)
    x = run["x"]
    assert x is run["x"] and x.dtype == np.float64 and x.flags.c_contiguous
    with pytest.raises(ValueError, match="read-only"):
        x[0] = 1.0
    copy = x.copy()
    del run
    assert (x == copy).all()


def test_rows_at_instants_and_distances(root):
    text = fric.load(root / STICK_SLIP)
    even = text.run("stick_slip", every="10 ms", errors=False)
    assert len(even.t) == 4001 and even.t[7] == 0.07
    at = text.run("stick_slip", at=[0.0, 0.07, 3.21], errors=False)
    assert list(at.t) == [0.0, 0.07, 3.21] and at["x"][1] == even["x"][7]
    thin = text.run("stick_slip", thin=True, solver="expo", step="10 us", errors=False)
    assert 1000 < len(thin.t) < 100_000
    with pytest.raises(ValueError, match="rising order"):
        text.run("stick_slip", at=[1.0, 0.5]).t


def test_units_are_those_of_the_text(root):
    run = fric.load(root / STICK_SLIP).run("hunting", errors=False)
    assert run.units["v"] == "mm/s" and run.keys() == list(run.units)
    assert np.array_equal(run.in_unit("v"), run["v"] * 1000)
    data = run.to_xarray()
    assert data["v"].attrs["units"] == "m*s^-1" and data["time"].attrs["units"] == "s"
    assert data["v"].values.tobytes() == run["v"].tobytes()
    pint = pytest.importorskip("pint")
    speed = pint.UnitRegistry()(data["v"].attrs["units"])
    assert speed.to("mm/s").magnitude == pytest.approx(1000)


def test_verdicts_and_finals(root):
    run = fric.load(root / STICK_SLIP).run("stick_slip")
    assert run.passed and all(run.verdicts) and len(run.verdicts) == 2
    assert run.verdicts[0].text.startswith("period(v)") and run.verdicts[0].error is not None
    assert run.finals["pulled"] == pytest.approx(4.0)
    assert "svg" in run._repr_html_() and "<script" not in run._repr_html_()
    assert run.svg() != run.svg(), "identifiers are unique on a page"


def test_cases_of_a_sweep():
    text = fric.loads(
        "model M { param a = 1 m  output x [m] = a }\n"
        "experiment e { run M() for 1 s  sweep a = 1 m, 2 m, 3 m  expect final(x) < 2.5 m  record x }\n"
    )
    runs = text.runs("e")
    assert [run.label for run in runs] == ["a = 1 m", "a = 2 m", "a = 3 m"]
    assert [run.passed for run in runs] == [True, True, False]
    with pytest.raises(ValueError, match="3 cases; use text.runs"):
        text.run("e")


def test_a_run_that_stops_carries_its_rows():
    text = fric.loads(
        "model M { state x [m] = 0 in -1 m .. 1 m  dx/dt = 1 m/s }\nexperiment e { run M() for 9 s  record x }\n"
    )
    with pytest.raises(fric.RunError, match="left its range") as found:
        text.run("e")
    assert found.value.time == pytest.approx(1, abs=0.2) and found.value.run["x"][-1] <= 1.2


def test_a_model_is_simulated():
    model = fric.model("LuGre")
    t = np.array([0.0, 0.5, 1.0])
    run = model.simulate(1, inputs={"v": (t, np.array([0.0, 0.01, -0.01]))}, tol=1e-8)
    assert "F" in run.keys() and "z" in run.keys()
    assert run.t[-1] == 1.0 and 0.5 in run.t, "corners are met"
    signal = model.simulate("1 s", inputs={"v": "10 mm/s * sin(2 rad/s * t)"}, outputs=["F"], at=[0.1, 0.2])
    assert signal.keys() == ["F"] and len(signal.t) == 2
    held = model.simulate(1, inputs={"v": (t, np.array([0.0, 0.01, -0.01]))}, hold=True, outputs=["v"], at=[0.4, 0.7])
    assert list(held["v"]) == [0.0, 0.01]
    with pytest.raises(ValueError, match="no signal for `v`"):
        model.simulate(1)
    with pytest.raises(TypeError, match="a function of Python"):
        model.simulate(1, inputs={"v": lambda t: t})


def test_progress_is_reported_and_an_exception_of_it_ends_the_run():
    text = fric.loads(
        "model M { state x [m] = 0  dx/dt = 1 m/s * sin(t / 1 s) }\n"
        "experiment e { run M() for 1000 s  solver rk4 step 10 us  record x every 1 s }\n"
    )
    with pytest.raises(ZeroDivisionError):
        text.run("e", progress=lambda done, total: 1 / 0)
