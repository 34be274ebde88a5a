"""Sweeps: the bytes of the command on every engine, whatever dies meanwhile.

``FRIC_SWEEP_RUNS``: runs of the sweep whose workers are killed (2,000; the bar of the design is 20,000).
"""

import concurrent.futures
import contextlib
import hashlib
import json
import math
import os
import pickle
import random
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import fric

TEXT = """
import std.interfaces
import std.friction
model Pull {
  param  m = 1 kg in 0.2 kg .. 5 kg
  state  x [m]   = 0
  state  v [m/s] = 0 in -3 m/s .. 3 m/s
  let    pull = 2 N/m * (0.1 m/s * t - x)
  part   fr : Friction = Karnopp(v = v, F_ext = pull)
  dx/dt = v
  dv/dt = (pull - fr.F) / m
}
experiment pulled {
  run    Pull() for 3 s
  solver rk4 step 1 ms
  expect max(v) < 0.4 m/s
  show   final(x) [mm]
}
"""
VARY = {"fr.Fs": "1 N .. 1.8 N by 0.2 N", "m": fric.lognormal("1 kg", 0.8)}


def sweep(folder, runs=60, **how):
    return fric.sweep(folder / "pull.fric", "pulled", vary=VARY, runs=runs, seed=7, **how)


OPTIONS = ["--vary", "fr.Fs = 1 N .. 1.8 N by 0.2 N", "--vary", "m ~ lognormal(1 kg, 0.8)", "--seed", "7", "-q"]


def alone(command, folder, runs=60, out="alone.csv", *more):
    """The sweep of the command on one thread."""
    how = ["--runs", str(runs), "--threads", "1", "--out", out, *more]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *OPTIONS, *how], cwd=folder, check=True)
    return bytes_of(folder / out)


def bytes_of(path):
    return path.read_bytes() if path.is_file() else contents(path)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "pull.fric").write_text(TEXT, encoding="utf-8")
    return tmp_path


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=3, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
    ) as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    from distributed import Client

    with Client(cluster) as client:
        yield client


def test_the_bytes_are_those_of_the_command(command, folder):
    whole = alone(command, folder)
    for threads in (1, 3):
        table = sweep(folder, out=folder / "t.csv", threads=threads)
        assert (folder / "t.csv").read_bytes() == whole
    assert len(table) == 300 and table.columns[0] == "run"
    assert alone(command, folder, out="alone.parquet") == sweep_bytes(folder, "t.parquet")
    assert alone(command, folder, out="alone") == sweep_bytes(folder, "set")
    here = sweep(folder)
    assert here.path is None and here["run"].tolist() == list(range(300))
    assert set(here["fr.Fs [N]"].tolist()) == {1.0, 1.2, 1.4, 1.6, 1.8}
    assert here["fr.Fs"] is here["fr.Fs [N]"]
    failed = here["status"] != "ok"
    assert 0 < failed.sum() < 150 and np.isnan(here["max(v)"][here["status"] == here["status"][failed][0]]).all()
    frame = here.to_pandas()
    assert list(frame.columns) == here.columns and len(frame) == 300
    assert "deviation" in here.summary or "mean" in here.summary
    with pytest.raises(fric.UnknownName, match="fr.Fs"):
        here["fr.Fz"]


def sweep_bytes(folder, name):
    sweep(folder, out=folder / name)
    return bytes_of(folder / name)


