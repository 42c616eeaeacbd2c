"""Designs observers that converge from any distance, since level sets of the outputs are flat in a constant metric.

The outputs y are some of the states, and z are the others. In the coordinates (y, w), with `w = z − Ly`, let the metric
be `diag(p I, P)`. Its geodesics are straight lines, and so are the level sets of y: they are totally geodesic, which is
the second condition. The first one, that f contracts the vectors that do not change y, is

    −(P A + AᵀP) − rate P > 0,  A = ∂f_z/∂z − L ∂f_y/∂z,

the matrix inequality of an observer gain L for the pair (∂f_z/∂z, ∂f_y/∂z). On a box, which is convex, it ensures that

- the reduced-order observer `ŵ' = f_z(y, ẑ) − L f_y(y, ẑ)`, `ẑ = ŵ + Ly`, converges from any distance in the box, and
  from everywhere if A does not depend on z: for each motion y(t) it contracts in P;
- the full observer `x̂' = f(x̂) + k [I; L] (y − ŷ)` contracts in `diag(p I, P)` for all k above a threshold.

If f has at some point a vector v with `∂f_y/∂z v = 0` and `∂f_z/∂z v = λ v`, λ ≥ −rate/2, then no L and P exist, not
even an L that depends on the point: vᵀ(PA + AᵀP)v = 2λ vᵀPv.

Source: Sanfelice & Praly 2015, section I; Sanfelice & Praly 2012 and 2016, Convergence of nonlinear observers on Rⁿ
with a Riemannian metric, parts I and II, IEEE TAC 57(7) and 61(10); own derivation of the above for constant P.
"""

import contextlib
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import FINITE, Count, NotNegative, Positive, check_numbers
from covariant.certificates.base import Hypothesis, Statement
from covariant.certificates.theory._lmi import observer_gain
from covariant.models import StateSpace
from scalargraph import Lowered, enclose, lower
from scalargraph.errors import InputError
from scalargraph.proofs import MOST_BOXES, Box, Form, Proof, derivative_form, prove

CORNERS = 10
"""Largest number of variables for which all corners of the box are tried; otherwise, and in addition, random states."""
TRIED = 64
"""Number of random states at which the inequality is solved first."""
MARGINS = (0.3, 0.1, 1e-2, 1e-4, 1e-6)
"""Fractions of the largest Jacobian that are added to the rate for the solver: larger ones make the proof easier."""
ROUNDS = 8
"""Number of counterexamples that are added, one per proof, before the design is given up."""
CLOSE = 1e-9
"""Tolerance, relative to the Jacobians, for samples that show a vector to be an eigenvector or not to change y."""
RAISES = 6
"""Number of doublings of the full observer's gain if its first value, from the samples, is not proved."""


class ReducedOrderDesign(NamedTuple):
    """A reduced-order observer and the results on its convergence.

    Attributes:
        model: the system.
        measured: indices (p,) of the states that are measured, in the order of the outputs.
        unmeasured: indices (n − p,) of the other states.
        injection: L (n − p, p); None if there is none.
        metric: P (n − p, n − p); None if there is none.
        everywhere: whether the inequality does not depend on unmeasured states, so that estimates may be anywhere.
        statement: the statement that the reduced-order observer contracts in P, or the reason why none does.
        gain: proved gain k [1/s] of the full observer `x̂' = f + k [I; L] (y − ŷ)`; None if none is proved.
        weights: p (p,), the metric of the measured states besides P in the full observer; None if it was not tried.
        full: the statement that the full observer contracts in the box; None if it was not tried.

    Example:
        >>> from covariant import certificates, models
        >>> design = certificates.reduced_order(models.lorenz(), rate=1.0)
        >>> design.statement.short, design.everywhere, design.injection.shape
        ('holds (proved)', True, (2, 1))
    """

    model: StateSpace
    measured: tuple[int, ...]
    unmeasured: tuple[int, ...]
    injection: Float[np.ndarray, "m p"] | None
    metric: Float[np.ndarray, "m m"] | None
    everywhere: bool
    statement: Statement
    gain: float | None = None
    weights: Float[np.ndarray, "p"] | None = None
    full: Statement | None = None

    @property
    def direction(self) -> Float[np.ndarray, "n p"]:
        """[I; L] (n, p) in the order of the states: how a difference of the outputs corrects them."""
        if self.injection is None:
            raise InputError(f"there is no reduced-order observer: {self.statement.claim} {self.statement.short}")
        both = np.zeros((len(self.measured) + len(self.unmeasured), len(self.measured)))
        both[list(self.measured)], both[list(self.unmeasured)] = np.eye(len(self.measured)), self.injection
        return both


