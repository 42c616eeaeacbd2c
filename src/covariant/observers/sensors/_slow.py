"""Slow states: quantities that change slowly or not at all, and are estimated along with the motion.

An unknown force, the offset of an encoder, a payload, or a level of friction enters the equations of motion or the
measurement through functions that a filter differentiates. So one mechanism serves all of them.

A state with a time constant τ is a first-order Gauss–Markov (Ornstein–Uhlenbeck) process: `s' = −(s − s₀)/τ + w`. If no
measurement shows it any more, its value is forgotten and its uncertainty returns to the usual one; a random walk would
keep its value, and its uncertainty would grow.

Source: Friedland 1969, Treatment of bias in recursive filtering, IEEE TAC 14(4), for states that are constant;
Pannocchia & Rawlings 2003, Disturbance models for offset-free model-predictive control, AIChE Journal 49(2), for
integral action; Gelb 1974, Applied Optimal Estimation, section 2.2, for Gauss–Markov processes.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._gauss_markov import gauss_markov
from covariant._linalg import semidefinite_root
from covariant._typing import Matrix, Number, Numbers, Scalar, Vector
from covariant.models import (
    Family,
    MechanicalSystem,
    Motion,
    Parametric,
    acceleration,
    check_shapes,
    input_count,
    resistance,
)
from covariant.observers.base import as_gain, as_numbers, check_covariance, check_positive, diagonal
from scalargraph.errors import InputError

SlowVector = Float[Array, "k"]


class SlowVariables(Functional):
    """A group of k slow states s: constants, random walks, or Gauss–Markov processes.

    In the field `slow` of a filter, at least one of `force`, `model` and `offset` is required; slow states of a
    `Sensor` need none of them.

    Use it for a force or parameter of your own form. `external_force`, `sensor_bias`, `uncertain_parameters` and
    `wrench` build the usual ones. A slow state that no measurement shows keeps its initial uncertainty: check its
    standard deviation.

    Attributes:
        names: Names (k) of the states in estimates and reports.
        first: Values (k,) at the start.
        first_cov: Covariance (k, k) of these values.
        walk_cov: Spectral density (k, k) of the random walk, the variance that is added per second; 0 for constants.
            With a `time` τ, the states have the covariance `walk_cov τ/2` in the long run.
        force: `(q, v, s) -> (n,)`, a generalised force in addition to those of the model, a covector in the frame.
        model: `s -> MechanicalSystem`, the model with these states as parameters, which replaces the filter's model.
        offset: `s -> (n,)`, the offset of measured configurations: `y = retract(q, offset)`. In coordinates it is
            added, on a group it is a displacement in the body frame.
        values: `s -> (k,)`, the values that are reported, if they are not s itself.
        time: Time constant τ [s], after which 1/e of the difference to `first` is left; None (default) for states that
            do not return.
        law: `v -> (values (k,), rates (k,) [1/s])`, the values to which the states return at a velocity, and at which
            rates, in place of `first` and `time`; `walk_cov` is then their covariance in the long run. Its method
            `without` returns a model without the forces that the states replace. None by default.

    Raises:
        ValueError: A matrix is not a covariance, a time is not positive and finite, a shape does not fit the names, or
            two names are equal.

    Example:
        >>> import numpy as np
        >>> from covariant import models, observers
        >>> one = np.eye(1)
        >>> drag = observers.SlowVariables(("drag",), np.zeros(1), one, 0 * one, force=lambda q, v, s: -s * v)
        >>> observers.IntrinsicKalman(models.oscillator(), 1e-3, 1e-4, 1.0, drag).slow_names
        ('drag',)
    """

    names: tuple[str, ...] = eqx.field(static=True)
    first: SlowVector = eqx.field(converter=jnp.asarray)
    first_cov: Float[Array, "k k"] = eqx.field(converter=jnp.asarray)
    walk_cov: Float[Array, "k k"] = eqx.field(converter=jnp.asarray)
    force: Callable[[Array, Vector, SlowVector], Vector] | None = None
    model: Callable[[SlowVector], MechanicalSystem] | None = None
    offset: Callable[[SlowVector], Vector] | None = None
    values: Callable[[SlowVector], SlowVector] | None = None
    time: Scalar | None = eqx.field(default=None, converter=as_gain)
    law: Any = None

    def __check_init__(self):
        if self.time is not None:
            check_positive("SlowVariables", time=self.time)
        k = len(self.names)
        if not k or len(set(self.names)) < k:
            raise InputError(f"SlowVariables: names must be different names, one for each state; got {self.names}")
        if np.shape(self.first) != (k,) or not _finite(self.first):
            raise InputError(f"SlowVariables: first must be {k} finite numbers, one for each name; got {self.first}")
        for name in ("first_cov", "walk_cov"):
            cov = getattr(self, name)
            if np.shape(cov) != (k, k):
                raise InputError(f"SlowVariables: {name} must be a matrix ({k}, {k}); its shape is {np.shape(cov)}")
            check_covariance("SlowVariables", name, cov)

    def first_root(self) -> Float[Array, "k k"]:
        """Square root (k, k) of the covariance at the start."""
        return semidefinite_root(self.first_cov)

    @property
    def stay(self) -> bool:
        """Whether the states are constants or random walks, which return to no value."""
        return self.time is None and self.law is None

    def advanced(self, v: Vector, s: SlowVector, h: Scalar) -> tuple[SlowVector, SlowVector]:
        """The expected states: the mean over a step that begins with the velocity v, and the values at its end."""
        if self.stay:
            return s, s
        first, steps = (part.astype(s.dtype) for part in self._returning(v, h))
        mean, end, _ = gauss_markov(steps)
        return first + mean * (s - first), first + end * (s - first)

    def spread(self, v: Vector, h: Scalar) -> Float[Array, "k k"]:
        """Square root (k, k) of the covariance that a step adds."""
        # With a time τ the variance in the long run is walk_cov τ/2.
        size = 1.0 if self.time is None else self.time / 2
        added = h if self.stay else size * gauss_markov(self._returning(v, h)[1])[2]
        return jnp.reshape(jnp.sqrt(added), (-1, 1)) * semidefinite_root(self.walk_cov).astype(h.dtype)

    def _returning(self, v: Vector, h: Scalar) -> tuple[SlowVector, Array]:
        """Values to which the states return, and the length of a step in time constants."""
        time: Any = self.time
        values, rates = (self.first, 1 / time) if self.law is None else self.law(v)
        return values, h * rates


def as_groups(given: Any) -> tuple[Any, ...]:
    """Tuple of groups, from one group or a sequence of them."""
    return tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else (given,)


class SlowStates(NamedTuple):
    """All slow states of a filter, one group after the other.

    Attributes:
        groups: The groups, of k states together.

    Example:
        >>> from covariant import observers
        >>> from covariant.observers.sensors._slow import SlowStates
        >>> SlowStates((observers.external_force([[1.0]]), observers.sensor_bias(0.01))).names
        ('external_force1', 'bias1')
    """

    groups: tuple[Any, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k) of all states."""
        return tuple(name for group in self.groups for name in group.names)

    @property
    def forgotten_forces(self) -> list[bool]:
        """Which states (k) are forces with a time constant, whose usual size a filter can learn."""
        forces = [group.force is not None and group.time is not None for group in self.groups]
        return [force for force, group in zip(forces, self.groups, strict=True) for _ in group.names]

    @property
    def measured(self) -> bool:
        """Whether any group gives measurements an offset."""
        return any(group.offset is not None for group in self.groups)

    def first(self, like: Vector) -> SlowVector:
        """Values (k,) at the start."""
        return jnp.concatenate([like[:0], *(group.first.astype(like.dtype) for group in self.groups)])

    def first_root(self) -> Float[Array, "k k"]:
        """Square root (k, k) of the covariance at the start; at least one group is needed."""
        return functools.reduce(diagonal, [group.first_root() for group in self.groups])

    def walk_root(self, v: Vector, h: Scalar) -> Float[Array, "k k"]:
        """Square root of the covariance that is added in a step; at least one group is needed."""
        return functools.reduce(diagonal, [group.spread(v, h) for group in self.groups])

    def advanced(self, v: Vector, s: SlowVector, h: Scalar) -> tuple[SlowVector, SlowVector]:
        """The expected states: the mean over a step, and the values at its end.

        States with a time constant τ return towards their first values, by the factor `exp(−h/τ)` at the end and
        `τ/h (1 − exp(−h/τ))` in the mean; the others stay.
        """
        pairs = [group.advanced(v, part, h) for group, part in zip(self.groups, self.parts(s), strict=True)]
        means, ends = (jnp.concatenate([s[:0], *each]) for each in (zip(*pairs, strict=True) if pairs else ((), ())))
        return means, ends

    def parts(self, s: SlowVector) -> list[Array]:
        """The states split into those of each group."""
        ends = np.cumsum([len(group.names) for group in self.groups])
        return jnp.split(s, ends[:-1].tolist()) if self.groups else []

    def in_model(self, model: MechanicalSystem, s: SlowVector) -> MechanicalSystem:
        """Model with these states in it, and their forces added to its dissipation."""
        pairs = list(zip(self.groups, self.parts(s), strict=True))
        # The model comes first, since forces are added to the dissipation of the model that replaces it.
        for group, part in pairs:
            model = model if group.model is None else group.model(part)
        for group in self.groups:
            model = model if group.law is None else group.law.without(model)
        forces = [(group.force, part) for group, part in pairs if group.force is not None]

        # Dissipation is the force that may depend on velocity, position and time.
        def dissipation(t, q, v, u):
            return resistance(model, t, q, v, u) + sum(force(q, v, part) for force, part in forces)

        return eqx.tree_at(lambda m: m.dissipation, model, dissipation) if forces else model

    def offset(self, s: SlowVector, like: Vector) -> Vector:
        """Offset of measured configurations, the sum over all groups."""
        pairs = zip(self.groups, self.parts(s), strict=True)
        return sum((group.offset(part) for group, part in pairs if group.offset is not None), jnp.zeros_like(like))

    def values(self, s: SlowVector) -> SlowVector:
        """Values that are reported, by `SlowVariables.values` if a group has it."""
        pairs = zip(self.groups, self.parts(s), strict=True)
        return jnp.concatenate(
            [s[:0], *(part if group.values is None else group.values(part) for group, part in pairs)]
        )

    def check(self, whose: str, model: MechanicalSystem) -> None:
        """Check that the groups fit each other, and a model whose dimension is known."""
        for group in self.groups:
            if not isinstance(group, SlowVariables):
                raise InputError(
                    f"{whose}: slow must be one SlowVariables or several, such as sensor_bias(0.01); got {group!r}"
                )
            if group.force is None and group.model is None and group.offset is None:
                raise InputError(
                    f"{whose}: give a force, a model or an offset that depends on the slow states "
                    f"{', '.join(group.names)}"
                )
        self.check_names(whose)
        if sum(group.model is not None for group in self.groups) > 1:
            raise InputError(
                f"{whose}: only one group of slow states may replace the model; put their numbers together"
            )
        if None not in model.manifold.shape:
            _check_shapes(whose, self, model)

    def check_names(self, whose: str) -> None:
        """Check that no two states have the same name."""
        duplicate = next((name for name in self.names if self.names.count(name) > 1), None)
        if duplicate is not None:
            raise InputError(f"{whose}: two slow states are called {duplicate!r}; give each its own name")


