"""The probability of logs under a model and noise, as a function of both: what is fitted, and what judges a fit.

The innovations of a Kalman filter along the logs are white if model and noise are right, and their probability is that
of the logs. The filter is that of the linear model of errors along a motion near the readings, as in `_error_model`;
each evaluation moves this motion to the smoothed one, so that the filter is linearised where the motion is. A large
process noise makes every row a prediction of its own, so that the search cannot lose the motion; as the noise falls,
the stretches over which the model predicts grow to the whole log. There are no windows to choose.

Source: Schweppe 1965, Evaluation of likelihood functions for Gaussian signals, IEEE TIT 11(1); Bell 1994, The iterated
Kalman smoother as a Gauss–Newton method, SIAM Journal on Optimization 4(3); Ljung 1999, System Identification, 7.4.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from covariant._linalg import known_rms
from covariant.calibration._least_squares import STD_OF_MEDIAN, Blocks, robust
from covariant.calibration.identification._error_model import VAGUE, ErrorModel, NoiseLevels, kalman, smoothed
from covariant.calibration.identification._predict import FAR, PredictionErrors
from covariant.calibration.identification._rows import Rows
from covariant.calibration.identification._unknowns import Unknowns
from covariant.geometry import AbstractManifold
from covariant.models import Motion
from covariant.signals import AnyArray

USUAL, FINEST = 1e-3, 1e-6
"""Usual and least noise of a reading, as fractions of the motion: below the least is rounding."""
RANGE = 1e4
"""Ratio of the bounds of a noise to what explains all motion."""
REACH = np.log(20.0)
"""How far the logarithm of a noise may move in a search, which is one of many."""
DIFFERENCE = 1e-4
"""Change of the logarithm of a noise by which a derivative is taken: far above rounding, far below what counts."""
QUIET = np.log(1e-12)
"""Logarithm of a noise that is none."""
GAINED, PRECISE = 0.2, 1e-3
"""Decreases of twice the negative log-likelihood in a round, and in a step for noise, below which a search ends."""
BEYOND = 1e100
"""Error in standard deviations that is as good as any larger one."""
MOVES = 4
"""How often the motion of a window is moved to the best one with the model's equations."""

NumpyArray = np.ndarray

_filtered = eqx.filter_jit(kalman)


