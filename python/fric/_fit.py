"""Parameters from recordings: fits of a text, their answers, and residuals for other optimisers."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fric import _fric, _html, _tables, _values
from fric.errors import CompileError, Diagnostic, diagnostics, unknown

if TYPE_CHECKING:
    from fric._model import Text


class _Asked(NamedTuple):
    """What of the text is changed, as the extension module reads it."""

    set: list[str]
    data: list[str]
    tables: list[tuple[str, str]]
    solver: str | None
    step: float | None
    tol: float | None
    threads: int | None


class _Wished(NamedTuple):
    """What is wished beside the values."""

    starts: int | None
    seed: int
    level: float
    robust: bool
    profile: list[str]
    pieces: int


def _asked(
    text: Text,
    name: str,
    data: Any,
    set: Mapping[str, Any] | None,
    solver: str | None,
    step: str | float | None,
    tol: float | None,
    threads: int | None,
) -> _Asked:
    paths, tables = [], []
    several = data if isinstance(data, (list, tuple)) else [] if data is None else [data]
    for k, one in enumerate(several):
        table = _tables.of(one)
        if table is None:
            paths.append(os.path.abspath(os.fspath(one)))
        else:
            own = f"{name}_data.csv" if len(several) == 1 else f"{name}_data_{k + 1}.csv"
            paths.append(own)
            tables.append((own, table))
    if data is not None and not paths:
        raise ValueError("data: no recording was given")
    given = dict(set or {})
    known = None
    if any(not isinstance(value, str) for value in given.values()):
        # A recording that is not on disk leaves the units of its fit unknown: then numbers are texts, `"2 N"`.
        with contextlib.suppress(CompileError):
            known = {path: (si, False) for path, si in text._inner.units(name)}
    values = _values.settings(given, known)
    return _Asked(
        [f"{path}={value}" for path, value in values.items()],
        paths,
        tables,
        solver,
        None if step is None else _values.seconds("step", step),
        tol,
        _whole("threads", threads, 1, 1024),
    )


def _wished(
    starts: int | None, seed: int, level: float, robust: bool, profile: str | Sequence[str] | None, pieces: int
) -> _Wished:
    if not 0.5 <= level <= 0.9999:
        raise ValueError(f"level: a probability from 0.5 to 0.9999 is needed, not {level!r}")
    names = [profile] if isinstance(profile, str) else list(profile or [])
    pieces = _whole("pieces", pieces, 1, 100) or 1
    return _Wished(_whole("starts", starts, 1, 100_000), _whole("seed", seed, 0, 2**64 - 1) or 0, float(level), robust, names, pieces)


def _whole(name: str, value: int | None, least: int, most: int) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not hasattr(value, "__index__"):
        raise TypeError(f"{name}: a whole number is needed, not {value!r}")
    number = int(value)
    if not least <= number <= most:
        raise ValueError(f"{name}: a number from {least} to {most} is needed, not {number}")
    return number


def _found(text: Text, names: Sequence[str], asked: _Asked, wished: _Wished) -> list[Fit]:
    found, problems = _fric.fit(text._inner, list(names), asked, wished)
    for report in problems:
        import warnings

        warnings.warn(f"a law has no answer:\n{report}", stacklevel=4)
    return [Fit(one) for one in found]


class _Compared:
    """What fits and residuals have in common: their unknowns and what is compared."""

    _inner: _fric.Fit | _fric.Found

    @property
    def names(self) -> list[str]:
        """The unknowns: ``Fc``, ``initial(z)``; those of one recording with its name."""
        return [label for label, *_ in self._inner.unknowns]

    @property
    def units(self) -> dict[str, str]:
        """The SI unit of each unknown."""
        return {label: si for label, _, si, *_ in self._inner.unknowns}

    @property
    def times(self) -> dict[str, np.ndarray]:
        """For each compared difference the times of its rows in s, as in the recording; of steady points their numbers."""
        return {label: times for label, _, times in self._inner.compared}


class Fit(_Compared):
    """The answer of a fit: values with intervals. All numbers are in SI. ``str()`` is the table of ``fric fit``."""

    def __init__(self, inner: _fric.Found):
        self._inner: _fric.Found = inner
        self._json = json.loads(inner.json)

    @property
    def name(self) -> str:
        """The name of the fit."""
        return self._json["fit"]

    @property
    def law(self) -> str:
        """The model, and which of several laws it is."""
        return self._json["alternative"] or self._json["model"]

    @property
    def values(self) -> dict[str, float]:
        """The value of each unknown."""
        return dict(zip(self.names, self._inner.values))

    @property
    def sd(self) -> dict[str, float]:
        """The standard deviation of each value; infinite, or wider than its range, where the data do not determine it."""
        return dict(zip(self.names, (sd for sd, _ in self._inner.spreads)))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The interval of each value, with the probability ``level``."""
        return dict(zip(self.names, (ends for _, ends in self._inner.spreads)))

    @property
    def cov(self) -> np.ndarray:
        """The covariance of the values, (unknowns, unknowns), in their order."""
        sd = np.array(list(self.sd.values()))
        return self._inner.correlation * np.outer(sd, sd)

    @property
    def correlation(self) -> np.ndarray:
        """The correlations of the values, (unknowns, unknowns)."""
        return self._inner.correlation

    @property
    def residuals(self) -> dict[str, np.ndarray]:
        """Computed minus recorded for each compared difference, a read-only array: ``{"F - data.F": …}``."""
        return dict(zip((label for label, *_ in self._inner.compared), self._inner.residuals))

    @property
    def set(self) -> dict[str, float]:
        """The values that all recordings share, by the paths of the model: for ``fric.model`` and ``text.run(set=…)``."""
        paths = (path for _, path, *_ in self._inner.unknowns)
        return {path: value for path, value in zip(paths, self._inner.values) if path is not None}

    @property
    def converged(self) -> bool:
        """Whether the search ended in a minimum."""
        return self._inner.converged

    @property
    def passed(self) -> bool:
        """Whether every ``expect`` of the fit holds."""
        return self._inner.passed

    @property
    def rank(self) -> int | None:
        """The place among several laws, from 1; laws that do not differ share one."""
        return self._inner.rank

    @property
    def warnings(self) -> list[Diagnostic]:
        """What the data do not determine, what drifts, what a law lacks: the warnings of ``fric fit``."""
        return diagnostics(self._inner.warnings)

    @property
    def notes(self) -> list[str]:
        """Notes of the fit."""
        return self._json["notes"]

    @property
    def json(self) -> dict[str, Any]:
        """The object that ``fric fit --json`` prints."""
        return json.loads(self._inner.json)

    def save(self, folder: str | os.PathLike[str] = "out", *, page: bool = False) -> list[Path]:
        """Writes the files of ``fric fit``: a text to go on with, JSON, CSV, pictures, and with ``page`` the report.

        A recording that was in memory is written beside them. Returns the paths.
        """
        return [Path(path) for path in self._inner.save(os.fspath(folder), page)]

    def svg(self, width: float = 860) -> str:
        """What the fit plots, as SVG; empty if it plots nothing."""
        return "".join(self._inner.svg(width, _html.identifier()))

    def _repr_html_(self) -> str:
        rows = []
        for one in self._json["parameters"]:
            low, high = one["interval"]
            cells = (f"{x:.6g}" if isinstance(x, float | int) else str(x) for x in (one["value"], one["sd"], low, high))
            rows.append((_label(one), *cells, one["unit"]))
        table = _html.table(("", "value", "± sd", "from", "to", ""), rows)
        warnings = "".join(f"<p>{_html.escaped(one.code)}: {_html.escaped(one.message)}</p>" for one in self.warnings)
        return self.svg() + table + warnings

    def __str__(self) -> str:
        return f"{self.name}\n{self._inner.words}"

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.6g} {self.units[name]}".rstrip() for name, value in self.values.items())
        return f"<fric.Fit {self.name} of {self.law}: {values}>"


