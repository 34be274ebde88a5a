"""The command ``fric``, as ``pip install`` puts it on the path."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from fric import _fric

#: Options of a sweep that have no meaning on an engine, or are for the command itself.
_LOCAL = ("--threads", "--plot", "--shard", "--interpret", "--unit", "--join", "--plan")


def _value(arguments: list[str], *names: str) -> str | None:
    """Takes the value of an option out of the arguments."""
    for k, argument in enumerate(arguments):
        for name in names:
            if argument == name and k + 1 < len(arguments):
                value = arguments[k + 1]
                del arguments[k : k + 2]
                return value
            if name.startswith("--") and argument.startswith(f"{name}="):
                del arguments[k]
                return argument[len(name) + 1 :]
    return None


def _flag(arguments: list[str], *names: str) -> bool:
    """Takes a flag out of the arguments."""
    found = [k for k, argument in enumerate(arguments) if argument in names]
    for k in reversed(found):
        del arguments[k]
    return bool(found)


def _sweep(address: str, arguments: list[str]) -> int:
    """``fric sweep … --on ADDRESS``: the plan is made by the command, its units are sent to the engine."""
    from fric import _sweep as sweeps
    from fric.errors import SweepError

    for argument in arguments:
        option = argument.split("=", 1)[0]
        if option in _LOCAL:
            print(f"error: {option} and --on cannot be used together", file=sys.stderr)
            return 2
    keep = _value(list(arguments), "--keep") or "rows"
    out = _value(arguments, "--out", "-o") or ("sweep.json" if keep == "summary" else "sweep.csv")
    resume, quiet = _flag(arguments, "--resume"), _flag(arguments, "--quiet", "-q")
    # The errors of a sample are computed by the command on its own threads.
    _flag(arguments, "--no-error")
    with tempfile.TemporaryDirectory(prefix="fric-") as folder:
        plan = Path(folder) / "sweep.fricjob"
        code = _fric.command(["fric", *arguments, "--quiet", "--plan", str(plan)])
        if code != 0:
            return code
        try:
            sweeps._check_name(Path(out), keep)
            table = sweeps._run(
                plan.read_bytes(), Path(out), keep, address, 5.0, None, resume, None if quiet else True, 3
            )
        except KeyboardInterrupt:
            print(f"stopped: the rows that came are kept; go on with --resume", file=sys.stderr)
            return 1
        except (SweepError, ImportError, ValueError, OSError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    if not quiet:
        print(f"{len(table)} runs on {address}")
        print(table.summary, end="")
        print(f"  wrote {out}")
    return 0


def main() -> int:
    """Runs the command with the arguments of this process."""
    import signal

    arguments = sys.argv[1:]
    if arguments[:1] == ["sweep"]:
        address = _value(arguments, "--on")
        if address is not None:
            return _sweep(address, arguments)
    # As in a program without Python: a closed pipe and Ctrl-C are handled by the command.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _fric.command(["fric", *arguments])


if __name__ == "__main__":
    sys.exit(main())
