"""Run the tests on other versions of Python, with the newest packages that pyproject.toml allows.

The environment `.venv` has the oldest: those of constraints.txt. Each other version has its own, such as `.venv-3.12`,
and one that is not on this machine is left out, with a line that says so.

    python tools/matrix.py            # those of `make test`, on Python 3.12 and 3.13
    python tools/matrix.py --short    # forms of jaxprs, a certificate, the README, the demo; the newest version only
"""

import argparse
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
VERSIONS = ("3.12", "3.13")
INSTALL = ("-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--upgrade", "-e", ".[dev]")
ALL = (
    "pytest -n 2 --dist loadgroup --no-loadscope-reorder --max-worker-restart 0 -m 'not long'",
    "python gallery/run_all.py",
)
SHORT = (
    "pytest -n 2 --dist loadgroup tests/lowering/test_jax_forms.py tests/lowering/test_lowering.py",
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


def environment(version: str, python: str) -> Path:
    """The environment of a version, made or brought up to date where pyproject.toml is newer."""
    folder = ROOT / f".venv-{version}"
    ready = folder / "ready"
    if not ready.exists() or ready.stat().st_mtime < (ROOT / "pyproject.toml").stat().st_mtime:
        subprocess.run([python, "-m", "venv", folder], check=True)
        subprocess.run([folder / "bin/python", *INSTALL], check=True, cwd=ROOT)
        ready.touch()
    return folder


def main(arguments: list[str] | None = None) -> int:
    """Run the commands on every version that is here; the result is 1 where one of them fails."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--short", action="store_true", help="only the tests that depend on versions most")
    short = parser.parse_args(arguments).short
    commands, versions = (SHORT, VERSIONS[-1:]) if short else (ALL, VERSIONS)
    failed = []
    for version in versions:
        python = interpreter(version)
        if python is None:
            print(f"Python {version} is not here: nothing was run on it", flush=True)
            continue
        folder = environment(version, python)
        for command in commands:
            program, *words = shlex.split(command.format(environment=folder.name))
            print(f"Python {version}: {program} {' '.join(words)}", flush=True)
            if subprocess.run([folder / "bin" / program, *words], cwd=ROOT, check=False).returncode:
                failed.append(f"Python {version}: {program} {' '.join(words)}")
    print(*(f"FAILED {what}" for what in failed), sep="\n", end="\n" if failed else "")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
