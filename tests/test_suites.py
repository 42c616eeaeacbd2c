"""The seconds of tests, by which they are sorted into suites, are those of tests that are there."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]
TABLE = json.loads((ROOT / "tests/seconds.json").read_text(encoding="utf-8"))


def gone(names) -> list[str]:
    """Tests whose function is not in their file; which parameters they have may depend on the machine."""
    return sorted(name for name in {name.partition("[")[0] for name in names} if not _is_there(name))


def _is_there(name: str) -> bool:
    file, _, function = name.partition("::")
    path = ROOT / file
    return path.is_file() and f"def {function}(" in path.read_text(encoding="utf-8")


def test_every_test_of_the_table_of_seconds_is_there():
    """Under a new name it is in the short suite, however slow: `python tools/test_seconds.py FILE` measures it."""
    assert not gone(TABLE)


def test_a_renamed_test_is_missed():
    here = "tests/test_suites.py::test_a_renamed_test_is_missed"
    assert gone([here, f"{here}[1]", f"{here}_by_all", "tests/test_no_such.py::test_it[a]"]) == [
        "tests/test_no_such.py::test_it",
        f"{here}_by_all",
    ]
