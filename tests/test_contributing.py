"""The code of the pages on extending the library, applied to a copy of it: what they say happens, happens."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("extending.md", "extending-verbs.md")]
COPIED = (
    *("src", "tools", "docs", "benchmarks", "pyproject.toml", "mkdocs.yml", "README.md"),
    *(
        "tests/charts.py",
        "tests/conftest.py",
        "tests/test_house.py",
        "tests/house.toml",
        "tests/laws",
        "tests/geometry",
    ),
)


def followed() -> dict[str, str]:
    """What the pages make of files, by their names: each change must find its place exactly once."""
    files: dict[str, str] = {}
    for language, name, text in re.findall(r'```(\w+) title="(.+?)"\n(.*?)```', "".join(PAGES), re.DOTALL):
        if language == "python":
            assert not (ROOT / name).exists(), f"{name} is there already"
            files[name] = text
            continue
        lines = text.splitlines(keepends=True)
        assert {line[0] for line in lines} <= {" ", "+"}
        old = "".join(line[1:] for line in lines if line[0] == " ")
        present = files.get(name) or (ROOT / name).read_text(encoding="utf-8")
        assert present.count(old) == 1, f"{name} has {present.count(old)} places like this one:\n{old}"
        files[name] = present.replace(old, "".join(line[1:] for line in lines))
    return files


def test_every_change_of_the_pages_finds_its_place():
    """In the short suite, since a change of any of these files may move it."""
    assert len(followed()) > 8


@pytest.fixture(scope="module")
def house(tmp_path_factory) -> Path:
    """A copy of the project in which the pages have been followed."""
    copy = tmp_path_factory.mktemp("house")
    for name in COPIED:
        source, target = ROOT / name, copy / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
        else:
            shutil.copy(source, target)
    for name, text in followed().items():
        path = copy / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return copy


def python(house: Path, *arguments: str) -> str:
    paths = [str(house / "src"), str(house / "tools")]
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=house,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
