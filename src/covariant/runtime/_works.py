"""What works behind a stream: compiled C on buffers of its own, or a compiled program of JAX."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from covariant.lowering import LoweringError
from covariant.runtime._compile import missing
from covariant.runtime._kernel import Kernel, kernel


class InC:
    """Measurement `y`, input `u` and estimate `x` in arrays at fixed places, which C reads and writes."""

    def __init__(self, made: Kernel):
        states, estimates, infos = made.sizes
        names = [leaf.name for leaf in made.program.info for _ in range(leaf.size)]
        self.y, self.u = np.zeros(int(np.prod(made.program.y))), np.zeros(made.program.u)
        self.x, self.info, self.state = (np.zeros(size) for size in (estimates, infos, states))
        self._result = names.index("result")
        self._made = made  # it keeps the library loaded
        self._run, self._init = made.library.kernel_run, made.library.kernel_init
        point = made.pointer
        self._dt, self._told = made.ffi.new("double[1]"), point(self.info)
        self._pointers = point(self.state), 1, point(self.u), point(self.y), self._dt, point(self.x), self._told
        self._starts = self._pointers[3], self._pointers[0]

    def start(self, t: float) -> None:
        """Start at y, at the time t."""
        y, state = self._starts
        self._init(y, t, state)
        before = self.u.copy()
        self.u.fill(0.0)
        self.advance(0.0)  # a step of no length leaves the state as it is, and tells its estimate
        self.u[:] = before

    def advance(self, dt: float) -> int:
        """One step, in place; returns its result code."""
        self._dt[0] = dt
        self._run(*self._pointers)
        return int(self._told[self._result])


class InJax:
    """The same by JAX."""

    def __init__(self, observer: Any, y: np.ndarray, inputs: int):
        self._shape, self._observer = y.shape, observer
        self.y, self.u = np.zeros(y.size), np.zeros(inputs)
        self._step = eqx.filter_jit(_stepped)
        self._begin = eqx.filter_jit(lambda observer, y, t: observer.init(y, t))
        self._state = self._begin(observer, jnp.asarray(y), jnp.asarray(0.0))
        self._estimate = eqx.filter_jit(lambda observer, state: _flat(observer.estimate(state)))
        self.x = np.array(self._estimate(observer, self._state))

    def start(self, t: float) -> None:
        """Start at y, at the time t."""
        self._state = self._begin(self._observer, jnp.asarray(self.y.reshape(self._shape)), jnp.asarray(t))
        self.x[:] = self._estimate(self._observer, self._state)

    def advance(self, dt: float) -> int:
        """One step; returns its result code."""
        y = jnp.asarray(self.y.reshape(self._shape))
        self._state, x, code = self._step(self._observer, self._state, jnp.asarray(self.u), y, jnp.asarray(dt))
        self.x[:] = x
        return int(code)


def _stepped(observer, state, u, y, dt):
    state, info = observer.step(state, u, y, dt)
    return state, _flat(observer.estimate(state)), info.result


def _flat(x: Any) -> Any:
    return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(x)])


def engine(observer: Any, y: np.ndarray, inputs: int) -> tuple[str, InC | InJax]:
    """The name of the engine, with the reason where it is not C, and the engine for an observer."""
    why = missing()
    if why is None:
        try:
            return "c", InC(kernel(observer, y, inputs))
        except (LoweringError, OSError) as error:
            why = str(error)
    return f"jax: {why}", InJax(observer, y, inputs)
