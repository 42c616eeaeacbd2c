"""Computes geodesics of any space from its connection: Runge–Kutta steps, Newton shooting, conjugate points.

Everything is computed in the coordinates s of the retraction around the start p, with velocities in the frame; in a
chart these are the coordinates themselves, up to a shift. Source: Aghannan & Rouchon 2003, section II; Milnor, Morse
Theory, section 15 (index theorem) for conjugate points.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp

from covariant._integrate import rk4, rk8
from covariant._linalg import pivots, solve
from covariant._typing import Code, Flag, Matrix, Scalar, Vector, Vectors
from covariant.geometry._manifold import AbstractManifold, Configuration
from covariant.signals import StepCode
from scalargraph.errors import InputError

NEWTON_LIMIT = 40
"""Number of damped Newton iterations after which a search gives up."""
CONTINUATION_STAGES = 12
"""Number of intermediate targets of the continuation that follows a failed direct search."""
NEAR_ENOUGH = 1e-2
"""Fraction of its length by which a geodesic with a fixed amount of work may miss its target."""


@runtime_checkable
class Curved(Protocol):
    """The part of a space that the computation of geodesics uses: a manifold with a connection, and lengths.

    Example:
        >>> from covariant.geometry import Euclidean
        >>> from covariant.geometry._geodesics import Curved
        >>> isinstance(Euclidean(), Curved)
        True
    """

    @property
    def manifold(self) -> AbstractManifold: ...
    def __call__(self, x: Configuration) -> Matrix: ...
    def connection(self, x: Configuration, a: Vector, b: Vector) -> Vector: ...
    def gram(self, x: Configuration, w: Vectors) -> Matrix: ...
    def norm(self, x: Configuration, a: Vector) -> Scalar: ...


class Budget(NamedTuple):
    """Work that a numerical `exp` or `log` may do. Closed forms ignore it.

    Keep the default for work offline. Set numbers for an observer that runs in real time or is exported, since every
    step must then take the same time. Check the residual of `shoot` in that case: with too few corrections the geodesic
    misses its end.

    Attributes:
        newton: None, the default, is for work offline: Newton shooting iterates until it converges, with `steps`
            eighth-order steps along the unit-time geodesic. A number is for real time: there are exactly that many
            corrections, with `steps` fourth-order steps, so the amount of work is fixed and can be exported.
        steps: number of integration steps along the geodesic, 8 by default.
        conjugate: whether a search that iterates until it converges also counts conjugate points; True by default.
        near: whether the end is close to the start, as for an observer that has converged; False by default. It needs a
            fixed number of corrections. The search then starts from the second-order expansion alone and uses the
            expansion's derivative in place of that of the geodesic's end, so that a correction costs one geodesic
            instead of n + 1. Each correction raises the order of the error by two: over a distance r a search misses by
            O(r³) without corrections, and by O(r⁵) with one.

    Example:
        A fixed amount of work, as in real time. Each correction of the velocity shortens the miss:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Budget, Metric, shoot, sphere
        >>> p, q = jnp.zeros(1), jnp.array([0.1])
        >>> guess = shoot(Metric(sphere()), p, q, budget=Budget(newton=0, steps=4, near=True))
        >>> corrected = shoot(Metric(sphere()), p, q, budget=Budget(newton=1, steps=4, near=True))
        >>> float(corrected.residual) < 1e-5 < float(guess.residual)
        True
    """

    newton: int | None = None
    steps: int = 8
    conjugate: bool = True
    near: bool = False


class Shot(NamedTuple):
    """A geodesic from p to q over unit time.

    Attributes:
        velocity: its velocity (n,) at p, `log_p q`.
        arrival: its velocity (n,) at q.
        residual: the distance, in the metric, by which it misses q.
        result: a `covariant.StepCode` code.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, shoot
        >>> shot = shoot(Euclidean(), jnp.array([1.0]), jnp.array([3.0]))
        >>> shot.velocity.tolist(), float(shot.residual)
        ([2.0], 0.0)
    """

    velocity: Vector
    arrival: Vector
    residual: Scalar
    result: Code


class Transported(NamedTuple):
    """End of a unit-time geodesic, with vectors transported in parallel along it.

    Attributes:
        q: the configuration at the end.
        velocity: the velocity (n,) of the geodesic there.
        w: the transported vectors (..., n).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, transport_along
        >>> from covariant.geometry._geodesics import Transported
        >>> end = transport_along(Euclidean(), jnp.zeros(1), jnp.array([2.0]), jnp.array([3.0]))
        >>> isinstance(end, Transported), end.q.tolist()
        (True, [2.0])
    """

    q: Configuration
    velocity: Vector
    w: Vectors


class Ray(NamedTuple):
    """A point of a geodesic, in coordinates s around its start.

    Attributes:
        s: coordinates (n,) of the retraction around the start.
        velocity: velocity (n,) in the frame at the point.
        w: transported vectors (k, n) in this frame.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Budget, Euclidean
        >>> from covariant.geometry._geodesics import arrive
        >>> ray = arrive(Euclidean(), jnp.zeros(1), jnp.array([2.0]), Budget(steps=1))
        >>> round(float(ray.s[0]), 9)
        2.0
    """

    s: Vector
    velocity: Vector
    w: Vectors


def transport_along(space: Curved, p: Configuration, velocity: Vector, w: Vectors, budget: Budget) -> Transported:
    """`transport_along` by numerical integration, for any space.

    Args:
        space: the space.
        p: configuration at which the geodesic starts.
        velocity: its velocity (n,) at p.
        w: vectors (..., n) at p.
        budget: rule and number of the integration steps.

    Returns:
        The end of the geodesic, its velocity and the vectors there.
    """
    start = Ray(jnp.zeros_like(velocity), velocity, w.reshape(-1, velocity.shape[0]))
    end = follow(space, p, start, budget)
    return Transported(space.manifold.retract(p, end.s), end.velocity, end.w.reshape(w.shape))


def follow(space: Curved, p: Configuration, ray: Ray, budget: Budget, fraction: float = 1.0) -> Ray:
    """Geodesic and transported vectors after a fraction of unit time.

    Args:
        space: the space.
        p: configuration at which the geodesic starts.
        ray: the point of the geodesic from which it is followed.
        budget: rule and number of the integration steps.
        fraction: time to follow it for, 1 by default.

    Returns:
        The ray at the end.
    """
    manifold = space.manifold

    def flow(_, point: Ray) -> Ray:
        x = manifold.retract(p, point.s)
        transported = jnp.concatenate([point.velocity[None], point.w])  # a geodesic transports its own velocity
        rates = jax.vmap(lambda a: space.connection(x, point.velocity, a))(transported)
        # Parallel transport: ∇ w = 0 means ẇ = −B(v, w) in components of the frame.
        return Ray(manifold.local_rate(p, point.s, point.velocity), -rates[0], -rates[1:])

    # Offline, integration errors must not limit Newton's method. In real time each sample pays for the steps.
    rule = rk8 if budget.newton is None else rk4
    return rule(flow, 0.0, ray, fraction, budget.steps)


@eqx.filter_jit  # a search calls it in many places; with jit each of its derivatives is traced only once
def arrive(space: Curved, p: Configuration, velocity: Vector, budget: Budget) -> Ray:
    """End of the unit-time geodesic from p."""
    none = jnp.zeros((0, *velocity.shape), velocity.dtype)
    return follow(space, p, Ray(jnp.zeros_like(velocity), velocity, none), budget)


class Target(NamedTuple):
    """The target q of a search.

    Attributes:
        s: its coordinates (n,) around p.
        metric: the metric's matrix (n, n) there, in these coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry._geodesics import Target
        >>> float(Target(jnp.zeros(1), 4.0 * jnp.eye(1)).length(jnp.array([3.0])))
        6.0
    """

    s: Vector
    metric: Matrix

    def length(self, miss: Vector) -> Scalar:
        """Length in the metric at q of a difference of coordinates (n,)."""
        return root(self.square(miss))

    def square(self, miss: Vector) -> Scalar:
        """Squared length in the metric at q of a difference of coordinates (n,)."""
        return miss @ self.metric @ miss


def root(square: Scalar) -> Scalar:
    """Square root of a scalar, with a zero (not undefined) derivative at 0; a negative scalar gives 0."""
    none = square <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))


def aim(space: Curved, p: Configuration, s: Vector) -> Target:
    """The target with coordinates s (n,) around p."""
    return Target(s, metric_in_retraction(space, p, s))


def metric_in_retraction(space: Curved, p: Configuration, s: Vector) -> Matrix:
    """The metric's matrix in the coordinates of the retraction around p."""
    axes = jnp.eye(s.shape[0], dtype=s.dtype)
    return space.gram(space.manifold.retract(p, s), jax.vmap(lambda a: space.manifold.frame_velocity(p, s, a))(axes))


