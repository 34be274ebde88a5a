"""Sweeps: on the threads of this machine, or on an engine of many; the bytes are those of ``fric sweep``."""

from __future__ import annotations

import csv
import functools
import hashlib
import heapq
import os
import io
import queue
import socket
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from concurrent import futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fric import _fric, _values
from fric._model import Progress, Text, _reporter, load
from fric._statistics import Statistics
from fric.errors import SweepError, VersionMismatch, unknown

#: Most rows of a table in memory.
MOST_ROWS = 1_000_000
#: Bytes of rows that may wait for an earlier unit.
MOST_WAITING = 64 << 20
#: Runs of a unit before anything is known of their cost, and the fewest later on: enough for the widest lanes.
FEWEST = 64
#: Seconds of the longest unit.
LONGEST = 30.0
#: Workers that may die one after the other without a row between.
MOST_DEATHS = 20


@dataclass(frozen=True)
class Draw:
    """A distribution from which a parameter is drawn. Numbers without a unit are in SI."""

    name: str
    first: Any
    second: Any

    def _text(self, path: str, si: str) -> str:
        first = _values.written(path, self.first, si)
        second = _values.written(path, self.second, "" if self.name == "lognormal" else si)
        return f"~ {self.name}({first}, {second})"


def normal(mean: Any, deviation: Any) -> Draw:
    """A normal distribution, for ``vary``: ``fric.normal("1 kg", "50 g")``."""
    return Draw("normal", mean, deviation)


def lognormal(median: Any, spread: float) -> Draw:
    """A log-normal distribution: the median, and the standard deviation of the logarithm, about the relative spread."""
    return Draw("lognormal", median, spread)


def uniform(low: Any, high: Any) -> Draw:
    """A uniform distribution between two bounds."""
    return Draw("uniform", low, high)


class Table:
    """The table of a sweep: a row for each run."""

    def __init__(self, path: Path | None, columns: list[tuple[str, str]], rows: int, summary: str):
        #: The file, or the folder of a dataset; none if it is in memory alone.
        self.path = path
        #: The summary of ``fric sweep``.
        self.summary = summary
        self._kinds = dict(columns)
        self._rows = rows
        self._values: dict[str, np.ndarray] | None = None
        #: What became of each measure, with ``keep="both"``.
        self.statistics: Statistics | None = None

    @property
    def columns(self) -> list[str]:
        """The titles, such as ``fr.Fs [N]``."""
        return list(self._kinds)

    def __len__(self) -> int:
        return self._rows

    def __getitem__(self, name: str) -> np.ndarray:
        """A column by its title, or by what stands before the unit. Values are in the unit of the title."""
        if self._values is None:
            self._values = self._read(self.path)
        for title, values in self._values.items():
            if name in (title, title.rsplit(" [", 1)[0]):
                return values
        raise unknown("column", name, self.columns)

    def _read(self, path: Path | None) -> dict[str, np.ndarray]:
        assert path is not None
        if path.suffix != ".csv":
            frame = self.to_pandas()
            return {title: frame[title].to_numpy() for title in frame.columns}
        with open(path, newline="", encoding="utf-8") as file:
            lines = csv.reader(file)
            next(lines)
            columns = list(zip(*lines)) or [()] * len(self._kinds)
        return {title: _column(kind, cells) for (title, kind), cells in zip(self._kinds.items(), columns)}

    def to_pandas(self) -> Any:
        """The table as a DataFrame."""
        import pandas  # type: ignore

        if self.path is not None and self.path.suffix != ".csv":
            if self.path.is_dir():
                parts = sorted(self.path.glob("part-*.parquet"))
                return pandas.concat([pandas.read_parquet(part) for part in parts], ignore_index=True)
            return pandas.read_parquet(self.path)
        return pandas.DataFrame({title: self[title] for title in self._kinds})

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        """The columns for pyarrow, polars and DuckDB, numbers without a copy. A number that is missing is NaN."""
        columns: list[tuple[str, Any]] = []
        for title in self._kinds:
            values = self[title]
            numbers = values.dtype.kind in "if"
            columns.append((title, np.ascontiguousarray(values) if numbers else values.tolist()))
        return _fric.arrow_stream(columns)

    def __repr__(self) -> str:
        return f"<fric.Table {self._rows} runs: {', '.join(self._kinds)}>"


