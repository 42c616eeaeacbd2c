"""Run other projects' suites and oracles on this library: `make peers`, or `python tools/peers/run.py NAME …`.

Each suite is a file of this folder and runs in its own environment, `.venv-peers-NAME`, which is made when it is first
asked for: the versions named here, in front of the packages of `.venv`. The results of a suite are written to
`docs/peers.json`, where results of suites that were not asked for stay. The page `docs/peers.md` is written from that
file alone, here and by `python tools/pages.py`.

    python tools/peers/run.py                # all
    python tools/peers/run.py lie filterpy   # some
    python tools/peers/run.py --again lie    # in a new environment
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from page import RESULTS, page

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
THREADS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}


class Suite(NamedTuple):
    """What a suite needs beside this library.

    Attributes:
        packages: Requirements with versions; the first one is the project that is compared with.
        unpinned: Packages whose version in constraints.txt does not apply.
        beside: Requirements of a second environment, for a package that needs another NumPy than this library.
        environment: Environment variables of the run.
        seeks: A package that would be compared with, were it to be had: what pip answers is on the page.
    """

    packages: tuple[str, ...]
    unpinned: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    seeks: str = ""


SUITES = {
    "geomstats": Suite(
        ("geomstats==2.8.0", "autograd==1.9.1", "numpy==2.3.5", "pytest"),
        unpinned=("numpy",),
        environment=(("GEOMSTATS_BACKEND", "autograd"),),
    ),
    "lie": Suite(("jaxlie==1.5.0", "mpmath"), beside=("pin==4.1.0",), seeks="manifpy"),
    "filterpy": Suite(("filterpy==2.0.0",)),
    "fmi": Suite(("fmpy",)),
    "control": Suite(("control",)),
    "sysid": Suite(("mujoco[sysid]",), seeks="figaroh==1.0.2"),
    "dynamics": Suite(("mujoco",), beside=("pin==4.1.0",)),
}
"""Every suite by its name, which is that of its file `suite_NAME.py` in this folder."""


class UnavailableError(Exception):
    """A package that pip does not install, with its answer."""


def python(folder: Path) -> Path:
    """The interpreter of an environment."""
    return folder / "bin" / "python"


def install(folder: Path, requirements: list[str], unpinned: tuple[str, ...] = (), layered: bool = True) -> None:
    """Make an environment with these packages, unless it is there with the same ones.

    A layered one sees the packages of the environment that this runs in, behind its own; it takes seconds, not minutes.
    """
    pins = (ROOT / "constraints.txt").read_text().splitlines() if layered else []
    pins = [line for line in pins if re.split(r"[=\[; ]", line)[0] not in unpinned]
    wanted = json.dumps([requirements, pins, sys.prefix])
    ready = folder / "ready.json"
    if ready.exists() and ready.read_text() == wanted:
        return
    shutil.rmtree(folder, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    [packages] = folder.glob("lib/python3*/site-packages")
    if layered:
        (packages / "behind.pth").write_text("\n".join(path for path in sys.path if path.endswith("site-packages")))
    (folder / "constraints.txt").write_text("\n".join(pins) + "\n")
    done = pip(folder, "-c", str(folder / "constraints.txt"), *requirements)
    if done.returncode:
        raise UnavailableError(answer(done.stderr))
    ready.write_text(wanted)


def pip(folder: Path, *words: str) -> subprocess.CompletedProcess:
    """Ask pip to install something into an environment."""
    command = [sys.executable, "-m", "pip", "--python", python(folder), "install", "--quiet"]
    command += ["--disable-pip-version-check", "--only-binary", ":all:", *words]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)


def answer(text: str) -> str:
    """What pip says, in one line without names of hosts and folders."""
    lines = [line for line in text.splitlines() if line.startswith("ERROR") or "requires" in line]
    said = (lines[-1] if lines else text[-300:]).removeprefix("ERROR: ")
    return re.sub(r"\S*://\S+|/\S{8,}", "…", said).rstrip(".") + "."


def sought(environment: Path, package: str) -> str:
    """What pip answers when it is asked for a package, or nothing where it would install it."""
    done = pip(environment, "--dry-run", package)
    return answer(done.stderr) if done.returncode else ""


def ran(name: str, again: bool) -> dict:
    """Run one suite: its results, or why it did not run."""
    suite, folder = SUITES[name], ROOT / f".venv-peers-{name}"
    second = ROOT / f".venv-peers-{re.split('[=<>]', suite.beside[0])[0]}" if suite.beside else None
    if again:
        for made in filter(None, (folder, second)):
            shutil.rmtree(made, ignore_errors=True)
    project = re.split(r"[=\[]", suite.packages[0])[0]
    outcome = {"name": name, "project": project, "date": time.strftime("%Y-%m-%d")}
    try:
        install(folder, list(suite.packages), suite.unpinned)
    except UnavailableError as reason:
        return outcome | {"unavailable": {project: str(reason)}}
    unavailable, words = {}, []
    if suite.seeks and (said := sought(folder, suite.seeks)):
        unavailable[suite.seeks] = said
    if second:
        try:
            install(second, list(suite.beside), layered=False)
            words = ["--beside", str(python(second))]
        except UnavailableError as reason:
            unavailable[suite.beside[0]] = str(reason)
    with tempfile.TemporaryDirectory() as scratch:
        out, start = Path(scratch, "outcome.json"), time.monotonic()
        environment = {**os.environ, **THREADS, "PYTHONPATH": str(ROOT / "src"), **dict(suite.environment)}
        words = [HERE / f"suite_{name}.py", "--out", str(out), *words]
        done = subprocess.run([python(folder), *words], cwd=ROOT, env=environment, check=False)
        if not out.exists():
            return outcome | {"unavailable": unavailable, "failed": f"the suite ended with code {done.returncode}"}
        outcome |= json.loads(out.read_text())
    return outcome | {"unavailable": unavailable, "seconds": round(time.monotonic() - start)}


def line(outcome: dict) -> str:
    """The line of a suite: name, version, cases, passed, deviations, seconds."""
    if "cases" not in outcome:
        return f"{outcome['name']} did not run: {outcome.get('failed') or outcome['unavailable']}"
    keys = ("name", "version", "cases", "passed", "deviations", "seconds")
    return " ".join(str(len(outcome[k]) if k == "deviations" else outcome[k]) for k in keys)


def main() -> int:
    """Run suites and write their results; the exit code is 1 where one has a case that fails without a reason."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SUITES))
    parser.add_argument("--again", action="store_true", help="make the environments anew")
    parser.add_argument("--install", action="store_true", help="only make the environments")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(SUITES):
        parser.error(f"no suite is called {', '.join(unknown)}; there are {', '.join(SUITES)}")
    bad = False
    for name in arguments.names or SUITES:
        outcome = ran(name, arguments.again)
        print(line(outcome), flush=True)
        results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
        results[name] = outcome
        ordered = {key: results[key] for key in SUITES if key in results}
        RESULTS.write_text(json.dumps(ordered, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        bad |= "cases" not in outcome or any(not each["reason"] for each in outcome["deviations"])
    RESULTS.with_suffix(".md").write_text(page(), encoding="utf-8")
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
