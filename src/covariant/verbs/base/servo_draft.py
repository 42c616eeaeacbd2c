"""The part of a drafted model file on servos: the robot, a table for each servo, and comments on other columns."""

import json
import math
import os
import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.sax.saxutils import quoteattr

from covariant import models
from covariant.calibration import Draft
from covariant.calibration.identification import DraftedServo
from covariant.logs import unit_factor
from covariant.verbs.base.placeholders import marked
from scalargraph.errors import InputError

FIRST_STIFFNESS = 10.0
"""First stiffness [N m/rad] of a servo; without gravity a fit determines only its ratio to the inertia."""
FIRST_COULOMB = 0.01
"""First dry friction, relative to the torque at an error of one radian."""
FIRST_LIMIT = 0.3
"""First largest torque, relative to that at an error of one radian."""
LAG_LIMITS = (0.02, 0.2)
"""Limits of the lag [s] from which the first delay and damping follow."""
FIRST_LOAD = 0.2
"""First friction per torque that a gear carries."""
USUAL_LAG = 0.06
"""Lag [s] if the log shows none, as with a servo that stands still."""
LINK_INERTIA = 0.001
"""Inertia [kg m^2] of the link of each joint if no robot is given."""
MIN_OFFSET = 0.005
"""Least offset [rad] between a servo and its joint that is written into the draft."""
_REGISTERS = {
    "current": "currents of the drive, no forces or torques",
    "load": "per cent of the drive's voltage or load, no forces or torques",
    "voltage": "supply: with resistance, torque_constant and supply of a drive in [servo.NAME], logged_supply = true "
    "takes them as inputs",
    "temperature": "temperatures",
}


class Joints(NamedTuple):
    """The joints of a robot and the positions of a log.

    Attributes:
        path: Path of the robot, or the name of an included one; "" for independent joints.
        names: Names of the joints that have a position, in the order of the robot.
        positions: Index of the position of each joint in the draft.
        locked: Names of the joints without a position.
        guess: Text on joints that were matched by order, and on positions without a joint; "" if there are none.
        many: Whether there are many logs.
        one_type: Whether all servos are of one type.
    """

    path: str
    names: tuple[str, ...]
    positions: tuple[int, ...]
    locked: tuple[str, ...] = ()
    guess: str = ""
    many: bool = False
    one_type: bool = False


def match_joints(draft: Draft, path: str, many: bool = False, one_type: bool = False) -> Joints:
    """Match joints to the positions of a log, by name where the names agree, and the others in their order."""
    plain = draft.plain_names
    if not path:
        return Joints("", tuple(_joint_name(name) for name in plain), tuple(range(len(plain))), many=many)
    model = models.robots.load(path)
    if not model.manifold.commuting:
        raise InputError(f"{path}: servos are drafted for a robot whose base stands still and has no ball joints")
    joints, words = model.coordinates, [_words(name) for name in plain]
    by_name: dict[str, int] = {}
    for joint in joints:
        alike = [i for i, each in enumerate(words) if each == _words(joint)]
        if len(alike) == 1:
            by_name[joint] = alike[0]
    open_joints = [joint for joint in joints if joint not in by_name]
    open_positions = [i for i in range(len(plain)) if i not in by_name.values()]
    in_order = dict(zip(open_joints, open_positions, strict=False))
    matched = by_name | in_order
    names = tuple(joint for joint in joints if joint in matched)
    guess = ""
    if in_order:
        guess = "that " + ", ".join(f"{joint} is {draft.q[i]}" for joint, i in in_order.items())
        guess += " is guessed from their order: compare names, and the signs of both"
    without_joint = [draft.q[i] for i in open_positions[len(open_joints) :]]
    if without_joint:
        guess += "; " if guess else ""
        guess += f"{', '.join(without_joint)} have no joint in {Path(path).name}, and are left out"
    locked = tuple(joint for joint in joints if joint not in matched)
    return Joints(path, names, tuple(matched[j] for j in names), locked, guess, many, one_type)


def _words(name: str) -> frozenset[str]:
    """Words in the name of a joint or column that distinguish it from others."""
    words = re.findall(r"[a-z]+|[0-9]+", name.lower())
    return frozenset(words) - {"q", "pos", "position", "joint", "angle", "present", "observation", "state", "motor"}


