"""MuJoCo and Pinocchio on every robot that is shipped, and on random trees: `tools/compare_robots.py` as a suite."""

import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

from outcome import Outcome, command_line

sys.path.append(str(Path(__file__).parents[1]))
import compare_robots as robots_beside

from covariant.models import robots

STATES, TREES = 20, 4
KINDS = {"matrix": "inertia matrix", "coriolis": "Coriolis forces", "weight": "weight", "rate": "forward dynamics"}


def with_coriolis(parts: dict) -> dict:
    """With Coriolis and centrifugal forces for the bias forces, which contain the weight."""
    return {**{key: parts[key] for key in ("matrix", "weight", "rate")}, "coriolis": parts["bias"] - parts["weight"]}


def differences(text: str, python: str | None) -> dict[str, dict[str, float]]:
    """By engine and by what is compared: the largest difference for the robot of a URDF text, relative to its size."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.urdf")
        path.write_text(text, encoding="utf-8")
        robot, model = robots.read(path), robots.load(path)
        moving = [joint for joint in robot.joints if joint.kind not in ("fixed", "floating")]
        at = robots_beside.states(model, moving, STATES)
        mine = with_coriolis(robots_beside.ours(model, at))
        engines = {"MuJoCo": robots_beside.by_mujoco(text, at)}
        if python:
            engines["Pinocchio"] = robots_beside.by_pinocchio(python, path, at)
    parts = {engine: with_coriolis(theirs) for engine, theirs in engines.items()}
    return {
        engine: {kind: robots_beside.difference({kind: mine[kind]}, theirs) for kind in KINDS}
        for engine, theirs in parts.items()
    }


def main() -> None:
    """Every robot, and a few trees, beside both engines."""
    arguments = command_line()
    names = f"MuJoCo {version('mujoco')}"
    if arguments.beside:
        asked = [arguments.beside, "-c", "import pinocchio; print(pinocchio.__version__)"]
        names += f", Pinocchio {subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()}"
    outcome, rows = Outcome(names), []
    files = {name: robots.located(name) for name in robots.ROBOTS}  # trees are URDF, closed loops MJCF
    texts = {name: path.read_text(encoding="utf-8") for name, path in files.items() if path.suffix == ".urdf"}
    texts |= {f"tree {seed}": robots_beside.tree(seed) for seed in range(TREES)}
    for name, text in texts.items():
        for engine, apart in differences(robots_beside.plain(text), arguments.beside).items():
            for kind, value in apart.items():
                outcome.close(f"{KINDS[kind]} of {name} beside {engine}", value, robots_beside.TOLERANCE)
            rows.append((name, engine, *(f"{apart[kind]:.1e}" for kind in KINDS)))
    note = (
        f"At {STATES} random states of each, relative to the largest number of its kind. Friction is taken out, of "
        "which the engines have other models, and a planar joint is given to them as three of one axis."
    )
    outcome.table("Largest differences", ("robot", "engine", *KINDS.values()), rows, note)
    outcome.write(arguments.out)


if __name__ == "__main__":
    main()
