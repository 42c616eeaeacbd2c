"""Checks the region of a certificate: the caller's bounds of positions, inputs and times."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._domains import POSITIVE
from covariant._names import unknown
from covariant.certificates.base._force_bounds import force_reads_time
from covariant.certificates.base._intrinsic import configuration_shape, driven_by, signals_of
from covariant.certificates.base._properties import configuration_names, free_entries
from covariant.geometry.lie import SE2, SE3, SO2, SO3
from covariant.models import MechanicalSystem
from scalargraph.errors import InputError
from scalargraph.proofs import Box, check_box

Bounds = tuple[ArrayLike, ArrayLike] | Mapping[str, ArrayLike]
"""Least and largest values, or pairs of them by name."""
ROTATIONS = ((SO2, 2), (SO3, 3), (SE2, 2), (SE3, 3))
"""Groups with rotations in the upper left of their matrices, and the order of these."""


SPEED = POSITIVE._replace(
    words="be a positive, finite bound",
    why="No contraction holds at all speeds and errors, so there is no certificate without such a bound",
)
"""Bounds that every certificate needs."""


def amount(name: str, value: ArrayLike, n: int) -> Float[np.ndarray, "n"]:
    """Convert one bound for all, or a bound for each, to `n` bounds."""
    amounts = np.broadcast_to(np.asarray(value, float), (n,)) if np.ndim(value) == 0 else np.asarray(value, float)
    if amounts.shape != (n,):
        raise InputError(f"certify: {name} needs one number, or {n} of them; got {amounts.size}")
    return amounts.copy()


class Region(NamedTuple):
    """Region of the true system: the box of positions, the bounds (2, m) of inputs, and first and last time [s]."""

    true: Box
    inputs: Float[np.ndarray, "2 m"]
    times: tuple[float, float]


def region_of(
    model: MechanicalSystem,
    position: Bounds | None,
    inputs: Bounds | ArrayLike | None,
    times: tuple[float, float] | None,
) -> Region:
    """Check the bounds of positions, inputs and times.

    Entries of the configuration that nothing depends on, and of rotations, need no bounds. Inputs without bounds are 0,
    and those that the friction depends on need some. What is missing is said in one error.
    """
    n, driven, places = len(model.coordinates or model.velocities), driven_by(model), configuration_names(model)
    names = signals_of(model)[0][1:]
    positions, ends = _positions(model, position, places), _inputs(inputs, names)
    absent, unset = np.isnan(positions[0]), np.isnan(ends[0])
    needed = absent & ~free_entries(model) if absent.any() else absent
    turned = _rotations(model, places)
    lacking_places = [name for name, lacks in zip(places, needed & ~turned, strict=True) if lacks]
    lacking_inputs = [names[k - 1] for k in driven if k and unset[k - 1]]
    lacking = [f"position needs bounds of {', '.join(lacking_places)}"] * bool(lacking_places)
    if lacking_inputs:
        lacking.append(f"input needs bounds of {', '.join(lacking_inputs)}, on which the friction depends")
    if both := [f"{name}=LOW:HIGH" for name in (*lacking_places, *lacking_inputs)]:
        lacking.append(f"region lacks {','.join(both)}")
    if times is None and (0 in driven or force_reads_time(model, n)):
        lacking.append(
            f"the {'friction' if 0 in driven else 'force'} of this model depends on time; give times=(first, last) "
            "[s], between which the statement is to hold"
        )
    if lacking:
        raise InputError(f"certify: {'; '.join(lacking)}")
    limit = np.where(needed, 1.0, 0.0)  # entries of rotations
    low, high = np.where(absent, [-limit, limit], positions)
    true = Box(places, model.units if model.manifold.commuting else ("",) * len(places), low, high)
    return Region(check_box(true), np.where(unset, 0.0, ends), _times(times))


def _positions(model: MechanicalSystem, bounds: Bounds | None, names: tuple[str, ...]) -> Float[np.ndarray, "2 p"]:
    """Least and largest positions, with NaN where nothing is given."""
    if bounds is None or isinstance(bounds, Mapping):
        return _by_name("position", bounds or {}, names)
    shape = configuration_shape(model, len(names))
    sides = np.stack([np.broadcast_to(np.asarray(side, float), shape).ravel() for side in bounds])
    if np.isnan(sides).any():
        raise InputError(f"certify: position must have finite bounds; got {sides.tolist()}")
    return sides


def _by_name(what: str, given: Mapping[str, ArrayLike], names: tuple[str, ...]) -> Float[np.ndarray, "2 k"]:
    """Bounds by name, with NaN for names that are not given."""
    ends = np.full((2, len(names)), np.nan)
    for name, pair in given.items():
        if name not in names:
            raise InputError(f"certify: {unknown(what, name, names)}")
        ends[:, names.index(name)] = pair
    return ends


def _rotations(model: MechanicalSystem, names: tuple[str, ...]) -> np.ndarray:
    """Which entries of the configuration are those of a rotation, within ±1."""
    order = next((k for group, k in ROTATIONS if model.manifold == group), 0)
    return np.array([name[0] == "g" and max(map(int, name[1:])) <= order for name in names]) if order else np.zeros(len(names), bool)


def _inputs(bounds: Bounds | ArrayLike | None, names: tuple[str, ...]) -> Float[np.ndarray, "2 m"]:
    """Least and largest inputs, with NaN where nothing is given."""
    m = len(names)
    if bounds is None or isinstance(bounds, Mapping):
        return _by_name("input", bounds or {}, names)
    sides = bounds if isinstance(bounds, tuple) else (-np.asarray(bounds, float), np.asarray(bounds, float))
    if len(sides) != 2:
        raise InputError(
            f"certify: input as a tuple is a pair of bounds, lower and upper; got {len(sides)} entries; "
            "write a list for one bound of each input"
        )
    try:
        stacked = np.stack([np.broadcast_to(np.asarray(side, float), (m,)) for side in sides])
    except ValueError:
        raise InputError(f"certify: input needs one bound, or {m} of them; got {np.size(sides[0])}") from None
    if not (np.isfinite(stacked).all() and (stacked[0] <= stacked[1]).all()):
        raise InputError(f"certify: input must have finite bounds; got {stacked.tolist()}")
    return stacked


def _times(times: tuple[float, float] | None) -> tuple[float, float]:
    """First and last time; a single instant where nothing depends on time."""
    if times is None:
        return 0.0, 0.0
    try:
        first, last = (float(t) for t in times)
    except (TypeError, ValueError):
        raise InputError(f"certify: times needs two instants; got {times!r}") from None
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise InputError(f"certify: times must be finite, the earlier one first; got {first:g} and {last:g}")
    return first, last
