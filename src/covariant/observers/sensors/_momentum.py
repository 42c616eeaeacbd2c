"""Estimates external forces by the momentum observer, as a baseline.

It treats a velocity, usually a filtered derivative of the positions, as measured, and the model as exact. The force is
the part of the motion that the model does not explain. No acceleration is needed: the momentum `p = M v` changes by the
forces of the model, by `Cᵀv`, which is `½∂<v, v>` in coordinates, and by the external force.

Source: De Luca & Mattone 2003, Actuator failure detection and isolation using generalized momenta, ICRA; Haddadin,
De Luca & Albu-Schäffer 2017, Robot collisions: a survey, IEEE Transactions on Robotics 33(6), equation (27).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._typing import Number, Scalar, Vector
from covariant.geometry import derivative
from covariant.models import MechanicalSystem, applied_force, resistance
from covariant.observers.base import as_gain, check_positive
from covariant.signals import StampError, check_rounding
from scalargraph.errors import InputError


class ForceState(NamedTuple):
    """State of an observer of external forces.

    Attributes:
        t: Time [s] of the last sample.
        q: Its configuration.
        v: Its velocity (n,), in the frame.
        force: Estimated external force (n,), a covector in the frame [N or N m].

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> observers.MomentumObserver(models.oscillator(), gain=25.0).init(jnp.zeros(1), jnp.zeros(1)).force.tolist()
        [0.0]
    """

    t: Scalar
    q: Array
    v: Vector
    force: Vector


class MomentumObserver(Functional):
    """The residual of the generalised momentum, `r = K (p − p₀ − ∫(F + Cᵀv + r) dt)`: the external force, late by 1/K.

    It is the exact solution of `r' = K (f − r)` over each sample; f is the change of momentum per time that the forces
    F
    of the model do not explain, by the trapezoidal rule. So it is stable for every gain and interval.

    Attributes:
        model: Mechanical system.
        gain: Gain K [1/s], the inverse of its time constant.

    Raises:
        ValueError: The gain is not positive and finite.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> t = np.linspace(0.0, 1.0, 101)  # a unit mass on a unit spring, pushed by 2 N so that x = 2 (1 − cos t)
        >>> q, v = 2 * (1 - np.cos(t))[:, None], 2 * np.sin(t)[:, None]
        >>> momentum = observers.MomentumObserver(models.oscillator(), gain=10.0)
        >>> force = observers.observed_forces(momentum, t, np.zeros((101, 1)), q, v)
        >>> force[[0, 10, 100], 0].round(3).tolist()  # 2 (1 − exp(−10 t))
        [0.0, 1.264, 2.0]
    """

    model: MechanicalSystem
    gain: Scalar = eqx.field(converter=as_gain)

    def __check_init__(self):
        check_positive("MomentumObserver", gain=self.gain)

    def init(self, q: Array, v: Vector, t: Number = 0.0) -> ForceState:
        """State at the first sample, at which no force is known yet.

        Args:
            q: Configuration.
            v: Velocity (n,), in the frame.
            t: Its time [s].

        Returns:
            The state, its force zero.
        """
        return ForceState(jnp.asarray(t, v.dtype), q, v, jnp.zeros_like(v))

    def step(self, state: ForceState, u: Float[Array, "m"], q: Array, v: Vector, dt: Scalar) -> ForceState:
        """State at the next sample.

        The force stays unchanged if the input, or configuration or velocity of this or the previous sample, is not
        finite. A sample that is not later than the previous one changes nothing.

        Args:
            state: State at the previous sample.
            u: Input (m,) that acted in between.
            q: Configuration at the next sample.
            v: Velocity (n,) there, in the frame.
            dt: Time [s] between them.

        Returns:
            The state, with the force that is estimated there.
        """
        later = jnp.isfinite(dt) & (dt > 0)
        # The divisor 1 avoids 0/0; the state of such a step is not used.
        new = self._advance(state, u, q, v, jnp.where(later, dt, 1.0))
        # Position and velocity are stored even if they are not finite: then the next sample leaves the force unchanged.
        new = new._replace(force=jnp.where(jnp.all(jnp.isfinite(new.force)), new.force, state.force))
        return jax.tree.map(lambda a, b: jnp.where(later, a, b), new, state)

    def _advance(self, state: ForceState, u: Float[Array, "m"], q: Array, v: Vector, dt: Scalar) -> ForceState:
        space, end = self.model.space, state.t + dt
        change = space.lower(q, v) - space.lower(state.q, state.v)
        known = (self._rate(state.t, state.q, state.v, u) + self._rate(end, q, v, u)) / 2
        unexplained = change / dt - known
        force = state.force - jnp.expm1(-self.gain * dt) * (unexplained - state.force)
        return ForceState(end, q, v, force)

    def _rate(self, t: Scalar, q: Array, v: Vector, u: Float[Array, "m"]) -> Vector:
        """Rate (n,) of the momentum in the frame, from everything that the model contains."""
        space = self.model.space
        force = applied_force(self.model, t, q, u) + resistance(self.model, t, q, v, u)
        # (∂_v M) v − M B(v, v) is Cᵀv in coordinates, and on a group also ad*_v M v, by which the frame turns.
        turned = derivative(space.manifold, lambda x: space.lower(x, v), q, v)
        return force + turned - space.connection_force(q, v, v)


def observed_forces(
    observer: MomentumObserver,
    t: Float[Any, "_"],
    u: Float[Any, "_ m"],
    q: Float[Any, "_ ..."],
    v: Float[Any, "_ n"],
) -> Float[Array, "_ n"]:
    """Run a momentum observer over estimated motions.

    Use it as a baseline for contact or collision forces, with velocities from any estimator. It treats velocities and
    model as exact, so their errors appear as forces. An `IntrinsicKalman` with an `external_force` estimates motion and
    force together, and gives standard deviations.

    Args:
        observer: The observer.
        t: Stamps (T,) [s].
        u: Inputs (T, m), each of which acts from its stamp to the next.
        q: Configurations (T, ...).
        v: Velocities (T, n), in the frame.

    Returns:
        The forces (T, n); zero in the first row, at which no motion is known yet.

    Raises:
        ValueError: The arrays do not have the same number of rows, or have none.
        StampError: A stamp is not finite or goes back.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> t, still = np.linspace(0.0, 1.0, 101), np.zeros((101, 1))
        >>> momentum = observers.MomentumObserver(models.oscillator(), gain=10.0)
        >>> held = observers.observed_forces(momentum, t, still, still + 0.3, still)  # against the spring
        >>> round(held[-1, 0].item(), 3)
        0.3
    """
    lengths = {"t": len(t), "u": len(u), "q": len(q), "v": len(v)}
    if len(set(lengths.values())) > 1 or not len(t):
        raise InputError(
            f"observed_forces: t, u, q and v must have the same number of rows, at least one; they have {lengths}"
        )
    if not isinstance(t, Tracer):
        _check_stamps(np.asarray(t, float))
    return _scan(observer, *(jnp.asarray(each, float) for each in (t, u, q, v)))


def _check_stamps(t: np.ndarray) -> None:
    """Check that stamps are finite, do not decrease, and stay distinct in the precision of JAX."""
    wrong = ~np.isfinite(t) | (np.diff(t, prepend=t[:1]) < 0)
    if wrong.any():
        k = int(wrong.argmax())
        raise StampError(
            f"observed_forces: row {k + 1}: the stamp {t[k]:g} s is not finite or before that of row {k}; sort or "
            "split the log"
        )
    if len(t) > 1:
        check_rounding(t, jnp.result_type(float))


@eqx.filter_jit
def _scan(observer: MomentumObserver, t: Array, u: Array, q: Array, v: Array) -> Float[Array, "_ n"]:
    def step(state, sample):
        state = observer.step(state, *sample)
        return state, state.force

    first = observer.init(q[0], v[0], t[0])
    # The input of a row acts until the next row.
    _, forces = jax.lax.scan(step, first, (u[:-1], q[1:], v[1:], jnp.diff(t)))
    return jnp.concatenate([first.force[None], forces])
