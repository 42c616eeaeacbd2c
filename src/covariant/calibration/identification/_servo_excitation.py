"""Servo commands for a designed motion, slow reversals and steps, and the expected errors of a fit of their log.

A servo tracks a motion if its command leads the motion by the delay, and exceeds it by the torque divided by the
stiffness. The reversals show friction and dead band; the steps and holds show delay, damping and stiffness. The
information is that of a fit that predicts positions from the commands alone: derivatives of the simulated positions
with respect to the open numbers, divided by the noise of the encoders.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.calibration._least_squares import PRIOR
from covariant.calibration.identification._excitation import Excitation, ExcitationPlan, JointLimits
from covariant.calibration.identification._expected import ExpectedErrors, Sensing
from covariant.calibration.identification._fourier import FourierMotion
from covariant.calibration.identification._robot_torques import (
    efforts,
    flattened,
    in_batches,
    inverse_inputs,
    usual_sizes,
)
from covariant.models import RobotFamily, acceleration, resistance
from covariant.models.robots import Servos, servos_in
from scalargraph.errors import InputError

PROBE_FRACTION = 1 / 3
"""Fraction of the periods that have reversals and steps in place of the motion."""
PROBE_REACH = 0.6
"""Fraction that reversals and steps use of the range on one side, and of the torque that is left while holding."""
REVERSAL_SPEED = 0.1
"""Largest speed of the slow reversals, as a fraction of the limit."""
LIMIT_STEP = 1.6
"""Size of a step that has to reach the torque limit, in multiples of limit / stiffness."""
AMPLITUDE_FACTOR, MAX_TRIES = 0.8, 12
"""Factor by which all amplitudes shrink as long as the simulation exceeds a limit, and the largest number of tries."""
TORQUE_MARGIN = 1e-3
"""Relative margin by which a torque stays below its limit, since a clipped torque equals the limit exactly."""
MAX_STEP_RATE = 0.5
"""Largest product of the simulation step and the fastest rate of the robot."""
MAX_SUBSTEPS = 64
"""Largest number of simulation steps from row to row."""
SKIPPED_TIME = 0.3
"""Time [s] at the start of a log whose rows do not count, since the first state is not known."""


class Commanded(NamedTuple):
    """Commands, and the motion that the model simulates from them.

    Attributes:
        inputs: Commands and further inputs (T, m).
        q, v: Positions and velocities (T, n).
        torque: Torques (T, n) of the servos within their limits.
        used: Largest positions, velocities and torques (3, n) as fractions of the limits.
        expected: What a log of them is expected to show; None until that is computed.
    """

    inputs: Float[np.ndarray, "T m"]
    q: Float[np.ndarray, "T n"]
    v: Float[np.ndarray, "T n"]
    torque: Float[np.ndarray, "T n"]
    used: Float[np.ndarray, "3 n"]
    expected: ExpectedErrors | None = None


class CommandedExcitation(NamedTuple):
    """A designed log of commands and a reference with one sine per joint, each with the expected errors of a fit."""

    designed: Commanded
    reference: Commanded


def of_coordinates(servos: Servos, values: Any) -> Float[np.ndarray, "n"]:
    """Torques (n,) at the coordinates from torques of their servos, such as limits; zero without a servo."""
    rows = np.abs(np.asarray(servos.rows))
    return np.sum(np.where(rows > 0, rows * np.asarray(values)[:, None], 0.0), axis=0)


def motion_periods(plan: ExcitationPlan) -> int:
    """Number of periods of the motion; the others have reversals and steps."""
    periods = round(plan.duration * plan.frequency)
    return periods - int(periods * PROBE_FRACTION)


def command_excitation(
    family: RobotFamily, limits: JointLimits, sensing: Sensing, plan: ExcitationPlan, found: Excitation
) -> CommandedExcitation:
    """Turn a designed motion into commands within the limits; `plan` describes the whole log."""
    simulation = _Simulation.of(family, sensing.rate)
    t = np.arange(round(plan.duration * sensing.rate) + 1) / sensing.rate
    asked = {n.target for n in family.numbers if n.group == "servo" and n.number == "limit"}
    # A servo may reach its own limit if that limit is to be fitted and is the smallest one.
    own_limit = of_coordinates(simulation.servos, simulation.servos.limit)
    limited = np.array([name in asked for name in limits.names]) & (own_limit <= limits.effort)
    moving = motion_periods(plan) / plan.frequency
    designed = _commanded(simulation, limits, plan, t, found.designed.motion, moving, limited)
    reference = _commanded(simulation, limits, plan, t, found.reference.motion, plan.duration, np.zeros_like(limited))
    both = (each._replace(expected=_expected(family, simulation, each, sensing)) for each in (designed, reference))
    return CommandedExcitation(*both)


def _commanded(
    simulation: "_Simulation",
    limits: JointLimits,
    plan: ExcitationPlan,
    t: np.ndarray,
    motion: FourierMotion,
    moving: float,
    limited: np.ndarray,
) -> Commanded:
    """Scale the motion down until commands, positions, speeds and torques are within the limits."""
    inner, probes, length = limits.within(plan.margin), t > moving, plan.duration - moving
    largest_use = np.ones(len(limits.names))
    for factor in AMPLITUDE_FACTOR ** np.arange(MAX_TRIES):
        inputs = simulation.commands(motion.scaled(factor), t, moving)
        if probes.any():
            inputs[probes] += simulation.probes(t[probes] - moving, length, inner, inputs[0], limited, factor)
        asked = simulation.positions(inputs)
        reached = np.abs((asked - limits.middle) / limits.room).max(axis=0)
        q, v, torque = simulation.run(inputs)
        used = limits.used(q, v, torque)
        if not np.isfinite(used).all():
            raise InputError("the simulation of the commands is not stable: give a higher rate, or a larger armature")
        # A torque limit that is to be fitted has to be reached.
        largest_use = np.max([used[0], used[1], np.where(limited, 0.0, used[2] * (1 + TORQUE_MARGIN)), reached], axis=0)
        if largest_use.max() <= 1:
            return Commanded(inputs, q, v, torque, used)
    joint = limits.names[int(np.argmax(largest_use))]
    raise InputError(
        f"joint {joint!r}: no commands were found that keep its limits of position, speed and torque; give a larger "
        "region, velocity or effort"
    )


class _Simulation(NamedTuple):
    """Simulation of the robot of a family with commands held from row to row, differentiable in its open numbers."""

    model: Any
    servos: Servos
    flat: np.ndarray
    positions_at: Callable[..., Any]
    slopes_at: Callable[..., Array]

    @classmethod
    def of(cls, family: RobotFamily, rate: float) -> "_Simulation":
        x = np.zeros(len(family.names))
        arrays, robot = flattened(family)
        model: Any = family.make(x)
        servos = servos_in(model)
        assert servos is not None
        if servos.rows.shape[0] != servos.rows.shape[1]:
            raise InputError("commands are designed for robots of which each joint has a servo; lock the others")
        substeps = int(np.clip(np.ceil(_fastest(model) / rate / MAX_STEP_RATE), 1, MAX_SUBSTEPS))
        step = 1 / rate / substeps

        @jax.jit
        def positions(flat: Array, inputs: Array, start: Array) -> tuple[Array, Array, Array]:
            return _simulated(robot(flat), inputs, start, step, substeps)

        flat, to_arrays = np.asarray(arrays(x)), np.asarray(jax.jit(jax.jacfwd(arrays))(x))

        @jax.jit
        def slopes(inputs: Array, start: Array) -> Array:
            def one_direction(slope: Array) -> Array:
                return jax.jvp(lambda part: positions(part, inputs, start)[0], (flat,), (slope,))[1]

            return jax.vmap(one_direction, in_axes=1, out_axes=2)(jnp.asarray(to_arrays))

        return cls(model, servos, flat, positions, slopes)

    def run(self, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities and torques (T, n) at the rows."""
        q, v, torque = self.positions_at(self.flat, inputs, self._start(inputs))
        return np.asarray(q), np.asarray(v), np.asarray(torque)

    def derivatives(self, inputs: np.ndarray) -> Float[np.ndarray, "T n p"]:
        """Derivatives of the positions in the open numbers."""
        return np.asarray(self.slopes_at(inputs, self._start(inputs)))

    def _start(self, inputs: np.ndarray) -> np.ndarray:
        # The command of the first row holds the robot at its first position.
        return self.places(inputs[:1])[0]

    def places(self, inputs: np.ndarray) -> np.ndarray:
        """Equilibrium positions (T, n) under these inputs, near the commanded positions."""
        place, gain = self.positions(inputs), inverse_inputs(self.model)
        for _ in range(20):
            still = np.zeros_like(place)
            sag = gain.apply(in_batches(efforts, self.model, place, still, still)[:, 0], place, still) - inputs
            place = place - self.positions(sag, 0.0)
        return place

    def positions(self, inputs: np.ndarray, offset: float = 1.0) -> np.ndarray:
        """Commanded positions (T, n) of inputs (T, m)."""
        servos = self.servos
        asked = inputs @ np.asarray(servos.commands).T + offset * np.asarray(servos.offset - servos.zero)
        return asked @ np.linalg.inv(np.asarray(servos.rows)).T

    def commands(self, motion: FourierMotion, t: np.ndarray, moving: float) -> np.ndarray:
        """Inputs (T, m) with which the servos track a motion, and hold its first position when it is over."""
        servos, gain = self.servos, inverse_inputs(self.model)
        ahead, inputs = np.asarray(servos.delay - servos.lead), []
        for j, shift in enumerate(ahead):
            at = np.clip(t + shift, 0.0, moving)
            q, v, a = motion.at(at)
            over = (at >= moving) | (at <= 0)
            v, a = np.where(over[:, None], 0.0, v), np.where(over[:, None], 0.0, a)
            inputs.append(gain.apply(in_batches(efforts, self.model, q, v, a)[:, 0], q, v)[:, j])
        return np.stack(inputs, axis=1)

    def probes(
        self, t: np.ndarray, length: float, inner: JointLimits, held: np.ndarray, limited: np.ndarray, factor: float
    ) -> np.ndarray:
        """Slow reversals over the first half, then steps with holds, to be added to the inputs `held`."""
        place = self.places(held[None])[0]
        up, down = inner.high - place, place - inner.low
        side = np.where(up >= down, 1.0, -1.0)
        room = PROBE_REACH * np.maximum(up, down)
        still = np.zeros((1, len(place)))
        holding = np.abs(in_batches(efforts, self.model, place[None], still, still)[0, 0])
        rows = np.abs(np.asarray(self.servos.rows))
        stiffness = of_coordinates(self.servos, np.asarray(self.servos.stiffness) * rows.sum(axis=1))
        step = np.minimum(room, PROBE_REACH * np.maximum(inner.effort - holding, 0.0) / stiffness)
        step = np.where(limited, np.minimum(up + down, LIMIT_STEP * inner.effort / stiffness), step)
        slow = np.minimum(room, REVERSAL_SPEED * inner.velocity * length / 8)
        phase = t / length
        # Two triangles, then a step up, back, half up and back.
        wave = 1 - np.abs(1 - np.mod(8 * phase, 2))
        level = np.select([phase < 0.5, phase < 0.65, phase < 0.8, phase < 0.9], [0.0, 1.0, 0.0, 0.5], 0.0)
        wave = np.where(phase < 0.5, wave, 0.0)
        moved = factor * side * (wave[:, None] * slow + level[:, None] * step)
        servos = self.servos
        return moved @ np.asarray(servos.rows).T @ np.linalg.pinv(np.asarray(servos.commands)).T


