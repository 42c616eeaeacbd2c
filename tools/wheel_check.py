"""Install the wheel into empty environments, as users do, and see that it does its work there.

    python tools/wheel_check.py              # all
    python tools/wheel_check.py logs robots  # without extras, and with these

builds the wheel and tries it in a folder with nothing in it. Without extras a log is a record in memory, and whatever
needs an extra is refused with the command that installs it. Then each extra is installed alone, does what it promises,
and is removed again before the next. With all extras the demo runs. Last, an exported Python package runs where NumPy
is and this library is not. Packages are the newest that pyproject.toml allows, and no tools of development are there.
The seconds of every step are printed.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DEVELOPMENT = ("pytest", "ruff", "basedpyright", "beartype", "hypothesis", "mkdocs")
START = time.monotonic()

IN_MEMORY = """
import numpy as np

import covariant

t = np.linspace(0.0, 2.0, 1001)
log = covariant.Record(t, np.zeros((1001, 1)), np.cos(t)[:, None])
result = covariant.estimate("oscillator", log, alpha=40.0, beta=800.0@ENGINE@)
assert result.velocity.shape == (1001, 1)
"""
GAINS = ("--alpha", "40", "--beta", "800")
CERTIFY = "--alpha 10 --beta 50 --velocity 1 --error 0.1 --region q=-1:1 --rate 1 --out proved.json"


def python(after: str, engine: str = "") -> tuple[str, ...]:
    """The command of an estimate in memory, followed by something else."""
    return ("python", "-c", IN_MEMORY.replace("@ENGINE@", engine) + after)


def on_files(log: str, velocities: str) -> tuple[tuple[str, ...], ...]:
    """The commands that write a log and read it."""
    return (
        ("covariant", "simulate", "oscillator", "-o", log, "--q0", "1", "--noise", "1e-4", "--duration", "4"),
        ("covariant", "estimate", "oscillator", log, *GAINS, "-o", velocities),
    )


class Trial(NamedTuple):
    """What an extra promises.

    Attributes:
        commands: Commands that do it; the first one needs the extra.
        refused: Whether the first one fails without the extra, with the command that installs it.
        alone: Whether no program of the system is on the path.
    """

    commands: tuple[tuple[str, ...], ...]
    refused: bool = True
    alone: bool = False


TRIALS = {
    "logs": Trial(on_files("log.csv", "velocities.csv")),
    "ros": Trial(on_files("log.mcap", "velocities.mcap")),
    "tables": Trial((python("assert list(result.to_pandas())[0] == 't'"),)),
    "report": Trial((python("result.plot('velocity.png'); print(result.report('page.html'))"),)),
    "robots": Trial(
        (
            (
                "python",
                "-c",
                "from pathlib import Path; from covariant.models import robots; Path('arm.xml').write_text('<mujoco>"
                '<worldbody><body><joint axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3"/></body>'
                "</worldbody></mujoco>'); print(robots.load('arm.xml').space)",
            ),
        )
    ),
    "engine": Trial((python("assert result.summary['engine'] == 'c', result.summary", ", engine='c'"),), refused=False),
    "lmi": Trial(
        (
            (
                "python",
                "-c",
                "import numpy as np; from covariant.certificates import common_metric; "
                "print(common_metric(-np.eye(2), rate=1.0).statement.short)",
            ),
        )
    ),
    "scale": Trial(
        (("covariant", "design", "metric", "unknown_frequency", "--grid", "5", "--rate", "8", "-o", "P.zarr"),)
    ),
    "wasm": Trial((("covariant", "export", "oscillator", "--rate", "500", *GAINS, "--wasm", "-o", "web"),), alone=True),
}
"""What is tried for each extra."""

EXPORTED = """
import importlib.util

import numpy as np
import oscillator

assert not importlib.util.find_spec("jax") and not importlib.util.find_spec("covariant")
t = np.linspace(0.0, 2.0, 1001)
run = oscillator.run(t, np.cos(t)[:, None], np.zeros((1001, 1)))
print(f"velocity {run.v[-1, 0]:.3f}, truth {-np.sin(2.0):.3f}")
assert abs(run.v[-1, 0] + np.sin(2.0)) < 0.01
"""


def main() -> None:
    """Try the wheel in all environments; raises where one does not do its work."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("extras", nargs="*", metavar="EXTRA", help=", ".join(TRIALS))
    asked = parser.parse_args().extras
    if unknown := set(asked) - set(TRIALS):
        parser.error(f"no extra is called {', '.join(unknown)}; there are {', '.join(TRIALS)}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with step("the wheel is built"):
            subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT], check=True)
        [wheel] = folder.glob("covariant-*.whl")
        core = environment(folder / "core")
        with step("installed without extras"):
            install(core, str(wheel))
        with step("an estimate in memory, and a proof"):
            run(core, folder, *python("print(result)"))
            run(core, folder, "covariant", "certify", "oscillator", *CERTIFY.split())
        bare = packages(core)
        for extra in asked or TRIALS:
            attempt(extra, core, folder, wheel)
            subprocess.run([*pip(core), "uninstall", "-q", "-y", *sorted(packages(core) - bare)], check=True)
        if not asked:
            everything(folder, wheel)
    print(f"all of it: {time.monotonic() - START:.0f} s")


