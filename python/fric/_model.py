"""Texts, models and runs."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from fric import _fit, _fric, _html, _tables, _values
from fric._fit import Fit, Residuals
from fric.errors import Diagnostic, RunError, diagnostics, unknown

Progress = Callable[[float, float], object]


@dataclass(frozen=True)
class Quantity:
    """A quantity of a model. Range and default are in SI."""

    path: str
    unit: str
    range: tuple[float, float] = (-np.inf, np.inf)
    default: float | None = None
    doc: str | None = None
    #: The SI unit, in which arrays and numbers without unit are.
    si: str = ""
    boolean: bool = False


@dataclass(frozen=True)
class Verdict:
    """What became of an ``expect``. Numbers are in ``unit``."""

    text: str
    holds: bool
    decided: bool
    value: float | None = None
    limit: float | None = None
    margin: float | None = None
    error: float | None = None
    unit: str | None = None
    time: float | None = None

    def __bool__(self) -> bool:
        return self.holds and self.decided


@dataclass(frozen=True, repr=False)
class Explanation:
    """The compiler's analysis of a model. ``str()`` is what ``fric explain`` prints."""

    words: str
    #: The object of ``fric explain --json``.
    json: dict[str, Any]

    @property
    def equations(self) -> list[tuple[str, str]]:
        """Left and right sides, in the order in which they are computed."""
        return [(one["left"], one["right"]) for one in self.json["equations"]]

    @property
    def stable(self) -> dict[str, float | None]:
        """The largest stable step of each method in s; none if it could not be found."""
        return {one["method"]: _number(one["largest_stable_s"]) for one in self.json["steps"]}

    def __str__(self) -> str:
        return self.words

    __repr__ = __str__


class Linear:
    """Matrices at a point: ``A, B, C, D = linear``; ``P`` and ``Q`` if parameters were named. Names in order, all in SI."""

    def __init__(self, found: dict[str, Any]):
        #: The object of ``fric linearise --json``.
        self.json = found
        names = {key: [one["name"] for one in found.get(key, [])] for key in ("states", "inputs", "outputs", "params")}
        self.states, self.inputs, self.outputs, self.params = names.values()
        rows = {"A": self.states, "B": self.states, "C": self.outputs, "D": self.outputs, "P": self.states}
        columns = {"A": self.states, "B": self.inputs, "C": self.states, "D": self.inputs}

        def matrix(name: str) -> np.ndarray:
            shape = len(rows.get(name, self.outputs)), len(columns.get(name, self.params))
            return np.array([[_number(x) for x in row] for row in found.get(name, [])], dtype=float).reshape(shape)

        self.A, self.B, self.C, self.D, self.P, self.Q = map(matrix, "ABCDPQ")
        #: The states at the point, and dx/dt there: 0 at an equilibrium.
        self.x = np.array([_number(one["value"]) for one in found["states"]], dtype=float)
        self.rates = np.array([_number(one["rate"]) for one in found["states"]], dtype=float)

    @property
    def eigenvalues(self) -> np.ndarray:
        """Those of A; of a pair both."""
        found = [complex(_number(one["real"]), _number(one["imaginary"])) for one in self.json["modes"]]
        return np.array([each for one in found for each in ((one, one.conjugate()) if one.imag else (one,))], complex)

    def __iter__(self) -> Any:
        return iter((self.A, self.B, self.C, self.D))

    def __repr__(self) -> str:
        names = ", ".join(self.states), ", ".join(self.inputs), ", ".join(self.outputs)
        return f"<fric.Linear of states ({names[0]}), inputs ({names[1]}), outputs ({names[2]})>"