def test_what_varies_is_given_in_every_way(folder):
    text = fric.load(folder / "pull.fric")
    ways = [
        {"m": "1 kg, 2 kg"},
        {"m": np.array([1.0, 2.0])},
        {"m": [1, "2 kg"]},
        ["m = 1 kg, 2 kg"],
    ]
    tables = [fric.sweep(text, vary=vary, duration="0.1 s") for vary in ways]
    assert all((table["m"] == [1.0, 2.0]).all() for table in tables)
    assert all((table["final(x)"] == tables[0]["final(x)"]).all() for table in tables)
    drawn = fric.sweep(text, vary={"m": fric.normal(1.0, "50 g")}, runs=5, duration="0.1 s")
    again = fric.sweep(text, vary="m ~ normal(1 kg, 0.05 kg)", runs=5, duration="0.1 s")
    assert (drawn["m"] == again["m"]).all() and len(np.unique(drawn["m"])) == 5
    # SI where no unit is written, in the unit of the text.
    assert fric.sweep(text, vary={"fr.Fs": [1.5]}, set={"m": 2.0}, duration=0.1)["fr.Fs"].tolist() == [1.5]


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        ({"vary": {"m": "1 N, 2 N"}}, ValueError, "force"),
        ({"vary": {"mm": "1 kg, 2 kg"}}, fric.UnknownName, "mm"),
        ({"vary": {}}, ValueError, "nothing varies"),
        ({"vary": {"m": "1 kg, 2 kg"}, "seed": 3}, ValueError, "distributions"),
        ({"vary": {"m": "1 kg, 2 kg"}, "tol": 1e-3}, ValueError, "tolerance"),
        ({"vary": {"m": "1 kg, 2 kg"}, "on": 3}, TypeError, "submit"),
        ({"vary": {"m": "1 kg, 2 kg"}, "on": "spark://x"}, ValueError, "dask://"),
        ({"vary": {"m": "1 kg, 2 kg"}, "resume": True}, ValueError, "out="),
        ({"vary": {"m": "1 kg, 2 kg"}, "unit": 0}, ValueError, "positive"),
        ({"vary": {"m": "1 kg, 2 kg"}, "keep": "sums"}, ValueError, "summary"),
        ({"vary": {"m": "1 kg, 2 kg"}, "keep": "summary", "out": "t.csv"}, ValueError, ".json"),
        ({"vary": {"m": "1 kg, 2 kg"}, "out": "t.json"}, ValueError, ".parquet"),
        ({"vary": {"m": "1 kg, 2 kg"}, "shared": True}, ValueError, "out="),
        ({"vary": {"m": "1 kg, 2 kg"}, "shared": True, "out": "t.csv"}, ValueError, "folder"),
        ({"design": {"m": [1.0, 2.0], "fr.Fs": [1.0]}}, ValueError, "one length"),
        ({"design": {"m": [1.0]}, "vary": {"m": "1 kg, 2 kg"}}, ValueError, "twice"),
        ({"design": {"mm": [1.0]}}, fric.UnknownName, "mm"),
        ({"design": {"m [N]": [1.0]}}, ValueError, "force"),
        ({"design": np.zeros((3, 2))}, TypeError, "zip"),
        ({"vary": {"m": fric.uniform("0.3 kg", "4 kg")}, "runs": 2_000_000}, ValueError, "too many for memory"),
    ],
)
def test_mistakes_are_told(folder, how, error, words):
    with pytest.raises(error, match=words):
        fric.sweep(folder / "pull.fric", "pulled", **how)


class Polled:
    """An engine that only answers when it is asked, as that of submitit, and whose jobs end in any order."""

    def __init__(self, executor):
        self.executor = executor

    def submit(self, function, *arguments):
        time.sleep(0.001)
        future = self.executor.submit(function, *arguments)

        class Job:
            def done(self):
                return future.done()

            def result(self):
                return future.result()

        return Job()


def test_any_executor_serves(command, folder):
    whole = alone(command, folder)
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        sweep(folder, out=folder / "t.csv", on=pool, unit=0.05)
        assert (folder / "t.csv").read_bytes() == whole
        sweep(folder, out=folder / "t.csv", on=Polled(pool), unit=0.05)
        assert (folder / "t.csv").read_bytes() == whole


def test_a_broken_pool_ends_a_sweep_that_another_engine_finishes(command, folder):
    runs = 400
    whole = alone(command, folder, runs)
    out = folder / "t.csv"
    with concurrent.futures.ProcessPoolExecutor(2) as pool:

        def kill(done, total):
            # A pool that breaks ends its processes before it tells.
            if done > total / 4:
                with contextlib.suppress(ProcessLookupError):
                    for process in list(pool._processes or ())[:1]:
                        os.kill(process, signal.SIGKILL)

        with pytest.raises(fric.SweepError, match="resume=True") as raised:
            sweep(folder, runs, out=out, on=pool, unit=0.002, progress=kill)
    first, last = raised.value.missing[0]
    assert 0 < first < last == 5 * runs
    with pytest.raises(ValueError, match="resume"):
        sweep(folder, runs, out=out)
    sweep(folder, runs, out=out, resume=True)
    assert out.read_bytes() == whole


