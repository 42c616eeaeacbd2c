"""The home of a user who reads a page, and a system without a compiler."""

import os
import shutil
from pathlib import Path

import pytest
from page_runs import COMPILER


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
    """The home of a new user, with an empty cache, who reads the pages one after the other, the README first.

    Processes that run tests beside each other share it, as two terminals of one user do.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "home"
    folder.mkdir(exist_ok=True)
    return folder
