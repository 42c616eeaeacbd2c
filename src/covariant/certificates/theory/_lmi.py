"""Solves linear matrix inequalities for contraction: one constant metric for many Jacobians, and an observer gain.

Source: Boyd, El Ghaoui, Feron & Balakrishnan 1994, Linear Matrix Inequalities in System and Control Theory, chapters 5
and 7: quadratic stability of a polytope of systems, and the change of variable Y = MK.
"""

import functools
import math
from collections.abc import Callable
from fractions import Fraction
from typing import Annotated, NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._domains import FINITE, Finite, NotNegative, check_numbers
from covariant._optional import load_optional
from covariant._typing import Numbers
from covariant.certificates.base import Hypothesis, Statement
from scalargraph.errors import InputError

AffineMatrix = Callable[[np.ndarray], np.ndarray]
"""Unknowns (d,) -> a symmetric matrix, affine in the unknowns, that must be positive semidefinite."""


SLACK = 1e-6
"""Fraction of the largest Jacobian that is added to the rate for the solver, as a margin for its rounding."""


class MetricDesign(NamedTuple):
    """A constant metric, and the gain of an observer for it.

    Attributes:
        metric: M (n, n), with eigenvalues from 1 to `conditioning`.
        gain: K (n, p); p = 0 if no gain was designed.
        conditioning: condition number of M.
        statement: the statement that M and K satisfy the inequalities, verified in rational arithmetic.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import common_metric
        >>> design = common_metric(-np.eye(2), rate=1.0)
        >>> design.metric.round(3).tolist(), design.gain.shape
        ([[1.0, 0.0], [0.0, 1.0]], (2, 0))
    """

    metric: Float[np.ndarray, "n n"]
    gain: Float[np.ndarray, "n p"]
    conditioning: float
    statement: Statement


@check_numbers
def common_metric(jacobians: Annotated[Numbers, FINITE], rate: Finite) -> MetricDesign:
    """Find the best conditioned metric M with `FᵀM + MF ≤ −rate M` for every Jacobian F, and so for their convex hull.

    Args:
        jacobians: Jacobians F (k, n, n) [1/s], or a single one (n, n).
        rate: rate [1/s] at which squared lengths decrease, distances at half of it; may be negative.

    Returns:
        The metric, without a gain.

    Raises:
        ValueError: there is no such metric, or the rate is not finite.
        ImportError: the solver clarabel is missing.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import common_metric
        >>> design = common_metric(np.array([[[-1.0, 2.0], [0.0, -1.0]], [[-1.0, 0.0], [2.0, -1.0]]]), rate=-1.0)
        >>> design.statement.short
        'holds (proved)'
    """
    f = _stack("jacobians", jacobians, None)
    return _design(f, np.zeros((len(f), 0, f.shape[1])), rate, 0.0)


@check_numbers
def observer_gain(
    jacobians: Annotated[Numbers, FINITE],
    outputs: Annotated[Numbers, FINITE],
    rate: Finite,
    *,
    effort: NotNegative = 1e-3,
) -> MetricDesign:
    """Find K and M with `(F − KH)ᵀM + M(F − KH) ≤ −rate M` for all pairs of Jacobians F and H.

    They minimise the condition number of M plus `effort` times the norm of MK. The result holds for the convex hull of
    the given pairs. If they are only samples of a set and not vertices of a polytope, the rest has to be certified.

    Args:
        jacobians: Jacobians F (k, n, n) [1/s] of the model, or a single one (n, n).
        outputs: Jacobians H (k, p, n) of the outputs, or a single one (p, n).
        rate: rate [1/s] at which squared lengths decrease, distances at half of it.
        effort: weight of the gain in the cost.

    Returns:
        The metric and the gain K (n, p).

    Raises:
        ValueError: the shapes do not fit, the rate is not finite, or there is no such gain; try a lower rate.
        ImportError: the solver clarabel is missing.

    Example:
        >>> from covariant.certificates import observer_gain
        >>> design = observer_gain([[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0]], rate=1.0)
        >>> design.gain.shape, design.statement.short
        ((2, 1), 'holds (proved)')
    """
    f = _stack("jacobians", jacobians, None)
    return _design(f, _stack("outputs", outputs, f), rate, effort)


