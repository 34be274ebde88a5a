"""Times the servo and stick-slip of docs/machine-code.md ("Beside other tools") by fric and by what users would take instead.

    python3 -m venv target/others
    target/others/bin/pip install numpy scipy numba casadi scikit-sundae pydiffsol
    cargo build --release
    target/others/bin/python benches/others/compare.py

All tools do the same work in one run of this script, in turn, on one processor: a tool that is not installed is named and left
out. Times are medians; `first` includes what a tool compiles when it is first called, `again` does not. Of `fric run` the
first is the time from the text to the answer, without the start of the process, and the other that of the run.

Fixed steps: 20 s of the PID servo with LuGre friction at 10 µs; errors are distances of the final position from that of
the C. Adaptive steps: 20 s of stick-slip; each tool takes the loosest of its tolerances 1e-3, 1e-4 … 1e-12 with which the
final position is within 1e-6 m of the reference, an implicit Runge-Kutta run (Radau) at 1e-12.
"""

import contextlib
import ctypes
import json
import math
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
FRIC = pathlib.Path(os.environ.get("FRIC", ROOT / "target/release/fric"))
STEPS, H = 2_000_000, 1e-5
# r, m, sigma0, sigma1, sigma2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max
PARAMS = [1.0, 1.0, 1e5, 316.0, 0.4, 1.0, 1.5, 1e-3, 3.0, 0.75, 2.0, 200.0, 0.5, 20.0]
NEAR = 1e-6
TOLERANCES = [10.0**-k for k in range(3, 13)]

SERVO = """import std.plant

experiment e {
  run    Servo(r = 1 m) for 20 s
  solver METHOD step 10 us
  expect final(x) > 0 m
}
"""
PULL = """import std.plant

experiment e {
  run    Pull() for 20 s
  solver adaptive tol TOL
  expect final(x) > 0 m
}
"""


def seconds(work, times):
    """The result of the first call, its time, and the median of that many more."""
    begun = time.perf_counter()
    result = work()
    first = time.perf_counter() - begun
    again = []
    for _ in range(times):
        begun = time.perf_counter()
        result = work()
        again.append(time.perf_counter() - begun)
    return result, first, statistics.median(again)


def gcc(source, *flags):
    library = pathlib.Path(FOLDER) / (source.stem + ".so")
    subprocess.run(["gcc", "-O3", "-march=native", "-shared", "-fPIC", *flags, "-o", library, source, "-lm"], check=True)
    return ctypes.CDLL(str(library))


def doubles(values):
    return (ctypes.c_double * len(values))(*values)


# Fixed steps: each returns a function that makes all steps and returns the final position.


def of_gcc(method):
    library = gcc(ROOT / "benches/servo.c")
    function = getattr(library, method)
    function.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double, ctypes.c_uint64]
    params = doubles(PARAMS)

    def run():
        state = doubles([0.0] * 6)
        function(state, params, H, STEPS)
        return state[0]

    return run


def of_numba(method):
    import numba

    r, m, sigma0, sigma1, sigma2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max = PARAMS

    @numba.njit(error_model="numpy")
    def slopes(x0, x1, x2, x3, x4):
        e = r - x0
        raw = Kp * e + x3 - Kp * N * (x0 - x4)
        u = min(max(raw, -u_max), u_max)
        ratio = x1 / vs
        g = Fc + (Fs - Fc) * math.exp(-(ratio * ratio))
        dz = x1 - sigma0 * abs(x1) / g * x2
        F = sigma0 * x2 + sigma1 * dz + sigma2 * x1
        return x1, (u - F) / m, dz, Kp / Ti * e + (u - raw) / Tt, N / Td * (x0 - x4)

    @numba.njit(error_model="numpy")
    def moved(x, h, k):
        return x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4]

    @numba.njit(error_model="numpy")
    def euler(count, h):
        x = (0.0, 0.0, 0.0, 0.0, 0.0)
        for _ in range(count):
            x = moved(x, h, slopes(x[0], x[1], x[2], x[3], x[4]))
        return x[0]

    @numba.njit(error_model="numpy")
    def rk4(count, h):
        x = (0.0, 0.0, 0.0, 0.0, 0.0)
        for _ in range(count):
            k1 = slopes(x[0], x[1], x[2], x[3], x[4])
            y = moved(x, h / 2, k1)
            k2 = slopes(y[0], y[1], y[2], y[3], y[4])
            y = moved(x, h / 2, k2)
            k3 = slopes(y[0], y[1], y[2], y[3], y[4])
            y = moved(x, h, k3)
            k4 = slopes(y[0], y[1], y[2], y[3], y[4])
            x = moved(moved(moved(moved(x, h / 6, k1), h / 3, k2), h / 3, k3), h / 6, k4)
        return x[0]

    function = euler if method == "euler" else rk4
    return lambda: function(STEPS, H)