def external_force(
    density: Numbers | None = None,
    name: str = "external_force",
    *,
    std: Numbers | None = None,
    time: Number | None = None,
) -> SlowVariables:
    """A generalised force that the model does not contain, such as a push, a disturbance, or wrong friction.

    With `std` and `time` it is a Gauss–Markov process, which resembles pushes that end and errors of friction: through
    a gap in the log the estimate returns to zero. With a `density` it is a random walk from zero, which suits a
    persistent load; through a gap its estimate stays, and its uncertainty grows without bound.

    Args:
        density: Spectral density (n, n) of the walk [N²/s or (N m)²/s]. At the start, the force has the covariance of
            the walk after one second.
        name: Name of the states, followed by the number of the component; "external_force" by default.
        std: Usual size (n,) of each component, its standard deviation in the long run and at the start [N or N m].
        time: Time constant τ [s] after which a force is forgotten.

    Returns:
        A group of n states, the components of the force in the frame [N or N m].

    Raises:
        ValueError: The density is not a covariance matrix, a number is not positive, or the arguments are neither a
            density alone nor `std` and `time` together.

    Example:
        >>> import numpy as np
        >>> from covariant import observers
        >>> observers.external_force(0.1 * np.eye(2), name="wind").names
        ('wind1', 'wind2')
        >>> push = observers.external_force(std=[0.5, 0.2], time=0.3)
        >>> push.names, float(push.time)
        (('external_force1', 'external_force2'), 0.3)
    """
    if density is not None and std is None and time is None:
        cov = _square("external_force", "density", density)
        return SlowVariables(_numbered_names(name, len(cov)), jnp.zeros(len(cov)), cov, cov, force=_itself)
    if density is not None or std is None or time is None:
        raise InputError("external_force: give a density, or both std and time")
    check_positive("external_force", time=time)
    stds = as_numbers("external_force", "std", std, None, 0.0)
    return forgotten_force(_numbered_names(name, len(stds)), stds, time, _itself)


