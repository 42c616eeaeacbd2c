"""Tests two conditions under which a metric makes an observer converge: locally, or from any distance.

The first condition, inequality (2), requires that f contracts the metric in all directions that do not change the
output. It yields an observer that converges locally. The second condition, G-9, requires that the output is monotonic
along geodesics, and hence that its level sets are totally geodesic. Only with it can a larger gain make the observer
converge from farther away.

Source: Sanfelice & Praly 2015, section I; Sanfelice & Praly 2012, Convergence of nonlinear observers on Rⁿ with a
Riemannian metric (Part I), IEEE TAC 57(7).
"""

import contextlib
from typing import Annotated, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import FINITE, KNOWN, Finite, check_numbers
from covariant._linalg import half_solve, solve, whiten
from covariant._typing import MatrixField, Scalar, StateField, Vector
from covariant.certificates.base import Hypothesis, Statement, StateMetric, Verdict, lowered_christoffel, show_no_jumps
from covariant.geometry import Budget, exp
from covariant.metrics import lie_derivative, with_time
from covariant.models import StateSpace
from scalargraph import LoweringError, jacobian, lower, to_jax
from scalargraph.errors import InputError
from scalargraph.proofs import Box, prove

DEPENDENT = 1e-9
"""Least ratio of the singular values of dh at which its rows count as independent."""
RANK_BOXES = 2000
"""Boxes after which the proof that the rows of dh are independent is given up; only the points speak for it then."""
ROUNDING = 64
"""Roundings, for each state and unit of conditioning, of the terms whose difference counts as zero."""
NO_OBSTACLE = 1e-6
"""Bending of a level set, times the size of the region of the points, below which it is straight there."""
VIOLATES = 1e-6
"""Fraction of the change of the output by which it has to return along a geodesic that is shown as a witness."""


class Observability(NamedTuple):
    """Statements about both conditions, and a geodesic on which the second fails.

    Attributes:
        condition_1: the statement of inequality (2), with the contraction rate [1/s] as margin.
        condition_2: the statement that level sets of the output are totally geodesic, with their bending as margin.
        witness: three successive states (3, n) on a minimising geodesic: the output of the first is closer to the
            output of the last than to that of the middle one. None if the second condition does not fail.
        outputs: their outputs (3, p), or None.

    Example:
        >>> from covariant.certificates import Hypothesis, Statement
        >>> from covariant.certificates.theory import Observability
        >>> premises = (Hypothesis("it holds at the points", "sampled"),)
        >>> first = Statement("f contracts", (), premises, 2.0, "3 states")
        >>> second = Statement("level sets are totally geodesic", (), premises, 0.0, "3 states")
        >>> print(Observability(first, second, None, None).verdict)  # usually from `observability`
        local, and from any distance for a large enough gain, as sampled at 3 states
    """

    condition_1: Statement
    condition_2: Statement
    witness: Float[np.ndarray, "3 n"] | None
    outputs: Float[np.ndarray, "3 p"] | None

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        if self.condition_1.verdict == "undecided":
            open_ones = [premise for premise in self.condition_1.hypotheses if premise.verdict == "undecided"]
            return f"not decided: {'; '.join(f'{premise.text}, {premise.place}' for premise in open_ones)}"
        if self.condition_1.verdict != "holds":
            return f"no observer from this metric: {self.condition_1.claim}, margin {self.condition_1.margin:.3g}"
        if self.condition_2.verdict == "fails":
            at = ", ".join(f"{entry:.3g}" for entry in self.condition_2.point)
            return f"local only: the output's level sets bend by {self.condition_2.margin:.3g} at ({at})"
        if self.condition_2.verdict == "undecided":
            return f"at least local, as sampled at {self.condition_1.domain}: the second condition was not decided"
        return f"local, and from any distance for a large enough gain, as sampled at {self.condition_2.domain}"


