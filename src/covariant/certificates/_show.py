"""What a certificate looks like, and what simulations say of it: arrays taken from the certificate itself.

Source: Aghannan & Rouchon 2003, Fig. 2 and Theorem 2.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant.certificates._certify import ContractionCertificate, Followed
from covariant.certificates._contraction import StateMetric
from covariant.certificates._distance import Decay, lower_distance, upper_distance
from covariant.certificates._prove import OPEN, PROVED, Proof, leaves
from covariant.certificates._tangent import conditioning, error_matrix, lyapunov, optimal_lyapunov, rate_of
from covariant.models import Motion
from covariant.simulation import observe, simulate

INSIDE = 0.98
"""How much of the bounds a motion that is shown may use, so that it keeps them between its stamps."""
WATCHED = 97
"""Stamps at which a motion is looked at, whether it is inside."""


class Projection(NamedTuple):
    """The boxes of one proof seen along all variables but two.

    - `claim`: which statement; `kind`: of each of the two variables; `names`, `units`: as in the certificate.
    - `proved`, `open` (k, 2, 2): different rectangles, low then high ends of both variables.
    - `domain` (2, 2): all of it; `counterexample` (2,): where the statement was proved wrong, or None.
    """

    claim: str
    kind: tuple[str, str]
    names: tuple[str, str]
    units: tuple[str, str]
    proved: Float[np.ndarray, "k 2 2"]
    open: Float[np.ndarray, "j 2 2"]
    domain: Float[np.ndarray, "2 2"]
    counterexample: Float[np.ndarray, "2"] | None


class Trajectories(NamedTuple):
    """A motion of the model inside the region, and estimates that begin on the border of the proved tube.

    - `t` (T,) [s]; `positions`, `velocities` (T, n): the motion; positions on a group are `log(g(0)⁻¹ g)`.
    - `estimated_positions`, `estimated_velocities` (k, T, n).
    - `half_widths` (2n,): how far the tube reaches in each position error, then in each velocity.
    - `shown`: the coordinate in whose plane of position and velocity the estimates begin all around the motion.
    - `distances`: of the estimates from the motion, and the certified bound.
    """

    t: Float[np.ndarray, "T"]
    positions: Float[np.ndarray, "T n"]
    velocities: Float[np.ndarray, "T n"]
    estimated_positions: Float[np.ndarray, "k T n"]
    estimated_velocities: Float[np.ndarray, "k T n"]
    half_widths: Float[np.ndarray, "two_n"]
    shown: int
    distances: Decay


class TradeOff(NamedTuple):
    """Rates λ [1/s] that the gains allow at q̂ = q, and how well conditioned a metric has them.

    - `rate`, `condition` (k,): of the best conditioned Q for each rate.
    - `used`, `paper`: rate and condition number of the certificate's Q, and of the one of the paper.
    - `certified`: the rate that the certificate is about.
    """

    rate: Float[np.ndarray, "k"]
    condition: Float[np.ndarray, "k"]
    used: tuple[float, float]
    paper: tuple[float, float]
    certified: float


def open_share(proof: Proof) -> float:
    """The share of the domain that no box proves."""
    return float(sum((codes == OPEN).sum() * 0.5**depth for depth, codes in enumerate(proof.levels)))


def kinds(certificate: ContractionCertificate) -> tuple[str, ...]:
    """What each variable of the domain is: "estimate", "velocity" (estimated), "error" or "force"."""
    n = len(certificate.velocity)
    words = ("estimate", "velocity", "error", "force")
    parts = words if len(certificate.domain.low) == 4 * n else words[1:]
    return tuple(word for word in parts for _ in range(n))


def half_widths(certificate: ContractionCertificate) -> Float[np.ndarray, "two_n"]:
    """How far the proved tube reaches in each position error [unit], then in each velocity error [unit/s].

    Raises `ValueError` where no tube is proved.
    """
    if certificate.summary.verdict != "holds":
        raise ValueError("no tube, since nothing is proved on the region")
    reaches = [claim for claim in certificate.claims if claim.kind == "reach"]
    return certificate.radius * np.sqrt([claim.square for claim in reaches])


def projection(certificate: ContractionCertificate) -> Projection:
    """Boxes of the first claim that does not hold, or of the contraction, over the two variables most often halved."""
    undecided = [claim for claim in certificate.claims if claim.proof.verdict != "holds"]
    claim = (undecided or certificate.claims)[0]
    domain, proof = claim.proof.box, claim.proof
    codes = np.concatenate(proof.levels)
    splits = np.bincount(codes[codes >= 0], minlength=len(domain.low)) + 0.5 * (domain.high > domain.low)
    i, j = sorted(np.argsort(-splits, kind="stable")[:2].tolist())
    found = {PROVED: [np.zeros((0, 2, 2))], OPEN: [np.zeros((0, 2, 2))]}
    for state, low, high in leaves(domain, proof.levels):
        for code, kept in found.items():
            of = state == code
            kept.append(np.stack([low[of][:, [i, j]], high[of][:, [i, j]]], axis=1))
    proved, remaining = (np.unique(np.concatenate(found[code]), axis=0) for code in (PROVED, OPEN))
    wrong = certificate.counterexample
    what = kinds(certificate)
    return Projection(
        claim.kind,
        (what[i], what[j]),
        (domain.names[i], domain.names[j]),
        (domain.units[i], domain.units[j]),
        proved,
        remaining,
        np.stack([domain.low[[i, j]], domain.high[[i, j]]]),
        None if wrong is None else wrong.mean(axis=0)[[i, j]],
    )


def trade_off(certificate: ContractionCertificate, count: int = 40) -> TradeOff:
    """What the gains of a certificate's observer allow, from slow rates to nearly the fastest."""
    alpha, beta = float(certificate.observer.alpha), float(certificate.observer.beta)
    fastest = -2 * float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
    rates = fastest * np.linspace(0.02, 0.98, count)
    matrices = [optimal_lyapunov(alpha, beta, rate) for rate in rates]

    def both(q) -> tuple[float, float]:
        return rate_of(alpha, beta, q), conditioning(beta, q)

    found = np.array(sorted(both(q) for q in matrices))
    return TradeOff(found[:, 0], found[:, 1], both(certificate.q), both(lyapunov(alpha, beta)), certificate.rate)