def forgotten_force(
    names: tuple[str, ...], stds: np.ndarray, time: Number, force: Callable[..., Vector]
) -> SlowVariables:
    """A force with independent components that starts with its long-run uncertainty and is forgotten over time."""
    cov = jnp.diag(jnp.asarray(stds**2))
    # The process is stationary: density · τ/2 is its covariance in the long run.
    return SlowVariables(names, jnp.zeros(len(stds)), cov, 2 / time * cov, force=force, time=time)


def sensor_bias(std: Numbers, drift: Numbers = 0.0, name: str = "bias") -> SlowVariables:
    """An offset of each measured position; on a group, an offset of the measured configuration in the body frame.

    Positions alone do not show a constant offset, but gravity does, or another force that depends on the position. If
    nothing does, the estimate stays as uncertain as at the start.

    Use it for an encoder whose zero is not exact. For a further sensor set its `bias_std` instead.

    Args:
        std: Standard deviations (n,) of the offsets at the start [rad or m]; zero for a position without an offset,
            which gets no state.
        drift: Standard deviation of the change in a second [rad/√s or m/√s], one for all or (n,); zero (default) for a
            constant.
        name: Name of the states, followed by the number of the position; "bias" by default.

    Returns:
        A group with a state for each position whose `std` is positive, the offset [rad or m].

    Raises:
        ValueError: A number is not finite and ≥ 0, or all of `std` are zero.

    Example:
        >>> from covariant import observers
        >>> bias = observers.sensor_bias(std=[0.01, 0.0, 0.02])
        >>> bias.names, bias.offset(bias.first + 1.0).tolist()
        (('bias1', 'bias3'), [1.0, 0.0, 1.0])
    """
    stds = as_numbers("sensor_bias", "std", std, None, 0.0)
    drifts = as_numbers("sensor_bias", "drift", drift, stds.size, 0.0)
    biased = np.flatnonzero(stds > 0)
    if not biased.size:
        raise InputError("sensor_bias: all of std are zero; give that of a position that may be off")
    # Names contain the number of the position, counted from 1.
    names = tuple(f"{name}{i + 1}" for i in biased)
    covs = jnp.diag(jnp.asarray(stds[biased] ** 2)), jnp.diag(jnp.asarray(drifts[biased] ** 2))
    return SlowVariables(
        names, jnp.zeros(biased.size), *covs, offset=Parametric(_along, axes=np.eye(stds.size)[:, biased])
    )


