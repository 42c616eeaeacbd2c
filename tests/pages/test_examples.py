"""Every command and every Python example of the README and the pages runs as it stands, in the place of a user.

Each page runs in one process, `tools/run_page.py`, from a folder with nothing in it but the `examples` and the
`gallery` of a checkout where the page says that it needs one. The process has the environment of a user and no setting
of the tests: the cache folder is empty when the README begins, and the pages find in it what those before them left.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from run_page import PARTS, Block, blocks

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
    return pytest.mark.parametrize("page", pages, ids=lambda p: p.name)


each_page = over(EXECUTED)


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


@pytest.fixture(scope="session")
def without_compiler(tmp_path_factory) -> str:
    """A PATH with all programs of the system but the compilers of C."""
    folder = tmp_path_factory.mktemp("bin")
    for place in filter(os.path.isdir, os.defpath.strip(":").split(os.pathsep)):
        for program in os.scandir(place):
            target = folder / program.name
            if not COMPILER.fullmatch(program.name) and not target.is_symlink():
                target.symlink_to(program.path)
    assert shutil.which("bash", path=str(folder))
    assert not any(shutil.which(name, path=str(folder)) for name in ("cc", "gcc", "clang", "tcc"))
    return str(folder)


@pytest.fixture(scope="session")
def home(tmp_path_factory) -> Path:
    """The home of a user who reads the README and then the pages."""
    return tmp_path_factory.mktemp("home")


@each_page
def test_a_page_runs_from_an_empty_folder(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath)


@pytest.mark.long
@over(WITH_LONG_BLOCKS)
def test_a_page_runs_with_its_long_blocks_too(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath, "--long")


@pytest.fixture(scope="session")
def home_without_compiler(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.mark.long
@over(WITH_COMMANDS)
def test_a_page_runs_without_a_compiler(page, tmp_path, home_without_compiler, without_compiler):
    run(page, tmp_path, home_without_compiler, without_compiler)


@pytest.mark.long
@over([page for page in WITH_COMMANDS if page.name in ("README.md", "your-log.md")])
def test_a_page_runs_without_a_cache(page, tmp_path, tmp_path_factory):
    """The two pages on which all commands of the main job are; what else commands write goes through the same cache."""
    run(page, tmp_path, tmp_path_factory.mktemp("home"), os.defpath, COVARIANT_CACHE="off")


@pytest.mark.long
@pytest.mark.parametrize("place", ["no compiler", "no cache"])
def test_the_demo_runs(place, tmp_path, tmp_path_factory, without_compiler):
    """With a compiler and a cache it is `make demo`."""
    path, settings = (without_compiler, {}) if place == "no compiler" else (os.defpath, {"COVARIANT_CACHE": "off"})
    command = [sys.executable, "gallery/demo.py", "--out", "demo"]
    run_program(command, tmp_path, tmp_path_factory.mktemp("home"), path, True, settings)
    made = {file.name for file in (tmp_path / "demo").iterdir()}
    assert made >= {"log.csv", "other.csv", "velocities.csv", "table.csv", "estimate.html", "compare.html"}


@each_page
def test_a_page_that_needs_a_checkout_says_so(page):
    prose = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not needs_checkout(page) or "checkout" in prose


def test_every_block_is_run_or_says_why_not():
    """What is not run is a part of a larger program, or has its reason above it; there are few of these."""
    reasons = []
    for page in PAGES:
        for block in blocks(page.read_text(encoding="utf-8")):
            known = block.language in ("bash", "python", "toml", "text", *PARTS)
            assert known, f"{page.name}:{block.line}: what is a block of {block.language!r}?"
            reasons += [f"{page.name}:{block.line}: {block.reason}"] if block.reason else []
            assert not block.reason or len(block.reason.split()) > 3, f"{page.name}:{block.line}: why is it not run?"
    assert len(reasons) <= 8, "\n".join(reasons)