class Likelihood(NamedTuple):
    """The negative log-likelihood of rows of logs, by blocks, at given noise.

    Attributes:
        unknowns: The unknown numbers of the model.
        rows: The rows.
        substeps: Runge–Kutta steps from a row to the next.
        noise: Noise levels.
        speed: Standard deviation of velocities where a stretch begins.
        pushes: The input matrix of the error model, held while parameters move: numbers that make a machine heavier
            must not gain by making the force that nobody knows weaker.
    """

    unknowns: Unknowns
    rows: Rows
    substeps: Any
    noise: NoiseLevels
    speed: Any
    pushes: Any = None

    def blocks(self, z: NumpyArray, kept: Any = None) -> Blocks:
        """The loss and its derivatives at z (p,); `kept` is what the last point has kept, near which that at z is."""
        run = self.rows.start if kept is None else self.moved_run(z, kept)
        # A motion that a step has carried beyond all numbers is judged as it was before.
        run = run if kept is None or np.isfinite(run.v).all() else kept.run
        system = self.linear(z, run)
        pushes, system = system.input_matrix, self.with_force(system)
        result = _filtered(system, self.noise, self.speed, VAGUE)
        e, slope, spread = (np.asarray(each) for each in (result.innovation, result.slope, result.spread))
        seen = spread != 0  # a variance that rounding made negative is not a number, and no row without a reading
        size = np.where(seen, spread, 1.0)
        # Far from the truth a motion may be beyond all numbers; what is not finite is refused by the search.
        e = np.clip(e / size, -BEYOND, BEYOND)
        if len(self.unknowns.parts) > 1:  # readings of one machine may be rougher than those of another
            whose, sizes = self.rows.of_machine[:, None], np.where(seen, np.abs(e), np.nan)
            each = [STD_OF_MEDIAN * np.nanmedian(np.where(whose == m, sizes, np.nan)) for m in np.unique(whose)]
            rough = np.nan_to_num(np.array(each), nan=1.0)[np.searchsorted(np.unique(whose), whose)]
            e, size = e / rough, size * rough
        slope = slope / size[:, :, None]
        loss, weight = robust(e)
        first = np.flatnonzero(np.diff(np.asarray(self.rows.block), prepend=-1))

        def sums(terms: NumpyArray) -> NumpyArray:
            return np.add.reduceat(terms, first, axis=0)

        def curvatures(weights: NumpyArray) -> NumpyArray:
            root = (slope * np.sqrt(weights)[:, :, None]).reshape(-1, slope.shape[2])
            parts = np.split(root, first[1:] * slope.shape[1])
            return np.stack([part.T @ part for part in parts])

        scores = sums(np.einsum("ti,tip->tp", weight * e, slope))
        loss = sums(np.sum(loss + np.log(size), axis=1))
        majorised = np.sum(curvatures(weight), axis=0)
        return Blocks(loss, scores, majorised, curvatures(weight**3), Kept(z, run, system, pushes))

    def moved(self, z: NumpyArray, dz: NumpyArray) -> NumpyArray:
        """Unknowns (p,) after a step."""
        return self.unknowns.moved(z, dz)

    def lowest(self, z: NumpyArray) -> NumpyArray:
        """Least steps (p,) that bounds permit."""
        return self.unknowns.lowest(z)

    def linear(self, z: NumpyArray, run: Motion) -> ErrorModel:
        """The linear model of errors along a motion."""
        return self.unknowns.linearised(jnp.asarray(z), run, self.rows, self.substeps)

    def with_force(self, system: ErrorModel) -> ErrorModel:
        """The linear model with the force as it was at first."""
        return system if self.pushes is None else system._replace(input_matrix=self.pushes)

    def moved_run(self, z: NumpyArray, kept: "Kept") -> Motion:
        """The smoothed motion at z, by the linear model along one near it."""
        errors = _smoothed_at(kept.system, jnp.asarray(z - kept.z), self.noise, self.speed)
        return self.unknowns.along(kept.run, errors)

    def likelier(
        self, kept: "Kept", bounds: Float[NumpyArray, "k 2"], steps: int, without: Sequence[str] = ()
    ) -> tuple["Likelihood", float]:
        """The same with the likeliest noise within bounds, `without` forces or wiggles, and twice its negative
        log-likelihood."""
        (_, n), d = kept.system.residual.shape, kept.pushes.shape[2]
        system = without_slopes(kept.system)._replace(input_matrix=kept.pushes)
        start, entries = np.clip(logarithms(self.noise, n, d), *bounds.T), np.arange(len(bounds))
        wiggle = entries >= 2 + n + d
        groups = {"wiggle": wiggle, "forces": ~wiggle & ((entries < 1) | (entries > n))}
        held = np.any([np.zeros(len(bounds), bool), *(groups[name] for name in without)], axis=0)
        free, times = entries[~held], (entries == 1 + n + d) | (entries == entries[-1])
        start[held & ~times] = QUIET
        # The first step of L-BFGS-B goes as far as bounds let it, where filters of hardly any noise overflow.
        near = np.clip(bounds, (start - REACH)[:, None], (start + REACH)[:, None])
        best, loss = descend(start, free, near, [system], None, self.speed, steps, VAGUE)
        return self._replace(noise=levels(best, n, d), pushes=kept.pushes), loss


class Kept(NamedTuple):
    """What a point keeps for the next one: the unknowns, the motion, the linear model of errors along it, and its input
    matrix under the numbers there."""

    z: NumpyArray
    run: Motion
    system: ErrorModel
    pushes: Any


def without_slopes(system: ErrorModel) -> ErrorModel:
    """The linear model for numbers that are known."""
    return system._replace(slopes=system.slopes[:, :, :0], shown_slopes=system.shown_slopes[:, :, :0])


@eqx.filter_jit
def _smoothed_at(system: ErrorModel, dz: Array, noise: NoiseLevels, speed: Any) -> Array:
    """Errors with which numbers that change by dz explain the rows best."""
    defect, residual = system.defect + system.slopes @ dz, system.residual - system.shown_slopes @ dz
    changed = without_slopes(system._replace(defect=defect, residual=jnp.where(system.present, residual, 0.0)))
    return smoothed(changed, noise, speed, VAGUE)