@check_numbers
def detectability_rate(
    model: StateSpace,
    metric: StateField,
    x: Annotated[Vector, FINITE],
    u: Annotated[Float[Array, "m"], FINITE] | None = None,
) -> Annotated[Scalar, KNOWN]:
    """Compute the largest q with which inequality (2), `L_f P ≤ ρ dh⊗dh − q P`, holds at x for some ρ [1/s].

    This is differential detectability: q is the least rate at which f contracts the squared lengths of vectors in the
    kernel of dh (Finsler's lemma).

    Args:
        model: the system, with its output h.
        metric: `x -> P (n, n)`, or `(t, x) -> P`, which is taken at t = 0.
        x: state (n,).
        u: constant input (m,), zero by default.

    Returns:
        q [1/s]; infinite if the output determines every direction, and −∞ if the rows of dh are dependent, since then
        the kernel is larger than n minus the number of outputs.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.theory import detectability_rate
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x[:1], coordinates=("a", "b"))
        >>> float(detectability_rate(model, lambda x: jnp.eye(2), jnp.zeros(2)))
        2.0
    """
    hidden, dh = _directions(model, x, u)
    sizes = jnp.linalg.svd(dh, compute_uv=False)
    # More outputs than states are always dependent, which the singular values alone do not show.
    independent = (sizes[-1] > DEPENDENT * sizes[0]) & (dh.shape[0] <= dh.shape[1])
    if not hidden.shape[1]:
        # If dh has no kernel, (2) holds for every q with a large enough ρ.
        return jnp.where(independent, jnp.inf, -jnp.inf).astype(x.dtype)
    change = hidden.T @ lie_derivative(model, metric, x, u) @ hidden
    # Finsler's lemma: a ρ exists exactly where the inequality holds on the kernel of dh.
    rate = -jnp.linalg.eigvalsh(whiten(hidden.T @ _at_start(metric)(x) @ hidden, change))[-1]
    return jax.lax.select(independent, rate, jnp.full_like(rate, -jnp.inf))


