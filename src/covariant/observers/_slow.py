"""Slow states: numbers that change slowly or not at all, and are estimated along with the motion.

An unknown force, the offset of an encoder, a payload, a level of friction: each of them enters the equations of motion
or the measurement, by functions that a filter differentiates as it computes them. So one mechanism serves all.

Source: Friedland 1969, Treatment of bias in recursive filtering, IEEE TAC 14(4), for states that are constant;
Pannocchia & Rawlings 2003, Disturbance models for offset-free model-predictive control, AIChE Journal 49(2), for
integral action.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from covariant._functional import Functional
from covariant._linalg import semidefinite_root
from covariant._typing import Matrix, Numbers, Vector
from covariant.models import Family, MechanicalSystem, Motion, Parametric, acceleration, input_count, resistance
from covariant.observers._covariance import check_covariance
from covariant.observers._square_root import diagonal

SlowVector = Float[Array, "k"]


class Slow(Functional):
    """A group of k slow states s, each a constant or a random walk.

    - `names` (k of them): what they are called where estimates are written.
    - `first` (k,): values at the start; `first_cov` (k, k): how uncertain they are.
    - `walk_cov` (k, k): spectral density of the random walk, the variance that is added in a second; 0 for constants.
    - `force`: `(q, v, s) -> (n,)`, a generalised force that acts besides those of the model, a covector in the frame.
    - `model`: `s -> MechanicalSystem`, the model with these numbers in it, in the place of the filter's own.
    - `offset`: `s -> (n,)`, by how much measured configurations are off: `y = retract(q, offset)`. In coordinates it is
      added, on a group it is a displacement in the body frame.
    - `values`: `s -> (k,)`, what is written of them, where that is not s itself.

    Of `force`, `model` and `offset` at least one is given. Raises `ValueError` for covariances that are none, for
    shapes that do not fit the names, and where nothing depends on the states.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    first: SlowVector = eqx.field(converter=jnp.asarray)
    first_cov: Float[Array, "k k"] = eqx.field(converter=jnp.asarray)
    walk_cov: Float[Array, "k k"] = eqx.field(converter=jnp.asarray)
    force: Callable[[Array, Vector, SlowVector], Vector] | None = None
    model: Callable[[SlowVector], MechanicalSystem] | None = None
    offset: Callable[[SlowVector], Vector] | None = None
    values: Callable[[SlowVector], SlowVector] | None = None

    def __check_init__(self):
        k = len(self.names)
        if not k or len(set(self.names)) < k:
            raise ValueError(f"Slow: names must be different names, one for each state; got {self.names}")
        if np.shape(self.first) != (k,) or not _finite(self.first):
            raise ValueError(f"Slow: first must be {k} finite numbers, one for each name; got {self.first}")
        for name in ("first_cov", "walk_cov"):
            given = getattr(self, name)
            if np.shape(given) != (k, k):
                raise ValueError(f"Slow: {name} must be a matrix ({k}, {k}); its shape is {np.shape(given)}")
            check_covariance("Slow", name, given)
        if self.force is None and self.model is None and self.offset is None:
            raise ValueError("Slow: give a force, a model or an offset that depends on the states")


def as_groups(given: Any) -> tuple[Any, ...]:
    """One group or several as a tuple."""
    return tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else (given,)


