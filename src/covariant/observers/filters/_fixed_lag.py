"""Fixed-lag smoother, sample by sample: estimates the state `lag` samples ago, from all samples up to now.

Buffers store, for the last `lag` samples, the states of the filter and the maps of its error back over each step. Each
sample adds an entry. The recursion of the smoother then runs back through the buffers to the oldest entry: it applies
the same maps of the error, in the same order, as `smooth` with the same lag.

Source: Moore 1973, Discrete-time fixed-lag smoothing algorithms, Automatica 9(2), for lags in a stream; for the rest
see `smooth`.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Inexact

from covariant._typing import Matrix, Number, Scalar
from covariant.models import MechanicalSystem
from covariant.observers.base import AbstractObserver, AbstractWrapper, Fields, LastInput, State
from covariant.observers.filters._gated_filter import AbstractGatedFilter, GatedFields
from covariant.observers.filters._smoother import (
    Backward,
    Smoothing,
    backward_map,
    error_before,
    recorded,
    smoothed_state,
)
from scalargraph.errors import InputError

OF_NOW = ("gate", "last_input", "readings", "sensor_gates")
"""Fields of the state of a filter that only its next step needs; buffers do not store them."""


class Prediction(NamedTuple):
    """A prediction that no measurement has corrected yet.

    Attributes:
        before: State of the filter before the prediction, without the fields that buffers do not store.
        root: Square root S (N, N) of the covariance of that state.
        carried: ΦS (N, N), with the transition matrix Φ of the error over the prediction.
    """

    before: Fields
    root: Matrix
    carried: Matrix


class FixedLagState(NamedTuple):
    """State of a `FixedLag`: the filter now, and buffers of L samples, the oldest first.

    Until L samples have arrived, copies of the first fill the buffers.

    Attributes:
        now: State of the filter.
        smoothed: State of the filter L samples ago, moved to the smoothed estimate.
        t: Times (L + 1,) [s]: of the smoothed estimate, of the samples since, and now.
        past: States of the filter at L samples, with an axis of L in front of each field.
        steps: Maps over the L steps since the oldest sample, each from the error after a step to the error before it.
        last_input: The last finite input (m,), or None for a filter that stores none.
        prediction: The last prediction, between `predict` and `correct` only; None otherwise.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> ekf = observers.EKF(models.oscillator(), jnp.eye(1), 1e-4 * jnp.eye(1), substeps=1)
        >>> state = observers.FixedLag(ekf, lag=5).init(jnp.array([0.3]), t=2.0)
        >>> state.t.tolist(), state.past.q.shape
        ([2.0, 2.0, 2.0, 2.0, 2.0, 2.0], (5, 1))
    """

    now: GatedFields
    smoothed: Fields
    t: Float[Array, "L1"]
    past: Fields
    steps: Backward
    last_input: LastInput = None
    prediction: Any = None


class FixedLagWindow(NamedTuple):
    """Estimates of the last L + 1 samples, each from all samples up to now; the last is that of the filter.

    Attributes:
        t: Times (L + 1,) [s].
        estimate: Estimates, as the filter returns them, with an axis of L + 1 in front.
        std: Standard deviations (L + 1, N), as in `Smoothed.std`.

    Example:
        >>> import jax.numpy as jnp
        >>> from covariant import models, observers
        >>> ekf = observers.EKF(models.oscillator(), jnp.eye(1), 1e-4 * jnp.eye(1), substeps=1)
        >>> delayed = observers.FixedLag(ekf, lag=2)
        >>> delayed.window(delayed.init(jnp.array([0.3]))).estimate.tolist()
        [[0.3, 0.0], [0.3, 0.0], [0.3, 0.0]]
    """

    t: Float[Array, "L1"]
    estimate: Any
    std: Float[Array, "L1 N"]


class FixedLag(AbstractWrapper):
    """A filter whose estimates come `lag` samples late and use the samples since.

    `estimate` belongs to the time `state.t[0]`, `lag` samples before the last one. It equals the result of `smooth`
    with this lag for that row, and the info has its standard deviations and slow states. Innovation and result are
    those of the last sample. During the first `lag` samples, the estimate is that of the first one. `window` returns
    the estimates of all samples since, for the end of a stream or a display. A step costs `lag` steps of the smoother
    and one of the filter.

    Use it if a delay of some samples is acceptable, as in monitoring or a display: its errors are clearly smaller than
    those of the filter. For complete logs use `smooth`.

    Args:
        observer: A filter with a covariance and a gate: `IntrinsicKalman`, `EKF`, `UKF`, `JointKalman` or `StateEKF`.
        lag: Number of samples L, 1 or more.

    Raises:
        ValueError: The observer is of another kind, or the lag is less than 1.

    Example:
        The velocity of a noisy oscillation, estimated thirty samples late and by the filter at once:

        >>> import numpy as np
        >>> from covariant import Record, models, observers
        >>> t = np.linspace(0.0, 4.0, 401)
        >>> y = np.cos(t) + 0.01 * np.random.default_rng(0).normal(size=401)
        >>> ekf = observers.EKF(models.oscillator(), np.array([[1e-2]]), np.array([[1e-4]]), substeps=1)
        >>> record = Record(t, np.zeros((401, 1)), y[:, None])
        >>> late, now = (np.asarray(observers.run(o, record).estimate) for o in (observers.FixedLag(ekf, 30), ekf))
        >>> errors = np.abs(late[30:, 1] + np.sin(t[:-30])), np.abs(now[:-30, 1] + np.sin(t[:-30]))
        >>> bool(errors[0].mean() < 0.5 * errors[1].mean())
        True
    """

    observer: AbstractGatedFilter
    lag: int = eqx.field(static=True)

    def __init__(self, observer: AbstractObserver, lag: int):
        if not isinstance(observer, AbstractGatedFilter):
            raise InputError(
                f"FixedLag: {type(observer).__name__} has no covariance of its own to smooth by; take an "
                "IntrinsicKalman, EKF, UKF, JointKalman or StateEKF"
            )
        if lag < 1:
            raise InputError(f"FixedLag: lag must be a number of samples, 1 or more; got {lag}")
        self.observer, self.lag = observer, lag

    @property
    def model(self) -> MechanicalSystem | Any:
        """Model of the filter; None for one without."""
        return getattr(self.observer, "model", None)

    def init(self, y: Inexact[Array, "*n"], t: Number = 0.0) -> FixedLagState:
        """State at a measured configuration, whose copies fill the buffers.

        Args:
            y: First measurement, complete: coordinates (n,), or on a group a matrix (N, N).
            t: Its time stamp [s], 0 by default.

        Returns:
            The state.
        """
        first = self.observer.init(y, t)
        last_input = first.last_input if "last_input" in first._fields else None
        root = self.observer.root(first)
        # Nothing happened before the first sample, so the steps in the buffers leave the error unchanged.
        nothing = Backward(jnp.zeros_like(root[0]), jnp.eye(len(root), dtype=root.dtype), jnp.zeros_like(root))
        times = jnp.full(self.lag + 1, jnp.asarray(t, root.dtype))
        oldest = _without(first, OF_NOW)
        past, steps = jax.tree.map(lambda a: jnp.broadcast_to(a, (self.lag, *jnp.shape(a))), (oldest, nothing))
        return FixedLagState(_without(first, ("last_input",)), oldest, times, past, steps, last_input)

    def estimate(self, state: FixedLagState) -> Any:
        """Smoothed estimate of the sample `lag` before the last one.

        Args:
            state: State of this observer.

        Returns:
            The estimate, as the filter returns it.
        """
        return self.observer.estimate(state.smoothed)

    def predict(self, state: FixedLagState, u: Float[Array, "m"], dt: Scalar) -> FixedLagState:
        """Predict by the filter; `correct` shifts the buffers.

        Args:
            state: State after the previous sample.
            u: Input (m,), constant over dt.
            dt: Length of the prediction [s].

        Returns:
            The predicted state.

        Raises:
            ValueError: The state is predicted already; a sample without a measurement is corrected with NaN.
        """
        if state.prediction is not None:
            raise InputError(
                "FixedLag: correct a predicted state before the next prediction; NaN marks what is not measured"
            )
        now, carried = self.observer.carried(state.now, u, dt)
        before = Prediction(_without(state.now, OF_NOW), self.observer.root(state.now), carried)
        times = jnp.append(state.t[1:], state.t[-1] + dt)
        return state._replace(now=now, t=times, prediction=before)

    def correct(self, state: FixedLagState, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> tuple[FixedLagState, Any]:
        """Correct the filter, and smooth back through the buffer.

        Args:
            state: State that `predict` returned.
            u: Input (m,) that acted over the prediction.
            y: Measurement, NaN where missing.

        Returns:
            The state, and the info of the filter with the standard deviations and slow states of the estimate.
        """
        before, root, carried = state.prediction
        now, info, step = recorded(self.observer, root, carried, state.now, u, y)

        def appended(buffer, last):
            return jnp.concatenate([buffer[1:], last[None]])

        def back(error, step):
            return error_before(error, step), None

        past, steps = jax.tree.map(appended, (state.past, state.steps), (before, backward_map(step)))
        oldest = jax.lax.scan(back, self._error(now), steps, reverse=True)
        smoothed, _ = smoothed_state(self.observer, jax.tree.map(lambda a: a[0], past), oldest[0])
        new = state._replace(now=now, smoothed=smoothed, past=past, steps=steps, prediction=None)
        return new, info._replace(**self.observer.deviations(smoothed))

    def innovation(self, state: FixedLagState, u: Float[Array, "m"], y: Inexact[Array, "*n"]) -> Any:
        return self.observer.innovation(state.now, u, y)

    def window(self, state: FixedLagState) -> FixedLagWindow:
        """Estimates of the last `lag + 1` samples, each from all samples up to now.

        Args:
            state: State of this observer.

        Returns:
            Times, estimates and standard deviations, the oldest first. They are the last rows of `smooth`. Until
            `lag` samples have arrived, copies of the first one fill the remaining rows.
        """

        def earlier(error, step):
            before = error_before(error, step)
            return before, before

        last = self._error(state.now)
        errors = jax.lax.scan(earlier, last, state.steps, reverse=True)[1]
        now = _without(state.now, OF_NOW)
        states, errors = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), (state.past, errors), (now, last))

        def estimated(state, error):
            new, root = smoothed_state(self.observer, state, error)
            return self.observer.estimate(new), jnp.sqrt(jnp.sum(root**2, axis=-1))

        return FixedLagWindow(state.t, *jax.vmap(estimated)(states, errors))

    def _error(self, state: GatedFields) -> Smoothing:
        """Mean and root of the covariance of the filter's error now."""
        root = self.observer.root(state)
        return Smoothing(jnp.zeros_like(root[0]), root)


def _without(state: State, names: tuple[str, ...]) -> State:
    """A state with None in the named fields that it has."""
    return state._replace(**{name: None for name in names if name in state._fields})