def shoot(space: Curved, p: Configuration, q: Configuration, guess: Vector | None, budget: Budget) -> Shot:
    """Geodesic from p to q by Newton shooting.

    The search starts from the caller's guess or from `d + ½B(d, d)`, d = local(p, q), whichever ends closer to q. With
    a fixed budget it is undamped and can be exported; otherwise it is damped, checked for conjugate points, and
    differentiated implicitly.

    Args:
        space: the space.
        p: configuration at which the geodesic starts.
        q: configuration at which it ends.
        guess: first guess of its velocity (n,) at p, or None.
        budget: work of the search.

    Returns:
        Velocities at both ends, residual and result code.

    Raises:
        ValueError: for a budget with `near` and without a number of `newton` corrections.
    """
    if budget.near:
        return shoot_near(space, p, q, budget)
    target = aim(space, p, space.manifold.local(p, q))
    start = first_guess(space, p, target, guess, budget)
    if budget.newton is None:
        velocity = implicit_newton(space, p, target, start, budget)
    else:
        velocity = start
        for _ in range(budget.newton):
            velocity = velocity + newton_step(space, p, target, velocity, budget)[0]
    end = arrive(space, p, velocity, budget)
    residual = target.length(target.s - end.s)
    # A converged search misses only by rounding errors; a fixed number of corrections may leave a larger residual.
    result = found(space, p, velocity, residual, NEAR_ENOUGH if budget.newton is not None else 1e4 * epsilon(velocity))
    if budget.newton is None and budget.conjugate:
        # A count has no derivative; `stop_gradient` avoids tracing derivatives of this whole recursion.
        is_conjugate = conjugate_points(space, p, jax.lax.stop_gradient(velocity), budget) > 0
        result = jnp.where((result == StepCode.OK) & is_conjugate, StepCode.CONJUGATE_POINT, result)
    return Shot(velocity, end.velocity, residual, result)


