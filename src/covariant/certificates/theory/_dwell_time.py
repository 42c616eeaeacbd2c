"""Computes how much impacts of feet enlarge small errors of an observer, and how long it needs between impacts.

With constant gains and measurements in continuous time, small errors ξ and ζ of position and velocity obey the law
`ξ' = ζ − αξ`, `ζ' = −βξ` in flight and in stance. With complex poles the length

    V = β|ξ|² − α<ξ, ζ> + |ζ|²

decreases exactly by `V' = −αV`. For a jump, let II be the second fundamental form of the leaf, and S its shape operator
for the lost velocity n, `<S a, b> = <II(a, b), n>`. Then

    touch-down  ξ⁺ = P ξ, ζ⁺ = P ζ + S P ξ:   √V grows at most by F_td, the largest singular value of
                Q^½ [[1, 0], [s, 1]] Q^−½ over the eigenvalues s of S, with Q = [[β, −α/2], [−α/2, 1]]
    lift-off    ξ⁺ = ξ, ζ⁺ = ζ + II(ξ, v):    √V grows at most by F_lo = √(1 + |II(·, v)|²/(β − α²/4))

so that errors vanish if `α/2 (flight + stance) > ln F_td + ln F_lo`. This holds for small errors only, and does not
cover contacts that are detected instead of known, or feet that slip.
"""

from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._domains import FACTOR, FINITE, POSITIVE, Domain, Positive, check_numbers
from covariant._typing import Number, Vector
from covariant.certificates.base import Hypothesis, Statement
from covariant.geometry import CLOSED, Leaf
from scalargraph.errors import InputError

ASSUMED = (
    "the times of all contacts are known, and the estimate jumps at the same instants as the motion",
    "errors are so small that first variations count, in a tube where the feet's rows keep their rank",
    "impacts are plastic, and feet on the ground do not slip",
    "positions are measured in continuous time and without noise, and the model is exact",
)
"""Premises of the inequality besides its numbers."""
ON_LEAF = Domain(f"be zero within {CLOSED:g}", lambda gap: np.abs(gap) < CLOSED)
"""Values of a constraint on its leaf."""


class JumpGrowth(NamedTuple):
    """Largest factors by which jumps enlarge a small error, with the gains that they assume.

    Attributes:
        touch_down: Factor F_td of a touch-down.
        lift_off: Factor F_lo of a lift-off.
        alpha: Gain α [1/s] of the observer.
        beta: Gain β [1/s²].

    Example:
        >>> from covariant.certificates.theory import JumpGrowth
        >>> JumpGrowth(touch_down=1.02, lift_off=1.01, alpha=20.0, beta=200.0).lift_off
        1.01
    """

    touch_down: Annotated[Float[Array, "*k"] | float, FACTOR]
    lift_off: Annotated[Float[Array, "*k"] | float, FACTOR]
    alpha: Annotated[Float[Array, "*k"] | float, POSITIVE]
    beta: Annotated[Float[Array, "*k"] | float, POSITIVE]


@check_numbers
def jump_growth(
    leaf: Leaf,
    q: Annotated[Array, FINITE],
    v: Annotated[Vector, FINITE],
    alpha: Annotated[Number, POSITIVE],
    beta: Annotated[Number, POSITIVE],
) -> JumpGrowth:
    """Compute the factors by which jumps between the air and a leaf enlarge a small error of an observer.

    Args:
        leaf: The leaf of the feet on the ground, such as the space of `models.standing`.
        q: Configuration on the leaf.
        v: Velocity (n,) before a touch-down; for a lift-off, the velocity of the motion along the leaf.
        alpha: Gain α [1/s] of the observer.
        beta: Gain β [1/s²], more than α²/4.

    Returns:
        The factors of a touch-down with the velocity v, and of a lift-off with its part along the leaf. They are NaN
        if traced arguments, which cannot be refused, are outside of their domain.

    Raises:
        ValueError: q is not on the leaf, or β is not more than α²/4: with real poles this length may grow at first.

    Example:
        A mass on a rod of 2 m. Before the rod holds, it moves outwards at 1 m/s and along at 2 m/s:

        >>> import jax.numpy as jnp
        >>> from covariant.certificates import jump_growth
        >>> from covariant.geometry import Euclidean, Leaf
        >>> circle = Leaf(Euclidean(), lambda x: (x @ x - 4.0)[None] / 2, jnp.array([2.0, 0.0]))
        >>> growth = jump_growth(circle, circle.assembly, jnp.array([1.0, 2.0]), 20.0, 200.0)
        >>> [round(float(factor), 4) for factor in growth]
        [1.0253, 1.005, 20.0, 200.0]
    """
    _check_poles("jump_growth", alpha, beta)
    gap = leaf.constraint(q)
    ON_LEAF.check("jump_growth", "the constraint of the leaf at q", gap)
    axes = jnp.eye(v.shape[0], dtype=v.dtype)
    tangent = leaf.projected(q, v)
    # In orthonormal components w, a = L⁻ᵀw with g = L Lᵀ, operators are matrices with the norms of the formulas.
    root = jnp.linalg.cholesky(leaf(q))
    vectors = jax.scipy.linalg.solve_triangular(root, axes, lower=True)  # rows: the axes of such components
    along = jax.vmap(lambda a: leaf.projected(q, a))(vectors)
    lost = leaf.lower(q, v - tangent)
    shape = jax.vmap(lambda a: jax.vmap(lambda b: lost @ leaf.second_form(q, a, b))(along))(along)
    bend = jax.vmap(lambda a: root.T @ leaf.second_form(q, a, tangent), out_axes=1)(along)
    values = jnp.linalg.eigvalsh((shape + shape.T) / 2)
    half = jnp.linalg.cholesky(jnp.asarray([[beta, -alpha / 2], [-alpha / 2, 1.0]]))

    def stretched(s):
        return half.T @ jnp.array([[1.0, 0.0], [0.0, 1.0]]).at[1, 0].set(s) @ jnp.linalg.inv(half.T)

    touch_down = jnp.max(jnp.linalg.norm(jax.vmap(stretched)(values), 2, axis=(1, 2)))
    # β − α²/4 = det Q, from the same factor of Q; both are NaN if Q is not positive definite.
    lift_off = jnp.sqrt(1 + (jnp.linalg.norm(bend, 2) / (half[0, 0] * half[1, 1])) ** 2)
    # The maps have the determinant 1, so a factor can be below 1 only by rounding.
    least = jnp.where(jnp.all(jnp.abs(gap) < CLOSED), 1.0, jnp.nan)
    return JumpGrowth(jnp.maximum(touch_down, least), jnp.maximum(lift_off, least), alpha, beta)


