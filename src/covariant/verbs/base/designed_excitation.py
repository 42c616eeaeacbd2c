"""Computes a motion whose log determines numbers of a robot, within the limits of its file or of the arguments."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from covariant import logs, models
from covariant.calibration import (
    ExcitationPlan,
    ExpectedErrors,
    JointLimits,
    Sensing,
    command_excitation,
    design_excitation,
    motion_periods,
    motor_inputs,
    of_coordinates,
)
from covariant.models import ModelFile, Overrides, RobotFamily, robots
from covariant.verbs.base.arguments import Amounts, Region, amounts, bounds, numbers
from covariant.verbs.base.kind import numbered
from covariant.verbs.base.kinds import kind_of
from covariant.verbs.base.progress import Progress
from scalargraph.errors import InputError

TORQUE_NOISE = 0.01
"""Standard deviation of logged torques, as a fraction of the largest ones, where none is given."""


class Limits(NamedTuple):
    """Limits that replace those of the robot's file, and the noise of logged torques; see `design_excitation`."""

    region: Region
    velocity: Amounts | None
    effort: Amounts | None
    torque_noise: Amounts | None


def designed_excitation(
    model: str,
    names: Sequence[str],
    overrides: Overrides,
    given: Limits,
    plan: ExcitationPlan,
    rate: float,
    progress: Progress,
) -> tuple[logs.Columns, dict[str, np.ndarray], dict[str, str], dict[str, Any]]:
    """Design a motion of a robot."""
    progress("reading the model")
    family = models.robot_family(model, names, overrides)
    file = family.file
    machine: Any = file.model
    if file.measurement_std is None:
        raise InputError(
            f"{model}: the noise of the encoders is not known; put measurement.std or measurement.quantum in the model "
            "file, or give `overrides=['measurement.std=NUMBER']`"
        )
    limits = _limits(model, family, given)
    noise = np.broadcast_to(np.asarray(file.measurement_std, float), len(limits.names))
    servos = robots.servos_in(machine)
    torque_noise = TORQUE_NOISE * limits.effort
    if servos is not None:
        if given.torque_noise is not None:
            raise InputError(f"{model}: its servos are told positions and log no torque; leave out `torque_noise`")
        # A torque is known as well as the error that makes it.
        torque_noise = noise * of_coordinates(servos, servos.stiffness)
    elif given.torque_noise is not None:
        torque_noise = amounts("torque-noise", given.torque_noise, limits.names)
    sensing = Sensing(noise, torque_noise, rate)

    if not float(round(plan.duration * rate, 6)).is_integer():
        raise InputError(
            f"rate: {rate:g} rows a second are no whole number of rows in {plan.duration:g} s, so the table would not "
            f"end at rest; give {round(plan.duration * rate) / plan.duration:.6g}"
        )
    _column_names(file)

    def report(fraction: float) -> None:
        progress(f"designing a motion of {file.name}", fraction)

    t = np.arange(round(plan.duration * rate) + 1) / rate
    try:
        if servos is None:
            found: Any = design_excitation(family, limits, sensing, plan, file.reference_half, report)
            q, v, third = found.designed.motion.at(t)
            u, motors = motor_inputs(machine, q, v, third)
            windows = {key: 2 * each.expected.window.half for key, each in found._asdict().items()}
            kind = {"motors": motors.tolist(), "window": windows}
        else:
            moving = motion_periods(plan) / plan.frequency
            shorter = plan._replace(duration=moving)
            motion = design_excitation(family, limits, sensing, shorter, file.reference_half, report)
            found = command_excitation(family, limits, sensing, plan, motion)
            u, q, v, third, *_ = found.designed
            kind = {"torques": _third_names(file), "moving": moving}
    except InputError as error:
        raise InputError(f"{model}: {error}") from error
    columns, units = _columns(file, t, (q, v, third, u))
    details = {
        "model": model,
        "rows": len(t),
        "rate": rate,
        "periods": round(plan.duration * plan.frequency),
        **plan._asdict(),
        **kind,
        "joints": _joints(file, limits, sensing, found),
        **_expected_errors(family, found.designed.expected, found.reference.expected),
    }
    return file.columns, columns, units, details