def trajectories(
    certificate: ContractionCertificate, *, count: int = 5, stamps: int = 160, seed: int = 0
) -> Trajectories:
    """Simulate the model inside the region of a proved certificate, and `count` estimates from the border of its tube.

    Of random motions with sinusoidal inputs within their bounds, one that stays inside longest is taken, at most eight
    time constants of the observer, and of those one that moves much. The upper distance of the estimates begins at the
    radius.

    Raises `ValueError` where nothing is proved, or where no motion stays inside for as long as two stamps.
    """
    reached, side = half_widths(certificate), _Side(certificate)
    first, longest, _ = _eight_time_constants(certificate)
    m = len(certificate.given["inputs"]["low"])
    push = _inputs(certificate, 2 * jnp.pi / longest * (2 + 0.74 * jnp.arange(m, dtype=float)), jnp.zeros(m))
    rng = np.random.default_rng(seed)
    start, duration, travel = _stays_inside(certificate, side, push, first, longest, rng)
    t = jnp.linspace(first, first + duration, stamps)
    n = len(certificate.velocity)
    angles = jnp.linspace(0, 2 * jnp.pi, count, endpoint=False) + 0.3

    @jax.jit
    def follow(start, shown, size):
        def one(angle):
            begin = _on_the_border(certificate, side, start, _across(certificate, side, start, shown, angle), size)
            actual, estimated = side.observed(start, begin, t, push, rtol=1e-9, atol=1e-11)
            ends = jax.vmap(side.chart)(estimated, actual)
            metric = _metric(certificate)
            low = jax.vmap(lambda s, a, b: lower_distance(metric, s, a, b))(t, *ends)
            high = jax.vmap(lambda s, a, b: upper_distance(metric, s, a, b))(t, *ends)
            places = [jax.vmap(side.coordinates, (None, 0))(start, x) for x in (actual, estimated)]
            return *places, low, high

        # One after the other: steps are chosen for each.
        return jax.lax.map(one, angles)

    shown = int(np.argmax(travel[:n] / reached[:n] if side.flat else travel[-n:] / reached[n:]))
    actual, estimated, low, high = (np.asarray(a) for a in follow(start, shown, certificate.radius))
    truth = actual[0]
    shrink = np.exp(-certificate.decay * (np.asarray(t) - first))
    bound = np.broadcast_to(certificate.radius * shrink, high.shape)
    return Trajectories(
        np.asarray(t),
        truth[:, :n],
        truth[:, n:],
        estimated[..., :n],
        estimated[..., n:],
        reached,
        shown,
        Decay(np.asarray(t), low, high, bound),
    )


