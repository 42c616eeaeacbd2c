"""Builds the inequalities of a proof: symmetric matrices that must be positive definite on a region."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import Finite, check_numbers
from covariant._linalg import solve
from covariant._typing import Vector
from covariant.certificates.base._claims import reach_squares
from covariant.certificates.base._contraction import lengths
from covariant.certificates.base._document import Resolved
from covariant.certificates.base._error_system import ErrorSystem, corrections, values
from covariant.geometry import AbstractSpace
from scalargraph.proofs import Form, as_form, derivative_form


@check_numbers
def contraction(error_system: ErrorSystem, rate: Finite) -> Form:
    """Build the matrix `−(F_ΘᵀN + Ṅ + N F_Θ) − rate N`; the system contracts if it is positive definite.

    Use it with `proofs.prove` for a proof by hand if neither `certify` nor `cascade` fits. At all points where the
    matrix is positive definite, squared lengths of small errors in the metric N decrease at least at `rate`, and
    lengths at half of it. So does the distance of any two solutions if the region is convex in this metric.

    Args:
        error_system: the system, as from `error_system` or `virtual`.
        rate: rate [1/s] at which squared lengths have to decrease.

    Returns:
        The matrix as a function of the variables z of the region, for `proofs.prove`.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import contraction, virtual
        >>> from covariant.models import StateSpace
        >>> from covariant.observers import Contracting
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x, coordinates=("x",))
        >>> system = virtual(Contracting(model, jnp.eye(1), jnp.zeros(1)), np.eye(1))  # x' = −x + (z − x)
        >>> contraction(system, rate=3.0)(jnp.zeros(3)).tolist()
        [[1.0]]
    """
    return length_change(error_system, lambda coframe, gram, change: -change - rate * gram)


def length_change(error_system: ErrorSystem, formula: Callable[[Array, Array, Array], Array]) -> Form:
    """Build the form of an expression in Θ, N and `F_ΘᵀN + Ṅ + N F_Θ`, the rate of change of squared lengths."""

    def whole(coframe, gram, change, jacobian):
        return formula(coframe, gram, lengths(gram, change, jacobian))

    return in_frame_along(error_system, whole)


def in_frame_along(error_system: ErrorSystem, formula: Callable[[Array, Array, Array, Array], Array]) -> Form:
    """Build the form of an expression in Θ, N, Ṅ and `F_Θ = (Θ̇ + Θ ∂f/∂x)Θ⁻¹`, with rates of change along the flow."""

    def parts(derivatives, nodes, count):
        flow, coframe, frame, gram, *_ = nodes
        state = range(1, count + 1)
        # The derivative along the flow: time has the rate 1, the state has x', and z is constant.
        along = {0: derivatives.graph.constant(1.0), **dict(zip(state, flow.tolist(), strict=True))}
        changes = (derivatives.along(each, along) for each in (coframe, gram))
        return coframe, frame, gram, derivatives.each(flow, state, frame), *changes

    def whole(coframe, frame, gram, image, turn, change):
        return formula(coframe, gram, change, turn @ frame + coframe @ image)

    return derivative_form(values(error_system), lambda z: error_system.at(z).x, parts, whole)


def width_bound(error_system: ErrorSystem, row: int, square: float) -> Form:
    """Build the matrix `square N − r rᵀ`, where r is one row of the Jacobian of (error, velocity).

    If it is positive definite, a curve of length ℓ changes this entry of (error, velocity) by less than `ℓ √square`.
    """

    def matrix(z):
        point, t = error_system.at(z), jnp.zeros((), z.dtype)
        r = point.error_jacobian()[row]
        # r rᵀ ≤ square N means |r·δ| ≤ √square |δ| for all δ, by Cauchy and Schwarz.
        return square * point.metric.gram(t, point.x) - jnp.outer(r, r)

    return as_form(matrix)


def remainder_bound(error_system: ErrorSystem, row: int, square: float, curvature: bool = True) -> Form:
    """Build the matrix `square g⊗…⊗g − TᵀgT` of a tensor T of `RemainderClaim`, with a column for all its vectors.

    It is positive definite where |T(u, …)| < √square for all unit vectors. R is zero on a line, and counts as zero
    where the observer has no curvature term.
    """

    def tensors(t, x, z):
        space = error_system.at(z).metric.lift
        place, v = jnp.split(x, 2)
        n = len(place)
        each = jnp.eye(n, dtype=x.dtype)

        def connection(a):
            return jax.vmap(lambda b: space.connection(place, a, b), out_axes=1)(each)

        def curved(a):
            return space.curvature(place, a, v, v) if curvature and n > 1 else jnp.zeros_like(v)

        if row < 2:
            tensor = jax.vmap(connection, out_axes=1)(each)
        else:
            tensor = space.raise_(place, z[3 * n : 4 * n]) if row == 2 else jax.vmap(curved, out_axes=1)(each)
        return space(place), tensor

    def parts(derivatives, nodes, count):
        g, tensor = nodes
        return g, derivatives.each(tensor, range(1, 1 + count // 2)) if row in (1, 4) else tensor

    def formula(g, tensor):
        columns = tensor.reshape(len(g), -1)
        grams = functools.reduce(jnp.kron, [g] * (tensor.ndim - 1), jnp.ones((1, 1)))
        return square * grams - columns.T @ g @ columns

    return derivative_form(tensors, lambda z: error_system.at(z).x, parts, formula)


def squared_widths(error_system: ErrorSystem, z: Vector) -> Float[Array, "two_n"]:
    """Compute for each row the least `square` for which `width_bound` is positive semidefinite at z."""
    point = error_system.at(z)
    gram, rows = point.metric.gram(jnp.zeros((), z.dtype), point.x), point.error_jacobian()
    return jnp.sum(rows * solve(gram, rows.T).T, axis=1)


def disturbance_bound(error_system: ErrorSystem, sizes: Float[np.ndarray, "two_n"], square: float) -> Form:
    """Build the matrix `square I − BᵀMB`, with B the Jacobian of the flow in errors of measurement and force.

    If it is positive definite, errors `δ = sizes w` with |w| ≤ 1 (in the Euclidean norm) change the flow by a vector
    that is shorter than `√square`.
    """
    n = len(sizes) // 2

    def parts(derivatives, nodes, count):
        # The inputs of the graph are time, state and z, in which error and force follow the velocities.
        start = 1 + count + error_system.first_velocity(n) + n
        flow, coframe, _, gram, _, noise = nodes
        return coframe, gram, noise, derivatives.each(flow, range(start, start + 2 * n))

    def formula(coframe, gram, noise, change):
        # The metric is M = ΘᵀNΘ, so the coframe Θ multiplies the columns of B.
        b = jnp.concatenate([change[:, :n] @ noise, change[:, n:]], axis=1) * jnp.asarray(sizes)[None]
        return square * jnp.eye(2 * n) - (coframe @ b).T @ gram @ (coframe @ b)

    return derivative_form(values(error_system), lambda z: error_system.at(z).x, parts, formula)


def correction(
    error_system: ErrorSystem, noise: Float[np.ndarray, "n"] | None = None, squares: Sequence[float] = ()
) -> Form:
    """Build the matrix `N_h − JᵀN_0J`, with J the Jacobian of the correction by a measurement of age h in the frames.

    If it is positive definite, the correction shortens all curves, from the metric M_h before it to M_0 after it.
    With measurement errors it is `diag(N_h, Γ) − [J B]ᵀN_0[J B]`: if this is positive definite, a curve of length ℓ
    between the truth and an estimate has at most the length `√(ℓ² + ΣΓ)` after a correction by an erroneous
    measurement.

    The inequality also covers Lipschitz corrections: −JᵀN_0J is concave in J, so it holds for the mean Jacobians that
    give the change of chords, as in `derivative_form`.

    Args:
        error_system: the system, as from `sampled_system`.
        noise: bounds (n,) of the errors of the measured positions, which scale the columns of B; None without errors.
        squares: diagonal of Γ, one for each bound that is not zero.

    Returns:
        The matrix (2n + len(squares), the same) as a function of z.
    """
    if noise is None:
        return at_correction(error_system, lambda before, after, jacobian: before - jacobian.T @ after @ jacobian)
    columns, scale = np.flatnonzero(noise), jnp.asarray(noise[noise != 0])

    def formula(before, after, jacobian, errors):
        both = jnp.concatenate([jacobian, errors[:, columns] * scale[None]], axis=1)
        return jax.scipy.linalg.block_diag(before, jnp.diag(jnp.asarray(squares))) - both.T @ after @ both

    return at_noisy_correction(error_system, formula)


def at_correction(error_system: ErrorSystem, formula: Callable[[Array, Array, Array], Array]) -> Form:
    """Build the form of an expression in N_h before a correction C, N_0 after it, and J.

    In the frames J = Θ_0(C x) (∂C/∂x) Θ_h(x)⁻¹, with the measurement held constant.
    """

    def parts(derivatives, nodes, count):
        new, coframe, after, frame, before, *_ = nodes
        return coframe, after, derivatives.each(new, range(1, 1 + count)), frame, before

    def whole(coframe, after, slope, frame, before):
        return formula(before, after, coframe @ slope @ frame)

    return derivative_form(corrections(error_system), lambda z: error_system.at(z).x, parts, whole)


def at_noisy_correction(error_system: ErrorSystem, formula: Callable[[Array, Array, Array, Array], Array]) -> Form:
    """Build the form of an expression in N_h, N_0, J, as in `at_correction`, and `B = Θ_0(C x) ∂C/∂y`."""

    def parts(derivatives, nodes, count):
        new, coframe, after, frame, before, *_ = nodes
        n = count // 2
        # The measurement is the estimated position minus its error, and both are variables in z.
        errors = derivatives.each(new, range(1 + count + 2 * n, 1 + count + 3 * n))
        return coframe, after, derivatives.each(new, range(1, 1 + count)), errors, frame, before

    def whole(coframe, after, slope, errors, frame, before):
        return formula(before, after, coframe @ slope @ frame, -coframe @ errors)

    return derivative_form(corrections(error_system), lambda z: error_system.at(z).x, parts, whole)


def joint_force_bound(error_system: ErrorSystem, sizes: Float[np.ndarray, "n"], square: float) -> Form:
    """Build the matrix `square I − BᵀMB`, with B the Jacobian of the flow between samples in the joint force."""
    n = len(sizes)

    def parts(derivatives, nodes, count):
        flow, coframe, _, gram, *_ = nodes
        # In z the joint force comes after estimate, velocity, position error and input force.
        return coframe, gram, derivatives.each(flow, range(1 + count + 4 * n, 1 + count + 5 * n))

    def formula(coframe, gram, change):
        b = coframe @ (change * jnp.asarray(sizes)[None])
        return square * jnp.eye(n) - b.T @ gram @ b

    return derivative_form(values(error_system), lambda z: error_system.at(z).x, parts, formula)


def start_bound(error_system: ErrorSystem, squares: Float[np.ndarray, "two_n"], square: float) -> Form:
    """Build the matrix `square diag(1/squares) − M`, with M the metric in coordinates, right after a measurement.

    If it is positive definite everywhere, an error with the components δ_i has at most the length
    `√(square Σ δ_i²/squares_i)`.
    """

    def matrix(z):
        point, t = error_system.at(z), jnp.zeros((), z.dtype)
        metric = point.metric if point.after is None else point.after
        return square * jnp.diag(1 / jnp.asarray(squares)) - metric(t, point.x)

    return as_form(matrix)


def missing_bound(error_system: ErrorSystem, square: float, limit: float, reach: Float[np.ndarray, "n"]) -> Form:
    """Build a matrix of three blocks (n, n) that bounds the acceleration omitted by a prediction.

    With D the derivative of the omitted acceleration by the position error e, at a constant estimate, the blocks are
    `square g(q) − Dᵀg(q)D`, `4 g(q) − g(q − e)` and `limit²/n I − W g(q) W`, W = diag(reach). Where they are positive
    definite, the omitted acceleration is shorter than `√square |e|`, lengths of vectors at most double over an error,
    and a curve of length ℓ, which changes e by at most `ℓ reach`, makes |e| at most `ℓ limit`.
    """
    n = len(reach)

    def parts(derivatives, nodes, count):
        *_, missing, here, there = nodes
        return derivatives.each(missing, [1 + count + k for k in error_system.errors(n)]), here, there

    def whole(slope, here, there):
        weighted = here * jnp.asarray(np.outer(reach, reach))
        blocks = square * here - slope.T @ here @ slope, 4 * here - there, limit**2 / n * jnp.eye(n) - weighted
        return jax.scipy.linalg.block_diag(*blocks)

    return derivative_form(corrections(error_system), lambda z: error_system.at(z).x, parts, whole)


FORMS: dict[str, Callable[[Resolved, Any], Form]] = {
    "contraction": lambda of, claim: contraction(of.about, of.document.rate),
    "reach": lambda of, claim: width_bound(of.about, claim.row, claim.square),
    "remainder": lambda of, claim: remainder_bound(of.about, claim.row, claim.square, of.observer.curvature),
    "correction": lambda of, claim: correction(
        of.about, of.document.given.noise if claim.squares else None, claim.squares
    ),
    "missing": lambda of, claim: missing_bound(of.about, claim.square, claim.limit, of.document.unit_reach),
    "start": lambda of, claim: start_bound(of.about, reach_squares(of.document.claims), claim.square),
}
"""The matrix to be proved positive definite, for each kind of claim of a document."""


def metric_form(space: AbstractSpace, formula: Callable[[Array, Array], Array]) -> Form:
    """The form of an expression in the metric g (n, n) and its derivatives ∂_k g_ij (n, n, n), from the graph of g."""

    def parts(derivatives, nodes, n):
        return nodes[0], derivatives.each(nodes[0], range(1, 1 + n))

    return derivative_form(lambda t, q, z: (space(q),), lambda z: z, parts, formula)
