"""Public functions of geometry. Each takes the space first, then the base point.

A plain callable `q -> (n, n)`, the matrix of a metric, also counts as a space. Vectors are components (n,) in the frame
of the space's manifold, and covectors are components in its dual frame; in coordinates these are ∂/∂q and dq.
"""

import jax.numpy as jnp

from covariant._typing import MatrixField, Scalar, Vector, Vectors
from covariant.geometry._geodesics import Budget, Shot, Transported
from covariant.geometry._manifold import Configuration
from covariant.geometry._metric import as_space
from covariant.geometry._space import AbstractSpace
from covariant.signals import StepCode

Space = AbstractSpace | MatrixField


def inner(space: Space, q: Configuration, x: Vector, y: Vector) -> Scalar:
    """Inner product `<x, y>` at q; for a kinetic-energy metric `½ <v, v>` is the kinetic energy [J].

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        x: vector (n,) at q.
        y: vector (n,) at q.

    Returns:
        The inner product, a scalar.

    Example:
        Kinetic energy of 2 kg at 3 m/s:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry._functions import inner
        >>> v = jnp.array([3.0])
        >>> float(inner(lambda q: 2.0 * jnp.eye(1), jnp.zeros(1), v, v) / 2)
        9.0
    """
    return as_space(space).inner(q, x, y)


def norm(space: Space, q: Configuration, x: Vector) -> Scalar:
    """Length `|x|` of a vector at q, with a zero (not undefined) derivative at x = 0.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        x: vector (n,) at q.

    Returns:
        The length, a scalar.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry._functions import norm
        >>> float(norm(lambda q: 4.0 * jnp.eye(2), jnp.zeros(2), jnp.array([3.0, 4.0])))
        10.0
    """
    return as_space(space).norm(q, x)


def connection(space: Space, q: Configuration, x: Vector, y: Vector) -> Vector:
    """Covariant derivative `B(x, y) = ∇_x y` of the field y with constant components.

    For a moving vector w and a velocity v, `∇_q̇ w = ẇ + B(v, w)`. The arguments do not commute, except in coordinates:
    `B(x, y) − B(y, x) = [x, y]`, where x is the direction and y the differentiated field.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        x: direction (n,).
        y: components (n,) of the differentiated field, constant in the frame.

    Returns:
        Vector (n,).

    Example:
        In polar coordinates (r, φ) the centrifugal term is −r φ'²:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import connection
        >>> polar = lambda q: jnp.diag(jnp.stack([jnp.ones(()), q[0] ** 2]))
        >>> velocity = jnp.array([0.0, 1.0])
        >>> connection(polar, jnp.array([2.0, 0.0]), velocity, velocity).tolist()
        [-2.0, 0.0]
    """
    return as_space(space).connection(q, x, y)


def christoffel(space: Space, q: Vector, x: Vector, y: Vector) -> Vector:
    """Christoffel symbols `Γ(q)(x, y)` contracted with x and y: the `connection` in coordinates, symmetric in both.

    Use it for the terms of a geodesic equation, `q'' = −Γ(q)(q', q')`; the Coriolis forces are the inertia matrix times
    `Γ(q)(q', q')`. It is for coordinates only: in the frame of a group the connection is not symmetric, so use
    `space.connection` there.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: coordinates (n,).
        x: vector (n,).
        y: vector (n,).

    Returns:
        Vector (n,) with the entries `Γ^k_ij x_i y_j`.

    Example:
        In polar coordinates (r, φ), `Γ^φ_rφ = 1/r`:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import christoffel
        >>> polar = lambda q: jnp.diag(jnp.stack([jnp.ones(()), q[0] ** 2]))
        >>> christoffel(polar, jnp.array([2.0, 0.0]), jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])).tolist()
        [0.0, 0.5]
    """
    return as_space(space).connection(q, x, y)