@check_numbers
def dwell_time(growth: JumpGrowth, flight: Positive, stance: Positive) -> Statement:
    """State whether small errors of an observer vanish over a cycle of flight and stance, by the dwell-time inequality.

    The condition is only sufficient, so the verdict is never "fails". It concerns small errors and known contacts: read
    its assumptions. The gains are those for which the factors were computed.

    Args:
        growth: Factors of the touch-downs and lift-offs, from `jump_growth` with a single pair of gains; the largest
            one of each kind is used.
        flight: Shortest flight [s].
        stance: Shortest stance [s].

    Returns:
        The statement; its margin is `α/2 (flight + stance) − ln F_td − ln F_lo`.

    Raises:
        ValueError: A number is outside its domain, the factors have different gains, or β is not more than
            α²/4.

    Example:
        >>> from covariant.certificates import dwell_time
        >>> from covariant.certificates.theory import JumpGrowth
        >>> statement = dwell_time(JumpGrowth(1.02, 1.01, 20.0, 200.0), flight=0.2, stance=0.1)
        >>> statement.short, round(statement.margin, 2)
        ('holds (sampled)', 2.97)
    """
    for name in ("alpha", "beta"):
        if len(several := np.unique(getattr(growth, name))) != 1:
            raise InputError(f"dwell_time: the factors must be of one pair of gains; {name} is {several.tolist()}")
    alpha, beta = (float(np.ravel(gain)[0]) for gain in (growth.alpha, growth.beta))
    _check_poles("dwell_time", alpha, beta)
    worst = np.max(growth.touch_down), np.max(growth.lift_off)
    gained = alpha / 2 * (flight + stance)
    FINITE.check("dwell_time", "α/2 (flight + stance)", gained)
    margin = float(gained - np.log(worst).sum())
    condition = Hypothesis(
        f"α/2 (flight + stance) = {gained:.4g} is more than ln F_td + ln F_lo = {gained - margin:.4g}",
        "sampled",
        "holds" if margin > 0 else "undecided",
        margin,
    )
    count = max(np.size(growth.touch_down), np.size(growth.lift_off))
    return Statement(
        "small errors of position and velocity shrink over each cycle of flight and stance",
        (f"alpha = {alpha:g} 1/s, beta = {beta:g} 1/s²", f"flight {flight:g} s, stance {stance:g} s at least"),
        (condition, *(Hypothesis(text, "assumed") for text in ASSUMED)),
        margin,
        f"{count} events that were looked at" if count > 1 else "the event that was looked at",
    )


def _check_poles(whose: str, alpha: Number, beta: Number) -> None:
    """Raise `InputError` if the poles are real, for which the length may grow at first."""
    # `alpha**2` is avoided, since it overflows with an error.
    traced = isinstance(alpha, Tracer) or isinstance(beta, Tracer)
    if not traced and not beta > (least := alpha / 2 * (alpha / 2)):
        raise InputError(f"{whose}: beta must be more than alpha²/4 = {least:g} 1/s²; got {beta:g}")
