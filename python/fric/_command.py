"""The command ``fric``, as ``pip install`` puts it on the path."""

from __future__ import annotations

import sys

from fric import _fric


def main() -> int:
    """Runs the command with the arguments of this process."""
    import signal

    # As in a program without Python: a closed pipe and Ctrl-C are handled by the command.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _fric.command(["fric", *sys.argv[1:]])


if __name__ == "__main__":
    sys.exit(main())
