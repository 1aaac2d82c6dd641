"""`calibrate`: the entry point. The verbs are in `calibrate.cli`."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Exit codes: 0 good, 1 failed, 2 usage or configuration, 3 done with loss, 4 a gate failed."""
    # Before numpy is loaded: small matrices are faster on one thread, and the same to the bit on any machine
    # with the same processor, whatever its number of cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from calibrate.cli.app import app
    from calibrate.errors import CalibrationError
    from recordings.cli.terminal import print_what_it_can
    from recordings.errors import RecordingError, printed
    from recordings.plain_text import plain_text

    print_what_it_can()
    try:
        app(prog_name="calibrate")  # the station calls it as a module
    except (CalibrationError, RecordingError) as problem:
        print(f"calibrate: {printed(problem)}", file=sys.stderr)
        sys.exit(problem.exit_code)
    except OSError as problem:  # of a full disk behind stdout, say
        where = problem.filename or "the output"
        print(plain_text(f"calibrate: {where}: {problem.strerror or problem}"), file=sys.stderr)
        sys.exit(1)
