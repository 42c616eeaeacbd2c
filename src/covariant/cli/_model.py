"""`covariant model`: what a model is made of, and what is known of its geometry."""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from covariant import models
from covariant.cli._console import working
from covariant.models import robots


def show(spec: str, overrides: tuple[str, ...], samples: int, seed: int, as_json: bool) -> None:
    """Print a model: of a robot its tree, the masses and what of its file was used; then conditioning and curvature."""
    file = models.load(spec, overrides)
    result: dict[str, Any] = {"model": spec, "name": file.name}
    result |= {"coordinates": list(file.model.coordinates), "units": list(file.model.units)}
    result |= {"velocities": list(file.model.velocities), "inputs": len(file.columns.u)}
    robot, box = _robot(spec, overrides), None
    if robot is not None:
        result |= _of_robot(robot)
        box = _limits(robot, file.model.coordinates)
    if file.mechanical:
        with working(f"measuring the geometry of {file.name}", quiet=as_json):
            seen = models.survey(file.need_mechanical(spec, ""), box, samples, seed)
        result |= {"samples": samples, "conditioning": seen.conditioning, "curvature": seen.curvature}
    print(json.dumps(result) if as_json else "\n".join(_lines(result)))


def _robot(spec: str, overrides: tuple[str, ...]) -> robots.Description | None:
    """The description of a robot's file, where the model is one."""
    if ":" in spec:
        return None
    made = models.recipe(spec, overrides)
    if made.get("system") != "robot":
        return None
    given = made["parameters"]
    return robots.read(given["path"], motor_torques=given.get("motor_torques", False))


def _of_robot(robot: robots.Description) -> dict[str, Any]:
    joints = [
        {
            "name": joint.name,
            "kind": joint.kind,
            "parent": joint.parent,
            "child": joint.child,
            "mass": robot.links[joint.child].mass,
            "limits": [None if np.isinf(limit) else limit for limit in (joint.lower, joint.upper)],
            "follows": None if joint.follows is None else joint.follows._asdict(),
        }
        for joint in robot.joints
    ]
    mass = sum(inertia.mass for inertia in robot.links.values())
    return {
        "robot": robot.name,
        "root": robot.root,
        "mass": mass,
        "joints": joints,
        "motors": [motor.name for motor in robot.motors],
        "used": robot.used,
        "ignored": robot.ignored,
        "doubts": list(robot.doubts),
    }


def _limits(robot: robots.Description, coordinates: tuple[str, ...]) -> np.ndarray:
    """Bounds of the coordinates (n, 2): the limits of the joints, ±π or ±1 m where there are none."""
    named = {joint.name: joint for joint in robot.joints}
    rows = []
    for name in coordinates:
        joint = named.get(name)
        limits = (-np.inf, np.inf) if joint is None else (joint.lower, joint.upper)
        wide = 1.0 if joint is not None and joint.kind == "prismatic" else np.pi
        rows.append([limit if np.isfinite(limit) else sign * wide for limit, sign in zip(limits, (-1, 1), strict=True)])
    return np.array(rows).reshape(-1, 2)


def _lines(result: dict[str, Any]) -> Iterator[str]:
    names = ", ".join(result["velocities"] or result["coordinates"])
    yield f"{result['name']}: {len(result['velocities'] or result['coordinates'])} velocities ({names})"
    yield f"{result['inputs']} inputs"
    if "robot" in result:
        yield f"robot {result['robot']!r}, {result['mass']:.6g} kg"
        yield from _tree(result)
        for what in ("used", "ignored"):
            counts = ", ".join(f"{count} {tag}" for tag, count in result[what].items())
            yield f"{what}: {counts or 'nothing'}"
        yield "refused: nothing"
        yield from (f"doubt: {sentence}" for sentence in result["doubts"])
    if "conditioning" in result:
        low, high = result["conditioning"]
        yield f"condition number of the inertia matrix: {low:.3g} to {high:.3g}"
        if result["curvature"] is not None:
            low, high = result["curvature"]
            yield f"sectional curvature: {low:.3g} to {high:.3g} 1/(kg m²)"
        yield f"sampled at {result['samples']} configurations within the limits, no proof"


def _tree(result: dict[str, Any]) -> Iterator[str]:
    depth = {result["root"]: 0}
    yield f"  {result['root']}"
    for joint in result["joints"]:  # each after the one that carries it
        depth[joint["child"]] = depth[joint["parent"]] + 1
        low, high = joint["limits"]
        limits = "" if low is None or high is None or joint["kind"] == "fixed" else f", {low:.4g} to {high:.4g}"
        led = "" if joint["follows"] is None else f", follows {joint['follows']['joint'] or 'nothing'}"
        indent = "  " * (depth[joint["child"]] + 1)
        yield f"{indent}{joint['name']} ({joint['kind']}{limits}{led}) -> {joint['child']}, {joint['mass']:.4g} kg"
