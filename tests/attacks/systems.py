"""Small systems of one degree of freedom, what `certify` says about their observers, and what these really do.

A law of friction is written once, as `law(xp, x, v)`: with `xp = jax.numpy` the prover reads it, with `xp = numpy` it
is simulated, so that no derivative and no graph is shared between the two. x is the position, or on the circle the
rotation matrix (2, 2). Everything else is kept simple: unit mass, gains and metric the same for all.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant import geometry, models
from covariant.certificates import ContractionCertificate, certify, optimal_lyapunov
from covariant.certificates.base import ErrorSystem, StateMetric, in_coordinates
from covariant.certificates.base._error_system import Point
from covariant.certificates.checking._checked import CHECKER
from covariant.geometry import lie
from covariant.observers import Intrinsic
from scalargraph import LoweringError
from scalargraph.proofs import prove

ALPHA, BETA, RATE = 10.0, 50.0, 2.0
"""Gains [1/s], [1/s²] and the rate of squared lengths [1/s] that is asked for: the gains alone allow 10 1/s."""
Q = optimal_lyapunov(ALPHA, BETA, 6.0)
EFFORT = {"boxes": 3000}
"""Enough for true statements about such systems, and no more."""

Law = Callable[[Any, Any, Any], Any]


class Case(NamedTuple):
    """A law of friction, and a true motion beside which an estimate goes astray.

    - `law`: as the prover gets it; `plain`: the same in NumPy alone, where the law needs more of JAX than arrays.
    - `place`, `speed`: where the true motion begins; `held`: whether a bounded input keeps it there.
    - `size`: how far from it the estimates begin, as a length in the metric on states.
    - `velocity`, `error`, `position`, `input`: the bounds of the statement.
    """

    law: Law
    plain: Law | None = None
    place: float = 0.0
    speed: float = 0.0
    held: bool = False
    size: float = 1e-7
    velocity: float = 1.0
    error: float = 0.1
    position: tuple[float, float] = (-1.0, 1.0)
    input: float = 1.0

    def bounds(self) -> dict[str, Any]:
        """The bounds, as `certify` takes them on the line."""
        return {name: getattr(self, name) for name in ("velocity", "error", "position", "input")}

    def friction(self) -> Law:
        return self.plain or self.law


def line(law: Law, metric=None, force=None, potential=None, circles: tuple[int, ...] = ()) -> Intrinsic:
    """The observer of a point mass on a line, or with circles=(0,) of a wheel whose angle is a coordinate."""
    model = models.Lagrangian(
        geometry.Euclidean() if metric is None else metric,
        (lambda q: 0.0 * q[0]) if potential is None else potential,
        force,
        lambda q, v: law(jnp, q, v),
        circles,
        coordinates=("x",),
        units=("m",),
    )
    return Intrinsic(model, ALPHA, BETA)


def wheel(law: Law, force=None, potential=None) -> Intrinsic:
    """The observer of a wheel of unit inertia on the group SO(2); the law gets the matrix of its rotation."""
    model = models.GroupSystem(lie.SO2, np.eye(1), potential, force, lambda g, v: law(jnp, g, v), units=("1/s",))
    return Intrinsic(model, ALPHA, BETA)


def unless_refused(work: Callable[[], Any]) -> Any:
    """What some work finds, or None where it is refused; what breaks by accident is no refusal."""
    try:
        return work()
    except np.linalg.LinAlgError:
        raise
    except (ValueError, LoweringError) as refusal:
        if "jax_numpy" in str(refusal):  # the strict settings of the tests, broken by the library
            raise
        return None


def certified(observer, **given) -> ContractionCertificate | None:
    """What `certify` says, or None where it refuses; what it proves, its checker must accept."""
    found = unless_refused(lambda: certify(observer, **given))
    if found is not None:
        refused = [h for h in found.statement.hypotheses if h.text.startswith(CHECKER) and h.verdict != "holds"]
        assert not refused, refused
    return found


def attempt(observer, **bounds) -> ContractionCertificate | None:
    """What `certify` says with the usual gains, or None where it refuses."""
    return certified(observer, **{"rate": RATE, "q": Q, **EFFORT, **bounds})


def proved(matrix, domain) -> str:
    """The verdict of `prove` on a matrix, "refused" where it raises."""
    found = unless_refused(lambda: prove(matrix, domain, **EFFORT))
    return "refused" if found is None else found.verdict


def verdict(observer, **bounds) -> str:
    """The verdict of `certify`, "refused" where it raises."""
    found = attempt(observer, **bounds)
    return "refused" if found is None else found.statement.verdict


def rotation(theta):
    """Rotation matrices (2, 2, ...) of angles (...)."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s], [s, c]])


