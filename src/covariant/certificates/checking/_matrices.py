"""Builds the matrices of claims for the checker: JAX functions that must be positive definite, or defined.

Like the matrices of the prover, they are built from the observer's flow and the frame of the metric. Unlike the prover,
the checker uses JAX derivatives, after removing custom derivative rules.
"""

import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from covariant.certificates.base import (
    AbstractClaim,
    DisturbanceClaim,
    Document,
    ErrorSystem,
    PredictionClaim,
    Resolved,
    friction_of,
    reach_squares,
)
from covariant.certificates.sampled import Prediction, defect_matrix, sampled_prediction
from covariant.models import MechanicalSystem, applied_force
from scalargraph.proofs.checker import ROUND, along, jacobian, value_and_jacobian

Matrix = Callable[[Any], Any]
SLACK = 2.0**-20
"""Relative amount by which forces may exceed their bounds, so that attained bounds can be shown quickly."""


def contraction(about: ErrorSystem, rate: float) -> Matrix:
    """Build `−(FᵀN + Ṅ + NF) − rate N`.

    Args:
        about: the observer and its metric.
        rate: rate λ [1/s] of squared lengths.

    Returns:
        A function z (d,) -> (2n, 2n).
    """

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        x = point.x
        # x' comes with the Jacobian, so that the flow is evaluated once.
        velocity, slope = value_and_jacobian(lambda y: point.flow(t, y), x)

        def metric_along(s):
            at = x + s * velocity
            return point.metric.coframe(s, at), point.metric.gram(s, at)

        # Total derivatives: time advances and the state moves with the flow. Since t is 0, t + 1 is the tangent 1.
        (coframe, gram), (turn, change) = along(metric_along, t, t + 1)
        product = gram @ (turn + coframe @ slope) @ point.metric.frame(t, x)
        return -(product + product.T + change) - rate * gram

    return matrix


def width_bound(about: ErrorSystem, row: int, square: float) -> Matrix:
    """Build `square N − r rᵀ` for a row r of the Jacobian of error and velocity."""

    def matrix(z):
        point = about.at(z)
        r = point.error_jacobian()[row]
        return square * point.metric.gram(jnp.zeros(()), point.x) - jnp.outer(r, r)

    return matrix


def remainder(about: ErrorSystem, row: int, square: float, curvature: bool) -> Matrix:
    """Build `square g⊗…⊗g − TᵀgT` for the tensor of a row of the claims on remainders, all in coordinates."""

    def matrix(z):
        x, space = about.at(z).x, about.at(z).metric.lift
        (q, v), n = jnp.split(x, 2), len(x) // 2
        unit = jnp.eye(n)

        def christoffel(q):
            return jnp.stack([jnp.stack([space.connection(q, a, b) for b in unit], axis=-1) for a in unit], axis=-1)

        def curved(q):
            return float(curvature and n > 1) * jnp.stack([space.curvature(q, a, v, v) for a in unit], axis=-1)

        tensor = (
            lambda: christoffel(q),
            lambda: jacobian(christoffel, q),
            lambda: space.raise_(q, z[3 * n : 4 * n]),
            lambda: curved(q),
            lambda: jacobian(curved, q),
        )[row]()
        g, grams = space(q), jnp.ones((1, 1))
        for _ in range(tensor.ndim - 1):
            grams = jnp.kron(grams, g)
        columns = tensor.reshape(n, -1)
        return square * grams - columns.T @ g @ columns

    return matrix


def remainder_rate(document: Document, bounds: list[float]) -> float:
    """Bound what (2) loses [1/s] against (5): infinite where geodesics to the measurement may not be unique."""
    (a, c), (_, b) = document.q.tolist()
    alpha, beta = document.observer["alpha"], document.observer["beta"]
    connection, slope, source, curvature, change = bounds
    per_radius = math.sqrt(2 * b / (a * b - c * c))
    bend = connection * per_radius * document.radius
    chord = 1 / (math.exp(-bend) - bend) if bend < 0.5 else math.inf
    if not chord**4 * (slope * (per_radius * document.radius) ** 2 / 4 + bend) < 1 - ROUND:
        return math.inf
    # Second-order terms: of the logarithm, of the parallel transport of the source, and of the curvature.
    of_log = connection / 2 * math.sqrt((a * alpha**2 + 2 * c * alpha * beta + b * beta**2) / 2)
    of_transport = source * (slope + 3 * connection**2) / 2
    of_curvature = change + 3 * connection * curvature / 2
    terms = of_log + math.sqrt(b / 2) * (of_transport + of_curvature)
    return math.exp(2 * bend) * terms * per_radius**2 * document.radius * (1 + ROUND)


