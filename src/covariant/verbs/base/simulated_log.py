"""Computes the log of a simulated machine: its motion, and what its sensors read of it."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from covariant import logs, models, simulation
from covariant.models import MechanicalSystem, ModelFile, Overrides, Parametric
from covariant.signals import Record
from covariant.simulation import PiecewiseInputs, PositionSensor
from covariant.verbs.base.arguments import amounts, numbers
from covariant.verbs.base.kind import AbstractKind, numbered
from covariant.verbs.base.kinds import kind_of, or_zeros
from covariant.verbs.base.progress import Progress
from covariant.verbs.base.scenario import FORCE, Scenario
from covariant.verbs.base.sensors import FileSensor, file_sensors, sensed
from scalargraph.errors import InputError

DIGITS = 12
"""Decimals of a time [s] in a log: times that agree in all of them are one, however they were computed."""
DETUNED = 0.37
"""Each input is faster than the one before by this part of the frequency, so that no two are in step."""

LIMIT_TOLERANCE = 1e-9
"""Distance [rad or m] beyond its limits up to which a joint has not left them: a rounding error."""

FIRST_PUSH, BETWEEN_PUSHES, PUSH_LENGTH = 1.0, 2.0, 1.0
"""When pushes from outside begin [s]: the first one, and from each to the next; and how long each of them lasts [s]."""


def simulated_log(
    model: Any, overrides: Overrides, scenario: Scenario, progress: Progress
) -> tuple[
    str,
    bool,
    logs.Columns,
    Record,
    tuple[str, ...],
    dict[str, np.ndarray],
    dict[str, str],
    tuple[FileSensor, ...],
    tuple[str, ...],
]:
    """Simulate a model and its sensors; the last part are warnings."""
    progress("reading the model")
    name, file = models.spec_name(model), models.load(model, overrides)
    kind = kind_of(file)
    sensor = _sensor(name, kind, scenario)
    delays, beside = np.atleast_1d(np.asarray(file.delay, float)), file_sensors(file)
    late = [*delays, *(part.delay for part in beside)]
    # The log begins when its latest reading is of the start.
    t = simulation.stamps(sensor, scenario.duration, scenario.seed) + max(late)
    read = np.round([t - delay for delay in late], DIGITS)
    u, acting = _inputs(file, scenario, t, read)
    progress("simulating")
    machine, force = _add_push(name, file, scenario)
    everything, at_rest = _motion(kind, scenario, machine, acting)
    # Both sides are rounded to DIGITS, so that each time is exactly one of the beginnings.
    now, rows = (np.searchsorted(acting.begin, times) for times in (np.round(t, DIGITS), read))
    true, x = everything.y[now], jax.tree.map(lambda leaf: leaf[now], everything.x)
    if not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(x)):
        raise InputError(f"{name}: the motion leaves the finite numbers; check initial state and inputs")
    of_sensors = rows[len(delays) :]
    true_then = everything.y[rows[0]]  # the configuration at the time of the reading, not of the stamp
    if len(delays) > 1:
        true_then = np.stack([everything.y[row, i] for i, row in enumerate(rows[: len(delays)])], axis=1)
    measured = kind.sense(sensor, true_then, scenario.seed)
    record = Record(t, u, measured, x)
    layout = _layout(file)
    configuration, hidden = kind.truth(layout, true, x)
    columns = {layout.t: t} | logs.to_columns(layout, measured) | dict(zip(layout.u, u.T, strict=True))
    for i, (part, row) in enumerate(zip(beside, of_sensors, strict=True)):
        then = jax.tree.map(lambda leaf, row=row: leaf[row], everything.x)
        # What acts until then: an input that jumps at a stamp is read before it acts.
        inputs = acting.at(np.maximum(row - 1, 0), acting.begin[row])
        columns |= part.to_columns(sensed(machine, part, then, inputs, acting.begin[row], (scenario.seed, i)))
    columns |= {f"true_{key}": column for key, column in (configuration | hidden).items()}
    names = tuple(f"true_{key}" for key in hidden)
    units = _units(file, layout, tuple(hidden))
    units |= {name: unit for part in beside for name, unit in part.si_units.items()}
    if force is not None:
        forces = [f"true_{key}" for key in numbered(FORCE, file.dimension)]
        columns |= dict(zip(forces, np.asarray(jax.vmap(force)(jnp.asarray(t))).T, strict=True))
        units |= dict(zip(forces, kind.force_units, strict=True))
    warnings = *at_rest, *_limits_left(file, t, true)
    return name, file.mechanical, layout, record, names, columns, units, beside, warnings


def _motion(
    kind: AbstractKind, scenario: Scenario, machine: Any, acting: PiecewiseInputs
) -> tuple[Any, tuple[str, ...]]:
    """The motion at the beginning of each interval, and a warning where it had to be begun, or where nothing moves."""

    def simulate(**start: Any) -> tuple[Any, bool]:
        motion = simulation.simulate_piecewise(machine, kind.start(**start), acting)
        motion = jax.tree.map(np.asarray, motion)
        return motion, len(motion.y) < 2 or bool(np.ptp(motion.y, axis=0).any())

    motion, moves = simulate(q0=scenario.q0, v0=scenario.v0)
    if moves:
        return motion, ()
    remedy = "give q0, v0 or amplitude" if kind.file.mechanical else "give q0 or amplitude"
    if scenario.asks_for_motion:
        return motion, (f"nothing moves in this log; {remedy}",)
    name, values = kind.first_motion
    motion, moves = simulate(**{"q0": None, "v0": None, name: values})
    given = f"{name} = {', '.join(f'{value:g}' for value in values)}"
    began = f"from rest nothing moves here, so the log begins with {given}" if moves else "nothing moves in this log"
    return motion, (f"{began}; {remedy}" + " for another motion" * moves,)


def _limits_left(file: ModelFile, t: Float[np.ndarray, "T"], q: np.ndarray) -> tuple[str, ...]:
    """A warning if joints of a robot leave their limits."""
    space = models.robots.robot_space(file.need_mechanical("", "").space) if file.mechanical else None
    if space is None:
        return ()
    positions = np.asarray(jax.vmap(space.joint_angles)(jnp.asarray(q)))
    left = []
    for i, (name, low, high) in enumerate(space.limits):
        outside = np.maximum(low - positions[:, i], positions[:, i] - high)
        if outside.max() > LIMIT_TOLERANCE:
            first, unit = int(np.argmax(outside > LIMIT_TOLERANCE)), "rad" if space.tree.turn[i].any() else "m"
            left.append((float(t[first]), name, f"{low:g} to {high:g} {unit}", positions[np.argmax(outside), i], unit))
    if not left:
        return ()
    (start, name, limits, reached, unit), *others = sorted(left)
    too = "".join(f", {other!r} at {time:.4g} s" for time, other, *_ in others)
    return (
        f"joint {name!r} leaves its limits {limits} at t = {start:.4g} s and reaches {reached:.4g} {unit}"
        + (f"; others leave theirs: {too[2:]}" if too else "")
        + "; nothing stops a joint at its limits here: give a q0 within them and smaller amplitudes",
    )


def _sensor(name: str, kind: AbstractKind, scenario: Scenario) -> PositionSensor:
    if np.any(scenario.quantum) and not kind.has_ticks:
        raise InputError(f"quantum: ticks are of coordinates, and {name} is on a group; use noise")
    noise = amounts("noise", scenario.noise, kind.measured.names)
    quantum = amounts("quantum", scenario.quantum, kind.measured.names) if kind.has_ticks else 0.0
    return PositionSensor(scenario.rate, noise, quantum, scenario.jitter, scenario.dropout)


def _inputs(
    file: ModelFile, scenario: Scenario, t: Float[np.ndarray, "T"], read: Float[np.ndarray, "d T"]
) -> tuple[Float[np.ndarray, "T m"], PiecewiseInputs]:
    """The inputs that are logged at stamps t, and how they act, in intervals that begin at stamps and readings too."""
    names = file.columns.u
    amplitude = or_zeros("amplitude", scenario.amplitude, names)
    pace = 2 * np.pi * scenario.frequency * (1 + DETUNED * np.arange(len(names)))
    u = amplitude * np.sin(pace * t[:, None])
    stamps = np.round(t, DIGITS)
    stated = file.input_between, file.input_delay, file.input_lag
    return u, simulation.logged_inputs(stamps, u, *stated, np.append(read.ravel(), stamps), file.input_lead)


def _add_push(name: str, file: ModelFile, scenario: Scenario) -> tuple[Any, Callable[[Any], Any] | None]:
    """The model with pushes that act on it, and these as a function of time; None where nothing pushes."""
    if scenario.push is None:
        return file.model, None
    model = file.need_mechanical(name, "pushes are for")
    force = Parametric(pushes, largest=numbers("push", scenario.push, kind_of(file).estimates.names))
    return pushed(model, lambda t, q: force(t)), force


def pushed(model: MechanicalSystem, force: Callable[[Any, Any], Any]) -> MechanicalSystem:
    """The model with a force (n,) of time and configuration that acts on it."""

    def dissipation(t, q, v, u):
        return models.resistance(model, t, q, v, u) + force(t, q)

    return eqx.tree_at(lambda m: m.dissipation, model, dissipation)


def pushes(t: Any, largest: Any) -> Any:
    """Pushes (n,) at a time, as `verbs.simulate` describes them."""
    n, since = largest.shape[0], (t - FIRST_PUSH) / BETWEEN_PUSHES
    k = jnp.floor(since)
    within = jnp.clip((since - k) * BETWEEN_PUSHES / PUSH_LENGTH, 0.0, 1.0)
    # A raised cosine: it and its slope are continuous.
    height = jnp.where(k < 0, 0.0, (1 - jnp.cos(2 * jnp.pi * within)) / 2) * (1 - 2 * jnp.mod(jnp.floor(k / n), 2))
    return jnp.where(jnp.arange(n) == jnp.mod(k, n).astype(int), height * largest, 0.0)


def _layout(file: ModelFile) -> logs.Columns:
    """The columns to write; an attitude is written as qw, qx, qy, qz unless the model file names other columns, the
    second one as qw2, qx2, qy2, qz2."""
    count = file.unnamed_attitudes
    names = tuple(f"q{part}{k or ''}" for k in (0, *range(2, count + 1)) for part in "wxyz")
    return file.columns._replace(quaternion_wxyz=names) if count else file.columns


def _units(file: ModelFile, layout: logs.Columns, hidden: tuple[str, ...]) -> dict[str, str]:
    """SI units of the columns, as far as the model knows them."""
    known = file.model.logged_units
    units = {layout.t: "s"} | dict(zip(layout.q, known.get("q", ()), strict=False))
    units |= dict.fromkeys(layout.position, "m") | dict.fromkeys(layout.angle, "rad")
    truth = {name: unit for name, unit in units.items() if name != layout.t}
    truth |= dict(zip(hidden, known.get("truth", ()), strict=False))
    return units | {f"true_{name}": unit for name, unit in truth.items()}
