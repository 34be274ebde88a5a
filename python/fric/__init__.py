"""Models of friction, controllers and rigs in the language fric, as fast objects.

>>> import fric
>>> contact = fric.model("LuGre")
>>> s = contact.start(step="10 us", outputs=["F"])
>>> force = s.step(0.001)
"""

from fric._fric import Batch, Native, Stepper, __version__
from fric._model import Explanation, Linear, Model, Quantity, Run, Study, Text, Verdict, load, loads, model
from fric._statistics import Group, Measured, Statistics
from fric._sweep import Table, lognormal, normal, sweep, sweep_rows, uniform
from fric.errors import (
    CompileError,
    Diagnostic,
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
    "Group",
    "InternalError",
    "Linear",
    "Measured",
    "Model",
    "Native",
    "Quantity",
    "RangeError",
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
    "sweep",
    "sweep_rows",
    "uniform",
]
