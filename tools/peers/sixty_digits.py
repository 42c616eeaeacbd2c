"""Exponentials of rotations and rigid motions, their logarithms and Jacobians, in arithmetic of 60 digits.

All from power series of matrices, which share no formula with the closed forms that are compared with them. Numbers are
integers in units of 2⁻²⁴⁰ where matrices are multiplied, which takes a tenth of the time of mpmath.
"""

from typing import NamedTuple

import mpmath
import numpy as np

ONE = 1 << 240


def fixed(value: float) -> int:
    """A number as an integer in units of 2⁻²⁴⁰."""
    return int(mpmath.ldexp(mpmath.mpf(float(value)), 240)) if np.isfinite(value) else 0


def product(a, b):
    """Product of two matrices of such integers."""
    return (a @ b) >> 240


def series(a, divisor):
    """The terms of `Σ aᵏ / (divisor(1) ⋯ divisor(k))`."""
    term, k, terms = np.eye(len(a), dtype=object) * ONE, 0, []
    while k < 4 or max(abs(entry) for entry in term.flat) > ONE >> 215:
        terms.append(term)
        k += 1
        term = product(a, term) // divisor(k)
    return terms


def hat(name: str, x: list[int]):
    """Matrix of the algebra."""
    if name == "SO2":
        return np.array([[0, -x[0]], [x[0], 0]], object)
    if name == "SE2":
        return np.array([[0, -x[2], x[0]], [x[2], 0, x[1]], [0, 0, 0]], object)
    a, b, c = x[-3:]
    turn = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]], object)
    if name == "SO3":
        return turn
    return np.block([[turn, np.array(x[:3], object)[:, None]], [np.zeros((1, 4), object)]])


def vee(name: str, m) -> list[int]:
    """Coordinates of a matrix of the algebra."""
    if name == "SO2":
        return [m[1, 0]]
    if name == "SE2":
        return [m[0, 2], m[1, 2], m[1, 0]]
    turn = [m[2, 1], m[0, 2], m[1, 0]]
    return turn if name == "SO3" else [*m[:3, 3], *turn]


class Exact(NamedTuple):
    """What each function should return, in units of 2⁻²⁴⁰, by its name."""

    values: dict[str, np.ndarray]

    def element(self) -> np.ndarray:
        """The element, rounded to double precision."""
        return np.array([[int(v) / ONE for v in row] for row in self.values["exp"]])

    def error(self, name: str, outcome: np.ndarray, dtype: type) -> float:
        """Error of a result in units of rounding, relative to the exact one, or absolute where that is zero."""
        if not np.all(np.isfinite(outcome)):
            return float("nan")
        right = self.values[name]
        apart = np.array([fixed(v) for v in np.ravel(outcome)], object) - np.ravel(right)
        size = norm(np.ravel(right)) or 1.0
        return norm(apart) / size / float(np.finfo(dtype).eps)


def norm(parts) -> float:
    """Euclidean norm."""
    return float(mpmath.sqrt(mpmath.mpf(sum(int(v) ** 2 for v in parts)))) / ONE


def inverse(a):
    """Inverse of a matrix."""
    with mpmath.workdps(75):
        solved = mpmath.inverse(mpmath.matrix([[mpmath.mpf(int(v)) / ONE for v in row] for row in a]))
        return np.array([[int(mpmath.nint(v * ONE)) for v in row] for row in solved.tolist()], object)


def exact(name: str, x: np.ndarray) -> Exact:
    """All functions at a twist x (n,)."""
    with mpmath.workdps(75):
        n, twist = len(x), [fixed(v) for v in x]
        basis = [hat(name, [ONE * (i == j) for i in range(n)]) for j in range(n)]
        a = hat(name, twist)
        exp = sum(series(a, lambda k: k))
        back = sum(series(-a, lambda k: k))
        small = np.array([vee(name, product(a, e) - product(e, a)) for e in basis], object).T
        terms = series(-small, lambda k: k + 1)
        right = sum(terms)
        adjoint = np.array([vee(name, product(product(exp, e), back)) for e in basis], object).T
        values = {
            "exp": exp,
            "log": np.array(twist, object),
            "right_jacobian": right,
            "right_jacobian_inverse": inverse(right),
            "adjoint": adjoint,
        }
    return Exact(values)
