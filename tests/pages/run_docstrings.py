"""Run the examples in the docstrings of modules, as a user's Python runs them, in a folder that may be written to.

    python run_docstrings.py covariant.observers.base._gate covariant.observers.wrappers._gated

Exit status 1 where a result is not the one shown; what was printed says which.
"""

import doctest
import importlib
import sys

HOW = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE

if __name__ == "__main__":
    results = [doctest.testmod(importlib.import_module(name), optionflags=HOW) for name in sys.argv[1:]]
    sys.exit(any(result.failed or not result.attempted for result in results))