def _column(kind: str, cells: tuple[str, ...]) -> np.ndarray:
    if kind == "integers":
        return np.array([int(cell) for cell in cells], dtype=np.int64)
    if kind == "numbers":
        return np.array([float(cell) if cell else np.nan for cell in cells], dtype=float)
    if kind == "booleans":
        known = {"true": True, "false": False}
        found = [known.get(cell) for cell in cells]
        return np.array(found, dtype=object if None in found else bool)
    return np.array(cells, dtype=object)


def sweep(
    text: str | os.PathLike[str] | Text,
    experiment: str | None = None,
    *,
    vary: Mapping[str, Any] | Iterable[str] = (),
    design: Any = None,
    runs: int | None = None,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,
    solver: str | None = None,
    step: str | float | None = None,
    tol: float | None = None,
    duration: str | float | None = None,
    out: str | os.PathLike[str] | None = None,
    keep: str = "rows",
    shared: bool = False,
    on: Any = None,
    unit: float = 5.0,
    threads: int | None = None,
    resume: bool = False,
    progress: bool | Progress | None = None,
    retries: int = 3,
) -> Table | Statistics:
    """Runs an experiment many times, with the rows and bytes of ``fric sweep``.

    ``vary``: what changes, as texts of ``--vary``, or by path: a text (``"1 N .. 2 N by 0.1 N"``), an array in SI, or a
    distribution (:func:`normal`, :func:`lognormal`, :func:`uniform`), drawn ``runs`` times. ``design``: runs of your
    own, a DataFrame or a mapping from paths, such as ``"m"`` in SI or ``"m [g]"``, to columns of one length. ``out``: a name that ends in
    ``.csv`` or ``.parquet``, or a folder for a dataset of Parquet files; else the table is in memory. ``keep``: ``"rows"``;
    ``"summary"``, statistics alone, in memory or as ``.json``; or ``"both"``, a table with statistics. ``on``: where it is
    run: a client or cluster of Dask, its address ``"dask://host:8786"``, the module ``ray`` after ``ray.init``,
    ``"ray://host:10001"``, or any executor with ``submit``; else ``threads`` threads here. ``shared``: the workers write the files of a dataset, into a folder that all machines see under
    one name; only their hashes are sent. ``unit``: about how many seconds of work are sent at once. ``resume``: goes on with a table
    that was interrupted, here or elsewhere. A unit whose worker dies is sent again, up to ``retries`` times.
    """
    plan = _plan(text, experiment, vary, design, runs, seed, set, solver, step, tol, duration, keep)
    if out is not None:
        _check_name(Path(out), keep)
        if shared and (keep == "summary" or Path(out).suffix):
            raise ValueError("shared: workers write the files of a dataset: out= is then a folder, a name without ending")
        return _run(plan, Path(out), keep, on, unit, threads, resume, progress, retries, shared=shared)
    if shared:
        raise ValueError("shared: workers write the files of a dataset: name its folder with out=")
    if resume:
        raise ValueError("resume: a table in memory is gone when a call ends; name a file with out=")
    with tempfile.TemporaryDirectory(prefix="fric-") as folder:
        name = "table.json" if keep == "summary" else "table.csv"
        most = None if keep == "summary" else MOST_ROWS
        table = _run(plan, Path(folder) / name, keep, on, unit, threads, False, progress, retries, most)
        if isinstance(table, Table):
            table._values = table._read(table.path)
            if table.statistics is not None:
                table.statistics.path = None
        table.path = None
    return table


def _plan(
    text: str | os.PathLike[str] | Text,
    experiment: str | None,
    vary: Mapping[str, Any] | Iterable[str],
    design: Any,
    runs: int | None,
    seed: int | None,
    set: Mapping[str, Any] | None,
    solver: str | None,
    step: str | float | None,
    tol: float | None,
    duration: str | float | None,
    keep: str,
) -> bytes:
    loaded = text if isinstance(text, Text) else load(text)
    if experiment is None:
        if len(loaded.experiments) != 1:
            raise unknown("experiment", "", loaded.experiments)
        experiment = loaded.experiments[0]
    elif experiment not in loaded.experiments:
        raise unknown("experiment", experiment, loaded.experiments)
    known = {path: (si, False) for path, si in loaded._inner.units(experiment)}
    return _fric.sweep_plan(
        loaded._inner,
        experiment,
        _varied(vary, known),
        None if design is None else _table(design, known),
        [f"{path}={value}" for path, value in _values.settings(dict(set or {}), known).items()],
        solver,
        None if step is None else _values.seconds("step", step),
        tol,
        None if duration is None else _values.seconds("duration", duration),
        runs,
        seed,
        keep,
    )


