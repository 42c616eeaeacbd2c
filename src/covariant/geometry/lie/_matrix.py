"""General matrix groups: SU(n), and groups that a user defines by a basis of their algebra.

Source: Higham 2008, Functions of Matrices, chapters 6 (square roots), 10 (exponential) and 11 (logarithm).
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact

from covariant._linalg import at_places
from covariant._typing import Element, Flag, Vector
from covariant.geometry.lie._group import AbstractGroup
from scalargraph.errors import InputError

# Six halvings reduce a turn by π to π/64; the series of 8 terms then errs by less than tan(π/128)¹⁶/17 < 1e-26 of it.
HALVINGS = 6
"""Number of square roots that are taken before the series of the logarithm is used."""
ROOT_LIMIT = 80
"""Number of Newton iterations after which a square root stops; the matrix is then on the cut locus, to rounding."""
# The first omitted term is 1/19! = 8e-18.
TAYLOR = 18
"""Degree of the series of the exponential, exact to rounding for norms up to 1."""
DOUBLINGS = 10
"""Squarings after the series of the exponential; they suffice for norms up to 1024, beyond which float64 overflows."""


class SU(AbstractGroup):
    """Unitary matrices of determinant 1, SU(n); x holds the n² − 1 real coordinates of su(n).

    The basis is −i/2 times the generalised Gell-Mann matrices: first the symmetric ones of all pairs j < k, then the
    antisymmetric ones, then the diagonal ones. With this basis the bracket of su(2) is the cross product, as in SO(3).
    The logarithm needs the Schur form, which JAX offers on CPUs only.

    Attributes:
        n: number of rows, 2 or more.

    Raises:
        ValueError: for any other n.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import SU
        >>> e1, e2, e3 = jnp.eye(3)
        >>> bool(jnp.allclose(SU(2).lie_bracket(e1, e2), e3))
        True
    """

    n: int = eqx.field(static=True)

    def __check_init__(self):
        if not isinstance(self.n, int) or self.n < 2:
            raise InputError(f"SU(n) needs an integer n of 2 or more; got {self.n!r}")

    @property
    def dimension(self) -> int:
        return self.n**2 - 1

    @property
    def order(self) -> int:
        return self.n

    def hat(self, x: Vector) -> Element:
        above, below, diagonal = _su_layout(self.n)
        pairs = len(above)
        # Above the diagonal, −(i/2)λ x is −ix/2 for a symmetric λ (entry 1), and −x/2 for an antisymmetric (entry −i).
        upper = jax.lax.complex(-x[pairs : 2 * pairs], -x[:pairs]) / 2
        middle = -0.5 * (jnp.asarray(diagonal, x.dtype) @ x[2 * pairs :])
        entries = jnp.concatenate([upper, -upper.conj(), jax.lax.complex(jnp.zeros_like(middle), middle)])
        places = np.argsort(np.concatenate([above, below, np.arange(self.n) * (self.n + 1)]))
        return at_places(entries, places).reshape(self.n, self.n)

    def vee(self, matrix: Element) -> Vector:
        above, below, diagonal = _su_layout(self.n)
        upper = at_places(matrix, above) - at_places(matrix, below).conj()
        middle = -matrix.reshape(-1)[:: self.n + 1].imag @ jnp.asarray(diagonal, matrix.real.dtype)
        return jnp.concatenate([-upper.imag, -upper.real, middle])

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        return matrix_bracket(self, x, y)

    def exp(self, x: Vector) -> Element:
        return matrix_exp(self.hat(x))

    def log(self, g: Element) -> Vector:
        return differentiable_log(self, unitary_log, g)

    def inverse(self, g: Element) -> Element:
        return g.conj().T

    def defect(self, g: Element) -> Array:
        unitary = jnp.max(jnp.abs(g.conj().T @ g - jnp.eye(self.n, dtype=g.dtype)))
        return jnp.maximum(unitary, jnp.abs(jnp.linalg.det(g) - 1))

    def unique_log(self, g: Element) -> Flag:
        angles = jnp.linalg.eigvalsh(1j * self.hat(self.log(g)))
        # Moving 2π from the largest to the smallest angle gives another logarithm, equally long if they differ by 2π.
        return 2 * np.pi - (angles[-1] - angles[0]) > 4 * jnp.finfo(angles.dtype).eps ** 0.5


class MatrixGroup(AbstractGroup):
    """A group of invertible matrices defined by a basis of its algebra, real or complex.

    Args:
        basis: matrices (n, N, N), linearly independent and closed under the bracket.
        structure: structure constants C (n, n, n), with `[e_i, e_j] = C[i, j, k] e_k`. Optional: they save work if many
            of them are zero, and they are exact; they must agree with the basis.

    Attributes:
        basis: the basis.
        dual: dual basis (n, N, N), by which `vee` projects.
        structure: the structure constants, or None.

    Raises:
        ValueError: the basis is linearly dependent or not closed under the bracket, or the structure constants do not
            match it.

    Example:
        Translations of the line, as matrices [[1, x], [0, 1]]:

        >>> import jax.numpy as jnp
        >>> from covariant.geometry.lie import MatrixGroup
        >>> line = MatrixGroup([[[0.0, 1.0], [0.0, 0.0]]])
        >>> line.exp(jnp.array([2.0])).tolist()
        [[1.0, 2.0], [0.0, 1.0]]
    """

    basis: Inexact[Array, "n N N"]
    dual: Inexact[Array, "n N N"]
    structure: Float[Array, "n n n"] | None

    def __init__(self, basis, structure=None):
        array = np.asarray(basis)
        basis = array.astype(complex if np.iscomplexobj(array) else float)
        if basis.ndim != 3 or basis.shape[1] != basis.shape[2] or not len(basis):
            raise InputError(f"MatrixGroup: the basis must have shape (n, N, N); got {basis.shape}")
        # Real and imaginary parts side by side: the algebra is a real vector space, even if matrices are complex.
        flat = np.concatenate([part.reshape(len(basis), -1) for part in (np.real(basis), np.imag(basis))], axis=1)
        if np.linalg.matrix_rank(flat) < len(basis):
            raise InputError(f"MatrixGroup: the {len(basis)} matrices of the basis are linearly dependent")
        dual = np.linalg.pinv(flat).T
        real, imaginary = np.split(dual, 2, axis=1)
        products = np.einsum("iab,jbc->ijac", basis, basis)
        brackets = products - products.swapaxes(0, 1)
        pairs = (len(basis), len(basis), -1)
        flat_brackets = np.concatenate([np.real(brackets).reshape(pairs), np.imag(brackets).reshape(pairs)], axis=2)
        constants = flat_brackets @ dual.T
        # The tolerance follows the precision in which the caller wrote the basis, before conversion to double.
        accuracy = np.finfo(array.dtype if np.issubdtype(array.dtype, np.inexact) else float).eps ** 0.5
        scale = accuracy * max(1.0, float(np.abs(brackets).max()))
        if np.abs(constants @ flat - flat_brackets).max() > scale:
            raise InputError("MatrixGroup: the basis is not closed under the commutator, so it spans no algebra")
        given = constants if structure is None else structure
        if np.shape(given) != constants.shape or np.abs(given - constants).max() > scale:
            raise InputError("MatrixGroup: the structure constants C[i, j, k] are not those of the basis")
        self.basis = jnp.asarray(basis)
        self.dual = jnp.asarray((real + 1j * imaginary if np.iscomplexobj(basis) else real).reshape(basis.shape))
        self.structure = None if structure is None else jnp.asarray(structure, float)

    @property
    def dimension(self) -> int:
        return self.basis.shape[0]

    @property
    def order(self) -> int:
        return self.basis.shape[1]

    def hat(self, x: Vector) -> Element:
        basis = _in_precision(self.basis, x.dtype)
        return jnp.tensordot(x.astype(basis.dtype), basis, 1)

    def vee(self, matrix: Element) -> Vector:
        # Re Σ d̄m = Re d · Re m + Im d · Im m: the inner product of the real vector space.
        return jnp.tensordot(_in_precision(self.dual, matrix.dtype).conj(), matrix, 2).real

    def lie_bracket(self, x: Vector, y: Vector) -> Vector:
        if self.structure is None:
            return matrix_bracket(self, x, y)
        return jnp.einsum("i,j,ijk->k", x, y, self.structure.astype(x.dtype))

    def exp(self, x: Vector) -> Element:
        return matrix_exp(self.hat(x))

    def log(self, g: Element) -> Vector:
        """Principal logarithm if it lies in the algebra; otherwise there is none, and `contains` is False.

        Args:
            g: element (N, N).

        Returns:
            Coordinates (n,) in the algebra.
        """
        return differentiable_log(self, partial(principal_log, self), g)

    def inverse(self, g: Element) -> Element:
        return jnp.linalg.inv(g)

    def defect(self, g: Element) -> Array:
        """Distance of `exp(log g)` from g.

        A group given by a basis has no known equations, so this is the only test. It rejects elements without a
        principal logarithm in the algebra.

        Args:
            g: matrix (N, N).

        Returns:
            Largest entry of the difference, a scalar.
        """
        return jnp.max(jnp.abs(self.exp(self.log(g)) - g))

    def unique_log(self, g: Element) -> Flag:
        return matrix_unique_log(g)


def _in_precision(constants: Array, dtype) -> Array:
    """Constants, real or complex, in the precision of `dtype`."""
    real = np.finfo(dtype).dtype
    return constants.astype(np.result_type(real, np.complex64) if jnp.iscomplexobj(constants) else real)


def _su_layout(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places of the pairs j < k in the flattened matrix, places with k > j, and the basis of the diagonal matrices."""
    rows, columns = np.triu_indices(n, 1)
    diagonal = np.zeros((n, n - 1))
    for k in range(1, n):
        diagonal[:k, k - 1] = np.sqrt(2 / (k * (k + 1)))
        diagonal[k, k - 1] = -k * np.sqrt(2 / (k * (k + 1)))
    return rows * n + columns, columns * n + rows, diagonal


