"""Simulates motions of the model in the region of a certificate, and estimates from the border of its tube.

Source: Aghannan & Rouchon 2003, Theorem 2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import Count, Positive, Whole, check_numbers
from covariant.certificates.base import error_matrix
from covariant.certificates.proving._contraction_certificate import ContractionCertificate
from covariant.certificates.theory import Decay, lower_distance, upper_distance
from covariant.models import Motion
from covariant.simulation import observe, simulate
from scalargraph.errors import InputError

INSIDE = 0.98
"""Fraction of the bounds that a simulated motion may use, so that it also keeps them between its stamps."""
WATCHED = 97
"""Number of stamps at which a motion is tested to be inside the bounds."""


class Followed(NamedTuple):
    """Estimates that start on the border of the proved ball, each around another motion of the model.

    Attributes:
        t: stamps (k, T) [s], until the motion leaves the region or the bound of the velocity, and for at most eight
            time constants.
        low, high: lower and upper bounds (k, T) of the distance of each estimate from its motion.
        bound: the certified bound `ε e^(−λt/2)` (k, T).
        certified: rate λ [1/s], of squared lengths.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Followed
        >>> t = np.array([[0.0, 1.0]])
        >>> distance, bound = 0.1 * np.exp(-t), 0.1 * np.exp(-t / 2)
        >>> measured = Followed(t, distance, distance, bound, certified=1.0)  # usually from `follow_estimates`
        >>> measured.holds, measured.rates.round(6).tolist()
        (True, [2.0])
    """

    t: Float[np.ndarray, "k T"]
    low: Float[np.ndarray, "k T"]
    high: Float[np.ndarray, "k T"]
    bound: Float[np.ndarray, "k T"]
    certified: float

    @property
    def holds(self) -> bool:
        """Whether no distance exceeds its bound, with a relative tolerance of one millionth for the integration."""
        return bool((self.low <= self.bound * (1 + 1e-6)).all())

    @property
    def rates(self) -> Float[np.ndarray, "k"]:
        """The rate λ (k,) [1/s] of each pair, from its first stamp to its last."""
        return 2 * np.log(self.high[:, 0] / self.high[:, -1]) / (self.t[:, -1] - self.t[:, 0])


class Trajectories(NamedTuple):
    """A motion of the model inside the region, and estimates that start on the border of the proved tube.

    Attributes:
        t: stamps (T,) [s].
        positions: positions (T, n) of the motion; on a group `log(g(0)⁻¹ g)`.
        velocities: velocities (T, n) of the motion.
        estimated_positions, estimated_velocities: positions and velocities of the estimates (k, T, n).
        half_widths: half widths (2n,) of the tube in each position error, then in each velocity.
        shown: index of a coordinate; in the plane of its position and velocity the estimates start all around the
            motion.
        distances: distances of the estimates from the motion, and the certified bound.

    Example:
        >>> import numpy as np
        >>> from covariant.certificates import Decay, Trajectories
        >>> t, motion, estimates = np.array([0.0, 1.0]), np.zeros((2, 1)), 0.1 * np.ones((3, 2, 1))
        >>> distance = np.array([0.1, 0.05]) * np.ones((3, 1))
        >>> distances = Decay(t, distance, distance, distance)
        >>> picture = Trajectories(t, motion, motion, estimates, estimates, np.ones(2), 0, distances)
        >>> picture.distances.holds  # usually from `trajectories`
        True
    """

    t: Float[np.ndarray, "T"]
    positions: Float[np.ndarray, "T n"]
    velocities: Float[np.ndarray, "T n"]
    estimated_positions: Float[np.ndarray, "k T n"]
    estimated_velocities: Float[np.ndarray, "k T n"]
    half_widths: Float[np.ndarray, "two_n"]
    shown: int
    distances: Decay


@check_numbers
def follow_estimates(
    certificate: ContractionCertificate,
    count: Count = 100,
    *,
    stamps: Count = 25,
    seed: Whole = 0,
    rtol: Positive = 1e-10,
    atol: Positive = 1e-13,
) -> Followed:
    """Simulate motions in the region of a certificate, each with an estimate from the border of the proved ball.

    Args:
        certificate: a certificate that holds.
        count: number k of random motions; each estimate starts at a random point of the border.
        stamps: number T of instants at which the distances are measured.
        seed: seed of the random numbers.
        rtol, atol: relative and absolute tolerance of the integration.

    Returns:
        Distances of the estimates from their motions, with the certified bound.

    Raises:
        ValueError: nothing is proved, or motions leave the region too soon.
    """
    plant, radius = _Plant(certificate), certificate.radius
    rng = np.random.default_rng(seed)
    start, inputs, until = _draw_motions(plant, count, rng)
    directions = jnp.asarray(rng.normal(size=(count, 2 * plant.n)))
    metric, first = plant.metric, plant.first

    @jax.jit
    @jax.vmap
    def follow(start, inputs, until, direction):
        region_point = plant.place(start)[: 2 * plant.n]
        root = jnp.linalg.cholesky(metric.gram(jnp.zeros(()), region_point))
        # Uniform on the sphere of the metric: with N = LLᵀ, the vector L⁻ᵀ w has the length of w.
        ball = jnp.linalg.solve(root.T, direction / jnp.linalg.norm(direction))
        begin = _on_the_border(plant, start, metric.frame(jnp.zeros(()), region_point) @ ball, jnp.asarray(radius))
        t = first + (until - first) * jnp.linspace(0, 1, stamps)
        actual, estimated = plant.observed(start, begin, t, plant.inputs(*inputs), rtol=rtol, atol=atol)
        return t, *jax.vmap(plant.chart)(estimated, actual)

    @jax.jit
    def distances(*arguments):
        between = jax.vmap(lambda *x: (lower_distance(metric, *x), upper_distance(metric, *x)))
        return jax.lax.map(lambda x: between(*x), arguments)  # one by one: each evaluates many points at every stamp

    t, *ends = follow(start, inputs, jnp.asarray(until), directions)
    t, low, high = (np.asarray(a) for a in (t, *distances(t, *ends)))
    return Followed(t, low, high, radius * np.exp(-certificate.decay * (t - first)), certificate.rate)


@check_numbers
def trajectories(
    certificate: ContractionCertificate, *, count: Count = 5, stamps: Count = 160, seed: Whole = 0
) -> Trajectories:
    """Simulate the model inside the region of a proved certificate, and estimates from the border of its tube.

    Random motions have sinusoidal inputs within their bounds. Of these, one is chosen that moves much and stays inside
    longest, up to eight time constants of the observer. The upper bound of each estimate's distance starts at the
    radius.

    Args:
        certificate: a certificate that holds.
        count: number k of estimates.
        stamps: number T of instants.
        seed: seed of the random numbers.

    Returns:
        The motion and the estimates, with their distances.

    Raises:
        ValueError: nothing is proved, or no motion stays inside for two stamps.
    """
    plant = _Plant(certificate)
    half_widths = plant.half_widths
    m = certificate.given.inputs.shape[1]
    # The frequencies are no multiples of each other, so that several inputs do not repeat one pattern.
    control = plant.inputs(2 * jnp.pi / plant.longest * (2 + 0.74 * jnp.arange(m, dtype=float)), jnp.zeros(m))
    rng = np.random.default_rng(seed)
    start, duration, travel = _longest_motion(plant, control, rng)
    t = jnp.linspace(plant.first, plant.first + duration, stamps)
    n = len(certificate.velocity)
    angles = jnp.linspace(0, 2 * jnp.pi, count, endpoint=False) + 0.3

    @jax.jit
    def follow(start, shown, size):
        def one(angle):
            begin = _on_the_border(plant, start, _across(plant, start, shown, angle), size)
            actual, estimated = plant.observed(start, begin, t, control, rtol=1e-9, atol=1e-11)
            ends = jax.vmap(plant.chart)(estimated, actual)
            low = jax.vmap(lambda s, a, b: lower_distance(plant.metric, s, a, b))(t, *ends)
            high = jax.vmap(lambda s, a, b: upper_distance(plant.metric, s, a, b))(t, *ends)
            places = [jax.vmap(plant.coordinates, (None, 0))(start, x) for x in (actual, estimated)]
            return *places, low, high

        # One after another, since each integration chooses its own steps.
        return jax.lax.map(one, angles)

    shown = int(np.argmax(travel[:n] / half_widths[:n] if plant.flat else travel[-n:] / half_widths[n:]))
    actual, estimated, low, high = (np.asarray(a) for a in follow(start, shown, certificate.radius))
    truth = actual[0]
    shrink = np.exp(-certificate.decay * (np.asarray(t) - plant.first))
    bound = np.broadcast_to(certificate.radius * shrink, high.shape)
    return Trajectories(
        np.asarray(t),
        truth[:, :n],
        truth[:, n:],
        estimated[..., :n],
        estimated[..., n:],
        half_widths,
        shown,
        Decay(np.asarray(t), low, high, bound),
    )


class _Plant:
    """The model of a certificate that has a tube: its motions, and the chart in which its metric compares states.

    The chart is given by the coordinates, or by the retraction around the estimate. Motions start at `first` and last
    at most `longest`, eight times the time `constant` of the gains [s].
    """

    def __init__(self, certificate: ContractionCertificate):
        self.certificate, self.half_widths, self.n = certificate, certificate.half_widths, len(certificate.velocity)
        self.model, self.manifold = certificate.observer.model, certificate.observer.model.manifold
        self.flat = self.manifold.commuting
        # For such certificates the metric on states is a single function for the whole region.
        self.metric = certificate.error_system.at(jnp.zeros(len(certificate.error_system.names))).metric
        alpha, beta = float(certificate.observer.alpha), float(certificate.observer.beta)
        # Time constant of the slower pole of the error law.
        self.constant = -1 / float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
        self.first, last = certificate.given.times
        # e⁻⁸ = 3e-4: the rest of an initial error is then hardly visible.
        self.longest = 8 * self.constant
        if last > self.first:
            self.longest = min(self.longest, last - self.first)

    def draw(self, rng, count: int) -> Motion:
        """Draw random states inside the bounds, as starts of motions."""
        if self.flat:
            low, high = self.certificate.given.positions
            # Scaled down by a random factor, since starts close to the middle keep their bounds longer.
            share = rng.uniform(-1, 1, (count, 2, self.n)) * rng.uniform(size=(count, 1, 1))
            q = (low + high) / 2 + share[:, 0] * (high - low) / 2
            return Motion(jnp.asarray(q), jnp.asarray(share[:, 1] * self.certificate.velocity))
        turn = rng.normal(size=(count, self.n))
        # Lengths up to π reach every attitude of SO(3); longer ones reach no further attitude.
        turn *= np.pi * rng.uniform(size=(count, 1)) / np.linalg.norm(turn, axis=1, keepdims=True)
        v = rng.uniform(-1, 1, (count, self.n)) * rng.uniform(size=(count, 1)) * self.certificate.velocity
        q = jax.vmap(lambda s: self.manifold.retract(self.manifold.origin(), s))(jnp.asarray(turn))
        return Motion(q, jnp.asarray(v))

    def simulated(self, start: Motion, t: Array, control) -> tuple[Array, Array]:
        """Entries of the configuration (T, k), and velocities (T, n), of the motion from `start`."""
        q, v = self.model.motion(simulate(self.model, self.model.state(start), t, control, rtol=1e-5, atol=1e-7).x)
        return q.reshape(len(t), -1), v

    def observed(self, start: Motion, estimate: Motion, t: Array, control, **tolerances) -> tuple[Motion, Motion]:
        """The motion from `start`, and the estimates of an observer that starts at `estimate`."""
        observer = self.certificate.observer
        state = observer.init(estimate.q)._replace(q=estimate.q, v=estimate.v)
        x, states = observe(self.model, observer, self.model.state(start), state, t, control, **tolerances)
        return self.model.motion(x), Motion(states.q, states.v)

    def coordinates(self, start: Motion, x: Motion) -> Array:
        """Position, relative to `start` if there are no coordinates, and velocity."""
        return jnp.concatenate([x.q if self.flat else self.manifold.local(start.q, x.q), x.v])

    def chart(self, estimated: Motion, actual: Motion) -> tuple[Array, Array]:
        """Both states in the chart in which the metric compares them."""
        return self.coordinates(estimated, estimated), self.coordinates(estimated, actual)

    def place(self, x: Motion) -> Array:
        """The point of the region with the estimate x and all other variables zero."""
        return jnp.concatenate([*([x.q] if self.flat else []), x.v, jnp.zeros(2 * self.n)])

    def inputs(self, pace: Array, phase: Array) -> Callable[[Array, Any], Array]:
        """Sinusoidal inputs (m,) within their bounds."""
        low, high = jnp.asarray(self.certificate.given.inputs)
        return lambda t, x: (low + high) / 2 + INSIDE * (high - low) / 2 * jnp.sin(pace * t + phase)

    def inside(self, places: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The number of stamps from the first on at which each motion (k, T, ...) is inside the bounds."""
        low, high = self.certificate.given.positions
        middle, half = (low + high) / 2, (high - low) / 2
        # Entries of rotation matrices attain their bounds ±1, and exceed them slightly by rounding.
        allowed = half * INSIDE if self.flat else half + 1e-9
        # NaN, from a motion that left every bound, compares as outside.
        with np.errstate(invalid="ignore"):
            within = (np.abs(places - middle) <= allowed).all(-1)
            within &= (np.abs(v) <= INSIDE * self.certificate.velocity).all(-1)
        inside = np.asarray(within)
        return np.where(inside.all(1), inside.shape[1], inside.argmin(1))

    def moved(self, x: Motion, step: Array) -> Motion:
        """The state x changed by a step (2n,) of position and velocity."""
        turn, v = jnp.split(step, 2)
        return Motion(self.manifold.retract(x.q, turn), x.v + v)