@check_numbers
def reduced_order(
    model: StateSpace,
    rate: Positive,
    *,
    box: Annotated[Sequence[tuple[float, float]], FINITE] | None = None,
    inputs: Annotated[Sequence[tuple[float, float]], FINITE] | None = None,
    effort: NotNegative = 1e-3,
    full: bool = False,
    boxes: Count = MOST_BOXES,
) -> ReducedOrderDesign:
    """Design an observer that converges from any distance, and prove that it does. Needs `covariant[lmi]`.

    The inequality is solved at corners of the box and at random states, and then proved on the whole box; a
    counterexample is added to the states.

    Args:
        model: system with a box, whose outputs are some of its states, and which does not depend on time.
        rate: rate [1/s] at which squared distances decrease, positive.
        box: bounds of each state, those of the model by default.
        inputs: bounds of each input; zero by default.
        effort: weight of the injection relative to the condition number of P.
        full: find a gain of the full observer as well, for half of the rate.
        boxes: boxes after which a proof is given up.

    Returns:
        The design. Its statement fails if a state in the box shows that no such observer exists.

    Raises:
        ValueError: the outputs are not states, all states are measured, the model depends on time or has no box, a
            bound or the rate is out of range, or neither a design nor a reason against it was found.
        ImportError: the solver clarabel is missing.

    Example:
        >>> from covariant import certificates, models
        >>> frequency = models.unknown_frequency()
        >>> print(certificates.reduced_order(frequency, rate=0.1).statement.short)  # x1 = 0 shows nothing of ω²
        fails
        >>> seen = [(0.5, 1.0), (1.0, 1.5), (0.5, 1.5)]
        >>> certificates.reduced_order(frequency, rate=0.1, box=seen).statement.short
        'holds (proved)'
    """
    split = _Split.of(model, box, inputs)
    # The entries on which the inequality, and the conditions for f to be defined without jumps, depend.
    used = split.used()
    everywhere, domain = used.isdisjoint(split.unmeasured), split.domain(used)
    points = _starts(domain)
    for _ in range(ROUNDS):
        slopes = split.slopes(points)
        found = _solved(slopes, split, rate, effort)
        if found is None:
            return _impossible(split, points, slopes, rate)
        injection, metric = found
        proof = prove(split.inequality(injection, metric, rate), domain, boxes=boxes)
        if proof.verdict != "fails" or proof.counterexample is None:
            break
        points = [*points, proof.counterexample.mean(axis=0)]
    else:
        raise InputError(f"reduced_order: after {ROUNDS} counterexamples there is still one; make the box smaller")
    statement = _statement(split, injection, metric, rate, proof, everywhere)
    design = ReducedOrderDesign(model, split.measured, split.unmeasured, injection, metric, everywhere, statement)
    return _with_gain(design, split, points, rate / 2, boxes) if full and statement.verdict == "holds" else design


