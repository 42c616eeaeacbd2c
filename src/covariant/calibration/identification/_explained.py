"""What each column of a log is to the others: slope, set-point, pose, attitude; and the roles that follow from it."""

import dataclasses
import re

import numpy as np
from jaxtyping import Float

from covariant.calibration.identification._commands import FEWEST_CHANGES
from covariant.calibration.identification._names import EULER, paired, point_in_plane
from covariant.calibration.identification._roles import LogColumns, role
from covariant.calibration.identification._ship_columns import plane_and_heading
from covariant.calibration.identification._stamp_columns import is_near
from covariant.logs import Register, is_unit_of, without_unit, words_of
from scalargraph.errors import InputError

OFF_UNIT = 0.05
"""Largest distance of the length of a quaternion from 1."""
SCALED_MOTION = 0.1
"""Least motion, in lengths, of four numbers whose length stays within its square, for them to be a quaternion."""
HELD = 0.5
"""Least fraction of the rows in which an input that nothing follows keeps its value."""

_QUATERNION = re.compile(r"(.*?)[_./\[]?([wxyzijkWXYZIJK]|real|scalar|[0-9]+)\]?$")
"""Name of one of the four numbers of a quaternion, as qw, q_x, orientation.y or q[3], and the letter or index."""
_LETTERS = {"i": "x", "j": "y", "k": "z", "real": "w", "scalar": "w"}
"""Other letters of these numbers."""


def explained(log: LogColumns, q: tuple[str, ...]) -> tuple[LogColumns, tuple[str, ...]]:
    """The positions among columns that are called so, and the roles of the others by what they are to these.

    A column that another one has as its slope is a position, and that one its velocity; what moves in steps and has no
    velocity is an input. A point in the plane and a heading are a pose. Angles about three axes are an attitude.
    """
    roles = dict(log.roles)
    moved = [name for name in q if any(log.is_slope(name, each) for each in roles if each not in (name, log.t))]
    for name in q if moved else ():
        # Only its unit calls it a position.
        if name not in moved and role(without_unit(log.labels[name])) == "" and _in_steps(log[name]):
            roles[name] = "u"
    words = {name: words_of(name) for name in roles if roles[name] in ("q", "") and name != log.t}
    axes = [[name for name, each in words.items() if each & axis] for axis in EULER]
    if all(axes) and not log.of("command") and not log.of("u"):
        x, y, z = (names[0] for names in axes)
        degrees = ", degrees=True" if max(np.nanmax(np.abs(log[name])) for name in (x, y, z)) > 2 * np.pi else ""
        raise InputError(
            f"{x}, {y}, {z} are the angles of a body that turns, and no joints: write its quaternion into the log, as "
            f'frame[["qx", "qy", "qz", "qw"]] = scipy.spatial.transform.Rotation.from_euler("ZYX", '
            f'frame[[{z!r}, {y!r}, {x!r}]]{degrees}).as_quat(), or name them by `columns["q"]` if they are joints'
        )
    if pose := plane_and_heading(dataclasses.replace(log, roles=roles)):
        x, y, turn = pose
        raise InputError(
            f"{x}, {y}, {turn} are the pose of a craft in the plane, and no joints: write a model file with the "
            'system "ship" (u: a rudder and a thrust) or "hovercraft" (two thrusts) with '
            f'position = ["{x}", "{y}"] and angle = ["{turn}"], or "manoeuvring_ship" (u: rudder and revolutions), '
            f'"supply_vessel" or "cybership" (u: two forces and a moment) with q = ["{x}", "{y}", "{turn}"]; '
            'or name them by `columns["q"]` if they are joints'
        )
    plane = point_in_plane(words)
    if plane is not None:
        log = log.labelled({name: "m" for name in plane if log.unit(name, "q") is None})
        roles |= dict.fromkeys(plane, "q")
    log = dataclasses.replace(log, roles=roles)
    return log, log.of("q")


def _in_steps(values: Float[np.ndarray, "T"]) -> bool:
    """Whether a column keeps its value in most rows, and changes in few."""
    steps = np.diff(values[np.isfinite(values)])
    return bool(len(steps) and np.mean(steps == 0) > HELD and np.count_nonzero(steps) >= 2)


def driving(log: LogColumns, u: tuple[str, ...]) -> list[str]:
    """Inputs that have the unit of a position."""
    return [name for name in u if log.unit(name, "u") is None and log.unit(name, "q") is not None]


def odd_rates(log: LogColumns, q: tuple[str, ...], v: tuple[str, ...]) -> list[str]:
    """Remarks on columns that are called velocities and are another multiple of the slope of a position."""
    coded = [Register.of(log[name]).fault(name) for name in log.of("v")]
    ratios = [(name, log.slope_ratio(each, name), each) for name in log.of("v") if name not in v for each in q]
    odd = [f"{name} is {ratio:.3g} times the slope of {each}, and left out" for name, ratio, each in ratios if ratio]
    return [*(f"{fault}; left out" for fault in coded if fault), *odd]


def velocities(log: LogColumns, q: tuple[str, ...]) -> tuple[str, ...]:
    """The velocity of each position: of what is called so, or of what has no name, what follows its slope."""
    named = paired(q, [name for name in log.of("v") if not Register.of(log[name]).negative])
    if len(named) == len(q):
        return named if not any(_is_off(log, *pair) for pair in zip(q, named, strict=True)) else ()
    found = []
    for position in q:
        ratios = {name: log.slope_ratio(position, name) for name in (*named, *log.of(""))}
        like = [name for name, ratio in ratios.items() if ratio and ratio > 0 and (name not in named or is_near(ratio))]
        found += like[:1]
    return tuple(found) if len(set(found)) == len(q) else ()


def _is_off(log: LogColumns, position: str, name: str) -> bool:
    """Whether a velocity is in another unit than its position says."""
    rate, unit = log.unit(name, "v"), log.unit(position, "q") or "rad"
    if rate is not None and not is_unit_of(rate, (f"{unit}/s",)):
        return True
    ratio = log.slope_ratio(position, name)
    moving = np.count_nonzero(np.diff(log[position])) > FEWEST_CHANGES
    return bool(moving and ratio is not None and not 0.4 < ratio < 1.6)


def quaternion(log: LogColumns) -> tuple[str, ...]:
    """Names of four columns that are a unit quaternion which moves, scalar first; none where no four are."""
    groups: dict[str, dict[str, str]] = {}
    for name in (each for each in log.roles if each != log.t):
        match = _QUATERNION.match(name)
        if match is not None and role(name) not in ("left out", "t"):
            letter = match[2].lower()
            groups.setdefault(match[1], {})[_LETTERS.get(letter, letter)] = name
    for group in groups.values():
        for order in ("wxyz", "0123", "1234"):
            # The first four of seven joints are none.
            if set(order) != {key for key in group if key.isdigit() == order.isdigit()}:
                continue
            names = tuple(group[key] for key in order)
            q = log.stack(names)
            q = q[np.isfinite(q).all(axis=1)]
            if not len(q) or not np.ptp(q, axis=0).any():
                continue
            lengths, motion = np.linalg.norm(q, axis=1), np.ptp(q, axis=0).max()
            if np.abs(lengths - 1).max() < OFF_UNIT:
                return names
            # Whole numbers of a sensor, as 16384 for 1
            if motion > SCALED_MOTION * lengths.max() and np.ptp(lengths) < SCALED_MOTION**2 * lengths.max():
                raise InputError(
                    f"{', '.join(names)} are a quaternion of length {np.median(lengths):.5g}; divide them by it in the "
                    'log, or name the positions by `columns["q"]`'
                )
    return ()
