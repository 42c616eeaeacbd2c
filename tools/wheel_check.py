"""Install the wheel into empty environments, as users do, and see that it does its work there.

    python tools/wheel_check.py

builds the wheel, and tries it three times in a folder with nothing in it: without extras, where a log is a record in
memory and a file is refused with the command that helps; with the extra `logs`, from a CSV file to velocities; with all
extras, where the demo runs. Packages are the newest that pyproject.toml allows, and no tools of development are there.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
DEVELOPMENT = ("pytest", "ruff", "basedpyright", "beartype", "hypothesis", "mkdocs")

IN_MEMORY = """
import numpy as np

import covariant

t = np.linspace(0.0, 2.0, 1001)
log = covariant.Record(t, np.zeros((1001, 1)), np.cos(t)[:, None])
result = covariant.estimate("oscillator", log, alpha=40.0, beta=800.0)
assert result.velocity.shape == (1001, 1)
print(result)
"""
SIMULATE = ("covariant", "simulate", "oscillator", "-o", "log.csv", "--q0", "1", "--noise", "1e-4")
ESTIMATE = ("covariant", "estimate", "oscillator", "log.csv", "--alpha", "40", "--beta", "800", "-o", "velocities.csv")


def main() -> None:
    """Try the wheel in all environments; raises where one does not do its work."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT], check=True)
        [wheel] = folder.glob("*.whl")
        core = installed(folder, wheel, "")
        run(core, folder, "python", "-c", IN_MEMORY)
        refused = run(core, folder, *SIMULATE, expected=2)
        assert "pip install 'covariant[logs]'" in refused, refused
        logs = installed(folder, wheel, "logs")
        run(logs, folder, *SIMULATE)
        run(logs, folder, *ESTIMATE)
        assert (folder / "velocities.csv").read_text(encoding="utf-8").startswith("t,q1,v1")
        run(installed(folder, wheel, "all"), folder, "python", str(ROOT / "gallery" / "demo.py"), "--out", str(folder))


def installed(folder: Path, wheel: Path, extra: str) -> Path:
    """The programs of a new environment that has the wheel, with an extra, and no tools of development."""
    place = folder / (extra or "core")
    subprocess.run([sys.executable, "-m", "venv", place], check=True)
    asked = f"covariant[{extra}] @ {wheel.as_uri()}" if extra else str(wheel)
    pip = (place / "bin" / "python", "-m", "pip", "--disable-pip-version-check")
    subprocess.run([*pip, "install", "-q", asked], check=True)
    listed = subprocess.run([*pip, "list", "--format", "freeze"], check=True, capture_output=True, text=True).stdout
    names = {line.partition("==")[0] for line in listed.splitlines()}
    assert not names & set(DEVELOPMENT), names & set(DEVELOPMENT)
    size = sum(path.stat().st_size for path in place.rglob("*") if path.is_file() and not path.is_symlink())
    print(f"== {extra or 'no extras'}: {len(names)} packages, {size / 1e6:.0f} MB", flush=True)
    return place / "bin"


def run(programs: Path, folder: Path, *command: str, expected: int = 0) -> str:
    """Run a program of an environment as a user would; returns what it says, and raises for another exit code."""
    place = {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "LANG": "C.UTF-8"}
    environment = {"PATH": f"{programs}{os.pathsep}{os.defpath}", **place}
    done = subprocess.run(
        [programs / command[0], *command[1:]],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print(done.stdout, end="", flush=True)
    if done.returncode != expected:
        raise SystemExit(f"exit code {done.returncode}, not {expected}, of {' '.join(command)}")
    return done.stdout


if __name__ == "__main__":
    main()
