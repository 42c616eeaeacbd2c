"""Observer that copies the plant and injects the output error, with a gain that makes it contracting.

Source: Jouffroy & Fossen 2004, equation (12). Its Theorem 2 is replaced by the virtual system
`y' = f(t, y, u(t)) + K(z − h(t, y))`: plant and observer both are solutions of it, whatever generates the input u(t).
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
from covariant.observers.base import AbstractFlowObserver, Info, LastInput, as_gain, check_finite, no_input, still
from covariant.signals import StepCode
from scalargraph.errors import InputError

Injected = Callable[[Array, Array, Array, Array], Array]
"""`(t, x, u, z) -> (n,)`: f of the model with measured outputs z replacing states; it equals f if z = h(x)."""


class ContractingState(NamedTuple):
    """State of a `Contracting` observer.

    Attributes:
        x: Estimated state (n,).
        t: Time [s] of the state.
        unmeasured: Time [s] since each output (p,) was last measured.
        last_input: The last finite input (m,).

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> tank = models.StateSpace(lambda t, x, u: -2.0 * x, lambda t, x, u: x, coordinates=("level",), units=("m",))
        >>> observer = observers.Contracting(tank, gain=jnp.array([[3.0]]), start=jnp.array([1.0]))
        >>> state = observer.init(jnp.array([1.5]))
        >>> state = observer.predict(state, jnp.zeros(0), jnp.asarray(0.1))
        >>> state.unmeasured.tolist()
        [0.1]
    """

    x: Vector
    t: Scalar
    unmeasured: Float[Array, "p"]
    last_input: LastInput = None


class Contracting(AbstractFlowObserver):
    """Observer `x̂' = f(t, x̂, u) + K (z − h(t, x̂, u))` of a state-space model, equation (12).

    With sampled measurements the model runs between samples, and the correction is implicit,
    `x⁺ = x̂ + WK (I + h_x WK)⁻¹ (z − h)`, where W contains the weight [s] of each output: no gain makes the correction
    unstable, and for dt → 0 it becomes the differential equation.

    Use it for a model that is not mechanical, with a gain from `certificates.observer_gain` or your own design.
    `certificates.virtual` and `proofs.prove` show where it converges. `StateEKF` needs no design, but has no proof.

    Attributes:
        model: The system, with n states and p outputs.
        gain: K (n, p) [unit of the state / (s · unit of the output)], or a function `(t, z) -> (n, p)` of
            time and measured outputs.
        start: First estimate (n,).
        injected: f with measured outputs z in place of states, `(t, x, u, z) -> (n,)`; for instance a rotation by the
            measured heading instead of the estimated one. None (default) uses f itself.
        substeps: Number of Runge–Kutta steps of the model in each sample, 1 by default.
        memory: Upper bound [s], infinite by default, of the weight of an output, which is the time since it was last
            measured.

    Raises:
        ValueError: Gain, start and model do not fit each other, or the gain has an entry that is not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> tank = models.StateSpace(lambda t, x, u: -2.0 * x, lambda t, x, u: x, coordinates=("level",), units=("m",))
        >>> observer = observers.Contracting(tank, gain=jnp.array([[3.0]]), start=jnp.array([1.0]))
        >>> state = observers.continuous(observer.init(jnp.array([1.5])))
        >>> observer.flow(state.t, state, jnp.zeros(0), jnp.array([1.5])).x.tolist()  # −2 · 1 + 3 · (1.5 − 1)
        [-0.5]
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
            raise InputError(f"start has {n} entries; the model has {len(self.model.coordinates)} states")
        if callable(self.gain):  # it has no shape to check
            return
        if p and self.gain.shape != (n, p):
            raise InputError(
                f"gain must have a row for each of {n} states, a column for each of {p} outputs; its shape is "
                f"{self.gain.shape}"
            )
        check_finite("Contracting", gain=self.gain)

    def init(self, y: Float[Array, "p"], t: Number = 0.0) -> ContractingState:
        """State at the first estimate `start`.

        Args:
            y: First measurement (p,); only its shape and precision are used.
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        start = jnp.asarray(self.start, y.dtype)
        return ContractingState(start, jnp.asarray(t, y.dtype), jnp.zeros_like(y), no_input(self.model, start))

    def estimate(self, state: ContractingState) -> Vector:
        return state.x

    def virtual(self, t: Scalar, x: Vector, u: Float[Array, "m"], z: Float[Array, "p"]) -> Vector:
        """Right-hand side of the virtual system at x.

        Its Jacobian in x, at fixed u and z, must be contracting: if u depends on an estimate, it acts equally on plant
        and observer. Angles in z are not wrapped.

        Args:
            t: Time [s].
            x: State (n,).
            u: Input (m,).
            z: Complete measurement (p,).

        Returns:
            x' (n,).
        """
        injected_f = self.model.f(t, x, u) if self.injected is None else self.injected(t, x, u, z)
        return injected_f + self._gain(t, z) @ (z - self.model.h(t, x, u))

    def flow(self, t: Scalar, state: ContractingState, u: Float[Array, "m"], y: Float[Array, "p"]) -> ContractingState:
        expected = self.model.h(t, state.x, u)
        nearest = expected - self.model.output_error(expected, y)  # y, with angles shifted by 2π towards the expected
        slope, one = self.virtual(t, state.x, u, nearest), jnp.ones_like(state.t)
        return ContractingState(slope, one, jnp.zeros_like(state.unmeasured), still(state.last_input))

    def predict(self, state: ContractingState, u: Float[Array, "m"], dt: Scalar) -> ContractingState:
        x = rk4(lambda s, x: self.model.f(s, x, u), state.t, state.x, dt, self.substeps)
        return state._replace(x=x, t=state.t + dt, unmeasured=state.unmeasured + dt)

    def correct(
        self, state: ContractingState, u: Float[Array, "m"], y: Float[Array, "p"]
    ) -> tuple[ContractingState, Info]:
        """Correct a predicted state by the implicit formula; a missing output has weight 0.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement (p,), NaN where missing.

        Returns:
            The corrected state, and the info, whose distance is the Euclidean length of the correction.
        """
        x, time, elapsed, _ = state
        expected = self.model.h(time, x, u)
        missing = jnp.isnan(y)
        error = self.model.output_error(expected, y)
        weight = jnp.where(missing, 0.0, jnp.minimum(elapsed, self.memory))
        # output_error is h − z, so this is z, with angles shifted to the nearest turn.
        correction_gain = self._gain(time, expected - error) * weight[None, :]
        # One implicit Euler step of x' = −K (h − z) over the weight, with h linearised; its matrix is (I + h_x KW).
        effect = jnp.eye(y.shape[0], dtype=y.dtype) + jax.jacfwd(self.model.h, 1)(time, x, u) @ correction_gain
        # The matrix is small but not symmetric, so its normal equations are solved.
        correction = correction_gain @ solve(effect.T @ effect, effect.T @ error)
        corrected = x - correction
        result = jnp.where(jnp.all(missing), int(StepCode.COASTED), int(StepCode.OK))
        result = jnp.where(jnp.all(jnp.isfinite(corrected)), result, int(StepCode.NOT_FINITE)).astype(jnp.int32)
        new_state = state._replace(x=corrected, unmeasured=jnp.where(missing, elapsed, 0.0))
        return new_state, Info(-error, jnp.sqrt(correction @ correction), result)

    def _gain(self, t: Scalar, z: Float[Array, "p"]) -> Float[Array, "n p"]:
        return self.gain(t, z) if callable(self.gain) else jnp.asarray(self.gain, z.dtype)


def craft_observer(craft: Craft, k1: Numbers, k2: Numbers, start: Vector | None = None) -> Contracting:
    """Observer (101)–(102) of a craft: `η̂' = J(z)ν̂ + K1(z − η̂)`, `Mν̂' + (C(ν̂) + D(ν̂))ν̂ + g(z) = τ + Jᵀ(z)K2(z −
    η̂)`.

    It converges if K2 is symmetric positive definite. The metric `diag(K2, M)` shows this only if drag acts at rest; a
    metric with a cross term shows it in all cases. The paper's `K2 = I − K_p` is unstable for K_p > 1.

    Args:
        craft: The craft, with n coordinates and m velocities.
        k1: Gain K1 (n, n) [1/s].
        k2: Gain K2 (n, n) [N/m, N m].
        start: First estimate (η, ν) (n + m,), by default at rest at the origin.

    Returns:
        The observer, which estimates (η, ν) (n + m,).

    Raises:
        ValueError: A gain is not (n, n).

    Example:
        >>> import jax.numpy as jnp
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> ship = models.marine.surface_ship(np.eye(3), 0.1 * np.eye(3))
        >>> observer = observers.craft_observer(ship, k1=2.0 * np.eye(3), k2=3.0 * np.eye(3))
        >>> observer.gain(0.0, jnp.zeros(3)).diagonal().tolist()  # K1 above M⁻¹JᵀK2
        [2.0, 2.0, 2.0]
    """
    n, m = len(craft.coordinates), len(craft.velocities)
    gains = [np.asarray(k, float) for k in (k1, k2)]
    for name, k in zip(("k1", "k2"), gains, strict=True):
        if k.shape != (n, n):
            raise InputError(f"{name} must be square, ({n}, {n}); its shape is {k.shape}")

    def gain(t, z):
        first, second = (jnp.asarray(k, z.dtype) for k in gains)
        mass = jnp.asarray(craft.mass, z.dtype)
        return jnp.concatenate([first, solve(mass, craft.transform(z).T @ second)])

    def injected(t, x, u, z):
        nu = x[n:]
        return jnp.concatenate([craft.transform(z) @ nu, craft.acceleration(z, nu, u)])

    return Contracting(state_space(craft), gain, jnp.zeros(n + m) if start is None else start, injected)
