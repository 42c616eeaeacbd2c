"""A momentum observer that estimates velocities: the model's momentum, corrected by that of a filtered derivative."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.velocity.cases import Case
from benchmarks.velocity.estimators import AbstractEstimator, Estimate, Numbers
from benchmarks.velocity.estimators.differences import readings
from covariant.models import Motion, advance


class Momentum(AbstractEstimator):
    """The observer of external forces of De Luca & Mattone with its states read as velocities.

    `p̂' = F + Cᵀv̂ + r`, where the residual `r = K (M v − p̂)` compares with the momentum of a filtered derivative v, and
    the estimate is `v̂ = M⁻¹p̂`. Between readings the model moves (y, v̂) for one interval.
    """

    name, knows_model = "momentum", True
    source = "De Luca & Mattone 2003, with the velocity read from its momentum"

    def ranges(self, case: Case) -> dict[str, tuple[float, float]]:
        rate = case.loaded.rate
        return {"bandwidth": (0.02 * rate, 3.0 * rate), "gain": (0.002 * rate, 1.0 * rate)}

    def run(self, case: Case, numbers: Sequence[Numbers], rows: np.ndarray) -> list[Estimate]:
        t, y = readings(case, rows)
        u = np.asarray(case.loaded.record.u)[: len(t)]
        each = [jnp.array([one[name] for one in numbers]) for name in ("bandwidth", "gain")]
        v = _follow(case.model, jnp.asarray(t), jnp.asarray(y), jnp.asarray(u), *each)
        return [Estimate(one) for one in np.asarray(v)]


def _follow(model, t, y, u, bandwidths, gains):
    @jax.jit
    def all_of(t, y, u, bandwidths, gains):
        def one(bandwidth, gain):
            def step(state, sample):
                filtered, v = state
                begin, last, now, input_, h = sample
                difference = (now - last) / h
                filtered = filtered + (1 - jnp.exp(-bandwidth * h)) * (difference - filtered)
                v = advance(model, begin, Motion(last, v), input_, h, 2).v
                v = v + (1 - jnp.exp(-gain * h)) * (filtered - v)
                return (filtered, v), v

            rest = jnp.zeros(y.shape[1])
            samples = (t[:-1], y[:-1], y[1:], u[:-1], jnp.diff(t))
            return jnp.concatenate([rest[None], jax.lax.scan(step, (rest, rest), samples)[1]])

        return jax.vmap(one)(bandwidths, gains)

    return all_of(t, y, u, bandwidths, gains)


ESTIMATORS = [Momentum()]
