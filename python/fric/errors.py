"""The exceptions of fric."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

__all__ = [
    "CompileError",
    "Diagnostic",
    "FitError",
    "InternalError",
    "RangeError",
    "RunError",
    "SweepError",
    "UnitError",
    "UnknownName",
    "VersionMismatch",
]


@dataclass(frozen=True)
class Diagnostic:
    """What the compiler says about one place of a text."""

    code: str
    severity: str
    message: str
    help: str | None = None
    labels: tuple[dict[str, Any], ...] = field(default=())

    @property
    def line(self) -> int | None:
        """Line of the first label, from 1."""
        return self.labels[0]["line"] if self.labels else None

    @property
    def column(self) -> int | None:
        """Column of the first label, from 1, in characters."""
        return self.labels[0]["column"] if self.labels else None


def diagnostics(text: str) -> list[Diagnostic]:
    """The diagnostics in the JSON of ``fric check``."""
    return [
        Diagnostic(one["code"], one["severity"], one["message"], one["help"], tuple(one["labels"]))
        for one in json.loads(text)
    ]


class _Reported(Exception):
    """An error with the compiler's report."""

    def __init__(self, report: str, found: list[Diagnostic] | None = None):
        super().__init__(report)
        self.report = report
        self.diagnostics = found or []

    def __str__(self) -> str:
        return self.report

    def __reduce__(self) -> Any:
        return type(self), (self.report, self.diagnostics)

    def _repr_html_(self) -> str:
        from fric._html import escaped

        return f"<pre>{escaped(self.report)}</pre>"


class CompileError(_Reported, ValueError):
    """What ``fric check`` calls an error. ``str()`` is its report with the marked lines of the text."""


class UnitError(_Reported, TypeError):
    """The unit of a value does not fit."""


class RangeError(_Reported, ValueError):
    """A value outside its range, or a ``require`` that it violates. Nothing has changed."""


class FitError(_Reported, RuntimeError):
    """A fit without an answer: no start can be run, an unknown changes nothing, or there are too few rows."""


class UnknownName(_Reported, KeyError):
    """There is no quantity, model or experiment of this name; the message has the nearest one."""


def unknown(what: str, name: str, known: list[str]) -> UnknownName:
    """The error that nothing has this name."""
    from fric._fric import nearest

    near = nearest(name, known)
    if near:
        help = f"did you mean `{near}`?"
    elif known:
        more = f" and {len(known) - 8} more" if len(known) > 8 else ""
        help = f"there are {', '.join(known[:8])}{more}"
    else:
        help = "there are none"
    return UnknownName(f"no {what} `{name}`; {help}")


class RunError(RuntimeError):
    """A run or a step that stopped: a quantity left its range, or is not finite."""

    #: What was recorded up to there; none for a step.
    run: Any = None
    #: The rows that were computed up to there, by ``follow``.
    rows: Any = None

    def __init__(self, cause: str, time: float):
        super().__init__(cause)
        self.cause = cause
        self.time = time

    def __reduce__(self) -> Any:
        return type(self), (self.cause, self.time)


class SweepError(RuntimeError):
    """A sweep that is not complete: ``missing`` are the ranges of runs without a row, (first, last + 1)."""

    def __init__(self, message: str, missing: list[tuple[int, int]]):
        super().__init__(message)
        self.missing = missing

    def __reduce__(self) -> Any:
        return type(self), (str(self), self.missing)


class VersionMismatch(SweepError):
    """A worker has another version of fric than the plan of a sweep: ``host``, ``planned`` and ``installed``."""

    def __init__(
        self,
        message: str,
        planned: str = "",
        installed: str = "",
        host: str = "",
        missing: list[tuple[int, int]] | None = None,
    ):
        super().__init__(message, missing or [])
        self.planned, self.installed, self.host = planned, installed, host

    def __reduce__(self) -> Any:
        return type(self), (str(self), self.planned, self.installed, self.host, self.missing)


class InternalError(RuntimeError):
    """A mistake of fric itself."""

    def __init__(self, message: str):
        from fric._fric import __version__

        super().__init__(f"fric {__version__} made a mistake: {message}. Please report this with the text and the call.")


# Codes whose errors concern a value that was given.
_UNITS = {"E0101", "E0102", "E0103", "E0104", "E0106", "E0108", "E0110"}
_NAMES = {"E0201", "E0204", "E0205", "E0208"}
_RANGES = {"E0501", "E0502"}
# Codes of searches without an answer.
_UNFITTED = {"E0906", "E0907", "E0910"}


def of_problems(report: str, text: str, codes: list[str]) -> Exception:
    """The exception of the first error. In a value that was given it has a class of its own."""
    found = diagnostics(text)
    first = next((one for one in found if one.severity == "error"), None)
    given = first is not None and any(label["file"] == "--set" for label in first.labels)
    code = codes[0] if codes else ""
    kind: type[_Reported] = CompileError
    if given and code in _UNITS:
        kind = UnitError
    elif given and code in _NAMES:
        kind = UnknownName
    elif code in _RANGES:
        kind = RangeError
    elif code in _UNFITTED:
        kind = FitError
    return kind(report, found)