def _fastest(model: Any) -> float:
    """Largest rate [1/s] of the robot at rest: damping rate or natural frequency of its servos."""
    q = jnp.asarray(model.manifold.origin())
    n = len(q)
    u, t, zero = jnp.zeros(model.inputs), jnp.zeros(()), jnp.zeros(n)
    braking = -np.asarray(jax.jit(jax.jacfwd(lambda v: resistance(model, t, q, v, u)))(zero))
    servos = servos_in(model)
    assert servos is not None
    rows = np.asarray(servos.rows)
    holding = rows.T @ (np.asarray(servos.stiffness)[:, None] * rows)
    inertia = np.asarray(jax.jit(model.space)(q))
    damped, sprung = (np.linalg.eigvals(np.linalg.solve(inertia, part)) for part in (braking, holding))
    return float(max(np.abs(damped).max(), np.sqrt(np.abs(sprung).max())))


def _simulated(
    model: Any, inputs: Array, start: Array, step: float, substeps: int
) -> tuple[Float[Array, "T n"], Float[Array, "T n"], Float[Array, "T n"]]:
    """Positions, velocities and torques at the rows, by symplectic Euler steps, which suit stiff servos."""
    servos: Any = servos_in(model)
    count = len(inputs)
    length = step * substeps

    def acting(k: Array) -> Array:
        """Mean over step k of inputs that are held from row to row and delayed; piecewise linear in the delay."""
        place = (k * step - servos.delay) / length
        row = jnp.floor(place)
        # Fraction of the step that lies in the next row.
        part = jnp.clip((place - row) * substeps - (substeps - 1), 0.0, 1.0)

        def at(shift: int) -> Array:
            rows = jnp.clip(row.astype(int) + shift, 0, count - 1)
            return jnp.take_along_axis(inputs, rows[None], axis=0)[0]

        return (1 - part) * at(0) + part * at(1) + servos.lead * (at(0) - at(-1)) / length

    t = jnp.zeros(())

    def advance(x: tuple[Array, Array], u: Array) -> tuple[tuple[Array, Array], None]:
        q, v = x
        v = v + step * acceleration(model, t, q, v, u)
        return (q + step * v, v), None

    def simulate_row(x: tuple[Array, Array], u: Array) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        q, v = x
        torque = servos.rows.T @ (servos.torque(q, v, u[0]) + servos.back_emf * (servos.rows @ v))
        return jax.lax.scan(advance, x, u)[0], (q, v, torque)

    u = jax.vmap(acting)(jnp.arange(count * substeps, dtype=float)).reshape(count, substeps, -1)
    return jax.lax.scan(simulate_row, (start, jnp.zeros_like(start)), u)[1]


def _expected(family: RobotFamily, simulation: _Simulation, commanded: Commanded, sensing: Sensing) -> ExpectedErrors:
    """Standard errors of a fit that predicts the positions of the whole log from its commands."""
    forgotten = int(np.ceil(SKIPPED_TIME * sensing.rate))
    rows = simulation.derivatives(commanded.inputs)[forgotten:] / sensing.noise[:, None]
    a = np.gradient(commanded.v, 1 / sensing.rate, axis=0)
    sizes, _ = usual_sizes(family, commanded.torque, commanded.torque, commanded.v, a)
    scaled = rows * sizes
    information = np.einsum("tjp,tjq->pq", scaled, scaled)
    covariance = np.linalg.inv(information + np.eye(len(sizes)) / PRIOR**2)
    return ExpectedErrors.of(family, sizes, information, covariance)
