"""The pages with what takes long on them, without a compiler, and without a cache; the demo likewise.

What computes, and whether it is kept, is decided in one place each: a page with the main commands shows it in the long
suite. All others, and all long blocks, are exhaustive.
"""

import os
import sys

import pytest
from page_runs import WITH_COMMANDS, WITH_LONG_BLOCKS, over, run, run_program


def long_for(name, pages):
    """Over pages, all but one of them exhaustive, each of which any process may run."""
    marks = {page: [pytest.mark.xdist_group(page.name)] for page in pages}
    for page in pages:
        marks[page] += [] if page.name == name else [pytest.mark.exhaustive]
    cases = [pytest.param(page, marks=marks[page], id=page.name) for page in pages]
    return pytest.mark.parametrize("page", cases)


@pytest.mark.exhaustive
@over(WITH_LONG_BLOCKS)
def test_a_page_runs_with_its_long_blocks_too(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath, "--long")


@long_for("README.md", WITH_COMMANDS)
def test_a_page_runs_without_a_compiler(page, tmp_path, home, without_compiler):
    run(page, tmp_path, home, without_compiler)


@long_for("check.md", WITH_COMMANDS)
def test_a_page_runs_without_a_cache(page, tmp_path, home):
    run(page, tmp_path, home, os.defpath, COVARIANT_CACHE="off")


@pytest.mark.exhaustive
@pytest.mark.parametrize("place", ["no compiler", "no cache"])
def test_the_demo_runs(place, tmp_path, home, without_compiler):
    """With a compiler and a cache it is `make demo`."""
    path, settings = (without_compiler, {}) if place == "no compiler" else (os.defpath, {"COVARIANT_CACHE": "off"})
    command = [sys.executable, "gallery/demo.py", "--out", "demo"]
    run_program(command, tmp_path, home, path, True, settings)
    made = {file.name for file in (tmp_path / "demo").iterdir()}
    assert made >= {"log.csv", "other.csv", "velocities.csv", "table.csv", "estimate.html", "compare.html"}