def curvature(space: Space, q: Configuration, x: Vector, y: Vector, z: Vector) -> Vector:
    """Riemann curvature `R(x, y)z = ∇_x∇_y z − ∇_y∇_x z − ∇_[x,y] z` at q.

    On the unit sphere `R(x, y)z = <y, z>x − <x, z>y`.

    Its sign decides how errors between neighbouring motions grow: with negative curvature they diverge. `Intrinsic` and
    `Geodesic` compensate the term `R(ξ, v)v`. Books differ in the sign convention; here it is the one of the formula
    above. Use `sectional_curvature` for a single number.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        x: first vector (n,) of the pair in which R is antisymmetric.
        y: second vector (n,) of this pair.
        z: vector (n,) on which R acts.

    Returns:
        Vector (n,).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import curvature, sphere
        >>> x, y = jnp.array([0.5, 0.0]), jnp.array([0.0, 0.5])  # of unit length at the origin of the chart
        >>> curvature(sphere(), jnp.zeros(2), x, y, y).tolist()
        [0.5, 0.0]
    """
    return as_space(space).curvature(q, x, y, z)


def sectional_curvature(space: Space, q: Configuration, x: Vector, y: Vector) -> Scalar:
    """Sectional curvature of the plane of two vectors; 1 on the unit sphere.

    It is `K(x, y) = <R(x, y)y, x> / (|x|²|y|² − <x, y>²)` at q. Its unit is the reciprocal of the metric's. If it is
    negative, geodesics that start side by side diverge.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        x: vector (n,) in the plane.
        y: vector (n,) in the plane, not a multiple of x.

    Returns:
        The curvature K, a scalar.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import hyperbolic, sectional_curvature
        >>> q, x, y = jnp.array([0.1, 0.2]), jnp.array([1.0, 0.0]), jnp.array([1.0, 1.0])
        >>> round(float(sectional_curvature(hyperbolic(), q, x, y)), 9)
        -1.0
    """
    space = as_space(space)
    # Divided by the squared area of the parallelogram, K depends on the plane and not on the vectors that span it.
    xx, xy, yy = space.inner(q, x, x), space.inner(q, x, y), space.inner(q, y, y)
    return space.inner(q, space.curvature(q, x, y, y), x) / (xx * yy - xy**2)


def gradient(space: Space, q: Configuration, covector: Vector) -> Vector:
    """Tangent vector `g(q)⁻¹ covector` of a covector, such as a differential or a generalised force.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration.
        covector: covector (n,) at q.

    Returns:
        Vector (n,).

    Example:
        Acceleration of 2 kg by a force of 6 N:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry._functions import gradient
        >>> gradient(lambda q: 2.0 * jnp.eye(1), jnp.zeros(1), jnp.array([6.0])).tolist()
        [3.0]
    """
    return as_space(space).raise_(q, covector)


def exp(space: Space, q: Configuration, v: Vector, budget: Budget = Budget()) -> Configuration:
    """Riemannian exponential: the end, after unit time, of the geodesic from q with velocity v.

    Use it to move a configuration along a vector without leaving the space, as for a correction or a sample around a
    mean. It is the inverse of `log` up to the first conjugate point. If it has no closed form, it integrates the
    geodesic equation; `manifold.retract` is cheaper if first order is enough.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        q: configuration at which the geodesic starts.
        v: its velocity (n,) at q.
        budget: work of the numerical integration; closed forms ignore it.

    Returns:
        A configuration.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, exp
        >>> exp(Euclidean(), jnp.array([1.0, 2.0]), jnp.array([0.5, 0.0])).tolist()
        [1.5, 2.0]
    """
    return as_space(space).transport_along(q, v, v[None], budget).q


def shoot(
    space: Space,
    p: Configuration,
    q: Configuration,
    guess: Vector | None = None,
    budget: Budget = Budget(),
) -> Shot:
    """Geodesic from p to q in unit time, with its residual and a result code.

    Use it in place of `log` to learn whether the search succeeded, or which velocity the geodesic has at its end. `OK`
    does not prove that the geodesic is the shortest: a numerical search returns one geodesic, and only conjugate points
    are counted. Pass the previous solution as `guess` if p and q move slowly.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        p: configuration at which it starts.
        q: configuration at which it ends.
        guess: first guess of its initial velocity (n,), optional; it is used if no other candidate ends closer to q.
        budget: work of the numerical search; closed forms ignore it.

    Returns:
        Velocities at both ends, residual and result code.

    Raises:
        ValueError: for a budget with `near` and without a number of `newton` corrections.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import StepCode
        >>> from covariant.geometry import shoot, sphere
        >>> shot = shoot(sphere(), jnp.zeros(2), jnp.array([1.0, 0.0]))
        >>> StepCode(int(shot.result)).name
        'OK'
    """
    return as_space(space).shoot(p, q, guess, budget)


