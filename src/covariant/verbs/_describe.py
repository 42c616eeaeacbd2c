"""`describe_model`: coordinates, inputs, robot tree and geometry of a model."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from covariant import models
from covariant.models import Overrides, robots
from covariant.verbs.base.equations import write_equations
from covariant.verbs.base.placeholders import placeholder_sentence, placeholders
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult


def describe_model(
    model: Any,
    *,
    samples: int = 200,
    seed: int = 0,
    equations: bool = False,
    overrides: Overrides = (),
    progress: Progress = notebook_line,
) -> "ModelResult":
    """Describe a model: its coordinates and inputs, the tree of a robot, and the curvature of its metric.

    Use it on a new model or robot to see the order of coordinates and inputs before you name columns of a log. Strong
    curvature or bad conditioning says that coordinates matter: then `Geodesic` or `IntrinsicKalman` pays. Placeholders
    that are left in a drafted file are listed as well.

    Args:
        model: A model file (.toml), a robot, `module:attribute`, the name of a system, a `ModelFile`, or a system.
        samples: Number of configurations at which the geometry is measured, within the limits of a robot's joints.
        seed: Seed of the configurations.
        equations: Print metric, Christoffel symbols, curvature and the intrinsic observer instead, as Markdown with
            LaTeX. This is refused where the formulas are too large, as they are of a robot with many joints.
        overrides: Values that replace those of the model file.
        progress: Called with a description of the work.

    Returns:
        Names, units and geometry of the model, and of a robot its tree.

    Raises:
        ValueError: For a model that cannot be loaded, or whose equations are not printed.

    Example:
        >>> from covariant import verbs
        >>> result = verbs.describe_model("oscillator", samples=5)
        >>> result.summary["coordinates"], result.summary["conditioning"]
        (['q'], (1.0, 1.0))
    """
    name = models.spec_name(model)
    progress("reading the model")
    file = models.load(model, overrides)
    facts: dict[str, Any] = {"model": name, "name": file.name}
    facts |= {"coordinates": list(file.model.coordinates), "units": list(file.model.units)}
    facts |= {"velocities": list(file.model.velocities), "inputs": len(file.columns.u)}
    facts |= _named_quantities(file)
    facts |= {"commands": _commands(file), "placeholders": placeholders(model, overrides)}
    robot, box = _robot(model, overrides), None
    if robot is not None:
        facts |= _of_robot(robot)
        box = _limits(robot, file.model.coordinates)
    if equations:
        progress(f"writing the equations of {file.name}")
        system = file.need_mechanical(name, "equations are printed of")
        facts["equations"] = write_equations(system, file.name, file.columns.u)
    elif file.mechanical:
        progress(f"measuring the geometry of {file.name}")
        survey = models.survey(file.need_mechanical(name, ""), box, samples, seed)
        facts |= {"samples": samples, "conditioning": survey.conditioning, "curvature": survey.curvature}
    return ModelResult(facts)


@dataclass(frozen=True, repr=False)
class ModelResult(AbstractResult):
    """Description of a model.

    Attributes:
        facts: Names, units and geometry, as plain data; of a robot also its joints, masses [kg] and motors.
            "conditioning" and "curvature" [1/(kg m²)] are the lowest and highest values at the samples, and
            "equations", where they are asked for, is Markdown.

    Example:
        >>> from covariant import verbs
        >>> result = verbs.describe_model("oscillator", samples=5)
        >>> result
        <ModelResult: oscillator: 1 coordinates (q [m]); 1 inputs (u1)>
        >>> result.facts["units"], result.facts["inputs"]
        (['m'], 1)
    """

    facts: dict[str, Any]

    @property
    def headline(self) -> str:
        return next(_lines(self.facts))

    @property
    def summary(self) -> dict[str, Any]:
        return self.facts

    def __str__(self) -> str:
        return self.facts.get("equations") or "\n".join(_lines(self.facts))


def _named_quantities(file: models.ModelFile) -> dict[str, Any]:
    """Estimated quantities, inputs and parameters, in words with their units."""
    model = file.model
    named = {
        "coordinates" if file.mechanical else "states": _headings(model.coordinates, model.units),
        "velocities": _headings(model.velocities, model.velocity_units),
        "inputs": _headings(file.columns.u, model.logged_units["u"]),
    }
    parameters = {
        name: f"{', '.join(f'{value:.4g}' for value in np.ravel(each.value))} {each.unit}".removesuffix(" 1")
        for name, each in model.parameters.items()
    }
    return {"named": named, "parameters": parameters}


def _headings(names: Sequence[str], units: Sequence[str]) -> list[str]:
    return [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units or [""] * len(names), strict=True)]


def _commands(file: models.ModelFile) -> dict[str, float]:
    """The inputs that are commands, with their delays [s]; empty where inputs are torques or forces."""
    if file.input_kind != "command":
        return {}
    delays = np.broadcast_to(file.input_delay, len(file.columns.u)).tolist()
    return dict(zip(file.columns.u, delays, strict=True))


def _robot(model: Any, overrides: Overrides) -> robots.Description | None:
    """The description of a robot's file, where the model is one."""
    if not isinstance(model, str | os.PathLike) or ":" in str(model):
        return None
    recipe = models.recipe(str(model), overrides)
    if recipe.get("system") != "robot":
        return None
    parameters = recipe["parameters"]
    robot = robots.read(parameters["path"], motor_torques=parameters.get("motor_torques", False))
    return robots.changed(robot, servos=parameters.get("servos"))


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
        span = 1.0 if joint is not None and joint.kind == "prismatic" else np.pi
        rows.append([limit if np.isfinite(limit) else sign * span for limit, sign in zip(limits, (-1, 1), strict=True)])
    return np.array(rows).reshape(-1, 2)


def _lines(result: dict[str, Any]) -> Iterator[str]:
    counts = (f"{len(names)} {what} ({', '.join(names)})" for what, names in result["named"].items() if names)
    yield f"{result['name']}: {'; '.join(counts)}"
    told = ", ".join(f"{name} after {1e3 * delay:.3g} ms" for name, delay in result["commands"].items())
    if told:
        yield f"inputs of servos: {told}"
    yield from (f"parameter {name} = {text}" for name, text in result["parameters"].items())
    if result["placeholders"]:
        yield placeholder_sentence(result["placeholders"])
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
