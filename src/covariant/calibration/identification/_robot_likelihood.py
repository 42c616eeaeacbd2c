"""Numbers of a robot that explain logs best: those of the greatest likelihood, from those by residual torques.

Torques over windows know nothing of the motion from one window to the next. Where the noise is that of an encoder, the
positions of a whole log tell much more, and a short log is enough.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant.calibration._least_squares import PRIOR, Fixed, Point
from covariant.calibration.identification._error_model import ErrorModel, assembled
from covariant.calibration.identification._fit import ACCURACY, DIFFERENT, Solved, begun, likeliest
from covariant.calibration.identification._likelihood import stable_steps
from covariant.calibration.identification._robot_fit import RobotFit, accelerations, driving, rounded_values
from covariant.calibration.identification._robot_torques import (
    Determined,
    Torques,
    needed,
    sticking_speeds,
    usual_sizes,
)
from covariant.calibration.identification._rows import Rows
from covariant.geometry import AbstractManifold
from covariant.models import MechanicalSystem, Motion, RobotFamily

STEEPEST = 10
"""Most Runge–Kutta steps in a row of which the linear model of a row is good: where dry friction is so steep that it
would take more, a joint stops or reverses between two rows, and residual torques say more of it."""


@dataclass(frozen=True, eq=False)
class RobotUnknowns:
    """Coordinates of a robot's open numbers, relative to their usual sizes (p,); zero at the first values.

    Below the speeds `sticking` (n,) dry friction may be anything, so that no number is read from a joint's torque.
    """

    family: RobotFamily
    sizes: Float[np.ndarray, "p"]
    sticking: Float[np.ndarray, "n"]
    torques: Torques
    accelerations: Callable[..., np.ndarray]
    rates: Callable[..., np.ndarray]
    inertias: Callable[..., np.ndarray]
    first: Float[np.ndarray, "p"]
    parts: Int[np.ndarray, "M k"]
    manifold: AbstractManifold

    @classmethod
    def of(cls, family: RobotFamily, rows: Rows) -> "RobotUnknowns":
        """The numbers with usual sizes and speeds in the motion of rows."""
        q, v = (np.asarray(each)[: rows.used] for each in rows.start)
        u = np.asarray(rows.inputs)[np.asarray(rows.rows)[: rows.used]]
        a = np.diff(v, axis=0, append=v[-1:]) / rows.step
        a[np.asarray(rows.fresh)[1 : rows.used].nonzero()] = 0.0
        torques, first = Torques.of(family), np.zeros(len(family.names))
        both = torques.rows(driving)(first, u), torques.rows(needed)(first, q, v, a)
        sizes, speed = usual_sizes(family, *both, v, a)
        functions = map(torques.rows, (accelerations, _rates, lambda model, q: model.space(q)))
        rest: Any = *functions, first, family.parts, family.file.model.manifold
        return cls(family, sizes, sticking_speeds(family, speed), torques, *rest)

    def model(self, z: Array, _machine: int = 0) -> Any:
        """The model at relative coordinates z (p,)."""
        return self.family.make(z * self.sizes)

    def moved(self, z: np.ndarray, dz: np.ndarray) -> np.ndarray:
        """Coordinates (p,) after a step."""
        return np.maximum(z + dz, self.family.least / self.sizes)

    def lowest(self, z: np.ndarray) -> Float[np.ndarray, "p"]:
        """Least steps (p,) that the bounds of the numbers permit."""
        return self.family.least / self.sizes - z

    def fixed_at(self, z: np.ndarray) -> Float[np.ndarray, "p"]:
        """Coordinates (p,) at which undetermined combinations are fixed: those of the first values."""
        return np.zeros_like(z)


def linearised_robot(unknowns: RobotUnknowns, z: Array, run: Motion, rows: Rows, _steps: Any) -> ErrorModel:
    """Linearise a robot along a run: in its state by exponentials, in its numbers by torques.

    Dry friction of light joints is so steep that explicit steps would have to be tiny: each half of a step is the exact
    solution of the equations linearised at its beginning (Hochbruck & Ostermann 2010, Exponential integrators, Acta
    Numerica 19, section 2), extrapolated with that of the whole step. Torques are fewer than numbers, so that their
    derivatives cost less than those of a step in each number.
    """
    x, n = np.asarray(z) * unknowns.sizes, run.v.shape[1]
    q, v = np.asarray(run.q), np.asarray(run.v)
    u, fresh = np.asarray(rows.inputs)[np.asarray(rows.rows)][:-1], np.asarray(rows.fresh)
    dt = np.where(fresh[1:], 0.0, np.diff(np.asarray(rows.t)))
    start, then = (np.concatenate([q[at], v[at]], axis=1) for at in (slice(-1), slice(1, None)))
    whole, first_half = _exponentials(unknowns, x, start, u, (dt, dt / 2))
    (second_half,) = _exponentials(unknowns, x, start + first_half[:, :, -1], u, (dt / 2,))
    halves = first_half[:, :, -1] + second_half[:, :, -1]
    defect = start + (4 * halves - whole[:, :, -1]) / 3 - then
    transition = 2 * second_half[:, :, :-1] @ first_half[:, :, :-1] - whole[:, :, :-1]
    changes = []
    # Inputs of the row before act in a step, from its beginning to its end.
    for at in (slice(None, -1), slice(1, None)):
        a = unknowns.accelerations(x, q[at], v[at], u, np.ones_like(v[:-1]))
        torque = unknowns.torques.derivatives(x, q[at], v[at], a, u)
        torque *= (np.abs(v[at]) >= unknowns.sticking)[:, :, None]
        changes.append(-np.linalg.solve(unknowns.inertias(x, q[at]), torque))
    begin, end = changes
    h = dt[:, None, None]
    # What a number changes at the beginning of a step is damped until its end.
    damped = transition[:, n:, n:] @ begin
    slopes = np.concatenate([h**2 * (begin / 3 + end / 6), h * (damped + end) / 2], axis=1) * unknowns.sizes
    linear = transition, defect, slopes, np.linalg.inv(unknowns.inertias(x, q[:-1]))
    valid = np.stack([np.isfinite(part.reshape(len(dt), -1)).all(axis=1) for part in linear]).all(axis=0)
    linear = [jnp.asarray(np.where(valid.reshape(-1, *[1] * (part.ndim - 1)), part, np.nan)) for part in linear]
    return assembled(unknowns.manifold, linear, jnp.asarray(dt), run, rows)


def _exponentials(
    unknowns: RobotUnknowns,
    x: Float[np.ndarray, "p"],
    state: Float[np.ndarray, "T n2"],
    u: Float[np.ndarray, "T m"],
    times: Sequence[Float[np.ndarray, "T"]],
) -> list[Float[np.ndarray, "T n2 n21"]]:
    """For each time the transition of errors, and in the last column the change of the state, linearised."""
    from scipy.linalg import expm

    n, count = state.shape[1] // 2, len(state)
    q, v = state[:, :n], state[:, n:]
    rates = unknowns.rates(x, q, v, u)
    matrix = np.zeros((count, 2 * n + 1, 2 * n + 1))
    matrix[:, :n, n : 2 * n], matrix[:, :n, -1] = np.eye(n), v
    matrix[:, n : 2 * n] = rates
    finite: Any = np.isfinite(np.sum(rates, axis=(1, 2), keepdims=True))
    return [np.where(finite, expm(np.where(finite, matrix, 0.0) * h[:, None, None])[:, :-1], np.nan) for h in times]


def _rates(model: MechanicalSystem, q: Array, v: Array, u: Array) -> Float[Array, "n n21"]:
    """Derivatives (n, 2n) of the accelerations in position and velocity, and these themselves as the last column."""
    n = len(q)

    def acceleration(state: Array) -> tuple[Array, Array]:
        a = accelerations(model, state[:n], state[n:], u, jnp.ones(n))
        return a, a

    slopes, a = jax.jacfwd(acceleration, has_aux=True)(jnp.concatenate([q, v]))
    return jnp.concatenate([slopes, a[:, None]], axis=1)


def likeliest_robot(
    unknowns: RobotUnknowns, found: RobotFit, rows: Rows, progress: Callable[[int, int], object] = lambda *_: None
) -> RobotFit:
    """The numbers of greatest likelihood near those of a fit by residual torques; these where friction is too steep."""
    start = unknowns.moved(found.coordinates / unknowns.sizes, np.zeros_like(unknowns.sizes))
    if stable_steps(unknowns, start, rows) > STEEPEST:
        return found
    problem, bounds = begun(unknowns, rows, None, linearised_robot)
    point = Point.at(problem, start)
    if not np.isfinite(point.blocks.loss).all():
        return found
    begin: Any = unknowns.family, None, problem, point, Fixed.nothing(len(start)), bounds
    return _concluded(found, unknowns, likeliest(Solved(*begin), progress).point)


def _concluded(found: RobotFit, unknowns: RobotUnknowns, point: Point) -> RobotFit:
    """The fit with the numbers of a point, and their standard errors."""
    family = unknowns.family
    x, sizes, blocks = point.z * unknowns.sizes, unknowns.sizes, point.blocks
    covariance = np.linalg.inv(blocks.information + np.eye(len(x)) / PRIOR**2) + ACCURACY**2 * np.eye(len(x))
    if blocks.overdispersion > DIFFERENT**2:
        covariance = covariance * blocks.overdispersion
    outer = np.outer(sizes, sizes)
    known = Determined.of(family, x, sizes, blocks.information / outer, covariance * outer)
    values = rounded_values(np.asarray(jax.jit(family.values)(x)), family.first, known.prior)
    named = dict(zip(("standard_errors", "determined", "combinations"), known[:3], strict=True))
    return found._replace(values=values, coordinates=x, likeliest=True, **named)
