"""Numbers of a robot that explain logs best: those of the greatest likelihood, from those by residual torques.

Torques over windows know nothing of the motion from one window to the next. Where the noise is that of an encoder, the
positions of a whole log tell much more, and a short log is enough.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from covariant.calibration._least_squares import PRIOR, Fixed, Point
from covariant.calibration.identification._error_model import ErrorModel, error_model
from covariant.calibration.identification._fit import DIFFERENT, Solved, begun, likeliest
from covariant.calibration.identification._robot_fit import RobotFit, accelerations, driving
from covariant.calibration.identification._robot_torques import (
    Determined,
    Torques,
    needed,
    sticking_speeds,
    usual_sizes,
)
from covariant.calibration.identification._rows import Rows
from covariant.calibration.identification._unknowns import Unknowns
from covariant.geometry import AbstractManifold
from covariant.models import MechanicalSystem, Motion, RobotFamily


@dataclass(frozen=True, eq=False)
class RobotUnknowns:
    """Coordinates of a robot's open numbers, relative to their usual sizes (p,); zero at the first values.

    Below the speeds `sticking` (n,) dry friction may be anything, so that no number is read from a joint's torque.
    """

    family: RobotFamily
    sizes: Float[np.ndarray, "p"]
    sticking: Float[np.ndarray, "n"]
    torques: Torques
    _functions: dict[str, Callable[..., np.ndarray]] = field(default_factory=dict)

    @classmethod
    def of(cls, family: RobotFamily, rows: Rows) -> "RobotUnknowns":
        """The numbers with usual sizes and speeds in the motion of rows."""
        t, q, v = (np.asarray(each)[: rows.used] for each in (rows.t, rows.start.q, rows.start.v))
        u = np.asarray(rows.inputs)[np.asarray(rows.rows)[: rows.used]]
        steps = np.maximum(np.diff(t), 1e-9)[:, None]
        a = np.concatenate([np.diff(v, axis=0) / steps, np.zeros_like(v[:1])])
        a[np.concatenate([np.asarray(rows.fresh)[1 : rows.used], [True]])] = 0.0
        torques, first = Torques.of(family), np.zeros(len(family.names))
        both = torques.rows(driving)(first, u), torques.rows(needed)(first, q, v, a)
        sizes, speed = usual_sizes(family, *both, v, a)
        return cls(family, sizes, sticking_speeds(family, speed), torques)

    @property
    def first(self) -> Float[np.ndarray, "p"]:
        return np.zeros_like(self.sizes)

    @property
    def parts(self) -> Int[np.ndarray, "M k"]:
        return self.family.parts

    @property
    def manifold(self) -> AbstractManifold:
        return self.family.file.model.manifold

    def model(self, z: Array, machine: int = 0) -> Any:
        """The model at relative coordinates z (p,)."""
        del machine
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

    def along(self, name: str, function: Callable[..., Any], x: np.ndarray, *columns: np.ndarray) -> np.ndarray:
        """A function of the model and a row at rows; its graph is made once."""
        if name not in self._functions:
            self._functions[name] = self.torques.rows(function)
        return self._functions[name](x, *columns)


def linearised(unknowns: RobotUnknowns, z: Array, run: Motion, rows: Rows, steps: Any) -> ErrorModel:
    """Linearise a robot along a run: in its state by a step of the model, in its numbers by torques.

    Torques are fewer than numbers, so that derivatives of torques cost less than those of a step in each number.
    """
    x = np.asarray(z) * unknowns.sizes
    system = error_model(Unknowns.none(unknowns.model(z)), jnp.zeros(0), run, rows, steps)
    q, v = np.asarray(run.q), np.asarray(run.v)
    u = np.asarray(rows.inputs)[np.asarray(rows.rows)]
    changes = []
    # Inputs of the row before act in a step, from its beginning to its end.
    for at in (slice(None, -1), slice(1, None)):
        a = unknowns.along("accelerations", accelerations, x, q[at], v[at], u[:-1], np.ones_like(v[:-1]))
        torque = unknowns.torques.derivatives(x, q[at], v[at], a, u[:-1])
        torque *= (np.abs(v[at]) >= unknowns.sticking)[:, :, None]
        inertia = unknowns.along("inertia", _inertia, x, q[at])
        changes.append(-np.linalg.solve(inertia, torque))
    begin, end = changes
    dt, n = np.asarray(system.dt)[1:, None, None], v.shape[1]
    # What a number changes at the beginning of a step is damped until its end.
    damped = np.asarray(system.transition)[1:, n:, n:] @ begin
    slopes = np.concatenate([dt**2 * (begin / 3 + end / 6), dt * (damped + end) / 2], axis=1)
    slopes = np.where(np.isfinite(slopes), slopes, 0.0) * unknowns.sizes
    slopes = np.concatenate([np.zeros_like(slopes[:1]), slopes])
    return system._replace(slopes=jnp.asarray(np.where(np.asarray(system.fresh)[:, None, None], 0.0, slopes)))


def _inertia(model: MechanicalSystem, q: Array) -> Array:
    return model.space(q)


def likeliest_robot(
    family: RobotFamily, found: RobotFit, rows: Rows, progress: Callable[[int, int], object] = lambda *_: None
) -> RobotFit:
    """The numbers of greatest likelihood near those of a fit by residual torques."""
    unknowns: Any = RobotUnknowns.of(family, rows)
    problem, bounds = begun(unknowns, rows, None, linearised)
    start = np.maximum(found.coordinates / unknowns.sizes, family.least / unknowns.sizes)
    problem, _ = problem.likelier(Point.at(problem, start).blocks.rest, bounds, 10)
    solved = Solved(family, None, problem, Point.at(problem, start), Fixed.nothing(len(start)), bounds)
    return _concluded(family, found, unknowns, likeliest(solved, progress).point)


def _concluded(family: RobotFamily, found: RobotFit, unknowns: RobotUnknowns, point: Point) -> RobotFit:
    """The fit with the numbers of a point, and their standard errors."""
    x, sizes, blocks = point.z * unknowns.sizes, unknowns.sizes, point.blocks
    covariance = np.linalg.inv(blocks.information + np.eye(len(x)) / PRIOR**2)
    if blocks.overdispersion > DIFFERENT**2:
        covariance = covariance * blocks.overdispersion
    outer = np.outer(sizes, sizes)
    known = Determined.of(family, x, sizes, blocks.information / outer, covariance * outer)
    values = np.asarray(jax.jit(family.values)(x))
    errors, determined, combined = known.said
    found = found._replace(values=values, standard_errors=errors, determined=determined, combinations=combined)
    return found._replace(coordinates=x, likeliest=True)
