"""Measure how many seconds of a core each test takes, and keep those that take some in `tests/seconds.json`.

The suite of a test follows from it, by the seconds in `SUITES` of `tests/conftest.py`. They are those of the
processors, so that a machine that is busy measures the same as one that is not.

    python tools/test_seconds.py                         # every test; hours
    python tools/test_seconds.py tests/codegen           # those of a folder, or of what else pytest understands
    python tools/test_seconds.py -m "not exhaustive"
"""

import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "tests" / "seconds.json"
LEAST = 1.0
"""Seconds below which a test is not listed."""
LINES = "COVARIANT_TEST_SECONDS"
"""Environment variable with the file to which the tests write their seconds, for the processes that run them."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item, nextitem):
    """Write the seconds of this process and of those it started."""
    began = sum(os.times()[:4])
    result = yield
    with open(os.environ[LINES], "a", encoding="utf-8") as file:
        file.write(json.dumps([item.nodeid, sum(os.times()[:4]) - began]) + "\n")
    return result


def merged(table: dict[str, float], measured: dict[str, float], collected: set[str]) -> dict[str, float]:
    """The table with what was measured, without what is quick now or is no test any more."""
    changed = {**table, **{test: round(seconds, 1) for test, seconds in measured.items()}}
    return {test: changed[test] for test in sorted(changed) if changed[test] >= LEAST and test in collected}


def tests() -> set[str]:
    """Every test that there is."""
    listing = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return {line for line in listing.stdout.splitlines() if "::" in line}


def main() -> int:
    """Run pytest with the arguments, and write the table; returns the exit code of pytest."""
    with tempfile.TemporaryDirectory() as folder:
        lines = Path(folder, "lines")
        lines.touch()
        paths = [str(ROOT / "tools"), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, LINES: str(lines), "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        command = [sys.executable, "-m", "pytest", "-p", "test_seconds", "-n", "2", "--dist", "loadfile", *sys.argv[1:]]
        code = subprocess.run(command, cwd=ROOT, env=environment, check=False).returncode
        measured: Counter[str] = Counter()
        for line in lines.read_text(encoding="utf-8").splitlines():
            test, seconds = json.loads(line)
            measured[test] += seconds
    table = json.loads(TABLE.read_text(encoding="utf-8")) if TABLE.exists() else {}
    TABLE.write_text(
        json.dumps(merged(table, measured, tests()), indent=0, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    return code


if __name__ == "__main__":
    sys.exit(main())
