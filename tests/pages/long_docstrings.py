"""What takes long of `test_docstrings.py`."""

import subprocess
import sys
from pathlib import Path

import pytest
from test_docstrings import SOURCE

RUN = Path(__file__).with_name("run_docstrings.py")


FILES = sorted(path for package in (SOURCE, SOURCE.parent / "scalargraph") for path in package.rglob("*.py"))
WITH_EXAMPLES = [path for path in FILES if ">>>" in path.read_text(encoding="utf-8")]


def name_of(path: Path) -> str:
    parts = path.relative_to(SOURCE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(path: Path) -> str:
    package, *rest = path.relative_to(SOURCE.parent).parts
    return rest[0].removesuffix(".py") if package == "covariant" else package


@pytest.mark.exhaustive("calibration", "observers", "verbs")
@pytest.mark.parametrize("room", sorted({room_of(path) for path in WITH_EXAMPLES}))
def test_examples_show_what_they_compute(room, tmp_path):
    names = [name_of(path) for path in WITH_EXAMPLES if room_of(path) == room]
    done = subprocess.run([sys.executable, str(RUN), *names], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
