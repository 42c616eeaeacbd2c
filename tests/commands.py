"""Running a command as a machine or a person does."""

import base64
import gzip
import io
import json
import re
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple

import pytest

from covariant.cli import main


class Ended(NamedTuple):
    """Exit code of a command, and what it printed."""

    code: int
    out: str
    error: str


def leave(*arguments: object) -> Ended:
    """Run a command to its end."""
    out, error = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(error):
        patch.setattr(sys, "argv", ["covariant", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
    # A slow machine shows lines of progress.
    said = re.sub(r"(?m)^covariant: .*\d+ s( left)?\n", "", error.getvalue())
    return Ended(int(left.value.code or 0), out.getvalue(), said)


def command(*arguments: object) -> dict:
    """Run a command with --json and return what it prints."""
    ended = leave(*arguments, "--json")
    assert ended.code == 0, ended
    return json.loads(ended.out)


def files() -> list[Path]:
    """What lies in the current folder, which is the test's own: others write into the checkout at the same time."""
    assert not Path("pyproject.toml").exists(), "start with monkeypatch.chdir(tmp_path)"
    return sorted(path for path in Path().rglob("*") if "__pycache__" not in path.parts)


def refused(*arguments: object, named: tuple[str, ...] | list[str] = (), code: int = 2) -> str:
    """The one line by which a command refuses its input, with the words in `named`; no file comes or goes."""
    before = files()
    ended = leave(*arguments)
    assert (ended.code, ended.out) == (code, ""), ended
    assert ended.error.startswith("covariant: ")
    assert ended.error.count("\n") == 1
    assert all(part in ended.error for part in named), ended.error
    assert files() == before
    return ended.error


def unpacked(page: str, name: str) -> str:
    """What a page holds compressed, in base 85 in other letters."""
    found = re.search(rf'id="{name}" data-bytes="(\d+)">([^<]*)<', page)
    return gzip.decompress(base64.b85decode(found[2].replace(",", "<"))[: int(found[1])]).decode()