def first_noise(
    unknowns: Unknowns, rows: Rows, system: ErrorModel, least: Float[NumpyArray, "n"] | None
) -> tuple[NoiseLevels, Float[NumpyArray, "k 2"]]:
    """Noise with which forces explain all motion, from which a search begins, and bounds of the logarithms of noise.

    `least` (n,) is the least noise of a reading, such as that of its quantum.
    """
    step, (_, n) = rows.step, system.residual.shape
    motion, rates = unknowns.sizes_of(rows)
    floor = np.maximum(FINEST * motion, 0.0 if least is None else least)
    noise = np.maximum(_roughness(unknowns.manifold, rows), floor)
    within = ~np.asarray(rows.fresh)[1 : len(rates)]
    acceleration = float(np.sqrt(np.mean((np.diff(rates, axis=0)[within] / step) ** 2))) + 1e-9
    gains = np.asarray(system.input_matrix)[:, np.asarray(system.driven[0])]
    force, white = acceleration / np.sqrt(np.mean(gains**2, axis=(0, 1))), USUAL * acceleration * np.sqrt(step)
    usual = np.log([white, *noise, *force, 8 * step, *noise, 8 * step])
    lower, upper = usual - np.log(RANGE), usual + np.log(RANGE)
    lower[1 : 1 + n] = np.log(floor)
    times = [1 + n + len(force), -1]
    lower[times], upper[times] = np.log(4 * step), np.log(step * max(len(rates), 8))
    return levels(usual, n, len(force)), np.stack([lower, upper], axis=1)


def _roughness(manifold: AbstractManifold, rows: Rows) -> Float[NumpyArray, "n"]:
    """Noise (n,) of readings by their fourth differences, in which a motion that they resolve hardly remains."""
    seen = ~np.asarray(jax.vmap(manifold.missing)(jnp.asarray(rows.y)[: rows.used]))
    # Of each coordinate the rows with a reading: positions may come at fewer rows than inputs.
    read = [jnp.asarray(rows.start.q)[np.flatnonzero(each)] for each in seen.T]
    steps = [np.asarray(jax.vmap(manifold.towards)(q[:-1], q[1:]))[:, j] for j, q in enumerate(read)]
    # White noise of one has a variance of 1 + 16 + 36 + 16 + 1 = 70 there.
    fourth = [np.median(np.abs(np.diff(each, 3))) if len(each) > 3 else 0.0 for each in steps]
    return STD_OF_MEDIAN / np.sqrt(70.0) * np.array(fourth)


def levels(z: AnyArray, n: int, d: int) -> NoiseLevels:
    """Noise of the logarithms of the noise of acceleration, readings (n,) and force (d,), of the force's time, and, if
    there are so many, of wiggles (n,) and their time."""
    each, force = jnp.exp(jnp.asarray(z)), 1 + n
    noise = NoiseLevels(each[0], each[1:force], each[force : force + d], each[force + d])
    if len(each) == force + d + 1:
        return noise
    return noise._replace(wiggle=each[force + d + 1 : -1], wiggle_time=each[-1])


def logarithms(noise: NoiseLevels, n: int, d: int) -> Float[NumpyArray, "k"]:
    """The logarithms that `levels` makes a noise of."""
    force, wiggle = np.broadcast_to(np.asarray(noise.force), d), np.broadcast_to(np.asarray(noise.wiggle), n)
    own = [float(noise.acceleration), *np.asarray(noise.measurement), *force, float(noise.force_time)]
    return np.log(np.maximum([*own, *wiggle, float(noise.wiggle_time)], 1e-300))


@eqx.filter_jit
def _losses(z: Float[Array, "k p"], system: ErrorModel, mask: Any, speed: Any, doubt: float) -> Float[Array, "k"]:
    """Twice the negative log-likelihood of the noise `levels(z)` for each row of z."""

    def loss(z):
        each = kalman(system, levels(z, system.residual.shape[1], system.input_matrix.shape[2]), speed, doubt).loss
        return jnp.sum(each if mask is None else jnp.where(mask, each, 0.0))

    return jax.vmap(loss)(z)


