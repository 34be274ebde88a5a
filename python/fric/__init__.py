"""Models of friction, controllers and rigs in the language fric, as fast objects.

>>> import fric
>>> contact = fric.model("LuGre")
>>> s = contact.start(step="10 us", outputs=["F"])
>>> force = s.step(0.001)
"""

from typing import TYPE_CHECKING

from fric._fric import Batch, Native, Stepper, __version__
from fric._fit import Fit, Residuals
from fric._model import Explanation, Linear, Model, Quantity, Run, Study, Text, Verdict, load, loads, model, rank
from fric._statistics import Group, Measured, Statistics
from fric._sweep import Table, lognormal, normal, sweep, sweep_rows, uniform
from fric.errors import (
    CompileError,
    Diagnostic,
    FitError,
    InternalError,
    RangeError,
    RunError,
    SweepError,
    UnitError,
    UnknownName,
    VersionMismatch,
)

__all__ = [
    "Batch",
    "CompileError",
    "Diagnostic",
    "Explanation",
    "Fit",
    "FitError",
    "Group",
    "InternalError",
    "Linear",
    "Measured",
    "Model",
    "Native",
    "Quantity",
    "RangeError",
    "Residuals",
    "Run",
    "RunError",
    "Statistics",
    "Stepper",
    "Study",
    "SweepError",
    "Table",
    "Text",
    "UnitError",
    "UnknownName",
    "Verdict",
    "VersionMismatch",
    "__version__",
    "load",
    "loads",
    "lognormal",
    "model",
    "normal",
    "rank",
    "sweep",
    "sweep_rows",
    "uniform",
]


if TYPE_CHECKING:
    from fric._estimator import Estimator


def __getattr__(name: str) -> object:
    # It needs scikit-learn, which takes long to import: none of the names of `from fric import *`.
    if name == "Estimator":
        from fric._estimator import Estimator

        return Estimator
    raise AttributeError(f"module 'fric' has no attribute {name!r}")
