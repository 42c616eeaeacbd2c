"""Runs a page of the documentation as a user would, from a folder with nothing in it.

Each page runs in one process, `tools/run_page.py`, with the environment of a user and no setting of the tests; the
`examples` and the `gallery` of a checkout are there where the page says that it needs one.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from run_page import Block, blocks

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMPILER = re.compile(r"(.*-)?(cc|gcc|g\+\+|c\+\+|clang|clang\+\+|tcc|c89|c99|cpp|zig|icx)(-[\d.]+)?")


def runnable(page: Path) -> list[Block]:
    return [block for block in blocks(page.read_text(encoding="utf-8")) if runs(block)]


def runs(block: Block) -> bool:
    code = block.language == "python" and not block.title
    return not block.reason and (code or block.language in ("bash", "toml"))


EXECUTED = [page for page in PAGES if runnable(page)]
WITH_COMMANDS = [page for page in EXECUTED if any(block.language == "bash" for block in runnable(page))]
WITH_LONG_BLOCKS = [page for page in EXECUTED if any(block.long for block in runnable(page))]


def over(pages: list[Path]) -> pytest.MarkDecorator:
    """Over pages, each of which any process may run."""
    cases = [pytest.param(page, marks=pytest.mark.xdist_group(page.name), id=page.name) for page in pages]
    return pytest.mark.parametrize("page", cases)


def environment(home: Path, path: str) -> dict[str, str]:
    """All that a fresh account has. Which covariant is tried is the only thing that comes from outside."""
    own = {"PATH": path, "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), "LANG": "C.UTF-8"}
    return own | {name: os.environ[name] for name in ("PYTHONPATH",) if name in os.environ}


def run(page: Path, work: Path, home: Path, path: str, *options: str, **settings: str) -> None:
    """Run a page in an empty folder; fails with what its blocks print where one fails."""
    command = [sys.executable, ROOT / "tools" / "run_page.py", page, *options]
    run_program(command, work, home, path, needs_checkout(page), settings)


def run_program(command: list, work: Path, home: Path, path: str, checkout: bool, settings: dict[str, str]) -> None:
    if checkout:
        for name in ("examples", "gallery"):
            shutil.copytree(ROOT / name, work / name, ignore=shutil.ignore_patterns("out", "__pycache__"))
    bin_folder = Path(sys.executable).parent
    done = subprocess.run(
        command,
        cwd=work,
        env=environment(home, f"{bin_folder}{os.pathsep}{path}") | settings,
        capture_output=True,
        text=True,
        check=False,
    )
    print(done.stdout)
    assert done.returncode == 0, done.stdout.rpartition(" blocks failed")[2] + done.stderr


def needs_checkout(page: Path) -> bool:
    return any(re.search(r"\b(examples|gallery)/", block.text) for block in runnable(page))
