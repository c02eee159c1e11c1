"""The command ``neurosim``, also as ``python -m neurosim``."""

from __future__ import annotations

import os
import sys

from neurosim.base.interrupts import asked_to_end, own_process


def main() -> None:
    """Run the command line as the process's main program, which signals can end."""
    own_process()
    from neurosim.cli.main import main as command  # takes most of a second

    try:
        command()
    except SystemExit as stop:
        if not asked_to_end():
            raise
        # Threads that are still busy must not keep the process from ending.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(stop.code if isinstance(stop.code, int) else 1)


if __name__ == "__main__":
    main()
