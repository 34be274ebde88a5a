"""Recordings in memory as tables that the language reads."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def text(headings: Sequence[str], columns: Sequence[Any]) -> str:
    """A table as CSV, every number with all its digits."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(headings)
    writer.writerows(zip(*(np.asarray(column).tolist() for column in columns)))
    return out.getvalue()


def of(data: Any) -> str | None:
    """A recording as CSV: a mapping, a table of pandas or polars, a structured array, or a run. None if it is a path."""
    if isinstance(data, (str, os.PathLike)):
        return None
    if hasattr(data, "units") and hasattr(data, "keys") and hasattr(data, "t"):
        # A run, whose arrays are in SI.
        from fric import _fric

        si = {label: _fric.si_unit(unit) for label, unit in data.units.items()}
        columns = {"t [s]": data.t, **{f"{label} [{si[label]}]" if si[label] else label: data[label] for label in data.keys()}}
    elif isinstance(data, np.ndarray) and data.dtype.names:
        columns = {name: data[name] for name in data.dtype.names}
    elif isinstance(data, Mapping):
        columns = {str(name): column for name, column in data.items()}
    elif hasattr(data, "columns") and hasattr(data, "__getitem__"):
        columns = {str(name): data[name] for name in data.columns}
        name = getattr(getattr(data, "index", None), "name", None)
        if name is not None:
            columns = {str(name): data.index, **columns}
    else:
        raise TypeError(
            f"data: a path, a mapping of headings to arrays, a table of pandas or polars, or a run is needed, not {type(data).__name__}"
        )
    if not columns:
        raise ValueError("data: it has no column")
    arrays = {name: np.asarray(column) for name, column in columns.items()}
    shapes = {name: array.shape for name, array in arrays.items()}
    first = next(iter(shapes.values()))
    for name, shape in shapes.items():
        if len(shape) != 1 or shape != first:
            raise ValueError(f"data: column {name!r} has the shape {shape}; all need the same (n,)")
    return text(list(arrays), list(arrays.values()))