def _limits(model: str, family: RobotFamily, given: Limits) -> JointLimits:
    """The limits of the arguments, and those of the robot's file where there are none."""
    file, parameters = family.file, family.document["parameters"]
    names = file.model.coordinates
    robot = robots.read(parameters["path"], motor_torques=parameters.get("motor_torques", False))
    robot = robots.changed(robot, offsets=parameters.get("offsets"), servos=models.servo_tables(family.document))
    if parameters.get("actuated") is None:
        _refuse_velocity_servos(model, robot, names)
    of_file = {joint.name: joint for joint in robot.joints}
    joints = [of_file.get(name) for name in names]
    # The file limits true positions, and those of a log are off by the offset of the encoder.
    ends = [(j.lower - j.encoder_offset, j.upper - j.encoder_offset) if j else (-np.inf, np.inf) for j in joints]
    _refuse_followers(model, robot, names, given)
    region = bounds("region", given.region, names, "joint")
    low, high = np.array([region.get(name, pair) for name, pair in zip(names, ends, strict=True)], float).T
    effort = _largest("effort", given.effort, names, [j.effort if j else np.inf for j in joints])
    if (servos := robots.servos_in(family.file.model)) is not None:
        effort = np.minimum(effort, of_coordinates(servos, servos.limit))
    velocity = _largest("velocity", given.velocity, names, [j.velocity if j else np.inf for j in joints])
    limits = JointLimits(names, low, high, velocity, effort)
    _refuse_missing(model, limits)
    return limits


def _refuse_followers(model: str, robot: robots.Description, names: Sequence[str], given: Limits) -> None:
    """Raise `ValueError` for a joint that follows another one, where the limits of the file would be used.

    Its own limits bind the one that it follows, by its ratio and through chains of them.
    """
    followers = [j.name for j in robot.joints if j.follows and j.follows.joint and j.name not in names]
    missing = [key for key in ("region", "velocity", "effort") if getattr(given, key) is None or given.region == {}]
    if followers and missing:
        raise InputError(
            f"{model}: joint {followers[0]!r} follows another one, and its limits bind that one, too; give limits that "
            f"keep both, by {', '.join(f'`{key}`' for key in missing)}"
        )


def _largest(argument: str, given: Amounts | None, names: Sequence[str], of_file: list[float]) -> np.ndarray:
    if given is None:
        return np.array(of_file, float)
    return numbers(argument, given, names, positive=True, one=True)


def _refuse_missing(model: str, limits: JointLimits) -> None:
    """Raise `ValueError` for limits that neither the file nor an argument has; some files have 0 for none."""
    needed = {
        "region": ("ends of its positions", limits.room),
        "velocity": ("largest speed", limits.velocity),
        "effort": ("largest torque", limits.effort),
    }
    for argument, (what, sizes) in needed.items():
        names = [name for name, size in zip(limits.names, sizes, strict=True) if not 0 < size < np.inf]
        if names:
            example = ",".join(f"{name}=LOW:HIGH" for name in names) if argument == "region" else "NUMBER"
            raise InputError(
                f"{model}: joint {names[0]!r} has no {what} in its file"
                + (" that is read from MJCF" if str(model).endswith(".xml") and argument != "region" else "")
                + (f", and neither have {', '.join(names[1:])}" if names[1:] else "")
                + f"; give `{argument}` {example}"
            )


def _refuse_velocity_servos(model: str, robot: robots.Description, names: Sequence[str]) -> None:
    """Raise `ValueError` for a motor that is told a velocity: its torque is not its input."""
    for motor in robot.motors:
        if motor.joint in names and motor.damping and not motor.stiffness:
            raise InputError(
                f"{model}: actuator {motor.name!r} is a servo of velocities, whose torque is not its input; give the "
                f"joints whose torques are logged, as `overrides=['parameters.actuated=[\"{motor.joint}\"]']`"
            )