class Failing(concurrent.futures.ThreadPoolExecutor):
    """Takes some units, and none from then on."""

    def __init__(self, takes):
        super().__init__(2)
        self.takes = takes

    def submit(self, *arguments):
        self.takes -= 1
        if self.takes < 0:
            raise concurrent.futures.BrokenExecutor("out of order")
        return super().submit(*arguments)


@pytest.mark.parametrize("takes", [0, 1, 2, *(random.Random(seed).randrange(3, 12) for seed in range(4))])
def test_an_engine_that_takes_no_more_units_keeps_the_rows(command, folder, takes):
    runs = 400
    whole = alone(command, folder, runs)
    out = folder / "t.csv"
    with Failing(takes) as pool, pytest.raises(fric.SweepError, match="no more units: out of order.*resume=True") as raised:
        sweep(folder, runs, out=out, on=pool, unit=0.001)
    first, last = raised.value.missing[0]
    assert 0 <= first < last == 5 * runs
    sweep(folder, runs, out=out, resume=True)
    assert out.read_bytes() == whole


def test_statistics_alone_and_beside_rows_are_those_of_the_command(command, folder):
    runs = 700
    table = alone(command, folder, runs, "alone.csv", "--keep", "both")
    whole = (folder / "alone.json").read_bytes()
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        found = sweep(folder, runs, out=folder / "t.json", keep="summary", on=pool, unit=0.05)
        assert (folder / "t.json").read_bytes() == whole
        both = sweep(folder, runs, out=folder / "t.csv", keep="both", on=pool, unit=0.05)
    assert (folder / "t.csv").read_bytes() == table and (folder / "t.json").read_bytes() == whole
    assert len(found) == len(both) == 5 * runs and len(found.groups) == 5
    assert [group.point for group in found.groups] == [{"fr.Fs [N]": fs} for fs in (1.0, 1.2, 1.4, 1.6, 1.8)]
    for k, group in enumerate(found.groups):
        part = slice(k * runs, (k + 1) * runs)
        for name in ("max(v)", "final(x)"):
            values = both[name][part]
            values, measured = values[~np.isnan(values)], group[name]
            assert (measured.number, measured.missing) == (len(values), runs - len(values))
            assert measured.mean == pytest.approx(values.mean(), rel=1e-12)
            assert measured.deviation == pytest.approx(values.std(ddof=1), rel=1e-10)
            assert (measured.least[0], measured.greatest[0]) == (values.min(), values.max())
            for quantile in (0, 0.01, 0.3, 0.5, 0.95, 1):
                exact = np.sort(values)[int(np.floor(quantile * (len(values) - 1) + 0.5))]
                assert measured.quantile(quantile) == pytest.approx(exact, rel=1e-3)
            assert measured.histogram[2].sum() == len(values)
            lowest = np.argsort(both[name][part], kind="stable")[:16] + k * runs
            assert [row["run"] for row in measured.lowest] == lowest.tolist()
            assert measured.highest[0][measured.title] == values.max()
        held = both["max(v) < 0.4 m/s"][part]
        assert group.verdicts["max(v) < 0.4 m/s"] == (sum(x is True for x in held), sum(x is not None for x in held))
        assert sum(number for _, number, _ in group.ended) == group.runs == runs
    # Those in the file are the same as those computed from the histogram.
    in_file = json.loads(whole)["groups"][0]["measures"][found.groups[0]["final(x)"].title]["quantiles"]
    assert all(found.groups[0]["final(x)"].quantile(int(name[:-2]) / 100) == value for name, value in in_file.items())
    frame = both.statistics.to_pandas()
    assert len(frame) == 10 and frame["mean"].tolist()[0] == found.groups[0]["max(v)"].mean
    here = fric.sweep(folder / "pull.fric", vary={"m": fric.uniform("0.5 kg", "2 kg")}, runs=300, keep="summary")
    assert here.path is None and here["max(v)"].number == 300 and "median" in here.summary
    with pytest.raises(KeyError, match="groups"):
        found["max(v)"]
    with pytest.raises(fric.UnknownName, match="max"):
        here["max(w)"]