def uncertain_parameters(family: Family, std: Numbers, drift: Numbers = 0.0) -> SlowVariables:
    """Parameters of the model that are not well known or that change, such as a payload or a level of friction.

    Parameters that the model refuses when they are negative stay positive.

    Use it to estimate a parameter together with the motion, while a machine runs. For a constant parameter,
    `covariant.fit` is the better choice, since it uses complete logs. The motion must excite the parameter: a mass on a
    level track at constant speed leaves it undetermined.

    Args:
        family: The model with p open parameters, from `models.family`.
        std: Standard deviation of their relative error at the start, one for all or (p,); for a parameter whose first
            value is zero, of its error in the unit of the parameter.
        drift: Standard deviation of their relative change in a second, one for all or (p,) [1/√s]; zero (default) for
            constants.

    Returns:
        A group of p states, whose reported values are the parameters in their units.

    Raises:
        ValueError: A number is not finite and ≥ 0, or a parameter is the lag of the inputs, which is not part of the
            equations of motion.

    Example:
        >>> from covariant import models, observers
        >>> family = models.family("oscillator", ["stiffness"], {"parameters.stiffness": 2.0})
        >>> slow = observers.uncertain_parameters(family, std=0.1)
        >>> slow.names, slow.values(slow.first).tolist()
        (('stiffness',), [2.0])
    """
    p = len(family.names)
    if any(place[0] != "parameters" for place in family.places):
        raise InputError("uncertain_parameters: a lag of inputs is no number of the equations of motion; leave it out")
    stds = as_numbers("uncertain_parameters", "std", std, p, 0.0)
    drifts = as_numbers("uncertain_parameters", "drift", drift, p, 0.0)
    parameters = Parametric(_relative(family.positive), first=family.first)

    def model(z):
        return family.make(parameters(z))[0]

    # The states are relative changes, so both covariances are relative too.
    covs = jnp.diag(jnp.asarray(stds**2)), jnp.diag(jnp.asarray(drifts**2))
    return SlowVariables(family.names, jnp.zeros(p), *covs, model=model, values=parameters)