def _column_names(file: ModelFile) -> list[str]:
    names = file.columns
    groups = (names.q, kind_of(file).estimates.names, _third_names(file), names.u)
    listed = [names.t, *(name for group in groups for name in group)]
    for name in listed:
        if listed.count(name) > 1:
            raise InputError(f"{file.name}: two columns would be named {name!r}; rename the one in [columns]")
    return listed


def _third_names(file: ModelFile) -> list[str]:
    """Names of the columns beside positions and velocities: accelerations, or the torques of servos."""
    if robots.servos_in(file.model) is None:
        return list(numbered("a", len(file.model.coordinates)))
    return [f"torque_{name}" for name in file.model.coordinates]


def _columns(
    file: ModelFile, t: np.ndarray, rows: tuple[np.ndarray, ...]
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The columns in SI units, under the names of the model file, and their units."""
    listed = _column_names(file)
    arrays = dict(zip(listed, [t, *(column for each in rows for column in each.T)], strict=True))
    units = file.model.units
    si = ["s", *units, *(f"{unit}/s" for unit in units), *(f"{unit}/s^2" for unit in units)]
    servos = robots.servos_in(file.model)
    if servos is not None:
        si[1 + 2 * len(units) :] = [*("N m" if unit == "rad" else "N" for unit in units), *servos.input_units]
    return arrays, dict(zip(listed, si, strict=False))


def _joints(file: ModelFile, limits: JointLimits, sensing: Sensing, found: Any) -> list[dict[str, Any]]:
    """What of its limits each joint uses."""
    commanded, rows = robots.servos_in(file.model) is not None, []
    used, reference = found.designed.used, found.reference.used
    for i, (name, unit) in enumerate(zip(limits.names, file.model.units, strict=True)):
        force = "N m" if unit == "rad" else "N"
        sizes = (limits.room[i], limits.velocity[i], limits.effort[i])
        middles = (limits.middle[i], 0.0, 0.0)
        kinds = {}
        for k, (kind, its_unit) in enumerate((("position", unit), ("velocity", f"{unit}/s"), ("torque", force))):
            kinds[kind] = {
                "unit": its_unit,
                "limit": float(sizes[k]),
                "ends": [float(middles[k] - sizes[k]), float(middles[k] + sizes[k])],
                "largest": float(used[k, i] * sizes[k]),
                "fraction": float(used[k, i]),
                "reference_fraction": float(reference[k, i]),
            }
        if not commanded:
            kinds["torque"]["noise"] = float(sensing.torque_noise[i])
        rows.append({"name": name, "unit": unit, "noise": float(sensing.noise[i]), **kinds})
    return rows


def _expected_errors(family: RobotFamily, after: ExpectedErrors, before: ExpectedErrors) -> dict[str, Any]:
    """Standard errors to expect, and what is not determined."""
    unknown = [name for name, error in zip(family.names, after.errors, strict=True) if np.isnan(error)]
    sentences = [f"no log of this motion shows {', '.join(unknown)} alone"] if unknown else []
    sentences += [
        f"{name}: a tenth of its usual size cannot be told from zero, nor can its value, with ± {error:.2g}"
        for name, error, known in zip(family.names, after.errors, after.determined, strict=True)
        if not known and np.isfinite(error)
    ]
    return {
        "parameters": [
            {
                "name": number.name,
                "unit": number.unit,
                "value": number.first,
                "reference_error": _number_or_none(before.errors[i]),
                "error": _number_or_none(after.errors[i]),
            }
            for i, number in enumerate(family.numbers)
        ],
        "undetermined": [*sentences, *(f"only the combination {text} is" for text in after.combinations.determined)],
        "combinations": list(after.combinations.determined),
        "redundant": list(after.combinations.absorbed),
        "rank": {"reference": before.combinations.rank, "designed": after.combinations.rank},
        "condition": {"reference": _number_or_none(before.condition), "designed": _number_or_none(after.condition)},
    }


def _number_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