def _draw_motions(plant: _Plant, count: int, rng) -> tuple[Any, tuple[Array, Array], np.ndarray]:
    """`count` starts of motions, the pace and phase (count, m) of their inputs, and their ends in time (count,).

    These are random motions that stay within the bounds for at least a time constant of the gains.
    """
    first, longest = plant.first, plant.longest
    t = jnp.linspace(first, first + longest, WATCHED)
    m = plant.certificate.given.inputs.shape[1]

    @jax.jit
    @jax.vmap
    def motions(x0, inputs):
        return plant.simulated(x0, t, plant.inputs(*inputs))

    batches, ends = [], np.zeros(0)
    for _ in range(20):
        pace = jnp.asarray(rng.uniform(1, 4, (2 * count, m))) * (2 * jnp.pi / longest)
        drawn = plant.draw(rng, 2 * count), (pace, jnp.asarray(rng.uniform(0, 2 * np.pi, (2 * count, m))))
        inside_count = plant.inside(*(np.asarray(a) for a in motions(*drawn)))
        last = np.asarray(t)[np.maximum(inside_count - 1, 0)]
        long_enough = last >= first + min(plant.constant, longest)
        batches.append(jax.tree.map(lambda a, long_enough=long_enough: a[long_enough], drawn))
        ends = np.concatenate([ends, last[long_enough]])
        if len(ends) >= count:
            start, inputs = jax.tree.map(lambda *parts: jnp.concatenate(parts)[:count], *batches)
            return start, inputs, ends[:count]
    raise InputError("too few motions stay inside the region for a time constant of the gains; take a larger region")


