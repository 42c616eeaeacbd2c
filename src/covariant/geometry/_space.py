"""A configuration space: a manifold with a frame, and a metric in it; all its operations, derived from the metric.

`lower` alone defines the metric; the connection, the curvature and geodesics follow from it and the frame. A space
with something better, such as closed forms or the recursions of a robot, has methods of its own for them. Every
operation is directional: no array of n³ entries is formed.

`B(a, b) = ∇_a b` is the covariant derivative, along a, of the field whose components are b everywhere. Its arguments
do not commute outside coordinates: `B(a, b) − B(b, a) = [a, b]`. The first is the direction, the second is
differentiated.

Source: Aghannan & Rouchon 2003, section II; Koszul's formula in a frame, and Hamel's equations, as in Marsden & Ratiu
1999, Introduction to Mechanics and Symmetry, chapter 13. Curvature sign: on the unit sphere
`R(x, y)z = <y, z>x − <x, z>y`.
"""

import abc
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._linalg import solve
from covariant._typing import Matrix, Scalar, Vector, Vectors
from covariant.geometry import _geodesics as geodesics
from covariant.geometry._geodesics import Budget, Shot, Transported, root
from covariant.geometry._manifold import AbstractManifold, Configuration


class AbstractSpace(Functional):
    """A Riemannian configuration space. Vectors are components (n,) in the manifold's frame."""

    manifold: eqx.AbstractVar[AbstractManifold]

    @property
    def homogeneous(self) -> bool:
        """Whether the metric, in the frame, is the same at every configuration, and so all that follows from it."""
        return False

    @abc.abstractmethod
    def lower(self, x: Configuration, a: Vector) -> Vector:
        """`<a, ·>` at x; where the metric is kinetic energy, the momentum of the velocity a."""

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        """The vector a with `lower(x, a) = μ`; where μ is a force, its acceleration."""
        return solve(self(x), mu)

    def __call__(self, x: Configuration) -> Matrix:
        """The metric's matrix at x: the inner products `<e_i, e_j>` of the frame."""
        zero = self.manifold.zero(x)
        return self.gram(x, jnp.eye(zero.shape[0], dtype=zero.dtype))

    def gram(self, x: Configuration, w: Float[Array, "k n"]) -> Float[Array, "k k"]:
        """Inner products of the vectors w (k, n) at x."""
        return w @ jax.vmap(lambda a: self.lower(x, a))(w).T

    def inner(self, x: Configuration, a: Vector, b: Vector) -> Scalar:
        """`<a, b>` at x."""
        return a @ self.lower(x, b)

    def norm(self, x: Configuration, a: Vector) -> Scalar:
        """`|a|` at x, with a zero (not undefined) derivative at a = 0."""
        return root(self.inner(x, a, a))

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """`<∇_a b, ·>`, the covector of the connection. With M = `lower`, Koszul's formula:

        `½[(∂_a M)b + (∂_b M)a − ∂<a, b> + M[a, b] − ad*_a M b − ad*_b M a]`.
        """
        one = derivative(self.manifold, lambda y: self.lower(y, b), x, a)
        two = derivative(self.manifold, lambda y: self.lower(y, a), x, b)
        total = one + two - differential(self.manifold, lambda y: self.inner(y, a, b), x)
        if not self.manifold.commuting:
            total = total + self.lower(x, self.manifold.bracket(x, a, b))
            total = total - coadjoint(self.manifold, x, a, self.lower(x, b))
            total = total - coadjoint(self.manifold, x, b, self.lower(x, a))
        return total / 2

    def coriolis_matrix(self, x: Configuration, v: Vector) -> Matrix:
        """The matrix C with `C a = <∇_v a, ·>`, so that C v are the Coriolis forces and `M' − 2C` is skew along v."""
        zero = self.manifold.zero(x)
        force = jax.vmap(lambda a: self.connection_force(x, v, a), out_axes=1)
        return force(jnp.eye(zero.shape[0], dtype=zero.dtype))

    def kinetic_force(self, x: Configuration, v: Vector) -> Vector:
        """`½∂<v, v>`: the derivative of the kinetic energy by the configuration, with the components of v constant."""
        return differential(self.manifold, lambda y: self.inner(y, v, v), x) / 2

    def connection(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """`B(a, b) = ∇_a b` at x."""
        return self.raise_(x, self.connection_force(x, a, b))

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """`R(a, b)c = (∂_a B)(b, c) − (∂_b B)(a, c) + B(a, B(b, c)) − B(b, B(a, c)) − B([a, b], c)` at x.

        The covector is computed first and raised once, with `M (∂_a B)(b, c) = (∂_a (M B))(b, c) − (∂_a M) B(b, c)`:
        no solution of a linear system is differentiated.
        """
        bc, force_a = self._bent(x, a, b, c)
        ac, force_b = self._bent(x, b, a, c)
        total = force_a - force_b + self.connection_force(x, a, bc) - self.connection_force(x, b, ac)
        if not self.manifold.commuting:
            total = total - self.connection_force(x, self.manifold.bracket(x, a, b), c)
        return self.raise_(x, total)

    def transport_along(self, p: Configuration, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        """Follow the geodesic of that velocity for unit time, with parallel transport of the vectors w (..., n)."""
        return geodesics.transport_along(self, p, velocity, w, budget)

    def shoot(self, p: Configuration, q: Configuration, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        """The geodesic from p to q; `guess` is a first guess of its velocity at p."""
        return geodesics.shoot(self, p, q, guess, budget)

    def _bent(self, x: Configuration, along: Vector, a: Vector, b: Vector) -> tuple[Vector, Vector]:
        """`B(a, b)`, and the covector `M (∂_along B)(a, b)` of its change in the direction `along`."""
        change = self.manifold.tangent(x, along)
        force, slope = jax.jvp(lambda y: self.connection_force(y, a, b), (x,), (change,))
        turned = self.raise_(x, force)
        return turned, slope - jax.jvp(lambda y: self.lower(y, turned), (x,), (change,))[1]


def derivative(
    manifold: AbstractManifold, f: Callable[[Array], Array], x: Configuration, a: Vector
) -> Float[Array, "..."]:
    """`∂_a f`: the rate of change of f at x when the configuration moves with velocity a."""
    return jax.jvp(f, (x,), (manifold.tangent(x, a),))[1]


def differential(manifold: AbstractManifold, f: Callable[[Array], Array], x: Configuration) -> Vector:
    """`∂f`, the covector with `<∂f, a> = ∂_a f`, for a scalar f."""
    return jax.grad(lambda a: f(manifold.nudged(x, a)))(manifold.zero(x))


def coadjoint(manifold: AbstractManifold, x: Configuration, a: Vector, mu: Vector) -> Vector:
    """`ad*_a μ` at x, with `<ad*_a μ, b> = <μ, [a, b]>`."""
    return jax.linear_transpose(lambda b: manifold.bracket(x, a, b), a)(mu)[0]
