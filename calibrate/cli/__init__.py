"""`calibrate`: the entry point of the command line."""

from __future__ import annotations

import os


def main() -> None:
    """Exit codes: 0 good, 1 failed, 2 usage or configuration, 3 done with loss, 4 a gate failed."""
    # Before numpy is loaded: small matrices are faster on one thread, and the same to the bit on any machine
    # with the same processor, whatever its number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from calibrate.cli.app import CALIBRATE
    from recordings.cli.lazy import run

    run("calibrate", CALIBRATE)
