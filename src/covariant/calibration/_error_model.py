"""The errors of a run as a linear system along it, on which a Kalman filter costs microseconds a sample.

Along a run of an observer, with the estimate x̂ after each sample, the true state is `x = x̂ ⊕ δ` with

    δ⁺ = F δ + c + G f + w,   r = Hδ + e,

where `x̂ ⊕ δ` moves along the retraction, c is what the model predicts beyond the next estimate, F its derivative, and r
the reading less the estimated position. f is a force that the model does not know, a random walk; w is white
acceleration, e the noise of a reading. F, G, c and r do not depend on the noise: one run of the model serves for all
noises, and the filter of this system is the extended Kalman filter to first order in the error of the run.

Source: Schweppe 1965, Evaluation of likelihood functions for Gaussian signals, IEEE TIT 11(1); Anderson & Moore 1979,
Optimal Filtering, section 10.1, for the likelihood. Huber 1981, section 7.7, for the weight of an outlier.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._typing import Flag, Scalar, Vector
from covariant.models import MechanicalSystem, Motion, advance

CREDIBLE = 5.0
"""Standard deviations beyond which an innovation is taken for an outlier: it pulls no more than one of this size."""
LONGEST_GAP = 5.0
"""After a step longer than so many usual ones the filter begins anew."""


class NoiseLevels(NamedTuple):
    """What a Kalman filter assumes of sensor and model.

    - `acceleration`: square root of the spectral density of the white acceleration noise, in every coordinate
      [rad/s² √s, or m/s² √s].
    - `measurement` (n,): standard deviation of one reading [rad or m].
    - `force`: standard deviation of what an unknown force changes by in a second [N or N m]; 0 for no such force.
    """

    acceleration: Scalar
    measurement: Vector
    force: Scalar


class ErrorModel(NamedTuple):
    """The system of errors along a run of T rows.

    - `transition` (T, 2n, 2n), `defect` (T, 2n): F and c of the step to each row.
    - `input_matrix` (T, n, n): the acceleration that a force makes.
    - `residual` (T, n): r, zero where `present` (T, n) says that nothing was measured.
    - `dt` (T,): length of the step to each row [s]; `fresh` (T,): rows at which the filter begins anew.
    """

    transition: Float[Array, "T n2 n2"]
    defect: Float[Array, "T n2"]
    input_matrix: Float[Array, "T n n"]
    residual: Float[Array, "T n"]
    present: Bool[Array, "T n"]
    dt: Float[Array, "T"]
    fresh: Bool[Array, "T"]


class Filtered(NamedTuple):
    """What the filter finds at each row.

    - `loss` (T, n): twice the negative logarithm of the likelihood of each number, without the constant.
    - `innovation`, `spread` (T, n): the innovations and their standard deviations, each after those before it in the
      row, so that they are independent.
    - `error` (T, 2n): δ after the row.
    """

    loss: Float[Array, "T n"]
    innovation: Float[Array, "T n"]
    spread: Float[Array, "T n"]
    error: Float[Array, "T n2"]


@eqx.filter_jit
def error_model(
    model: MechanicalSystem, q: Array, v: Float[Array, "T n"], t: Array, u: Array, y: Array, steps: int
) -> ErrorModel:
    """The errors along estimates q and v (T, n) of a run over a record; `steps` Runge–Kutta steps in each sample."""
    manifold, n = model.manifold, v.shape[1]
    dt = jnp.diff(t)

    def step(t, q, v, u, h, next_q, next_v):
        def ahead(error):
            start = Motion(manifold.retract(q, error[:n]), v + error[n:])
            end = advance(model, t, start, u, h, steps)
            return jnp.concatenate([manifold.local(next_q, end.q), end.v - next_v])

        nothing = jnp.zeros(2 * n, v.dtype)
        slope, defect = jax.jacfwd(lambda error: (ahead(error),) * 2, has_aux=True)(nothing)
        input_matrix = jax.vmap(model.space.raise_, (None, 0))(q, jnp.eye(n, dtype=v.dtype)).T
        return slope, defect, input_matrix

    moved = jax.vmap(step)(t[:-1], q[:-1], v[:-1], u[:-1], dt, q[1:], v[1:])
    sound = jnp.all(jnp.isfinite(moved[0]), axis=(1, 2)) & (dt <= LONGEST_GAP * jnp.median(dt))
    moved = [jnp.where(sound.reshape(-1, *[1] * (each.ndim - 1)), each, 0.0) for each in moved]
    transition, defect, input_matrix = (jnp.concatenate([jnp.zeros_like(each[:1]), each]) for each in moved)
    present = ~jax.vmap(manifold.missing)(y)
    residual = jnp.where(present, jax.vmap(manifold.towards)(q, y), 0.0)
    zero, fresh = jnp.zeros_like(dt[:1]), jnp.ones(1, bool)
    return ErrorModel(
        transition,
        defect,
        input_matrix,
        residual,
        present,
        jnp.concatenate([zero, dt]),
        jnp.concatenate([fresh, ~sound]),
    )


def kalman(errors: ErrorModel, noise: NoiseLevels, speed: Scalar | float) -> Filtered:
    """The Kalman filter of the system of errors; at the start velocities are known to `speed` [rad/s or m/s]."""
    n = errors.residual.shape[1]
    variance = noise.measurement**2
    # Before anything has been measured the force is that of a random walk of one second.
    first = jnp.diag(jnp.concatenate([variance, jnp.full(n, speed**2), jnp.full(n, noise.force**2)]))
    walk = jnp.zeros((3 * n, 3 * n)).at[2 * n :, 2 * n :].set(jnp.eye(n) * noise.force**2)

    def step(state, row):
        x, cov = state
        input_matrix = jnp.concatenate([row.dt**2 / 2 * row.input_matrix, row.dt * row.input_matrix])
        whole = jnp.block([[row.transition, input_matrix], [jnp.zeros((n, 2 * n)), jnp.eye(n)]])
        x = whole @ x + jnp.concatenate([row.defect, jnp.zeros(n)])
        cov = whole @ cov @ whole.T + row.dt * walk + _white(noise.acceleration, row.dt, n)
        now: Any = jnp.where(row.fresh, 0.0, x), jnp.where(row.fresh, first, cov)
        found: list[Any] = []
        for i in range(n):  # the noise of the readings is independent, so they are taken in one after the other
            *now, told = _reading(now[0], now[1], i, row.residual[i], variance[i], row.present[i])
            found.append(told)
        loss, innovation, spread = (jnp.stack(each) for each in zip(*found, strict=True))
        return tuple(now), Filtered(loss, innovation, spread, now[0][: 2 * n])

    return jax.lax.scan(step, (jnp.zeros(3 * n), first), errors)[1]


def _white(acceleration: Scalar, dt: Scalar, n: int) -> Float[Array, "m m"]:
    """Covariance that white acceleration adds to position, velocity and force."""
    both = acceleration**2 * jnp.stack([jnp.stack([dt**3 / 3, dt**2 / 2]), jnp.stack([dt**2 / 2, dt])])
    return jnp.zeros((3 * n, 3 * n)).at[: 2 * n, : 2 * n].set(jnp.kron(both, jnp.eye(n)))


def _reading(x: Vector, cov: Array, i: int, residual: Scalar, variance: Scalar, present: Flag):
    """The correction by one number; beyond `CREDIBLE` deviations it has the noise of an outlier of its size."""
    innovation, spread = residual - x[i], cov[i, i] + variance
    square = innovation**2 / spread
    limit = CREDIBLE**2
    far = jnp.maximum(square / limit, 1.0)
    gain = jnp.where(present, cov[:, i] / (spread * far), 0.0)
    kept = jnp.eye(len(x)) - jnp.outer(gain, jnp.eye(len(x))[i])
    noise = jnp.where(present, spread * far - cov[i, i], 0.0)
    cov = kept @ cov @ kept.T + noise * jnp.outer(gain, gain)
    loss = jnp.log(spread) + jnp.where(square > limit, limit * (1 + jnp.log(far)), square)
    told = (jnp.where(present, each, 0.0) for each in (loss, innovation, jnp.sqrt(spread)))
    return x + gain * innovation, cov, tuple(told)
