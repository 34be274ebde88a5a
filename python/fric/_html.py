"""Notebook representations: text escaped, no script, no request, identifiers unique on a page."""

from __future__ import annotations

import itertools
from html import escape as escaped
from typing import Iterable

__all__ = ["escaped", "identifier", "table"]

_COUNT = itertools.count(1)


def identifier() -> str:
    """A prefix for identifiers that no other representation of this process has."""
    return f"fric{next(_COUNT)}"


def table(heads: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts."""
    head = "".join(f"<th>{escaped(one)}</th>" for one in heads)
    body = "".join("<tr>" + "".join(f"<td>{escaped(one)}</td>" for one in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