def _longest_motion(plant: _Plant, control, rng, count: int = 512) -> tuple[Any, float, np.ndarray]:
    """The start of a motion within the bounds, how long it stays inside, and its ranges of positions and velocities."""
    t = jnp.linspace(plant.first, plant.first + plant.longest, 49)
    draws = plant.draw(rng, count)

    @jax.jit
    @jax.vmap
    def motions(x0):
        return plant.simulated(x0, t, control)

    places, v = (np.asarray(a) for a in motions(draws))
    lasts = plant.inside(places, v)
    best = lasts == lasts.max()
    travel = np.where(best, np.nan_to_num(np.ptp(v / plant.certificate.velocity, axis=1)).sum(-1), -1.0)
    chosen = int(travel.argmax())
    if lasts[chosen] < 2:
        raise InputError("no motion was found that stays inside the region; take a larger one to see its tube")
    until = lasts[chosen]
    ranges = np.concatenate([np.ptp(a[chosen, :until], axis=0) for a in (places, v)])
    return jax.tree.map(lambda a: a[chosen], draws), float(t[until - 1] - t[0]), ranges


def _across(plant, start, shown, angle):
    """A step from the state `start`, in the plane of one position error and its velocity, at the given angle."""
    point, t = plant.certificate.error_system.at(plant.place(start)), jnp.zeros(())
    rows = point.error_jacobian()[jnp.array([shown, shown + plant.n])]
    # Along N⁻¹rᵀ the entry of a row r changes most, relative to the length of the change.
    widest = jnp.linalg.solve(point.metric.gram(t, point.x), rows.T)
    along = widest / jnp.sqrt(jnp.sum(rows.T * widest, axis=0, keepdims=True))
    return point.metric.frame(t, point.x) @ (along @ jnp.array([jnp.cos(angle), jnp.sin(angle)]))


def _on_the_border(plant, start, step, size):
    """The state at the distance `size` from `start` in the direction of `step` (2n,)."""
    t = jnp.zeros(())

    def rescale(_, scale):
        # A fixed-point iteration: the distance is nearly proportional to the scale.
        return scale * size / upper_distance(plant.metric, t, *plant.chart(plant.moved(start, scale * step), start))

    return plant.moved(start, jax.lax.fori_loop(0, 20, rescale, jnp.asarray(size)) * step)
