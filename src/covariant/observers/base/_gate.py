"""Decides which measurements an estimator uses, by a gate on their distance from the predicted ones.

An outlier is isolated, while readings of a real motion agree with their neighbours. A reading is refused if neither the
estimate nor the last used reading explains it. Suppose that refused readings lie on a line that starts at the last used
reading and whose slope is a credible velocity. Then there was an impact, or the estimated velocity is wrong: at the
third such reading the estimate restarts with their position and velocity. Readings that agree in another way, as after
a slip, must persist for `patience` samples. After a gap without readings, three that agree with each other suffice.

Refused readings that the usual speed can explain, and that continue without lying on a line, indicate a wrong model,
more noise than assumed, or contact. Such a reading is used by the ordinary correction, as without a gate, and its full
square enters the scale of the gate. This balances two errors. An outlier of size d that is used changes the velocity by
about Kd, with the gain K, until it is forgotten after 1/(K dt) rows: a squared error of K d²/dt in total. A motion of
size d that is refused leaves the velocity wrong by d/dt for one more row, (d/dt)²; if it is refused again, the error
adds up to 2, 3, … times as much. So a single refusal costs at most as much as a missing reading, while refusals in
every row would ruin the estimate; outliers that are beyond the reach of motion stay refused.

Source: Bar-Shalom, Li & Kirubarajan 2001, Estimation with Applications to Tracking and Navigation, section 5.4 for the
gate.
"""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._linalg import half_solve
from covariant._typing import Flag, Matrix, Vector
from covariant.geometry import AbstractManifold
from covariant.observers.base._gate_memory import BEND, GateMemory, Judged, Line, Sample, Velocity
from scalargraph.errors import InputError

BELIEVED = 4.0
"""Largest weight of a squared innovation in the average, as a multiple of it, so that outliers change it little."""
CREDIBLE = 4.0
"""Largest credible velocity, as a multiple of the usual one."""
AGREEING = 3.0
"""Tolerance for readings on a line, in standard deviations of the noise."""
MOVING = 4.0
"""Least distance of neighbouring readings on a line that shows a velocity, in standard deviations of the noise."""
ROUGHLY = 0.25
"""Largest distance between a line and the last used reading, as a fraction of the change since then."""
HOLE = 3.0
"""Gap before refused readings, in steps between them, above which they are compared only with each other."""