def _label(one: dict[str, Any]) -> str:
    label = f"initial({one['path']})" if one["initial"] else one["path"]
    return f"{label} of {one['recording']}" if one["recording"] else label


class Residuals(_Compared):
    """Computed minus recorded as a function of the unknowns, for optimisers and samplers of one's own.

    ``r(values)`` is an array of all differences in SI; ``values`` has a number for each of ``names``, or is a mapping of
    some, the others as in ``start``. ``scipy.optimize.least_squares(r, r.start, bounds=r.bounds, x_scale=r.scale)``.
    """

    def __init__(self, inner: _fric.Fit):
        self._inner: _fric.Fit = inner

    @property
    def start(self) -> np.ndarray:
        """Where the text starts."""
        return np.array([start for *_, start, _ in self._inner.unknowns])

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The lower and the upper ends of the ranges."""
        low, high = np.array([ends for *_, ends in self._inner.unknowns]).reshape(-1, 2).T
        return low, high

    @property
    def scale(self) -> np.ndarray:
        """A size of each unknown: its start, or the width of its range where that is 0."""
        low, high = self.bounds
        return np.where(self.start != 0, abs(self.start), high - low)

    def split(self, values: Sequence[float] | np.ndarray | Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The same, an array for each compared difference."""
        labels = [label for label, *_ in self._inner.compared]
        return dict(zip(labels, self._inner.residuals(self._numbers(values))))

    def __call__(self, values: Sequence[float] | np.ndarray | Mapping[str, Any]) -> np.ndarray:
        return np.concatenate(self._inner.residuals(self._numbers(values)))

    def _numbers(self, values: Sequence[float] | np.ndarray | Mapping[str, Any]) -> list[float]:
        if isinstance(values, Mapping):
            for name in values:
                if name not in self.names:
                    raise unknown("unknown of the fit", name, self.names)
            units = self.units
            return [
                _values.number(name, values[name], units[name]) if name in values else start
                for name, start in zip(self.names, self.start.tolist())
            ]
        return np.asarray(values, dtype=float).ravel().tolist()

    def __repr__(self) -> str:
        return f"<fric.Residuals of {', '.join(self.names)}>"