class Study:
    """A friction model's measured behaviour: ``json`` as ``fric characterise --json``; a notebook shows the page."""

    def __init__(self, found: dict[str, Any], page: str):
        self.json, self.page = found, page

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the page, a file of HTML that needs no other."""
        with open(path, "w", encoding="utf-8") as file:
            file.write(self.page)

    def _repr_html_(self) -> str:
        # The page has styles of its own.
        return f'<iframe srcdoc="{_html.escaped(self.page)}" style="width:100%;height:40em;border:0" sandbox></iframe>'

    def __repr__(self) -> str:
        return f"<fric.Study of {self.json.get('model', 'a model')}>"


class Text:
    """A text of the language with its models and experiments. Made by :func:`load` and :func:`loads`."""

    def __init__(self, inner: _fric.Text):
        self._inner = inner

    @property
    def name(self) -> str:
        """The path of the file."""
        return self._inner.source()[0]

    @property
    def source(self) -> str:
        """The text itself."""
        return self._inner.source()[1]

    @property
    def models(self) -> list[str]:
        """Names of the models."""
        return self._inner.models()

    @property
    def experiments(self) -> list[str]:
        """Names of the experiments."""
        return self._inner.experiments()

    @property
    def fits(self) -> list[str]:
        """Names of the fits."""
        return self._inner.fits()

    @property
    def warnings(self) -> list[Diagnostic]:
        """What ``fric check`` warns of."""
        return [one for one in diagnostics(self._inner.check()) if one.severity == "warning"]

    def model(self, name: str | None = None, /, **arguments: Any) -> Model:
        """A model of the text, with arguments as in the language; the only one if no name is given."""
        if name is None:
            if len(self.models) != 1:
                raise unknown("model", "", self.models)
            name = self.models[0]
        return Model(self, name, arguments)

    def run(self, experiment: str | None = None, **how: Any) -> Run:
        """Runs an experiment as ``fric run`` does, to the bit; the only one if no name is given.

        See :meth:`runs` for the options. Expectations that fail raise nothing: look at ``passed``.
        """
        if experiment is None:
            if len(self.experiments) != 1:
                raise unknown("experiment", "", self.experiments)
            experiment = self.experiments[0]
        runs = self.runs(experiment, **how)
        if len(runs) != 1:
            raise ValueError(f"`{experiment}` sweeps: it has {len(runs)} cases; use text.runs({experiment!r})")
        return runs[0]

    def runs(
        self,
        experiment: str,
        *,
        set: Mapping[str, Any] | None = None,
        solver: str | None = None,
        step: str | float | None = None,
        tol: float | None = None,
        duration: str | float | None = None,
        every: str | float | None = None,
        at: Sequence[float] | np.ndarray | None = None,
        thin: bool = False,
        errors: bool = True,
        interpret: bool = False,
        progress: bool | Progress | None = None,
        _corners: list[float] | None = None,
    ) -> list[Run]:
        """Runs an experiment; a run for each case of its sweeps.

        ``set``: parameters and parts, ``{"fr.Fs": "2 N"}``. ``every``, ``at``: rows at equal distances, or at these
        instants in s; else there is a row for each step, with ``thin`` some thousand with every minimum and maximum.
        ``errors=False`` leaves out the estimate of the numerical errors. A run that stops raises RunError.
        """
        if experiment not in self.experiments:
            raise unknown("experiment", experiment, self.experiments)
        given = dict(set or {})
        bare = any(not isinstance(value, str) for value in given.values())
        known = {path: (si, False) for path, si in self._inner.units(experiment)} if bare else None
        values = _values.settings(given, known)
        found = self._inner.run(
            experiment,
            [f"{path}={value}" for path, value in values.items()],
            solver,
            None if step is None else _values.seconds("step", step),
            tol,
            None if duration is None else _values.seconds("duration", duration),
            _corners or [],
            errors,
            interpret,
            _reporter(progress),
        )
        rows = None if every is None else _values.seconds("every", every)
        instants = None if at is None else [float(t) for t in np.asarray(at, dtype=float).ravel()]
        runs = [Run(one, rows, instants, thin) for one in found]
        for run in runs:
            if run._inner.failure:
                cause, time = run._inner.failure
                label = f", {run.label}" if run.label else ""
                error = RunError(f"{experiment}{label}: {cause}", time)
                error.run = run
                raise error
        return runs

    def fit(self, name: str | None = None, **how: Any) -> Fit:
        """Finds the parameters with which a model follows recordings, as ``fric fit`` does; the only fit if no name is given.

        See :meth:`rank` for the options. A search without an answer raises FitError. Expectations that fail and warnings
        raise nothing: look at ``passed``, ``converged`` and ``warnings``.
        """
        found = self.rank(*([] if name is None else [name]), **how)
        if len(found) != 1:
            raise ValueError(f"`{found[0].name}` has {len(found)} laws; use text.rank({found[0].name!r})")
        return found[0]

    def rank(
        self,
        *names: str,
        data: Any = None,
        set: Mapping[str, Any] | None = None,
        starts: int | None = None,
        seed: int = 0,
        level: float = 0.95,
        robust: bool = False,
        profile: str | Sequence[str] | None = None,
        pieces: int = 4,
        solver: str | None = None,
        step: str | float | None = None,
        tol: float | None = None,
        threads: int | None = None,
    ) -> list[Fit]:
        """Fits each law of a fit with a ``sweep``, or several fits, and ranks them by what they predict: the best first.

        ``data``: recordings in place of the text's own, each a path, a mapping of headings to arrays (``{"t [s]": …,
        "v [mm/s]": …}``), a table of pandas or polars, or a :class:`Run`; a list for several. Headings without a unit have
        that of the text. All other options as on the command line. A law without an answer is a warning.
        """
        names = tuple(self._fit(name) for name in names or [None])
        asked = _fit._asked(self, names[0], data, set, solver, step, tol, threads)
        return _fit._found(self, names, asked, _fit._wished(starts, seed, level, robust, profile, pieces))

    def residuals(
        self,
        name: str | None = None,
        *,
        data: Any = None,
        set: Mapping[str, Any] | None = None,
        solver: str | None = None,
        step: str | float | None = None,
        tol: float | None = None,
        threads: int | None = None,
    ) -> Residuals:
        """Computed minus recorded as a function of the unknowns of a fit, compiled once: for other optimisers."""
        name = self._fit(name)
        asked = _fit._asked(self, name, data, set, solver, step, tol, threads)
        return Residuals(_fric.residuals(self._inner, name, asked))

    def _fit(self, name: str | None) -> str:
        if name is None and len(self.fits) == 1:
            return self.fits[0]
        if name not in self.fits:
            raise unknown("fit", name or "", self.fits)
        return name

    def __repr__(self) -> str:
        all = {"models": self.models, "experiments": self.experiments, "fits": self.fits}
        return f"<fric.Text {self.name}: {'; '.join(f'{what} ' + ', '.join(names) for what, names in all.items() if names)}>"

    def __reduce__(self) -> Any:
        from fric import _restore

        return _restore.text, (*self._inner.source(), self._inner.files())


def _reporter(progress: bool | Progress | None) -> Progress | None:
    if progress is None or progress is False:
        return None
    if callable(progress):
        return progress
    try:
        from tqdm.auto import tqdm  # type: ignore
    except ImportError:
        import sys

        return lambda done, total: print(f"\r{100 * done / total:3.0f} %", end="", file=sys.stderr, flush=True)
    bar = tqdm(total=1.0)

    def report(done: float, total: float) -> None:
        bar.update(done / total - bar.n)

    return report


class Model:
    """A model with its arguments, ready to be stepped or simulated."""

    def __init__(self, text: Text, name: str, arguments: Mapping[str, Any]):
        if name not in text.models:
            raise unknown("model", name, text.models)
        self._text, self.name = text, name
        bare = text._inner.describe(name, [])
        known = {row[1]: (row[3], row[6]) for row in bare}
        self._values = _values.settings(dict(arguments), known)
        rows = text._inner.describe(name, self._settings()) if self._values else bare
        self._quantities = [
            (kind, Quantity(path, unit, (within[0], within[1]), default, doc, si, boolean))
            for kind, path, unit, si, within, default, boolean, doc in rows
        ]

    def _settings(self) -> list[str]:
        return [f"{path}={value}" for path, value in self._values.items()]

    def _of(self, kind: str) -> dict[str, Quantity]:
        return {quantity.path: quantity for own, quantity in self._quantities if own == kind}

    @property
    def text(self) -> Text:
        """The text that declares it."""
        return self._text

    @property
    def inputs(self) -> dict[str, Quantity]:
        """Inputs by path, in the order of the text."""
        return self._of("input")

    @property
    def outputs(self) -> dict[str, Quantity]:
        """Outputs by path."""
        return self._of("output")

    @property
    def params(self) -> dict[str, Quantity]:
        """Parameters by path, with their values."""
        return self._of("param")

    @property
    def states(self) -> dict[str, Quantity]:
        """States by path."""
        return self._of("state")

    @property
    def equations(self) -> str:
        """The equations in the symbols of print."""
        return self._text._inner.equations(self.name)

    def start(
        self,
        *,
        step: str | float,
        method: str = "expo",
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        interpret: bool = False,
    ) -> _fric.Stepper:
        """Starts an instance for fixed steps. ``inputs`` and ``outputs`` fix the order of arguments and results."""
        return _fric.Stepper(
            self._text._inner,
            self.name,
            dict(self._values),
            method,
            _values.seconds("step", step),
            _names("inputs", inputs),
            _names("outputs", outputs),
            interpret,
        )

    def batch(
        self,
        n: int,
        *,
        step: str | float,
        method: str = "expo",
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        params: Mapping[str, Any] | None = None,
        threads: int = 1,
        interpret: bool = False,
    ) -> _fric.Batch:
        """Starts ``n`` instances that are stepped together; the bits of each are those of an instance alone.

        ``params``: parameters that differ, each an array of n numbers in SI. The results do not depend on ``threads``.
        """
        columns = {}
        for path, values in (params or {}).items():
            numbers = np.asarray(values, dtype=float)
            if path not in self.params:
                raise unknown("parameter", path, list(self.params))
            if numbers.shape not in ((), (n,)):
                raise ValueError(f"params: `{path}` has shape {numbers.shape}, and ({n},) is needed")
            columns[path] = np.broadcast_to(numbers, (n,))
        sets: dict[tuple[float, ...], int] = {}
        rows = zip(*columns.values()) if columns else [()] * n
        which = [sets.setdefault(tuple(map(float, row)), len(sets)) for row in rows]

        def settings(row: tuple[float, ...]) -> dict[str, str]:
            own = {
                path: _values.written(path, value, self.params[path].si, self.params[path].boolean)
                for path, value in zip(columns, row)
            }
            return {**self._values, **own}

        return _fric.Batch(
            self._text._inner,
            self.name,
            [settings(row) for row in sets],
            which,
            method,
            _values.seconds("step", step),
            _names("inputs", inputs),
            _names("outputs", outputs),
            threads,
            interpret,
        )

    def simulate(
        self,
        duration: str | float,
        *,
        inputs: Mapping[str, Any] | None = None,
        outputs: Sequence[str] | None = None,
        hold: bool = False,
        solver: str | None = None,
        step: str | float | None = None,
        tol: float | None = None,
        **how: Any,
    ) -> Run:
        """Runs the model on its own.

        ``inputs``: for each input a number in SI, a text of the language (``"1 N * sin(2 rad/s * t)"``), or a pair of
        arrays (t, values) in SI: straight lines between them, or with ``hold`` values that stay until the next one; an adaptive
        run meets their corners and jumps exactly. ``outputs``: expressions to record; else all outputs and states.
        Further options are those of :meth:`Text.runs`.
        """
        given = dict(inputs or {})
        for path in given:
            if path not in self.inputs:
                raise unknown("input", path, list(self.inputs))
        missing = [path for path in self.inputs if path not in given]
        if missing:
            raise ValueError(f"inputs: no signal for {', '.join(f'`{path}`' for path in missing)} of `{self.name}`")
        arguments, series, corners = [], {}, []
        for path, value in given.items():
            quantity = self.inputs[path]
            if callable(value):
                raise TypeError(
                    f"inputs: `{path}` is a function of Python, which each of some 100,000 evaluations would call; "
                    "give a pair of arrays (t, values), or make the steps yourself with start().step"
                )
            if isinstance(value, tuple):
                series[path] = _series(path, value, hold)
            else:
                arguments.append(f"{path} = {_values.written(path, value, quantity.si, quantity.boolean)}")
        experiment = f"simulation_of_{self.name}"
        while experiment in self._text.experiments or experiment in self._text.models:
            experiment += "_"
        files = list(self._text._inner.files())
        name, source = self._text._inner.source()
        data = ""
        if series:
            times, columns = _merged(series)
            # A held value jumps at its instant: a step ends there with the value before, and the next one begins with the
            # new one.
            jumps = [np.asarray(value[0], dtype=float) for value in given.values() if isinstance(value, tuple)]
            corners = np.unique(np.concatenate(jumps)).tolist() if hold else times.tolist()
            units = [self.inputs[path].si for path in columns]
            heads = ["t [s]", *(f"c{k} [{si}]" if si else f"c{k}" for k, si in enumerate(units))]
            file = f"{experiment}.csv"
            files = [one for one in files if one[:2] != (name, file)]
            files.append((name, file, file, _tables.text(heads, [times, *columns.values()])))
            data = f"  data {json.dumps(file)} ({', '.join(heads)})\n"
            arguments += [f"{path} = data.c{k}" for k, path in enumerate(columns)]
        record = list(outputs) if outputs is not None else [*self.outputs, *self.states]
        if not record:
            raise ValueError(f"outputs: `{self.name}` has no output and no state; name an expression to record")
        instance = f"{self.name}({', '.join(arguments)})"
        body = f"{source}\nexperiment {experiment} {{\n  run {instance} for {_values.seconds('duration', duration)!r} s\n"
        body += f"{data}  record {', '.join(record)}\n}}\n"
        values = {**self._values, **how.pop("set", {})}
        made = Text(_fric.Text(name, body, files))
        return made.run(experiment, set=values, solver=solver, step=step, tol=tol, _corners=corners, **how)

    def explain(self) -> Explanation:
        """What ``fric explain`` says: quantities, order of equations, states, costs and largest stable steps."""
        words, found = self._text._inner.explain(self.name, self._settings())
        return Explanation(words, json.loads(found))

    def linearise(
        self,
        at: Mapping[str, Any] | None = None,
        *,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        params: Sequence[str] | None = None,
        rest: bool = False,
    ) -> Linear:
        """The matrices of the model at a point, as ``fric linearise``: dx = A x + B u, y = C x + D u around it, in SI.

        ``at``: states, inputs, parameters and regimes there, ``{"v": "1 mm/s", "fr": "stick"}``; all others as at the
        start, or with ``rest`` where the model comes to rest. ``inputs``, ``outputs``: names; else those of the model.
        ``params``: P and Q are the derivatives with respect to these.
        """
        known = {quantity.path: quantity for _, quantity in self._quantities}

        def text(path: str, value: Any) -> str:
            quantity = known.get(path)
            if quantity is not None:
                return _values.written(path, value, quantity.si, quantity.boolean)
            if not isinstance(value, str):
                raise unknown("state, input or parameter", path, list(known))
            # The regime of a part.
            return value

        given = [(path, text(path, value)) for path, value in (at or {}).items()]
        ins, outs = _names("inputs", inputs) or [], _names("outputs", outputs) or []
        moved = _names("params", params) or []
        found = self._text._inner.linearise(self.name, self._settings(), ins, outs, moved, given, None, rest)
        return Linear(json.loads(found))

    def curve(
        self,
        output: str,
        over: str,
        values: str | Sequence[float] | np.ndarray,
        *,
        points: int = 201,
        **held: Any,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where an output comes to rest while an input is held at each of some values: the steady curve, in SI.

        ``values``: an array, or a range such as ``"-5 mm/s .. 5 mm/s"`` with ``points`` of them. ``held``: values of other
        inputs; 0 else. NaN where the output does not come to rest.
        """
        for path in (over, *held):
            if path not in self.inputs:
                raise unknown("input", path, list(self.inputs))
        if isinstance(values, str):
            low, dots, high = values.partition("..")
            if not dots:
                raise ValueError(f'values: a range such as "-5 mm/s .. 5 mm/s" is needed, not {values!r}')
            ends = [_values.number(over, end.strip(), self.inputs[over].si) for end in (low, high)]
            x = np.linspace(ends[0], ends[1], points)
        else:
            x = np.asarray(values, dtype=float).ravel()
        others = {path: 0.0 for path in self.inputs if path != over} | held
        inputs = [(over, x.tolist())] + [
            (path, [_values.number(path, value, self.inputs[path].si, self.inputs[path].boolean)])
            for path, value in others.items()
        ]
        if x.size == 0:
            return x, x.copy()
        if not np.isfinite(x).all():
            raise ValueError(f"values: those of `{over}` must be finite")
        if output not in self.outputs and output not in self.states:
            raise unknown("output", output, [*self.outputs, *self.states])
        return x, self._text._inner.steady(self.name, self._settings(), output, inputs)

    def emit(self, dialect: str) -> str:
        """The model as Python source for ``numpy``, ``jax``, ``casadi`` or ``sympy``, as ``fric build --emit``."""
        return self._text._inner.emit(self.name, self._settings(), dialect)

    def module(self, dialect: str) -> ModuleType:
        """The module of that source: ``f``, ``start``, and the names of rows in ``STATES``, ``INPUTS``, ``PARAMS``, ``OUTPUTS``."""
        made = ModuleType(f"{self.name}_{dialect}")
        exec(compile(self.emit(dialect), f"<{self.name} for {dialect}>", "exec"), made.__dict__)
        return made

    def function(self, dialect: str) -> Callable[..., Any]:
        """The pure function ``f(t, x, u, p) -> dx, y`` of that source: rates of the states and outputs, in SI."""
        return self.module(dialect).f

    def characterise(self) -> Study:
        """Runs a friction model (an input ``v`` and an output ``F``) through the standard battery of experiments."""
        found, page = self._text._inner.characterise(self.name, list(self._values.items()))
        return Study(json.loads(found), page)

    def _steady_svg(self) -> str:
        """The steady curve of a friction model; empty for others."""
        if "v" not in self.inputs or "F" not in self.outputs:
            return ""
        speed = self.inputs["v"].si
        scales = [
            quantity.default
            for quantity in self.params.values()
            if quantity.si == speed and quantity.default is not None and 0 < quantity.default < np.inf
        ]
        most = 5 * max(scales) if scales else 0.05
        try:
            x, y = self.curve("F", "v", np.linspace(-most, most, 121))
        except (ValueError, RuntimeError):
            # A model that cannot stand alone has no such curve; its equations are shown all the same.
            return ""
        if not np.isfinite(y).any():
            return ""
        points = list(zip(x.tolist(), y.tolist()))
        axes = ("v", speed), ("F", self.outputs["F"].si)
        return _fric.curve_svg(f"{self.name}, steady", *axes, points, 560, _html.identifier())

    def _repr_html_(self) -> str:
        rows = [
            (
                kind,
                quantity.path,
                quantity.unit or "1",
                "" if quantity.default is None else f"{quantity.default:g} {quantity.si}",
                quantity.doc or "",
            )
            for kind, quantity in self._quantities
        ]
        table = _html.table(("", "name", "unit", "value", ""), rows)
        head = f"<h4>{_html.escaped(self.name)}</h4><pre>{_html.escaped(self.equations)}</pre>"
        return head + self._steady_svg() + table

    def __repr__(self) -> str:
        values = ", ".join(f"{path} = {value}" for path, value in self._values.items())
        return f"<fric.Model {self.name}({values})>"

    def __reduce__(self) -> Any:
        return Model, (self._text, self.name, self._values)