def matrix_bracket(group: AbstractGroup, x: Vector, y: Vector) -> Vector:
    """Lie bracket `[x, y]` by one commutator of matrices, for a group of any dimension."""
    a, b = group.hat(x), group.hat(y)
    return group.vee(a @ b - b @ a)


def matrix_exp(a: Element) -> Element:
    """Matrix exponential by scaling and squaring of exp − 1, so that small steps from the identity lose no digits."""
    # The number of halvings is not smooth, but the result does not depend on it, so its gradient is stopped.
    norm = jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(a), axis=0)))
    # The matrix is scaled to norm ≤ 1, where the series is exact to rounding.
    # A norm of zero has the logarithm −∞, which is clipped to 0.
    doublings = jnp.clip(jnp.ceil(jnp.log2(norm)), 0, DOUBLINGS)
    a = a * 0.5 ** doublings.astype(a.dtype)
    # Horner's rule for exp − 1 = a(1 + a/2 (1 + a/3 (…))); adding 1 would absorb small digits.
    order = jnp.arange(TAYLOR - 1, 0, -1).astype(a.dtype)
    total = jax.lax.fori_loop(0, TAYLOR - 1, lambda i, f: (a + a @ f) / order[i], a / TAYLOR)
    # f = exp(a) − 1 squared: (1 + f)² − 1 = f² + 2f.
    total = jax.lax.fori_loop(0, DOUBLINGS, lambda i, f: jnp.where(i < doublings, f @ f + 2 * f, f), total)
    return total + jnp.eye(a.shape[0], dtype=a.dtype)


