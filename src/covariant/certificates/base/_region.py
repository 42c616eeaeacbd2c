"""Checks the region of a certificate: the caller's bounds of positions, inputs and times."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Float

from covariant._domains import POSITIVE
from covariant._names import refuse_unknown
from covariant.certificates.base._force_bounds import force_reads_time
from covariant.certificates.base._intrinsic import any_configuration, configuration_shape, driven_by, signals_of
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
    """Check the bounds of positions, inputs and times, and say everything that is missing in one error.

    Entries of the configuration that nothing depends on need no bounds, nor do rotations. Inputs without bounds are 0,
    but those that the friction depends on need some.
    """
    places, signals, driven = configuration_names(model), signals_of(model)[0][1:], driven_by(model)
    names, count = (*places, *signals), len(places)
    ends, given = np.zeros((2, len(names))), np.zeros(len(names), bool)
    if inputs is not None:
        ends[:, count:], given[count:] = _inputs(inputs, len(signals)), True
    if isinstance(position, Mapping):
        for name, pair in position.items():
            refuse_unknown("coordinate or input of the region", name, names)
            ends[:, names.index(name)] = low, high = np.asarray(pair, float)
            given[names.index(name)] = True
            if not -math.inf < low <= high < math.inf:
                raise InputError(f"certify: {name} needs two finite bounds, the lower one first; got {low:g}, {high:g}")
    elif position is not None:
        shape = configuration_shape(model, count)
        ends[:, :count] = [np.broadcast_to(np.asarray(side, float), shape).ravel() for side in position]
        given[:count] = True
    needed = np.isin(np.arange(len(names)), [count + k - 1 for k in driven if k])
    if not given[:count].all():
        needed[:count] = ~free_entries(model)
    turned = ~given & needed & np.append(_rotations(model), np.zeros(len(signals), bool))
    timed = "friction" if 0 in driven else "the force" if force_reads_time(model) else ""
    _need_nothing(names, count, needed & ~given & ~turned, timed if times is None else "")
    ends += np.outer([-1.0, 1.0], turned)
    true = Box(places, model.units if model.manifold.commuting else ("",) * count, *ends[:, :count])
    return Region(check_box(true), ends[:, count:], _times(times))


def _need_nothing(names: Sequence[str], count: int, lacking: np.ndarray, timed: str) -> None:
    """Raise `ValueError` with all bounds that are missing: of `count` positions and then of inputs, and of times."""
    parts = slice(None, count), slice(count, None)
    missing = [[name for name, lacks in zip(names[part], lacking[part], strict=True) if lacks] for part in parts]
    reasons = [f"position needs bounds of {', '.join(missing[0])}"] * bool(missing[0])
    reasons += [f"input needs bounds of {', '.join(missing[1])}, on which the friction depends"] * bool(missing[1])
    if both := [f"{name}=LOW:HIGH" for name in (*missing[0], *missing[1])]:
        reasons.append(f"region lacks {','.join(both)}")
    if timed:
        reasons.append(
            f"{timed} of this model depends on time; give times=(first, last) [s], between which the statement is to "
            "hold"
        )
    if reasons:
        raise InputError(f"certify: {'; '.join(reasons)}")


def _rotations(model: MechanicalSystem) -> np.ndarray:
    """Return for each entry of the configuration whether it is that of a rotation, within ±1."""
    entries = np.zeros(np.shape(any_configuration(model)), bool)
    order = next((k for group, k in ROTATIONS if model.manifold == group), 0)
    entries[:order, ...][..., :order] = True
    return entries.ravel()


def _inputs(bounds: Bounds | ArrayLike, m: int) -> Float[np.ndarray, "2 m"]:
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