def _names(what: str, names: Sequence[str] | None) -> list[str] | None:
    if isinstance(names, str):
        raise TypeError(f"{what} is a list of names: [{names!r}]")
    return None if names is None else list(names)


def _series(path: str, pair: Any, hold: bool) -> tuple[np.ndarray, np.ndarray]:
    """Times and values of an input."""
    if len(pair) != 2:
        raise ValueError(f"inputs: `{path}` is a pair of arrays (t, values), not {len(pair)} of them")
    t, x = (np.asarray(one, dtype=float) for one in pair)
    if t.ndim != 1 or t.shape != x.shape or t.size < 2:
        raise ValueError(f"inputs: `{path}` has times of shape {t.shape} and values of shape {x.shape}; both need (n,)")
    if not (np.isfinite(t).all() and np.isfinite(x).all()):
        raise ValueError(f"inputs: `{path}` has values that are not finite")
    if not (np.diff(t) > 0).all():
        raise ValueError(f"inputs: the times of `{path}` do not rise")
    if hold:
        # A value stays until just before the next instant.
        t, x = np.column_stack([t[:-1], np.nextafter(t[1:], -np.inf)]).ravel(), np.repeat(x, 2)[:-1]
        t = np.append(t, pair[0][-1])
    return t, x


def _merged(series: dict[str, tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """All series on the instants of all of them."""
    times = np.unique(np.concatenate([t for t, _ in series.values()]))
    return times, {path: np.interp(times, t, x) for path, (t, x) in series.items()}


def _number(value: Any) -> Any:
    """A number of the JSON, in which infinite ones are texts."""
    return float(value) if value in ("inf", "-inf", "nan") else value


class Run:
    """The results of a run. ``r["x"]`` is a read-only array in SI, ``r.t`` the times in s."""

    def __init__(self, inner: _fric.Run, every: float | None, at: list[float] | None, thin: bool):
        self._inner, self._how = inner, (every or inner.every if at is None else None, at, thin)
        self._json = json.loads(inner.json)
        self._rows: tuple[np.ndarray, list[tuple[str, str, bool, np.ndarray]]] | None = None

    def _columns(self) -> tuple[np.ndarray, list[tuple[str, str, bool, np.ndarray]]]:
        if self._rows is None:
            every, at, thin = self._how
            self._rows = self._inner.rows(None if thin else every, at, thin)
        return self._rows

    @property
    def t(self) -> np.ndarray:
        """Times in s."""
        return self._columns()[0]

    def keys(self) -> list[str]:
        """Labels of what was recorded."""
        return [label for label, *_ in self._columns()[1]]

    def __getitem__(self, label: str) -> np.ndarray:
        for own, _, _, values in self._columns()[1]:
            if own == label:
                return values
        raise unknown("recorded quantity", label, self.keys())

    def __contains__(self, label: object) -> bool:
        return label in self.keys()

    def __iter__(self) -> Any:
        return iter(self.keys())

    def __len__(self) -> int:
        return len(self.keys())

    @property
    def units(self) -> dict[str, str]:
        """The unit of each in the text. Arrays are in SI; see :meth:`in_unit`."""
        return {label: unit for label, unit, *_ in self._columns()[1]}

    def in_unit(self, label: str) -> np.ndarray:
        """The values in the unit of the text."""
        return _fric.in_unit(self[label], self.units[label])

    @property
    def label(self) -> str:
        """How the case differs from others of its experiment."""
        return self._inner.label

    @property
    def verdicts(self) -> list[Verdict]:
        """What became of each ``expect``."""
        names = Verdict.__dataclass_fields__
        return [
            Verdict(**{key: _number(value) for key, value in one.items() if key in names})
            for one in self._json.get("expects", [])
        ]

    @property
    def passed(self) -> bool:
        """Whether every ``expect`` held, and is decided."""
        return self._json["passed"]

    @property
    def finals(self) -> dict[str, float]:
        """Outputs at the end, in SI."""
        return {path: value for path, value, *_ in self._inner.finals}

    @property
    def notes(self) -> list[str]:
        """Notes of compiler and solver."""
        return self._json["notes"]

    @property
    def steps(self) -> int | None:
        """Number of steps; none if the run stopped."""
        return self._json.get("steps")

    @property
    def json(self) -> dict[str, Any]:
        """The object that ``fric run --json`` prints."""
        return json.loads(self._inner.json)

    def to_pandas(self) -> Any:
        """A table of pandas with the columns of ``fric run --data``: time in s, ``x [mm]``."""
        import pandas  # type: ignore

        columns = {f"{label} [{unit}]" if unit else label: self.in_unit(label) for label, unit in self.units.items()}
        return pandas.DataFrame({"t [s]": self.t, **columns})

    def to_xarray(self) -> Any:
        """A data set of xarray over time in SI; ``attrs["units"]`` can be read by pint and udunits."""
        import xarray

        def variable(label: str, values: np.ndarray) -> Any:
            attributes = _attributes(_fric.si_unit(self.units[label]))
            return ("time", values, attributes)

        variables = {label: variable(label, self[label]) for label in self.keys()}
        time = xarray.Variable("time", self.t, {"units": "s"})
        return xarray.Dataset(variables, coords={"time": time})

    def __arrow_c_stream__(self, requested_schema: object = None) -> Any:
        """The columns in SI for pyarrow, polars and DuckDB, without a copy: ``t [s]``, ``x [m]``."""
        columns = [("t [s]", self.t)]
        for label, unit in self.units.items():
            si = _fric.si_unit(unit)
            columns.append((f"{label} [{si}]" if si else label, self[label]))
        return _fric.arrow_stream(columns)

    def svg(self, width: float = 860) -> str:
        """The plots of the experiment as SVG; empty if it has none."""
        return self._inner.svg(width, _html.identifier())

    def _repr_html_(self) -> str:
        rows = [
            (one.text, "passed" if one else "failed" if one.decided else "undecided", _shown(one))
            for one in self.verdicts
        ]
        table = _html.table(("expect", "", "value"), rows) if rows else ""
        return self.svg() + table

    def __repr__(self) -> str:
        state = "passed" if self.passed else "failed"
        label = f", {self.label}" if self.label else ""
        return f"<fric.Run {self._json['experiment']}{label}: {state}, {self._json['time']} s>"


def _shown(verdict: Verdict) -> str:
    return "" if verdict.value is None else f"{verdict.value:.6g} {verdict.unit or ''}".strip()


def _attributes(si: str) -> dict[str, str]:
    """Units as pint and udunits read them; a fractional exponent is only told, because udunits would drop it."""
    if "/" in si and "(" in si or "." in si:
        return {"long_name": f"in {si}"}
    spelled = si
    for ours, theirs in (("·", "*"), ("Ohm", "ohm"), ("rev", "revolution"), ("deg", "degree")):
        spelled = spelled.replace(ours, theirs)
    factors: list[str] = []
    for k, part in enumerate(spelled.split("/")):
        for factor in filter(None, part.split("*")):
            base, _, power = factor.partition("^")
            if base == "1":
                continue
            exponent = int(power or 1) * (-1 if k else 1)
            factors.append(base if exponent == 1 else f"{base}^{exponent}")
    return {"units": "*".join(factors) or "1"}


def load(path: str | os.PathLike[str]) -> Text:
    """Loads a file; what it imports is found relative to it. Raises CompileError, OSError."""
    path = os.fspath(path)
    return Text(_fric.Text(path, _fric.Text.read(path), []))


def loads(source: str, name: str = "text.fric") -> Text:
    """Loads a text; what it imports is found relative to ``name``."""
    return Text(_fric.Text(name, source, []))


def rank(data: Any, *laws: str, **how: Any) -> list[Fit]:
    """Fits the standard laws to one recording, as ``fric fit FILE.csv`` does, and ranks them: the best first.

    ``data``: as for :meth:`Text.rank`; its headings are t, v, F or t, x, F or v, F, with units, as in ``{"t [s]": …, "v [mm/s]":
    …, "F [N]": …}``. ``laws``: some of them, such as ``"LuGre"``. Options as for :meth:`Text.rank`.
    """
    table = _tables.of(data)
    if table is None:
        path = os.fspath(data)
        table, stem = _fric.table(path), os.path.splitext(os.path.basename(path))[0]
    else:
        path, stem = "recording.csv", "recording"
        how["data"] = data
    made = Text(_fric.Text(f"{stem}_laws.fric", _fric.laws(table, path), []))
    return made.rank(*([law.lower() for law in laws] or made.fits), **how)


def model(name: str, /, **arguments: Any) -> Model:
    """A model of the library, with arguments as in the language."""
    found = _fric.library_model(name)
    if found is None:
        raise unknown("model of the library", name, _fric.library_models())
    file, source = found
    return Text(_fric.Text(file, source, [])).model(name, **arguments)
