"""A friction law as an estimator of scikit-learn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fric import _fric, _tables, _values
from fric._model import Model, Quantity, Text
from fric._model import model as of_library
from fric.errors import unknown

try:
    from sklearn.base import BaseEstimator, RegressorMixin  # type: ignore
    from sklearn.utils.validation import check_is_fitted, column_or_1d, validate_data  # type: ignore
except ImportError:
    raise ImportError("fric.Estimator needs scikit-learn 1.6 or newer: pip install 'fric[sklearn]'") from None


# Name, text and files of a text.
_Source = tuple[str, str, list[tuple[str, str, str, str]]]


class Estimator(RegressorMixin, BaseEstimator):
    """The parameters of a model as an estimator: ``X`` has a column for each input, ``y`` one for each output, in SI.

    ``model``: the name of a model of the library, or a :class:`fric.Model`, whose arguments stay as they are. ``vary``: the
    unknowns, each with a range, ``{"Fc": "0.5 N .. 2 N"}``, with a start too, ``"1 N in 0.5 N .. 2 N"``, or with what is
    known, ``"1 N +- 0.1 N"``; without it the standard laws have ranges from the data, as in ``fric fit FILE.csv``.
    ``step``: the time between rows, ``"1 ms"``; without it rows are steady points, in any order. ``inputs``, ``outputs``:
    names in the order of the columns, else those of the model. Other options as for :meth:`fric.Text.rank`.

    After ``fit``: ``values_`` and ``sd_`` in SI, and ``fit_``, the :class:`fric.Fit`.
    """

    def __init__(
        self,
        model: str | Model = "CoulombViscous",
        vary: Mapping[str, str] | None = None,
        *,
        step: str | float | None = None,
        inputs: list[str] | None = None,
        outputs: list[str] | None = None,
        starts: int | None = None,
        seed: int = 0,
        robust: bool = False,
        threads: int | None = None,
    ):
        self.model, self.vary, self.step = model, vary, step
        self.inputs, self.outputs = inputs, outputs
        self.starts, self.seed, self.robust, self.threads = starts, seed, robust, threads

    def fit(self, X: Any, y: Any) -> Estimator:
        """Finds the values; raises FitError. X: (rows, inputs), or (rows,) for one input; y: (rows, outputs) or (rows,)."""
        law = self._law()
        inputs, outputs = self._ports(law)
        X, y = validate_data(
            self, _columns(X, inputs), y, dtype=np.float64, y_numeric=True, multi_output=True, ensure_min_samples=2
        )
        y = column_or_1d(y, warn=True) if len(outputs) == 1 else y
        columns = y.reshape(len(y), -1)
        _need("y", columns, outputs)
        data = self._table(X, columns, inputs, outputs)
        self._name, self._source = self._text(law, inputs, outputs, data)
        text = Text(_fric.Text(*self._source))
        how = {"starts": self.starts, "seed": self.seed, "robust": self.robust, "threads": self.threads}
        self.fit_ = text.fit(self._name, data=data, set=law._values, **how)
        self.values_, self.sd_ = self.fit_.values, self.fit_.sd
        self._step = None if self.step is None else self.fit_._inner.steps[0]
        self._flat = y.ndim == 1
        return self

    def predict(self, X: Any) -> np.ndarray:
        """The outputs with the values found, over time from the initial state on: of the shape of ``y``."""
        check_is_fitted(self)
        law = self._law()
        inputs, outputs = self._ports(law)
        X = validate_data(self, _columns(X, inputs), dtype=np.float64, reset=False)
        # A fit needs more rows than unknowns, also where nothing is searched for.
        rows = np.concatenate([X, np.repeat(X[-1:], max(0, len(self.values_) + 1 - len(X)), axis=0)])
        nothing = np.zeros((len(rows), len(outputs)))
        data = self._table(rows, nothing, inputs, outputs)
        text = Text(_fric.Text(*self._source))
        residuals = text.residuals(self._name, data=data, set=law._values, step=self._step, threads=self.threads)
        found = np.column_stack(list(residuals.split(self.values_).values()))[: len(X)]
        return found[:, 0] if self._flat else found

    def _law(self) -> Model:
        return self.model if isinstance(self.model, Model) else of_library(self.model)

    def _ports(self, law: Model) -> tuple[dict[str, Quantity], dict[str, Quantity]]:
        """Inputs and outputs in the order of the columns."""
        seen = {**law.states, **law.outputs}
        for what, names, known in (("input", self.inputs or (), law.inputs), ("output", self.outputs or (), seen)):
            for name in names:
                if name not in known:
                    raise unknown(what, name, list(known))
        missing = [name for name in law.inputs if self.inputs is not None and name not in self.inputs]
        if missing:
            raise ValueError(f"inputs: `{missing[0]}` of `{law.name}` is missing")
        outputs = {name: seen[name] for name in self.outputs} if self.outputs is not None else law.outputs
        return {name: law.inputs[name] for name in self.inputs or law.inputs}, outputs

    def _table(
        self, X: np.ndarray, y: np.ndarray, inputs: dict[str, Quantity], outputs: dict[str, Quantity]
    ) -> dict[str, Any]:
        """Rows as a recording, whose columns have these names in all texts."""
        _need("X", X, inputs)
        step = None if self.step is None else _values.seconds("step", self.step)
        columns = {} if step is None else {"t [s]": np.arange(len(X)) * step}
        for name, quantities, values in (("v", inputs, X), ("F", outputs, y)):
            for k, quantity in enumerate(quantities.values()):
                columns[_heading(f"{name}{k or ''}", quantity)] = values[:, k]
        return columns

    def _text(
        self, law: Model, inputs: dict[str, Quantity], outputs: dict[str, Quantity], data: dict[str, Any]
    ) -> tuple[str, _Source]:
        """The name of a fit, and the text that has it."""
        if self.vary is None:
            if (list(inputs), list(outputs)) == (["v"], ["F"]):
                table = _tables.of(data) or ""
                source: _Source = ("laws.fric", _fric.laws(table, "recording.csv"), [])
                if law.name.lower() in _fric.Text(*source).fits():
                    return law.name.lower(), source
            raise ValueError(f"vary: `{law.name}` is no standard law, whose ranges follow from the data: {{'Fc': '0.5 N .. 2 N'}}")
        both = [path for path in self.vary if path in law._values]
        if both:
            raise ValueError(f"vary: `{both[0]}` is an argument of the model, and stays as it is")
        if not self.vary:
            raise ValueError("vary: no unknown is named")
        file, text = law._text._inner.source()
        name = "estimator"
        while name in law._text.fits or name in law._text.models or name in law._text.experiments:
            name += "_"
        arguments = ", ".join(f"{path} = data.v{k or ''}" for k, path in enumerate(inputs))
        ranges = ", ".join(f"{path} {_range(path, range)}" for path, range in self.vary.items())
        minimised = ", ".join(f"rms({path} - data.F{k or ''})" for k, path in enumerate(outputs))
        body = f"{text}\nfit {name} {{\n  run {law.name}({arguments})\n  data \"recording.csv\" ({', '.join(data)})\n"
        body += f"  vary {ranges}\n  minimise {minimised}\n}}\n"
        return name, (file, body, law._text._inner.files())

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        outputs = self._ports(self._law())[1]
        tags.target_tags.multi_output, tags.target_tags.single_output = len(outputs) > 1, len(outputs) == 1
        tags.regressor_tags.poor_score = True
        return tags

    def __getstate__(self) -> Any:
        # The answer holds machine code; values and deviations stay.
        return {name: value for name, value in super().__getstate__().items() if name != "fit_"}


def _columns(X: Any, inputs: Mapping[str, Quantity]) -> Any:
    """Rows of inputs: one input may come as it is recorded, without a second dimension."""
    is_flat = np.ndim(X) == 1 if isinstance(X, (list, tuple)) else getattr(X, "ndim", 2) == 1
    return np.asarray(X).reshape(-1, 1) if len(inputs) == 1 and is_flat else X


def _need(what: str, found: np.ndarray, wanted: Mapping[str, Quantity]) -> None:
    if found.shape[1] != len(wanted):
        raise ValueError(f"{what} has {found.shape[1]} columns, and {len(wanted)} are needed: {', '.join(wanted)}")


def _heading(name: str, quantity: Quantity) -> str:
    return f"{name} [{quantity.si}]" if quantity.si else name


def _range(path: str, range: str) -> str:
    if not isinstance(range, str):
        raise TypeError(f"vary: `{path}` needs a range such as \"0.5 N .. 2 N\", not {range!r}")
    return f"= {range}" if "+-" in range or " in " in range else f"in {range}"