def test_a_design_gives_the_rows_of_the_command(command, folder):
    import pandas

    rng = np.random.default_rng(5)
    mass, force = rng.uniform(0.4, 4, 90), rng.uniform(1, 2, 90)
    text = "m [g],fr.Fs [N]\n" + "".join(f"{1000 * m!r},{f!r}\n" for m, f in zip(mass.tolist(), force.tolist()))
    (folder / "design.csv").write_text(text, encoding="utf-8")
    how = ["--design", "design.csv", "-q", "--out", "alone.csv"]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *how], cwd=folder, check=True)
    grams = pandas.DataFrame({"m [g]": 1000 * mass, "fr.Fs [N]": force})
    for design in (grams, folder / "design.csv"):
        fric.sweep(folder / "pull.fric", design=design, out=folder / "t.csv")
        assert (folder / "t.csv").read_bytes() == (folder / "alone.csv").read_bytes()
    table = fric.sweep(folder / "pull.fric", design={"m": mass, "fr.Fs": force}, vary={"x": "0 m, 1 mm"}, duration=0.1)
    assert len(table) == 180 and table["m"].tolist() == np.repeat(mass, 2).tolist()
    assert (table["x"] == np.tile([0.0, table["x"][1]], 90)).all() and (table["fr.Fs"] == np.repeat(force, 2)).all()


def test_rows_come_in_order_and_an_iterator_may_be_left(folder):
    whole = sweep(folder, 100)
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        for how in ({"threads": 2}, {"on": pool, "unit": 0.02}):
            reached, parts = 0, []
            for first, rows in fric.sweep_rows(folder / "pull.fric", "pulled", vary=VARY, runs=100, seed=7, **how):
                assert first == reached
                reached += len(rows)
                parts.append(rows)
            assert reached == 500 and len(parts) > 1
            for title in whole.columns:
                together = np.concatenate([rows[title] for rows in parts])
                assert all(a == b or (a != a and b != b) for a, b in zip(together, whole[title])), title
        for first, rows in fric.sweep_rows(folder / "pull.fric", vary=VARY, runs=100_000_000, on=pool, unit=0.02):
            if first > 500:
                break
        # The pool is free for others.
        assert pool.submit(abs, -1).result(timeout=60) == 1


class Elsewhere:
    """Workers with another version of fric: plans are another's to them."""

    def __init__(self, executor):
        self.executor = executor

    def submit(self, function, plan, first, last):
        version = f'"version": "{fric.__version__}"'.encode()
        assert version in plan
        old = plan.replace(version, b'"version": "0.0.9"') if first > 100 else plan
        return self.executor.submit(function, old, first, last)


def test_another_version_names_the_host_and_the_rest_is_resumed(command, folder):
    whole = alone(command, folder)
    out = folder / "t.csv"
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        with pytest.raises(fric.VersionMismatch, match=f"{socket.gethostname()} has fric .* pip install fric==0.0.9") as raised:
            sweep(folder, out=out, on=Elsewhere(pool), unit=0.01)
        error = raised.value
        assert (error.host, error.planned, error.installed) == (socket.gethostname(), "0.0.9", fric.__version__)
        assert error.missing[0][1] == 300 and isinstance(error, fric.SweepError)
        again = pickle.loads(pickle.dumps(error))
        assert (str(again), again.host, again.missing) == (str(error), error.host, error.missing)
        sweep(folder, out=out, on=pool, resume=True)
    assert out.read_bytes() == whole


