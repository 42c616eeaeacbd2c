"""Linear matrix inequalities for contraction: one constant metric for many Jacobians, and the gain of an observer.

Source: Boyd, El Ghaoui, Feron & Balakrishnan 1994, Linear Matrix Inequalities in System and Control Theory, chapters 5
and 7: quadratic stability of a polytope of systems, and the change of variable Y = MK.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant._optional import load_optional
from covariant._typing import Numbers

AffineMatrix = Callable[[np.ndarray], np.ndarray]
"""Unknowns (d,) -> a symmetric matrix, affine in the unknowns, that has to be positive semidefinite."""


class MetricDesign(NamedTuple):
    """A constant metric M (n, n) with eigenvalues from 1 to `conditioning`, and a gain K (n, p), p = 0 without one."""

    metric: Float[np.ndarray, "n n"]
    gain: Float[np.ndarray, "n p"]
    conditioning: float


def common_metric(jacobians: Numbers, rate: float) -> MetricDesign:
    """The best conditioned M with `FᵀM + MF ≤ −rate M` for every Jacobian F (k, n, n), so for all in their hull.

    Squared lengths decrease at `rate` [1/s], distances at half of it. Raises `ValueError` where there is none.
    """
    f = _stack("jacobians", jacobians, None)
    return _design(f, np.zeros((len(f), 0, f.shape[1])), rate, 0.0)


def observer_gain(jacobians: Numbers, outputs: Numbers, rate: float, *, effort: float = 1e-3) -> MetricDesign:
    """K and M with `(F − KH)ᵀM + M(F − KH) ≤ −rate M` for all pairs of Jacobians F (k, n, n) and H (k, p, n).

    They minimise the condition number of M plus `effort` times the norm of MK. The pairs are the vertices of a
    polytope, on all of which the result then holds, or samples of a set, between which it has to be certified. Raises
    `ValueError` where the shapes do not fit, or where there is no such gain, with the advice to lower the rate.
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
        raise ValueError(
            f"no constant metric makes all {len(f)} Jacobians contract at {rate:g} 1/s; lower the rate or the set"
        )
    m, y, conditioning, _ = parts(x)
    return MetricDesign(m, np.linalg.solve(m, y), float(conditioning))


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
