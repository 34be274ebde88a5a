"""Statistics of a sweep, as ``fric sweep --keep summary`` writes them."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from fric.errors import unknown


def _number(value: Any) -> float:
    # JSON has no infinity: it is written as a word, and what is not a number as null.
    return math.nan if value is None else float(value)


def _named(what: str, name: str, found: dict[str, Any]) -> Any:
    """An item by its title, or by what stands before the unit."""
    for title, value in found.items():
        if name in (title, title.rsplit(" [", 1)[0]):
            return value
    raise unknown(what, name, list(found))


class Measured:
    """What became of one measure in a group of runs, in the unit of its title."""

    def __init__(self, title: str, found: dict[str, Any], columns: list[str]):
        self.title, self._found, self._columns = title, found, columns
        #: Runs with a value, without one, with one that is not a number, and with an infinite one.
        self.number: int = found["number"]
        self.missing: int = found["missing"]
        self.not_a_number: int = found["not a number"]
        self.infinite: int = found["infinite"]
        #: Of the finite values.
        self.mean = _number(found["mean"])
        self.deviation = _number(found["deviation"])
        #: The least and the greatest value, each with the first of its runs; none without values.
        self.least: tuple[float, int] | None = self._end("least")
        self.greatest: tuple[float, int] | None = self._end("greatest")

    def _end(self, which: str) -> tuple[float, int] | None:
        end = self._found[which]
        return None if end is None else (_number(end["value"]), end["run"])

    @property
    def histogram(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lower and upper ends of the bins that are not empty, and how many values are in each."""
        bins = self._found["histogram"]
        low, high = (np.array([_number(one[k]) for one in bins], dtype=float) for k in (0, 1))
        return low, high, np.array([one[2] for one in bins], dtype=np.int64)

    def quantile(self, part: float) -> float:
        """The value below which this part of the values lies, within 0.1 % of it."""
        if not 0 <= part <= 1:
            raise ValueError(f"quantile: a number between 0 and 1 is needed, not {part!r}")
        if self.least is None or self.greatest is None:
            return math.nan
        low, high, count = self.histogram
        # As Rust rounds: halves away from zero.
        rank = math.floor(part * (self.number - 1) + 0.5)
        at = int(np.searchsorted(np.cumsum(count), rank, side="right"))
        ends = float(low[at]), float(high[at])
        if ends[0] == ends[1]:
            middle = ends[0]
        else:
            middle = 0.0 if 0.0 in ends else ends[0] + 0.5 * (ends[1] - ends[0])
        return min(max(middle, self.least[0]), self.greatest[0])

    @property
    def lowest(self) -> list[dict[str, Any]]:
        """The rows of up to 16 runs with the least values."""
        return [dict(zip(self._columns, row)) for row in self._found["lowest"]]

    @property
    def highest(self) -> list[dict[str, Any]]:
        """The rows of up to 16 runs with the greatest values."""
        return [dict(zip(self._columns, row)) for row in self._found["highest"]]

    def __repr__(self) -> str:
        return f"<fric.Measured {self.title}: mean {self.mean:.6g}, deviation {self.deviation:.3g} of {self.number}>"


class Group:
    """The runs of one point of the grids."""

    def __init__(self, found: dict[str, Any], columns: list[str]):
        #: The values of the grids that its runs share.
        self.point: dict[str, Any] = found["point"]
        self.runs: int = found["runs"]
        #: How runs ended: (status of the first, number of runs, first run).
        self.ended = [(one["status"], one["runs"], one["first"]) for one in found["ended"]]
        #: For each expectation in how many runs it holds, and in how many it was judged.
        self.verdicts = {title: (one["held"], one["judged"]) for title, one in found["verdicts"].items()}
        #: By the title of the column.
        self.measures = {title: Measured(title, one, columns) for title, one in found["measures"].items()}

    def __getitem__(self, name: str) -> Measured:
        return _named("measure", name, self.measures)

    def __repr__(self) -> str:
        point = ", ".join(f"{title} = {value}" for title, value in self.point.items())
        return f"<fric.Group {point or 'all'}: {self.runs} runs>"


class Statistics:
    """What became of each measure of a sweep, for each point of the grids."""

    def __init__(self, path: str | os.PathLike[str], words: str = ""):
        #: The file, a text of JSON.
        self.path: Path | None = Path(path)
        #: The summary that ``fric sweep`` prints.
        self.summary = words
        found = json.loads(self.path.read_text(encoding="utf-8"))
        self.runs: int = found["runs"]
        self.columns: list[str] = found["columns"]
        self.groups = [Group(one, self.columns) for one in found["groups"]]

    def __len__(self) -> int:
        return self.runs

    def __getitem__(self, name: str) -> Measured:
        """A measure of a sweep whose runs are all in one group."""
        if len(self.groups) != 1:
            raise KeyError(f"there are {len(self.groups)} groups, one for each point of the grids: take one of `groups`")
        return self.groups[0][name]

    def to_pandas(self) -> Any:
        """A row for each group and measure."""
        import pandas  # type: ignore

        rows = []
        for group in self.groups:
            for title, measured in group.measures.items():
                ends = {"least": measured.least, "greatest": measured.greatest}
                row = {**group.point, "measure": title, "number": measured.number, "missing": measured.missing}
                row |= {"mean": measured.mean, "deviation": measured.deviation}
                row |= {name: math.nan if end is None else end[0] for name, end in ends.items()}
                row |= {name: _number(value) for name, value in measured._found["quantiles"].items()}
                rows.append(row)
        return pandas.DataFrame(rows)

    def __repr__(self) -> str:
        return f"<fric.Statistics of {self.runs} runs in {len(self.groups)} groups>"
