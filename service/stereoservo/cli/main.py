"""Entry point of the command line ``stereoservo``, with hardly any imports: ``stop`` has raised the stop slot before
the libraries of the commands are loaded.
"""

from __future__ import annotations

import os
import sys

from stereoservo.cli import interruption
from stereoservo.cli.early_stop import raise_stop

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: its threads cost more than they gain


def invoke(arguments: list[str]) -> int:
    """Run one command line; returns the exit code. Failures are printed, as JSON with ``--json``."""
    raised = raise_stop(arguments)
    from stereoservo.cli.dispatch import run  # typer and more, which a stop must not wait for

    return run(arguments, raised)


def _go_first() -> None:
    """Raise the priority of this process, a stop, if the account is allowed to (root, or ``nice`` in limits.conf)."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, -20)
    except OSError:
        return  # ordinary priority, as for any other command


def main() -> None:
    """Entry point of the command line."""
    interruption.install()
    if sys.argv[1:2] == ["stop"]:
        _go_first()
    sys.exit(invoke(sys.argv[1:]))


if __name__ == "__main__":
    main()
