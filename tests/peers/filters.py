"""What SciPy makes of random recordings, for the test of `compiler/src/experiment/filters.rs`.

python3 -m venv target/scipy && target/scipy/bin/pip install scipy==1.17.1
target/scipy/bin/python tests/peers/filters.py > tests/peers/filters.txt

Each case has three lines: the filter with its parameter, the recording, and what comes out.
"""

import numpy
from scipy.signal import butter, decimate, filtfilt, savgol_filter, sosfiltfilt

chance = numpy.random.default_rng(26)


def recording(rows):
    """A walk on a slope: its ends are far from 0, and it has all frequencies."""
    return numpy.round(5.0 + 0.3 * numpy.arange(rows) + numpy.cumsum(chance.normal(size=rows)), 6)


def show(name, parameter, x, y):
    print(name, parameter)
    for numbers in (x, y):
        print(" ".join(repr(float(number)) for number in numbers))


for corner, rows in [(0.5, 16), (0.12, 60), (0.9, 40), (0.02, 90)]:
    x = recording(rows)
    y = sosfiltfilt(butter(4, corner, output="sos"), x)
    if corner > 0.1:  # The polynomials of a low corner are ill-conditioned.
        assert numpy.allclose(y, filtfilt(*butter(4, corner), x), rtol=1e-9)
    show("smooth", corner, x, y)
for n, rows in [(2, 28), (3, 61), (5, 80), (10, 101)]:
    x = recording(rows)
    show("thin", n, x, decimate(x, n, ftype="iir", zero_phase=True))
for interval, rows in [(0.25, 2), (0.001, 30)]:
    x = recording(rows)
    y = numpy.gradient(x, interval)
    if rows > 2:
        assert numpy.allclose(y[1:-1], savgol_filter(x, 3, 2, deriv=1, delta=interval)[1:-1])
    show("slope", interval, x, y)
