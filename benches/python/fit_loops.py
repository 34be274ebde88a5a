"""What users would take beside the fits of fric: `benches/fits.rs` runs it, with the folder of `moved.csv`.

Prints times in s: of a run of a moved LuGre contact by a loop of numba, with an exponential step from row to row; and of a
Jacobian of a body that is pulled over such a contact for 30 s, four unknowns and 1,501 rows, made in four ways:

- nine runs by a classical Runge-Kutta loop of numba, with steps as long as they may be for an error of a tenth of the noise
  (2 mm);
- nine runs by LSODA of SciPy, with rates by numba, tol 1e-8;
- forward sensitivities by CVODES of CasADi, tol 1e-6, and tol 1e-8.

`nan` where a library is missing.
"""

import math
import sys
import time

import numpy as np
from numba import njit

CONTACT = (1e5, 316.0, 0.4, 1.0, 1.5, 1e-3)


@njit
def moved(v, h, sigma0, sigma1, sigma2, fc, fs, vs):
    out = np.empty(v.size)
    z = 0.0
    for k in range(v.size):
        g = fc + (fs - fc) * math.exp(-((v[k] / vs) ** 2))
        out[k] = sigma0 * z + sigma1 * (v[k] - sigma0 * abs(v[k]) / g * z) + sigma2 * v[k]
        if k + 1 < v.size:
            w = 0.5 * (v[k] + v[k + 1])
            g = fc + (fs - fc) * math.exp(-((w / vs) ** 2))
            a = sigma0 * abs(w) / g
            z = z * math.exp(-a * h) - w * math.expm1(-a * h) / a if a * h > 1e-12 else z + w * h
    return out


@njit
def rates(t, x, v, z, sigma0, sigma1, sigma2, fc, fs, vs):
    g = fc + (fs - fc) * math.exp(-((v / vs) ** 2))
    dz = v - sigma0 * abs(v) / g * z
    return v, 2.0 * (0.1 * t - x) - (sigma0 * z + sigma1 * dz + sigma2 * v), dz


@njit
def pulled(h, every, rows, sigma0, sigma1, sigma2, fc, fs, vs):
    out = np.empty(rows)
    x = v = z = 0.0
    for row in range(rows):
        out[row] = x
        for k in range(every):
            t = (row * every + k) * h
            a = rates(t, x, v, z, sigma0, sigma1, sigma2, fc, fs, vs)
            b = rates(t + h / 2, x + h / 2 * a[0], v + h / 2 * a[1], z + h / 2 * a[2], sigma0, sigma1, sigma2, fc, fs, vs)
            c = rates(t + h / 2, x + h / 2 * b[0], v + h / 2 * b[1], z + h / 2 * b[2], sigma0, sigma1, sigma2, fc, fs, vs)
            d = rates(t + h, x + h * c[0], v + h * c[1], z + h * c[2], sigma0, sigma1, sigma2, fc, fs, vs)
            x += h / 6 * (a[0] + 2 * b[0] + 2 * c[0] + d[0])
            v += h / 6 * (a[1] + 2 * b[1] + 2 * c[1] + d[1])
            z += h / 6 * (a[2] + 2 * b[2] + 2 * c[2] + d[2])
    return out


def best(call, repetitions):
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        call()
        times.append(time.perf_counter() - begin)
    return min(times)


def by_lsoda(times):
    """Nine runs by SciPy."""
    try:
        from scipy.integrate import odeint
    except ImportError:
        return float("nan")

    @njit
    def f(y, t, *contact):
        return np.array(rates(t, y[0], y[1], y[2], *contact))

    def run():
        return odeint(f, np.zeros(3), times, args=CONTACT, rtol=1e-8, atol=1e-10, mxstep=100_000)

    run()
    return best(lambda: [run() for _ in range(9)], 2)


def by_cvodes(times, tol):
    """Forward sensitivities of four parameters by CasADi."""
    try:
        import casadi
    except ImportError:
        return float("nan")
    x, p, t = casadi.MX.sym("x", 3), casadi.MX.sym("p", 4), casadi.MX.sym("t")
    sigma0, fc, fs, vs = casadi.vertsplit(p)
    g = fc + (fs - fc) * casadi.exp(-((x[1] / vs) ** 2))
    dz = x[1] - sigma0 * casadi.fabs(x[1]) / g * x[2]
    dv = 2.0 * (0.1 * t - x[0]) - (sigma0 * x[2] + CONTACT[1] * dz + CONTACT[2] * x[1])
    how = {"reltol": tol, "abstol": 1e-3 * tol, "max_num_steps": 1_000_000}
    made = casadi.integrator("run", "cvodes", {"x": x, "t": t, "p": p, "ode": casadi.vertcat(x[1], dv, dz)}, 0.0, times, how)
    values = casadi.MX.sym("values", 4)
    found = made(x0=casadi.DM.zeros(3), p=values)["xf"][0, :]
    jacobian = casadi.Function("jacobian", [values], [casadi.jacobian(found, values)])
    point = [CONTACT[0], CONTACT[3], CONTACT[4], CONTACT[5]]
    try:
        jacobian(point)
    except RuntimeError as error:
        print(f"CasADi, tol {tol:g}: {error}", file=sys.stderr)
        return float("nan")
    return best(lambda: jacobian(point), 2)


def main():
    v = np.loadtxt(sys.argv[1] + "/moved.csv", delimiter=",", skiprows=1, usecols=1)
    moved(v, 1e-3, *CONTACT)
    run = best(lambda: moved(v, 1e-3, *CONTACT), 50)
    exact = pulled(5e-6, 4000, 1501, *CONTACT)
    every = next(
        n
        for n in (100, 200, 250, 300, 400, 500, 700, 1000, 2000)
        if np.sqrt(np.mean((pulled(0.02 / n, n, 1501, *CONTACT) - exact) ** 2)) < 2e-4
    )
    jacobian = best(lambda: [pulled(0.02 / every, every, 1501, *CONTACT) for _ in range(9)], 3)
    times = np.linspace(0, 30, 1501)
    print(run, jacobian, by_lsoda(times), by_cvodes(times, 1e-6), by_cvodes(times, 1e-8))


main()