def shoot_near(space: Curved, p: Configuration, q: Configuration, budget: Budget) -> Shot:
    """Geodesic from p to a nearby q, corrected by the derivative of the second-order expansion of its end."""
    if budget.newton is None:
        raise InputError("Budget: near=True makes a fixed number of corrections; name it, as in newton=1")
    d = space.manifold.local(p, q)

    def second_order(v: Vector) -> Vector:
        # In coordinates s the geodesic has s'' = −B(v, v) − Q(v, v) at s = 0: it ends at v − (B + Q)/2 to third order.
        return (space.connection(p, v, v) + space.manifold.retraction_acceleration(p, v)) / 2

    velocity = d + second_order(d)
    for _ in range(budget.newton):
        miss = d - arrive(space, p, velocity, budget).s
        # I + D(second_order) is the inverse of the Jacobian of v ↦ s to first order in v; no linear system is solved.
        velocity = velocity + miss + jax.jvp(second_order, (velocity,), (miss,))[1]
    end = arrive(space, p, velocity, budget)
    # The difference of coordinates s becomes a frame vector at q, since the metric there measures it.
    residual = space.norm(q, space.manifold.frame_velocity(p, d, d - end.s))
    return Shot(velocity, end.velocity, residual, found(space, p, velocity, residual, NEAR_ENOUGH))


def found(space: Curved, p: Configuration, velocity: Vector, residual: Scalar, part: float) -> Code:
    """Result code of a search: `OK` if the geodesic misses its target by at most a fraction `part` of its length."""
    # The absolute term matters for p = q: the geodesic has length zero, and so has every fraction of it.
    close = residual <= part * space.norm(p, velocity) + 64 * epsilon(velocity)
    return jnp.where(close, StepCode.OK, StepCode.NOT_CONVERGED)


