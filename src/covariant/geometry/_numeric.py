"""Geometry of any metric from its matrix alone: automatic derivatives, Runge–Kutta geodesics, Newton shooting.

Source: Aghannan & Rouchon 2003, section II; Milnor, Morse Theory, section 15 (index theorem) for conjugate points.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import jvp
from jaxtyping import Array

from covariant._integrate import rk4, rk8
from covariant._linalg import pivots, solve
from covariant._typing import Code, Flag, Matrix, MatrixField, Scalar, Vector, Vectors
from covariant.geometry._abstract import AbstractMetric, Budget, Shot, Transported, norm
from covariant.signals import Result

NEWTON_LIMIT = 40
"""Damped Newton iterations after which a search is given up."""
CONTINUATION_STAGES = 12
"""Intermediate targets of a search that failed directly."""


class Metric(AbstractMetric):
    """A metric known only by its matrix `q (n,) -> (n, n)`; every operation is derived from it."""

    matrix: MatrixField

    def __call__(self, q: Vector) -> Matrix:
        return self.matrix(q)

    def christoffel(self, q: Vector, x: Vector, y: Vector) -> Vector:
        """`Γ(x, y) = g⁻¹ ½[(∂_x g) y + (∂_y g) x − ∇_q <x, y>]`."""
        _, x_part = jvp(lambda p: self.matrix(p) @ y, (q,), (x,))
        _, y_part = jvp(lambda p: self.matrix(p) @ x, (q,), (y,))
        gradient = jax.grad(lambda p: x @ self.matrix(p) @ y)(q)
        return solve(self.matrix(q), (x_part + y_part - gradient) / 2)

    def curvature(self, q: Vector, x: Vector, y: Vector, z: Vector) -> Vector:
        """`R(x, y)z = (∂_xΓ)(y, z) − (∂_yΓ)(x, z) + Γ(x, Γ(y, z)) − Γ(y, Γ(x, z))`."""
        g_yz, dx = jvp(lambda p: self.christoffel(p, y, z), (q,), (x,))
        g_xz, dy = jvp(lambda p: self.christoffel(p, x, z), (q,), (y,))
        return dx - dy + self.christoffel(q, x, g_yz) - self.christoffel(q, y, g_xz)

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget) -> Transported:
        return transport_along(self, p, velocity, w, budget)

    def shoot(self, p: Vector, q: Vector, guess: Vector | None, budget: Budget) -> Shot:
        return shoot(self, p, q, guess, budget)


def transport_along(metric: AbstractMetric, p: Vector, velocity: Vector, w: Vectors, budget: Budget) -> Transported:
    """Numerical `transport_along` for any metric."""

    def flow(_, x: Transported) -> Transported:
        carried = jax.vmap(lambda a: metric.christoffel(x.q, x.velocity, a))(x.w)
        return Transported(x.velocity, -metric.christoffel(x.q, x.velocity, x.velocity), -carried)

    start = Transported(p, velocity, w.reshape(-1, p.shape[0]))
    end = follow(budget, flow, start)
    return end._replace(w=end.w.reshape(w.shape))


def follow(budget: Budget, flow, x):
    """Integrate over unit time by the rule and the steps the budget stands for."""
    rule = rk8 if budget.newton is None else rk4
    return rule(flow, 0.0, x, 1.0, budget.steps)


def spray(metric: AbstractMetric, budget: Budget, p: Vector, velocity: Vector, fraction: float = 1.0, steps=None):
    """Point and velocity of the geodesic from p after a fraction of unit time."""
    none = jnp.zeros((0, *p.shape), p.dtype)
    end = metric.transport_along(p, fraction * velocity, none, budget._replace(steps=steps or budget.steps))
    return end.q, end.velocity / fraction


def shoot(metric: AbstractMetric, p: Vector, q: Vector, guess: Vector | None, budget: Budget) -> Shot:
    """Newton shooting for the geodesic from p to q.

    It starts from the best of `d + ½Γ(p)(d, d)`, d = q − p, and the caller's guess. A fixed budget runs undamped and is
    exported as it stands; an open one is damped, checked for conjugate points, and differentiated implicitly.
    """
    start = first_guess(metric, p, q, guess, budget)
    if budget.newton is None:
        velocity = implicit_newton(metric, p, q, start, budget)
    else:
        velocity = start
        for _ in range(budget.newton):
            velocity = velocity + newton_step(metric, p, q, velocity, budget)[0]
    end, arrival = spray(metric, budget, p, velocity)
    residual = norm(metric, q, q - end)
    scale = 1e-2 if budget.newton is not None else 1e4 * epsilon(q)
    found = residual <= scale * norm(metric, p, velocity) + 64 * epsilon(q)
    result = jnp.where(found, Result.OK, Result.NOT_CONVERGED)
    if budget.newton is None:
        passed = conjugate_points(metric, p, jax.lax.stop_gradient(velocity), budget) > 0
        result = jnp.where(found & passed, Result.CONJUGATE_POINT, result)
    return Shot(velocity, arrival, residual, result)


def first_guess(metric: AbstractMetric, p: Vector, q: Vector, guess: Vector | None, budget: Budget) -> Vector:
    """The candidate whose geodesic passes closest to q; the second-order one is best near, but overshoots far away."""
    d = q - p
    candidates = [d + metric.christoffel(p, d, d) / 2]
    candidates += [] if guess is None else [guess]
    candidates += [d] if budget.newton is None else []
    best = candidates[0]
    if len(candidates) > 1:
        tried = jnp.stack(candidates)
        miss = jax.vmap(lambda v: norm(metric, q, q - spray(metric, budget, p, v)[0]))(tried)
        best = tried[jnp.argmin(jnp.where(jnp.isfinite(miss), miss, jnp.inf))]
    return best


def newton_step(metric: AbstractMetric, p: Vector, q: Vector, velocity: Vector, budget: Budget):
    """Correction of the initial velocity, and the squared miss (metric at q) it is meant to remove.

    The normal equations in the metric keep the matrix symmetric positive definite, so no pivoting is needed.
    """

    def end(v):
        point = spray(metric, budget, p, v)[0]
        return point, point

    jacobian, reached = jax.jacfwd(end, has_aux=True)(velocity)
    miss = q - reached
    weighted = jacobian.T @ metric(q)
    return solve(weighted @ jacobian, weighted @ miss), miss @ metric(q) @ miss


def epsilon(q: Vector) -> float:
    return float(jnp.finfo(q.dtype).eps)


class _Search(NamedTuple):
    velocity: Vector
    correction: Vector
    miss: Scalar
    damping: Scalar
    tries: Code


def damped_newton(metric: AbstractMetric, p: Vector, q: Vector, start: Vector, budget: Budget) -> Vector:
    """Newton's method, each step shortened until the miss shrinks."""

    def unfinished(s: _Search):
        # Convergence is quadratic: below this the last correction leaves only rounding errors.
        long = norm(metric, p, s.correction) > epsilon(q) ** 0.5 * norm(metric, p, s.velocity)
        return (s.tries == 0) | (long & (s.tries < NEWTON_LIMIT) & (s.damping > 1e-6))

    def improve(s: _Search):
        candidate = s.velocity + s.damping * s.correction
        correction, miss = newton_step(metric, p, q, candidate, budget)
        better = (miss < s.miss) & jnp.all(jnp.isfinite(correction))
        damping = jnp.where(better, jnp.minimum(1.0, 4 * s.damping), s.damping / 4)
        new = _Search(candidate, correction, miss, damping, s.tries + 1)
        old = s._replace(damping=damping, tries=s.tries + 1)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)

    one = jnp.ones((), q.dtype)
    first = _Search(start, jnp.zeros_like(start), one * jnp.inf, one, jnp.zeros((), jnp.int32))
    last = jax.lax.while_loop(unfinished, improve, first)
    return last.velocity + jnp.where(unfinished(last), 0.0, 1.0) * last.correction


