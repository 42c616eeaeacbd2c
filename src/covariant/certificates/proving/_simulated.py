"""Simulates motions of the model in the region of a certificate, and estimates from the border of its tube.

Source: Aghannan & Rouchon 2003, Theorem 2.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._domains import Count, Whole, check_numbers
from covariant.certificates.base import error_matrix, true_region
from covariant.certificates.proving._contraction_certificate import ContractionCertificate
from covariant.certificates.theory import Decay, lower_distance, upper_distance
from covariant.models import Motion
from covariant.simulation import observe, simulate
from scalargraph.errors import InputError

INSIDE = 0.98
"""Fraction of the bounds that a simulated motion may use, so that it also keeps them between its stamps."""


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
        >>> from covariant.certificates import Trajectories
        >>> from covariant.certificates.theory import Decay
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
    # Paces that are no multiples of each other: several inputs do not repeat one pattern.
    control = plant.inputs(2 * jnp.pi / plant.longest * (2 + 0.74 * jnp.arange(m, dtype=float)))
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

    The chart is that of its coordinates, or of the retraction around the estimate. Motions start at `first` and are
    followed for at most `longest`, eight time constants of the gains [s].
    """

    def __init__(self, certificate: ContractionCertificate):
        self.certificate, self.half_widths, self.n = certificate, certificate.half_widths, len(certificate.velocity)
        self.model, self.manifold = certificate.observer.model, certificate.observer.model.manifold
        self.flat = self.manifold.commuting
        # For such certificates the metric on states is a single function for the whole region.
        self.metric = certificate.error_system.at(jnp.zeros(len(certificate.error_system.names))).metric
        alpha, beta = float(certificate.observer.alpha), float(certificate.observer.beta)
        # Time constant of the slower pole of the error law.
        constant = -1 / float(np.linalg.eigvals(error_matrix(alpha, beta)).real.max())
        self.first, last = certificate.given.times
        # e⁻⁸ = 3e-4: what is left of a first error is then hardly visible.
        self.longest = 8 * constant
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
        here = jnp.concatenate([*([x.q] if self.flat else []), x.v])
        return jnp.pad(here, (0, len(self.certificate.error_system.names) - here.size))

    def inputs(self, pace: Array) -> Callable[[Array, Any], Array]:
        """Sinusoidal inputs (m,) within their bounds."""
        low, high = jnp.asarray(self.certificate.given.inputs)
        return lambda t, x: (low + high) / 2 + INSIDE * (high - low) / 2 * jnp.sin(pace * t)

    def inside(self, places: np.ndarray, v: np.ndarray) -> np.ndarray:
        """The number of stamps from the first on at which each motion (k, T, ...) is inside the bounds."""
        low, high = self.certificate.given.positions
        # Coordinates on which nothing depends are unlimited, around the value at which motions start.
        middle, half = (
            (low + high) / 2,
            np.diff(true_region(self.model, self.certificate.given.positions), axis=0)[0] / 2,
        )
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
