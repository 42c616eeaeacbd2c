"""Learns the size of a filter's unknown noise on line, from the filter's own innovations.

The variance of the unknown, of forgotten forces or else of the process noise, is s times the initial setting, and s ≥ 1
is adapted to the log. With D = ∂P/∂log s and d = ∂x̂/∂log s, a row with the correction δ shows how much likelier a
larger s would have made its innovation. In the basis of a root R of the predicted covariance, P⁻ = R Rᵀ, with
e = R⁻¹δ, M = R⁻¹P⁺R⁻ᵀ, E = R⁻¹DR⁻ᵀ and c = R⁻¹d, the correlation of e with the effect of older corrections is

    g = eᵀc,   i = cᵀ(I − M)c,   E ← M E M,   c ← M(c + E e),

for any kind of measurement: g is 0 on average if the gains are optimal, and its derivative in log s is −i. The part of
the likelihood that depends on the size of innovations, ½ tr((I − M)E) for each unit above 1, counts only if they are
smaller than expected, because larger sensor noise than assumed must not raise the gains. A scoring step,
g/(1/`SPREAD` + i), changes log s. If the model is right, s stays near 1; if it is wrong, the covariance and the gains
grow, in the limit to those of a filter without a model.

Source: Mehra 1970, On the identification of variances and adaptive Kalman filtering, IEEE TAC 15(2); Gupta & Mehra
1974, Computational aspects of maximum likelihood estimation and reduction in sensitivity function calculations, IEEE
TAC 19(6), for the sensitivities; Ljung & Söderström 1983, Theory and Practice of Recursive Identification.
"""

import math
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from covariant._linalg import lower_solve
from covariant._typing import Flag, Matrix, Scalar, Vector

SPREAD = 0.5
"""Prior variance of log s, relative to the rows in memory."""
MEMORY = 20.0
"""Information after which a change of log s is forgotten: that of 40 independent numbers that depend on s alone."""
HELD = 2
"""Number of latest rows whose corrections are not correlated with an innovation, as their noise may be correlated."""
LARGEST = math.log(1e6)
"""Largest log s, so that the covariance fits into single precision."""


class NoiseScale(NamedTuple):
    """The learnt size of a filter's unknown noise, with the sensitivities needed to learn it.

    Attributes:
        log: Logarithm of s, the variance of the unknown relative to the initial setting.
        cov: Derivative ∂P/∂log s (N, N) of the covariance of the error.
        estimates: Derivative (N, 1 + H) of the estimate: by corrections that are `HELD` rows old or older, then by each
            of the newer ones, the oldest first.
    """

    log: Scalar
    cov: Float[Array, "N N"]
    estimates: Float[Array, "N H1"]

    @classmethod
    def at_start(cls, root: Matrix) -> "NoiseScale":
        """The scale 1 for a filter whose covariance has the root (N, N)."""
        return cls(jnp.zeros((), root.dtype), jnp.zeros_like(root), jnp.zeros((root.shape[0], HELD + 1), root.dtype))

    @property
    def factor(self) -> Scalar:
        """The variance s, relative to the initial setting."""
        return jnp.exp(self.log)

    def advanced(self, transition: Matrix, noise: Float[Array, "N m"]) -> "NoiseScale":
        """The scale after a prediction; the unknown adds noise with this root at its present size."""
        cov = transition @ self.cov @ transition.T + noise @ noise.T
        return self._replace(cov=cov, estimates=transition @ self.estimates)

    def corrected(
        self, root: Matrix, after: Matrix, correction: Vector, reset: Matrix, restart: Flag, size: Scalar
    ) -> "NoiseScale":
        """The scale after a correction.

        The lower triangular `root` is that of the covariance before; `after` is a root of the covariance after the
        correction and before the reset; `size` is the mean square of innovations relative to the expected one.
        """
        k = root.shape[0]
        columns = jnp.concatenate([self.cov, after, correction[:, None], self.estimates], axis=1)
        solved = lower_solve(root, columns)
        left, remaining, e, each = solved[:, :k], solved[:, k : 2 * k], solved[:, 2 * k], solved[:, 2 * k + 1 :]
        share = lower_solve(root, left.T)
        kept = remaining @ remaining.T
        e = e / jnp.sqrt(jnp.maximum(size, 1.0))
        c = each[:, 0]
        score = e @ c + jnp.minimum(size - 1.0, 0.0) / 2 * (jnp.trace(share) - jnp.sum(kept * share))
        information = c @ (c - kept @ c)
        step = score / (1 / SPREAD + information)
        # An upward step applies to s instead of its logarithm; otherwise the square of an outlier would count in full.
        step = jnp.where(step > 0, jnp.log1p(jnp.maximum(step, 0.0)), step)
        log = jnp.clip((1 - jnp.minimum(information / MEMORY, 0.5)) * self.log + step, 0.0, LARGEST)
        into = reset @ root
        cov = into @ (kept @ share @ kept) @ into.T
        each = jnp.concatenate([each, (share @ e)[:, None]], axis=1)
        each = jnp.concatenate([each[:, :1] + each[:, 1:2], each[:, 2:]], axis=1)
        estimates = into @ (kept @ each)
        # After a restart, nothing depends on earlier noise.
        gone = restart | ~jnp.isfinite(score)
        return NoiseScale(
            jnp.where(gone, self.log, log), jnp.where(gone, 0.0, (cov + cov.T) / 2), jnp.where(gone, 0.0, estimates)
        )


def scaled(
    scale: NoiseScale | None, transition: Matrix, noise: Float[Array, "N m"], unknown: Bool[Array, "N 1"] | bool = True
) -> tuple[Float[Array, "N m"], NoiseScale | None]:
    """The root of a prediction's noise, with its `unknown` rows at the learnt size, and the scale after it."""
    if scale is None:
        return noise, None
    noise = jnp.where(unknown, jnp.sqrt(scale.factor) * noise, noise)
    return noise, scale.advanced(transition, jnp.where(unknown, noise, 0.0))


def factor_of(scale: NoiseScale | None, like: Scalar) -> Scalar:
    """The variance s of the unknown; 1 for a filter that is not adaptive."""
    return jnp.ones_like(like) if scale is None else scale.factor