@check_numbers
def bending(
    model: StateSpace,
    metric: StateField,
    x: Annotated[Vector, FINITE],
    u: Annotated[Float[Array, "m"], FINITE] | None = None,
) -> tuple[Annotated[Scalar, KNOWN], Scalar, Vector]:
    """Compute the curvature of the level set of the output through x in the metric.

    It is the largest principal curvature |II(v, v)|. The second fundamental form II is the component of
    `∂²h(v, v) − dh Γ(v, v)` along grad h; it is 0 if the level set is totally geodesic. With several outputs it is a
    lower bound.

    Args:
        model: the system, with its output h.
        metric: `x -> P (n, n)`, or `(t, x) -> P`, which is taken at t = 0.
        x: state (n,).
        u: constant input (m,), zero by default.

    Returns:
        The curvature, in the inverse of the metric's unit of length; what roundings can make of a curvature that is
        zero; and the unit direction (n,) of most curvature.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant.certificates.theory import bending
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x[:1] ** 2 + x[1:] ** 2, coordinates=("a", "b"))
        >>> curvature, rounding, direction = bending(model, lambda x: jnp.eye(2), jnp.array([2.0, 0.0]))
        >>> round(float(curvature), 6)  # a circle of radius 2
        0.5
    """
    hidden, dh = _directions(model, x, u)
    if not hidden.shape[1]:  # level sets are points
        return jnp.zeros((), x.dtype), jnp.zeros((), x.dtype), jnp.zeros_like(x)
    p, n = _at_start(metric)(x), len(x)
    unit = half_solve(hidden.T @ p @ hidden, hidden.T).T  # orthonormal in the metric
    t0, _, u0 = _arguments(model, x, u)

    def derivative_of_output(y):
        return jacobian(lambda z: model.h(t0, z, u0), y)

    def on_unit(tensor, vectors):
        return jnp.einsum("pij,ia,jb->abp", tensor.reshape(-1, n, n), vectors, vectors)

    # Second covariant derivative of h: ∇²h(v, w) = ∂²h(v, w) − dh(Γ(v, w)).
    change, second = jacobian(_at_start(metric), x), jacobian(derivative_of_output, x)
    inverse = solve(p, jnp.eye(n, dtype=x.dtype))
    forms = on_unit(second, unit) - on_unit(dh @ inverse @ lowered_christoffel(change).reshape(-1, n).T, unit)
    # The sizes of all terms before anything cancels, in the inverse and in Γ too, and what a rounding of them can be.
    size = jnp.abs(change)
    size = (jnp.transpose(size, (2, 0, 1)) + jnp.transpose(size, (0, 2, 1)) + size) / 2
    size = jnp.abs(dh) @ jnp.abs(inverse) @ size.reshape(-1, n).T
    sizes = on_unit(jnp.abs(second), jnp.abs(unit)) + on_unit(size, jnp.abs(unit))
    rounding = ROUNDING * n * jnp.finfo(x.dtype).eps * jnp.linalg.cond(p)
    # Lengths of normal vectors: |a dh|² = aᵀ (dh P⁻¹ dhᵀ)⁻¹ a for the normal vector with dh(normal) = a.
    normal = half_solve(dh @ solve(p, dh.T), jnp.moveaxis(forms, -1, 0).reshape(dh.shape[0], -1))
    normal = jnp.moveaxis(normal.reshape(dh.shape[0], *forms.shape[:2]), 0, -1)
    scale = jnp.sqrt(jnp.trace(jnp.linalg.inv(dh @ solve(p, dh.T))))
    # The largest |II(v, v)| over unit v, output by output: exact for one output, a lower bound for more.
    values, vectors = jnp.linalg.eigh(jnp.moveaxis(normal + jnp.swapaxes(normal, 0, 1), -1, 0) / 2)
    best = jnp.argmax(jnp.abs(values))
    k = values.shape[1]
    direction = unit @ vectors[best // k][:, best % k]
    return jnp.abs(values).reshape(-1)[best], rounding * scale * jnp.max(sizes), direction


@check_numbers
def observability(
    model: StateSpace,
    metric: StateField,
    points: Annotated[Float[np.ndarray, "k n"], FINITE],
    *,
    u: Annotated[Float[Array, "m"], FINITE] | None = None,
    rate: Finite = 0.0,
    budget: Budget = Budget(),
) -> Observability:
    """Test at given states two conditions for a metric to make an observer converge: locally, and from any distance.

    The second condition fails where `bending` does not vanish; a geodesic then demonstrates it. With several outputs a
    vanishing bending decides nothing.

    The first condition requires that the metric contracts in directions that do not change the output; it suffices for
    local convergence. The second one requires that level sets of the output are totally geodesic, so that a larger gain
    helps far away. The states are samples: a failure refutes the metric, but success at all of them proves nothing
    between them.

    Args:
        model: the system, with its output h.
        metric: `x -> P (n, n)`, or `(t, x) -> P`, which is taken at t = 0.
        points: states (k, n), at least one.
        u: constant input (m,), zero by default.
        rate: rate [1/s]; the first condition holds if `detectability_rate` exceeds it at all points.
        budget: effort for the geodesic of the witness.

    Returns:
        A statement for each condition, and the witness. Both statements are undecided if f or h may jump between the
        points, since derivatives do not show jumps.

    Raises:
        ValueError: the metric is not finite or not positive definite at a point, the outputs are dependent, or there
            are no points.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant.certificates import observability
        >>> from covariant.models import StateSpace
        >>> model = StateSpace(lambda t, x, u: -x, lambda t, x, u: x[:1], coordinates=("a", "b"))
        >>> result = observability(model, lambda x: jnp.eye(2), np.zeros((1, 2)))
        >>> result.condition_1.margin, result.condition_2.verdict
        (2.0, 'holds')
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or not len(points):
        raise InputError(f"observability needs states `points` (k, n), at least one; got {points.shape}")
    field = _at_start(metric)
    _check_premises(model, field, points, u)
    sampled = _sample_conditions(model, metric, points, u)
    premises = (
        Hypothesis("the metric is positive definite at each of the points", "sampled"),
        _independence(model, points, u),
        *_show_smoothness(model, points, u),
        Hypothesis("what holds at the points holds between them", "assumed"),
        Hypothesis("it holds at other times, and under other inputs than the constant one given", "assumed"),
    )
    first = _contracting(sampled, rate, _describe_kernel(model, points, u), premises)
    if isinstance(metric, StateMetric) and metric.lift is not None and _sees_positions(model, points, u):
        return Observability(first, _straight_fibres(sampled, premises), None, None)
    states, outputs = _witness(model, field, sampled, u, budget) if sampled.bent else (None, None)
    single_output = jax.eval_shape(model.h, *_arguments(model, jnp.asarray(points[0]), u)).shape == (1,)
    verdict = "fails" if states is not None else "holds" if single_output and not sampled.bent else "undecided"
    return Observability(first, _totally_geodesic(sampled, verdict, single_output, premises), states, outputs)


class _Sampled(NamedTuple):
    """Both conditions at the points (k, n).

    Attributes:
        points: The states.
        rates: `detectability_rate` at each.
        bends: Largest principal curvature of the level sets of the output at each.
        roundings: What roundings can make of a curvature that is zero.
        directions: The directions (k, n) in which the level sets bend most.
        size: Largest distance of a point from their centre, to first order; infinite for a single point.
    """

    points: np.ndarray
    rates: np.ndarray
    bends: np.ndarray
    roundings: np.ndarray
    directions: np.ndarray
    size: float

    @property
    def domain(self) -> str:
        if len(self.points) == 1:
            return f"the state {_text(self.points[0])}"
        return f"{len(self.points)} states between {_text(self.points.min(0))} and {_text(self.points.max(0))}"

    @property
    def worst(self) -> int:
        """The point where the bending exceeds rounding most."""
        return int((self.bends - self.roundings).argmax())

    @property
    def bent(self) -> bool:
        bend = self.bends[self.worst]
        return bool(bend > self.roundings[self.worst] and bend * self.size > NO_OBSTACLE)


def _sample_conditions(model: StateSpace, metric: StateField, points: np.ndarray, u: Array | None) -> _Sampled:
    @eqx.filter_jit
    def conditions_at(x):
        return detectability_rate(model, metric, x, u), *bending(model, metric, x, u)

    values = jax.lax.map(conditions_at, jnp.asarray(points), batch_size=64)
    away = points - points.mean(axis=0)
    lengths = np.einsum("ki,ij,kj->k", away, np.asarray(_at_start(metric)(jnp.asarray(points.mean(axis=0)))), away)
    size = float(np.sqrt(lengths.max())) if lengths.max() > 0 else np.inf
    rates, bends, roundings, directions = (np.asarray(a) for a in values)
    sampled = _Sampled(points, rates, bends, roundings, directions, size)
    for name, numbers in (("contraction rate", sampled.rates), ("bending", sampled.bends)):
        if np.isnan(numbers).any():
            raise InputError(f"the {name} is not a number at {_text(points[int(np.isnan(numbers).argmax())])}")
    return sampled


def _contracting(sampled: _Sampled, rate: float, hidden: str, premises: tuple[Hypothesis, ...]) -> Statement:
    """The first condition."""
    k = int(sampled.rates.argmin())
    slowest, point = float(sampled.rates[k]), sampled.points[k]
    text = f"f contracts the hidden directions faster than {rate:.4g} 1/s at each of the points"
    contracts = Hypothesis(text, "sampled", "holds" if slowest > rate else "fails", slowest - rate, _text(point))
    claim = "f contracts the metric in the directions the output does not see, at the rate of the margin [1/s]"
    about = (f"states: {sampled.domain}", f"directions that the output does not see: {hidden}")
    return Statement(claim, about, (contracts, *premises), slowest, sampled.domain, tuple(point.tolist()))


def _totally_geodesic(
    sampled: _Sampled, verdict: Verdict, single_output: bool, premises: tuple[Hypothesis, ...]
) -> Statement:
    """The second condition."""
    largest, point = float(sampled.bends[sampled.worst]), sampled.points[sampled.worst]
    text = "the level sets of the output do not bend at any of the points"
    text += "" if single_output else "; of several outputs this is known of one at a time only"
    levels = Hypothesis(text, "sampled", verdict, largest, _text(point))
    claim = "level sets of the output are totally geodesic; the margin is their largest principal curvature"
    about, domain = (f"states: {sampled.domain}",), sampled.domain
    return Statement(claim, about, (levels, *premises), largest, domain, tuple(point.tolist()))


def _straight_fibres(sampled: _Sampled, premises: tuple[Hypothesis, ...]) -> Statement:
    """The second condition for the lift of a metric on configurations, with all configurations measured.

    Velocities at one configuration are a totally geodesic set in the lift, and a geodesic's shadow only turns: while it
    turns by less than a right angle, the distance of its configurations grows, whatever the number of outputs.
    """
    lift = "the metric is a lift, whose fibres, the level sets of the positions, are totally geodesic"
    turns = "along geodesics the position turns by less than π/2 and has one shortest path to where it began"
    hypotheses = (
        Hypothesis(lift, "proved"),
        Hypothesis("the output is the position at each of the points", "sampled"),
        Hypothesis(turns, "assumed"),
    )
    claim = (
        "level sets of the output are totally geodesic, and along geodesics that turn by less than π/2 the distance "
    )
    claim += "of the outputs grows"
    domain = f"{sampled.domain}, where geodesics turn by less than π/2"
    return Statement(claim, (f"states: {sampled.domain}",), (*hypotheses, *premises), 0.0, domain)


def _sees_positions(model: StateSpace, points: np.ndarray, u: Array | None) -> bool:
    """Whether the output is the first half of the state, at the points."""
    n = points.shape[1] // 2
    outputs = jax.lax.map(lambda x: model.h(*_arguments(model, x, u)), jnp.asarray(points))
    dh = jax.lax.map(lambda x: _differentiate_output(model, x, u), jnp.asarray(points))
    return np.array_equal(outputs, points[:, :n]) and np.array_equal(dh, np.broadcast_to(np.eye(n, 2 * n), dh.shape))


def _check_premises(model: StateSpace, metric: StateField, points: np.ndarray, u: Array | None) -> None:
    """Raise `ValueError` where outputs are dependent, or the metric is none, at one of the points."""

    @eqx.filter_jit
    def at(x):
        dh = _differentiate_output(model, x, u)
        return jnp.linalg.svd(dh, compute_uv=False), jnp.linalg.eigvalsh(metric(x))[0]

    sizes, least = (np.asarray(a) for a in jax.lax.map(at, jnp.asarray(points), batch_size=64))
    dependent = ~(sizes[:, -1] > DEPENDENT * sizes[:, 0])
    outputs = jax.eval_shape(model.h, *_arguments(model, jnp.asarray(points[0]), u)).shape[0]
    dependent |= outputs > points.shape[1]
    if dependent.any() and np.isfinite(sizes).all():
        k = int(dependent.argmax())
        rank = int((sizes[k] > DEPENDENT * sizes[k, 0]).sum())
        raise InputError(
            f"observability: dh has rank {rank} at {_text(points[k])}, below the number of outputs, {outputs}; leave "
            "out outputs that follow from others"
        )
    if not (least > 0).all():  # NaN is no metric either
        raise InputError(f"the metric is not positive definite at {_text(points[int((~(least > 0)).argmax())])}")


def _independence(model: StateSpace, points: np.ndarray, u: Array | None) -> Hypothesis:
    """State that the rows of dh are independent: proved between the points if a proof is found, otherwise sampled.

    The determinant of dh dhᵀ is the sum of the squares of all p × p minors of dh (Cauchy–Binet), so it is positive
    if and only if one of them does not vanish; different minors may serve at different points.
    """

    def products(x):
        dh = _differentiate_output(model, x, u)
        return dh @ dh.T

    names = _names(model, points.shape[1])
    hull = Box(names, model.units or ("",) * len(names), points.min(0), points.max(0))
    try:
        proved = prove(products, hull, boxes=RANK_BOXES).verdict == "holds"
    except LoweringError:  # an output that is no graph of scalars, like one that is read from a table
        proved = False
    if proved:
        return Hypothesis(f"the rows of dh are independent: dh dhᵀ is positive definite for {hull}", "proved")
    return Hypothesis("the rows of dh are independent at each of the points", "sampled")


def _show_smoothness(model: StateSpace, points: np.ndarray, u: Array | None) -> tuple[Hypothesis, ...]:
    """Show that f and h do not jump between the points."""
    t0, _, u0 = _arguments(model, jnp.asarray(points[0]), u)
    names = _names(model, points.shape[1])
    return tuple(
        premise
        for what, function in (("f", model.f), ("h", model.h))
        for premise in show_no_jumps(what, lambda x, function=function: function(t0, x, u0), (points,), names)
    )


def _describe_kernel(model: StateSpace, points: np.ndarray, u: Array | None) -> str:
    """The kernel of dh in words: the coordinates on which no output depends, and the number of further directions."""
    dh = np.asarray(jax.lax.map(lambda x: _differentiate_output(model, x, u), jnp.asarray(points)))
    unseen = (dh == 0).all((0, 1))
    names = np.array(_names(model, points.shape[1]))
    remaining = len(names) - dh.shape[1] - int(unseen.sum())
    parts = [*names[unseen], *([f"{remaining} among {', '.join(names[~unseen])}"] if remaining else [])]
    return ", ".join(parts) or "none"


def _names(model: StateSpace, n: int) -> tuple[str, ...]:
    return model.coordinates or tuple(f"x{k + 1}" for k in range(n))


def _at_start(metric: StateField) -> MatrixField:
    """The metric as a function of the state alone, at time zero."""
    timed = with_time(metric)
    return lambda x: timed(jnp.zeros((), x.dtype), x)


def _witness(
    model: StateSpace, metric: MatrixField, sampled: _Sampled, u: Array | None, budget: Budget
) -> tuple[np.ndarray, np.ndarray] | tuple[None, None]:
    """Three successive states on a geodesic that touches a level set, and their outputs, which return; or None."""
    k = sampled.worst
    x, radius = jnp.asarray(sampled.points[k]), sampled.directions[k] / sampled.bends[k]
    # Custom derivative rules of the metric are removed: with them, the geodesic would be that of another metric.
    with contextlib.suppress(LoweringError):
        metric = to_jax(lower(metric, x))

    @eqx.filter_jit
    def around(velocity):
        # Tangent to the level set, so that outputs of both ends differ little from each other, and more from that of x.
        ends = jax.vmap(lambda v: exp(metric, x, v, budget))(jnp.stack([-velocity, 0.9 * velocity]))
        states = jnp.stack([ends[0], x, ends[1]])
        return states, jax.vmap(lambda x: model.h(*_arguments(model, x, u)))(states)

    for k in range(1, 6):  # shorter and shorter fractions of the level set's radius of curvature
        states, outputs = map(np.asarray, around(jnp.asarray(10.0**-k * radius)))
        there, back = np.linalg.norm(outputs[1:] - outputs[0], axis=1)
        if np.isfinite(states).all() and there - back > VIOLATES * there:
            return states, outputs
    return None, None


def _directions(model: StateSpace, x: Vector, u: Array | None) -> tuple[Float[Array, "n k"], Float[Array, "p n"]]:
    """A basis of the kernel of dh, and dh."""
    dh = _differentiate_output(model, x, u)
    # In the complete QR of dhᵀ the first columns span its range; the others span the kernel of dh.
    return jnp.linalg.qr(dh.T, mode="complete")[0][:, dh.shape[0] :], dh


def _differentiate_output(model: StateSpace, x: Vector, u: Array | None) -> Float[Array, "p n"]:
    """dh, the derivative of the output by the state."""
    t0, _, u0 = _arguments(model, x, u)
    return jacobian(lambda y: model.h(t0, y, u0), x)


def _arguments(model: StateSpace, x: Vector, u: Array | None) -> tuple[Scalar, Vector, Array]:
    """Arguments of f and h at time zero, with a zero input if none is given."""
    return jnp.zeros((), x.dtype), x, jnp.zeros(model.inputs, x.dtype) if u is None else u


def _text(x: np.ndarray) -> str:
    return f"({', '.join(f'{entry:.3g}' for entry in x)})"