def _table(design: Any, known: Mapping[str, tuple[str, bool]]) -> str:
    """A design as the text of a table."""
    if isinstance(design, (str, os.PathLike)):
        return Path(design).read_text(encoding="utf-8")
    if hasattr(design, "columns") and hasattr(design, "to_numpy"):
        design = {title: design[title].to_numpy() for title in design.columns}
    if not isinstance(design, Mapping):
        raise TypeError(
            f"design: a DataFrame, the name of a file .csv, or a mapping from paths to values is needed, not "
            f"{type(design).__name__}; of an array: dict(zip(paths, array.T))"
        )
    columns = {str(title): np.asarray(values, dtype=float) for title, values in design.items()}
    lengths = {title: values.shape for title, values in columns.items()}
    if not columns or any(len(shape) != 1 for shape in lengths.values()) or len(dict.fromkeys(lengths.values())) != 1:
        raise ValueError(f"design: columns of one length are needed, not {lengths}")
    # A path alone is in SI.
    units = {title: known.get(title.strip(), ("", False))[0] for title in columns}
    heads = [f"{title} [{units[title]}]" if units[title] and "[" not in title else title for title in columns]
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(heads)
    lines.writerows(map(repr, row) for row in zip(*(values.tolist() for values in columns.values())))
    return text.getvalue()


def sweep_rows(
    text: str | os.PathLike[str] | Text,
    experiment: str | None = None,
    *,
    vary: Mapping[str, Any] | Iterable[str] = (),
    design: Any = None,
    runs: int | None = None,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,
    solver: str | None = None,
    step: str | float | None = None,
    tol: float | None = None,
    duration: str | float | None = None,
    on: Any = None,
    unit: float = 5.0,
    threads: int | None = None,
    retries: int = 3,
) -> Iterator[tuple[int, Table]]:
    """The rows of a sweep as they come, in the order of the runs: the number of the first run, and a table of some rows.

    Arguments are those of :func:`sweep`. Nothing is written, and memory does not grow with the number of runs. An iterator
    that is closed, or left by ``break`` and no longer used, stops what is under way.
    """
    plan = _plan(text, experiment, vary, design, runs, seed, set, solver, step, tol, duration, "rows")
    return _streamed(plan, on, unit, threads, retries)


def _streamed(plan: bytes, on: Any, unit: float, threads: int | None, retries: int) -> Iterator[tuple[int, Table]]:
    engine = _engine(on, threads)
    sent: dict[Any, tuple[int, int, int]] = {}
    rows = _Rows(plan)
    try:
        client = _Client(plan, None, rows, engine, _seconds(unit, engine), retries, sent)
        for _ in client.steps():
            yield from rows.come()
        yield from rows.come()
        client.end()
    finally:
        engine.close(sent)


class _Rows:
    """Rows that are handed on and not kept."""

    def __init__(self, plan: bytes):
        self.total, self.columns = _fric.sweep_about(plan)
        self.items, self.next = self.total, 0
        self._come: list[tuple[int, Table]] = []

    def runs(self, items: int) -> int:
        return items

    def take(self, unit: bytes) -> None:
        # Between the first line and the last, which name the plan and the hash.
        lines = unit.decode("utf-8").splitlines()[1:-1]
        first = int(lines[0].split(",", 1)[0])
        assert first <= self.next
        cells = list(csv.reader(lines[self.next - first :]))
        columns = list(zip(*cells)) or [()] * len(self.columns)
        table = Table(None, self.columns, len(cells), "")
        table._values = {title: _column(kind, column) for (title, kind), column in zip(self.columns, columns)}
        self._come.append((self.next, table))
        self.next += len(cells)

    def come(self) -> list[tuple[int, Table]]:
        come, self._come = self._come, []
        return come


