"""The command line: `covariant init | check | fit | tune | estimate | compare | simulate | certify | …`."""

import os
import sys
import traceback

# Before numpy is loaded: a threaded BLAS slows the tiny matrices of a compiled step by orders of magnitude.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Entry point; bad input gives one line on standard error and exit code 2.

    A log that does not fit its model at all gives exit code 1. Any other exception is a bug of this library, or of a
    model that the user wrote in Python: it is shown with its traceback, and the exit code is 70.
    """
    from covariant.cli._app import app
    from covariant.cli._terminal import BUG, INTERNAL_ERROR, say
    from scalargraph.errors import InputError

    try:
        app()  # leaves by SystemExit, with code 2 when the options are wrong
    except (InputError, OSError) as error:
        if os.environ.get("COVARIANT_DEBUG"):
            raise
        say(f"covariant: {' '.join(str(error).split())}", sys.stderr)
        sys.exit(getattr(error, "exit_code", InputError.exit_code))
    except Exception:
        traceback.print_exc()
        say(f"covariant: {BUG}", sys.stderr)
        sys.exit(INTERNAL_ERROR)
