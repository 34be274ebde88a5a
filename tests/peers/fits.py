"""What SciPy's `least_squares` and lmfit find in recordings of a moved contact, for the tests of `fric fit` in
`tests/fits.rs`.

python3 -m venv target/scipy && target/scipy/bin/pip install scipy==1.17.1 numba==0.68.1 lmfit==1.3.4
target/scipy/bin/python tests/peers/fits.py > tests/peers/fits.txt

The recordings are those of `tests/support/moved_contact.rs`, with white noise of 5 mN. The model is integrated by 320
exponential steps from row to row: half as many move no value by 2e-4 of its standard deviation. Each line: who, seed,
then value and standard deviation of each parameter. `huber` is SciPy with loss="huber" on recordings of which a twentieth
are outliers of twenty standard deviations; the scale is that of the median, until it settles, and the covariance that of
Huber, Robust Statistics (1981), sec. 7.6.
"""

import numpy as np
from math import cos, exp, expm1, log, pi, sin, sqrt
from lmfit import Parameters, minimize
from numba import njit
from scipy.optimize import least_squares

TRUE = np.array([1e5, 316.0, 0.4, 1.0, 1.5, 1e-3])
NOISE = 5e-3
SUBSTEPS = 320


class Chance:
    """SplitMix64."""

    def __init__(self, seed):
        self.state = seed

    def fraction(self):
        mask = (1 << 64) - 1
        self.state = (self.state + 0x9E3779B97F4A7C15) & mask
        z = self.state
        z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
        z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
        return ((z ^ (z >> 31)) >> 11) / (1 << 53)

    def normal(self):
        a, b = 1.0 - self.fraction(), self.fraction()
        return sqrt(-2.0 * log(a)) * cos(2.0 * pi * b)


def velocity(t):
    if t < 1.0:
        slow = 2 * pi * 4.0 * 4e-6 * cos(2 * pi * 4.0 * t)
    elif t < 2.0:
        slow = 2e-3 * sin(2 * pi * 2.0 * t)
    else:
        slow = 50e-3 * sin(pi * (t - 2.0))
    return slow + 2 * pi * 60.0 * 1e-6 * cos(2 * pi * 60.0 * t)


V = np.array([velocity(1e-3 * k) for k in range(4002)])


@njit
def force(p, v, parts):
    """Force at the rows of a velocity that is linear between them."""
    sigma0, sigma1, sigma2, fc, fs, vs = p
    out = np.empty(len(v) - 1)
    h, z = 1e-3 / parts, 0.0
    for k in range(len(v) - 1):
        rate = sigma0 * abs(v[k]) / (fc + (fs - fc) * exp(-((v[k] / vs) ** 2)))
        out[k] = sigma0 * z + sigma1 * (v[k] - rate * z) + sigma2 * v[k]
        for i in range(parts):
            w = v[k] + (v[k + 1] - v[k]) * (i + 0.5) / parts
            a = sigma0 * abs(w) / (fc + (fs - fc) * exp(-((w / vs) ** 2)))
            z = z * exp(-a * h) - w * expm1(-a * h) / a if a * h > 1e-12 else z + w * h
    return out


def problem(data, parts):
    """Residuals in logarithms of the parameters, and their derivatives."""
    residuals = lambda x: force(np.exp(x), V, parts) - data

    def jacobian(x):
        d = 1e-5
        one = lambda k: (residuals(x + d * np.eye(6)[k]) - residuals(x - d * np.eye(6)[k])) / (2 * d)
        return np.stack([one(k) for k in range(6)], 1)

    return residuals, jacobian


EXACT = dict(x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)


def fitted(data, parts):
    """Values and standard deviations."""
    residuals, jacobian = problem(data, parts)
    found = least_squares(residuals, np.log(TRUE), jac=jacobian, **EXACT)
    variance = found.fun @ found.fun / (len(data) - 6)
    return np.exp(found.x), np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * variance) * np.exp(found.x)


def by_lmfit(data, parts):
    residuals, jacobian = problem(data, parts)
    names = ["sigma0", "sigma1", "sigma2", "Fc", "Fs", "vs"]
    start = Parameters()
    for name, true in zip(names, TRUE):
        start.add(name, value=log(true))
    of = lambda p: np.array([p[name].value for name in names])
    found = minimize(
        lambda p: residuals(of(p)), start, Dfun=lambda p: jacobian(of(p)), xtol=1e-14, ftol=1e-14, gtol=1e-14
    )
    x = of(found.params)
    return np.exp(x), np.array([found.params[name].stderr for name in names]) * np.exp(x)


def by_huber(data, parts):
    residuals, jacobian = problem(data, parts)
    scale = lambda x: np.median(np.abs(residuals(x))) / 0.6744897501960817
    x = np.log(fitted(data, parts)[0])
    for _ in range(10):
        s = scale(x)
        x = least_squares(residuals, x, jac=jacobian, loss="huber", f_scale=1.345 * s, **EXACT).x
    z, n, p = residuals(x) / s, len(data), 6
    within = np.mean(np.abs(z) <= 1.345)
    square = np.mean(np.clip(z, -1.345, 1.345) ** 2) * n / (n - p) * (1 + p / n * (1 - within) / within) ** 2
    j = jacobian(x) / s
    return np.exp(x), np.sqrt(np.diag(np.linalg.inv(j.T @ j)) * square) / within * np.exp(x)


def outlier(chance):
    """Twenty standard deviations of either sign in a twentieth of the rows."""
    if chance.fraction() < 0.05:
        return 20.0 * NOISE * (1.0 if chance.fraction() < 0.5 else -1.0)
    return 0.0


def shown(who, seed, value, sd):
    print(who, seed, *(f"{x:.10e}" for pair in zip(value, sd) for x in pair))


exact = force(TRUE, V, 20)
for seed in range(3):
    chance = Chance(seed)
    data = exact + np.array([NOISE * chance.normal() for _ in exact])
    value, sd = fitted(data, SUBSTEPS)
    coarse, _ = fitted(data, SUBSTEPS // 2)
    assert np.all(np.abs(coarse - value) < 2e-4 * sd), np.abs(coarse - value) / sd
    shown("scipy", seed, value, sd)
    shown("lmfit", seed, *by_lmfit(data, SUBSTEPS))
    chance = Chance(seed)
    data = exact + np.array([NOISE * chance.normal() + outlier(chance) for _ in exact])
    shown("huber", seed, *by_huber(data, SUBSTEPS))
