"""Tests whether a controller that uses the estimate of an observer is exponentially stable.

The error e of the controlled plant obeys `e' = a(e, t) + b(e, x̃, t)`, where b vanishes with the observer's error x̃.
With `c1|e|² ≤ V_con ≤ c2|e|²`, `V_con' ≤ −c3|e|²` along a, `|∂V_con/∂e| ≤ c4|e|`, `V_obs' ≤ −λ_q|x̃|²` and
`|b| ≤ γ1|x̃| + γ2|e|`, Theorem 3 requires γ1² < 4(c3 − c4γ2)λ_q/c4². This condition depends on units, since its
function
V_con + V_obs adds quantities of different units. With V_con + κV_obs and a large κ, γ2 < c3/c4 suffices.

Source: Jouffroy & Fossen 2004, Theorem 3, equations (64)–(79).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import Count, Positive, Whole, check_numbers
from covariant.certificates.base import (
    ErrorSystem,
    Evidence,
    Hypothesis,
    Statement,
    Verdict,
    length_change,
    lines as list_of,
    need_steady,
)
from covariant.certificates.theory._falsify import Pencil, pencil, slowest
from scalargraph import jacobian
from scalargraph.errors import InputError
from scalargraph.proofs import MOST_BOXES, Box, Form, as_form, check_box, prove

Coupling = Callable[[Array], tuple[Array, Array]]
"""`z -> (∂b/∂x̃ (n, k), ∂b/∂e (n, n))`, as a function of variables z in a box."""

UNITS: Mapping[str, tuple[tuple[str, float], ...]] = {
    "kg": (("g", 1e3), ("t", 1e-3), ("Mt", 1e-9)),
    "m": (("mm", 1e3), ("km", 1e-3)),
    "rad": (("deg", 180 / math.pi),),
    "s": (("ms", 1e3), ("h", 1 / 3600)),
}
"""Other units in which the printed condition is tried: their names, and how many of them are one SI unit."""


class Constants(NamedTuple):
    """The constants of Theorem 3 over a set.

    Attributes:
        c1, c2, c4: bounds of V_con: `c1|e|² ≤ V_con ≤ c2|e|²`, `|∂V_con/∂e| ≤ c4|e|`.
        c3: decay of V_con along the controlled plant, `V_con' ≤ −c3|e|²`.
        lambda_q: decay of V_obs, `V_obs' ≤ −λ_q|x̃|²`; both decays are in units of their V per second.
        gamma1, gamma2: growth of the coupling with x̃ and with e, `|b| ≤ γ1|x̃| + γ2|e|`.
        m1: the least eigenvalue of M in `V_obs = x̃ᵀMx̃`.

    Example:
        >>> from covariant.certificates.theory import Constants
        >>> constants = Constants(c1=0.5, c2=0.5, c3=1.0, c4=1.0, lambda_q=2.0, gamma1=3.0, gamma2=0.0, m1=1.0)
        >>> constants.printed, constants.weighted, constants.kappa
        (False, True, 1.125)
    """

    c1: float
    c2: float
    c3: float
    c4: float
    lambda_q: float
    gamma1: float
    gamma2: float
    m1: float

    @property
    def positive(self) -> bool:
        """Whether V_con and V_obs are positive definite; otherwise their decay does not show that errors vanish."""
        return self.c1 > 0 and self.m1 > 0

    @check_numbers
    def with_mass(self, factor: Positive) -> "Constants":
        """Convert the constants to a unit of mass in which V_con, an energy, has another numerical value.

        Args:
            factor: the numerical value in the new unit divided by the value in the present one.
        """
        energies = {name: factor * getattr(self, name) for name in ("c1", "c2", "c3", "c4")}
        return self._replace(**energies)

    @property
    def bound(self) -> float:
        """The upper bound of γ1² as printed, `4(c3 − c4γ2)λ_q/c4²`; −∞ if V_con has no gradient."""
        if not self.c4 > 0:
            return -math.inf
        # The condition for κ = 1 below, that is, for V_con + V_obs itself; c4 has the unit of V_con, λ_q has not.
        return 4 * (self.c3 - self.c4 * self.gamma2) * self.lambda_q / self.c4**2

    @property
    def printed(self) -> bool:
        """Whether condition (72) holds as printed."""
        small = self.positive and self.lambda_q > 0 and self.gamma2 < self.c3 / self.c4 and self.gamma1**2 < self.bound
        return bool(small)

    @property
    def weighted(self) -> bool:
        """Whether the weaker condition for `V_con + κV_obs` holds."""
        decay = self.positive and self.lambda_q > 0 and self.c3 > 0 and self.gamma2 < self.c3 / self.c4
        return bool(decay and math.isfinite(self.gamma1))

    @property
    def kappa(self) -> float:
        """The lower bound of the κ for which `V_con + κV_obs` decreases; infinite if there is no such κ."""
        if not self.weighted:
            return math.inf
        # V' ≤ −(c3 − c4γ2)|e|² + c4γ1|e||x̃| − κλ_q|x̃|² is negative if and only if its discriminant is negative.
        return (self.c4 * self.gamma1) ** 2 / (4 * self.lambda_q * (self.c3 - self.c4 * self.gamma2))


class Growth(NamedTuple):
    """A growing solution of the observer's error system, linearised and frozen at its worst point.

    Attributes:
        t, error: the solution (T, k) at stamps (T,) [s].
        rate: rate of growth [1/s].
        point: values of the variables of the box, by name.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates.theory import Growth
        >>> growth = Growth(np.zeros(3), np.ones((3, 1)), 2.0, {"x": 1.0})  # usually in a `CascadeCertificate`
        >>> growth.rate, growth.point
        (2.0, {'x': 1.0})
    """

    t: Float[np.ndarray, "T"]
    error: Float[np.ndarray, "T k"]
    rate: float
    point: dict[str, float]


class CascadeCertificate(NamedTuple):
    """Result on the exponential stability of a cascade over a set, by the printed and by the weighted condition.

    Attributes:
        statement: "holds" if the weighted condition holds, "fails" if the observer's error can grow, otherwise
            "undecided", since the conditions are only sufficient; each condition is a hypothesis.
        printed, units: whether (72) holds in the units of the problem, and whether it holds in others, by name.
        constants: the constants of Theorem 3.
        growth: a solution along which the observer's error grows, or None.

    Example:
        >>> from covariant.certificates import CascadeCertificate, Hypothesis, Statement
        >>> from covariant.certificates.theory import Constants
        >>> constants = Constants(0.5, 0.5, 1.0, 1.0, 2.0, 3.0, 0.0, 1.0)
        >>> statement = Statement("it is stable", (), (Hypothesis("c3 > 0", "sampled"),), 2.0)
        >>> result = CascadeCertificate(statement, False, constants, {"g": True}, None)  # usually from `cascade`
        >>> result.verdict, result.depends_on_units, result.kappa
        ('holds', True, 1.125)
    """

    statement: Statement
    printed: bool
    constants: Constants
    units: dict[str, bool]
    growth: Growth | None

    @property
    def verdict(self) -> Verdict:
        """The verdict of the statement."""
        return self.statement.verdict

    @property
    def evidence(self) -> Evidence:
        """The evidence of the statement: "proved" or "sampled"."""
        return self.statement.evidence

    @property
    def depends_on_units(self) -> bool:
        """Whether (72) as printed holds in some of the units and fails in others."""
        return len({self.printed, *self.units.values()}) > 1

    @property
    def kappa(self) -> float:
        """The lower bound of the weights κ for which `V_con + κV_obs` decreases."""
        return self.constants.kappa

    def __str__(self) -> str:
        c = self.constants
        lines = [
            f"cascade: {self.statement.short}, with weight κ > {c.kappa:.4g} on V_obs",
            f"c1 = {c.c1:.5g}, c2 = {c.c2:.5g}, c3 = {c.c3:.5g}, c4 = {c.c4:.5g}, λ_q = {c.lambda_q:.5g}, "
            f"γ1 = {c.gamma1:.5g}, γ2 = {c.gamma2:.5g}, m1 = {c.m1:.5g}",
            f"(72) as printed: γ1² = {c.gamma1**2:.5g} {'<' if c.printed else 'is not below'} {c.bound:.5g}",
        ]
        if self.depends_on_units:
            verdicts = ", ".join(f"{name}: {'holds' if ok else 'fails'}" for name, ok in self.units.items())
            lines.append(f"warning: (72) as printed depends on units; {verdicts}")
        if self.growth is not None:
            lines.append(f"the observer's error can grow at {self.growth.rate:.4g} 1/s")
        return "\n".join([*lines, "hypotheses:", *list_of(self.statement.hypotheses), f"over {self.statement.domain}"])


@check_numbers
def cascade(
    controller: tuple[ErrorSystem, Box],
    observer: tuple[ErrorSystem, Box],
    coupling: tuple[Coupling, Box],
    *,
    units: tuple[Sequence[str], Sequence[str]] | None = None,
    proved: bool = False,
    attempts: Count = 20_000,
    starts: Whole = 64,
    boxes: Count = MOST_BOXES,
    seed: Whole = 0,
) -> CascadeCertificate:
    """Compute the constants of Theorem 3 over a set, and the verdicts of both conditions.

    All constants come from Jacobians, so they hold for finite errors within the boxes, by the mean-value theorem.

    Use it to show that a controller that is stable with the true state stays stable with the estimate of an observer.
    The constants depend on the units of the states, and with `proved=False` they are sampled. The result is
    conservative: if the condition fails, the loop may still be stable.

    Args:
        controller: the system `e' = a(e, t)` with the metric P of `V_con = ½eᵀPe`, and the box of its variables.
        observer: its virtual system with the metric M of `V_obs = x̃ᵀMx̃`, as from `virtual`, and a box.
        coupling: Jacobians of b by x̃ and by e, and a box.
        units: units of the entries of e and of x̃, such as "m" or "rad/s". With them, (72) is also tried in other
            units, changing one unit at a time. V_con counts as an energy, whose unit contains mass; V_obs has no mass
            in its unit.
        proved: whether to prove every constant instead of sampling it, with a margin of 2 %; a constant that cannot be
            proved with `boxes` boxes leaves the verdict "undecided".
        attempts, starts: number of random points for each sampled constant, and of descents from the worst ones.
        boxes: largest number of boxes for each proof.
        seed: seed of the random numbers.

    Returns:
        The statement with its constants.

    Raises:
        ValueError: bounds are not in order, boxes have different bounds for one variable, or a flow depends on time.

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> from covariant.certificates import cascade, virtual
        >>> from scalargraph.proofs import box
        >>> model = models.StateSpace(lambda t, x, u: -x, lambda t, x, u: x, coordinates=("x",))
        >>> system = virtual(observers.Contracting(model, jnp.eye(1), jnp.zeros(1)), np.eye(1))
        >>> part = system, box(x=(-1.0, 1.0), z_y1=(-1.0, 1.0), zdot_y1=(0.0, 0.0))  # serves as plant and as observer
        >>> coupling = lambda z: (z[:, None], jnp.zeros((1, 1))), box(k=(0.0, 1.0))
        >>> result = cascade(part, part, coupling, attempts=100, starts=4)
        >>> result.statement.short, round(result.constants.gamma1, 6)
        ('holds (sampled)', 1.0)
    """
    _check_same_bounds(controller[1], observer[1], coupling[1])
    for error_system, domain in (controller, observer):
        need_steady("cascade", error_system, domain)
    _check_sizes(controller, observer, coupling)
    search = _Search(attempts, starts, seed, proved, boxes)
    forms = _forms(controller, observer, coupling)
    ones = tuple(np.ones(size) for size in _sizes(coupling))
    constants, worst = _constants(forms, ones, search)
    other_units, short_search = {}, search._replace(attempts=min(attempts, 2000), starts=min(starts, 16), proved=False)
    for name, scales, mass in _scales(*units) if units is not None else ():
        converted = constants if mass != 1 else _constants(forms, scales, short_search)[0]
        other_units[name] = converted.with_mass(mass).printed
    growth = None if constants.lambda_q > 0 else _growth(*observer, worst)
    domain = "; ".join(str(box.free) for box in (controller[1], observer[1], coupling[1]))
    statement = _statement(constants, growth, "proved" if proved else "sampled", domain)
    return CascadeCertificate(statement, constants.printed, constants, other_units, growth)


def _statement(c: Constants, growth: Growth | None, evidence: Evidence, domain: str) -> Statement:
    """The conditions of the weighted theorem as hypotheses; only a growing error refutes the statement."""

    def premise(text: str, margin: float) -> Hypothesis:
        verdict = "holds" if margin > 0 else "undecided"
        return Hypothesis(text, evidence, verdict, margin if math.isfinite(margin) else None)

    shrinks = premise("the observer's error shrinks, λ_q > 0", c.lambda_q)
    if growth is not None:
        point = ", ".join(f"{name} = {value:.4g}" for name, value in growth.point.items())
        shrinks = Hypothesis(shrinks.text, "sampled", "fails", c.lambda_q, point)
    bounded = "holds" if math.isfinite(c.gamma1) else "undecided"
    surplus = c.c3 / c.c4 - c.gamma2 if c.c4 > 0 else -math.inf
    hypotheses = (
        premise("V_con is positive definite, c1 > 0", c.c1),
        premise("V_obs is positive definite, m1 > 0", c.m1),
        premise("the controlled plant alone is stable, c3 > 0", c.c3),
        shrinks,
        premise("the coupling grows with e less than the plant decays, γ2 < c3/c4", surplus),
        Hypothesis("the coupling with the observer's error is bounded, γ1", evidence, bounded),
        Hypothesis("the errors stay within the boxes", "assumed"),
        Hypothesis("controller, observer and coupling are those of one plant", "assumed"),
    )
    claim = "plant and observer together are exponentially stable"
    data = ("constants of Theorem 3: " + ", ".join(f"{name} = {value:.5g}" for name, value in c._asdict().items()),)
    return Statement(claim, (*data, f"boxes: {domain}"), hypotheses, c.lambda_q, domain)


def _check_same_bounds(*boxes: Box) -> None:
    """Raise `ValueError` if a variable has different bounds in two boxes: all of them must describe one set."""
    known: dict[str, tuple[float, float]] = {}
    for box in boxes:
        for name, low, high in zip(box.names, box.low.tolist(), box.high.tolist(), strict=True):
            if known.setdefault(name, (low, high)) != (low, high):
                first = known[name]
                raise InputError(
                    f"cascade: {name} is in [{first[0]:g}, {first[1]:g}] in one box and in [{low:g}, {high:g}] in "
                    "another; give it the same bounds in all of them"
                )


def _check_sizes(
    controller: tuple[ErrorSystem, Box], observer: tuple[ErrorSystem, Box], coupling: tuple[Coupling, Box]
) -> None:
    """Raise `InputError` if the sizes of errors in the coupling and in the coupled systems differ."""
    parts = ("controller", controller, "e"), ("observer", observer, "x̃")
    for (name, (error_system, box), error), size in zip(parts, _sizes(coupling), strict=True):
        own = jax.eval_shape(lambda z, of=error_system: of.at(z).x, jnp.asarray(box.low)).shape[0]
        if own != size:
            raise InputError(
                f"cascade: {error} of the coupling has the size {size}, and that of the {name} {own}; give controller, "
                "observer and coupling of one plant"
            )


class _Search(NamedTuple):
    attempts: int
    starts: int
    seed: int
    proved: bool
    boxes: int


class _Form(NamedTuple):
    """A symmetric matrix (n, n) of z whose smallest eigenvalue is computed, in the units of the problem.

    Attributes:
        matrix: a function of z, followed by the squares of the scales of e and of x̃.
        into: whether the scales of e or those of x̃ multiply its vectors.
        graph: the squares of these scales, and the negative of the matrix.
    """

    matrix: Form
    into: Literal["e", "x"]
    graph: Pencil
    box: Box


def _sizes(coupling: tuple[Coupling, Box]) -> tuple[int, int]:
    """Number of entries of e and of x̃."""
    shape = jax.eval_shape(coupling[0], jnp.asarray(coupling[1].low))[0].shape
    return shape[0], shape[1]


def _forms(controller, observer, coupling) -> dict[str, _Form]:
    (plant, plant_box), (error, error_box), (jacobians, coupling_box) = controller, observer, coupling
    sizes = _sizes(coupling)

    def split(whole, d):
        return jnp.split(whole, (d, d + sizes[0]))

    def metric(error_system, box, sign):
        def form(whole):
            point = error_system.at(split(whole, len(box.low))[0])
            return sign * point.metric(jnp.zeros((), whole.dtype), point.x)

        return as_form(form)

    def squared(which):
        def form(whole):
            z, e, _ = split(whole, len(coupling_box.low))
            b = jacobians(z)[which]
            # The least eigenvalue of −BᵀEB is −|√E B|², so the same search yields the largest singular value.
            return -b.T @ (e[:, None] * b)

        return as_form(form)

    def with_pencil(matrix: Form, into, box) -> _Form:
        check_box(box)
        d = len(box.low)
        start, end = (d, d + sizes[0]) if into == "e" else (d + sizes[0], d + sum(sizes))

        def pencil_of(matrix_value, whole):
            return jnp.concatenate([jnp.diag(whole[start:end]).ravel(), -((matrix_value + matrix_value.T) / 2).ravel()])

        graph = matrix.beside(pencil_of).graph(jnp.concatenate([jnp.asarray(box.low), *map(jnp.ones, sizes)])).entries
        return _Form(matrix, into, pencil(graph, _add_scales(box, np.ones(sum(sizes)))), box)

    return {
        "small": with_pencil(metric(plant, plant_box, 1.0), "e", plant_box),
        # The largest eigenvalue of P is the least one of −P with opposite sign, so one search serves both.
        "large": with_pencil(metric(plant, plant_box, -1.0), "e", plant_box),
        "fall": with_pencil(_change(plant, len(plant_box.low), -0.5), "e", plant_box),  # V_con has the factor ½
        "error": with_pencil(_change(error, len(error_box.low), -1.0), "x", error_box),
        "weight": with_pencil(metric(error, error_box, 1.0), "x", error_box),
        "from_error": with_pencil(squared(0), "x", coupling_box),
        "from_itself": with_pencil(squared(1), "e", coupling_box),
    }


def _constants(forms: dict[str, _Form], scales, search: _Search) -> tuple[Constants, np.ndarray]:
    """The constants for e and x̃ multiplied by `scales`, and the point at which λ_q is attained."""
    extremes = {name: _least(form, scales, search) for name, form in forms.items()}
    small, large, c3, lambda_q, m1, *couplings = (value for value, _ in extremes.values())
    gamma1, gamma2 = (math.sqrt(max(-least, 0.0)) for least in couplings)
    # Half the extreme eigenvalues of P, since V_con = ½eᵀPe.
    return Constants(small / 2, -large / 2, c3, -large, lambda_q, gamma1, gamma2, m1), extremes["error"][1]


def _least(form: _Form, scales, search: _Search) -> tuple[float, np.ndarray]:
    """The smallest eigenvalue over the box, or a lower bound if it is to be proved, and the point."""
    squares = [scale**2 for scale in scales]
    box, whole = form.box, _add_scales(form.box, np.concatenate(squares))
    value, where = slowest(form.graph, whole, search.attempts, search.starts, search.seed)
    if search.proved:
        # The margin is needed because an attained bound would need infinitely many boxes.
        bound = value - 0.02 * abs(value) - 1e-9
        scale_squares = squares[0 if form.into == "e" else 1]

        above = form.matrix.then(lambda matrix: matrix - bound * jnp.diag(jnp.asarray(scale_squares)))
        value = bound if prove(above, whole, boxes=search.boxes).verdict == "holds" else -math.inf
    return value, where[: len(box.low)]


def _add_scales(box: Box, squares: np.ndarray) -> Box:
    """The box extended by the squares of the scales, as fixed variables."""
    return box.with_fixed(squares, tuple(f"scale_{i}" for i in range(len(squares))))


def _change(error_system: ErrorSystem, d: int, factor: float) -> Form:
    """A multiple of `FᵀM + Ṁ + MF` (n, n) in coordinates, as a function of z and of unused scales."""

    def formula(coframe, gram, change):
        # From the frame back to coordinates, since Theorem 3 uses norms in coordinates.
        return factor * coframe.T @ change @ coframe

    return length_change(error_system._replace(at=lambda whole: error_system.at(whole[:d])), formula)


def _scales(of_e: Sequence[str], of_x: Sequence[str]):
    """Other units, changing one at a time: the name, the scales of e and x̃, and the factor of V_con."""
    for unit, others in UNITS.items():
        for name, factor in others:
            pair = tuple(np.array([_factor(u, unit, factor) for u in entries]) for entries in (of_e, of_x))
            if unit == "kg" or any((scale != 1).any() for scale in pair):
                yield name, pair, factor if unit == "kg" else 1.0


def _factor(written: str, unit: str, factor: float) -> float:
    """Factor of the number of a quantity in "a" or "a/b" if `unit` is replaced by a unit smaller by `factor`."""
    over, _, under = written.partition("/")
    # In "a/b", a smaller unit a increases the number, and a smaller unit b decreases it.
    return (factor if over == unit else 1.0) / (factor if under == unit else 1.0)


def _growth(error_system: ErrorSystem, domain: Box, where: np.ndarray) -> Growth | None:
    """The fastest growing solution of the error system, frozen at a point, over five time constants, or None."""
    point, t = error_system.at(jnp.asarray(where)), jnp.zeros(())
    slope = np.asarray(jacobian(lambda x: point.flow(t, x), point.x))
    values, vectors = np.linalg.eig(slope)
    fastest = int(np.argmax(np.real(values)))
    rate = float(values[fastest].real)
    if not rate > 0:
        return None
    stamps = np.linspace(0.0, 5 / rate, 101)
    # The real part of a complex solution is a solution, since the Jacobian is real.
    error = (np.exp(values[fastest] * stamps)[:, None] * vectors[:, fastest]).real
    return Growth(stamps, error, rate, dict(zip(domain.names, where.tolist(), strict=True)))
