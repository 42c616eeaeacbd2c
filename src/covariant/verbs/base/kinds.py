"""The kinds of models: in coordinates, on a group, and in state-space form."""

import abc
import math
from collections.abc import Callable, Collection, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant import logs, models, scoring, simulation
from covariant._integrate import rk4
from covariant.calibration import (
    DataSheet,
    Trial,
    first_estimate,
    observer_gains,
    outliers,
    state_noise,
    tuned_estimators,
    tuned_state_estimators,
)
from covariant.codegen import ROWS, Signals
from covariant.models import ModelFile, Motion
from covariant.observers import AbstractObserver, on_legs
from covariant.simulation import PositionSensor
from covariant.verbs.base.arguments import Amounts, numbers
from covariant.verbs.base.kind import AbstractKind, Labels, numbered
from scalargraph.errors import InputError

CENTRE, SWING = 0.7, 0.2
"""Centre and amplitude of the positions in the self-test, in units of the coordinates; on circles the centre is π."""
OUTLIER_ROW, OUTLIER = 23, 1.5
"""The row of the self-test that a gate has to refuse, and how far it is off [rad or m]."""
MOST_MOVED = 20.0
"""How many times as far as in half of the log another joint moves with the measured one near a dead centre."""
USE_TORQUES = "intrinsic-kalman", "ukf"
"""Observers whose noise may depend on the configuration, as that of torques does."""
WITH_FORCE = "intrinsic-force"
"""The observer with constant gains that estimates an unknown force."""
NO_FORCE = (
    "It learns no force: the model file tells neither `force_rate` in [design], nor the size of a force in "
    "[uncertainty]."
)


