"""Checks leaves of saved certificates in ball arithmetic of many digits: a third one, beside prover and checker.

The graphs of a matrix and of its derivatives are the same as the prover's. The graphs and the test of positive
definiteness are evaluated in the arithmetic of Arb, by python-flint.

Source: F. Johansson, Arb: efficient arbitrary-precision midpoint-radius interval arithmetic, IEEE Trans. Computers
66(8), 2017.
"""

import math
import operator
from pathlib import Path
from typing import Any

import flint
import jax.numpy as jnp
import numpy as np

from covariant.certificates.base import (
    FORMS,
    DisturbanceClaim,
    Document,
    PredictionClaim,
    Resolved,
    disturbance_bound,
    joint_force_bound,
    parse,
)
from covariant.certificates.checking._check import follows
from covariant.certificates.checking._matrices import prediction_of_steps, sizes
from covariant.certificates.sampled import defect_bound
from scalargraph import Lowered, evaluate, expand
from scalargraph.errors import InputError
from scalargraph.graph import Domain, pairs
from scalargraph.proofs import Form
from scalargraph.proofs.checker import halves, leaves

BITS = 106
"""Precision in bits, twice that of a double."""
DEPTH = 8
"""Largest number of times a leaf may be halved, as balls give wider bounds than intervals."""