def of_casadi(method):
    import casadi

    r, m, sigma0, sigma1, sigma2, Fc, Fs, vs, Kp, Ti, Td, N, Tt, u_max = PARAMS
    x = casadi.SX.sym("x", 5)
    e = r - x[0]
    raw = Kp * e + x[3] - Kp * N * (x[0] - x[4])
    u = casadi.fmin(casadi.fmax(raw, -u_max), u_max)
    g = Fc + (Fs - Fc) * casadi.exp(-((x[1] / vs) ** 2))
    dz = x[1] - sigma0 * casadi.fabs(x[1]) / g * x[2]
    F = sigma0 * x[2] + sigma1 * dz + sigma2 * x[1]
    f = casadi.Function(
        "f", [x], [casadi.vertcat(x[1], (u - F) / m, dz, Kp / Ti * e + (u - raw) / Tt, N / Td * (x[0] - x[4]))]
    )
    if method == "euler":
        after = x + H * f(x)
    else:
        k1 = f(x)
        k2 = f(x + H / 2 * k1)
        k3 = f(x + H / 2 * k2)
        k4 = f(x + H * k3)
        after = x + H / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    step = casadi.Function("servo_step", [x], [after])
    source = pathlib.Path(FOLDER) / f"casadi_{method}.c"
    with contextlib.chdir(FOLDER):
        step.generate(source.name)
    # The loop is in C too, and the generated function is in its sight.
    with open(source, "a") as text:
        text.write(
            "\nvoid all(double *x, unsigned long long count) {\n"
            f"  double y[5];\n  const double *in[{1 + step.sz_arg()}]; double *out[{1 + step.sz_res()}];\n"
            f"  casadi_int iw[{1 + step.sz_iw()}]; double w[{1 + step.sz_w()}];\n"
            "  for (; count > 0; count--) {\n    in[0] = x; out[0] = y;\n"
            "    servo_step(in, out, iw, w, 0);\n    for (int i = 0; i < 5; i++) x[i] = y[i];\n  }\n}\n"
        )
    function = gcc(source, "-fno-semantic-interposition").all
    function.argtypes = [ctypes.c_void_p, ctypes.c_uint64]

    def run():
        state = doubles([0.0] * 5)
        function(state, STEPS)
        return state[0]

    return run


def fric_run(text):
    path = pathlib.Path(FOLDER) / "text.fric"
    path.write_text(text)
    done = subprocess.run([FRIC, "run", path, "e", "--json", "--no-error"], capture_output=True, text=True)
    return json.loads(done.stdout)



# Adaptive steps: each returns a function of the tolerance that returns the final position.


def pull(t, x, v, z):
    """Slopes of stick-slip: the model Pull of std.plant."""
    g = 1.0 + 0.5 * math.exp(-((v / 1e-3) ** 2))
    dz = v - 1e5 * abs(v) / g * z
    F = 1e5 * z + 316.0 * dz + 0.4 * v
    return v, 2.0 * (0.1 * t - x) - F, dz


# Scales of the states, for absolute tolerances.
SCALES = [1.0, 0.1, 1e-5]


def numba_slopes():
    import numba
    import numpy

    inner = numba.njit(error_model="numpy")(pull)

    @numba.njit(error_model="numpy")
    def slopes(t, y):
        dx, dv, dz = inner(t, y[0], y[1], y[2])
        return numpy.array([dx, dv, dz])

    return slopes


def of_scipy(method):
    import numpy
    from scipy.integrate import solve_ivp

    slopes = numba_slopes()

    def run(tol):
        atol = tol * numpy.array(SCALES)
        found = solve_ivp(slopes, (0.0, 20.0), [0.0, 0.0, 0.0], method=method, rtol=tol, atol=atol)
        return found.y[0, -1] if found.success else math.nan

    return run


def of_cvode():
    import numpy
    from sksundae.cvode import CVODE

    slopes = numba_slopes()

    def rhs(t, y, yp):
        yp[:] = slopes(t, y)

    def run(tol):
        solver = CVODE(rhs, rtol=tol, atol=tol * numpy.array(SCALES), max_num_steps=1_000_000)
        found = solver.solve(numpy.array([0.0, 20.0]), numpy.array([0.0, 0.0, 0.0]))
        return found.y[-1, 0] if found.success else math.nan

    return run