def test_workers_write_a_dataset_that_all_see(command, folder):
    runs = 300
    whole = alone(command, folder, runs, "alone")
    assert len(whole) == 7
    with concurrent.futures.ProcessPoolExecutor(2) as pool:
        sweep(folder, runs, out=folder / "set", on=pool, shared=True)
        assert contents(folder / "set") == whole
        # Interrupted, and resumed without `shared`.
        with pytest.raises(KeyboardInterrupt):
            sweep(folder, runs, out=folder / "set", on=pool, shared=True, progress=interrupt)
        assert not (folder / "set/_fric.json").exists()
        sweep(folder, runs, out=folder / "set", resume=True)
        assert contents(folder / "set") == whole
        with pytest.raises(fric.SweepError, match="under one name|cannot write"):
            sweep(folder, runs, out=folder / "other", on=Astray(pool), shared=True)


def interrupt(done, total):
    if done > total / 3:
        raise KeyboardInterrupt


class Astray:
    """Workers that see another folder under the name of the client's."""

    def __init__(self, executor):
        self.executor = executor

    def submit(self, function, plan, first, last):
        return self.executor.submit(astray, function, plan, first, last)


def astray(function, plan, first, last):
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        return function.func(folder, plan, first, last)


def test_tables_are_arrow_streams(folder):
    pyarrow, polars = pytest.importorskip("pyarrow"), pytest.importorskip("polars")
    table = sweep(folder)
    frame = table.to_pandas()
    for found in (pyarrow.table(table), polars.DataFrame(table).to_arrow()):
        assert found.column_names == table.columns and found.num_rows == 300
        assert found["run"].to_pylist() == list(range(300))
        assert found["status"].to_pylist() == frame["status"].tolist()
        assert found["max(v) < 0.4 m/s"].to_pylist() == [None if x is None else bool(x) for x in table["max(v) < 0.4 m/s"]]
        assert np.array_equal(found["max(v) [m/s]"].to_numpy(), table["max(v)"], equal_nan=True)
    assert None in table["max(v) < 0.4 m/s"].tolist()
    address = pyarrow.table(table)["max(v) [m/s]"].chunk(0).buffers()[1].address
    assert address == table["max(v)"].ctypes.data
    sweep(folder, out=folder / "t.parquet")
    assert pyarrow.table(fric.sweep(folder / "pull.fric", vary={"m": "1 kg, 2 kg"}, out=folder / "u.parquet")).num_rows == 2


def test_ctrl_c_keeps_what_came_and_the_command_goes_on(command, folder):
    runs = 400
    whole = alone(command, folder, runs)

    def stop(done, total):
        if done > total / 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(folder, runs, out=folder / "t.csv", threads=2, progress=stop, unit=0.02)
    assert (folder / ".t.csv.unfinished").exists()
    vary = ["--vary", "fr.Fs = 1 N .. 1.8 N by 0.2 N", "--vary", "m ~ lognormal(1 kg, 0.8)"]
    how = ["--runs", str(runs), "--seed", "7", "-q", "--out", "t.csv", "--resume"]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *vary, *how], cwd=folder, check=True)
    assert (folder / "t.csv").read_bytes() == whole


class Counting:
    """A client of Dask whose workers write down each unit that they begin."""

    def __init__(self, client, folder):
        self.client, self.folder = client, folder
        folder.mkdir()

    def __getattr__(self, name):
        return getattr(self.client, name)

    def submit(self, function, *arguments, **how):
        return self.client.submit(begun, str(self.folder), function, *arguments, **how)


def begun(folder, function, plan, first, last):
    Path(folder, f"{first}-{last}-{os.getpid()}-{time.monotonic_ns()}").touch()
    return function(plan, first, last)


def made_twice(folder):
    """The share of runs that were begun again, as if each unit had been lost at its end."""
    units = [[int(word) for word in path.name.split("-")[:2]] for path in folder.iterdir()]
    return sum(last - first for first, last in units) / max(last for _, last in units) - 1


