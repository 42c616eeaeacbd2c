"""Checks the region of a certificate: the caller's bounds of positions, inputs and times."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._domains import POSITIVE
from covariant.certificates.base._force_bounds import force_reads_time
from covariant.geometry.lie import SO2, SO3
from covariant.models import MechanicalSystem, input_count
from scalargraph.errors import InputError
from scalargraph.proofs import Box, check_box

Bounds = tuple[ArrayLike, ArrayLike]


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
    model: MechanicalSystem, position: Bounds | None, inputs: Bounds | ArrayLike, times: tuple[float, float] | None
) -> Region:
    """Check the bounds of positions, inputs and times."""
    n = len(model.coordinates or model.velocities)
    true = _coordinates(model, position, n) if model.manifold.commuting else _elements(model, position)
    return Region(check_box(true), _inputs(model, inputs, n), _times(model, n, times))


def _coordinates(model: MechanicalSystem, position: Bounds | None, n: int) -> Box:
    if position is None:
        raise InputError(f"certify: position needs bounds of {', '.join(model.coordinates)}")
    low, high = (np.broadcast_to(np.asarray(side, float), (n,)).copy() for side in position)
    return Box(model.coordinates, model.units, low, high)


def _elements(model: MechanicalSystem, position: Bounds | None) -> Box:
    order = model.manifold.origin().shape[0]
    names = tuple(f"g{i + 1}{j + 1}" for i, j in itertools.product(range(order), repeat=2))
    if position is None:
        if model.manifold not in (SO2, SO3):
            raise InputError("certify: on this group position needs bounds of the entries of its matrices (N, N)")
        position = (-np.ones((order, order)), np.ones((order, order)))
    low, high = (np.broadcast_to(np.asarray(side, float), (order, order)).ravel().copy() for side in position)
    return Box(names, ("",) * len(names), low, high)


def _inputs(model, bounds, n: int) -> Float[np.ndarray, "2 m"]:
    m = input_count(model, n)
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


def _times(model: MechanicalSystem, n: int, times: tuple[float, float] | None) -> tuple[float, float]:
    """First and last time; a single instant if the force does not depend on time."""
    if times is None:
        if force_reads_time(model, n):
            raise InputError(
                "certify: the force of this model depends on time; give times=(first, last) [s], between which the "
                "statement is to hold"
            )
        return 0.0, 0.0
    try:
        first, last = (float(t) for t in times)
    except (TypeError, ValueError):
        raise InputError(f"certify: times needs two instants; got {times!r}") from None
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise InputError(f"certify: times must be finite, the earlier one first; got {first:g} and {last:g}")
    return first, last