class _Split(NamedTuple):
    """A model with its states in two parts, and the variables of a proof, which are states and inputs."""

    model: StateSpace
    f: Callable[[Array, Array, Array], Array]
    measured: tuple[int, ...]
    unmeasured: tuple[int, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, model: StateSpace, box: Sequence | None, inputs: Sequence | None) -> "_Split":
        n = len(model.coordinates)
        if not n:
            raise InputError("reduced_order: the model has no names of its states; give its coordinates")
        sides = np.asarray(model.box if box is None else box, float)
        if sides.shape != (n, 2):
            raise InputError(f"reduced_order: box must have bounds for each of {n} states; its shape is {sides.shape}")
        given = np.zeros((model.inputs, 2)) if inputs is None else np.asarray(inputs, float).reshape(-1, 2)
        if given.shape != (model.inputs, 2):
            raise InputError(f"reduced_order: inputs must have bounds for each of {model.inputs}; got {given.shape[0]}")
        bounds = np.concatenate([sides, given])
        if not np.isfinite(bounds).all() or (bounds[:, 0] > bounds[:, 1]).any():
            raise InputError("reduced_order: bounds must be finite, the lower one first")
        f = jax.jit(model.f)  # traced once, so that all graphs are of one function, even where f changes with each call
        x, u = jnp.asarray(sides.mean(axis=1)), jnp.asarray(given.mean(axis=1))
        outputs = lower(model.h, jnp.zeros(()), x, u)
        read = [outputs.graph.nodes[i] for i in outputs.outputs]
        # Inputs of the graph are the time, the states, and the inputs of the model.
        at = [int(node.value) - 1 if node.op == "input" and node.value is not None else -1 for node in read]
        if not all(0 <= i < n for i in at) or len(set(at)) < len(at):
            raise InputError("reduced_order: each output must be a state of its own; change the coordinates")
        if 0 in _inputs_of(lower(f, jnp.zeros(()), x, u)):
            raise InputError("reduced_order: the model depends on time; give a system that does not")
        rest = tuple(i for i in range(n) if i not in at)
        if not rest:
            raise InputError("reduced_order: all states are measured; there is nothing to estimate")
        names = (*model.coordinates, *(f"u{i + 1}" for i in range(model.inputs)))
        units = (*("" if unit == "1" else unit for unit in model.units or ("",) * n), *("",) * model.inputs)
        return cls(model, f, tuple(at), rest, names, units, bounds[:, 0], bounds[:, 1])

    @property
    def n(self) -> int:
        return len(self.measured) + len(self.unmeasured)

    @property
    def motion(self) -> str:
        """The box of true motions, in words."""
        return f"true motions: {Box(self.names, self.units, self.low, self.high)}"

    @property
    def scales(self) -> tuple[np.ndarray, np.ndarray]:
        """Half widths of the box of measured and of unmeasured states, as units for the solver."""
        half = (self.high - self.low)[: self.n] / 2
        half = np.where(half > 0, half, 1.0)
        return half[list(self.measured)], half[list(self.unmeasured)]

    def derivatives(self, points: Sequence[np.ndarray]) -> np.ndarray:
        """Derivatives (k, n, n) of f by the states, for searches and samples."""
        return self.form(lambda slope: slope, range(self.n)).at(np.stack(points))

    def slopes(self, points: Sequence[np.ndarray]) -> np.ndarray:
        """Derivatives (k, n, n − p) of f by the unmeasured states, with their rows first, in units of `scales`."""
        y, z = self.scales
        slopes = self.derivatives(points)[:, :, list(self.unmeasured)]
        ordered = slopes[:, [*self.unmeasured, *self.measured]]
        return ordered * z[None, None, :] / np.concatenate([z, y])[None, :, None]

    def form(self, formula: Callable[[Array], Array], columns: Sequence[int]) -> Form:
        """Build the form of an expression in ∂f/∂x, for some states, from the graph of f, as JAX does not see jumps."""

        def values(t, x, z):
            return (self.f(t, x, z[self.n :]),)

        def parts(derivatives, nodes, count):
            return (derivatives.each(nodes[0], [1 + i for i in columns]),)

        return derivative_form(values, lambda z: z[: self.n], parts, formula)

    def inequality(self, injection: np.ndarray, metric: np.ndarray, rate: float) -> Form:
        """The inequality for L and P."""
        gain, p = jnp.asarray(injection), jnp.asarray(metric)

        def matrix(slope):
            product = p @ (slope[jnp.array(self.unmeasured)] - gain @ slope[jnp.array(self.measured)])
            return -(product + product.T) - rate * p

        return self.form(matrix, self.unmeasured)

    def used(self) -> set[int]:
        """The variables that affect the derivatives by unmeasured states, or whether f is defined and does not jump."""
        formed = self.form(lambda slope: slope, self.unmeasured).graph(jnp.asarray((self.low + self.high) / 2))
        noted = formed.conditions
        needed = noted.graph.pruned([condition.node for condition in noted.conditions])[0].nodes
        in_conditions = {int(node.value) for node in needed if node.op == "input" and node.value is not None}
        return {i for i in _inputs_of(formed.entries) | in_conditions if i < len(self.low)}

    def domain(self, used: set[int]) -> Box:
        """The box of these variables; all others are fixed at their midpoint, since nothing depends on them."""
        middle, chosen = (self.low + self.high) / 2, np.isin(np.arange(len(self.low)), sorted(used))
        return Box(self.names, self.units, np.where(chosen, self.low, middle), np.where(chosen, self.high, middle))


def _inputs_of(lowered: Lowered) -> set[int]:
    nodes = lowered.graph.pruned(lowered.outputs)[0].nodes
    return {int(node.value) for node in nodes if node.op == "input" and node.value is not None}


