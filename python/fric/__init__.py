"""Models of friction, controllers and rigs in the language fric, as fast objects.

>>> import fric
>>> contact = fric.model("LuGre")
>>> s = contact.start(step="10 us", outputs=["F"])
>>> force = s.step(0.001)
"""

from fric._fric import Batch, Stepper, __version__
from fric._model import Model, Quantity, Run, Text, Verdict, load, loads, model
from fric.errors import (
    CompileError,
    Diagnostic,
    InternalError,
    RangeError,
    RunError,
    UnitError,
    UnknownName,
)

__all__ = [
    "Batch",
    "CompileError",
    "Diagnostic",
    "InternalError",
    "Model",
    "Quantity",
    "RangeError",
    "Run",
    "RunError",
    "Stepper",
    "Text",
    "UnitError",
    "UnknownName",
    "Verdict",
    "__version__",
    "load",
    "loads",
    "model",
]