@pytest.mark.parametrize("name", ["t.csv", "t.parquet", "t.json", "set", "shared"])
def test_dask_gives_the_same_bytes_though_workers_are_killed(command, folder, cluster, client, name):
    """Of three processes one is killed at 25 % and one at 60 %."""
    runs = int(os.environ.get("FRIC_SWEEP_RUNS", "2000")) // 5
    keep = "summary" if name.endswith(".json") else "rows"
    whole = alone(command, folder, runs, f"alone{Path(name).suffix}", "--keep", keep)
    killed, begin = [], time.perf_counter()

    def kill(done, total):
        if len(killed) < 2 and done > total * (0.25, 0.60)[len(killed)]:
            alive = [worker.process.pid for worker in cluster.workers.values() if worker.process and worker.process.pid]
            os.kill(alive[len(killed) % len(alive)], signal.SIGKILL)
            killed.append(done / total)

    counting = Counting(client, folder / "begun")
    how = {"keep": keep, "shared": name == "shared", "unit": 0.01, "progress": kill}
    table = sweep(folder, runs, out=folder / name, on=counting, **how)
    took, twice = time.perf_counter() - begin, made_twice(folder / "begun")
    print(f"{name}: {len(table)} runs in {took:.1f} s, workers killed at {killed}, {100 * twice:.1f} % of runs begun twice")
    assert len(killed) == 2
    assert bytes_of(folder / name) == whole, hashlib.sha256(str(whole).encode()).hexdigest()
    # A death costs the unit that is under way and one whose result was not taken yet. With `shared` a unit is a file of 256
    # runs; of a few runs any unit is a large part.
    most = 4 * 256 / len(table) if name == "shared" else 0.05
    assert 0 <= twice <= most or runs < 4000


def test_the_address_of_a_cluster_serves(command, folder, cluster):
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    sweep(folder, 60, out=folder / "set", on=address, unit=0.1)
    assert contents(folder / "set") == alone(command, folder, 60, "alone")


class Changed:
    """Ray, whose workers write down their process and get another plan from a run on."""

    def __init__(self, ray, folder, old=math.inf):
        self.ray, self.folder, self.old = ray, str(folder), old

    def __getattr__(self, name):
        return getattr(self.ray, name)

    def remote(self, **how):
        folder, old, version = self.folder, self.old, f'"version": "{fric.__version__}"'.encode()

        def changed(function):
            def called(work, plan, first, last):
                import os

                open(f"{folder}/{first}-{last}-{os.getpid()}", "w").close()
                return function(work, plan if first < old else plan.replace(version, b'"version": "0.0.9"'), first, last)

            return self.ray.remote(**how)(called)

        return changed


def test_ray_gives_the_same_bytes_though_a_worker_is_killed(command, folder):
    ray = pytest.importorskip("ray")
    runs = 400
    whole = alone(command, folder, runs)
    units = folder / "begun"
    units.mkdir()
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    try:
        killed = []

        def kill(done, total):
            # The worker of a unit whose rows have not come.
            late = [path.name.split("-") for path in units.iterdir() if int(path.name.split("-")[0]) >= done]
            if not killed and done > total / 4 and late:
                killed.append(late[-1][2])
                os.kill(int(killed[0]), signal.SIGKILL)

        sweep(folder, runs, out=folder / "t.csv", on=Changed(ray, units), unit=0.01, progress=kill)
        assert killed and (folder / "t.csv").read_bytes() == whole
        twice = made_twice(units)
        print(f"{len(list(units.iterdir()))} units, {100 * twice:.1f} % of runs begun twice")
        with pytest.raises(fric.VersionMismatch, match="pip install fric==0.0.9") as raised:
            sweep(folder, out=folder / "u.csv", on=Changed(ray, units, old=100), unit=0.01)
        assert raised.value.planned == "0.0.9" and raised.value.missing[0][1] == 300
    finally:
        ray.shutdown()


CLIENT = """
import sys
from pathlib import Path
from test_sweep import sweep

if __name__ == "__main__":
    folder, name, keep, scheduler, runs = Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4], int(sys.argv[5])
    how = dict(out=folder / name, keep=keep, unit=0.05, resume=sys.argv[6] == "resume")
    if scheduler == "threads":
        sweep(folder, runs, threads=2, **how)
    else:
        from distributed import Client

        with Client(scheduler) as client:
            sweep(folder, runs, on=client, **how)
"""


