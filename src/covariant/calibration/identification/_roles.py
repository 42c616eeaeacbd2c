"""Roles of columns of a log by their names."""

import re

from covariant.calibration.identification._commands import COMMANDS, POSITIONS, TARGETS, TORQUES
from covariant.logs import MEANT, unit_in_name, words_of

_WORDS = {
    "left out": "true truth raw error errors err limit limits",
    "v": "v w dq qd dqdt dot qdot dth dtheta om omega vel velocity velocities speed rate gyro",
    "u": "u tau torque torques tq trq effort force motor input",
    "t": "t time times timestamp timestamps stamp stamps sec secs seconds",
    "q": "q th theta phi psi angle ang pos position positions enc encoder joint x",
}
"""Words in the names of columns, by role; the first role with a match counts."""
REGISTERS = {
    "current": "current currents amp amps ampere",
    "load": "load loads pwm duty",
    "voltage": "volt volts voltage voltages",
    "temperature": "temp temperature temperatures",
}
"""Words of registers of a drive, by what they hold; none of these is a torque."""


def role(name: str, entry: str = "") -> str:
    """Role of a column by its name, a key of `_WORDS`: by its words, else by its unit; empty where neither shows it.

    Of a drive it may be a "command" of its position, the "switch" of its torque, or one of `REGISTERS`. `entry` is what
    the log calls the entry of a list, whose column says that it is a state or an action.
    """
    words = words_of(f"{name} {entry}")
    if words & set(_WORDS["left out"].split()):
        return "left out"
    if words & {"enable", "enabled"}:
        return "switch"
    register = next((kind for kind, synonyms in REGISTERS.items() if words & set(synonyms.split())), "")
    is_rate = bool(words & set(_WORDS["v"].split())) or unit_in_name(name, MEANT["v"]) is not None
    is_torque = bool(words & TORQUES) or unit_in_name(name, MEANT["u"]) is not None
    if words & COMMANDS:
        if is_rate or register:
            return "left out"
        return "command" if not is_torque else "left out" if words & TARGETS else "u"
    if register and not words & POSITIONS and not is_torque:
        return register
    if words & POSITIONS and not is_torque and not is_rate:
        return "q"
    # Entries of a state are positions unless they say otherwise.
    if re.fullmatch(r"(?:.*[_./])?state\[[0-9]+\]", name):
        return "v" if is_rate else "u" if is_torque else "q"
    roles = [kind for kind, synonyms in _WORDS.items() if words & set(synonyms.split())]
    # A unit of velocity decides, whatever the words: q1 [rad/s] is no position.
    if unit_in_name(name, MEANT["v"]):
        return "v"
    roles += [kind for kind, units in MEANT.items() if unit_in_name(name, units)]
    return next(iter(roles), "")