def first_guess(space: Curved, p: Configuration, target: Target, guess: Vector | None, budget: Budget) -> Vector:
    """The candidate for the initial velocity whose geodesic ends closest to q.

    The second-order candidate is best close to p, but overshoots farther away.
    """
    d = target.s
    second_order = space.connection(p, d, d) + space.manifold.retraction_acceleration(p, d)
    candidates = [d + second_order / 2]
    candidates += [] if guess is None else [guess]
    candidates += [d] if budget.newton is None else []
    best = candidates[0]
    if len(candidates) > 1:
        velocities = jnp.stack(candidates)
        miss = jax.vmap(lambda v: target.length(d - arrive(space, p, v, budget).s))(velocities)
        # A candidate whose geodesic overflows must not be chosen: its miss counts as infinite.
        best = velocities[jnp.argmin(jnp.where(jnp.isfinite(miss), miss, jnp.inf))]
    return best


def newton_step(space: Curved, p: Configuration, target: Target, velocity: Vector, budget: Budget):
    """Newton correction of the initial velocity.

    The normal equations in the metric keep the matrix symmetric positive definite, so no pivoting is needed.
    """

    def end(v):
        s = arrive(space, p, v, budget).s
        return s, s

    jacobian, reached = jax.jacfwd(end, has_aux=True)(velocity)
    miss = target.s - reached
    # Normal equations in the metric at q: `solve` needs a positive definite matrix; JᵀGJ is one, J is not.
    weighted = jacobian.T @ target.metric
    return solve(weighted @ jacobian, weighted @ miss), target.square(miss)


def epsilon(a: Vector) -> float:
    """Rounding unit of the precision of an array."""
    return float(jnp.finfo(a.dtype).eps)


class _Search(NamedTuple):
    velocity: Vector
    correction: Vector
    miss: Scalar
    damping: Scalar
    tries: Code