def follow(
    certificate: ContractionCertificate, count: int, stamps: int, seed: int, rtol: float, atol: float
) -> Followed:
    """As `ContractionCertificate.follow`."""
    half_widths(certificate)
    side, radius = _Side(certificate), certificate.radius
    rng = np.random.default_rng(seed)
    start, pushes, first, until = _motions(certificate, side, count, rng)
    directions = jnp.asarray(rng.normal(size=(count, 2 * side.n)))

    metric = _metric(certificate)

    @jax.jit
    @jax.vmap
    def onwards(start, pushes, until, direction):
        place = side.place(start)[: 2 * side.n]
        root = jnp.linalg.cholesky(metric.gram(jnp.zeros(()), place))
        # On a sphere of the metric all directions are alike.
        ball = jnp.linalg.solve(root.T, direction / jnp.linalg.norm(direction))
        begin = _on_the_border(certificate, side, start, metric.frame(jnp.zeros(()), place) @ ball, jnp.asarray(radius))
        t = first + (until - first) * jnp.linspace(0, 1, stamps)
        actual, estimated = side.observed(start, begin, t, _inputs(certificate, *pushes), rtol=rtol, atol=atol)
        return t, *jax.vmap(side.chart)(estimated, actual)

    @jax.jit
    def distances(*given):
        between = jax.vmap(lambda *x: (lower_distance(metric, *x), upper_distance(metric, *x)))
        return jax.lax.map(lambda x: between(*x), given)  # one by one: each takes many points at every stamp

    t, *ends = onwards(start, pushes, jnp.asarray(until), directions)
    t, low, high = (np.asarray(a) for a in (t, *distances(t, *ends)))
    return Followed(t, low, high, radius * np.exp(-certificate.decay * (t - first)), certificate.rate)


def _motions(certificate, side, count: int, rng) -> tuple[Any, tuple[Array, Array], float, np.ndarray]:
    """`count` starts of motions and the pace and phase (count, m) of their inputs, when they begin and end (count,).

    Of random ones those that stay within the bounds for a time constant of the gains or longer.
    """
    first, longest, constant = _eight_time_constants(certificate)
    t = jnp.linspace(first, first + longest, WATCHED)
    m = len(certificate.given["inputs"]["low"])

    @jax.jit
    @jax.vmap
    def motions(x0, pushes):
        return side.simulated(x0, t, _inputs(certificate, *pushes))

    found, ends = [], np.zeros(0)
    for _ in range(20):
        pace = jnp.asarray(rng.uniform(1, 4, (2 * count, m))) * (2 * jnp.pi / longest)
        drawn = side.draw(rng, 2 * count), (pace, jnp.asarray(rng.uniform(0, 2 * np.pi, (2 * count, m))))
        lasts = _inside(certificate, side, *(np.asarray(a) for a in motions(*drawn)))
        last = np.asarray(t)[np.maximum(lasts - 1, 0)]
        good = last >= first + min(constant, longest)
        found.append(jax.tree.map(lambda a, good=good: a[good], drawn))
        ends = np.concatenate([ends, last[good]])
        if len(ends) >= count:
            start, pushes = jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *found)
            return start, pushes, first, ends[:count]
    raise ValueError("too few motions stay inside the region for a time constant of the gains; take a larger region")


