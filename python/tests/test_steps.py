"""``step``, ``hold`` and ``follow`` have the same bits, here and in another process, compiled and interpreted."""

import concurrent.futures
import copy
import gc
import multiprocessing
import pickle
import random
import threading
import time
import tracemalloc

import numpy as np
import pytest
from elsewhere import block, in_another_process, model_elsewhere

import fric
from fric import _fric


def contacts():
    """Library models with one input v, and their outputs."""
    for name in _fric.library_models():
        try:
            model = fric.model(name)
        except fric.CompileError:
            continue
        if model.outputs:
            yield model


def started(model, method, interpret=False):
    return model.start(step="0.5 ms", method=method, interpret=interpret)


def test_step_hold_and_follow_agree_for_every_model(seed):
    chance = random.Random(seed)
    count = compared = 0
    for model in contacts():
        method = chance.choice(["euler", "rk4", "expo", "implicit"])
        try:
            s = started(model, method)
        except (fric.RunError, fric.CompileError):
            continue
        names = s.inputs
        chance.shuffle(names)
        ways = [
            model.start(step="0.5 ms", method=method, inputs=names, interpret=interpret) for interpret in (False, True)
        ]
        followed, held = ways[0].copy(), ways[0].copy()
        rows = np.array([[1e-3 * chance.uniform(-1, 1) for _ in names] for _ in range(30)]).reshape(30, len(names))
        taken = []
        try:
            for row in rows:
                taken.append(ways[0].step(*row))
                assert ways[1].step(*row) == taken[-1] or np.isnan(taken[-1]).any(), (model, method)
        except fric.RunError:
            pass
        count += 1
        if names:
            try:
                found = followed.follow(rows)
            except fric.RunError as error:
                found = error.rows[: len(taken)]
            wanted = np.array(taken, dtype=float).reshape(found.shape)
            assert np.array_equal(found, wanted, equal_nan=True), (seed, model, method)
            if len(taken) == len(rows):
                assert block(followed) == block(ways[0]), (seed, model, method)
                compared += 1
        if len(taken) == len(rows):
            one = ways[0].copy()
            held = ways[0].copy()
            try:
                for _ in range(17):
                    last = one.step(*rows[0])
                assert held.hold(17, *rows[0]) == last and block(held) == block(one), (seed, model, method)
            except fric.RunError:
                pass
    print(f"seed {seed}: {count} models, {compared} of them followed to the end")
    assert count > 60 and compared > 40


def test_results_keep_the_order_that_was_given():
    text = fric.loads("model M { input a [1]  input b [1]  output p [1] = a - b  output q [1] = a * 10 }")
    s = text.model("M").start(step=1, inputs=["b", "a"], outputs=["q", "p"])
    assert s.step(1.0, 5.0) == (50.0, 4.0) and (s.inputs, s.outputs) == (["b", "a"], ["q", "p"])
    assert s.follow([[1.0, 5.0], [2, 1]]).tolist() == [[50.0, 4.0], [10.0, -1.0]]
    one = text.model("M").start(step=1, outputs=["p"])
    assert one.step(3, 2) == 1.0 and isinstance(one.step(3, 2), float)


def test_arrays_of_any_layout_are_read():
    model = fric.model("LuGre")
    v = 1e-3 * np.sin(np.arange(40.0))
    expected = model.start(step="10 us").follow(v)
    wide = np.zeros(80)
    wide[::2] = v
    odd = np.frombuffer(b"\0" + v.tobytes(), dtype=np.uint8)[1:].view(np.float64)
    for given in [
        v.reshape(40, 1), np.asfortranarray(v.reshape(40, 1)), wide[::2], v[::-1][::-1], v.tolist(), odd,
        np.ma.masked_array(v), v.astype(">f8"),
    ]:  # fmt: skip
        assert np.array_equal(model.start(step="10 us").follow(given), expected)
    assert model.start(step="10 us").follow(np.zeros(0)).shape == (0,)
    out = np.full(40, 7.0)
    assert model.start(step="10 us").follow(v, out=out) is out and np.array_equal(out, expected)


def test_state_is_read_and_written():
    text = fric.loads("model M { input u [m/s]  state x [m] = 1 m  state y = 2  dx/dt = u  dy/dt = -y / 1 s }")
    s = text.model("M").start(step="1 ms", outputs=["x", "y"])
    assert s.states == ["x", "y"] and s.state.tolist() == [1.0, 2.0]
    s.state = [3.0, 4.0]
    assert s["x"] == 3.0 and s.time == 0.0
    s.hold(10, 0.0)
    assert s.time == pytest.approx(0.01) and s["x"] == 3.0
    s["x"] = "5 m"
    assert s["x"] == 5.0
    s.reset()
    assert s.state.tolist() == [1.0, 2.0] and s.time == 0.0


