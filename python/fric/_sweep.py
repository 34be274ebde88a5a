"""Sweeps: on the threads of this machine, or on an engine of many; the bytes are those of ``fric sweep``."""

from __future__ import annotations

import csv
import hashlib
import heapq
import os
import queue
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Mapping
from concurrent import futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fric import _fric, _values
from fric._model import Progress, Text, _reporter, load
from fric.errors import SweepError, unknown

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
    runs: int | None = None,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,
    solver: str | None = None,
    step: str | float | None = None,
    tol: float | None = None,
    duration: str | float | None = None,
    out: str | os.PathLike[str] | None = None,
    on: Any = None,
    unit: float = 5.0,
    threads: int | None = None,
    resume: bool = False,
    progress: bool | Progress | None = None,
    retries: int = 3,
) -> Table:
    """Runs an experiment many times, with the rows and bytes of ``fric sweep``.

    ``vary``: what changes, as texts of ``--vary``, or by path: a text (``"1 N .. 2 N by 0.1 N"``), an array in SI, or a
    distribution (:func:`normal`, :func:`lognormal`, :func:`uniform`), drawn ``runs`` times. ``out``: a name that ends in
    ``.csv`` or ``.parquet``, or a folder for a dataset of Parquet files; else the table is in memory. ``on``: where it is
    run: a client or cluster of Dask, its address ``"dask://host:8786"``, or any executor with ``submit``; else
    ``threads`` threads here. ``unit``: about how many seconds of work are sent at once. ``resume``: goes on with a table
    that was interrupted, here or elsewhere. A unit whose worker dies is sent again, up to ``retries`` times.
    """
    loaded = text if isinstance(text, Text) else load(text)
    if experiment is None:
        if len(loaded.experiments) != 1:
            raise unknown("experiment", "", loaded.experiments)
        experiment = loaded.experiments[0]
    elif experiment not in loaded.experiments:
        raise unknown("experiment", experiment, loaded.experiments)
    known = {path: (si, False) for path, si in loaded._inner.units(experiment)}
    plan = _fric.sweep_plan(
        loaded._inner,
        experiment,
        _varied(vary, known),
        [f"{path}={value}" for path, value in _values.settings(dict(set or {}), known).items()],
        solver,
        None if step is None else _values.seconds("step", step),
        tol,
        None if duration is None else _values.seconds("duration", duration),
        runs,
        seed,
    )
    if out is not None:
        return _run(plan, Path(out), on, unit, threads, resume, progress, retries)
    if resume:
        raise ValueError("resume: a table in memory is gone when a call ends; name a file with out=")
    with tempfile.TemporaryDirectory(prefix="fric-") as folder:
        table = _run(plan, Path(folder) / "table.csv", on, unit, threads, False, progress, retries, MOST_ROWS)
        table._values = table._read(table.path)
        table.path = None
    return table


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
    begin = time.perf_counter()
    rows = _fric.sweep_unit(plan, first, last)
    return rows, time.perf_counter() - begin


class _Engine:
    """Anything with ``submit(function, *arguments)`` that returns futures with ``result`` and ``done``."""

    def __init__(self, executor: Any, slots: int | None = None):
        self._executor, self._slots = executor, slots
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._polled: list[Any] = []

    def slots(self) -> int:
        """How many units run at once."""
        return self._slots or getattr(self._executor, "_max_workers", None) or os.cpu_count() or 1

    def _submit(self, plan: bytes, first: int, last: int) -> Any:
        return self._executor.submit(_work, plan, first, last)

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
        return self._client.submit(_work, plan, first, last, key=key, pure=False, retries=0)

    def lost(self) -> str | None:
        status = getattr(self._client, "status", "running")
        return None if status in ("running", "connecting", "newly-created") else f"the client of Dask is {status}"

    def close(self, sent: Iterable[Any]) -> None:
        if self.lost() is None:
            self._client.cancel(list(sent), force=True)
        if self._own:
            self._client.close()


def _engine(on: Any, threads: int | None) -> _Engine:
    if on is None:
        return _Threads(threads)
    if threads is not None:
        raise ValueError("threads: a unit runs on one thread of the engine; its own settings say how many there are")
    if isinstance(on, str):
        scheme, _, address = on.partition("://")
        if scheme != "dask" or not address:
            raise ValueError(f"on: {on!r} is no engine; write \"dask://host:8786\", or pass a client or an executor")
        try:
            from distributed import Client
        except ImportError:
            raise ImportError("on: Dask is not installed here: pip install 'fric[dask]'") from None
        return _Dask(Client(f"tcp://{address}"), own=True)
    if hasattr(on, "get_client") and hasattr(on, "scheduler_address"):
        return _Dask(on.get_client(), own=True)
    if hasattr(on, "nthreads") and hasattr(on, "scatter"):
        return _Dask(on, own=False)
    if hasattr(on, "submit"):
        return _Engine(on)
    raise TypeError(f"on: {type(on).__name__} has no `submit`; pass a client or cluster of Dask, or an executor")