def _joint_name(name: str) -> str:
    """Name of a joint from its column, without the word that marks a position."""
    short = re.sub(r"^(?:q|pos|position|angle|present_position|joint_position|joint_pos)[_./ ]+(?=\D)", "", name)
    short = re.sub(r"[_./ ]+(?:q|pos|position|angle|present_position)$", "", short)
    return re.sub(r"\W+", "_", short, flags=re.ASCII).strip("_") or "joint"


def with_joints(draft: Draft, joints: Joints) -> Draft:
    """The draft with the positions of these joints only, in their order."""
    order = joints.positions
    if order == tuple(range(len(draft.q))):
        return draft
    n, used = len(draft.q), [i for i, servo in enumerate(draft.servos) if servo is not None]
    where = {position: place for place, position in enumerate(used)}
    driven = [where[i] for i in order if i in where]
    switches = tuple(draft.switches[i] for i in driven) if draft.switches else ()

    def each(values):
        return tuple(values[i] for i in order) if isinstance(values, tuple) and len(values) == n else values

    units = {field: each(texts) if field != "u" else texts for field, texts in draft.units.items()}
    if "u" in units:
        texts = units["u"]
        units["u"] = (*(texts[i] for i in driven), *texts[len(used) : len(used) + len(switches)])
    fields = {key: each(getattr(draft, key)) for key in ("q", "v", "lengths", "quantum", "noise", "period", "servos")}
    return draft._replace(
        **fields,
        u=(*(draft.u[i] for i in driven), *switches),
        span=draft.span[list(order)],
        units=units,
        switches=switches,
        left_out=(*draft.left_out, *(name for name in draft.q if name not in fields["q"])),
    )


def robot_lines(draft: Draft, joints: Joints, path: str) -> list[str]:
    """Lines of the system and its parameters; `path` is the robot's path relative to the folder of the model file."""
    lines = ['system = "robot"', "", "[parameters]"]
    if joints.path:
        lines += [f"path = {quoted(path)}"]
    else:
        lines += [
            f"path = {quoted(path)}  # each joint by itself, without weight: give the file of your robot",
            "# here, its joints in the order of columns.q, or draft anew with --set 'parameters.path=\"arm.urdf\"'",
        ]
    if joints.guess:
        lines += [f"# {line}" for line in textwrap.wrap(f"{joints.guess[0].upper()}{joints.guess[1:]}.", 108)]
    driven = [name for name, servo in zip(joints.names, draft.servos, strict=True) if servo is not None]
    if len(driven) < len(joints.names):
        lines.append(f"actuated = [{', '.join(map(quoted, driven))}]  # the others have no command")
    if joints.locked:
        locked = ", ".join(f"{_key(name)} = 0.0" for name in joints.locked)
        lines.append(f"lock = {{ {locked} }}  # no column was found")
    centred = _centres(draft)
    if any(centred):
        inside = ", ".join(f"{_key(n)} = {x:.6g}" for n, x in zip(joints.names, centred, strict=True) if x)
        lines.append(f"offsets = {{ {inside} }}  # rad: half of the ticks is taken for zero, a guess")
    return lines


def _centres(draft: Draft) -> list[float]:
    """Angle to add to each position [rad] so that the middle of a 4096-tick encoder is zero."""
    ticks = zip(draft.units_of_positions, draft.span, strict=True)
    return [-math.pi if unit == "turn/4096" and low >= 0 else 0.0 for unit, (low, _) in ticks]