def _check_name(out: Path, keep: str) -> None:
    if keep == "summary" and out.suffix != ".json":
        raise ValueError(f"out: {out}: the name of statistics ends in .json")
    if keep != "summary" and out.suffix not in ("", ".csv", ".parquet"):
        raise ValueError(f"out: {out}: the name of a table ends in .csv or .parquet, that of a dataset has no ending")


def _varied(vary: Mapping[str, Any] | Iterable[str], known: Mapping[str, tuple[str, bool]]) -> list[str]:
    if isinstance(vary, str):
        return [vary]
    if not isinstance(vary, Mapping):
        return list(vary)
    texts = []
    for path, values in vary.items():
        si = known.get(path.split(",")[0].strip(), ("", False))[0]
        if isinstance(values, Draw):
            texts.append(f"{path} {values._text(path, si)}")
        elif isinstance(values, str):
            texts.append(f"{path} {values}" if values.lstrip().startswith("~") else f"{path} = {values}")
        else:
            # Also a quantity of pint with an array, whose items are quantities.
            texts.append(f"{path} = " + ", ".join(_values.written(path, value, si) for value in values))
    return texts


def _work(plan: bytes, first: int, last: int) -> tuple[bytes, float]:
    """A unit, and the seconds that it took. Sent to workers."""
    return _worked(_fric.sweep_unit, plan, first, last)


def _worked(work: Any, *arguments: Any) -> tuple[bytes, float]:
    begin = time.perf_counter()
    try:
        made = work(*arguments)
    except VersionMismatch as error:
        host, planned, installed = socket.gethostname(), error.planned, error.installed
        remedy = f"pip install fric=={planned}" if planned != installed else "install the same build of fric"
        raise VersionMismatch(
            f"{host} has fric {installed}, and the sweep was planned by fric {planned}: on {host}, {remedy}",
            planned,
            installed,
            host,
        ) from None
    return made, time.perf_counter() - begin


def _work_shared(folder: str, plan: bytes, first: int, last: int) -> tuple[bytes, float]:
    """A file of a dataset in a folder that the client sees too: its hash, and the seconds that it took. Sent to workers."""
    return _worked(lambda: _fric.sweep_file(plan, folder, first).encode())


class _Engine:
    """Anything with ``submit(function, *arguments)`` that returns futures with ``result`` and ``done``."""

    def __init__(self, executor: Any, slots: int | None = None):
        self._executor, self._slots = executor, slots
        #: What workers do.
        self.work: Any = _work
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._polled: list[Any] = []

    def slots(self) -> int:
        """How many units run at once."""
        return self._slots or getattr(self._executor, "_max_workers", None) or os.cpu_count() or 1

    def _submit(self, plan: bytes, first: int, last: int) -> Any:
        return self._executor.submit(self.work, plan, first, last)

    def send(self, plan: bytes, first: int, last: int) -> Any:
        future = self._submit(plan, first, last)
        if hasattr(future, "add_done_callback"):
            future.add_done_callback(self._done.put)
        else:
            self._polled.append(future)
        return future

    def wait(self, seconds: float) -> list[Any]:
        """Futures that have ended; waits for one."""
        if self._polled:
            end = time.monotonic() + seconds
            while time.monotonic() < end:
                ended = [future for future in self._polled if future.done()]
                if ended:
                    self._polled = [future for future in self._polled if future not in ended]
                    return ended
                time.sleep(0.01)
            return []
        try:
            return [self._done.get(timeout=seconds)]
        except queue.Empty:
            return []

    def result(self, future: Any) -> Any:
        """What a future that has ended returns, or raises."""
        return future.result()

    def lost(self) -> str | None:
        """Why nothing more will come of what was sent; else none."""
        return None

    def close(self, sent: Iterable[Any]) -> None:
        for future in sent:
            if hasattr(future, "cancel"):
                future.cancel()


class _Threads(_Engine):
    def __init__(self, threads: int | None):
        count = threads or os.cpu_count() or 1
        super().__init__(futures.ThreadPoolExecutor(count, thread_name_prefix="fric"), count)

    def close(self, sent: Iterable[Any]) -> None:
        self._executor.shutdown(wait=False, cancel_futures=True)


