"""The outcome of a suite: cases that pass, deviations with their reason, and tables, as a file for the runner."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class CommandLine(NamedTuple):
    """The command line of a suite: the file to write, and the interpreter of a second environment."""

    out: Path
    beside: str | None


def command_line() -> CommandLine:
    """The arguments that the suite was started with."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--beside", help="a Python interpreter with the packages of the second environment")
    arguments = parser.parse_args()
    return CommandLine(arguments.out, arguments.beside)


class Outcome:
    """Collects the results of one suite.

    Attributes:
        version: Versions of the packages that are compared with.
        cases: Number of cases so far.
        passed: Number of those that passed.
    """

    def __init__(self, version: str):
        self.version, self.cases, self.passed = version, 0, 0
        self._deviations: list[dict[str, str]] = []
        self._left_out: list[dict[str, str | int]] = []
        self._tables: list[dict[str, object]] = []

    def case(self, name: str, passed: bool, reason: str = "") -> None:
        """Count a case; one that does not pass is a deviation, an unexplained one where no reason is arguments."""
        self.cases += 1
        self.passed += bool(passed)
        if not passed:
            self._deviations.append({"case": name, "reason": reason})
            print(f"  deviation: {name}{': ' + reason if reason else ' (unexplained)'}", flush=True)

    def close(self, name: str, difference: float, allowed: float, reason: str = "") -> None:
        """Count a case that passes where a difference is no larger than is allowed."""
        shown = f"{name}: {difference:.1e}, allowed {allowed:.0e}"
        self.case(shown, bool(difference <= allowed), reason)

    def left_out(self, what: str, count: int, reason: str) -> None:
        """Cases of the other project that do not apply here."""
        self._left_out.append({"what": what, "count": count, "reason": reason})

    def table(self, title: str, head: Sequence[str], rows: Sequence[Sequence[object]], note: str = "") -> None:
        """A table for the page."""
        cells = [[str(cell) for cell in row] for row in rows]
        self._tables.append({"title": title, "head": list(head), "rows": cells, "note": note})

    def write(self, path: Path) -> None:
        """Write everything to a file, as JSON."""
        outcome = {
            "version": self.version,
            "cases": self.cases,
            "passed": self.passed,
            "deviations": self._deviations,
            "left_out": self._left_out,
            "tables": self._tables,
        }
        path.write_text(json.dumps(outcome), encoding="utf-8")