def servo_lines(draft: Draft, joints: Joints) -> list[str]:
    """Lines of the servo tables."""
    servos = [servo for servo in draft.servos if servo is not None]
    lags = [servo.lag for servo in servos if servo.lag]
    lag = min(max(min(lags), LAG_LIMITS[0]), LAG_LIMITS[1]) if lags else USUAL_LAG
    seen = "of the shortest lag of a position behind its command in this log" if lags else "of a usual lag"
    lines = ["", "[inputs]", 'kind = "command"  # u are positions that servos are commanded to, no torques']
    values = {
        "stiffness": (FIRST_STIFFNESS, "N m/rad"),
        "damping": (FIRST_STIFFNESS * lag / 2, "N m s/rad"),
        "armature": (FIRST_STIFFNESS * (lag / 2) ** 2 / 4, "kg m^2, of the rotor as felt at the joint"),
        "coulomb": (FIRST_COULOMB * FIRST_STIFFNESS, "N m, dry friction of the gear"),
    }
    if joints.one_type:  # many logs of servos that share their numbers tell friction near rest
        values["stribeck"] = FIRST_COULOMB * FIRST_STIFFNESS / 2, "N m, more of it near rest"
    elif joints.many:
        values["limit"] = FIRST_LIMIT * FIRST_STIFFNESS, "N m, the largest torque"
    if joints.many and joints.path:  # without masses only the ratios of torques show
        values["load"] = FIRST_LOAD, "friction per torque that the gear carries"
    first = ""
    for name, servo in zip(joints.names, draft.servos, strict=True):
        if servo is None:
            continue
        lines += ["", f"[servo.{_key(name)}]"]
        lines += [f"like = {quoted(first)}  # servos of one type; without this line each has its own"] * bool(first)
        # Damping and dry friction are those of a gear under its own load, and others in each joint.
        for key, (value, what) in ({k: values[k] for k in ("damping", "coulomb")} if first else values).items():
            rounded = float(f"{value:.3g}")
            lines.append(f"{key} = {rounded!r}  {marked([rounded])}; {what}")
        if not first:
            lines.append(f"delay = {lag / 2:.3g}  # s, half {seen}")
            lines += ["stribeck_velocity = 0.1  # rad/s"] * joints.one_type
        if joints.many:
            lines.append("offset = 0.0  # rad, of the position beyond the command")
        else:
            lines += _offset_line(servo, bool(joints.path))
        first = first or (name if joints.one_type else "")
        if draft.switches:
            lines.append("switch = true  # another input is 0 where the servo is off")
    return lines


def _offset_line(servo: DraftedServo, weighed: bool) -> list[str]:
    """The line of the offset, commented out if the weight of the robot may explain it."""
    if abs(servo.offset) < MIN_OFFSET:
        return []
    mark, why = ("# ", ", unless the weight does it") if weighed else ("", "")
    return [f"{mark}offset = {servo.offset:.3g}  # rad, by which positions of this log are beyond the command{why}"]


def register_lines(draft: Draft) -> list[str]:
    """Comments on columns of the drive that are not used."""
    return [f"# {', '.join(names)}: {_REGISTERS[kind]}" for kind, names in draft.registers.items()]


def loose_joints(draft: Draft, joints: Joints) -> str:
    """The URDF file of independent joints, about a vertical or along a horizontal axis, so that no weight acts."""
    lines = [
        '<?xml version="1.0"?>',
        "<!-- Drafted: each joint of a log of servos by itself, without weight. The inertias are placeholders: of a",
        "     servo alone only the ratio of stiffness and inertia shows. Take the file of your robot in its place. -->",
        '<robot name="loose_joints">',
        '  <link name="base"/>',
    ]
    rows = zip(joints.names, draft.lengths, draft.span, draft.units_of_positions, strict=True)
    for name, is_length, (low, high), unit in rows:
        ends = sorted(unit_factor(unit) * x for x in (low, high))
        margin = max(0.2 * (ends[1] - ends[0]), 0.1)
        kind = "prismatic" if is_length else "revolute"
        limits = f'lower="{ends[0] - margin:.4g}" upper="{ends[1] + margin:.4g}" effort="100" velocity="100"'
        inertia = f'ixx="{LINK_INERTIA}" ixy="0" ixz="0" iyy="{LINK_INERTIA}" iyz="0" izz="{LINK_INERTIA}"'
        lines += [
            f"  <link name={quoteattr(name + '_link')}>",
            f'    <inertial><mass value="{LINK_INERTIA * 100:g}"/><inertia {inertia}/></inertial>',
            "  </link>",
            f'  <joint name={quoteattr(name)} type="{kind}">',
            f'    <parent link="base"/><child link={quoteattr(name + "_link")}/>',
            f'    <axis xyz="{"1 0 0" if is_length else "0 0 1"}"/><limit {limits}/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def path_from(folder: Path, path: str) -> str:
    """Path of a robot relative to the folder of a model file; the name of an included robot stays."""
    located = models.robots.located(path)
    if str(located) != path:
        return path
    return os.path.relpath(located.resolve(), folder.resolve()).replace(os.sep, "/")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else quoted(name)


def quoted(text: str | Sequence[str]) -> str:
    return json.dumps(text, ensure_ascii=False)