class _Dask(_Engine):
    def __init__(self, client: Any, own: bool):
        super().__init__(client)
        self._client, self._own, self._count, self._asked = client, own, 0, 0.0
        self._sent = 0

    def slots(self) -> int:
        # A cluster may grow and shrink; an adaptive one begins with no worker.
        if time.monotonic() - self._asked > 1.0:
            self._count, self._asked = sum(self._client.nthreads().values()), time.monotonic()
        return max(1, self._count)

    def _submit(self, plan: bytes, first: int, last: int) -> Any:
        self._sent += 1
        key = f"fric-{hashlib.sha256(plan).hexdigest()[:8]}-{first}-{last}-{self._sent}"
        # `pure`: equal arguments would be taken for an equal task, and an old result be handed out.
        return self._client.submit(self.work, plan, first, last, key=key, pure=False, retries=0)

    def lost(self) -> str | None:
        status = getattr(self._client, "status", "running")
        return None if status in ("running", "connecting", "newly-created") else f"the client of Dask is {status}"

    def close(self, sent: Iterable[Any]) -> None:
        if self.lost() is None:
            self._client.cancel(list(sent), force=True)
        if self._own:
            self._client.close()


class _Ray(_Engine):
    """Tasks of Ray, which it does not repeat by itself."""

    def __init__(self, ray: Any, own: bool):
        super().__init__(ray)
        self._ray, self._own = ray, own
        self._task = ray.remote(max_retries=0, num_cpus=1)(_called)

    def slots(self) -> int:
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def _submit(self, plan: bytes, first: int, last: int) -> Any:
        task = self._task.remote(self.work, plan, first, last)
        future = task.future()
        future.task = task
        return future

    def result(self, future: Any) -> Any:
        try:
            return future.result()
        except self._ray.exceptions.RayTaskError as error:
            # It wraps the exception of the unit, whose message and fields count.
            raise error.cause from None

    def close(self, sent: Iterable[Any]) -> None:
        for future in sent:
            self._ray.cancel(future.task, force=True)
        if self._own:
            self._ray.shutdown()


def _called(work: Any, plan: bytes, first: int, last: int) -> Any:
    return work(plan, first, last)


def _engine(on: Any, threads: int | None) -> _Engine:
    if on is None:
        return _Threads(threads)
    if threads is not None:
        raise ValueError("threads: a unit runs on one thread of the engine; its own settings say how many there are")
    if isinstance(on, str):
        scheme, _, address = on.partition("://")
        if scheme not in ("dask", "ray") or not address:
            raise ValueError(
                f"on: {on!r} is no engine; write \"dask://host:8786\" or \"ray://host:10001\", or pass a client or an executor"
            )
        try:
            if scheme == "ray":
                import ray  # type: ignore

                ray.init(on)
                return _Ray(ray, own=True)
            from distributed import Client
        except ImportError:
            raise ImportError(f"on: {scheme.title()} is not installed here: pip install 'fric[{scheme}]'") from None
        return _Dask(Client(f"tcp://{address}"), own=True)
    if hasattr(on, "get_client") and hasattr(on, "scheduler_address"):
        return _Dask(on.get_client(), own=True)
    if hasattr(on, "nthreads") and hasattr(on, "scatter"):
        return _Dask(on, own=False)
    if hasattr(on, "submit"):
        return _Engine(on)
    if hasattr(on, "remote") and hasattr(on, "cluster_resources"):
        return _Ray(on, own=False)
    raise TypeError(
        f"on: {type(on).__name__} has no `submit`; pass a client or cluster of Dask, the module `ray`, or an executor"
    )


def _is_death(error: BaseException) -> bool:
    """Whether a worker ended under a unit, so that another may finish it."""
    of_dask = {"KilledWorker", "CancelledError", "FutureCancelledError", "CommClosedError"}
    of_ray = {"WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"}
    names = {kind.__name__ for kind in type(error).__mro__}
    return bool(names & (of_dask | of_ray | {"UncompletedJobError"}))


