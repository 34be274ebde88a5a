"""Exceptions are those of the table in docs/python.md, and say what to do."""

import pickle
import random

import numpy as np
import pytest

import fric

TEXT = """model Servo {
  input  u [N] in -10 N .. 10 N
  param  m = 1 kg in > 0
  param  low = 1 N
  param  high = 2 N
  require low < high
  state  x [mm] = 0
  state  v [m/s] = 0 in -5 m/s .. 5 m/s
  dx/dt = v
  dv/dt = u / m
  output F [N] = u
}
experiment e { run Servo(u = 1 N) for 1 s  expect final(x) > 0 m }
"""


def test_a_compile_error_has_report_and_places():
    with pytest.raises(fric.CompileError) as found:
        fric.loads("model M { output x [m] = 1 m + 1 s }").model("M").start(step="1 ms")
    error = found.value
    assert isinstance(error, ValueError) and "E0101" in str(error) and "text.fric" in str(error)
    first = error.diagnostics[0]
    assert (first.code, first.severity, first.line) == ("E0101", "error", 1) and first.column > 20
    same = pickle.loads(pickle.dumps(error))
    assert str(same) == str(error) and same.diagnostics == error.diagnostics
    assert error._repr_html_().startswith("<pre>") and "<script" not in error._repr_html_()


@pytest.mark.parametrize(
    ("kind", "parent", "call"),
    [
        (fric.UnitError, TypeError, lambda text: text.model("Servo", m="1 N").params),
        (fric.UnitError, TypeError, lambda text: text.run("e", set={"m": "1 s"})),
        (fric.RangeError, ValueError, lambda text: text.model("Servo", m=-1.0).params),
        (fric.RangeError, ValueError, lambda text: text.model("Servo", low="3 N").params),
        (fric.RangeError, ValueError, lambda text: text.model("Servo", m=float("nan")).params),
        (fric.UnknownName, KeyError, lambda text: text.model("Servp")),
        (fric.UnknownName, KeyError, lambda text: text.run("f")),
        (fric.UnknownName, KeyError, lambda text: text.model("Servo", mass=1.0).params),
        (fric.UnknownName, KeyError, lambda text: text.model("Servo").start(step=1e-3, inputs=["w"])),
        (fric.UnknownName, KeyError, lambda text: text.model("Servo").start(step=1e-3, outputs=["y"])),
        (fric.UnknownName, KeyError, lambda text: text.model("Servo").start(step=1e-3, method="rk5")),
        (fric.UnknownName, KeyError, lambda text: fric.model("LuGri")),
        (fric.UnitError, TypeError, lambda text: text.model("Servo").start(step="1 m")),
        (fric.RangeError, ValueError, lambda text: text.model("Servo").start(step=-1)),
        (TypeError, TypeError, lambda text: text.model("Servo").start(step=1e-3, inputs="u")),
        (ValueError, ValueError, lambda text: text.model("Servo").start(step=1e-3, method="adaptive")),
        (OSError, OSError, lambda text: fric.load("/there/is/no/such.fric")),
    ],
)
def test_the_table_of_exceptions(kind, parent, call):
    with pytest.raises(kind) as found:
        call(fric.loads(TEXT))
    assert isinstance(found.value, parent) and len(str(found.value)) > 10
    assert "Traceback" not in str(found.value)


def test_a_near_name_is_suggested():
    with pytest.raises(fric.UnknownName, match="did you mean `LuGre`"):
        fric.model("LuGrr")


def test_a_refused_change_changes_nothing():
    s = fric.loads(TEXT).model("Servo").start(step="1 ms", inputs=["u"], outputs=["x", "F"])
    s.step(1.0)
    before = pickle.dumps(s)
    for call, kind in [
        (lambda: s.set(low=3.0), fric.RangeError),
        (lambda: s.set(low=0.5, high=0.1), fric.RangeError),
        (lambda: s.set(m="1 N"), fric.UnitError),
        (lambda: s.set(nothing=1.0), fric.UnknownName),
        (lambda: s.__setitem__("m", "2 s"), fric.UnitError),
        (lambda: s.__setitem__("F", 1.0), TypeError),
        (lambda: s.step(), TypeError),
        (lambda: s.step("1"), TypeError),
        (lambda: s.step(1.0, 2.0), TypeError),
        (lambda: s.hold(-1, 1.0), OverflowError),
        (lambda: s.follow(np.zeros((3, 2))), ValueError),
        (lambda: s.follow(np.zeros(3, dtype=np.float32)), TypeError),
        (lambda: s.follow(np.zeros(3, dtype=complex)), TypeError),
        (lambda: s.follow(None), TypeError),
        (lambda: s.follow("abc"), TypeError),
        (lambda: s.follow(np.zeros(3), out=np.zeros(3)), ValueError),
        (lambda: setattr(s, "state", [1.0]), ValueError),
    ]:
        with pytest.raises(kind):
            call()
        assert pickle.dumps(s) == before
    s.set(low=2.5, high=3.0)
    assert s["low"] == 2.5


def test_a_step_out_of_its_range_says_which_and_when():
    s = fric.loads(TEXT).model("Servo", m="1 g").start(step="1 ms", inputs=["u"], outputs=["v"])
    with pytest.raises(fric.RunError, match="`v` left its range") as found:
        for _ in range(100):
            s.step(1.0)
    assert found.value.time == pytest.approx(0.006)
    s.reset()
    with pytest.raises(fric.RunError) as found:
        s.follow(np.ones(100))
    assert found.value.rows.shape == (6,) and s.time == pytest.approx(0.006)


def test_random_calls_raise_and_never_abort(seed):
    """Random calls of the surface with wrong types, shapes and units: exceptions of Python, no abort."""
    import os

    chance = random.Random(seed)
    s = fric.loads(TEXT).model("Servo").start(step="1 ms")
    values = [
        0.5, -1.0, 0, True, None, "1 N", "x", "", b"x", float("nan"), float("inf"), 10**30, 1e300, [1.0], (1.0,), {},
        np.float64(0.25), np.float32(0.25), np.zeros(0), np.zeros(()), np.ones(3), np.ones((2, 1)), np.ones((1, 2, 1)),
        np.ones((4, 1), order="F"), np.ones(8)[::2], np.ones(3, dtype=int), np.ones(3, dtype=object), object(), s,
        np.ma.masked_array([1.0, 2.0]), np.frombuffer(b"\0" * 25, dtype=np.uint8)[1:].view(np.float64),
    ]  # fmt: skip
    calls = {"step": 2, "hold": 2, "follow": 2, "set": 1, "__setitem__": 2, "__getitem__": 1, "copy": 0, "reset": 0}
    raised = done = 0
    for number in range(int(os.environ.get("FRIC_CALLS", "20000"))):
        name = chance.choice(list(calls))
        arguments = [chance.choice(values) for _ in range(chance.randint(0, calls[name]))]
        if name == "__setitem__" and chance.random() < 0.7 and arguments:
            arguments[0] = chance.choice(["u", "x", "v", "m", "low", "F"])
        if name == "hold" and arguments and isinstance(arguments[0], (int, float)) and arguments[0] > 1000:
            arguments[0] = 7
        try:
            getattr(s, name)(*arguments)
            done += 1
        except Exception as error:  # noqa: BLE001
            raised += 1
            assert not isinstance(error, fric.InternalError), (seed, number, name, arguments)
            if isinstance(error, fric.RunError):
                s.reset()
                s.state = [0.0, 0.0]
                s["u"] = 0.0
    print(f"seed {seed}: {done} calls done, {raised} refused")
    assert done > 100 and raised > 100
