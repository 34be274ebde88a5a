"""What SciPy's `least_squares` finds in recordings of a moved contact, for the test of `fric fit` in `tests/fits.rs`.

python3 -m venv target/scipy && target/scipy/bin/pip install scipy==1.17.1 numba==0.68.1
target/scipy/bin/python tests/peers/fits.py > tests/peers/fits.txt

The recordings are those of `tests/support/moved_contact.rs`, with white noise of 5 mN. The model is integrated by 320
exponential steps from row to row: half as many move no value by 2e-4 of its standard deviation. Each line: seed, then
value and standard deviation of each parameter.
"""

import numpy as np
from math import cos, exp, expm1, log, pi, sin, sqrt
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


def fitted(data, parts):
    """Values and standard deviations, in logarithms."""
    residuals = lambda x: force(np.exp(x), V, parts) - data

    def jacobian(x):
        d = 1e-5
        one = lambda k: (residuals(x + d * np.eye(6)[k]) - residuals(x - d * np.eye(6)[k])) / (2 * d)
        return np.stack([one(k) for k in range(6)], 1)

    found = least_squares(residuals, np.log(TRUE), jac=jacobian, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
    variance = found.fun @ found.fun / (len(data) - 6)
    return np.exp(found.x), np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)) * variance) * np.exp(found.x)


exact = force(TRUE, V, 20)
for seed in range(3):
    chance = Chance(seed)
    data = exact + np.array([NOISE * chance.normal() for _ in exact])
    value, sd = fitted(data, SUBSTEPS)
    coarse, _ = fitted(data, SUBSTEPS // 2)
    assert np.all(np.abs(coarse - value) < 2e-4 * sd), np.abs(coarse - value) / sd
    print(seed, *(f"{x:.10e}" for pair in zip(value, sd) for x in pair))
