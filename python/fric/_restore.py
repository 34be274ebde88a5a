"""Makes objects again that were pickled."""

from __future__ import annotations

from typing import Any

from fric import _fric


def text(name: str, source: str, files: list[tuple[str, str, str, str]]) -> Any:
    """A text."""
    from fric._model import Text

    return Text(_fric.Text(name, source, files))


def stepper(
    source: tuple[str, str, list[tuple[str, str, str, str]]],
    model: str,
    values: dict[str, str],
    how: tuple[str, float, bool],
    inputs: list[str],
    outputs: list[str],
    block: bytes,
) -> _fric.Stepper:
    """A running instance."""
    method, step, interpret = how
    made = _fric.Stepper(_fric.Text(*source), model, values, method, step, inputs, outputs, interpret)
    made.restore(block)
    return made


def batch(
    source: tuple[str, str, list[tuple[str, str, str, str]]],
    model: str,
    sets: list[dict[str, str]],
    which: list[int],
    how: tuple[str, float, bool],
    inputs: list[str],
    outputs: list[str],
    threads: int,
    state: tuple[bytes, list[tuple[int, int, bytes]]],
) -> _fric.Batch:
    """Many running instances."""
    method, step, interpret = how
    made = _fric.Batch(_fric.Text(*source), model, sets, which, method, step, inputs, outputs, threads, interpret)
    made.restore(*state)
    return made