def _is_death(error: BaseException) -> bool:
    """Whether a worker ended under a unit, so that another may finish it."""
    names = {kind.__name__ for kind in type(error).__mro__}
    return bool(names & {"KilledWorker", "CancelledError", "FutureCancelledError", "WorkerCrashedError", "CommClosedError"})


def _run(
    plan: bytes,
    out: Path,
    on: Any,
    unit: float,
    threads: int | None,
    resume: bool,
    progress: bool | Progress | None,
    retries: int,
    most: int | None = None,
) -> Table:
    if not 0 < unit < float("inf"):
        raise ValueError("unit: a positive number of seconds is needed")
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
        # Here nothing is lost on the way: short units let Ctrl-C end the threads soon.
        unit = min(unit, 0.5) if isinstance(engine, _Threads) else unit
        _Client(plan, out, rows, engine, unit, retries, sent).run(_reporter(progress))
        return Table(out, rows.columns, rows.total, rows.finish())
    finally:
        engine.close(sent)
        if rows is not None:
            rows.leave()


class _Client:
    """Sends units, takes their rows in the order of the runs, and sends again what was lost."""

    def __init__(
        self,
        plan: bytes,
        out: Path,
        rows: Any,
        engine: _Engine,
        unit: float,
        retries: int,
        sent: dict[Any, tuple[int, int, int]],
    ):
        self.plan, self.out, self.rows, self.engine, self.retries, self.sent = plan, out, rows, engine, retries, sent
        self.seconds = min(unit, LONGEST)
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

    def size(self) -> int:
        """Runs of the next unit."""
        if not self.costs:
            return FEWEST
        size = self.seconds / max(statistics.median(self.costs), 1e-9)
        # The last units are smaller, so that all workers end at about the same time.
        left = (self.rows.total - self.unsent) / (2 * self.engine.slots())
        return max(FEWEST, int(min(size, left)))

    def send(self) -> None:
        """Sends what may be out: two units for each slot."""
        if any(deaths > 1 for _, _, deaths in self.sent.values()):
            return
        while len(self.sent) < 2 * self.engine.slots():
            if self.again:
                # Dask blames all units that were queued on a dead worker: one that was there twice is sent alone.
                alone = self.again[0][2] > 1
                if alone and self.sent:
                    return
                first, last, deaths = heapq.heappop(self.again)
                if alone:
                    self.sent[self.engine.send(self.plan, first, last)] = first, last, deaths
                    return
            elif self.unsent < self.rows.total and sum(len(one) for _, one in self.waiting.values()) < MOST_WAITING:
                # Without a known cost a few runs for each slot are enough.
                if not self.costs and len(self.sent) >= self.engine.slots():
                    return
                first, deaths = self.unsent, 0
                last = self.unsent = min(self.rows.total, first + self.size())
            else:
                return
            self.sent[self.engine.send(self.plan, first, last)] = first, last, deaths

    def died(self, first: int, last: int, deaths: int) -> None:
        self.deaths += 1
        if self.deaths > MOST_DEATHS:
            raise SweepError(
                f"{MOST_DEATHS} workers died one after the other, and no row came between; the rows before run "
                f"{self.rows.next} are kept: resume=True goes on with them",
                [(self.rows.next, self.rows.total)],
            )
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
            unit, seconds = future.result()
        except Exception as error:
            if _is_death(error) and self.engine.lost() is None:
                self.died(first, last, deaths)
                return
            why = str(error) or type(error).__name__
            raise SweepError(
                f"runs {first} to {last - 1}: {why}; the rows before run {self.rows.next} are kept: resume=True goes on with them",
                [(self.rows.next, self.rows.total)],
            ) from error
        self.costs.append(seconds / max(1, last - first))
        self.deaths = 0
        self.waiting[first] = last, unit
        while self.rows.next in self.waiting:
            self.rows.take(self.waiting.pop(self.rows.next)[1])
        if self.poison:
            self.spill()

    def spill(self) -> None:
        """Writes units that no row can precede as files for ``fric sweep --join``."""
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
        while self.rows.next < self.rows.total:
            self.send()
            if not self.sent:
                break
            for future in self.engine.wait(0.5):
                self.take(future)
            lost = self.engine.lost()
            if lost:
                raise SweepError(
                    f"{lost}; the rows before run {self.rows.next} are kept: resume=True goes on with them",
                    [(self.rows.next, self.rows.total)],
                )
            if report:
                report(self.rows.next, self.rows.total)
        if not self.poison:
            return
        self.poison.sort()
        self.spill()
        folder = self.out.with_name(f"{self.out.name}.units")
        some = ", ".join(map(str, self.poison[:5])) + (" …" if len(self.poison) > 5 else "")
        raise SweepError(
            f"run {some} ends the worker that makes it, also alone; the rows before run {self.rows.next} are in {self.out}, all "
            f"later ones in {folder}, for `fric sweep --join {folder / 'sweep.fricjob'}`",
            [(run, run + 1) for run in self.poison],
        )