class _Side:
    """Motions of a certificate's model, and where its metric compares them: in its coordinates, or in the chart of the
    retraction around the estimate."""

    def __init__(self, certificate: ContractionCertificate):
        self.certificate, self.n = certificate, len(certificate.velocity)
        self.model, self.manifold = certificate.observer.model, certificate.observer.model.manifold
        self.flat = self.manifold.commuting

    def draw(self, rng, count: int) -> Motion:
        """Random motions inside the bounds."""
        if self.flat:
            low, high = (np.asarray(self.certificate.given["positions"][end]) for end in ("low", "high"))
            share = rng.uniform(-1, 1, (count, 2, self.n)) * rng.uniform(size=(count, 1, 1))
            q = (low + high) / 2 + share[:, 0] * (high - low) / 2
            return Motion(jnp.asarray(q), jnp.asarray(share[:, 1] * self.certificate.velocity))
        turn = rng.normal(size=(count, self.n))
        turn *= np.pi * rng.uniform(size=(count, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
        v = rng.uniform(-1, 1, (count, self.n)) * rng.uniform(size=(count, 1)) * self.certificate.velocity
        q = jax.vmap(lambda s: self.manifold.retract(self.manifold.origin(), s))(jnp.asarray(turn))
        return Motion(q, jnp.asarray(v))

    def simulated(self, start: Motion, t: Array, push) -> tuple[Array, Array]:
        """Entries of the configuration (T, k), and velocities (T, n), of the motion from there."""
        q, v = self.model.motion(simulate(self.model, self.model.state(start), t, push, rtol=1e-5, atol=1e-7).x)
        return q.reshape(len(t), -1), v

    def observed(self, start: Motion, estimate: Motion, t: Array, push, **tolerances) -> tuple[Motion, Motion]:
        """The motion from `start`, and what the observer makes of it that begins at `estimate`."""
        observer = self.certificate.observer
        state = observer.init(estimate.q)._replace(q=estimate.q, v=estimate.v)
        x, states = observe(self.model, observer, self.model.state(start), state, t, push, **tolerances)
        return self.model.motion(x), Motion(states.q, states.v)

    def coordinates(self, start: Motion, x: Motion) -> Array:
        """Position, as seen from the start where there are no coordinates, and velocity."""
        return jnp.concatenate([x.q if self.flat else self.manifold.local(start.q, x.q), x.v])

    def chart(self, estimated: Motion, actual: Motion) -> tuple[Array, Array]:
        """Both where the metric can compare them."""
        return self.coordinates(estimated, estimated), self.coordinates(estimated, actual)

    def place(self, x: Motion) -> Array:
        """The point of the region where the estimate is x and all else is zero."""
        return jnp.concatenate([*([x.q] if self.flat else []), x.v, jnp.zeros(2 * self.n)])

    def moved(self, x: Motion, step: Array) -> Motion:
        turn, v = jnp.split(step, 2)
        return Motion(self.manifold.retract(x.q, turn), x.v + v)


def _metric(certificate: ContractionCertificate) -> StateMetric:
    """The metric on states, which is the same at every point."""
    return certificate.subject.at(jnp.zeros(len(certificate.subject.names))).metric


def _eight_time_constants(certificate: ContractionCertificate) -> tuple[float, float, float]:
    """When motions begin, how long they are followed at most, and the time constant of the gains [s]."""
    alpha, beta = float(certificate.observer.alpha), float(certificate.observer.beta)
    constant = -1 / float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
    first, last = certificate.given["times"]
    return first, min(8 * constant, last - first) if last > first else 8 * constant, constant


def _inputs(certificate: ContractionCertificate, pace: Array, phase: Array):
    """Sines (m,) within the bounds of the inputs."""
    low, high = (jnp.asarray(certificate.given["inputs"][end]) for end in ("low", "high"))
    return lambda t, x: (low + high) / 2 + INSIDE * (high - low) / 2 * jnp.sin(pace * t + phase)


def _inside(certificate: ContractionCertificate, side: Any, places: np.ndarray, v: np.ndarray) -> np.ndarray:
    """At how many of its first stamps each motion (k, T, ...) is inside the bounds."""
    low, high = (np.asarray(certificate.given["positions"][end]) for end in ("low", "high"))
    middle, half = (low + high) / 2, (high - low) / 2
    room = half * INSIDE if side.flat else half + 1e-9
    with np.errstate(invalid="ignore"):
        kept = (np.abs(places - middle) <= room).all(-1) & (np.abs(v) <= INSIDE * certificate.velocity).all(-1)
    inside = np.asarray(kept)
    return np.where(inside.all(1), inside.shape[1], inside.argmin(1))


def _stays_inside(
    certificate, side, push, first: float, longest: float, rng, count: int = 512
) -> tuple[Any, float, np.ndarray]:
    """The start of a motion within the bounds, for how long it is inside, and how far positions and velocities go."""
    t = jnp.linspace(first, first + longest, 49)
    draws = side.draw(rng, count)

    @jax.jit
    @jax.vmap
    def motions(x0):
        return side.simulated(x0, t, push)

    places, v = (np.asarray(a) for a in motions(draws))
    lasts = _inside(certificate, side, places, v)
    best = lasts == lasts.max()
    travel = np.where(best, np.nan_to_num(np.ptp(v / certificate.velocity, axis=1)).sum(-1), -1.0)
    chosen = int(travel.argmax())
    if lasts[chosen] < 2:
        raise ValueError("no motion was found that stays inside the region; take a larger one to see its tube")
    until = lasts[chosen]
    gone = np.concatenate([np.ptp(a[chosen, :until], axis=0) for a in (places, v)])
    return jax.tree.map(lambda a: a[chosen], draws), float(t[until - 1] - t[0]), gone


def _across(certificate, side, start, shown, angle):
    """A change of the state `start` in the plane of one position error and the change of velocity."""
    point, t = certificate.subject.at(side.place(start)), jnp.zeros(())
    rows = point.reach()[jnp.array([shown, shown + side.n])]
    widest = jnp.linalg.solve(point.metric.gram(t, point.x), rows.T)
    along = widest / jnp.sqrt(jnp.sum(rows.T * widest, axis=0, keepdims=True))
    return point.metric.frame(t, point.x) @ (along @ jnp.array([jnp.cos(angle), jnp.sin(angle)]))


def _on_the_border(certificate, side, start, step, size):
    """The state at the distance `size` from `start`, in the direction of `step` (2n,)."""
    metric, t = _metric(certificate), jnp.zeros(())

    def nearer(_, scale):
        return scale * size / upper_distance(metric, t, *side.chart(side.moved(start, scale * step), start))

    return side.moved(start, jax.lax.fori_loop(0, 20, nearer, jnp.asarray(size)) * step)