def log(space: Space, p: Configuration, q: Configuration, budget: Budget = Budget()) -> Vector:
    """Riemannian logarithm: the velocity at p of the unit-time geodesic to q.

    It may also return a geodesic that goes beyond a conjugate point and so is not the shortest one; `shoot` flags it.

    Use it as the error vector from p to q: `exp(space, p, log(space, p, q))` is q. It is a vector at p, so transport it
    before you compare it with one elsewhere.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        p: configuration at which the geodesic starts.
        q: configuration at which it ends.
        budget: work of the numerical search; closed forms ignore it.

    Returns:
        Velocity (n,) at p; NaN if the search did not converge, for which `shoot` reports the reason.

    Example:
        On the circle of 360° the shortest path from 10° to 350° is −20°:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import FlatTorus, log
        >>> log(FlatTorus(jnp.array([360.0])), jnp.array([10.0]), jnp.array([350.0])).tolist()
        [-20.0]
    """
    shot = shoot(space, p, q, None, budget)
    # NaN only for this code: with `CONJUGATE_POINT` the velocity still leads to q.
    return jnp.where(shot.result == StepCode.NOT_CONVERGED, jnp.nan, shot.velocity)


def distance(space: Space, p: Configuration, q: Configuration, budget: Budget = Budget()) -> Scalar:
    """Geodesic distance between p and q: the length of `log`.

    Use it to measure an error independently of coordinates. Its unit is that of the metric, such as √kg m for the
    kinetic-energy metric. If there is no closed form, each call searches for a geodesic, which costs far more than a
    norm. The geodesic need not be the shortest one: `shoot` flags it if it passes a conjugate point.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        p: configuration.
        q: configuration.
        budget: work of the numerical search; closed forms ignore it.

    Returns:
        The distance, a scalar; NaN if the search did not converge.

    Example:
        A quarter of a great circle of the unit sphere, in the stereographic chart:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import distance, sphere
        >>> bool(jnp.isclose(distance(sphere(), jnp.zeros(2), jnp.array([1.0, 0.0])), jnp.pi / 2))
        True
    """
    # A geodesic has constant speed, so its length over unit time is the length of its initial velocity.
    return norm(space, p, log(space, p, q, budget))


def transport(space: Space, p: Configuration, v: Vector, q: Configuration, budget: Budget = Budget()) -> Vector:
    """Parallel transport of v from p to q along the geodesic between them: a linear isometry.

    Use it to compare or add velocities at different configurations, such as an estimated and a true one. The result
    depends on the path, and the geodesic is the usual choice. The geodesic is searched first; if you know its initial
    velocity, `space.transport_along` saves the search.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        p: configuration at which v is.
        v: vector (n,) at p.
        q: configuration to which v is transported.
        budget: work of the numerical search and integration; closed forms ignore it.

    Returns:
        The transported vector, in the shape of v; NaN if the search did not converge.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import sphere, transport
        >>> from covariant.geometry._functions import norm
        >>> p, q, v = jnp.zeros(2), jnp.array([0.4, 0.2]), jnp.array([0.0, 1.0])
        >>> w = transport(sphere(), p, v, q)
        >>> bool(jnp.isclose(norm(sphere(), q, w), norm(sphere(), p, v)))
        True
    """
    return as_space(space).transport_along(p, log(space, p, q, budget), v, budget).w


def transport_along(
    space: Space, p: Configuration, velocity: Vector, w: Vectors, budget: Budget = Budget()
) -> Transported:
    """Geodesic of a velocity, followed for unit time, with parallel transport of vectors along it.

    Args:
        space: a space, or a metric in coordinates as a function `q -> (n, n)`.
        p: configuration at which the geodesic starts.
        velocity: its velocity (n,) at p.
        w: vectors (..., n) at p.
        budget: work of the numerical integration; closed forms ignore it.

    Returns:
        The end of the geodesic, its velocity and the vectors there.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, transport_along
        >>> p, velocity, w = jnp.zeros(2), jnp.array([1.0, 0.0]), jnp.array([0.0, 3.0])
        >>> end = transport_along(Euclidean(), p, velocity, w)
        >>> end.q.tolist(), end.w.tolist()
        ([1.0, 0.0], [0.0, 3.0])
    """
    return as_space(space).transport_along(p, velocity, w, budget)