def total_loss(
    z: NumpyArray, systems: Sequence[ErrorModel], masks: Sequence[NumpyArray] | None, speed: Any, doubt: float = 1.0
) -> tuple[float, NumpyArray]:
    """Twice the negative log-likelihood of a noise over several logs, and its derivative."""
    # Differences, all in one pass, cost a fifth of a derivative by either mode of differentiation.
    points = jnp.asarray(np.concatenate([z[None], z + DIFFERENCE * np.eye(len(z))]))
    losses: Any = sum(
        np.asarray(_losses(points, system, None if masks is None else jnp.asarray(masks[k]), speed, doubt))
        for k, system in enumerate(systems)
    )
    return float(losses[0]), (losses[1:] - losses[0]) / DIFFERENCE


def descend(
    start: NumpyArray,
    free: NumpyArray,
    bounds: NumpyArray,
    systems: Sequence[ErrorModel],
    masks: Sequence[NumpyArray] | None,
    speed: Any,
    steps: int,
    doubt: float = 1.0,
) -> tuple[NumpyArray, float]:
    """The likeliest noise over the entries `free` of its logarithms, within their bounds, and its loss."""
    from scipy.optimize import minimize

    def at(z):
        full = start.copy()
        full[free] = z
        return full

    def cost(z):
        loss, slope = total_loss(at(z), systems, masks, speed, doubt)
        valid = np.isfinite(loss) and np.isfinite(slope[free]).all()
        return (loss, slope[free]) if valid else (np.inf, np.zeros(len(free)))

    inside = np.clip(start[free], *bounds[free].T)
    options = {"maxiter": steps, "ftol": PRECISE / max(abs(cost(inside)[0]), 1.0), "maxls": 10}
    minimum = minimize(cost, inside, jac=True, method="L-BFGS-B", bounds=bounds[free], options=options)
    return at(minimum.x), float(minimum.fun)


def window_errors(
    unknowns: Any, z: NumpyArray, rows: Rows, length: float, judged: Bool[NumpyArray, "T"]
) -> PredictionErrors:
    """Root mean square errors of the motion that a model predicts over windows [s], each from its best first motion."""
    t = np.asarray(rows.t)
    rows = rows.only(judged)
    begun = t[np.maximum.accumulate(np.where(rows.fresh, np.arange(len(t)), 0))]
    window = np.floor((t - begun) / length + 1e-9)
    rows = rows._replace(fresh=np.asarray(rows.fresh) | (np.diff(window, prepend=-1) != 0))
    size = np.maximum(unknowns.sizes_of(rows)[0] * length / rows.step / np.sqrt(rows.used), 1e-12)
    speed, steps = unknowns.speed(rows), unknowns.steps(z, rows)
    # Readings so rough that none is an outlier: their size does not matter where nothing else is uncertain.
    noise = NoiseLevels(jnp.asarray(0.0), jnp.asarray(size), jnp.asarray(0.0))
    problem = Likelihood(unknowns, jax.tree.map(jnp.asarray, rows), steps, noise, speed)
    run, off, system = problem.rows.start, np.zeros((0, 0)), problem.linear(z, problem.rows.start)
    for _ in range(MOVES):
        run = problem.moved_run(z, Kept(np.asarray(z), run, system, None))
        if not np.isfinite(run.v).all():
            return PredictionErrors(*np.full((2, len(size)), np.inf), windows=np.full((1, len(size)), np.inf))
        off = np.where(system.present, (now := problem.linear(z, run)).residual, np.nan)
        # Those far off the others are left out from the next time on.
        off[(off**2 > FAR * np.nanquantile(off**2, 0.9, axis=0)).any(axis=1)] = np.nan
        system = now._replace(residual=jnp.nan_to_num(off), present=jnp.asarray(np.isfinite(off)))
    slow = np.where(np.diff(t, prepend=-np.inf)[:, None] > 0, unknowns.slower(rows, run), np.nan)
    slow[~np.isfinite(off)] = np.nan
    first = np.flatnonzero(np.asarray(rows.fresh) & np.asarray(judged))
    total, count = (np.add.reduceat(part, first) for part in (np.nan_to_num(off**2), np.isfinite(off).astype(float)))
    windows = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return PredictionErrors(known_rms(off), known_rms(slow), windows)
