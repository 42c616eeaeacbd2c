"""Run the tests with the lowest and the newest packages that pyproject.toml allows, and on other versions of Python.

The environment `.venv` lies between them: it has the versions of constraints.txt. On Python 3.11 each requirement has
the lowest version that pyproject.toml allows, on 3.12 and 3.13 the newest. Each has its own environment, such as
`.venv-3.12`; a version of Python that is not on this machine is left out, with a line that says so.

    python tools/matrix.py            # the tests of `make test` and the gallery
    python tools/matrix.py --short    # forms of jaxprs, a certificate, the README, the demo; on the newest Python only

Without `--short`, each environment also resolves `.[all]` with LeRobot, whose requirements have narrow bounds, and
installs nothing.
"""

import argparse
import os
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
LOWEST = "3.11-lowest"
ENVIRONMENTS = (LOWEST, "3.12", "3.13")
INSTALL = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--upgrade", "-e", ".[dev]")
RESOLVE = "python -m pip install --dry-run --ignore-installed --quiet --disable-pip-version-check .[all] lerobot"
TESTS = "pytest -n 2 --dist loadgroup --no-loadscope-reorder --max-worker-restart 0 -m 'not long'"
ALL = (RESOLVE, TESTS, "python gallery/run_all.py")
SHORT = (
    "pytest -n 2 --dist loadgroup tests/scalargraph/test_jax_forms.py tests/scalargraph/test_lowering.py",
    "covariant certify --check examples/certificates/ball_and_beam.json",
    "pytest tests/pages/test_examples.py -k README.md",
    "python gallery/demo.py --out {environment}/demo",
)
"""Commands of an environment, run in the root of the repository."""


def candidates(version: str) -> Iterator[str]:
    """Where Python of this version may be: on the path, or among the versions of pyenv, the newest first."""
    yield f"python{version}"
    folder = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
    found = [path for path in folder.glob(f"{version}.*/bin/python") if path.parts[-3].split(".")[2].isdigit()]
    yield from map(str, sorted(found, key=lambda path: -int(path.parts[-3].split(".")[2])))


def interpreter(version: str) -> str | None:
    """Python of this version that runs, or None; a name on the path may be that of a version that is not selected."""
    for name in candidates(version):
        try:
            subprocess.run([name, "-c", "import venv, ensurepip"], check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError):
            continue
        return name
    return None


def floors() -> str:
    """Constraints that pin every requirement of pyproject.toml that has a lowest version to that version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    requirements = map(Requirement, chain(project["dependencies"], *project["optional-dependencies"].values()))
    lowest = {(each.name, bound.version) for each in requirements for bound in each.specifier if bound.operator == ">="}
    return "".join(f"{name}=={version}\n" for name, version in sorted(lowest))


def environment(name: str, python: str) -> Path:
    """The environment of a name, made or brought up to date where pyproject.toml is newer."""
    folder = ROOT / f".venv-{name}"
    ready, constraints = folder / "ready", folder / "floors.txt"
    if not ready.exists() or ready.stat().st_mtime < (ROOT / "pyproject.toml").stat().st_mtime:
        subprocess.run([python, "-m", "venv", folder], check=True)
        constraints.write_text(floors() if name == LOWEST else "", encoding="utf-8")
        subprocess.run([folder / "bin/python", *INSTALL, "-c", constraints], check=True, cwd=ROOT)
        ready.touch()
    return folder


def main(arguments: list[str] | None = None) -> int:
    """Run the commands in every environment whose Python is here; the result is 1 if one of them fails."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--short", action="store_true", help="only the tests that depend on versions most")
    short = parser.parse_args(arguments).short
    commands, names = (SHORT, ENVIRONMENTS[-1:]) if short else (ALL, ENVIRONMENTS)
    failed = []
    for name in names:
        version = name.partition("-")[0]
        python = interpreter(version)
        if python is None:
            print(f"Python {version} is not here: nothing was run on it", flush=True)
            continue
        folder = environment(name, python)
        for command in commands:
            program, *words = shlex.split(command.format(environment=folder.name))
            print(f"Python {name}: {program} {' '.join(words)}", flush=True)
            if subprocess.run([folder / "bin" / program, *words], cwd=ROOT, check=False).returncode:
                failed.append(f"Python {name}: {program} {' '.join(words)}")
    print(*(f"FAILED {what}" for what in failed), sep="\n", end="\n" if failed else "")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