class Gate(eqx.Module):
    """Refuses a measurement that is too improbable, unless such measurements persist.

    It prevents a single outlier, such as a bit error, from spoiling an estimate. Kalman filters have a gate as their
    field `gate`; wrap another observer in `Gated`. With the default of 8 deviations, ordinary noise is practically
    never refused, even if the assumed noise is somewhat too small. Lower `patience` if a jump of the measurement may be
    real, as after re-homing, and should be followed sooner.

    Attributes:
        deviations: Threshold in standard deviations, 8 by default: a single number that is off by more is refused.
            Several numbers measured together, such as an attitude, are refused if they are equally improbable.
        patience: Number of consecutive refusals after which the next sample is accepted and the estimate restarts from
            it; 10 by default. Readings that show a velocity need not wait for this.
        memory: Number of samples over which the ratio of actual to expected squared innovations is averaged, 50 by
            default; the average widens the gate if the assumed noise is too small.

    Raises:
        ValueError: `deviations` is not positive and finite, `memory` not 1 or more and finite, or `patience` negative.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> from covariant.observers.base import GateMemory, Sample, Velocity
        >>> gate, manifold = observers.Gate(deviations=5.0), models.ball_and_beam().manifold
        >>> sample = Sample(jnp.array([4.0, 6.0]), jnp.eye(2), jnp.eye(2), jnp.ones(2, bool))
        >>> rest = Velocity(jnp.zeros(2), jnp.eye(2))
        >>> verdict = gate.judge(manifold, sample, GateMemory.at_start(jnp.zeros(2)), rest)
        >>> verdict.far.tolist(), verdict.memory.refused.tolist()
        ([False, True], [0, 1])
    """

    deviations: float = eqx.field(default=8.0, static=True)
    patience: int = eqx.field(default=10, static=True)
    memory: float = eqx.field(default=50.0, static=True)

    def __check_init__(self):
        for name in ("deviations", "memory"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"Gate: {name} must be a positive, finite number; got {value}")
        if self.memory < 1:
            raise InputError(f"Gate: memory must be a number of samples, 1 or more; got {self.memory}")
        if self.patience < 0:
            raise InputError(f"Gate: patience must be a number of samples, 0 or more; got {self.patience}")

    def judge(
        self,
        manifold: AbstractManifold,
        sample: Sample,
        memory: GateMemory,
        predicted: Velocity,
        usual: Matrix | None = None,
        least: Vector | float = 1.0,
    ) -> Judged:
        """Judge the measured components of an innovation by its covariance.

        In the average, a squared innovation counts at most as `BELIEVED` times the scale.

        Args:
            manifold: Manifold of the measured configurations; it says which components are measured together.
            sample: The innovation, at the end of the prediction by which `memory` was advanced.
            memory: Field `memory` of the verdict on the previous sample, advanced; `GateMemory.at_start` at the start.
            predicted: Velocity of the estimate.
            usual: Covariance (n, n) of the usual velocities, with zero mean; None (default) if the state contains no
                velocity, so that readings cannot correct it.
            least: Lower bound of the scale that widens the gate, a number or (n,); 1 by default.

        Returns:
            The verdict.
        """
        line, present, widening = memory.line(sample.innovation), sample.present, jnp.maximum(memory.scale, least)
        # For lines, the noise is at least the assumed one, as a scale below 1 only means that speeds or process noise
        # were assumed too large.
        noisier = jnp.maximum(memory.scale, 1.0)
        measured, far, even, moving, joined, continued = (jnp.zeros_like(present),) * 6
        square = memory.scale
        for together in manifold.measured_together(present.shape[0]):
            block, n = jnp.asarray(together), len(together)
            # A block is judged as a whole, so all of its components are needed.
            complete = jnp.all(present[block])
            # If the estimate is wrong, a reading that continues the last used one is still no outlier.
            innovation, width = sample.innovation[block], jnp.sqrt(widening[block])
            vectors = jnp.stack([innovation, innovation / width, line.change[block] / width], axis=1)
            whole, *narrowed = _mean_squares(sample.cov[jnp.ix_(block, block)], vectors)
            measured, square = measured.at[block].set(complete), square.at[block].set(whole)
            far = far.at[block].set(complete & (jnp.minimum(*narrowed) > self.limit(n) / n))
            noise = jnp.asarray(sample.noise)[jnp.ix_(block, block)] * noisier[block[0]]
            shape = _shape(jax.tree.map(lambda a, block=block: a[block], line), noise)
            shapes = zip((even, moving, joined, continued), shape, strict=True)
            even, moving, joined, continued = (a.at[block].set(b) for a, b in shapes)
        unequal = moving | ~even
        # A restart after long patience needs a complete configuration.
        patient = far & (memory.refused >= self.patience) & jnp.all(present)
        even, credible = even & far & (memory.refused >= 1), _credible(manifold, line, predicted, usual)
        straight = even & moving
        # All readings since the change of velocity are on the line; later in a burst, three in a row may be by chance.
        moved = straight & joined & (memory.refused <= 2) & credible
        # After a gap the motion before it tells nothing: three readings that agree with each other are accepted.
        possible = credible if usual is not None else jnp.ones_like(credible)
        moved = moved | (even & possible & (memory.refused >= 2) & (line.gap > HOLE * line.step))
        # These readings are within reach of motion, continue like motion or stay off in a fourth row, and are not equal
        # as after a slip. So the model or the noise is wrong, and the gate learns this without a cap.
        persistent = (memory.refused > 2) | (continued & (memory.refused >= 1))
        motion = far & unequal & persistent & _reached(manifold, line, usual)
        believed = jnp.where(motion, square, jnp.minimum(square, BELIEVED * memory.scale))
        scale = memory.scale + jnp.where(measured, (believed - memory.scale) / self.memory, 0.0)
        far = far & (moved | ~motion)
        restart, anew = jnp.any(patient | moved), present & (~far | patient | moved)
        velocity = predicted
        if usual is not None:
            # A restart after long patience also takes the velocity of the readings, if three of them agree.
            agreed = moved | (patient & straight & (memory.refused >= 2))
            mean = predicted.mean + jnp.where(agreed, line.slope, 0.0)
            cov = jnp.where(jnp.any(patient), usual, predicted.cov)
            velocity = Velocity(mean, with_block(cov, line.slope_cov(sample.noise, noisier), moved))
        return Judged(far, moved, restart, anew, velocity, memory.judged(line, present, far, scale))

    def limit(self, n: int) -> float:
        """The squared length that n standard Gaussian numbers exceed as rarely as a single one exceeds `deviations`."""
        from scipy.special import chdtrc, chdtri  # it loads slowly

        return float(chdtri(n, chdtrc(1, self.deviations**2)))