def _itself(q, v, s):
    return s


def _along(s, axes):
    return axes @ s


def _relative(positive: tuple[bool, ...]) -> Callable[..., Array]:
    """Parameters (p,) as a function of relative changes z (p,); for positive parameters z is a change of logarithm."""
    logarithmic = np.asarray(positive)

    def parameters(z, first):
        size = jnp.where(first == 0, 1.0, jnp.abs(first)).astype(first.dtype)
        # The inner `where` keeps exp from overflowing in entries that do not use it, whose derivative would be NaN.
        return jnp.where(logarithmic, first * jnp.exp(jnp.asarray(jnp.where(logarithmic, z, 0.0))), first + size * z)

    return parameters


def _numbered_names(name: str, n: int) -> tuple[str, ...]:
    return tuple(f"{name}{i + 1}" for i in range(n))


def _finite(value: Numbers) -> bool:
    return isinstance(value, Tracer) or bool(np.isfinite(np.asarray(value)).all())


def _square(whose: str, name: str, value: Any) -> Matrix:
    check_covariance(whose, name, value)
    if np.ndim(value) != 2:
        raise InputError(f"{whose}: {name} must be a matrix (n, n); its shape is {np.shape(value)}")
    return jnp.asarray(value, float)


def _check_shapes(whose: str, states: SlowStates, model: MechanicalSystem) -> None:
    q = jax.eval_shape(model.manifold.origin)
    v = jax.eval_shape(model.manifold.zero, q)
    (n,) = v.shape
    u, t = jax.ShapeDtypeStruct((input_count(model, n),), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)
    for group in states.groups:
        s, names = jax.ShapeDtypeStruct((len(group.names),), jnp.float64), ", ".join(group.names)

        def accelerate(t, q, v, u, s, build=group.model):
            return acceleration(build(s), t, *Motion(q, v), u)

        functions = (
            ("the acceleration of the model", group.model and accelerate, (t, q, v, u, s)),
            ("force", group.force, (q, v, s)),
            ("offset", group.offset, (s,)),
        )
        given = [
            (f"{whose}: {what} of the slow states {names}", function, arguments, (n,))
            for what, function, arguments in functions
            if function is not None
        ]
        check_shapes(given, f"{len(group.names)} of them", f"{n} velocities")