def of_casadi_cvodes():
    import casadi

    x, t = casadi.SX.sym("x", 3), casadi.SX.sym("t")
    g = 1.0 + 0.5 * casadi.exp(-((x[1] / 1e-3) ** 2))
    dz = x[1] - 1e5 * casadi.fabs(x[1]) / g * x[2]
    F = 1e5 * x[2] + 316.0 * dz + 0.4 * x[1]
    ode = {"x": x, "t": t, "ode": casadi.vertcat(x[1], 2.0 * (0.1 * t - x[0]) - F, dz)}

    def run(tol):
        options = {"reltol": tol, "abstol": tol * 1e-5, "max_num_steps": 1_000_000}
        solver = casadi.integrator("solver", "cvodes", ode, 0.0, 20.0, options)
        return float(solver(x0=[0.0, 0.0, 0.0])["xf"][0])

    return run


def of_diffsol():
    import numpy
    import pydiffsol

    code = """
u_i { x = 0, v = 0, z = 0 }
g { 1.0 + 0.5 * exp(-(v / 1e-3) * (v / 1e-3)) }
r { v - 1e5 * abs(v) / g * z }
F_i { v, 2.0 * (0.1 * t - x) - (1e5 * z + 316.0 * r + 0.4 * v), r }
"""
    ode = pydiffsol.Ode(code)

    def run(tol):
        ode.rtol, ode.atol = tol, tol * 1e-5
        found = ode.solve(numpy.array([]), 20.0)
        return found.ys[0, -1]

    return run


def attempt(name, make):
    try:
        return make()
    except ImportError as missing:
        print(f"  {name}: not installed ({missing})")
    except Exception as why:  # what a tool cannot do is part of the comparison
        print(f"  {name}: {type(why).__name__}: {str(why).splitlines()[0] if str(why) else ''}")
    return None


def fixed():
    print(f"\n20 s of the servo at 10 us, {STEPS} steps: seconds; distance of the final position from that of gcc, m")
    for method in ["euler", "rk4"]:
        reference = None
        for name, make in [("gcc -O3", of_gcc), ("numba", of_numba), ("CasADi C, gcc -O3", of_casadi)]:
            run = attempt(name, lambda: make(method))
            if run is None:
                continue
            x, first, again = seconds(run, 5)
            reference = x if reference is None else reference
            print(f"  {method:<6} {name:<20} first {first:7.3f}  again {again:7.4f}  {abs(x - reference):.1e}")
        walls = [fric_run(SERVO.replace("METHOD", method)) for _ in range(6)]
        first, again = statistics.median(map(whole, walls)), statistics.median(found["wall_seconds"] for found in walls)
        error = abs(reading(walls[0]) - reference)
        print(f"  {method:<6} {'fric run':<20} first {first:7.3f}  again {again:7.4f}  {error:.1e}")


def reading(found):
    """The value of the only measure of a run."""
    (expect,) = found["expects"]
    return expect["value"]


def whole(found):
    """Seconds from the text to the answer, without the start of the process."""
    return sum(found["compile_seconds"].values()) + found["wall_seconds"]


def adaptive():
    print(f"\n20 s of stick-slip to within {NEAR} m: milliseconds; tolerance, error in m")
    radau = of_scipy("Radau")
    reference = radau(1e-12)
    tools = [
        ("scipy LSODA", lambda: of_scipy("LSODA")),
        ("scipy Radau", lambda: of_scipy("Radau")),
        ("CVODE (scikit-sundae)", of_cvode),
        ("CVODES (CasADi)", of_casadi_cvodes),
        ("diffsol", of_diffsol),
    ]
    for name, make in tools:
        run = attempt(name, make)
        if run is None:
            continue
        for tol in TOLERANCES:
            x = attempt(name, lambda: run(tol))
            if x is not None and abs(x - reference) <= NEAR:
                _, _, again = seconds(lambda: run(tol), 5)
                print(f"  {name:<24} {1e3 * again:9.3f}  {tol:.0e}  {abs(x - reference):.1e}")
                break
        else:
            print(f"  {name:<24} no tolerance reaches it")
    for tol in TOLERANCES:
        found = [fric_run(PULL.replace("TOL", f"{tol:.0e}")) for _ in range(6)]
        x = reading(found[0])
        if abs(x - reference) <= NEAR:
            for name, seconds_of in [("fric run", lambda one: one["wall_seconds"]), ("fric run, from its text", whole)]:
                wall = statistics.median(map(seconds_of, found))
                print(f"  {name:<24} {1e3 * wall:9.3f}  {tol:.0e}  {abs(x - reference):.1e}")
            break


if __name__ == "__main__":
    if not FRIC.exists():
        sys.exit(f"error: {FRIC} is missing; build it with cargo build --release")
    with tempfile.TemporaryDirectory() as FOLDER:
        fixed()
        adaptive()