@eqx.filter_custom_jvp
def differentiable_log(group: AbstractGroup, algorithm: Callable[[Element], Element], g: Element) -> Vector:
    """Logarithm by any algorithm, with a derivative that does not differentiate the algorithm."""
    return group.vee(algorithm(g))


@differentiable_log.def_jvp
def _(primals, tangents):
    group, algorithm, g = primals
    x = differentiable_log(group, algorithm, g)
    return x, group.right_jacobian_inverse(x, group.vee(group.inverse(g) @ tangents[2]))


def unitary_log(g: Element) -> Element:
    """Logarithm of a unitary matrix of determinant 1, with the smallest angles whose sum is zero.

    It comes from the Schur form, which is diagonal for a unitary matrix.
    """
    # A normal matrix has a diagonal Schur form, with orthonormal vectors even if eigenvalues are equal.
    form, vectors = jax.scipy.linalg.schur(g, output="complex")
    angles = jnp.angle(jnp.diagonal(form))
    turns = jnp.round(jnp.sum(angles) / (2 * np.pi)).astype(int)
    rank = jnp.argsort(jnp.argsort(angles))
    excess = jnp.where(rank >= g.shape[0] - turns, 1.0, jnp.where(rank < -turns, -1.0, 0.0))
    # det g = 1, so the sum of the angles is a multiple of 2π; it is removed from the largest (smallest) angles.
    angles = angles - 2 * np.pi * excess.astype(angles.dtype)
    return 1j * vectors @ jnp.diag(angles.astype(g.dtype)) @ vectors.conj().T


