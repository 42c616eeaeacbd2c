"""Spaces of machines with closed loops: configurations that satisfy a constraint, with a connection of their own.

A = dc are the rows of the constraint c, `A⁺ = g⁻¹Aᵀ(A g⁻¹Aᵀ)⁻¹`, and `P = I − A⁺A` is the orthogonal projection. On the
whole space, the connection of a leaf c = 0 is the ordinary one, B, changed to

    B̃(a, b) = P B(a, b) + A⁺(∂_a A) b

It has no torsion, every leaf c = const is totally geodesic in it, and on vectors with A b = 0 it is the Levi-Civita
connection of the leaf. Configurations and vectors remain those of the whole space, n numbers each: no coordinates are
chosen on the leaf, so none can become singular.

Source: Kobayashi & Nomizu 1969, Foundations of Differential Geometry II, chapter VII, for the equation of Gauss.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from covariant._linalg import pivots, solve
from covariant._typing import Flag, Matrix, Vector, Vectors
from covariant.geometry import _geodesics as geodesics
from covariant.geometry._geodesics import Budget, Shot, Transported
from covariant.geometry._leaf_rows import CLOSED, SINGULAR, Look, closed, independent, rows_of
from covariant.geometry._manifold import AbstractManifold, Configuration
from covariant.geometry._space import AbstractSpace, derivative, differential
from scalargraph.errors import InputError

NEWTON_STEPS = 2
"""Newton steps back to the leaf after a displacement; the first one leaves an error of second order."""
READING_STEPS = 3
"""Gauss–Newton steps from an estimate to the measured coordinates; each of them squares the remaining error."""
STAGES = 32
"""Number of steps from the configuration `assembly` to the first measurement."""


class Normals(NamedTuple):
    """The normal vectors of a leaf at a configuration.

    Attributes:
        rows: Differentials A (m, n) of the constraint.
        raised: Their vectors g⁻¹Aᵀ, as rows (m, n).
        gram: `A g⁻¹Aᵀ` (m, m).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry._leaf import Normals
        >>> Normals(jnp.ones((1, 2)), jnp.ones((1, 2)), 2 * jnp.eye(1)).across(jnp.ones(1)).tolist()
        [0.5, 0.5]
    """

    rows: Float[Array, "m n"]
    raised: Float[Array, "m n"]
    gram: Float[Array, "m m"]

    def across(self, c: Float[Array, "m"]) -> Vector:
        """The vector `A⁺c` (n,), normal to the leaf, along which the constraint changes by c (m,)."""
        return solve(self.gram, c) @ self.raised

    def along(self, a: Vector) -> Vector:
        """The tangential part `P a` (n,) of a vector."""
        return a - self.across(self.rows @ a)


class Leaf(AbstractSpace):
    """The configurations of a space that satisfy a constraint, such as those of a machine with closed loops.

    Use it for linkages, parallel mechanisms and grippers: open the loops, describe the tree that remains, and give the
    constraint that closes them. Observers with constant gains and `IntrinsicKalman` run on it unchanged. Configurations
    and velocities are those of the tree, and every estimate stays on the leaf. A coordinate without an encoder is NaN
    in the measurements. The measured coordinates must determine the others; if they do not, only `IntrinsicKalman` can
    estimate the others, and it needs a complete first measurement.

    Attributes:
        space: The whole space, such as that of the tree.
        constraint: Function of a configuration whose value (m,) is zero on the leaf; its rows must be independent along
            every motion, see `Leaf.closing`.
        assembly: A configuration on the leaf. The same motor angles may allow several ways to assemble a linkage, so
            this one has to be given.
        held: Which rows of the constraint are active (m,); inactive ones must be zero everywhere, such as rows of feet
            in the air. None (default) means all.

    Example:
        A mass on a rod of 2 m, in the plane. It turns without force, and its acceleration is v²/r towards the centre:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry import Euclidean, Leaf
        >>> circle = Leaf(Euclidean(), lambda x: (x @ x - 4.0)[None] / 2, jnp.array([2.0, 0.0]))
        >>> v = jnp.array([0.0, 3.0])
        >>> circle.connection(circle.assembly, v, v).tolist()
        [4.5, 0.0]
        >>> circle.manifold.retract(circle.assembly, jnp.array([0.0, 0.1])).round(4).tolist()
        [1.9975, 0.0999]
    """

    space: AbstractSpace
    constraint: Callable[[Configuration], Float[Array, "m"]]
    assembly: Configuration
    held: Bool[Array, "m"] | None

    def __init__(
        self,
        space: AbstractSpace,
        constraint: Callable[[Configuration], Float[Array, "m"]],
        assembly: Configuration,
        held: Bool[Array, "m"] | None = None,
    ):
        self.space, self.constraint, self.assembly, self.held = space, constraint, assembly, held

    @classmethod
    def closing(
        cls, space: AbstractSpace, constraint: Callable[[Configuration], Float[Array, "m"]], near: Configuration
    ) -> "Leaf":
        """The leaf through the configuration closest to `near`, with the independent rows of the constraint.

        If two points of a planar linkage coincide in space, this gives three rows, one of which is zero everywhere.
        Rows that depend on others are detected at random configurations of the leaf, and left out.

        Args:
            space: The whole space.
            constraint: Function of a configuration with the value (m,) that is zero on the leaf.
            near: Configuration of the linkage as it is assembled, to a few digits.

        Returns:
            The leaf.

        Raises:
            ValueError: The loop does not close near this configuration; the number of independent rows changes along
                the motion, as at a change point; or the dependence of rows changes from place to place, as in an
                overconstrained linkage.

        Example:
            >>> import jax.numpy as jnp
            >>> from covariant.geometry import Euclidean, Leaf
            >>> def twice(x):
            ...     return jnp.stack([x @ x - 4.0, 3.0 * (x @ x - 4.0)])
            >>> Leaf.closing(Euclidean(), twice, jnp.array([1.9, 0.1])).constraint(jnp.array([2.0, 0.0])).shape
            (1,)
        """
        near = jnp.asarray(near, float)
        look = Look.of(space, constraint, near)
        start = closed(look, np.asarray(near))
        return cls(space, independent(look, constraint, start), jnp.asarray(start))

    @property
    def manifold(self) -> AbstractManifold:  # pyright: ignore[reportIncompatibleVariableOverride]
        return _LeafManifold(self)

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return self.space.lower(x, a)

    def __call__(self, x: Configuration) -> Matrix:
        return self.space(x)

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        normals, free = self._beside(x, mu)
        return normals.along(free)

    def connection(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        normals, free = self._beside(x, self.space.connection_force(x, a, b))
        return free - normals.across(self._left(normals, x, a, b, free))

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        return self.lower(x, self.connection(x, a, b))

    def acceleration(self, x: Configuration, v: Vector, force: Vector) -> Vector:
        normals, free = self._beside(x, force - self.space.connection_force(x, v, v))
        return free - normals.across(normals.rows @ free + self._change(x, v, v))

    def load(self, x: Configuration, v: Vector, force: Vector) -> Float[Array, "m"]:
        """Force in the joint that closes the loop: the Lagrange multipliers of the constraint.

        Args:
            x: Configuration.
            v: Velocity (n,).
            force: All other generalised forces (n,) on the system.

        Returns:
            Multipliers λ (m,), in force per unit of the constraint; `Aᵀλ` (n,) is the generalised force.
        """
        normals, free = self._beside(x, force - self.space.connection_force(x, v, v))
        return -solve(normals.gram, normals.rows @ free + self._change(x, v, v))

    def kinetic_force(self, x: Configuration, v: Vector, momentum: Vector | None = None) -> Vector:
        force = self.space.kinetic_force(x, v)
        if momentum is None:
            return force
        # Unlike v, a momentum has a part normal to the leaf; it acts when the rows turn.
        normals = self.normals(x)
        across = solve(normals.gram, normals.raised @ momentum)
        of_rows = differential(self.space.manifold, lambda y: across @ self._rate(y, v), x)
        return force + of_rows

    def curvature(self, x: Configuration, a: Vector, b: Vector, c: Vector) -> Vector:
        """Riemann curvature `R(a, b)c` for vectors along the leaf, by the equation of Gauss.

        With the second fundamental form II of the leaf in the whole space, it adds `<II(a, w), II(b, c)> − <II(b, w),
        II(a, c)>` to the curvature of the whole space. So no derivative of the projection is needed.
        """
        space, normals = self.space, self.normals(x)

        def left(w):
            """Normal parts of the covariant derivatives of w along a and b, in rows (2, m)."""

            # Computed from forces: A g⁻¹ of a force is a product with raised rows, and no linear system is transposed.
            def normal(along):
                return normals.raised @ space.connection_force(x, along, w) - self._change(x, along, w)

            return jax.vmap(normal)(jnp.stack([a, b]))

        of_a, of_b = jax.vmap(lambda rows: solve(normals.gram, rows))(left(c))

        def resisted(w):
            rows = left(w)
            return of_b @ rows[0] - of_a @ rows[1]

        # `resisted` is linear, so its derivative is the same at every w.
        bent = space.raise_(x, jax.grad(resisted)(jnp.zeros_like(a)))
        return normals.along(space.curvature(x, a, b, c) + bent)

    def transport_along(self, p: Configuration, velocity: Vector, w: Vectors, budget: Budget = Budget()) -> Transported:
        end = geodesics.transport_along(_EveryLeaf(self), p, velocity, w, budget)
        q = self.manifold.ambient.retract(end.q, self._back(end.q))
        normals = self.normals(q)
        along = jax.vmap(normals.along)
        return Transported(q, normals.along(end.velocity), along(end.w.reshape(-1, len(velocity))).reshape(end.w.shape))

    def shoot(self, p: Configuration, q: Configuration, guess: Vector | None = None, budget: Budget = Budget()) -> Shot:
        return geodesics.shoot(_EveryLeaf(self), p, q, guess, budget)

    def projected(self, x: Configuration, a: Vector) -> Vector:
        return self.normals(x).along(a)

    def between(self, x: Configuration, y: Configuration, matrix: Float[Array, "N N"]) -> Float[Array, "N N"]:
        n, size = self.manifold.zero(x).shape[0], len(matrix)
        axes = jnp.eye(size, dtype=matrix.dtype)

        def along(normals):
            block = jax.vmap(normals.along, in_axes=1, out_axes=1)(axes[:n, :n])
            return axes.at[:n, :n].set(block).at[n : 2 * n, n : 2 * n].set(block)

        before, after = jax.vmap(along)(jax.vmap(self.normals)(jnp.stack([x, y])))
        # On normal vectors the map is the identity: it stays invertible, and tangential vectors are not affected.
        return after @ matrix @ before + axes - before

    def restored(self, x: Configuration, v: Vector) -> tuple[Configuration, Vector]:
        q = self.manifold.ambient.retract(x, self._back(x))
        return q, self.projected(q, v)

    def restored_momentum(self, x: Configuration, momentum: Vector) -> tuple[Configuration, Vector]:
        q, v = self.restored(x, self.raise_(x, momentum))
        return q, self.lower(q, v)

    def normals(self, x: Configuration) -> Normals:
        """The normal vectors of the leaf at a configuration.

        Args:
            x: Configuration.

        Returns:
            The rows A (m, n), their vectors, and `A g⁻¹Aᵀ`.
        """
        return self._beside(x, self.manifold.zero(x))[0]

    def second_form(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        """Second fundamental form `II(a, b)`: how a geodesic of the leaf bends in the whole space.

        It is the normal part of the connection of the whole space. In a parallel frame the velocity error of an
        observer changes by `II(ξ, v)` when a foot lifts off. In an `impact` it changes by S ξ, with
        `<S ξ, a> = <II(ξ, a), n>` for the normal velocity n that is lost.

        Args:
            x: Configuration.
            a: Vector (n,) along the leaf.
            b: Vector (n,) along the leaf.

        Returns:
            The vector (n,), normal to the leaf.
        """
        normals, free = self._beside(x, self.space.connection_force(x, a, b))
        return normals.across(self._left(normals, x, a, b, free))

    def impact(self, x: Configuration, v: Vector) -> tuple[Configuration, Vector]:
        """Plastic impact: the normal part of the velocity is lost at once, as when a foot lands.

        A configuration that is not on the leaf, such as an estimate, is projected to it first, and the velocity is
        transported in parallel.

        Args:
            x: Configuration close to the leaf.
            v: Velocity (n,) before.

        Returns:
            The configuration on the leaf, and the velocity (n,) after.
        """
        q = self.manifold.retract(x, jnp.zeros_like(v))
        s = self.space.manifold.local(x, q)
        return q, self.projected(q, v - self.space.connection(x, s, v))

    def _beside(self, x: Configuration, force: Vector) -> tuple[Normals, Vector]:
        """The normal vectors, and the vector of a covector (n,): all are raised together, in one pass."""
        rows = rows_of(self.space, self.constraint, x)
        vectors = jax.vmap(lambda row: self.space.raise_(x, row))(jnp.concatenate([rows, force[None]]))
        return Normals(rows, vectors[:-1], _gram(rows, vectors[:-1], self.held)), vectors[-1]

    def regular(self, x: Configuration) -> Flag:
        """Whether the rows are independent at x. At a change point they are not, and the leaf branches."""
        return _is_regular(self.normals(x).gram)

    def _rate(self, x: Configuration, b: Vector) -> Float[Array, "m"]:
        return derivative(self.space.manifold, self.constraint, x, b)

    def _change(self, x: Configuration, a: Vector, b: Vector) -> Float[Array, "m"]:
        """Change `(∂_a A) b` (m,) of the rows along a, applied to constant components b."""
        return derivative(self.space.manifold, lambda y: self._rate(y, b), x, a)

    def _left(self, normals: Normals, x: Configuration, a: Vector, b: Vector, free: Vector) -> Float[Array, "m"]:
        """Normal part, in rows (m,), by which the connection `free` of the whole space leaves the leaf."""
        return normals.rows @ free - self._change(x, a, b)

    def _back(self, x: Configuration) -> Vector:
        """Displacement of a Newton step to the leaf."""
        return -self.normals(x).across(self.constraint(x))


class _EveryLeaf(AbstractSpace):
    """The whole space with the connection in which every leaf is totally geodesic; geodesics are integrated in it."""

    leaf: Leaf

    def __init__(self, leaf: Leaf):
        self.leaf = leaf

    @property
    def manifold(self) -> AbstractManifold:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.leaf.space.manifold

    def lower(self, x: Configuration, a: Vector) -> Vector:
        return self.leaf.space.lower(x, a)

    def raise_(self, x: Configuration, mu: Vector) -> Vector:
        return self.leaf.space.raise_(x, mu)

    def __call__(self, x: Configuration) -> Matrix:
        return self.leaf.space(x)

    def connection(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        return self.leaf.connection(x, a, b)

    def connection_force(self, x: Configuration, a: Vector, b: Vector) -> Vector:
        return self.leaf.connection_force(x, a, b)


def _of_ambient(name: str) -> Any:
    """A method that calls the manifold of the whole space."""

    def method(self, *arguments):
        return getattr(self.ambient, name)(*arguments)

    return method


class _LeafManifold(AbstractManifold):
    """The manifold of a leaf: configurations and frame of the whole space, with a retraction that stays on the leaf."""

    leaf: Leaf

    @property
    def ambient(self) -> AbstractManifold:
        return self.leaf.space.manifold

    redundant = True

    @property
    def commuting(self) -> bool:
        return self.ambient.commuting

    @property
    def shape(self) -> tuple[int | None, ...]:
        return np.shape(self.leaf.assembly)

    @property
    def rotations(self) -> tuple[tuple[int, ...], ...] | None:
        return self.ambient.rotations

    @property
    def circles(self) -> tuple[int, ...]:
        return self.ambient.circles

    zero = _of_ambient("zero")
    tangent = _of_ambient("tangent")
    components = _of_ambient("components")
    bracket = _of_ambient("bracket")
    frame_velocity = _of_ambient("frame_velocity")
    local_rate = _of_ambient("local_rate")
    carried_momentum = _of_ambient("carried_momentum")
    missing = _of_ambient("missing")
    measured_together = _of_ambient("measured_together")
    admitted = _of_ambient("admitted")

    def origin(self, dtype: jax.typing.DTypeLike = float) -> Configuration:
        return jnp.asarray(self.leaf.assembly, dtype)

    def retract(self, x: Configuration, s: Vector) -> Configuration:
        y = self.ambient.retract(x, s)
        return jax.lax.fori_loop(0, NEWTON_STEPS, lambda _, y: self.ambient.retract(y, self.leaf._back(y)), y)

    def local(self, x: Configuration, y: Configuration) -> Vector:
        return self.leaf.projected(x, self.ambient.local(x, y))

    def retraction_acceleration(self, x: Configuration, a: Vector) -> Vector:
        normals, free = self.leaf.normals(x), self.ambient.retraction_acceleration(x, a)
        return normals.along(free) - normals.across(self.leaf._change(x, a, a))

    def towards(self, x: Configuration, y: Configuration) -> Vector:
        return self.local(x, self.measured(x, y))

    def measured(self, x: Configuration, y: Configuration) -> Configuration:
        """The configuration on the leaf whose measured entries are closest to those of y, by Gauss–Newton steps."""
        return jax.lax.fori_loop(0, READING_STEPS, lambda _, q: self._closer(q, y), x)

    def shown(self, x: Configuration, present: Bool[Array, "n"], e: Vector) -> Vector:
        rows = self.leaf.normals(x).rows
        return _Fit.of(rows, present, self.leaf.held).step(rows, e, jnp.zeros_like(rows[:, 0]))

    def told(self, x: Configuration, present: Bool[Array, "n"]) -> Bool[Array, "n"]:
        return present | _is_regular(_Fit.of(self.leaf.normals(x).rows, present, self.leaf.held, damped=False).matrix)

    def seen(self, x: Configuration, y: Configuration) -> Configuration:
        return jnp.where(jnp.isnan(y) & ~jnp.all(self.missing(y)) & ~self._free, 0.0, y)

    def dead_centre(self, x: Configuration, y: Configuration) -> Flag:
        return ~self._complete(x, y) & ~jnp.all(self.missing(y)) & ~self._free

    @property
    def _free(self) -> Flag:
        """Whether no row is active, as with all feet in the air."""
        return jnp.zeros((), bool) if self.leaf.held is None else ~jnp.any(self.leaf.held)

    def _complete(self, x: Configuration, y: Configuration) -> Flag:
        return jnp.all(self.told(x, ~self.missing(y)))

    def unique(self, x: Configuration, y: Configuration) -> Flag:
        return self.ambient.unique(x, y) & self.leaf.regular(x)

    def checked(self, y: Configuration) -> Configuration:
        """The configuration on the leaf that fits the first measurement y, reached step by step from the assembly."""
        y = self.ambient.checked(y)
        complete = ~jnp.any(self.missing(y))
        # A complete configuration shows by itself how the loop is assembled.
        begin = jnp.where(complete, jnp.nan_to_num(y), self.origin(y.dtype))
        way = self.ambient.towards(begin, y)

        def follow(k, q):
            part = jnp.minimum((k + 1) / STAGES, 1.0).astype(way.dtype)
            waypoint = self.ambient.retract(begin, part * way)
            return self._closer(q, jnp.where(jnp.isnan(y), y, waypoint))

        q = jax.lax.fori_loop(0, STAGES + 4, follow, begin)
        if not isinstance(q, Tracer):
            self._refuse_undetermined(q, y)
        return q

    def _closer(self, q: Configuration, y: Configuration) -> Configuration:
        rows = self.leaf.normals(q).rows
        fit = _Fit.of(rows, ~self.missing(y), self.leaf.held)
        return self.ambient.retract(q, fit.step(rows, self.ambient.towards(q, y), self.leaf.constraint(q)))

    def _refuse_undetermined(self, q: Configuration, y: Configuration) -> None:
        if not bool(jnp.max(jnp.abs(self.leaf.constraint(q))) < CLOSED):
            raise InputError(
                "the first measurement cannot be reached from the way in which the loop is assembled: give another "
                f"assembly, or a complete first configuration; got {np.asarray(y).round(6).tolist()}"
            )
        if not bool(self._complete(q, y)):
            raise InputError(
                "the measured coordinates do not determine the others at the first measurement, as at a dead centre: "
                "begin elsewhere, measure another coordinate, or give a complete first configuration"
            )


class _Fit(NamedTuple):
    """Least squares over displacements along a leaf: its matrix (n, n), and the mask of the measured entries."""

    matrix: Matrix
    present: Bool[Array, "n"]
    held: Bool[Array, "m"] | None

    @classmethod
    def of(cls, rows: Float[Array, "m n"], present: Bool[Array, "n"], held: Any, damped: bool = True) -> "_Fit":
        # Adding the normal directions makes the matrix regular and does not change the solution.
        across = rows.T @ solve(_gram(rows, rows, held), rows)
        # A small weight on the last iterate determines only the components that no measurement determines.
        weights = present.astype(rows.dtype) + damped * float(jnp.finfo(rows.dtype).eps) ** 0.5
        return cls(across + jnp.diag(weights), present, held)

    def step(self, rows: Float[Array, "m n"], e: Vector, c: Float[Array, "m"]) -> Vector:
        """The displacement closest to e in its measured entries that reduces the constraint by c."""
        free = solve(self.matrix, jnp.where(self.present, e, 0.0))
        across = solve(self.matrix, rows.T)
        return free - across @ solve(_gram(rows, across.T, self.held), rows @ free + c)


def _gram(rows: Float[Array, "m n"], raised: Float[Array, "m n"], held: Bool[Array, "m"] | None) -> Float[Array, "m m"]:
    """`rows raisedᵀ`, with 1 on the diagonal for inactive rows, which are zero."""
    gram = rows @ raised.T
    return gram if held is None else gram + jnp.diag((~held).astype(rows.dtype))


def _is_regular(matrix: Matrix) -> Flag:
    scale = jnp.sqrt(jnp.diag(matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    scaled = matrix / scale[:, None] / scale[None, :]
    return jnp.all(pivots(scaled) > SINGULAR)
