"""The package alone: a wheel that is built from its folder passes its tests where there is no covariant."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "scalargraph"
version = "0"

[tool.hatch.build.targets.wheel]
packages = ["src/scalargraph"]
"""
ALONE = """
import importlib.util, sys
import pytest
assert importlib.util.find_spec("covariant") is None
sys.exit(pytest.main(sys.argv[1:]))
"""


def run(*arguments: str, folder: Path, **variables: str) -> str:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_of_its_folder_passes_its_tests_without_covariant(tmp_path):
    project, place = tmp_path / "project", tmp_path / "installed"
    shutil.copytree(ROOT / "src" / "scalargraph", project / "src" / "scalargraph")
    (project / "pyproject.toml").write_text(PROJECT)
    run("-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path), folder=project)
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(place)
    assert {path.name.partition("-")[0] for path in place.iterdir()} == {"scalargraph"}
    tests = tmp_path / "tests"
    shutil.copytree(Path(__file__).parent, tests, ignore=shutil.ignore_patterns("__pycache__", "long_*"))
    # Without `site`, the checkout, which is installed by a link to its sources, is on no path.
    paths = os.pathsep.join([str(place), sysconfig.get_path("purelib")])
    options = ("-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-m", "not exhaustive", "--strict-markers")
    settings = ("-o", "markers=exhaustive\ncore\nlong", "--rootdir", str(tests), str(tests))
    printed = run("-S", "-c", ALONE, *options, *settings, folder=tests, PYTHONPATH=paths, SCALARGRAPH_CACHE="off")
    assert " passed" in printed
    assert " failed" not in printed