def principal_log(group: AbstractGroup, g: Element) -> Element:
    """Logarithm by inverse scaling and squaring, and one Newton step that leaves rounding errors only.

    If the square roots do not converge (an eigenvalue is −1, to rounding), the last iterate is used.
    """
    root = jax.lax.fori_loop(0, HALVINGS, lambda _, root: _square_root(root), g)
    one = jnp.eye(g.shape[0], dtype=g.dtype)
    ratio = jnp.linalg.solve((root + one).T, (root - one).T).T  # (root − 1)(root + 1)⁻¹
    square, total = ratio @ ratio, one / 15
    for j in range(7, 0, -1):  # series of artanh
        total = one / (2 * j - 1) + square @ total
    # The logarithm of the root r is 2 artanh((r − 1)(r + 1)⁻¹); it is multiplied by 2^HALVINGS.
    x = 2.0 ** (HALVINGS + 1) * group.vee(ratio @ total)
    # exp(x)⁻¹g = 1 + δ with a small δ, and log(exp(x)(1 + δ)) = x + δ up to products of δ with x and itself.
    return group.hat(x) + group.inverse(group.exp(x)) @ g - one


def matrix_unique_log(g: Element) -> Flag:
    """Whether the principal logarithm of g (N, N) is unique: False if an eigenvalue is −1, to the root of rounding."""
    shifted = g + jnp.eye(g.shape[0], dtype=g.dtype)
    return jnp.linalg.svd(shifted, compute_uv=False)[-1] > 4 * jnp.finfo(g.dtype).eps ** 0.5


def _square_root(g: Element) -> Element:
    """Newton's iteration in the form of Denman and Beavers: X → g^½, Y → g^−½."""
    accuracy = 4 * g.shape[0] * jnp.finfo(g.dtype).eps

    def unfinished(carry):
        k, _, _, change = carry
        return (k < ROOT_LIMIT) & (change > accuracy)

    def improve(carry):
        k, x, y, _ = carry
        # Both use the old pair: this form is stable, Newton's X ← (X + X⁻¹g)/2 is not (Higham 2008, chapter 6).
        new_x, new_y = (x + jnp.linalg.inv(y)) / 2, (y + jnp.linalg.inv(x)) / 2
        return k + 1, new_x, new_y, jnp.max(jnp.abs(new_x - x))

    start = (jnp.zeros((), jnp.int32), g, jnp.eye(g.shape[0], dtype=g.dtype), jnp.asarray(jnp.inf, g.real.dtype))
    return jax.lax.while_loop(unfinished, improve, start)[1]