def attempt(extra: str, programs: Path, folder: Path, wheel: Path) -> None:
    """Try one extra, installed into an environment without any."""
    trial = TRIALS[extra]
    if trial.refused:
        with step(f"{extra}: what needs it is refused without it"):
            said = run(programs, folder, *trial.commands[0], refused=True, alone=trial.alone)
            assert f"pip install 'covariant[{extra}]'" in said, said
    with step(f"{extra}: installed"):
        install(programs, f"covariant[{extra}] @ {wheel.as_uri()}")
    with step(f"{extra}: does what it promises"):
        for command in trial.commands:
            run(programs, folder, *command, alone=trial.alone)


def everything(folder: Path, wheel: Path) -> None:
    """Try all extras in a new environment, and what is exported there in one that has NumPy alone."""
    programs, other = environment(folder / "all"), environment(folder / "numpy")
    with step("all: installed"):
        install(programs, f"covariant[all] @ {wheel.as_uri()}")
    with step("all: the demo"):
        run(programs, folder, "python", str(ROOT / "gallery" / "demo.py"), "--out", str(folder))
    with step("all: nothing is wrong with the installation"):
        run(programs, folder, "covariant", "doctor")
    with step("exported as a Python package"):
        words = ("oscillator", "--rate", "500", *GAINS, "--python", "-o", "exported")
        run(programs, folder, "covariant", "export", *words)
        [package] = folder.glob("exported/python/*.whl")
        assert "python/oscillator" in (folder / "exported" / "README.md").read_text(encoding="utf-8")
        install(other, str(package))
        run(other, folder, "python", "-c", EXPORTED)


@contextmanager
def step(title: str) -> Iterator[None]:
    """Print what is done, and the seconds that it takes."""
    start = time.monotonic()
    print(f"== {title}", flush=True)
    yield
    print(f"   {time.monotonic() - start:.1f} s", flush=True)


def environment(place: Path) -> Path:
    """The programs of a new, empty environment."""
    subprocess.run([sys.executable, "-m", "venv", place], check=True)
    return place / "bin"


def pip(programs: Path) -> tuple[str | Path, ...]:
    """The command of an environment's pip."""
    return (programs / "python", "-m", "pip", "--disable-pip-version-check")


def packages(programs: Path) -> set[str]:
    """Names of what is installed in an environment."""
    command = [*pip(programs), "list", "--format", "freeze"]
    listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return {line.partition("==")[0].partition(" @")[0] for line in listed.splitlines()}


def install(programs: Path, requirement: str) -> None:
    """Install something, and see that no tools of development come with it; prints number and size of the packages."""
    subprocess.run([*pip(programs), "install", "-q", requirement], check=True)
    names = packages(programs)
    assert not names & set(DEVELOPMENT), names & set(DEVELOPMENT)
    files = (path for path in programs.parent.rglob("*") if path.is_file() and not path.is_symlink())
    print(f"   {len(names)} packages, {sum(path.stat().st_size for path in files) / 1e6:.0f} MB", flush=True)


def run(programs: Path, folder: Path, *command: str, refused: bool = False, alone: bool = False) -> str:
    """Run a program of an environment as a user would; returns what it says, and raises for another exit code."""
    place = {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "LANG": "C.UTF-8"}
    path = str(programs) if alone else f"{programs}{os.pathsep}{os.defpath}"
    done = subprocess.run(
        [programs / command[0], *command[1:]],
        cwd=folder,
        env={"PATH": path, **place},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print("".join(f"   | {line}\n" for line in done.stdout.splitlines()[-8:]), end="", flush=True)
    if (done.returncode != 0) != refused:
        expected = "an error" if refused else "0"
        raise SystemExit(f"exit code {done.returncode}, not {expected}, of {' '.join(command)}\n{done.stdout}")
    return done.stdout


if __name__ == "__main__":
    main()
