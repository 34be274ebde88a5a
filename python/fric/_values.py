"""Values with units: numbers in SI, texts of the language, quantities of pint."""

from __future__ import annotations

import math
import numbers
from typing import Any

from fric import _fric
from fric.errors import RangeError, UnitError


def _magnitude(path: str, value: Any, si: str) -> float:
    """The value in SI of a quantity of pint."""
    unit = _pint_unit(si)
    try:
        return float(value.to(unit).magnitude)
    except Exception as error:
        raise UnitError(f"`{path}` has the unit {si or '1'}: {error}") from None


def _pint_unit(si: str) -> str:
    """A unit of the language as pint reads it."""
    return si.replace("·", "*").replace("^", "**").replace("Ohm", "ohm").replace("rev", "revolution") or "dimensionless"


def written(path: str, value: Any, si: str, boolean: bool = False) -> str:
    """A value as the language reads it."""
    if isinstance(value, str):
        return value
    if boolean or isinstance(value, bool):
        if value in (True, False):
            return "true" if value else "false"
        raise UnitError(f"`{path}` is a truth value, not {value!r}")
    if hasattr(value, "magnitude") and hasattr(value, "to"):
        value = _magnitude(path, value, si)
    if not isinstance(value, numbers.Real):
        raise UnitError(f"`{path}` is a number in SI or a text such as \"2 N\", not {type(value).__name__}")
    number = float(value)
    if math.isnan(number):
        raise RangeError(f"`{path}` is not a number (nan)")
    if math.isinf(number):
        return "inf" if number > 0 else "-inf"
    return f"{number!r} {si}".strip()


def number(path: str, value: Any, si: str, boolean: bool = False) -> float:
    """A value in SI."""
    if isinstance(value, str):
        try:
            found, unit = _fric.quantity(value)
        except ValueError as error:
            raise UnitError(f"`{path}`: {error}") from None
        if unit != si:
            raise UnitError(f"`{path}` has the unit {si or '1'}, and {value!r} is in {unit or '1'}")
        return found
    if hasattr(value, "magnitude") and hasattr(value, "to"):
        return _magnitude(path, value, si)
    if isinstance(value, bool) and not boolean:
        raise UnitError(f"`{path}` is a number, not a truth value")
    if not isinstance(value, numbers.Real):
        raise UnitError(f"`{path}` is a number in SI or a text such as \"2 N\", not {type(value).__name__}")
    return float(value)


def seconds(name: str, value: Any) -> float:
    """A time in s."""
    return number(name, value, "s")


def settings(values: dict[str, Any] | None, known: dict[str, tuple[str, bool]] | None = None) -> dict[str, str]:
    """Values as the language reads them. ``known``: SI unit of each path, and whether it is a truth value."""
    out = {}
    for path, value in (values or {}).items():
        si, boolean = (known or {}).get(path, ("", False))
        out[path] = written(path, value, si, boolean)
    return out