def find_geodesic(metric: AbstractMetric, p: Vector, q: Vector, start: Vector, budget: Budget) -> Vector:
    """A direct search, and where that fails one on targets that move from p to q in small steps."""

    def stage(carry: tuple[Scalar, Vector, Flag]):
        k, velocity, _ = carry
        direct, moved = k == 0, k / CONTINUATION_STAGES
        target = jnp.where(direct, q, p + moved * (q - p))
        extrapolated = velocity * k / jnp.maximum(k - 1, 1)
        begin = jnp.where(direct, start, jnp.where(k == 1, moved * (q - p), extrapolated))
        velocity = damped_newton(metric, p, target, begin, budget)
        miss = norm(metric, q, q - spray(metric, budget, p, velocity)[0])
        return k + 1, velocity, miss <= epsilon(q) ** 0.5 * norm(metric, p, velocity)

    def unfinished(carry):
        k, _, found = carry
        return ~found & (k <= CONTINUATION_STAGES)

    return jax.lax.while_loop(unfinished, stage, (jnp.zeros((), q.dtype), start, jnp.zeros((), bool)))[1]


def implicit_newton(metric: AbstractMetric, p: Vector, q: Vector, start: Vector, budget: Budget) -> Vector:
    """`find_geodesic`, differentiable by the implicit function theorem in p, q and the metric's own parameters."""

    def miss(velocity):
        return q - spray(metric, budget, p, velocity)[0]

    def search(_, first):
        return find_geodesic(metric, p, q, first, budget)

    def solve_linear(linear, y):
        return least_squares(jax.jacfwd(linear)(jnp.zeros_like(y)), y)

    return jax.lax.custom_root(miss, jax.lax.stop_gradient(start), search, solve_linear)


def least_squares(a: Matrix, b: Array) -> Array:
    """Solve the square system `a x = b` through its normal equations."""
    return solve(a.T @ a, a.T @ b)


def conjugate_points(metric: AbstractMetric, p: Vector, velocity: Vector, budget: Budget) -> Code:
    """Number of points conjugate to p strictly inside the geodesic, with multiplicity.

    By the index theorem this is the index of the second variation of the energy, which over fields that are Jacobi on
    each of the budget's steps is block tridiagonal. With A, B the derivatives of a step's end point by its start point
    and velocity, and J the Jacobi fields that vanish at p, its pivots are `g B⁻¹ J_next J⁻¹`.
    """
    n = p.shape[0]

    def step(flat):
        return jnp.concatenate(spray(metric, budget, flat[:n], flat[n:], 1 / budget.steps, 1))

    def advance(carry, _):
        x, fields, index = carry
        derivative = jax.jacfwd(step)(x)
        following = derivative @ fields
        # Congruence by J keeps the signature of a pivot and spares its inverse.
        pivot = fields[:n].T @ metric(x[:n]) @ least_squares(derivative[:n, n:], following[:n])
        negative = jnp.sum(pivots((pivot + pivot.T) / 2) < 0)
        return (step(x), following, index + negative.astype(index.dtype)), None

    x = jnp.concatenate([p, velocity])
    first = (step(x), jax.jacfwd(step)(x)[:, n:], jnp.zeros((), jnp.int32))
    (_, _, index), _ = jax.lax.scan(advance, first, length=budget.steps - 1)
    return index
