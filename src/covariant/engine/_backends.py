"""Executes the steps of a stream: by compiled C on its buffers, or by a compiled program of JAX."""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.engine._choice import EngineName, choose_open
from covariant.engine._kernel import Kernel, KernelForm
from covariant.observers import AbstractObserver


class CBackend:
    """Compiled C that works on buffers at fixed addresses; the observer's open numbers (K,) are its arguments.

    Attributes:
        state: State of the observer, as a flat array.
        y, u: Measurement and input that the next step reads, as flat arrays.
        x, info: Estimate and info that a step writes, as flat arrays.
        places: Buffers of the bytes of y and u.
        advance: `dt -> code`: one step of dt [s], in place.
    """

    def __init__(self, kernel: Kernel, numbers: np.ndarray, input_at_end: bool = False):
        states, estimates, infos = kernel.sizes
        count = kernel.library.kernel_fixed()
        sizes = (states, kernel.layout.u, int(np.prod(kernel.layout.y)), estimates, infos, count)
        self._numbers = np.zeros(sum(sizes))  # one array, so that a call passes one pointer
        self.state, self.u, self.y, self.x, self.info, fixed = np.split(self._numbers, np.cumsum(sizes)[:-1])
        self._open = np.ascontiguousarray(numbers)
        kernel.library.kernel_fix(kernel.pointer(self._open), kernel.pointer(fixed))
        self._input_at_end = input_at_end
        self._kernel = kernel  # this reference keeps the library loaded
        self._t = np.zeros(1)
        self._starts = tuple(map(kernel.pointer, (self.y, self._t, self.state)))
        self.places: Any = tuple(kernel.ffi.buffer(kernel.pointer(a), a.nbytes) for a in (self.y, self.u))
        """Buffers of the bytes of a measurement and an input; writing to them is faster than to NumPy arrays."""
        self.advance = functools.partial(kernel.library.kernel_step, kernel.pointer(self._numbers))
        """One step of dt, in place; returns its result code."""

    def start(self, t: float) -> None:
        """Start the observer at rest at the measurement in `y`, at the time t [s], and write its estimate to `x`."""
        self._t[0] = t
        self._kernel.library.kernel_init(self._kernel.pointer(self._open), *self._starts)
        u = self.u.copy()
        if not self._input_at_end:
            self.u.fill(0.0)
        # A step of zero length writes the estimate and leaves the state unchanged, except for the input it stores.
        self.advance(0.0)
        self.u[:] = u


class JaxBackend:
    """A compiled program of JAX with the attributes and methods of `CBackend`."""

    def __init__(self, observer: AbstractObserver, y: np.ndarray, inputs: int):
        self._shape, self._observer = y.shape, observer
        self.y, self.u = np.zeros(y.size), np.zeros(inputs)
        self.places: Any = tuple(map(memoryview, (self.y, self.u)))  # pyright: ignore[reportArgumentType]
        self._step = eqx.filter_jit(_step_observer)
        self._begin = eqx.filter_jit(lambda observer, y, t: observer.init(y, t))
        self._state = self._begin(observer, jnp.asarray(y), jnp.asarray(0.0))
        self._estimate = eqx.filter_jit(lambda observer, state: _flat(observer.estimate(state)))
        self.x = np.array(self._estimate(observer, self._state))

    def start(self, t: float) -> None:
        """Start the observer at rest at the measurement in `y`, at the time t [s], and write its estimate to `x`."""
        self._state = self._begin(self._observer, jnp.asarray(self.y.reshape(self._shape)), jnp.asarray(t))
        if self._observer.input_at_end:
            self.advance(0.0)
        self.x[:] = self._estimate(self._observer, self._state)

    def advance(self, dt: float) -> int:
        """Do one step of dt [s] with the measurement in `y` and the input in `u`; returns its result code."""
        y = jnp.asarray(self.y.reshape(self._shape))
        self._state, x, code = self._step(self._observer, self._state, jnp.asarray(self.u), y, jnp.asarray(dt))
        self.x[:] = x
        return int(code)


def _step_observer(observer, state, u, y, dt):
    state, info = observer.step(state, u, y, dt)
    return state, _flat(observer.estimate(state)), info.result


def _flat(x: object) -> Any:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(x)])


def backend(observer: Any, y: np.ndarray, inputs: int, asked: EngineName) -> tuple[str, CBackend | JaxBackend]:
    """Engine and backend for a stream of an observer."""
    # A stream has no last row, so its number of rows is infinite.
    chosen, (numbers,) = choose_open([observer], KernelForm(y.shape, inputs), math.inf, asked)
    if chosen.kernel is None:
        return str(chosen), JaxBackend(observer, y, inputs)
    return str(chosen), CBackend(chosen.kernel, numbers, observer.input_at_end)
