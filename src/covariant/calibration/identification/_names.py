"""Names of columns: words by role, and the names that drives and programs give to what they log."""

import re
from collections.abc import Iterable, Sequence

from covariant.logs import without_unit, words_of

WORDS = {
    "left out": "true truth raw error errors err limit limits",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq effort force forces motor input rudder aileron elevator throttle thruster "
    "thrusters thrust propeller prop fin sail valve steering",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x y heading yaw hdg height altitude "
    "depth stroke travel slide cart ticks",
}
"""Words in the names of columns, by role; the first role with a match counts."""
ACTUATORS = words_of(
    "rudder aileron elevator throttle thruster thrusters thrust propeller prop fin sail valve steering"
)
"""Words of what drives a machine by an angle or a speed of its own."""
REGISTERS = {
    "current": "current currents amp amps ampere",
    "load": "load loads pwm duty",
    "voltage": "volt volts voltage voltages",
    "temperature": "temp temperature temperatures",
}
"""Words of registers of a drive, by what they hold; none of these is a torque."""
AXES = words_of("iq uq vq ud vd")
"""Words of currents and voltages along the axes of a motor."""
LENGTHS = words_of("height altitude depth stroke travel slide cart")
"""Words of positions that are lengths."""
FEED_FORWARD = words_of("ff feedforward feed forward")
"""Words of torques that a drive adds to those that follow from its command."""
EULER = (words_of("roll phi"), words_of("pitch theta"), words_of("yaw psi heading hdg"))
"""Words of the angles about x, y and z by which an attitude is logged."""
DEGREES = 50.0
"""Span [rad] of an angle from which it is more likely in degrees."""
PLANE = ("x y", "px py", "north east", "n e", "easting northing")
"""Names of the two coordinates of a point in the plane, without the words for a position."""


PRODUCTS = {
    "moteus": ("position", "velocity", "torque", "q_current"),
    "ODrive": ("pos_estimate", "vel_estimate"),
}
"""Drives that log turns, though no name says so, and names of columns all of which a log of each has.

Names of other drives and programs consist of words that say what they mean.
"""
TURNS = {"q": "turn", "command": "turn", "v": "turn/s"}
"""Units of their columns by role."""


def product_of(names: Iterable[str]) -> str:
    """The drive of `PRODUCTS` that gave the names of a log, "" for none."""
    last = {re.split(r"[./]", name.lower())[-1] for name in names}
    return next((product for product, marks in PRODUCTS.items() if last >= set(marks)), "")


def point_in_plane(names: Iterable[str]) -> tuple[str, str] | None:
    """The two coordinates of a point in the plane among some names; None if there are no two, or three."""
    plain = {re.sub(r"pos(ition)?|[_./ ]", "", without_unit(name).lower()): name for name in names}
    pairs = ((plain.get(first), plain.get(second)) for first, second in map(str.split, PLANE))
    found = next(((first, second) for first, second in pairs if first and second), None)
    return None if {"z", "pz", "down", "d"} & set(plain) else found


def positions_of(q: Sequence[str], names: Sequence[str]) -> list[int]:
    """Index of the position to which each input or velocity belongs by its words and numbers; empty if one is unclear.

    So shoulder/effort is that of shoulder, and tau2 that of q2.
    """
    roles = words_of(" ".join(WORDS.values())) | words_of("measured actual estimate value data")

    def joint(name: str) -> frozenset[str]:
        plain = without_unit(name)
        return frozenset(words_of(plain) - roles) | frozenset(re.findall("[0-9]+", plain))

    places = {joint(name): k for k, name in enumerate(q)}
    found = [places[joint(name)] for name in names if joint(name) in places]
    return found if len(places) == len(q) and len({*found}) == len(found) == len(names) else []


def paired(q: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """Names of inputs or velocities in the order of their positions, if they say which these are."""
    places = positions_of(q, names)
    return tuple(name for _, name in sorted(zip(places, names, strict=True))) if places else tuple(names)