def test_parameters_change_and_the_state_stays():
    model = fric.model("LuGre")
    s = model.start(step="10 us")
    s.hold(1000, 1e-3)
    before = s.copy()
    s.set(Fs="2 N", Fc=1.2)
    assert (s["Fs"], s["Fc"]) == (2.0, 1.2) and s.time == before.time
    assert s.state.tolist() == before.state.tolist()
    s["sigma2"] = 0.25
    t = model.start(step="10 us")
    t.hold(1000, 1e-3)
    assert t.step(1e-3) == before.step(1e-3)
    fresh = fric.model("LuGre", Fs="2 N", Fc=1.2, sigma2=0.25).start(step="10 us")
    fresh.state = s.state
    assert fresh.step(1e-3) == s.step(1e-3)


def test_copies_are_independent():
    s = fric.model("LuGre").start(step="10 us")
    s.hold(10, 1e-3)
    for other in (s.copy(), copy.copy(s), copy.deepcopy(s), pickle.loads(pickle.dumps(s))):
        assert block(other) == block(s) and repr(other) == repr(s)
        other.step(1.0)
        assert block(other) != block(s)


@pytest.mark.parametrize("method", ["euler", "expo"])
def test_a_pickled_instance_continues_elsewhere(method):
    model = fric.model("LuGre", Fs="1.7 N")
    s = model.start(step="10 us", method=method)
    s.hold(33, 1e-3)
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
        there = pool.submit(in_another_process, s).result()
        assert pool.submit(model_elsewhere, model).result() == model.start(step="10 us").hold(100, 1e-3)
    assert there == in_another_process(s)


def test_imports_travel_with_a_pickled_text(tmp_path):
    (tmp_path / "part.fric").write_text("model Part { input u [1]  output y [1] = 2 * u }\n")
    (tmp_path / "main.fric").write_text('import "part.fric"\nmodel M { input u [1]  part p = Part(u = u)  output y [1] = p.y }\n')
    model = fric.load(tmp_path / "main.fric").model("M")
    sent = pickle.dumps(model)
    (tmp_path / "part.fric").unlink()
    (tmp_path / "main.fric").unlink()
    assert pickle.loads(sent).start(step=1).step(2.0) == 4.0


def test_two_threads_in_one_instance_are_told():
    s = fric.model("LuGre").start(step="10 us")
    rows = np.zeros(3_000_000)
    worker = threading.Thread(target=s.follow, args=(rows,))
    s.hold(5000, 0.0)
    worker.start()
    met = 0
    while worker.is_alive():
        try:
            s.step(0.0)
        except RuntimeError as error:
            assert "borrowed" in str(error)
            met += 1
    assert met > 0, "another thread runs while a long call lets it"


def test_other_threads_run_while_a_run_goes_on():
    text = fric.loads(
        "model M { state x [m] = 0  dx/dt = 1 m/s * sin(t / 1 s) }\n"
        "experiment e { run M() for 20 s  solver rk4 step 10 us  expect final(x) > 0 m }\n"
    )
    counted = [0]
    over = threading.Event()

    def count():
        while not over.is_set():
            counted[0] += 1
            time.sleep(0.001)

    worker = threading.Thread(target=count)
    worker.start()
    before = counted[0]
    text.run("e", errors=False)
    assert counted[0] > before + 3
    over.set()
    worker.join()


def test_memory_does_not_grow():
    s = fric.model("LuGre").start(step="10 us")
    rows = np.zeros(16)

    def calls(n):
        for _ in range(n):
            s.step(1e-3)
            s.follow(rows)
            s.state

    calls(2000)
    gc.collect()
    tracemalloc.start()
    calls(2000)
    # A leak is in each of three parts; what other tests have left to be cached is in one.
    seen = []
    for _ in range(4):
        seen.append(tracemalloc.get_traced_memory()[0])
        calls(7_000)
        gc.collect()
    grown = 3 * min(after - before for before, after in zip(seen, seen[1:]))
    tracemalloc.stop()
    assert grown < 20_000, f"{grown} bytes in 20,000 calls"


def test_models_tell_their_quantities():
    model = fric.model("LuGre")
    assert model.inputs["v"].unit == "m/s" and model.outputs["F"].si == "N" and model.states["z"].unit == "µm"
    assert model.params["Fs"].default == 1.5 and model.params["Fs"].range[0] >= 0
    assert fric.model("LuGre", Fs="2 N").params["Fs"].default == 2.0
    assert "dz/dt" in model.equations and "<table>" in model._repr_html_()
    hostile = fric.loads("model M { output x [m] = 1 m /// <script>alert(1)</script>\n }").model("M")
    assert "<script>" not in hostile._repr_html_()