def _starts(domain: Box) -> list[np.ndarray]:
    """Corners of the free variables, and random states."""
    free = np.flatnonzero(domain.low < domain.high)
    random = np.random.default_rng(0)
    points = list(random.uniform(domain.low, domain.high, (TRIED, len(domain.low))))
    if len(free) <= CORNERS:
        for ends in itertools.product((0, 1), repeat=len(free)):
            corner = domain.low.copy()
            corner[free] = np.where(ends, domain.high[free], domain.low[free])
            points.append(corner)
    return points


def _solved(slopes: np.ndarray, split: _Split, rate: float, effort: float) -> tuple[np.ndarray, np.ndarray] | None:
    """L and P in the units of the states, or None if the solver finds none."""
    m = len(split.unmeasured)
    size = max(float(np.linalg.norm(s[:m], 2)) for s in slopes)
    f, h = slopes[:, :m], slopes[:, m:]
    y, z = split.scales
    for margin in MARGINS:
        with contextlib.suppress(InputError):
            found = observer_gain(f, h, rate + margin * size, effort=effort)
            return found.gain * z[:, None] / y[None, :], found.metric / np.outer(z, z)
    return None


def _statement(
    split: _Split, injection: np.ndarray, metric: np.ndarray, rate: float, proof: Proof, everywhere: bool
) -> Statement:
    where = "anywhere" if everywhere else "in the box"
    claim = "squared distances of the reduced-order observer to the states that are not measured shrink at "
    claim += f"{rate:g} 1/s"
    hypotheses = (
        Hypothesis("f contracts the vectors that do not change the outputs, in the metric P", "proved", proof.verdict),
        Hypothesis("level sets of the outputs are totally geodesic: outputs are coordinates, P is constant", "proved"),
        Hypothesis(f"the motion stays in the box; estimates may be {where}", "assumed"),
        Hypothesis("the output is known at all times, and without noise", "assumed"),
    )
    matrices = f"L = {injection.tolist()}", f"P = {metric.tolist()}"
    about = (*matrices, f"w = z - Ly, {_describe_split(split)}", split.motion)
    return Statement(claim, about, hypotheses, rate, str(proof.box.free))


def _describe_split(split: _Split) -> str:
    y, z = (", ".join(split.names[i] for i in part) for part in (split.measured, split.unmeasured))
    return f"y = ({y}), z = ({z})"


def _impossible(split: _Split, points: Sequence[np.ndarray], slopes: np.ndarray, rate: float) -> ReducedOrderDesign:
    """A design that states that no observer exists, with the state and direction that show it."""
    m = len(split.unmeasured)
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for point, slope in zip(points, slopes, strict=True):
        values, vectors = np.linalg.eig(slope[:m])
        size = CLOSE * max(np.abs(slope).max(), rate)
        for value, vector in zip(values, vectors.T, strict=True):
            if abs(value.imag) > size or np.abs(vector.imag).max() > CLOSE:
                continue
            if np.abs(slope[m:] @ vector.real).max() > size or value.real < -rate / 2:
                continue
            if best is None or value.real > best[0]:
                best = float(value.real), point, vector.real
    if best is None:
        raise InputError(
            f"no constant injection and metric make a reduced-order observer contract at {rate:g} 1/s at the "
            f"{len(points)} states that were tried, and none of them shows why; lower the rate or make the box smaller"
        )
    value, point, direction = best
    direction = direction * split.scales[1]
    direction = direction / direction[np.argmax(np.abs(direction))]
    at = ", ".join(f"{name} = {x:.4g}" for name, x in zip(split.names, point.tolist(), strict=True))
    along = ", ".join(f"{split.names[i]}: {x:.3g}" for i, x in zip(split.unmeasured, direction.tolist(), strict=True))
    evidence = "proved" if _is_exact(split, point, direction, value) else "sampled"
    text = "f contracts the vectors that do not change the outputs"
    reason = Hypothesis(text, evidence, "fails", value, f"{at}, along ({along})")
    claim = f"squared distances of some reduced-order observer with a constant metric shrink at {rate:g} 1/s"
    grows = "along that direction the outputs do not change, and it grows at its margin [1/s]"
    about = (_describe_split(split), grows, split.motion)
    statement = Statement(claim, about, (reason,), value, str(split.domain(split.used()).free), tuple(point.tolist()))
    return ReducedOrderDesign(split.model, split.measured, split.unmeasured, None, None, False, statement)