@pytest.mark.parametrize("name", ["t.csv", "t.parquet", "set", "t.json"])
def test_a_client_killed_five_times_and_engines_in_turn_give_the_same_bytes(command, folder, cluster, seed, name):
    """Of the engines threads here, the command, Dask and units of the command, chosen at random; so are the times."""
    runs, chance = 500, random.Random(f"{seed} {name}")
    keep = "summary" if name.endswith(".json") else "rows"
    more = ["--keep", keep]
    whole = alone(command, folder, runs, f"alone{Path(name).suffix}", *more)
    (folder / "client.py").write_text(CLIENT, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    out, unfinished = folder / name, folder / (f".{name}.unfinished" if name != "set" else "set/._fric.json.unfinished")
    plan = ["--runs", str(runs), *more, "--plan", "p.fricjob"]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *OPTIONS, *plan], cwd=folder, check=True)

    def begin(engine):
        """Begins or resumes the sweep by an engine; for units the next one."""
        resume = ["resume"] if unfinished.exists() else ["begin"]
        if engine == "command":
            how = ["--runs", str(runs), "--threads", "1", "--out", name, *more, *(["--resume"] if resume == ["resume"] else [])]
            return [command, "sweep", "pull.fric", "pulled", *OPTIONS, *how]
        if engine == "units":
            which = f"{chance.randrange(8)}/8"
            return [command, "sweep", "--unit", which, "p.fricjob", "-q", "-o", f"{which[0]}.fricunit"]
        scheduler = "threads" if engine == "threads" else cluster.scheduler_address
        return [sys.executable, str(folder / "client.py"), str(folder), name, keep, scheduler, str(runs), *resume]

    killed = []
    engines = ["threads", "command", "dask", "units"]
    while len(killed) < 5:
        if out.exists() and not unfinished.exists():
            # It was finished before its time: the next kills begin anew.
            out.unlink() if out.is_file() else shutil.rmtree(out)
        engine = engines[len(killed)] if len(killed) < 4 else chance.choice(engines)
        child = subprocess.Popen(begin(engine), cwd=folder, env=environment)
        # Python takes its time to begin.
        time.sleep(chance.uniform(0, 0.5 if engine in ("command", "units") else 3))
        child.kill()
        child.wait()
        killed.append(engine)
    engine = chance.choice(engines)
    print(f"seed {seed}: {name}, killed {killed}, finished by {engine}")
    if engine == "units":
        for k in range(8):
            subprocess.run([command, "sweep", "--unit", f"{k}/8", "p.fricjob", "-q", "-o", f"{k}.fricunit"], cwd=folder, check=True)
        units = [f"{k}.fricunit" for k in chance.sample(range(8), 8)]
        subprocess.run([command, "sweep", "--join", "p.fricjob", *units, "-q", "--out", name], cwd=folder, check=True)
    elif unfinished.exists() or not out.exists() or (name == "set" and not (out / "_fric.json").exists()):
        subprocess.run(begin(engine), cwd=folder, env=environment, check=True)
    assert bytes_of(out) == whole
    assert not unfinished.exists()


class Poisoned:
    """Dask, where one run ends its worker."""

    def __init__(self, client, run):
        self.client, self.run = client, run

    def submit(self, function, plan, first, last):
        return self.client.submit(end, function, plan, first, last, self.run, pure=False)


def end(function, plan, first, last, poison):
    if first <= poison < last:
        os._exit(9)
    return function(plan, first, last)


def test_a_run_that_ends_its_workers_is_named_and_all_others_are_there(command, folder, client):
    whole = alone(command, folder).splitlines(keepends=True)
    # Dask itself gives a task up after its first death.
    client.run_on_scheduler(lambda dask_scheduler: setattr(dask_scheduler, "allowed_failures", 0))
    with pytest.raises(fric.SweepError, match="run 130 ends") as raised:
        sweep(folder, out=folder / "t.csv", on=Poisoned(client, 130), unit=0.01)
    assert raised.value.missing == [(130, 131)]
    assert (folder / "t.csv").read_bytes() == b"".join(whole[:131])
    units = folder / "t.csv.units"
    rows = {}
    for unit in units.glob("*.fricunit"):
        for line in unit.read_bytes().splitlines(keepends=True)[1:-1]:
            rows[int(line.split(b",")[0])] = line
    assert [rows[run] for run in range(131, 300)] == whole[132:]
    missing = subprocess.run(
        [command, "sweep", "--join", "sweep.fricjob", "--missing", *sorted(path.name for path in units.glob("*.fricunit"))],
        cwd=units,
        check=True,
        capture_output=True,
        text=True,
    )
    assert missing.stdout == "0..131\n"