class AbstractMechanical(AbstractKind):
    """A mechanical system, whose velocity is estimated."""

    what = "velocity"
    title = "Velocities"
    without_gate = (
        "It has no gate and refuses no measurement, since the model file tells no noise: add `std` to [measurement] "
        "and `acceleration` to [uncertainty]."
    )
    gates = " All are behind a gate that refuses outliers."

    def slopes(self, log: logs.Log) -> tuple[np.ndarray, str]:
        full, at = log.all_rows, np.asarray(log.record.t)
        t, y, order = np.asarray(full.t), self.complete(np.asarray(full.y)), int(self.file.reference_order)
        if np.isfinite(y).sum(axis=0).min() < order + 3:  # a polynomial of this order needs more than its coefficients
            return np.full((len(at), self.file.dimension), np.nan), "velocity, unknown in so short a log"
        return self._slopes(t, y, at, self.file.reference_half, order), "zero-phase reference"

    @abc.abstractmethod
    def _slopes(self, t: np.ndarray, y: np.ndarray, at: np.ndarray, half: float, order: int) -> np.ndarray:
        """Velocities (S, n) at the times `at` (S,), from readings shifted back by their delays."""

    def tuned(
        self, sheet: Callable[[], DataSheet], rate: float, names: Collection[str], trial: Trial | None = None
    ) -> dict[str, AbstractObserver]:
        return tuned_estimators(self.model, self.file.dimension, sheet(), rate, trial, names)

    def note(self, sheet: Callable[[], DataSheet], rate: float, name: str | None = None) -> str:
        if name is None:
            return f"All tuned from one data sheet; the observers have {observer_gains(sheet(), rate).summary}."
        if name != WITH_FORCE:
            return f"Designed {observer_gains(sheet(), rate).summary}."
        gains = observer_gains(sheet(), rate, self.model.space)
        return f"Designed {gains.summary}." + ("" if gains.force_rate else f" {NO_FORCE}")

    def unused(self, observer: AbstractObserver, name: str, sensors: bool) -> str:
        file, text = self.file, ""
        stated = {
            "the external force of [uncertainty]": file.external_force or file.external_force_std,
            "the bias of [measurement]": file.bias,
            "the parameters of [uncertainty]": file.family,
            "the presliding friction of [uncertainty]": any(np.ravel(file.presliding)) or None,
            "the forces of [wrench]": file.wrenches or None,
            "what [sensors] read": sensors or None,
        }
        if name == WITH_FORCE:
            del stated["the external force of [uncertainty]"]
        asked = [what for what, value in stated.items() if value is not None]
        if asked and (name == WITH_FORCE or not (observer.slow_names or observer.sensors)):
            text = f" It does not estimate {' and '.join(asked)}; intrinsic-kalman does."
        if file.torque_std is not None and name not in USE_TORQUES:
            text += f" It does not use the torque of [uncertainty]; {' and '.join(USE_TORQUES)} do."
        return text

    def self_test(self, rate: float, sheet: Callable[[], DataSheet] | None) -> np.ndarray:
        k, n = np.arange(ROWS + 1)[:, None], self.file.dimension
        pace = math.inf if sheet is None else float(np.min(sheet().speeds)) / rate  # largest change between rows
        # Each coordinate has a different period and phase, so that no two are equal.
        swing = min(SWING, 4.0 * pace) * np.sin(k / (4.0 + np.arange(n)) + np.arange(n))
        if sheet is not None:
            swing[OUTLIER_ROW, 0] += OUTLIER
        return self._displaced(swing)

    @abc.abstractmethod
    def _displaced(self, displacement: np.ndarray) -> np.ndarray:
        """Configurations (T, *n) at these displacements (T, n) from the centre of the self-test."""

    def start(self, q0: Amounts | None, v0: Amounts | None) -> Any:
        q, v = or_zeros("q0", q0, self._start_names), or_zeros("v0", v0, self.estimates.names)
        manifold = self.model.manifold
        if manifold.redundant and manifold.commuting:
            # A linkage begins as it is assembled, or near the positions that are given.
            start = manifold.origin() if q0 is None else manifold.checked(jnp.asarray(q))
            return self.model.state(Motion(start, self.model.space.projected(start, jnp.asarray(v))))
        return self.model.state(Motion(manifold.retract(manifold.origin(), jnp.asarray(q)), jnp.asarray(v)))

    @property
    def first_motion(self) -> tuple[str, list[float]]:
        return "v0", [1.0] * self.file.dimension

    @property
    @abc.abstractmethod
    def _start_names(self) -> tuple[str, ...]:
        """Names of the components of a displacement from the origin."""

    def truth(self, layout: logs.Columns, y: np.ndarray, x: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        velocities = np.asarray(self.model.motion(x).v).T
        return logs.to_columns(layout, y), dict(zip(self.estimates.names, velocities, strict=True))

    def _input_labels(self, inputs: int) -> Labels:
        # A system of this library with as many inputs as velocities takes generalised forces.
        names = _input_names(self.file, inputs)
        if self.model.input_units:
            return Labels(names, self.model.input_units)
        if self.file.system and inputs == self.file.dimension:
            return Labels(names, self.force_units)
        stated = [self.file.columns.unit_of("u", place) for place in range(inputs)]
        return Labels(names, tuple(_unit_of_force(text) if text else "" for text in stated))


class InCoordinates(AbstractMechanical):
    """A mechanical system in coordinates."""

    @property
    def positions(self) -> Labels:
        return self.axes

    @property
    def measured(self) -> Labels:
        return Labels(self.file.columns.q, self.axes.units)

    @property
    def message_columns(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        joints = [name.removesuffix("/position") for name in self.file.columns.q]
        return tuple(f"{name}/position" for name in joints), tuple(f"{name}/velocity" for name in joints)

    @property
    def _start_names(self) -> tuple[str, ...]:
        return self.file.columns.q

    def check(self, y: np.ndarray) -> None:
        manifold = self.model.manifold
        measured = np.asarray(manifold.origin())[None] if manifold.redundant else y[np.isfinite(y).all(axis=1)]
        models.check_metric(self.model, measured[:: max(1, len(measured) // 20)])

    def _slopes(self, t: np.ndarray, y: np.ndarray, at: np.ndarray, half: float, order: int) -> np.ndarray:
        y = scoring.unwrap(self.without_outliers(t, y), self.model.circles)
        delays = np.broadcast_to(np.asarray(self.file.delay, float), y.shape[1])
        slopes = np.empty((len(at), y.shape[1]))
        for delay in np.unique(delays):
            same_delay = delays == delay
            # A row at t shows the position at t − delay.
            slopes[:, same_delay] = scoring.zero_phase_velocity(t - delay, y[:, same_delay], at, half, order)
        return slopes

    def without_outliers(self, t: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.where(outliers(t, y, self.model.circles)[0], np.nan, y)

    def complete(self, y: np.ndarray) -> np.ndarray:
        manifold, lacking = self.model.manifold, np.isnan(y).all(axis=0)
        if not manifold.redundant or not lacking.any():
            return y
        first, rows = manifold.checked(jnp.asarray(y[0])), jnp.asarray(y)

        def follow(q, row):
            q = manifold.measured(q, row)
            return q, q

        whole = np.asarray(jax.jit(lambda: jax.lax.scan(follow, first, rows)[1])())
        known = np.all(lacking | np.isfinite(y), axis=1, keepdims=True)
        return np.where(lacking & known, whole, y)

    def dead_centre(self, y: np.ndarray, whole: np.ndarray) -> int | None:
        manifold, present = self.model.manifold, ~np.isnan(y).all(axis=0)
        if not manifold.redundant or present.all():
            return None
        axes, shown = jnp.eye(y.shape[1])[np.flatnonzero(present)], jnp.asarray(present)
        moved = jax.vmap(lambda q: jnp.max(jnp.abs(jax.vmap(lambda e: manifold.shown(q, shown, e))(axes))))
        ratio = np.asarray(jax.jit(moved)(jnp.asarray(whole)))
        near = ratio > MOST_MOVED * np.nanmedian(ratio)
        return int(near.argmax()) if near.any() else None

    def drawn(self, y: np.ndarray) -> np.ndarray:
        return scoring.unwrap(y, self.model.circles)

    def configuration(self, x: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return dict(zip(names, np.split(np.asarray(x), 2, axis=1)[0].T, strict=True))

    def _displaced(self, displacement: np.ndarray) -> np.ndarray:
        manifold = self.model.manifold
        if manifold.redundant:  # moved as it is assembled; an outlier is not along the motion
            small, begin = np.clip(displacement, -SWING, SWING), manifold.origin()
            moved = jax.jit(jax.vmap(lambda s: manifold.retract(begin, self.model.space.projected(begin, s))))(small)
            return np.asarray(moved) + displacement - small
        circles = np.isin(np.arange(self.file.dimension), manifold.circles)
        return displacement + np.where(circles, np.pi, CENTRE)

    def signals(self, inputs: int, sensors: tuple[str, ...]) -> Signals:
        columns, axes = self.file.columns.q, self.axes
        q = Labels(columns if len(columns) == self.file.dimension else axes.names, axes.units).headings
        u = self._input_labels(inputs).headings
        return Signals(q + sensors, u, (("q", q), ("v", self.estimates.headings)))


class OnGroup(AbstractMechanical):
    """A mechanical system on a Lie group, whose configuration is made of matrices."""

    has_ticks = False

    @property
    def measured(self) -> Labels:
        # An innovation is a displacement along each velocity.
        units = (unit.removesuffix("/s") if unit.endswith("/s") else "" for unit in self.model.velocity_units)
        return Labels(self.model.velocities, tuple(units))

    @property
    def _start_names(self) -> tuple[str, ...]:
        return numbered("q", self.file.dimension)

    def with_inputs(self, log: logs.Log) -> logs.Log:
        if self.file.columns.u:
            return log
        # The model file of a body in free flight names no input columns.
        count = models.input_count(self.model, self.file.dimension)
        parts = {"record": log.record} | ({} if log.whole is None else {"whole": log.whole})
        return log._replace(**{name: each._replace(u=np.zeros((len(each.t), count))) for name, each in parts.items()})

    def _slopes(self, t: np.ndarray, y: np.ndarray, at: np.ndarray, half: float, order: int) -> np.ndarray:
        # All parts of a pose are read at the same time, so there is one delay.
        t, columns = t - np.max(self.file.delay), self.file.columns
        twists = [
            scoring.zero_phase_twist(t, g, at, half, order, body.space)
            for body, g in zip(logs.bodies(columns), logs.matrices(columns, y), strict=True)
        ]
        joints = logs.coordinates(columns, y)
        # The joints are the last columns of a configuration, and circles are counted over all of them.
        circles = tuple(i - (y.shape[1] - joints.shape[1]) for i in self.model.circles)
        if joints.size:
            twists.append(scoring.zero_phase_velocity(t, scoring.unwrap(joints, circles), at, half, order))
        return np.concatenate(twists, axis=1)

    def configuration(self, x: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return logs.to_columns(self.file.columns, np.asarray(x.q))

    def _displaced(self, displacement: np.ndarray) -> np.ndarray:
        manifold = self.model.manifold
        return np.stack([np.asarray(manifold.retract(manifold.origin(), jnp.asarray(each))) for each in displacement])

    def signals(self, inputs: int, sensors: tuple[str, ...]) -> Signals:
        whole = ("the configuration, its matrices by rows; rotations have no unit, positions are in m, angles in rad",)
        return Signals(whole, self._input_labels(inputs).headings, (("v", self.estimates.headings),))

    def sense(self, sensor: PositionSensor, y: np.ndarray, seed: int) -> np.ndarray:
        # Errors are rotations and translations in the body frame.
        error = simulation.sense(sensor, np.zeros((len(y), len(self.model.velocities))), seed)
        # NaN marks a dropout; the retraction gets zeros instead, and its result is replaced by NaN below.
        measured = np.asarray(jax.vmap(self.model.manifold.retract)(y, jnp.nan_to_num(error)))
        return np.where(np.isnan(error).any(axis=1).reshape(-1, *(1,) * (measured.ndim - 1)), np.nan, measured)


class InStates(AbstractKind):
    """A state-space model, all states of which are estimated from its outputs."""

    what = "state"
    title = "States"
    draws_innovations = False
    makes_up_for_delays = False
    without_gate = "It has no gate, on a log either, and refuses no measurement."

    @property
    def measured(self) -> Labels:
        return Labels(self.file.columns.q, self.model.output_units)

    def slopes(self, log: logs.Log) -> None:
        return None

    def configuration(self, x: Any, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        return {}

    def tuned(
        self, sheet: Callable[[], DataSheet], rate: float, names: Collection[str], trial: Trial | None = None
    ) -> dict[str, AbstractObserver]:
        return tuned_state_estimators(self.model, state_noise(self.file, rate), names)

    def note(self, sheet: Callable[[], DataSheet], rate: float, name: str | None = None) -> str:
        start, deviation = first_estimate(self.file)
        named = zip(self.estimates.names, start, deviation, self.estimates.units, strict=True)
        first = ", ".join(f"{name} {x:.4g} ± {std:.3g} {unit}".rstrip() for name, x, std, unit in named)
        return f"Designed from the noise in the model file; first estimate {first}."

    def self_test(self, rate: float, sheet: Callable[[], DataSheet] | None) -> np.ndarray:
        # Outputs of the model that starts at the first estimate, without inputs.
        model, u, dt = self.model, jnp.zeros(self.model.inputs), 1 / rate

        def step(x: Array, t: Array) -> tuple[Array, Array]:
            return rk4(lambda s, x: model.f(s, x, u), t, x, dt, 1), model.h(t, x, u)

        times = jnp.arange(ROWS + 1.0) * dt
        return np.asarray(jax.lax.scan(step, first_estimate(self.file)[0], times)[1])

    def signals(self, inputs: int, sensors: tuple[str, ...]) -> Signals:
        y = Labels(self.file.columns.q, self.model.output_units).headings
        u = Labels(_input_names(self.file, inputs), self.model.input_units).headings
        return Signals(y, u, (("x", self.estimates.headings),))

    def start(self, q0: Amounts | None, v0: Amounts | None) -> Any:
        if v0 is not None:
            raise InputError("v0: a state-space model has no velocities; give all its initial state by q0")
        return or_zeros("q0", q0, self.estimates.names)

    @property
    def first_motion(self) -> tuple[str, list[float]]:
        # Off the middle of the box in which the model is valid, where it has one.
        box = self.model.box or ((0.0, 4 / 3),) * self.file.dimension
        return "q0", [float(low + 0.75 * (high - low)) for low, high in box]

    def truth(self, layout: logs.Columns, y: np.ndarray, x: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        return {}, dict(zip(self.model.coordinates, x.T, strict=True))


class OnLegs(InStates):
    """The base of a robot on legs: its outputs are the joints, which its states do not tell."""

    makes_up_for_delays = True
    without_gate = "A foot that is off its anchor is refused, and anchored anew where the encoders say it is."

    def self_test(self, rate: float, sheet: Callable[[], DataSheet] | None) -> np.ndarray:
        k, outputs, joints = np.arange(ROWS + 1)[:, None], len(self.model.outputs), self.model.f.joints
        y = CENTRE + SWING * np.sin(k / (4.0 + np.arange(outputs)) + np.arange(outputs))
        return np.where(np.arange(outputs) < joints, y, k % 3 < 2)  # flags of contact come and go

    def start(self, q0: Amounts | None, v0: Amounts | None) -> Any:
        raise InputError(f"{self.file.name}: how the legs move is no part of the model, so that it cannot be simulated")

    def note(self, sheet: Callable[[], DataSheet], rate: float, name: str | None = None) -> str:
        return "Designed from the noise of IMU and encoders and from the slip of feet in the model file."


def kind_of(file: ModelFile) -> AbstractKind:
    """The kind of the model of a model file."""
    if not file.mechanical:
        return OnLegs(file) if on_legs(file.model) else InStates(file)
    return InCoordinates(file) if file.model.manifold.commuting else OnGroup(file)


def _unit_of_force(text: str) -> str:
    """The unit that a model takes for an input that is logged in another one of the same kind."""
    return next((unit for unit in logs.MEANT["u"] if logs.is_unit_of(text, (unit,))), "")


def _input_names(file: ModelFile, count: int) -> tuple[str, ...]:
    return file.columns.u if len(file.columns.u) == count else numbered("u", count)


def or_zeros(argument: str, values: Amounts | None, names: Sequence[str]) -> Float[np.ndarray, "n"]:
    """Numbers of an argument, one for each name; zeros if it is None."""
    return np.zeros(len(names)) if values is None else numbers(argument, values, names)
