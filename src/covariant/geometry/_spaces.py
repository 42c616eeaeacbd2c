"""Reference spaces with exponential, logarithm and transport in closed form.

One class covers all constant curvatures K ≠ 0: the stereographic chart with the metric `4 / (1 + K|q|²)² I`, in which
geodesics are Möbius translations (Ungar 2008, Analytic Hyperbolic Geometry, chapters 3 and 6, with c = −K).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from covariant._typing import Flag, Matrix, Scalar, Vector, Vectors
from covariant.geometry._geodesics import Budget, Shot, Transported
from covariant.geometry._manifold import split
from covariant.geometry._metric import AbstractMetric
from covariant.signals import StepCode
from scalargraph.errors import InputError


def _found(velocity: Vector, arrival: Vector) -> Shot:
    finite = jnp.all(jnp.isfinite(velocity)) & jnp.all(jnp.isfinite(arrival))
    return Shot(
        velocity, arrival, jnp.zeros_like(velocity[0]), jnp.where(finite, int(StepCode.OK), StepCode.NOT_CONVERGED)
    )


class Euclidean(AbstractMetric):
    """Flat space in Cartesian coordinates.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, distance
        >>> float(distance(Euclidean(), jnp.zeros(2), jnp.array([3.0, 4.0])))
        5.0
    """

    def __call__(self, x: Vector) -> Matrix:
        return jnp.eye(x.shape[0], dtype=x.dtype)

    def connection(self, x: Vector, a: Vector, b: Vector) -> Vector:
        return jnp.zeros_like(x)

    def curvature(self, x: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
        return jnp.zeros_like(x)

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        return Transported(p + velocity, velocity, w)

    def shoot(self, p: Vector, q: Vector, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        return _found(q - p, q - p)


class FlatTorus(Euclidean):
    """Flat space whose coordinates are periodic; `log` takes the shortest path around.

    Attributes:
        periods: period (n,) of each coordinate, in its unit.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import FlatTorus, distance
        >>> degrees = FlatTorus(jnp.array([360.0]))
        >>> float(distance(degrees, jnp.array([10.0]), jnp.array([350.0])))
        20.0
    """

    periods: Vector

    def shoot(self, p: Vector, q: Vector, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        periods = self.periods.astype(q.dtype)
        # `round` goes to even numbers: of two paths of half a period the direct one is chosen.
        shortest = q - p - periods * jnp.round((q - p) / periods)
        return _found(shortest, shortest)


class ConstantCurvature(AbstractMetric):
    """Space of constant curvature K ≠ 0 in the stereographic chart, with the metric `4 / (1 + K|q|²)² I`.

    `sphere` and `hyperbolic` build it from a radius.

    Attributes:
        k: curvature K, in units of the reciprocal of the metric.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry._spaces import ConstantCurvature
        >>> ConstantCurvature(0.25)(jnp.array([2.0, 0.0])).tolist()
        [[1.0, 0.0], [0.0, 1.0]]
    """

    k: float = eqx.field(static=True, converter=float)

    def __call__(self, x: Vector) -> Matrix:
        return self._scale(x) ** 2 * jnp.eye(x.shape[0], dtype=x.dtype)

    def connection(self, x: Vector, a: Vector, b: Vector) -> Vector:
        # A metric e^{2φ} I has Γ(a, b) = (a·∇φ)b + (b·∇φ)a − (a·b)∇φ; here φ = log σ and ∇φ = −Kσx, σ being the scale.
        return -self.k * self._scale(x) * ((x @ a) * b + (x @ b) * a - (a @ b) * x)

    def curvature(self, x: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
        # R(a, b)c = K(<b, c>a − <a, c>b); an inner product is σ² times the product of components.
        return self.k * self._scale(x) ** 2 * ((b @ c) * a - (a @ c) * b)

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        middle, end = self._exponential(p, velocity / 2), self._exponential(p, velocity)

        def carry(a):  # in two halves, since the formula for transport to an antipode is 0/0
            return self._carry(middle, self._carry(p, a, middle), end)

        carried = jax.vmap(carry)(w.reshape(-1, p.shape[0])).reshape(w.shape)
        return Transported(end, carry(velocity), carried)

    def shoot(self, p: Vector, q: Vector, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        # An isometry that takes p to 0 makes the geodesic a straight line through the origin of the chart.
        displacement = self._add(-p, q)
        velocity = 2 / self._scale(p) * displacement * self._arctan_ratio(displacement @ displacement)
        return _found(velocity, self._carry(p, velocity, q))

    def _exponential(self, p: Vector, velocity: Vector) -> Vector:
        # A point at distance r from the origin has the radius tan(√K r/2)/√K in the chart, hence half of r = σ|v|.
        half = self._scale(p) * velocity / 2
        return self._add(p, half * self._tan_ratio(half @ half))

    def _scale(self, q: Vector) -> Scalar:
        return 2 / (1 + self.k * (q @ q))

    def _add(self, x: Vector, y: Vector) -> Vector:
        """Möbius addition: the isometry that takes 0 to x, applied to y."""
        # The denominator vanishes only on the sphere, for y opposite −x: the chart does not contain that sum.
        k, xy, xx, yy = self.k, x @ y, x @ x, y @ y
        return ((1 - 2 * k * xy - k * yy) * x + (1 + k * xx) * y) / (1 - 2 * k * xy + k**2 * xx * yy)

    def _carry(self, p: Vector, w: Vector, q: Vector) -> Vector:
        """Parallel transport from p to q: the gyration of (q, −p), scaled to keep the length."""
        c, u, v = -self.k, q, -p
        uv, uu, vv, uw, vw = u @ v, u @ u, v @ v, u @ w, v @ w
        a = -(c**2) * uw * vv + c * vw + 2 * c**2 * uv * vw
        b = -(c**2) * vw * uu - c * uw
        gyrated = w + 2 * (a * u + b * v) / (1 + 2 * c * uv + c**2 * uu * vv)
        return gyrated * self._scale(p) / self._scale(q)

    def _tan_ratio(self, square: Scalar) -> Scalar:
        """`tan(√K s) / (√K s)` as a function of s², smooth at zero for either sign of K."""
        x = self.k * square
        small, root = _root(x)
        # √K s = i√|K| s for K < 0, and tan(iz) = i tanh z: the factor i cancels in the ratio.
        closed_form = jnp.tan(root) / root if self.k > 0 else jnp.tanh(root) / root
        return jnp.where(small, _polynomial(_TAN, x), closed_form)

    def _arctan_ratio(self, square: Scalar) -> Scalar:
        """`arctan(√K s) / (√K s)` as a function of s²."""
        x = self.k * square
        small, root = _root(x)
        closed_form = jnp.arctan(root) / root if self.k > 0 else jnp.arctanh(root) / root
        return jnp.where(small, _polynomial(_ARCTAN, x), closed_form)


_NEAR = 0.1
"""Value of |K s²| below which a series replaces the closed form; it is generous, so all small s use the series."""
# The first omitted term, of the arc tangent, is at most 0.1¹⁸/37 = 3e-20 of the sum.
_TERMS = 18


def _root(x: Scalar) -> tuple[Flag, Scalar]:
    """Whether the series applies at x, and `√|x|`; if it applies, the root of `_NEAR` replaces the latter."""
    small = jnp.abs(x) < _NEAR
    # x is replaced before the root: a later `where` would leave an infinite derivative, and NaN, at zero.
    return small, jnp.sqrt(jnp.where(small, _NEAR, jnp.abs(x)))


def _polynomial(coefficients: list[float], x: Scalar) -> Scalar:
    # If the series is not used, its argument is 0: it cannot overflow or spoil a derivative.
    near = jnp.where(jnp.abs(x) < _NEAR, x, 0.0)
    total = jnp.zeros_like(x)
    for coefficient in reversed(coefficients):
        total = coefficient + near * total
    return total


def _tangent_series() -> list[float]:
    """Coefficients of `tan(s)/s` in s², from `tan' = 1 + tan²`."""
    coefficients: list[float] = [1.0]
    for k in range(1, _TERMS):
        # Comparing coefficients of s^{2k} in tan' = 1 + tan²: a convolution of the earlier ones.
        coefficients.append(sum(coefficients[j] * coefficients[k - 1 - j] for j in range(k)) / (2 * k + 1))
    return coefficients


_TAN = _tangent_series()
_ARCTAN = [(-1.0) ** k / (2 * k + 1) for k in range(_TERMS)]


def sphere(radius: float = 1.0) -> ConstantCurvature:
    """Sphere in the stereographic chart, which omits one point, opposite the origin.

    Use it to test methods against known geometry. The point opposite the origin is at infinity, so keep motions away
    from it. Near the origin lengths are twice those of the coordinates. For attitudes use `lie.SO3` with
    `LeftInvariant`, which has no such point.

    Args:
        radius: its radius, 1 by default; coordinates are in the same unit.

    Returns:
        The space of curvature 1/radius², of any dimension n.

    Example:
        From the origin to the equator, a quarter of a great circle:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import distance, sphere
        >>> bool(jnp.isclose(distance(sphere(2.0), jnp.zeros(2), jnp.array([2.0, 0.0])), jnp.pi))
        True
    """
    return ConstantCurvature(1.0 / radius**2)


def hyperbolic(radius: float = 1.0) -> ConstantCurvature:
    """Hyperbolic space of curvature −1/radius², in the Poincaré ball |q| < radius.

    Use it to test methods in a space whose negative curvature makes motions diverge. Points outside the ball are not in
    the space. Near the origin lengths are twice those of the coordinates.

    Args:
        radius: radius of the ball, 1 by default.

    Returns:
        The space, of any dimension n.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import distance, hyperbolic
        >>> q = jnp.array([jnp.tanh(0.5), 0.0])
        >>> round(float(distance(hyperbolic(), jnp.zeros(2), q)), 9)
        1.0
    """
    return ConstantCurvature(-1.0 / radius**2)


class Product(AbstractMetric):
    """Product of spaces, with their coordinates side by side.

    Use it for machines that do not influence each other, or for a flat part beside a curved one: closed forms of the
    factors are used, and geodesics are computed for each factor. If inertia couples the parts, use a `Metric` of the
    whole. If factors are groups, use a `ProductManifold`.

    Attributes:
        spaces: the factors.
        sizes: number of coordinates of each factor.

    Raises:
        ValueError: `spaces` and `sizes` have different lengths.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, FlatTorus, Product, log
        >>> cylinder = Product((Euclidean(), FlatTorus(jnp.array([360.0]))), sizes=(1, 1))
        >>> log(cylinder, jnp.array([0.0, 10.0]), jnp.array([5.0, 350.0])).tolist()
        [5.0, -20.0]
    """

    spaces: tuple[AbstractMetric, ...]
    sizes: tuple[int, ...] = eqx.field(static=True)

    def __check_init__(self):
        if len(self.spaces) != len(self.sizes):
            raise InputError(f"Product: {len(self.spaces)} spaces but {len(self.sizes)} sizes; give one size a space.")

    def __call__(self, x: Vector) -> Matrix:
        return jax.scipy.linalg.block_diag(*(space(part) for space, part in self._each(x)))

    def connection(self, x: Vector, a: Vector, b: Vector) -> Vector:
        return jnp.concatenate([space.connection(*parts) for space, *parts in self._each(x, a, b)])

    def curvature(self, x: Vector, a: Vector, b: Vector, c: Vector) -> Vector:
        return jnp.concatenate([space.curvature(*parts) for space, *parts in self._each(x, a, b, c)])

    def transport_along(self, p: Vector, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        ends = [space.transport_along(*parts, budget) for space, *parts in self._each(p, velocity, w)]
        return Transported(*(jnp.concatenate(field, axis=-1) for field in zip(*ends, strict=True)))

    def shoot(self, p: Vector, q: Vector, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        guesses = [None] * len(self.sizes) if guess is None else split(guess, self.sizes)
        pairs = zip(self._each(p, q), guesses, strict=True)
        shots = [space.shoot(*parts, first, budget) for (space, *parts), first in pairs]
        velocity, arrival = (jnp.concatenate([s[i] for s in shots]) for i in (0, 1))
        # Factors are orthogonal, so squares of lengths add up; the largest result code is the worst one.
        residual = jnp.sqrt(sum(s.residual**2 for s in shots))
        return Shot(velocity, arrival, residual, jnp.max(jnp.stack([s.result for s in shots])))

    def _each(self, *arrays: Array):
        return zip(self.spaces, *(split(a, self.sizes, axis=-1) for a in arrays), strict=True)
