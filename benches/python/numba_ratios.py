"""Speed of fric in Python beside numba: LuGre by Euler's method, in one process, with the same inputs.

    pip install ./python numba
    python benches/python/numba_ratios.py

Ratios of processor time, below 1 is faster than numba's `@njit`; the best of some repetitions in turn, one thread. Needs
an idle machine and a wheel of the profile `release`. Fails if a bar is missed.
"""

import math
import sys
import time

import numpy as np
from numba import njit

import fric

H = 1e-5
SIGMA0, SIGMA1, SIGMA2, FC, FS, VS = 1e5, 316.0, 0.4, 1.0, 1.5, 1e-3


def python_step(z, v):
    g = FC + (FS - FC) * math.exp(-((v / VS) ** 2))
    dz = v - SIGMA0 * abs(v) / g * z
    z += H * dz
    dz = v - SIGMA0 * abs(v) / g * z
    return z, SIGMA0 * z + SIGMA1 * dz + SIGMA2 * v


step = njit(python_step)


@njit
def hold(z, v, n):
    f = 0.0
    for _ in range(n):
        z, f = step(z, v)
    return z, f


@njit
def follow(z, rows):
    out = np.empty_like(rows)
    for k in range(rows.size):
        z, out[k] = step(z, rows[k])
    return z, out


@njit
def follow_many(z, rows):
    out = np.empty_like(rows)
    for i in range(rows.shape[0]):
        x = z[i]
        for k in range(rows.shape[1]):
            x, out[i, k] = step(x, rows[i, k])
        z[i] = x
    return out


def jax_scan():
    """The same steps of many instances by `jax.lax.scan` in doubles; none where jax is not installed."""
    try:
        import jax
    except ImportError:
        return None
    jax.config.update("jax_enable_x64", True)
    jnp = jax.numpy

    def body(z, v):
        g = FC + (FS - FC) * jnp.exp(-((v / VS) ** 2))
        a = SIGMA0 * jnp.abs(v) / g
        z = z + H * (v - a * z)
        return z, SIGMA0 * z + SIGMA1 * (v - a * z) + SIGMA2 * v

    return jax.jit(lambda z, rows: jax.lax.scan(body, z, rows.T)[1].T)


def best(repetitions, *calls):
    """The least processor time of each call in s, measured in turn."""
    least = [math.inf] * len(calls)
    for call in calls:
        call()
    for _ in range(repetitions):
        for k, call in enumerate(calls):
            begin = time.process_time()
            call()
            least[k] = min(least[k], time.process_time() - begin)
    return least


def report(name, bar, per, ours, theirs, whom="numba"):
    """One line of the table; whether the bar is met."""
    ratio = ours / theirs
    fine = ratio <= bar
    print(f"{name:<28} {1e9 * ours / per:8.1f} ns {1e9 * theirs / per:8.1f} ns  {ratio:5.2f}  <= {bar:.2f} of {whom}"
          f"{'' if fine else '  MISSED'}")
    return fine


def main():
    model = fric.model("LuGre", vd="inf", sigma1=SIGMA1, sigma2=SIGMA2)
    start = {"step": H, "method": "euler"}
    rows = 2e-3 * np.sin(np.arange(200_000) * 1e-3)
    s = model.start(**start)
    ours, theirs = s.follow(rows), follow(0.0, rows)[1]
    error = np.abs(ours - theirs).max()
    assert error < 1e-9, f"both make the same steps: they differ by {error}"
    print(f"{'':<28} {'fric':>11} {'other':>11}  ratio  bar")
    fine = []
    a, b = best(7, lambda: s.follow(rows), lambda: follow(0.0, rows))
    fine.append(report("follow, 200,000 inputs", 0.7, rows.size, a, b))
    n = 2000

    def held(of):
        def loop():
            for _ in range(n):
                of()
        return loop

    a, b = best(7, held(lambda: s.hold(100, 1e-3)), held(lambda: hold(0.0, 1e-3, 100)))
    fine.append(report("hold(100)", 0.55, 100 * n, a, b))

    def ours_loop():
        call = s.step
        for _ in range(100_000):
            call(1e-3)

    def numba_loop():
        z, call = 0.0, step
        for _ in range(100_000):
            z, _f = call(z, 1e-3)

    def python_loop():
        z, call = 0.0, python_step
        for _ in range(100_000):
            z, _f = call(z, 1e-3)

    a, b, c = best(7, ours_loop, numba_loop, python_loop)
    fine.append(report("step from a loop", 0.3, 1e5, a, b))
    fine.append(report("step from a loop", 0.4, 1e5, a, c, "pure Python"))
    many = 2e-3 * np.sin(np.arange(1024 * 500) * 1e-3).reshape(1024, 500)
    batch, out, z = model.batch(1024, **start), np.empty((1024, 500)), np.zeros(1024)
    a, b = best(7, lambda: batch.follow(many, out=out), lambda: follow_many(z, many))
    fine.append(report("batch.follow, 1,024 x 500", 0.3, many.size, a, b))
    scan = jax_scan()
    if scan is None:
        print("jax is not installed: no ratio to it")
    else:
        error = np.abs(np.asarray(scan(np.zeros(1024), many)) - model.batch(1024, **start).follow(many)).max()
        assert error < 1e-9, f"jax makes the same steps: they differ by {error}"
        a, b = best(7, lambda: batch.follow(many, out=out), lambda: scan(np.zeros(1024), many).block_until_ready())
        fine.append(report("batch.follow, 1,024 x 500", 0.3, many.size, a, b, "jax 64-bit"))
    begin = time.perf_counter()
    fric.model("LuGre").start(step=H).step(1e-3)
    print(f"first step from the text: {1e3 * (time.perf_counter() - begin):.1f} ms (bar 5 ms)")
    sys.exit(not all(fine))


if __name__ == "__main__":
    main()