def _is_exact(split: _Split, point: np.ndarray, direction: np.ndarray, value: float) -> bool:
    """Whether outward-rounded arithmetic shows exactly that the direction is an eigenvector and does not change y."""
    along = jnp.asarray(direction)

    def residual(slope):
        moved = slope @ along
        return jnp.concatenate([moved[jnp.array(split.measured)], moved[jnp.array(split.unmeasured)] - value * along])

    formed = split.form(residual, split.unmeasured).graph(jnp.asarray(point))
    found = enclose(formed.entries, point[None], point[None])
    return bool((found.low == 0).all() and (found.high == 0).all())


def _with_gain(
    design: ReducedOrderDesign, split: _Split, points: Sequence[np.ndarray], rate: float, boxes: int
) -> ReducedOrderDesign:
    """The design with a gain of the full observer, proved on the whole box in a metric diag(p I, P)."""
    assert design.injection is not None
    assert design.metric is not None
    injection, metric = design.injection, design.metric
    whole = Box(split.names, split.units, split.low, split.high)
    y, z = list(split.measured), list(split.unmeasured)

    def blocks(slope):
        """Derivatives of f by (y, w), from the derivatives by the state."""
        s, p = slope[jnp.array(y)], slope[jnp.array(z)]
        shear = jnp.asarray(injection)
        of_y, of_z = s[:, jnp.array(y)] + s[:, jnp.array(z)] @ shear, s[:, jnp.array(z)]
        below, kept = p[:, jnp.array(y)] + p[:, jnp.array(z)] @ shear, p[:, jnp.array(z)]
        return of_y, of_z, below - shear @ of_y, kept - shear @ of_z

    def matrix(k, weights):
        weight = jnp.diag(jnp.asarray(weights))

        def whole_matrix(slope):
            a, b, c, d = blocks(slope)
            upper = weight @ (k * jnp.eye(len(y)) - a)
            cross = -(weight @ b) - c.T @ jnp.asarray(metric)
            lower_ = -jnp.asarray(metric) @ d
            one = jnp.concatenate([upper + upper.T - rate * weight, cross], axis=1)
            two = jnp.concatenate([cross.T, lower_ + lower_.T - rate * jnp.asarray(metric)], axis=1)
            return jnp.concatenate([one, two])

        return split.form(whole_matrix, range(split.n))

    points = [*points, *np.random.default_rng(1).uniform(split.low, split.high, (TRIED, len(split.low)))]
    parts = [tuple(map(np.asarray, blocks(slope))) for slope in split.derivatives(points)]
    k, weights = _least_gain(parts, split, metric, rate)
    proof = prove(matrix(k, weights), whole, boxes=boxes)
    for _ in range(RAISES):
        if proof.verdict == "holds":
            break
        k *= 2
        proof = prove(matrix(k, weights), whole, boxes=boxes)
    premises = (
        Hypothesis("f - k [I; L] (y - h) contracts in diag(p, P)", "proved", proof.verdict),
        Hypothesis("the motion and the estimate stay in the box", "assumed"),
        Hypothesis("the output is known at all times, and without noise", "assumed"),
    )
    gain = f"for the gain k = {k:.6g} 1/s and larger ones"
    claim = f"squared distances of the full observer shrink at {rate:g} 1/s, {gain}"
    full = Statement(claim, (f"p = {weights.tolist()}",), premises, k, str(whole.free))
    return design._replace(gain=k if full.proved else None, weights=weights, full=full)


def _least_gain(
    blocks: Sequence[tuple[np.ndarray, ...]], split: _Split, metric: np.ndarray, rate: float
) -> tuple[float, np.ndarray]:
    """Least k at the samples, and the weights p of the outputs, divided by their common size."""
    scale = split.scales[0]
    best: tuple[float, np.ndarray] = (math.inf, np.ones(len(scale)))
    for size in np.geomspace(1e-4, 1e8, 61) * float(np.trace(metric * np.outer(split.scales[1], split.scales[1]))):
        weights = size / scale**2
        root = np.diag(1 / np.sqrt(weights))
        least = -math.inf
        for a, b, c, d in blocks:
            lower_ = -metric @ d
            lower_ = lower_ + lower_.T - rate * metric
            cross = np.diag(weights) @ b + c.T @ metric
            product = np.diag(weights) @ a
            need = root @ (product + product.T + cross @ np.linalg.solve(lower_, cross.T)) @ root
            least = max(least, float(np.linalg.eigvalsh(need + rate * np.eye(len(a)))[-1]) / 2)
        if least < best[0]:
            best = least, weights
    return 1.05 * max(best[0], rate), best[1]