def test_the_command_sends_units_to_a_cluster(command, folder, cluster):
    whole = alone(command, folder)
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    on = [command, "sweep", "pull.fric", "pulled", *OPTIONS, "--runs", "60", "--on", address]
    subprocess.run([*on, "--out", "t.csv"], cwd=folder, check=True)
    assert (folder / "t.csv").read_bytes() == whole
    alone(command, folder, 60, "alone.json", "--keep", "summary")
    subprocess.run([*on, "--keep", "summary"], cwd=folder, check=True)
    assert (folder / "sweep.json").read_bytes() == (folder / "alone.json").read_bytes()
    for options, words in [(["--threads", "2"], "--threads and --on"), (["--out", "t.txt"], ".parquet")]:
        failed = subprocess.run([*on, *options], cwd=folder, capture_output=True, text=True)
        assert failed.returncode in (1, 2) and words in failed.stderr, failed.stderr


def test_submitit_runs_units_on_its_local_executor(command, folder):
    submitit = pytest.importorskip("submitit")
    whole = alone(command, folder)
    executor = submitit.LocalExecutor(folder=str(folder / "jobs"))
    executor.update_parameters(timeout_min=5)
    sweep(folder, out=folder / "t.csv", on=executor, unit=1)
    assert (folder / "t.csv").read_bytes() == whole


def test_threads_of_python_run_on(folder):
    """The GIL is let go while units run."""
    count, stop = 0, threading.Event()

    def counting():
        nonlocal count
        while not stop.is_set():
            count += 1
            time.sleep(0.001)

    thread = threading.Thread(target=counting)
    thread.start()
    begin = time.perf_counter()
    sweep(folder, 200, threads=1)
    seconds = time.perf_counter() - begin
    stop.set()
    thread.join()
    assert count > 20 * seconds, f"{count} in {seconds} s"


def test_the_job_of_kubernetes_makes_all_units(command, folder, root):
    """A stand-in for the cluster: each pod's command with its index, as the controller would set it."""
    yaml = pytest.importorskip("yaml")
    job = yaml.safe_load((root / "examples/cluster/kubernetes.yaml").read_text(encoding="utf-8"))
    spec = job["spec"]
    assert (job["kind"], spec["completionMode"]) == ("Job", "Indexed")
    [container] = spec["template"]["spec"]["containers"]
    mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
    assert mounts == {"sweep": container["workingDir"]}
    assert f"%j/{spec['completions']}" in container["command"]
    whole = alone(command, folder, 4)
    vary = ["--vary", "fr.Fs = 1 N .. 1.8 N by 0.2 N", "--vary", "m ~ lognormal(1 kg, 0.8)"]
    plan = ["--runs", "4", "--seed", "7", "-q", "--plan", "sweep.fricjob"]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *vary, *plan], cwd=folder, check=True)
    for index in range(spec["completions"]):
        environment = {**os.environ, "JOB_COMPLETION_INDEX": str(index)}
        words = [word.replace("$(JOB_COMPLETION_INDEX)", str(index)) for word in container["command"]]
        assert words[0] == "fric"
        subprocess.run([command, *words[1:]], cwd=folder, env=environment, check=True)
    units = sorted(str(path) for path in (folder / "units").glob("*.fricunit"))
    join = [command, "sweep", "--join", "sweep.fricjob", *units, "-q", "--out", "t.csv"]
    subprocess.run(join, cwd=folder, check=True)
    assert (folder / "t.csv").read_bytes() == whole
