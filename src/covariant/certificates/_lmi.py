"""Linear matrix inequalities for contraction: one constant metric for many Jacobians, and the gain of an observer.

Source: Boyd, El Ghaoui, Feron & Balakrishnan 1994, Linear Matrix Inequalities in System and Control Theory, chapters 5
and 7: quadratic stability of a polytope of systems, and the change of variable Y = MK.
"""

import math
from collections.abc import Callable
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._optional import load_optional
from covariant._typing import Numbers
from covariant.certificates._statement import Hypothesis, Statement

AffineMatrix = Callable[[np.ndarray], np.ndarray]
"""Unknowns (d,) -> a symmetric matrix, affine in the unknowns, that has to be positive semidefinite."""


SLACK = 1e-6
"""Part of the largest Jacobian by which the solver is asked for a larger rate, so that its rounding does not matter."""


class MetricDesign(NamedTuple):
    """A constant metric M (n, n) with eigenvalues from 1 to `conditioning`, and a gain K (n, p), p = 0 without one.

    - `statement`: that M and K do what was asked; what the solver found is verified in rational arithmetic.
    """

    metric: Float[np.ndarray, "n n"]
    gain: Float[np.ndarray, "n p"]
    conditioning: float
    statement: Statement


def common_metric(jacobians: Numbers, rate: float) -> MetricDesign:
    """The best conditioned M with `FᵀM + MF ≤ −rate M` for every Jacobian F (k, n, n), so for all in their hull.

    Squared lengths decrease at `rate` [1/s], distances at half of it. Raises `ValueError` where there is none, and for
    a rate that is not finite.

    >>> import numpy as np
    >>> from covariant.certificates import common_metric
    >>> design = common_metric(np.array([[[-1.0, 2.0], [0.0, -1.0]], [[-1.0, 0.0], [2.0, -1.0]]]), rate=-1.0)
    >>> design.statement.short
    'holds (proved)'
    """
    f = _stack("jacobians", jacobians, None)
    return _design(f, np.zeros((len(f), 0, f.shape[1])), rate, 0.0)


def observer_gain(jacobians: Numbers, outputs: Numbers, rate: float, *, effort: float = 1e-3) -> MetricDesign:
    """K and M with `(F − KH)ᵀM + M(F − KH) ≤ −rate M` for all pairs of Jacobians F (k, n, n) and H (k, p, n).

    They minimise the condition number of M plus `effort` times the norm of MK. The pairs are the vertices of a
    polytope, on all of which the result then holds, or samples of a set, between which it has to be certified. Raises
    `ValueError` where the shapes do not fit, for a rate that is not finite, or where there is no such gain, with the
    advice to lower the rate.
    """
    f = _stack("jacobians", jacobians, None)
    return _design(f, _stack("outputs", outputs, f), rate, effort)


def _stack(name: str, matrices: Numbers, beside: np.ndarray | None) -> np.ndarray:
    found = np.asarray(matrices, float)
    found = found[None] if found.ndim == 2 else found
    wrong = found.ndim != 3 or (
        found.shape[1] != found.shape[2]
        if beside is None
        else found.shape[0] != beside.shape[0] or found.shape[2] != beside.shape[2]
    )
    if wrong:
        needed = "(k, n, n)" if beside is None else f"({beside.shape[0]}, p, {beside.shape[2]})"
        raise ValueError(f"{name} must have the shape {needed}; it has {np.shape(matrices)}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name} must be finite")
    return found


def _design(f: np.ndarray, h: np.ndarray, rate: float, effort: float) -> MetricDesign:
    if not math.isfinite(rate):
        raise ValueError(f"the rate must be a finite number; got {rate}")
    slack = SLACK * max(abs(rate), *(float(np.linalg.norm(each, 2)) for each in f))
    found = _solved(f, h, rate + slack, effort) or _solved(f, h, rate, effort)
    if found is None:
        raise ValueError(
            f"no constant metric makes all {len(f)} Jacobians contract at {rate:g} 1/s; lower the rate or the set"
        )
    m, k, conditioning = found
    return MetricDesign(m, k, conditioning, _statement(m, k, f, h, rate))