def wrapped(angle):
    return angle - 2 * np.pi * np.round(angle / (2 * np.pi))


def size_of(xi, zeta, q=Q):
    """The length of an error of position and velocity, in the metric on states."""
    return np.sqrt((q[0, 0] * xi**2 + 2 * q[0, 1] * xi * zeta + q[1, 1] * zeta**2) / 2)


def around(length: float, count: int = 16, q=Q):
    """Errors of position and velocity (2, count) of one length, in all directions."""
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    unit = np.stack([np.cos(angle), np.sin(angle)])
    return length * unit / size_of(*unit, q)


def linear(matrix, form) -> ErrorSystem:
    """The system x' = A x with the constant metric P."""

    def at(z):
        metric: StateMetric = in_coordinates(lambda t, x: jnp.asarray(form, float))
        return Point(lambda t, x: jnp.asarray(matrix, float) @ x + 0.0 * z[0], metric, jnp.zeros(len(matrix)))

    return ErrorSystem(("d",), ("",), at)


class Run(NamedTuple):
    """Simulated: times (T,), the true motion (T, k), the errors (T, k) of the estimates beside it."""

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    xi: np.ndarray
    zeta: np.ndarray


def simulate(
    law: Law, x, v, xi, zeta, *, push=None, hold=False, circle=False, on_group=False, seconds=0.1, steps=400, **gains
) -> Run:
    """Truth and estimate by the classical Runge–Kutta rule, from true states (k,) and errors (k,).

    - `push`: the force `(t, x, v) -> (k,)` beside friction, known to both; `hold`: it balances the friction.
    - `circle`: errors are wrapped to ±π; `on_group`: the law gets rotation matrices.
    """
    alpha, beta = gains.get("alpha", ALPHA), gains.get("beta", BETA)

    def at(x):
        return rotation(x) if on_group else x

    def change(t, state):
        x, v, estimated, speed = state
        pull = law(np, at(x), v)
        known = -pull if hold else 0.0 * v if push is None else push(t, x, v)
        off = wrapped(estimated - x) if circle or on_group else estimated - x
        return np.stack([v, pull + known, speed - alpha * off, known + law(np, at(estimated), speed) - beta * off])

    x, v, xi, zeta = np.broadcast_arrays(*(np.asarray(a, float) for a in (x, v, xi, zeta)))
    state, h = np.stack([x, v, x + xi, v + zeta]), seconds / steps
    found = [state]
    with np.errstate(all="ignore"):
        for k in range(steps):
            t = k * h
            k1 = change(t, state)
            k2 = change(t + h / 2, state + h / 2 * k1)
            k3 = change(t + h / 2, state + h / 2 * k2)
            k4 = change(t + h, state + h * k3)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            found.append(state)
    x, v, estimated, speed = np.stack(found, axis=1)
    with np.errstate(all="ignore"):
        off = wrapped(estimated - x) if circle or on_group else estimated - x
        return Run(np.arange(steps + 1) * h, x, v, off, speed - v)


def excess(run: Run, case: Case, rate: float = RATE) -> float:
    """How much the distances exceed what the rate allows, at most; above 1 the statement is false.

    Counts as long as the true motion keeps its bounds.
    """
    low, high = case.position
    kept = (run.x >= low) & (run.x <= high) & (np.abs(run.v) <= case.velocity)
    kept = np.logical_and.accumulate(kept, axis=0)
    with np.errstate(all="ignore"):
        distance = size_of(run.xi, run.zeta)
        allowed = distance[0] * np.exp(-rate / 2 * run.t)[:, None]
        return float(np.nanmax(np.where(kept, distance / allowed, 0.0)))


def falsehood(case: Case, **how) -> float:
    """How much estimates that begin very near the true motion of a case break its statement; above 1 it is false."""
    run = simulate(case.friction(), case.place, case.speed, *around(case.size), hold=case.held, **how)
    return excess(run, case)


def on_any_circle(case: Case) -> Case:
    """The same statement with no bounds of the position, which the group does not need."""
    return case._replace(position=(-math.inf, math.inf))