class BallMatrix:
    """Taylor's form of a symmetric matrix (n, n), `S(c) + S'(c) δ + ½ S''(box) δ²`, in balls of many digits.

    The caller sets the precision, `flint.ctx.workprec(BITS)`.

    Args:
        form: The matrix.
        low: Lower corner (d,) of a box that contains all others.
        high: Upper corner (d,).

    Attributes:
        n: Number of rows.
        free: Indices of the variables that the matrix reads and that have distinct bounds.
        reads: Their number.
    """

    def __init__(self, form: Form, low: np.ndarray, high: np.ndarray):
        entries = form.then(lambda m: (m + m.T) / 2).graph(jnp.asarray(low)).entries
        self.n = entries.results[0].shape[0]
        read = {int(node.value or 0) for node in entries.graph.nodes if node.op == "input"}
        self.free = [i for i in np.flatnonzero(high > low).tolist() if i in read]
        self.reads = len(self.free)
        value = entries._replace(outputs=tuple(entries.nodes()[np.tril_indices(self.n)].tolist()))
        self.first, self.second = expand(value, self.free, 1), expand(value, self.free, 2)
        self.arb, self.matrix, self.domain = flint.arb, flint.arb_mat, _balls(flint.arb)

    def show(self, low: np.ndarray, high: np.ndarray, what: str, depth: int = DEPTH) -> int:
        """Show that the matrix is positive definite on one box.

        Args:
            low: Lower corner (d,).
            high: Upper corner (d,).
            what: Name of the claim, for the message.
            depth: Largest number of halvings.

        Returns:
            Number of boxes evaluated.

        Raises:
            ValueError: This is not shown after `depth` halvings; the message names a box.
        """
        try:
            good, axis = self._definite(low, high)
        except _UndecidedError:
            good, axis = False, int((high - low).argmax())
        if good:
            return 1
        if not depth:
            box = ", ".join(f"{a:.6g} to {b:.6g}" for a, b in zip(low, high, strict=True))
            raise InputError(f"{what} is not shown in balls to be right where the variables are {box}")
        lows, highs = halves(low[None], high[None], np.array([axis]))
        return 1 + sum(self.show(a, b, what, depth - 1) for a, b in zip(lows, highs, strict=True))

    def _definite(self, low: np.ndarray, high: np.ndarray) -> tuple[bool, int]:
        """Whether `|I − CᵀSC| x < x` shows positive definiteness, and the variable that widens the bounds most."""
        centre, count = low / 2 + high / 2, self.n * (self.n + 1) // 2
        around = [self.arb(a).union(self.arb(b)) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
        # The rounded centre is not exactly in the middle, so the farther end counts; `upper` rounds the distance up.
        away = [abs(around[i] - self.arb(float(centre[i]))).upper() for i in self.free]
        at = self._matrices(self.first, list(map(self.arb, centre.tolist())), count)
        bend = self._matrices(self.second, around, count)[1 + len(self.free) :]
        middle = np.array([[float(at[0][i, j].mid()) for j in range(self.n)] for i in range(self.n)])
        values, vectors = np.linalg.eigh(middle)
        # C exists only if the eigenvalues are positive; otherwise nothing is shown on this box.
        if not values[0] > 0:
            return False, int((high - low).argmax())
        c = self.matrix((vectors / np.sqrt(values)).tolist())
        identity = self.matrix(np.eye(self.n).tolist())
        parts: list[tuple[Any, Any, tuple[int, ...]]] = [(c.transpose() * at[0] * c - identity, self.arb(1), ())]
        # S(c) + Σ Sᵢ δᵢ + ½ Σ Sᵢⱼ δᵢδⱼ: a pair i ≠ j occurs twice in the last sum, a square once.
        parts += [(c.transpose() * s * c, d, (k,)) for k, (s, d) in enumerate(zip(at[1:], away, strict=True))]
        for s, (i, j) in zip(bend, pairs(len(self.free)), strict=True):
            parts.append((c.transpose() * s * c, away[i] * away[j] / (2 if i == j else 1), (i, j)))
        error, share = self.matrix(self.n, self.n), np.zeros(len(self.free))
        for term, size, variables in parts:
            bound = self.matrix([[abs(term[i, j]) * size for j in range(self.n)] for i in range(self.n)])
            error += bound
            share[list(variables)] += sum(float(entry.upper()) for entry in bound.entries())
        # The vector x is computed in doubles, since any positive x is valid; only the comparison below is rigorous.
        rough, x = np.array([[float(error[i, j].mid()) for j in range(self.n)] for i in range(self.n)]), np.ones(self.n)
        for _ in range(8):
            x = rough @ x
            # Power iteration towards the Perron vector; the small number keeps every entry positive.
            x = x / x.max() + 1e-9
        product = error * self.matrix([[v] for v in x.tolist()])
        # A comparison of balls is true only if it holds for all numbers in them.
        good = all(product[i, 0] < self.arb(float(x[i])) for i in range(self.n))
        return good, int(self.free[share.argmax()] if len(share) else 0)

    def _matrices(self, graph: Lowered, z: list, count: int) -> list:
        """Consecutive symmetric matrices, each read from its entries on and below the diagonal."""
        values = evaluate(graph, self.domain, z)
        place = np.zeros((self.n, self.n), int)
        place[np.tril_indices(self.n)] = np.arange(count)
        place = np.maximum(place, place.T)
        return [
            self.matrix([[values[start + k] for k in row] for row in place.tolist()])
            for start in range(0, len(values), count)
        ]


class _UndecidedError(ArithmeticError):
    """Raised if a box does not decide a branch."""


def _balls(arb: Any) -> Domain:
    """The arithmetic of Arb; if a box does not decide a branch, it raises `_UndecidedError`."""
    zero, one = arb(0), arb(1)
    unary = "sqrt exp expm1 log log1p sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh"
    return {
        "constant": lambda value: value if isinstance(value, bool) else arb(float(value)),
        **{name: operator.methodcaller(name) for name in unary.split()},
        "add": operator.add,
        "sub": operator.sub,
        "mul": operator.mul,
        "div": operator.truediv,
        "neg": operator.neg,
        "abs": abs,
        # 0 may get either sign: the conditions of a proof exclude the jump there.
        "sign": lambda a: -one if _less(a, zero) else one,
        "floor": _floor,
        "ceil": lambda a: -_floor(-a),
        # It differs from rounding to even only half-way between integers: the conditions exclude a jump there.
        "round": lambda a: _floor(a + 0.5),
        "min": lambda a, b: a if _less(a, b) else b,
        "max": lambda a, b: b if _less(a, b) else a,
        "pow": operator.pow,
        "cbrt": lambda a: a.root(3),
        "atan2": lambda y, x: zero.atan2(y, x),
        "lt": _less,
        "le": _at_most,
        "eq": _equal,
        "and": operator.and_,
        "or": operator.or_,
        "not": operator.not_,
        "is_finite": lambda a: a.is_finite(),
        "select": lambda p, a, b: a if p else b,
        "either": lambda a, b, x, y: x if a < b else y if b < a else x.union(y),
        "stumpff": lambda k, x: _stumpff(arb, int(float(k)), x),
    }


def _less(a: Any, b: Any) -> bool:
    if a < b:
        return True
    if a >= b:
        return False
    raise _UndecidedError


def _at_most(a: Any, b: Any) -> bool:
    return not _less(b, a)


def _equal(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if not a.overlaps(b):
        return False
    if a.is_exact() and b.is_exact():
        return True
    raise _UndecidedError


def _floor(a: Any) -> Any:
    rounded = a.floor()
    if not rounded.is_exact():
        raise _UndecidedError
    return rounded


def _stumpff(arb: Any, k: int, x: Any) -> Any:
    """The series of Stumpff's function c_k, with a geometric bound of its remainder, valid for either sign of x."""
    total, term, terms = arb(0), 1 / arb(math.factorial(k)), 40
    for j in range(1, terms):
        total, term = total + term, -term * x / ((2 * j + k) * (2 * j + k - 1))
    # The ratio of each term to the one before, from the first omitted term on, is at most this.
    ratio = abs(x).upper() / ((2 * terms + k) * (2 * terms + k - 1))
    if not ratio < 0.5:
        raise _UndecidedError
    # 2 is 1/(1 − 1/2), the sum of the geometric series. arb(0, 1) is the ball [−1, 1]: the remainder has either sign.
    return total + 2 * abs(term).upper() * arb(0, 1)


MOST_VARIABLES = 10
"""Largest number of variables of a leaf that is checked whole."""
PART = 64
"""Ratio of a leaf with many variables to its checked part, in every direction."""


def check_sample(source: str | Path | Document, count: int = 20, seed: int = 0) -> tuple[int, int]:
    """Check random leaves of a saved certificate, drawn from all its claims; returns their number and that of all.

    Balls bound derivatives operation by operation, which needs smaller boxes than the Taylor models of the proof, so
    leaves are halved. Two kinds of leaves are too large for that: leaves with more than ten variables, and leaves on
    the steps of predictions. Of these only a random part is checked. A box that is not confirmed raises `ValueError`.
    """
    document = source if isinstance(source, Document) else parse(source)
    resolved, claims = follows(document), document.claims
    boxes = [leaves(*document.bounds(claim), claim.levels, f"claims[{index}]") for index, claim in enumerate(claims)]
    ends = np.cumsum([len(low) for low, _ in boxes])
    rng = np.random.default_rng(seed)
    # Drawn without repetition over all claims together, so that each leaf has the same probability.
    drawn = np.sort(rng.permutation(ends[-1])[:count])
    with flint.ctx.workprec(BITS):
        for index, claim in enumerate(claims):
            chosen = drawn[(drawn < ends[index]) & (drawn >= ends[index] - len(boxes[index][0]))]
            if not len(chosen):
                continue
            form = BallMatrix(_FORMS[claim.kind](resolved, claim), *document.bounds(claim))
            for k in chosen - (ends[index] - len(boxes[index][0])):
                leaf = boxes[index][0][k], boxes[index][1][k]
                # Derivatives of the defect of steps are too wide for balls on a whole leaf.
                large = form.reads > MOST_VARIABLES or isinstance(claim, PredictionClaim)
                piece = _part(*leaf, rng) if large else leaf
                form.show(*piece, f"{document.file}: leaf {k} of claims[{index}]")
    return len(drawn), int(ends[-1])


def _part(low: np.ndarray, high: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random part of a box."""
    start = low + rng.uniform(size=len(low)) * (1 - 1 / PART) * (high - low)
    return start, np.minimum(start + (high - low) / PART, high)


def _disturbance(of: Resolved, claim: DisturbanceClaim) -> Form:
    if of.document.sampling is None:
        return disturbance_bound(of.about, sizes(of.document), claim.square)
    return joint_force_bound(of.about, of.document.given.disturbance, claim.square)


_FORMS = FORMS | {
    "disturbance": _disturbance,
    "prediction": lambda of, claim: defect_bound(
        prediction_of_steps(of.document, of.observer), claim.square, claim.order
    ),
}
"""The forms of all claims, including those that need the checker's bounds of noise or the observer that runs."""