def _run(
    plan: bytes,
    out: Path,
    keep: str,
    on: Any,
    unit: float,
    threads: int | None,
    resume: bool,
    progress: bool | Progress | None,
    retries: int,
    most: int | None = None,
    shared: bool = False,
) -> Table | Statistics:
    engine = _engine(on, threads)
    sent: dict[Any, tuple[int, int, int]] = {}
    rows = None
    try:
        rows = _fric.SweepRows(plan, out, resume)
        if most is not None and rows.total > most:
            raise ValueError(f"{rows.total} rows are too many for memory, {most} are possible: name a file with out=")
        for warning in rows.warnings:
            import warnings

            warnings.warn(warning, stacklevel=3)
        client = _Client(plan, out, rows, engine, _seconds(unit, engine), retries, sent)
        if shared:
            engine.work = functools.partial(_work_shared, str(out.resolve()))
            client.share()
        client.run(_reporter(progress))
        words = rows.finish()
        if keep == "summary":
            return Statistics(out, words)
        table = Table(out, rows.columns, rows.total, words)
        if keep == "both":
            table.statistics = Statistics(out.with_suffix(".json"))
        return table
    finally:
        engine.close(sent)
        if rows is not None:
            rows.leave()


def _seconds(unit: float, engine: _Engine) -> float:
    """Seconds of a unit."""
    if not 0 < unit < float("inf"):
        raise ValueError("unit: a positive number of seconds is needed")
    # Here nothing is lost on the way: short units let Ctrl-C end the threads soon.
    return min(unit, 0.5) if isinstance(engine, _Threads) else unit