def _mean_squares(cov: Matrix, vectors: Float[Array, "n k"]) -> Float[Array, "k"]:
    """Squared lengths of k vectors by a covariance (n, n), divided by n; 1 on average if it is their covariance."""
    return jnp.sum(half_solve(cov, vectors) ** 2, axis=0) / len(vectors)


def _shape(line: Line, noise: Matrix) -> tuple[Flag, Flag, Flag, Flag]:
    """Whether the last three readings of a block are on a line, show motion, and start at the last used one, exactly
    or roughly.
    """
    step, length = line.step[0], line.length[0]
    columns = half_solve(noise, jnp.stack([line.slope, line.bend, line.change], axis=1)) / len(noise) ** 0.5
    slope, bend, change = columns.T
    displacement = slope @ slope * step**2
    # The bend combines the second difference of the noise, with the variance 1 + 4 + 1, and that of the motion.
    even = bend @ bend <= 6 * AGREEING**2 + BEND**2 * displacement
    # q is continuous, so the velocity changed at some time between the last used reading and the previous reading.
    since = jnp.clip(slope @ change / jnp.maximum(slope @ slope, jnp.finfo(slope.dtype).tiny), step, length)
    apart, steps = change - since * slope, since / step
    joined = apart @ apart <= AGREEING**2 * (1 + 2 * steps**2) + (BEND * steps) ** 2 * displacement
    return even, displacement >= MOVING**2, joined, joined | (apart @ apart <= ROUGHLY**2 * (change @ change))


def _credible(manifold: AbstractManifold, line: Line, predicted: Velocity, usual: Matrix | None) -> Bool[Array, "n"]:
    """Which components (n,) are measured together with a credible velocity; none if no usual velocity is known.

    Two readings are weak evidence of a line. They show a velocity only as after an impact, no faster than before or
    than usual. Three readings may show any credible velocity.
    """
    credible = jnp.zeros(line.slope.shape, bool)
    if usual is None:
        return credible
    for together in manifold.measured_together(len(usual)):
        block = jnp.asarray(together)
        before = predicted.mean[block]
        both = jnp.stack([before + line.slope[block], before], axis=1)
        after, before = _mean_squares(usual[jnp.ix_(block, block)], both)
        bound = jnp.where(line.refused[block] > 1, CREDIBLE**2, jnp.maximum(before, 1.0))
        credible = credible.at[block].set(after <= bound)
    return credible


def _reached(manifold: AbstractManifold, line: Line, usual: Matrix | None) -> Bool[Array, "n"]:
    """Which components (n,) may have reached their readings by motion at the usual speed, reversed at most two readings
    ago; so a large outlier that persists does not come into reach by waiting.
    """
    reached = jnp.zeros(line.change.shape, bool)
    if usual is None:
        return reached
    for together in manifold.measured_together(len(usual)):
        block = jnp.asarray(together)
        change = (line.change / (line.gap + line.step))[block, None]
        reached = reached.at[block].set(_mean_squares(usual[jnp.ix_(block, block)], change)[0] <= 4)
    return reached


def with_block(cov: Matrix, block: Matrix, places: Bool[Array, "n"]) -> Matrix:
    """A covariance with one block replaced by the block of another matrix, uncorrelated with the rest."""
    inside, outside = places[:, None] & places[None], ~places[:, None] & ~places[None]
    return jnp.where(inside, block, jnp.where(outside, cov, 0.0))


def start(manifold: AbstractManifold, q: Array, innovation: Vector, y: Array, anew: Bool[Array, "n"]) -> Array:
    """The configuration of a restart."""
    if manifold.redundant and manifold.commuting:
        return manifold.measured(q, jnp.where(anew, y, jnp.nan))
    partly = manifold.retract(q, manifold.shown(q, anew, jnp.where(anew, innovation, 0.0)))
    # In coordinates both are the same. A group element is used directly, without a logarithm in between.
    return partly if manifold.commuting else jnp.where(jnp.all(anew), manifold.measured(q, y), partly)


def judged(
    gate: Gate | None,
    manifold: AbstractManifold,
    sample: Sample,
    memory: GateMemory,
    predicted: Velocity,
    usual: Matrix | None,
) -> Judged:
    """Verdict of a gate; without a gate nothing is refused."""
    if gate is None:
        nothing = jnp.zeros_like(sample.present)
        velocity = predicted if usual is None else predicted._replace(cov=usual)
        return Judged(nothing, nothing, jnp.zeros((), bool), sample.present, velocity, memory)
    return gate.judge(manifold, sample, memory, predicted, usual)