def disturbance(about: ErrorSystem, sizes: np.ndarray, square: float) -> Matrix:
    """Build `square I − BᵀMB`, where B is the scaled Jacobian of the flow in errors of measurement and force."""
    n = len(sizes) // 2

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        slope = jacobian(lambda at: about.at(at).flow(t, point.x), z)
        # Error and force come after the velocities; an error of the measurement acts through the position error.
        start = about.first_velocity(n) + n
        of_error, of_force = slope[:, start : start + n], slope[:, start + n : start + 2 * n]
        b = jnp.concatenate([of_error @ point.noise_jacobian(), of_force], axis=1) * sizes[None]
        b = point.metric.coframe(t, point.x) @ b
        return square * jnp.eye(2 * n) - b.T @ point.metric.gram(t, point.x) @ b

    return matrix


def correction(about: ErrorSystem, noise: np.ndarray | None = None, squares: tuple[float, ...] = ()) -> Matrix:
    """Build `N_h − JᵀN_0J`, with J the Jacobian of the correction between the frames before and after it.

    With measurement errors it is `diag(N_h, Γ) − [J B]ᵀN_0[J B]`; B is the Jacobian by the measurement.

    Args:
        about: the observer and its metric.
        noise: bounds (n,) of the measurement errors; None without.
        squares: diagonal of Γ, one for each bound that is not zero.

    Returns:
        A function z (d,) -> (2n + k, 2n + k) for k squares.
    """

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        corrected, after = point.sampled
        new, slope = value_and_jacobian(corrected, point.x)
        coframe, gram, before = after.coframe(t, new), after.gram(t, new), point.metric.gram(t, point.x)
        in_frames = coframe @ slope @ point.metric.frame(t, point.x)
        if noise is None:
            return before - in_frames.T @ gram @ in_frames
        n = len(noise)

        # An error of the measurement is a position error with the opposite sign.
        def moved(e):
            return about.at(jnp.concatenate([z[: 2 * n], e, z[3 * n :]])).sampled[0](point.x)

        # A product with a matrix of constants selects the columns of joints with an error, and scales them.
        selected = np.diag(-noise)[:, noise != 0]
        errors = coframe @ jacobian(moved, z[2 * n : 3 * n]) @ selected
        cross = -in_frames.T @ gram @ errors
        rows = [before - in_frames.T @ gram @ in_frames, cross], [cross.T, np.diag(squares) - errors.T @ gram @ errors]
        return jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])

    return matrix


def joint_force(about: ErrorSystem, sizes: np.ndarray, square: float) -> Matrix:
    """Build `square I − BᵀMB`, where B is the scaled Jacobian of the flow between samples in the joint force."""
    n = len(sizes)

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())

        def pushed(w):
            return about.at(jnp.concatenate([z[: 4 * n], w, z[5 * n :]])).flow(t, point.x)

        b = point.metric.coframe(t, point.x) @ (jacobian(pushed, z[4 * n : 5 * n]) * sizes[None])
        return square * jnp.eye(n) - b.T @ point.metric.gram(t, point.x) @ b

    return matrix


def start(about: ErrorSystem, squares: np.ndarray, square: float) -> Matrix:
    """Build `square diag(1/squares) − M`, with M the metric in coordinates right after a measurement."""

    def matrix(z):
        point, t = about.at(z), jnp.zeros(())
        metric = point.metric if point.after is None else point.after
        theta = metric.coframe(t, point.x)
        return np.diag(square / squares) - theta.T @ metric.gram(t, point.x) @ theta

    return matrix


def everything(about: ErrorSystem, values: Callable[[ErrorSystem], Callable[..., Any]]) -> Matrix:
    """Collect everything that claims are computed from, as `values` of the system names it."""

    def parts(y):
        z, t, zeros = jnp.split(y, (len(about.names), len(about.names) + 1))
        return jnp.concatenate([part.ravel() for part in values(about)(t[0], about.at(z).x + zeros, z)])

    return parts


def missing(about: ErrorSystem, square: float, limit: float, reach: np.ndarray) -> Matrix:
    """Build the three blocks that bound the missing acceleration."""
    n = len(reach)

    def matrix(z):
        point, places = about.at(z), about.errors(n)
        before, e, behind = jnp.split(z, (places.start, places.stop))

        def lacking(e):
            return about.at(jnp.concatenate([before, e, behind])).missing(point.x)

        (g, there), slope = point.inertias(point.x), jacobian(lacking, e)
        ratio, doubled = square * g - slope.T @ g @ slope, 4 * g - there
        size = limit**2 / n * jnp.eye(n) - g * np.outer(reach, reach)
        rows = [[ratio, 0 * g, 0 * g], [0 * g, doubled, 0 * g], [0 * g, 0 * g, size]]
        return jnp.concatenate([jnp.concatenate(row, axis=1) for row in rows])

    return matrix


def _anywhere(model: MechanicalSystem, n: int) -> Any:
    return jnp.zeros(n) if model.manifold.commuting else model.manifold.origin()


def input_force(model: MechanicalSystem, n: int) -> Matrix:
    """Build the force of the input alone."""
    return lambda u: model.force(jnp.zeros(()), _anywhere(model, n), u)