def _stack(name: str, matrices: Numbers, beside: np.ndarray | None) -> np.ndarray:
    stack = np.asarray(matrices, float)
    stack = stack[None] if stack.ndim == 2 else stack
    wrong = stack.ndim != 3 or (
        stack.shape[1] != stack.shape[2]
        if beside is None
        else stack.shape[0] != beside.shape[0] or stack.shape[2] != beside.shape[2]
    )
    if wrong:
        needed = "(k, n, n)" if beside is None else f"({beside.shape[0]}, p, {beside.shape[2]})"
        raise InputError(f"{name} must have the shape {needed}; it has {np.shape(matrices)}")
    return stack


def _design(f: np.ndarray, h: np.ndarray, rate: float, effort: float) -> MetricDesign:
    slack = SLACK * max(abs(rate), *(float(np.linalg.norm(each, 2)) for each in f))
    # First a slightly higher rate, so that the statement at `rate` remains true despite the solver's rounding.
    solution = _solved(f, h, rate + slack, effort) or _solved(f, h, rate, effort)
    if solution is None:
        raise InputError(
            f"no constant metric makes {_count_jacobians(f, h)[1]} contract at {rate:g} 1/s; lower the rate or the set"
        )
    m, k, conditioning = solution
    return MetricDesign(m, k, conditioning, _statement(m, k, f, h, rate))


def _statement(m: np.ndarray, k: np.ndarray, f: np.ndarray, h: np.ndarray, rate: float) -> Statement:
    """State that M contracts at the rate for each pair of Jacobians, as shown in rational arithmetic."""
    metric, gain = rational(m), rational(k)
    is_metric = bool((m == m.T).all()) and is_definite(metric)
    wrong, margins = [], []
    for i, (a, b) in enumerate(zip(f, h, strict=True)):
        product = metric @ (rational(a) - gain @ rational(b))
        form = -(product + product.T) - Fraction(rate) * metric
        margins.append(float(np.linalg.eigvalsh(form.astype(float))[0]))
        if not is_definite(form):
            wrong.append(i)
    worst = wrong[0] if wrong else int(np.argmin(margins))
    least = float(np.linalg.eigvalsh(m)[0])
    pair, counted = _count_jacobians(f, h)
    definite = "M is symmetric and positive definite, in rational arithmetic"
    shrinks = f"squared lengths shrink faster than that for {counted}, in rational arithmetic"
    verdict = "undecided" if wrong else "holds"
    hypotheses = (
        Hypothesis(definite, "proved", "holds" if is_metric else "undecided", least),
        Hypothesis(shrinks, "proved", verdict, margins[worst], f"{pair} {worst + 1}"),
        Hypothesis("the Jacobians of the system are among those given, or in their hull", "assumed"),
    )
    data = (f"M = {m.tolist()}", *([f"K = {k.tolist()}"] if k.size else []), f"{counted}, states: {len(m)}")
    claim = f"squared lengths in the constant metric M shrink at {rate:g} 1/s or faster"
    return Statement(claim, data, hypotheses, margins[worst], f"the hull of {counted}")


def _count_jacobians(f: np.ndarray, h: np.ndarray) -> tuple[str, str]:
    """The name of one of the matrices, or pairs of matrices, and their number in words."""
    one, many = ("pair of Jacobians", "pairs of Jacobians") if h.size else ("Jacobian", "Jacobians")
    return one, f"{len(f)} {many if len(f) > 1 else one}"


