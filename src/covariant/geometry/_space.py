"""Configuration spaces: a manifold with a frame and a metric, and all operations that follow from the metric.

`lower` alone defines the metric; the connection, the curvature and geodesics follow from it and the frame. A space that
can do better, by closed forms or by the recursions of a robot, overrides the methods concerned. Every operation is
directional: no array of n³ entries is formed.

`B(a, b) = ∇_a b` is the covariant derivative, along a, of the field with the constant components b. Its arguments do
not commute, except in coordinates: `B(a, b) − B(b, a) = [a, b]`. The first is the direction, the second is
differentiated.

Source: Aghannan & Rouchon 2003, section II; Koszul's formula in a frame, and Hamel's equations, as in Marsden & Ratiu
1999, Introduction to Mechanics and Symmetry, chapter 13. Curvature sign: on the unit sphere `R(x, y)z = <y, z>x − <x,
z>y`.
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
    """A Riemannian configuration space. Vectors are components (n,) in the manifold's frame.

    A subclass defines `lower`; every other operation is derived from it.

    Subclass it if the metric has a closed form or a special structure. Otherwise use a ready space, `Metric` for a
    matrix, or `KineticEnergy` for an energy; `LeftInvariant` is for Lie groups. Derived operations cost automatic
    differentiation and numerical geodesics, so define those for which you know a closed form in the subclass.

    Attributes:
        manifold: the manifold of the configurations, with its frame.

    Example:
        The plane in polar coordinates (r, φ). The connection has the centrifugal term −r φ'²:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import AbstractManifold, AbstractSpace, Coordinates
        >>> class Polar(AbstractSpace):
        ...     manifold: AbstractManifold = Coordinates(circles=(1,))
        ...     def lower(self, x, a):
        ...         return jnp.stack([a[0], x[0] ** 2 * a[1]])
        >>> x, velocity = jnp.array([2.0, 0.0]), jnp.array([0.0, 1.0])
        >>> Polar().connection(x, velocity, velocity).tolist()
        [-2.0, 0.0]
    """

    manifold: eqx.AbstractVar[AbstractManifold]

    @abc.abstractmethod
    def lower(self, x: Configuration, a: Vector) -> Vector:
        """The covector `<a, ·>`; if the metric is the kinetic energy, the momentum of the velocity a.

        Args:
            x: configuration.
            a: vector (n,) in the frame at x.

        Returns:
            Covector (n,).
        """

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        """The vector of a covector, the inverse of `lower`; if μ is a force, this is its acceleration.

        Args:
            x: configuration.
            mu: covector μ (n,).

        Returns:
            The vector a (n,) with `lower(x, a) = μ`.
        """
        return solve(self(x), mu)

    def __call__(self, x: Configuration) -> Matrix:
        """The metric's matrix (n, n) at x: the inner products `<e_i, e_j>` of the frame."""
        zero = self.manifold.zero(x)
        return self.gram(x, jnp.eye(zero.shape[0], dtype=zero.dtype))

    def gram(self, x: Configuration, w: Float[Array, "k n"]) -> Float[Array, "k k"]:
        """Gram matrix: the inner products of several vectors.

        Args:
            x: configuration.
            w: vectors (k, n) in the frame at x.

        Returns:
            Matrix (k, k) of `<w_i, w_j>`.
        """
        return w @ jax.vmap(lambda a: self.lower(x, a))(w).T

    def inner(self, x: Configuration, a: Vector, b: Vector) -> Scalar:
        """Inner product `<a, b>` of two vectors (n,) at x."""
        return a @ self.lower(x, b)

    def norm(self, x: Configuration, a: Vector) -> Scalar:
        """Length `|a|` of a vector (n,) at x, with a zero (not undefined) derivative at a = 0."""
        return root(self.inner(x, a, a))

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """Covector `<∇_a b, ·>` of the connection, by Koszul's formula.

        With M = `lower` it is `½[(∂_a M)b + (∂_b M)a − ∂<a, b> + M[a, b] − ad*_a M b − ad*_b M a]`.

        Args:
            x: configuration.
            a: direction (n,).
            b: components (n,) of the differentiated field, constant in the frame.

        Returns:
            Covector (n,).
        """
        # The first three terms of the docstring: (∂_a M)b, (∂_b M)a, ∂<a, b>.
        one = derivative(self.manifold, lambda y: self.lower(y, b), x, a)
        two = derivative(self.manifold, lambda y: self.lower(y, a), x, b)
        total = one + two - differential(self.manifold, lambda y: self.inner(y, a, b), x)
        if not self.manifold.commuting:
            # The remaining terms of Koszul's formula, for a frame; they vanish in coordinates, where they are left out
            # to save work.
            total = total + self.lower(x, self.manifold.bracket(x, a, b))
            total = total - coadjoint(self.manifold, x, a, self.lower(x, b))
            total = total - coadjoint(self.manifold, x, b, self.lower(x, a))
        return total / 2

    def coriolis_matrix(self, x: Configuration, v: Vector) -> Matrix:
        """Coriolis matrix C, with `C a = <∇_v a, ·>`.

        C v are the Coriolis forces, and `M' − 2C` is skew along v, M being the metric's matrix.

        Args:
            x: configuration.
            v: velocity (n,).

        Returns:
            Matrix (n, n).
        """
        zero = self.manifold.zero(x)
        # C acts on the differentiated field, the second argument; only then is M' − 2C skew in every frame.
        force = jax.vmap(lambda a: self.connection_force(x, v, a), out_axes=1)
        return force(jnp.eye(zero.shape[0], dtype=zero.dtype))

    def kinetic_force(self, x: Configuration, v: Vector, momentum: Vector | None = None) -> Vector:
        """Derivative `½∂<v, v>` of the kinetic energy by the configuration, for constant velocity components.

        Args:
            x: configuration.
            v: velocity (n,).
            momentum: momentum (n,) of the motion, needed only on a `Leaf`; by default the momentum of v.

        Returns:
            Covector (n,).
        """
        return differential(self.manifold, lambda y: self.inner(y, v, v), x) / 2

    def connection(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """Covariant derivative `B(a, b) = ∇_a b` at x.

        Args:
            x: configuration.
            a: direction (n,).
            b: components (n,) of the differentiated field, constant in the frame.

        Returns:
            Vector (n,).
        """
        return self.raise_(x, self.connection_force(x, a, b))

    def acceleration(self, x: Configuration, v: Vector, force: Vector) -> Vector:
        """Rate v' of the velocity components under a force, `raise(force) − B(v, v)`.

        Args:
            x: configuration.
            v: velocity (n,).
            force: covector (n,).

        Returns:
            The rate (n,).
        """
        return self.raise_(x, force - self.connection_force(x, v, v))

    def projected(self, x: Configuration, a: Vector) -> Vector:
        """The part of a vector (n,) tangential to the space; only on a `Leaf` it differs from the vector."""
        return a

    def restored(self, x: Configuration, v: Vector) -> tuple[Configuration, Vector]:
        """A motion after a numerical step, moved back to the space, from which it may drift on a `Leaf`.

        Args:
            x: configuration.
            v: velocity (n,).

        Returns:
            The configuration and the velocity (n,) on the space.
        """
        return x, v

    def between(self, x: Configuration, y: Configuration, matrix: Float[Array, "N N"]) -> Float[Array, "N N"]:
        """A linear map of errors (position (n,), velocity (n,), others) from x to y, restricted to tangential parts.

        Args:
            x: configuration before.
            y: configuration after.
            matrix: the map (N, N).

        Returns:
            The map (N, N), which is invertible if `matrix` is.
        """
        return matrix

    def restored_momentum(self, x: Configuration, momentum: Vector) -> tuple[Configuration, Vector]:
        """The same as `restored`, for a momentum (n,) in place of a velocity."""
        return x, momentum

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """Riemann curvature `R(a, b)c` at x.

        It is `(∂_a B)(b, c) − (∂_b B)(a, c) + B(a, B(b, c)) − B(b, B(a, c)) − B([a, b], c)`. The covector is computed
        first and raised once, with `M (∂_a B)(b, c) = (∂_a (M B))(b, c) − (∂_a M) B(b, c)`: no solution of a linear
        system is differentiated.

        Args:
            x: configuration.
            a: first vector (n,) of the pair in which R is antisymmetric.
            b: second vector (n,) of this pair.
            c: vector (n,) on which R acts.

        Returns:
            Vector (n,).
        """
        bc, force_a = self._connection_and_change(x, a, b, c)
        ac, force_b = self._connection_and_change(x, b, a, c)
        total = force_a - force_b + self.connection_force(x, a, bc) - self.connection_force(x, b, ac)
        if not self.manifold.commuting:
            total = total - self.connection_force(x, self.manifold.bracket(x, a, b), c)
        return self.raise_(x, total)

    def transport_along(self, p: Configuration, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        """Geodesic of a velocity, followed for unit time, with parallel transport of vectors along it.

        Args:
            p: configuration at which the geodesic starts.
            velocity: its velocity (n,) at p.
            w: vectors (..., n) at p.
            budget: work of the numerical integration; closed forms ignore it.

        Returns:
            The end of the geodesic, its velocity and the vectors there.
        """
        return geodesics.transport_along(self, p, velocity, w, budget)

    def shoot(self, p: Configuration, q: Configuration, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        """Geodesic from p to q in unit time.

        Args:
            p: configuration at which it starts.
            q: configuration at which it ends.
            guess: first guess of its velocity (n,) at p, optional.
            budget: work of the numerical search; closed forms ignore it.

        Returns:
            The geodesic, with residual and result code.
        """
        return geodesics.shoot(self, p, q, guess, budget)

    def _connection_and_change(self, x: Configuration, along: Vector, a: Vector, b: Vector) -> tuple[Vector, Vector]:
        """`B(a, b)`, and the covector `M (∂_along B)(a, b)` of its change along the direction `along`."""
        change = self.manifold.tangent(x, along)
        force, slope = jax.jvp(lambda y: self.connection_force(y, a, b), (x,), (change,))
        vector = self.raise_(x, force)
        # Product rule: `slope` contains the change of M too, which is subtracted here.
        return vector, slope - jax.jvp(lambda y: self.lower(y, vector), (x,), (change,))[1]


def derivative(
    manifold: AbstractManifold, f: Callable[[Array], Array], x: Configuration, a: Vector
) -> Float[Array, "..."]:
    """Directional derivative `∂_a f`: the rate of change of f when the configuration moves with velocity a.

    Args:
        manifold: manifold of the configurations.
        f: function of a configuration, with an array of any shape as its value.
        x: configuration.
        a: velocity (n,) in the frame at x.

    Returns:
        Rate of change, in the shape of f(x).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Coordinates, derivative
        >>> float(derivative(Coordinates(), lambda q: q[0] ** 2, jnp.array([3.0]), jnp.array([0.5])))
        3.0
    """
    return jax.jvp(f, (x,), (manifold.tangent(x, a),))[1]


def differential(manifold: AbstractManifold, f: Callable[[Array], Array], x: Configuration) -> Vector:
    """Differential `∂f`: the covector with `<∂f, a> = ∂_a f`.

    Args:
        manifold: manifold of the configurations.
        f: scalar function of a configuration.
        x: configuration.

    Returns:
        Covector (n,) in the frame at x.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Coordinates, differential
        >>> differential(Coordinates(), lambda q: q[0] * q[1], jnp.array([3.0, 2.0])).tolist()
        [2.0, 3.0]
    """
    # Differentiating by the step a gives frame components; differentiating by x would include directions off the
    # manifold.
    return jax.grad(lambda a: f(manifold.nudged(x, a)))(manifold.zero(x))


def coadjoint(manifold: AbstractManifold, x: Configuration, a: Vector, mu: Vector) -> Vector:
    """Coadjoint operator of the frame, `ad*_a μ`, with `<ad*_a μ, b> = <μ, [a, b]>`."""
    # The second argument of `linear_transpose` is only an example of b; its values are not used.
    return jax.linear_transpose(lambda b: manifold.bracket(x, a, b), a)(mu)[0]
