"""A copy of the plant with output injection, made contracting by its gain.

Source: Jouffroy & Fossen 2004, equation (12). In place of its Theorem 2 stands the virtual system
`y' = f(t, y, u(t)) + K(z − h(t, y))`: both plant and observer are solutions of it, whatever generates the input u(t).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from covariant._integrate import rk4
from covariant._linalg import solve
from covariant._typing import Number, Numbers, Scalar, Vector
from covariant.models import StateSpace, state_space
from covariant.models.marine import Craft
from covariant.observers._protocol import AbstractFlowObserver, Held, Info, as_gain, check_finite, no_input, still
from covariant.signals import Result

Injected = Callable[[Array, Array, Array, Array], Array]
"""`(t, x, u, z) -> (n,)`: the model's f with measured outputs z replacing states; it equals f where z = h(x)."""


class ContractingState(NamedTuple):
    """Estimated state, the time [s] it belongs to, the time [s] since each output was last measured (p,), and the last
    finite input `held`."""

    x: Vector
    t: Scalar
    unmeasured: Float[Array, "p"]
    held: Held = None


class Contracting(AbstractFlowObserver):
    """`x̂' = f(t, x̂, u) + K (z − h(t, x̂, u))`, equation (12).

    - `gain`: K (n, p), or a function `(t, z) -> (n, p)` of time and measured outputs.
    - `start` (n,): first estimate.
    - `injected`: f with measured outputs z in place of states, `(t, x, u, z) -> (n,)`; for instance a rotation by the
      measured heading instead of the estimated one. By default f itself.
    - `substeps`: Runge–Kutta steps of the model in each sample.
    - `memory` [s]: an output is weighted by the time since it was last measured, but by no more than this.

    With sampled measurements the model runs between samples, and the correction is implicit,
    `x⁺ = x̂ + WK (I + h_x WK)⁻¹ (z − h)`, where W holds the weight [s] of each output: no gain makes it unstable by
    itself, and for dt → 0 it is the differential equation.

    Raises `ValueError` where gain, start and model do not fit each other, or the gain has an entry that is not finite.
    """

    model: StateSpace
    gain: Float[Array, "n p"] | Callable[[Array, Array], Array]
    start: Vector
    injected: Injected | None = None
    substeps: int = eqx.field(default=1, static=True)
    memory: Scalar = eqx.field(default=jnp.inf, converter=as_gain)

    def __check_init__(self):
        n, p = self.start.shape[0], len(self.model.outputs)
        if self.model.coordinates and n != len(self.model.coordinates):
            raise ValueError(f"start has {n} entries; the model has {len(self.model.coordinates)} states")
        if not callable(self.gain) and p and self.gain.shape != (n, p):
            raise ValueError(
                f"gain must have a row for each of {n} states, a column for each of {p} outputs; "
                f"its shape is {self.gain.shape}"
            )
        if not callable(self.gain):
            check_finite("Contracting", gain=self.gain)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> ContractingState:
        start = jnp.asarray(self.start, y.dtype)
        return ContractingState(start, jnp.asarray(t, y.dtype), jnp.zeros_like(y), no_input(self.model, start))

    def estimate(self, state: ContractingState) -> Vector:
        return state.x

    def virtual(self, t: Scalar, x: Vector, u: Float[Array, "m"], z: Float[Array, "p"]) -> Vector:
        """The right-hand side x' (n,) of the virtual system at x under the input u and the complete measurement z.

        Angles in z are not wrapped. What has to be contracting is its Jacobian in x at fixed u and z: where u depends
        on an estimate, it acts on plant and observer alike.
        """
        copy = self.model.f(t, x, u) if self.injected is None else self.injected(t, x, u, z)
        return copy + self._gain(t, z) @ (z - self.model.h(t, x, u))

    def flow(self, t: Scalar, state: ContractingState, u: Float[Array, "m"], y: Float[Array, "p"]) -> ContractingState:
        expected = self.model.h(t, state.x, u)
        nearest = expected - self.model.output_error(expected, y)  # y, with angles shifted by 2π to be nearest
        slope, one = self.virtual(t, state.x, u, nearest), jnp.ones_like(state.t)
        return ContractingState(slope, one, jnp.zeros_like(state.unmeasured), still(state.held))

    def predict(self, state: ContractingState, u: Float[Array, "m"], dt: Scalar) -> ContractingState:
        x = rk4(lambda s, x: self.model.f(s, x, u), state.t, state.x, dt, self.substeps)
        return state._replace(x=x, t=state.t + dt, unmeasured=state.unmeasured + dt)

    def correct(
        self, state: ContractingState, u: Float[Array, "m"], y: Float[Array, "p"]
    ) -> tuple[ContractingState, Info]:
        x, now, waited, _ = state
        expected = self.model.h(now, x, u)
        missing = jnp.isnan(y)
        error = self.model.output_error(expected, y)
        weight = jnp.where(missing, 0.0, jnp.minimum(waited, self.memory))
        correction_gain = self._gain(now, expected - error) * weight[None, :]
        effect = jnp.eye(y.shape[0], dtype=y.dtype) + jax.jacfwd(self.model.h, 1)(now, x, u) @ correction_gain
        # The matrix is not symmetric, so its normal equations are solved; it is small.
        correction = correction_gain @ solve(effect.T @ effect, effect.T @ error)
        moved = x - correction
        result = jnp.where(jnp.all(missing), int(Result.COASTED), int(Result.OK))
        result = jnp.where(jnp.all(jnp.isfinite(moved)), result, int(Result.NOT_FINITE)).astype(jnp.int32)
        after = state._replace(x=moved, unmeasured=jnp.where(missing, waited, 0.0))
        return after, Info(-error, jnp.sqrt(correction @ correction), result)

    def _gain(self, t: Scalar, z: Float[Array, "p"]) -> Float[Array, "n p"]:
        return self.gain(t, z) if callable(self.gain) else jnp.asarray(self.gain, z.dtype)


def craft_observer(craft: Craft, k1: Numbers, k2: Numbers, start: Vector | None = None) -> Contracting:
    """Observer (101)–(102) of a craft: `η̂' = J(z)ν̂ + K1(z − η̂)`, `Mν̂' + (C(ν̂) + D(ν̂))ν̂ + g(z) = τ + Jᵀ(z)K2(z − η̂)`.

    - `k1` [1/s] and `k2` [N/m, N m] (n, n): gains. It converges where K2 is symmetric positive definite. The metric
      `diag(K2, M)` shows this only where drag acts at rest; a metric with a cross term shows it everywhere. The paper's
      `K2 = I − K_p` is unstable for K_p > 1.
    - `start` (2n,): first estimate (η, ν), by default at rest at the origin.

    Raises `ValueError` where a gain is not (n, n).
    """
    n = len(craft.coordinates)
    gains = [np.asarray(k, float) for k in (k1, k2)]
    for name, k in zip(("k1", "k2"), gains, strict=True):
        if k.shape != (n, n):
            raise ValueError(f"{name} must be square, ({n}, {n}); its shape is {k.shape}")

    def gain(t, z):
        first, second = (jnp.asarray(k, z.dtype) for k in gains)
        mass = jnp.asarray(craft.mass, z.dtype)
        return jnp.concatenate([first, solve(mass, craft.transform(z).T @ second)])

    def injected(t, x, u, z):
        nu = x[n:]
        return jnp.concatenate([craft.transform(z) @ nu, craft.acceleration(z, nu, u)])

    return Contracting(state_space(craft), gain, jnp.zeros(2 * n) if start is None else start, injected)