def friction(model: MechanicalSystem, n: int) -> Matrix:
    """Build the friction.

    Args:
        model: a mechanical system whose friction depends on the velocity alone.
        n: number of velocities.

    Returns:
        A function of the velocity (n,) -> (n,).
    """
    return lambda v: friction_of(model, _anywhere(model, n), v)


def friction_slopes(model: MechanicalSystem, n: int) -> Matrix:
    """Build −∂f_i/∂v_i of the friction f."""
    # Entry i depends on velocity i alone, so that the sum over a column is the entry of the diagonal.
    return lambda v: -along(friction(model, n), v, jnp.ones_like(v))[1]


def force(model: MechanicalSystem, shape: tuple[int, ...]) -> Matrix:
    """Build the force on the system."""

    def applied(y):
        t, q, u = jnp.split(y, (1, 1 + int(np.prod(shape))))
        return applied_force(model, t[0], q.reshape(shape), u)

    return applied


def within(function: Matrix, low: np.ndarray, high: np.ndarray) -> Matrix:
    """Build a matrix that is positive definite if a function keeps its bounds."""

    def matrix(y):
        value = function(y)
        return jnp.diag(jnp.concatenate([value - low, high - value]))

    return matrix


def slopes(model: MechanicalSystem, shape: tuple[int, ...], n: int) -> Matrix:
    """Build the derivatives of the force by the position, on a group along the directions of the body frame."""

    def derivatives(y):
        t, q, u = jnp.split(y[:-n], (1, 1 + int(np.prod(shape))))

        def applied(step):
            return applied_force(model, t[0], model.manifold.nudged(q.reshape(shape), step), u)

        return jacobian(applied, y[-n:]).ravel()

    return derivatives


def stepped(model: MechanicalSystem, shape: tuple[int, ...], n: int) -> Matrix:
    """Build the force at a small step from the position, as in `slopes`."""

    def applied(y):
        t, q, u = jnp.split(y[:-n], (1, 1 + int(np.prod(shape))))
        return applied_force(model, t[0], model.manifold.nudged(q.reshape(shape), y[-n:]), u)

    return applied


def sizes(document: Document) -> np.ndarray:
    """Compute the largest errors of measured position and force; force errors are unmodelled or due to the position."""
    given = document.given
    # The shown slopes may exceed the stated ones by the slack.
    steepest = given.slopes * (1 + SLACK)
    return np.concatenate([given.noise, (given.disturbance + steepest @ given.noise) * (1 + ROUND)])


def prediction_of_steps(document: Document, observer: Any) -> Prediction:
    """Describe the Runge–Kutta steps of an observer with samples."""
    assert document.sampling is not None
    return sampled_prediction(observer, document.q, document.sampling)


def slack_of(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the amounts (d,) by which variables that are forces may exceed their bounds."""
    # The last term is for bounds that are zero.
    return SLACK * np.maximum(abs(low), abs(high)) + 1e-200


def claim_slack(document: Document, claim: AbstractClaim) -> np.ndarray:
    """Amounts (d,) by which the variables of a claim that are forces or friction slopes may exceed their bounds."""
    low, high = document.bounds(claim)
    place, n = np.arange(len(low)), len(document.velocity)
    if isinstance(claim, PredictionClaim):  # its force, age and lengths of steps, where they are no constants
        return np.where((place >= len(low) - n - 3) & (low < high), slack_of(low, high), 0.0)
    # All variables after the errors, except for the age, and for signals.
    after = len(low) - len(document.driven) - (document.sampling is not None)
    forces = (document.forces.start <= place) & (place < after)
    return np.where(forces, slack_of(low, high), 0.0)


def _disturbance(of: Resolved, claim: DisturbanceClaim) -> Matrix:
    if of.document.sampling is None:
        return disturbance(of.about, sizes(of.document), claim.square)
    return joint_force(of.about, of.document.given.disturbance, claim.square)


MATRICES: dict[str, Callable[[Resolved, Any], Matrix]] = {
    "contraction": lambda of, claim: contraction(of.about, of.document.rate),
    "reach": lambda of, claim: width_bound(of.about, claim.row, claim.square),
    "remainder": lambda of, claim: remainder(of.about, claim.row, claim.square, of.observer.curvature),
    "disturbance": _disturbance,
    "correction": lambda of, claim: correction(
        of.about, of.document.given.noise if claim.squares else None, claim.squares
    ),
    "missing": lambda of, claim: missing(of.about, claim.square, claim.limit, of.document.unit_reach),
    "prediction": lambda of, claim: defect_matrix(
        prediction_of_steps(of.document, of.observer), claim.square, jacobian, claim.order
    ),
    "start": lambda of, claim: start(of.about, reach_squares(of.document.claims), claim.square),
}
"""The matrix that must be positive definite, for each kind of claim."""
