"""Sweeps: the bytes of the command on every engine, whatever dies meanwhile.

``FRIC_SWEEP_RUNS``: runs of the sweep whose workers are killed (2,000; the bar of the design is 20,000).
"""

import concurrent.futures
import os
import signal
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


def alone(command, folder, runs=60, out="alone.csv"):
    """The sweep of the command on one thread."""
    vary = ["--vary", "fr.Fs = 1 N .. 1.8 N by 0.2 N", "--vary", "m ~ lognormal(1 kg, 0.8)"]
    how = ["--runs", str(runs), "--seed", "7", "-q", "--threads", "1", "--out", out]
    subprocess.run([command, "sweep", "pull.fric", "pulled", *vary, *how], cwd=folder, check=True)
    path = folder / out
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
    path = folder / name
    return path.read_bytes() if path.is_file() else contents(path)


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
            if done > total / 4:
                os.kill(next(iter(pool._processes)), signal.SIGKILL)

        with pytest.raises(fric.SweepError, match="resume=True") as raised:
            sweep(folder, runs, out=out, on=pool, unit=0.02, progress=kill)
    first, last = raised.value.missing[0]
    assert 0 < first < last == 5 * runs
    with pytest.raises(ValueError, match="resume"):
        sweep(folder, runs, out=out)
    sweep(folder, runs, out=out, resume=True)
    assert out.read_bytes() == whole


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


def test_dask_gives_the_same_bytes_though_workers_are_killed(command, folder, cluster, client):
    """Of three processes one is killed at 25 % and one at 60 %."""
    runs = int(os.environ.get("FRIC_SWEEP_RUNS", "2000")) // 5
    whole = alone(command, folder, runs)
    killed, begin = [], time.perf_counter()

    def kill(done, total):
        if len(killed) < 2 and done > total * (0.25, 0.60)[len(killed)]:
            alive = [worker.process.pid for worker in cluster.workers.values() if worker.process and worker.process.pid]
            os.kill(alive[len(killed) % len(alive)], signal.SIGKILL)
            killed.append(done / total)

    table = sweep(folder, runs, out=folder / "t.csv", on=client, unit=0.1, progress=kill)
    took = time.perf_counter() - begin
    print(f"{len(table)} runs in {took:.1f} s, workers killed at {killed}")
    assert len(killed) == 2
    assert (folder / "t.csv").read_bytes() == whole
    # The dataset, through an address.
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    sweep(folder, 60, out=folder / "set", on=address, unit=0.1)
    assert contents(folder / "set") == alone(command, folder, 60, "alone")


CLIENT = """
import sys, fric
from test_sweep import sweep
from pathlib import Path
from distributed import Client
if __name__ == "__main__":
    folder, scheduler, runs = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    with Client(scheduler) as client:
        sweep(folder, runs, out=folder / "t.csv", on=client, unit=0.05, resume=True)
"""


def test_a_killed_client_is_resumed_on_another_engine(command, folder, cluster):
    runs = 400
    whole = alone(command, folder, runs)
    (folder / "client.py").write_text(CLIENT, encoding="utf-8")
    arguments = [sys.executable, str(folder / "client.py"), str(folder), cluster.scheduler_address, str(runs)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    out = folder / "t.csv"
    seen = 0
    for part in (0.1, 0.3):
        child = subprocess.Popen(arguments, env=environment)
        while child.poll() is None and (not out.exists() or out.read_bytes().count(b"\n") < 5 * runs * part):
            time.sleep(0.01)
        child.kill()
        child.wait()
        seen = max(seen, out.read_bytes().count(b"\n"))
    assert 5 * runs * 0.3 <= seen
    if (folder / ".t.csv.unfinished").exists():
        sweep(folder, runs, out=out, threads=2, resume=True)
    assert out.read_bytes() == whole


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