def damped_newton(space: Curved, p: Configuration, target: Target, start: Vector, budget: Budget) -> Vector:
    """Newton's method with each step shortened until the residual decreases."""

    def far(s: _Search):
        # Convergence is quadratic: a correction below this threshold leaves only rounding errors.
        return space.norm(p, s.correction) > epsilon(start) ** 0.5 * space.norm(p, s.velocity)

    def unfinished(s: _Search):
        # Ten rejected steps in a row reduce the damping to 4⁻¹⁰ < 1e-6: no shorter step would decrease the residual.
        return (s.tries == 0) | (far(s) & (s.tries < NEWTON_LIMIT) & (s.damping > 1e-6))

    def improve(s: _Search):
        candidate = s.velocity + s.damping * s.correction
        # Step and residual come from one integration, so a rejected candidate costs no more than an accepted one.
        correction, miss = newton_step(space, p, target, candidate, budget)
        better = (miss < s.miss) & jnp.all(jnp.isfinite(correction))
        # The damping factor grows as fast as it was cut, so full steps, and quadratic convergence, return in the end.
        damping = jnp.where(better, jnp.minimum(1.0, 4 * s.damping), s.damping / 4)
        new = _Search(candidate, correction, miss, damping, s.tries + 1)
        old = s._replace(damping=damping, tries=s.tries + 1)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)

    # The residual starts at infinity, so that the start itself, a step of zero length, is accepted.
    one = jnp.ones((), start.dtype)
    first = _Search(start, jnp.zeros_like(start), one * jnp.inf, one, jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(unfinished, improve, first)
    return last.velocity + jnp.where(far(last), 0.0, last.correction)


def find_geodesic(space: Curved, p: Configuration, target: Target, start: Vector, budget: Budget) -> Vector:
    """Initial velocity by a direct search and, if that fails, by continuation.

    The continuation searches for a sequence of targets that move from p to q in small steps.
    """

    def stage(carry: tuple[Scalar, Vector, Flag]):
        k, velocity, _ = carry
        direct, fraction = k == 0, k / CONTINUATION_STAGES
        waypoint = aim(space, p, jnp.where(direct, target.s, fraction * target.s))
        # Velocities grow in proportion to the distance of the waypoint: by k/(k − 1) from one to the next.
        extrapolated = velocity * k / jnp.maximum(k - 1, 1)
        begin = jnp.where(direct, start, jnp.where(k == 1, fraction * target.s, extrapolated))
        velocity = damped_newton(space, p, waypoint, begin, budget)
        miss = target.length(target.s - arrive(space, p, velocity, budget).s)
        # The square root of rounding suffices to detect failure; `shoot` computes the residual that is reported.
        return k + 1, velocity, miss <= epsilon(start) ** 0.5 * space.norm(p, velocity)

    def unfinished(carry):
        k, _, converged = carry
        return ~converged & (k <= CONTINUATION_STAGES)

    return jax.lax.while_loop(unfinished, stage, (jnp.zeros((), start.dtype), start, jnp.zeros((), bool)))[1]


def implicit_newton(space: Curved, p: Configuration, target: Target, start: Vector, budget: Budget) -> Vector:
    """`find_geodesic`, differentiable by the implicit function theorem in p, q and the metric's own parameters."""

    def miss(velocity):
        return target.s - arrive(space, p, velocity, budget).s

    def search(_, first):
        return find_geodesic(space, p, target, first, budget)

    def solve_linear(linear, y):
        # The map is linear, so its derivative at 0 is its matrix; it is small, as a configuration has few entries.
        return least_squares(jax.jacfwd(linear)(jnp.zeros_like(y)), y)

    return jax.lax.custom_root(miss, jax.lax.stop_gradient(start), search, solve_linear)


def least_squares(a: Matrix, b: Vectors) -> Vectors:
    """Solution of the square system `a x = b` through its normal equations."""
    return solve(a.T @ a, a.T @ b)


def conjugate_points(space: Curved, p: Configuration, velocity: Vector, budget: Budget) -> Code:
    """Number of points conjugate to p strictly inside the geodesic, with multiplicity.

    By the index theorem this is the index of the second variation of the energy. On fields that are Jacobi fields
    within
    each of the budget's steps, this form is block tridiagonal. A and B are the derivatives of a step's end point with
    respect to its start point and velocity, and J are the Jacobi fields that vanish at p; its pivots are
    `g B⁻¹ J_next J⁻¹`.
    """
    n = velocity.shape[0]
    none = jnp.zeros((0, n), velocity.dtype)

    def step(flat):
        end = follow(space, p, Ray(flat[:n], flat[n:], none), budget._replace(steps=1), 1 / budget.steps)
        return jnp.concatenate([end.s, end.velocity])

    def advance(carry, _):
        x, fields, index = carry
        # Jacobi fields are derivatives of geodesics by their initial values: the flow of the linearised equation.
        change = jax.jacfwd(step)(x)
        following = change @ fields
        # Congruence by J keeps the signature of a pivot and needs no inverse. Velocities are in the frame, J is not.
        axes = jnp.eye(n, dtype=x.dtype)
        to_frame = jax.vmap(lambda a: space.manifold.frame_velocity(p, x[:n], a), out_axes=1)(axes)
        g = space(space.manifold.retract(p, x[:n]))
        # This is Jᵀ (g B⁻¹ J_next J⁻¹) J; a linear system is solved instead of inverting B.
        pivot = (to_frame @ fields[:n]).T @ g @ least_squares(change[:n, n:], following[:n])
        # It is symmetric up to discretisation; by Sylvester's law its pivots have the signs of its eigenvalues.
        negative = jnp.sum(pivots((pivot + pivot.T) / 2) < 0)
        return (step(x), following, index + negative.astype(index.dtype)), None

    x = jnp.concatenate([jnp.zeros_like(velocity), velocity])
    # Columns from n on are the fields that vanish at p, one for each direction of the initial velocity.
    first = (step(x), jax.jacfwd(step)(x)[:, n:], jnp.zeros((), jnp.int32))
    # Only interior nodes are visited: by the index theorem a conjugate point at q itself does not count.
    (_, _, index), _ = jax.lax.scan(advance, first, length=budget.steps - 1)
    return index