def _statement(m: np.ndarray, k: np.ndarray, f: np.ndarray, h: np.ndarray, rate: float) -> Statement:
    """That M contracts at the rate for each pair of Jacobians, shown in rational arithmetic on the numbers as given."""
    metric, gain = rational(m), rational(k)
    is_metric = bool((m == m.T).all()) and is_definite(metric)
    wrong, margins = [], []
    for i, (a, b) in enumerate(zip(f, h, strict=True)):
        moved = metric @ (rational(a) - gain @ rational(b))
        form = -(moved + moved.T) - Fraction(rate) * metric
        margins.append(float(np.linalg.eigvalsh(form.astype(float))[0]))
        if not is_definite(form):
            wrong.append(i)
    worst = wrong[0] if wrong else int(np.argmin(margins))
    pair = "Jacobian" if not k.size else "pair of Jacobians"
    hypotheses = (
        Hypothesis(
            "M is symmetric and positive definite, in rational arithmetic",
            "proved",
            "holds" if is_metric else "undecided",
            float(np.linalg.eigvalsh(m)[0]),
        ),
        Hypothesis(
            f"squared lengths shrink faster than that for each of the {len(f)} {pair}s, in rational arithmetic",
            "proved",
            "undecided" if wrong else "holds",
            margins[worst],
            f"{pair} {worst + 1}",
        ),
        Hypothesis("the Jacobians of the system are among those given, or in their hull", "assumed"),
    )
    about = (f"M = {m.tolist()}", *([f"K = {k.tolist()}"] if k.size else []), f"{len(f)} {pair}s of {len(m)} states")
    claim = f"squared lengths in the constant metric M shrink at {rate:g} 1/s or faster"
    return Statement(claim, about, hypotheses, margins[worst], f"the hull of {len(f)} {pair}s")


def rational(matrix: np.ndarray) -> np.ndarray:
    """A matrix of floats as one of fractions that are equal to them."""
    return np.vectorize(Fraction, otypes=[object])(matrix)


def is_definite(matrix: np.ndarray) -> bool:
    """Whether a symmetric matrix of fractions is positive definite, by elimination without rounding."""
    if not len(matrix):
        return True
    pivot, column = matrix[0, 0], matrix[1:, :1]
    return pivot > 0 and is_definite(matrix[1:, 1:] - column @ column.T / pivot)


def _solved(f: np.ndarray, h: np.ndarray, rate: float, effort: float) -> tuple[np.ndarray, np.ndarray, float] | None:
    """M, K and the condition of M as the solver finds them, or None."""
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
            moved = m @ a - y @ b
            return -(moved + moved.T) - rate * m

        return form

    def bounded(x):
        _, y, _, g = parts(x)
        return np.block([[g * np.eye(n), y], [y.T, g * np.eye(p)]])

    eye = np.eye(n)
    forms: list[AffineMatrix] = [shrinks(a, b) for a, b in zip(f, h, strict=True)]
    forms += [lambda x: parts(x)[0] - eye, lambda x: parts(x)[2] * eye - parts(x)[0], bounded]
    cost = np.zeros(size + n * p + 2)
    cost[-2:] = 1.0, effort if p else 1.0
    x = minimise(cost, forms)
    if x is None:
        return None
    m, y, conditioning, _ = parts(x)
    return m, np.linalg.solve(m, y), float(conditioning)


def minimise(cost: Float[np.ndarray, "d"], forms: list[AffineMatrix]) -> Float[np.ndarray, "d"] | None:
    """The unknowns x that minimise `cost @ x` with all forms positive semidefinite; None where there are none.

    Raises `ImportError` without clarabel, the solver.
    """
    clarabel, sparse = (
        load_optional(m, use="designing a metric needs", extra="lmi") for m in ("clarabel", "scipy.sparse")
    )
    d = len(cost)
    blocks, constants, cones = [], [], []
    for form in forms:
        at_zero = form(np.zeros(d))
        slopes = np.stack([_packed(form(unit) - at_zero) for unit in np.eye(d)], axis=1)
        blocks.append(-slopes)
        constants.append(_packed(at_zero))
        cones.append(clarabel.PSDTriangleConeT(len(at_zero)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    solver = clarabel.DefaultSolver(
        sparse.csc_matrix((d, d)),
        cost,
        sparse.csc_matrix(np.concatenate(blocks)),
        np.concatenate(constants),
        cones,
        settings,
    )
    solution = solver.solve()
    solved = str(solution.status) in ("Solved", "AlmostSolved")
    return np.asarray(solution.x) if solved else None


def _packed(matrix: np.ndarray) -> np.ndarray:
    """The upper triangle, column by column, with off-diagonal entries times √2, as the solver's cone needs it."""
    columns, rows = np.tril_indices(len(matrix))
    return matrix[rows, columns] * np.where(rows == columns, 1.0, math.sqrt(2))