class SlowStates(NamedTuple):
    """All slow states of a filter, one group after the other."""

    groups: tuple[Slow, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all states."""
        return tuple(name for group in self.groups for name in group.names)

    @property
    def measured(self) -> bool:
        """Whether measurements are off by any of them."""
        return any(group.offset is not None for group in self.groups)

    def first(self, like: Vector) -> SlowVector:
        """The values at the start."""
        return jnp.concatenate([like[:0], *(group.first.astype(like.dtype) for group in self.groups)])

    def first_root(self) -> Float[Array, "k k"]:
        """A square root of their covariance at the start."""
        return functools.reduce(diagonal, [semidefinite_root(group.first_cov) for group in self.groups])

    def walk_root(self) -> Float[Array, "k k"]:
        """A square root of the density of their random walks."""
        return functools.reduce(diagonal, [semidefinite_root(group.walk_cov) for group in self.groups])

    def parts(self, s: SlowVector) -> list[Array]:
        """The states of each group."""
        ends = np.cumsum([len(group.names) for group in self.groups])
        return jnp.split(s, ends[:-1].tolist()) if self.groups else []

    def in_model(self, model: MechanicalSystem, s: SlowVector) -> MechanicalSystem:
        """The model with these states."""
        both = list(zip(self.groups, self.parts(s), strict=True))
        for group, own in both:
            model = model if group.model is None else group.model(own)
        forces = [(group.force, own) for group, own in both if group.force is not None]

        def dissipation(t, q, v, u):
            return resistance(model, t, q, v, u) + sum(force(q, v, own) for force, own in forces)

        return eqx.tree_at(lambda m: m.dissipation, model, dissipation) if forces else model

    def offset(self, s: SlowVector, like: Vector) -> Vector:
        """By how much measured configurations are off."""
        both = zip(self.groups, self.parts(s), strict=True)
        return sum((group.offset(own) for group, own in both if group.offset is not None), jnp.zeros_like(like))

    def values(self, s: SlowVector) -> SlowVector:
        """What is written of them."""
        both = zip(self.groups, self.parts(s), strict=True)
        return jnp.concatenate([s[:0], *(own if group.values is None else group.values(own) for group, own in both)])

    def check(self, whose: str, model: MechanicalSystem) -> None:
        """Raise `ValueError` for groups that do not go together, or not with a model whose dimension is known."""
        for group in self.groups:
            if not isinstance(group, Slow):
                raise ValueError(f"{whose}: slow must be one Slow or several, such as sensor_bias(0.01); got {group!r}")
        twice = next((name for name in self.names if self.names.count(name) > 1), None)
        if twice is not None:
            raise ValueError(f"{whose}: two slow states are called {twice!r}; give each its own name")
        if sum(group.model is not None for group in self.groups) > 1:
            raise ValueError(
                f"{whose}: only one group of slow states may replace the model; put their numbers together"
            )
        if None not in model.manifold.shape:
            _check_shapes(whose, self, model)


def external_force(density: Numbers, name: str = "external_force") -> Slow:
    """A generalised force that the model does not contain: a push, a disturbance. It is a random walk from zero.

    - `density` (n, n): spectral density of the walk [N²/s or (N m)²/s]. At the start the force is as uncertain as the
      walk is after one second.

    Raises `ValueError` for a matrix that is no covariance.
    """
    cov = _square("external_force", "density", density)
    n = cov.shape[0]
    return Slow(_numbered(name, n), jnp.zeros(n), cov, cov, force=_itself)


def sensor_bias(std: Numbers, drift: Numbers = 0.0, name: str = "bias") -> Slow:
    """An offset of each measured position, or in the body frame of a measured configuration on a group.

    - `std` (n,): standard deviation of the offset at the start [rad or m]; zero for a position that is known to have
      none, of which no state is made.
    - `drift`: standard deviation of what it changes by in a second [rad/√s or m/√s], one for all or (n,); a zero for a
      constant.

    Positions alone do not show a constant offset: gravity does, or whatever else depends on the position. Where nothing
    does, the estimate keeps the uncertainty of the start. Raises `ValueError` for numbers that are not finite and ≥ 0,
    and where all of `std` are zero.
    """
    stds = _deviations("sensor_bias", "std", std)
    drifts = _deviations("sensor_bias", "drift", drift, stds.size)
    own = np.flatnonzero(stds > 0)
    if not own.size:
        raise ValueError("sensor_bias: all of std are zero; give that of a position that may be off")
    names = tuple(f"{name}{i + 1}" for i in own)
    covs = jnp.diag(jnp.asarray(stds[own] ** 2)), jnp.diag(jnp.asarray(drifts[own] ** 2))
    return Slow(names, jnp.zeros(own.size), *covs, offset=Parametric(_along, axes=np.eye(stds.size)[:, own]))


def uncertain_parameters(family: Family, std: Numbers, drift: Numbers = 0.0) -> Slow:
    """Numbers of the model that are not well known or that change: a payload, a level of friction.

    - `family`: the model with p open numbers, from `models.family`.
    - `std`: standard deviation of their relative error at the start, one for all or (p,); of a number whose first value
      is zero in its own unit.
    - `drift`: standard deviation of their relative change in a second; zero for constants.

    Numbers that the model refuses when they are negative stay positive. Raises `ValueError` for numbers that are not
    finite and ≥ 0, and for the lag of the inputs, which is no number of the equations of motion.
    """
    p = len(family.names)
    if any(place[0] != "parameters" for place in family.places):
        raise ValueError("uncertain_parameters: a lag of inputs is no number of the equations of motion; leave it out")
    stds = _deviations("uncertain_parameters", "std", std, p)
    drifts = _deviations("uncertain_parameters", "drift", drift, p)
    numbers = Parametric(_relative(family.positive), first=family.first)

    def model(z):
        return family.make(numbers(z))[0]

    covs = jnp.diag(jnp.asarray(stds**2)), jnp.diag(jnp.asarray(drifts**2))
    return Slow(family.names, jnp.zeros(p), *covs, model=model, values=numbers)


def _itself(q, v, s):
    return s


def _along(s, axes):
    return axes @ s


def _relative(positive: tuple[bool, ...]) -> Callable[..., Array]:
    """The numbers at relative changes z, whose logarithms these are where the numbers are positive."""
    logarithmic = np.asarray(positive)

    def numbers(z, first):
        size = jnp.where(first == 0, 1.0, jnp.abs(first)).astype(first.dtype)
        return jnp.where(logarithmic, first * jnp.exp(jnp.asarray(jnp.where(logarithmic, z, 0.0))), first + size * z)

    return numbers


def _numbered(name: str, n: int) -> tuple[str, ...]:
    return tuple(f"{name}{i + 1}" for i in range(n))


def _finite(given: Any) -> bool:
    return isinstance(given, Tracer) or bool(np.isfinite(np.asarray(given)).all())


def _square(whose: str, name: str, given: Any) -> Matrix:
    check_covariance(whose, name, given)
    if np.ndim(given) != 2:
        raise ValueError(f"{whose}: {name} must be a matrix (n, n); its shape is {np.shape(given)}")
    return jnp.asarray(given, float)


def _deviations(whose: str, name: str, given: Any, count: int | None = None) -> np.ndarray:
    """Standard deviations as an array of one axis, of `count` entries where that is known."""
    try:
        found = np.atleast_1d(np.asarray(given, float))
    except (TypeError, ValueError):
        found = np.array(np.nan)
    if found.ndim != 1 or not all(0 <= value < math.inf for value in found):
        raise ValueError(f"{whose}: {name} must be numbers ≥ 0, standard deviations; got {given}")
    if count is None:
        return found
    if found.size not in (1, count):
        raise ValueError(f"{whose}: {name} must be one number, or {count}; got {given}")
    return np.broadcast_to(found, (count,))


def _check_shapes(whose: str, states: SlowStates, model: MechanicalSystem) -> None:
    q = jax.eval_shape(model.manifold.origin)
    v = jax.eval_shape(model.manifold.zero, q)
    (n,) = v.shape
    for group in states.groups:
        s = jax.ShapeDtypeStruct((len(group.names),), jnp.float64)
        if group.model is not None:
            made = group.model
            u, t = jax.ShapeDtypeStruct((input_count(model, n),), jnp.float64), jax.ShapeDtypeStruct((), jnp.float64)

            def moved(t, q, v, u, s, made=made):
                return acceleration(made(s), t, *Motion(q, v), u)

            _need(whose, group, "the acceleration of the model", moved, (t, q, v, u, s), (n,))
        if group.force is not None:
            _need(whose, group, "force", group.force, (q, v, s), (n,))
        if group.offset is not None:
            _need(whose, group, "offset", group.offset, (s,), (n,))


def _need(whose: str, group: Slow, what: str, function: Any, arguments: tuple, wanted: tuple[int, ...]) -> None:
    names = ", ".join(group.names)
    try:
        shape = eqx.filter_eval_shape(function, *arguments).shape
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise ValueError(f"{whose}: {what} of the slow states {names} cannot be evaluated: {reason}") from error
    if shape != wanted:
        raise ValueError(f"{whose}: {what} of the slow states {names} must have shape {wanted}; it has {shape}")