def rational(matrix: np.ndarray) -> np.ndarray:
    """Convert a matrix of floats to one of fractions that are equal to them."""
    return np.vectorize(Fraction, otypes=[object])(matrix)


def is_definite(matrix: np.ndarray) -> bool:
    """Test whether a symmetric matrix of fractions is positive definite, by elimination without rounding."""
    if not len(matrix):
        return True
    # Sylvester's criterion: all pivots are positive; the rest is the Schur complement of the first one.
    pivot, column = matrix[0, 0], matrix[1:, :1]
    return pivot > 0 and is_definite(matrix[1:, 1:] - column @ column.T / pivot)


def _solved(f: np.ndarray, h: np.ndarray, rate: float, effort: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """M, K and the condition number of M from the solver, or None if there is no solution."""
    n, p = f.shape[1], h.shape[1]
    rows, columns = np.tril_indices(n)
    size = len(rows)

    def parts(x):
        m = np.zeros((n, n))
        m[rows, columns] = m[columns, rows] = x[:size]
        return m, x[size : size + n * p].reshape(n, p), x[-2], x[-1]

    def shrinks(a, b):
        def form(x):
            m, y, _, _ = parts(x)
            product = m @ a - y @ b
            return -(product + product.T) - rate * m

        return form

    def bounded(x):
        _, y, _, g = parts(x)
        # Positive semidefinite if and only if the largest singular value of Y is at most g (Schur complement).
        return np.block([[g * np.eye(n), y], [y.T, g * np.eye(p)]])

    eye = np.eye(n)
    forms: list[AffineMatrix] = [shrinks(a, b) for a, b in zip(f, h, strict=True)]
    # I ≤ M ≤ κI: the eigenvalues of M lie between 1 and the condition number κ, which is minimised. The inequalities
    # are homogeneous in M and Y, so M ≥ I only fixes the scale.
    forms += [lambda x: parts(x)[0] - eye, lambda x: parts(x)[2] * eye - parts(x)[0], bounded]
    cost = np.zeros(size + n * p + 2)
    # Without outputs the bound of |Y| is arbitrary, and any positive cost reduces it to 0.
    cost[-2:] = 1.0, effort if p else 1.0
    x = minimise(cost, forms)
    if x is None:
        return None
    # Y = MK makes the inequality linear in the unknowns; K follows.
    m, y, conditioning, _ = parts(x)
    return m, np.linalg.solve(m, y), float(conditioning)


def minimise(
    cost: Float[np.ndarray, "d"], forms: list[AffineMatrix], tolerance: float = 1e-8
) -> Float[np.ndarray, "d"] | None:
    """Minimise a linear cost over unknowns for which all affine forms are positive semidefinite."""
    needed = functools.partial(load_optional, use="solving matrix inequalities needs", extra="lmi")
    clarabel, sparse = map(needed, ("clarabel", "scipy.sparse"))
    d = len(cost)
    blocks, constants, cones = [], [], []
    for form in forms:
        at_zero = form(np.zeros(d))
        slopes = np.stack([_pack_triangle(form(unit) - at_zero) for unit in np.eye(d)], axis=1)
        blocks.append(-slopes)
        constants.append(_pack_triangle(at_zero))
        cones.append(clarabel.PSDTriangleConeT(len(at_zero)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    none, slopes = sparse.csc_matrix((d, d)), sparse.csc_matrix(np.concatenate(blocks))
    solution = clarabel.DefaultSolver(none, cost, slopes, np.concatenate(constants), cones, settings).solve()
    solved = str(solution.status) in ("Solved", "AlmostSolved")
    return np.asarray(solution.x) if solved else None


def _pack_triangle(matrix: np.ndarray) -> np.ndarray:
    """The upper triangle, column by column, with off-diagonal entries times √2, as the solver's cone needs it."""
    columns, rows = np.tril_indices(len(matrix))
    return matrix[rows, columns] * np.where(rows == columns, 1.0, math.sqrt(2))