class _Client:
    """Sends units, takes their rows in the order of the runs, and sends again what was lost."""

    def __init__(
        self,
        plan: bytes,
        out: Path | None,
        rows: Any,
        engine: _Engine,
        unit: float,
        retries: int,
        sent: dict[Any, tuple[int, int, int]],
    ):
        self.plan, self.out, self.rows, self.engine, self.retries, self.sent = plan, out, rows, engine, retries, sent
        self.seconds = min(unit, LONGEST)
        #: Runs of a block, of which only statistics are kept; else 1.
        block = max(1, rows.total // max(1, rows.items))
        self.fewest = max(1, FEWEST // block)
        self.what = "row" if rows.items == rows.total else "block"
        #: Runs of each unit, if they are files of a dataset; and where units go that come next.
        self.each = 0
        self.put: Any = rows.take
        #: Units that came before an earlier one, and their bytes.
        self.waiting: dict[int, tuple[int, bytes]] = {}
        #: Units to send again: first, last, deaths.
        self.again: list[tuple[int, int, int]] = []
        #: Runs that end each worker.
        self.poison: list[int] = []
        #: Seconds a run of the last units.
        self.costs: deque[float] = deque(maxlen=15)
        self.deaths = 0
        self.begin = rows.next
        self.unsent = rows.next

    def share(self) -> None:
        """Lets workers write the files of a dataset: a unit is a file."""
        self.each = self.rows.rows_a_file
        self.put = lambda hash: self.rows.adopt(hash.decode())

    def size(self, slots: int) -> int:
        """Runs of the next unit."""
        if self.each:
            return self.each
        if not self.costs:
            return self.fewest
        size = self.seconds / max(statistics.median(self.costs), 1e-9)
        # The last units are smaller, so that all workers end at about the same time.
        left = (self.rows.items - self.unsent) / (2 * slots)
        return max(self.fewest, int(min(size, left)))

    def send(self) -> None:
        """Sends what may be out: two units for each slot."""
        if any(deaths > 1 for _, _, deaths in self.sent.values()):
            return
        slots = self.asked(self.engine.slots)
        while len(self.sent) < 2 * slots:
            if self.again:
                # Dask blames all units that were queued on a dead worker: one that was there twice is sent alone.
                alone = self.again[0][2] > 1
                if alone and self.sent:
                    return
                first, last, deaths = heapq.heappop(self.again)
                if alone:
                    self.sent[self.asked(self.engine.send, self.plan, first, last)] = first, last, deaths
                    return
            elif self.unsent < self.rows.items and sum(len(one) for _, one in self.waiting.values()) < MOST_WAITING:
                # Without a known cost a few runs for each slot are enough.
                if not self.costs and len(self.sent) >= slots:
                    return
                first, deaths = self.unsent, 0
                last = self.unsent = min(self.rows.items, first + self.size(slots))
            else:
                return
            self.sent[self.asked(self.engine.send, self.plan, first, last)] = first, last, deaths

    def asked(self, call: Any, *arguments: Any) -> Any:
        """What a call of the engine returns. A broken pool or a cluster out of reach may raise here before any unit does."""
        try:
            return call(*arguments)
        except Exception as error:
            why = str(error) or type(error).__name__
            raise self.kept(f"the engine takes no more units: {why}") from error

    def kept(self, why: str) -> SweepError:
        """The error that ends a sweep, which can be resumed."""
        next = self.rows.next
        if self.out is None:
            return SweepError(why, [(next, self.rows.total)])
        return SweepError(
            f"{why}; the {self.what}s before {self.what} {next} are kept: resume=True goes on with them",
            [(self.rows.runs(next), self.rows.total)],
        )

    def died(self, first: int, last: int, deaths: int) -> None:
        self.deaths += 1
        if self.deaths > MOST_DEATHS:
            raise self.kept(f"{MOST_DEATHS} workers died one after the other, and no row came between")
        # A file of a dataset is not halved.
        if self.each and deaths + 1 >= max(3, self.retries) + 2:
            self.poison.append(first)
            return
        # A run is named only after it has died alone several times: its neighbour may have gone down with it.
        if deaths + 1 < max(3, self.retries) + (2 if last - first == 1 else 0):
            heapq.heappush(self.again, (first, last, deaths + 1))
        elif last - first > 1:
            # One of its runs may be the cause.
            middle = (first + last) // 2
            heapq.heappush(self.again, (first, middle, deaths))
            heapq.heappush(self.again, (middle, last, deaths))
        else:
            self.poison.append(first)

    def take(self, future: Any) -> None:
        first, last, deaths = self.sent.pop(future)
        try:
            unit, seconds = self.engine.result(future)
        except Exception as error:
            if _is_death(error) and self.engine.lost() is None:
                self.died(first, last, deaths)
                return
            why = str(error) or type(error).__name__
            if isinstance(error, VersionMismatch):
                kept = self.kept(str(error))
                raise VersionMismatch(str(kept), error.planned, error.installed, error.host, kept.missing) from error
            raise self.kept(f"{self.what}s {first} to {last - 1}: {why}") from error
        self.costs.append(seconds / max(1, last - first))
        self.deaths = 0
        self.waiting[first] = last, unit
        while self.rows.next in self.waiting:
            try:
                self.put(self.waiting.pop(self.rows.next)[1])
            except ValueError as error:
                raise self.kept(str(error)) from error
        if self.poison:
            self.spill()

    def spill(self) -> None:
        """Writes units that no row can precede as files for ``fric sweep --join``."""
        if self.out is None or self.each:
            return
        folder = self.out.with_name(f"{self.out.name}.units")
        folder.mkdir(exist_ok=True)
        (folder / "sweep.fricjob").write_bytes(self.plan)
        for first, (last, unit) in self.waiting.items():
            if unit:
                part = folder / f".{first}"
                part.write_bytes(unit)
                part.rename(folder / f"{first}-{last}.fricunit")
                self.waiting[first] = last, b""

    def run(self, report: Progress | None) -> None:
        for _ in self.steps():
            if report:
                report(self.rows.runs(self.rows.next), self.rows.total)
        self.end()

    def steps(self) -> Iterator[None]:
        """Works until no more units can come, and pauses after some have."""
        while self.rows.next < self.rows.items:
            self.send()
            if not self.sent:
                break
            for future in self.asked(self.engine.wait, 0.5):
                self.take(future)
            lost = self.engine.lost()
            if lost:
                raise self.kept(lost)
            yield

    def end(self) -> None:
        """Names the runs that end their workers."""
        if not self.poison:
            return
        self.poison.sort()
        self.spill()
        some = ", ".join(map(str, self.poison[:5])) + (" …" if len(self.poison) > 5 else "")
        missing = [(self.rows.runs(one), self.rows.runs(one + 1)) for one in self.poison]
        if self.each:
            missing = [(first, min(first + self.each, self.rows.total)) for first in self.poison]
            raise SweepError(
                f"one of the {self.each} runs from {some} on ends the worker that makes it; all other files of {self.out} are there: "
                f"the same sweep without shared= finds the run",
                missing,
            )
        if self.out is None:
            raise SweepError(f"run {some} ends the worker that makes it, also alone", missing)
        folder = self.out.with_name(f"{self.out.name}.units")
        raise SweepError(
            f"{'run' if self.what == 'row' else 'block'} {some} ends the worker that makes it, also alone; the {self.what}s before "
            f"{self.what} {self.rows.next} are kept for resume=True, all later ones are in {folder}, for `fric sweep --join "
            f"{folder / 'sweep.fricjob'}`",
            missing,
        )
