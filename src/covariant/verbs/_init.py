"""`init`: a first model file for a log, with the columns that its header names."""

import re
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from covariant import logs, models
from covariant.calibration import Draft, draft
from covariant.models import Overrides
from covariant.verbs.base import servo_draft
from covariant.verbs.base.inputs import ColumnNames, column_names
from covariant.verbs.base.outputs import check_output
from covariant.verbs.base.placeholders import marked
from covariant.verbs.base.progress import Progress, notebook_line
from covariant.verbs.base.result import AbstractResult
from scalargraph.errors import InputError
from scalargraph.files import utf8, write_together
from scalargraph.template import fill

DRY_FRICTION = "times atan(100 v): dry friction, divided by pi/2"
SETTABLE = ("units.t", "units.q", "units.u", "units.v", "parameters.path")
"""Values of a draft that may be given before it is written."""


def init(
    log: Any, *, columns: ColumnNames | None = None, overrides: Overrides = (), progress: Progress = notebook_line
) -> "InitResult":
    """Draft a model file from the header and the content of a log.

    Where all positions are angles, the machine is a chain of pendulums. Where some are lengths, its equations of motion
    are drafted as well, in a Python file beside the model file: of a pole on a cart for one length and one angle,
    otherwise of masses that move each on its own. Four columns that are a unit quaternion are the attitude of a body
    that turns about a point.

    Where positions follow other columns as servos follow their commands, the machine is a robot with a servo at each
    joint, which `covariant.fit` identifies. Its file is `parameters.path`; without one, each joint moves by itself.

    Args:
        log: A path, a DataFrame, or an xarray Dataset; or a folder of logs, such as a data set of LeRobot.
        columns: Names of columns by field (t, q, u, v) that are known; the others are guessed.
        overrides: Values of the draft that are known, `units.q`, `units.u`, `units.v`, `units.t` and `parameters.path`,
            the file of a robot: `{"units.q": "deg", "parameters.path": "arm.urdf"}`.
        progress: Called with a description as the work goes on.

    Returns:
        The draft, with what was guessed in its comments; `save` writes it.

    Raises:
        ValueError: For a log in which no stamps or positions are found, or servos are in a unit that is not clear.

    Example:
        >>> import numpy as np, pandas, covariant
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> covariant.verbs.init(pandas.DataFrame({"t": t, "angle": 0.3 * np.cos(t)}))
        <InitResult: stamps t, positions angle, no inputs>
    """
    progress("reading the log")
    known = {key: list(column_names(names)) for key, names in (columns or {}).items() if names is not None}
    content = models.override({}, overrides)
    settings = {f"{table}.{key}": value for table, keys in content.items() for key, value in keys.items()}
    for key in settings:
        if key not in SETTABLE:
            raise InputError(f"{key} is no value of a draft; write it into its file. There are {', '.join(SETTABLE)}")
    pairs = content.get("units", {}).items()
    units = {key: (texts,) if isinstance(texts, str) else tuple(texts) for key, texts in pairs}
    robot = str(settings.get("parameters.path", ""))
    survey, given = logs.survey(log), log
    log = survey.log
    try:
        drafted = draft(survey.columns, known, survey.units, units, survey.labels)
    except InputError as error:
        raise InputError(". ".join([f"{logs.source_name(log)}: {error}", *survey.remarks])) from error
    if robot and not drafted.servos:
        raise InputError(f"{logs.source_name(log)}: no commands of servos were found, and parameters.path is for these")
    of_set = "" if robot or survey.robot not in models.robots.ROBOTS else survey.robot
    many = survey.log is not given
    joints = servo_draft.match_joints(drafted, robot or of_set, many, bool(of_set)) if drafted.servos else None
    if joints is not None:
        drafted = servo_draft.with_joints(drafted, joints)
    return InitResult(logs.source_name(log), drafted, (*survey.remarks, *drafted.remarks), joints)


@dataclass(frozen=True, repr=False)
class InitResult(AbstractResult):
    """First model file for a log.

    Attributes:
        log: Name of the log.
        draft: Roles, units, ranges and noise of its columns, as they were guessed.
        remarks: What is odd about the names of its columns, and what was guessed of its inputs.
        joints: Joints of a robot with servos, and their positions; None for another machine.

    Example:
        >>> import numpy as np, pandas, covariant
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> result = covariant.verbs.init(pandas.DataFrame({"t": t, "angle": 0.3 * np.cos(t)}))
        >>> result.summary["columns"]["q"], list(result.texts("pendulum"))
        (['angle'], ['pendulum.toml'])
    """

    log: str
    draft: Draft
    remarks: tuple[str, ...] = ()
    joints: servo_draft.Joints | None = None

    def texts(self, stem: str = "draft", folder: str | Path = ".") -> dict[str, str]:
        """Compose the model file, and for some machines a module with its equations of motion or a robot, as texts.

        Args:
            stem: Name of the model file without its suffix; what is beside it is named after it.
            folder: Folder of the model file, from which the path of a robot counts.

        Returns:
            The texts by the names of their files, the model file last.
        """
        log, module = Path(self.log).name, _module_name(stem)
        files = {}
        if self.joints is not None:
            path = servo_draft.path_from(Path(folder), self.joints.path) if self.joints.path else f"{stem}.urdf"
            machine = servo_draft.robot_lines(self.draft, self.joints, path)
            machine += servo_draft.servo_lines(self.draft, self.joints)
            files = {} if self.joints.path else {path: servo_draft.loose_joints(self.draft, self.joints)}
        elif self.draft.is_ship:
            machine = _ship(self.draft)
        elif any(self.draft.lengths):
            machine = _python_system_lines(self.draft, module)
            files = {f"{module}.py": _equations(self.draft)}
        else:
            machine = _turning_body() if self.draft.quaternion else _chain(self.draft)
        return files | {f"{stem}.toml": _model_file(log, self.draft, machine, self.remarks)}

    @property
    def summary(self) -> dict[str, Any]:
        guess = self.draft
        quaternion = {"quaternion_wxyz": list(guess.quaternion)} if guess.quaternion else {}
        return {
            "log": self.log,
            "columns": {"t": guess.t, "q": list(guess.q), **quaternion, "u": list(guess.u), "v": list(guess.v)},
            "units": {field: list(texts) for field, texts in guess.units.items()},
            "left_out": list(guess.left_out),
            "remarks": list(self.remarks),
        }

    @property
    def headline(self) -> str:
        guess = self.draft
        measured = f"attitude {', '.join(guess.quaternion)}" if guess.quaternion else f"positions {', '.join(guess.q)}"
        line = f"stamps {guess.t}, {measured}"
        kind = "commands" if guess.servos else "inputs"
        line += f", {kind} {', '.join(dict.fromkeys(guess.u))}" if guess.u else ", no inputs"
        return line + (f", velocities {', '.join(guess.v)} to compare with" if guess.v else "")

    def __str__(self) -> str:
        lines = [self.headline, *self.remarks, *_order_guess(self.draft)]
        if self.draft.units:
            units = (f"{field}: " + ", ".join(dict.fromkeys(texts)) for field, texts in self.draft.units.items())
            lines.append(f"units {', '.join(units)}")
        registers, others = self.draft.unused
        current = ", ".join(self.draft.registers.get("current", ()))
        how = f'; with a torque constant of 0.08 N m/A, [columns] u = {current}, [units] u = "0.08 N m"'
        lines += (
            [f"no forces or torques, and left out: {', '.join(registers)}{how if current else ''}"] if registers else []
        )
        lines += [f"left out: {', '.join(others)}"] if others else []
        if self.joints is not None:
            return "\n".join([*lines, *self._next_of_servos()])
        if self.draft.is_ship:
            return "\n".join([*lines, *_next_of_ship(self.draft)])
        todo = "put first values of your machine into [parameters] of the model file"
        if any(self.draft.lengths):
            todo += (
                ", and its equations of motion into the Python file beside it, which is named after it, as "
                f"{_module_name('draft')}.py after draft.toml"
            )
        return "\n".join([*lines, todo])

    def _next_of_servos(self) -> list[str]:
        """What was guessed of the joints of servos, and what to do next."""
        assert self.joints is not None
        lines = [self.joints.guess] if self.joints.guess else []
        if not self.joints.path:
            lines = [
                "each joint moves by itself, without weight, as in the .urdf file beside the model file; for a robot, "
                "give its file by `overrides=['parameters.path=\"arm.urdf\"']`"
            ]
        return [*lines, f"then fit the servos: covariant fit MODEL {'FOLDER' if self.joints.many else 'LOG'} -o FITTED"]

    def written_files(self, path: str | Path) -> list[Path]:
        path = Path(path)
        return [path] + [path.with_name(name) for name in self.texts(path.stem) if name != path.name]

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the model file, and beside it the equations of motion or the robot where they are drafted as well.

        Args:
            path: The model file to write (.toml).
            overwrite: Whether files that exist are replaced.

        Returns:
            The path.

        Raises:
            ValueError: For another suffix, a folder that does not exist, or a file that exists already.
        """
        path = Path(path)
        check_output(path, ".toml", log=self.log)
        texts = {path.with_name(name): text for name, text in self.texts(path.stem, path.parent).items()}
        # All names are free before the first file is written.
        for existing in [file for file in texts if file.exists() and not overwrite]:
            raise InputError(
                f"{existing}: there is such a file already; `overwrite=True` replaces it, or give another name"
            )
        write_together({file: utf8(text) for file, text in texts.items()})
        # A draft that cannot be loaded fails here, and not in the command after it.
        models.load(str(path))
        return path


def _module_name(stem: str) -> str:
    """Name of the module beside a model file."""
    name = re.sub(r"\W", "_", stem, flags=re.ASCII) + "_model"
    return f"_{name}" if name[0].isdigit() else name


def _model_file(name: str, guess: Draft, machine: list[str], remarks: Sequence[str]) -> str:
    """The text of the model file; `machine` are the lines of the system and its parameters."""
    _, others = guess.unused
    motion = [
        "# motion_acceleration = 20.0  # rad/s^2, of the motion itself, and how long it persists [s]",
        "# motion_time = 0.5",
    ]
    lines = [
        f"# Drafted from the log {name}: {guess.rows} rows at {guess.rate:.4g} Hz. The columns are guessed from their",
        "# names and their content. Numbers with a comment `placeholder` are places to put yours, not measurements:",
        "# `covariant fit` and `covariant model` name those that still have that value.",
        "# Units: s, m, kg, rad, N m; those of the log are in [units] where they are others.",
        *(f"# {line}" for remark in remarks for line in textwrap.wrap(f"Of the log: {remark}.", 110)),
        "",
        *machine,
        "",
        "[columns]",
        f"t = {servo_draft.quoted(guess.t)}",
        *_measured(guess),
        f"u = {servo_draft.quoted(guess.u)}" + ("" if guess.u else "  # no input was found"),
        *([f"v = {servo_draft.quoted(guess.v)}  # only compared with, never used"] if guess.v else []),
        *servo_draft.register_lines(guess),
        *([f"# left out: {', '.join(others)}"] if others else []),
        *_units(guess),
        "",
        "[measurement]",
        _sensor(guess),
        *_period(guess),
        "",
        "[uncertainty]",
        "# Gains of observers are designed from how much acceleration the model leaves unexplained, which a log does",
        "# not tell before the model fits: set it after `covariant fit`, then take the marks of comments away.",
        f"# acceleration = 2.0  # {_both(guess, 'm/s^2', 'rad/s^2')}",
        "# correlation_time = 0.01  # s, over which it persists",
        *(motion if guess.quaternion else []),
        *(_WATER if guess.is_ship else []),
        "",
    ]
    return "\n".join(lines)


def _measured(guess: Draft) -> list[str]:
    """The line of the columns of the measured configuration."""
    if guess.quaternion:
        return [
            "# The squares of these sum to 1 in every row.",
            *(f"# {line[0].upper()}{line[1:]}." for line in _order_guess(guess)),
            f"quaternion_wxyz = {servo_draft.quoted(guess.quaternion)}",
        ]
    if guess.is_ship:
        return [
            f"position = {servo_draft.quoted(guess.q[:2])}  # towards north and east, or any two axes with z down",
            f"angle = {servo_draft.quoted(guess.q[2:])}  # from the first axis to the second",
        ]
    spans = ", ".join(f"{q} {low:.3g} to {high:.3g}" for q, (low, high) in zip(guess.q, guess.span, strict=True))
    called = [guess.entries[q] for q in guess.q if q in guess.entries]
    names = f"; the data set calls them {', '.join(called)}" if called else ""
    return [f"q = {servo_draft.quoted(guess.q)}  # in this log {spans}{names}"]


def _order_guess(guess: Draft) -> list[str]:
    """What is unclear about the order of a quaternion whose numbers are counted; letters say which is the scalar."""
    if not any(re.search(r"[0-9]\]?$", name) for name in guess.quaternion):
        return []
    return [f"that {guess.quaternion[0]} is the scalar is guessed: where it is the last, write quaternion_xyzw"]


def _turning_body() -> list[str]:
    """The system and its parameters of a body whose attitude is logged."""
    return [
        'system = "heavy_top"  # a body that turns about a point, on SO(3); other machines: docs/models.md',
        "",
        "[parameters]",
        _guess_line("inertia", 0.02, 3, "kg m^2, about the axes of the body"),
        "moment = 0.0  # N m, weight times the distance of the centre of mass from the point; 0 for a body that flies",
        "axis = [0.0, 0.0, 1.0]  # where the centre of mass lies, in the body; gravity points along -z in space",
        _guess_line("viscous", 0.01, 0, "N m s/rad, friction"),
    ]


def _ship(guess: Draft) -> list[str]:
    """The system and its parameters of a ship with rudder and propeller."""
    first = {name: (np.ravel(each.value), each.unit) for name, each in _of_ship(guess).items()}
    stated = [_list_line(name, *each) for name, each in first.items()]
    if not _has_thrust(guess):  # no force is logged, so that the data sheet alone tells the masses
        stated[0] = f"mass = {first['mass'][0].tolist()}  # {first['mass'][1]}, of the data sheet"
    return [
        'system = "ship"  # of surge, sway and yaw; the masses are those with added mass',
        "",
        "[parameters]",
        *stated,
        "current = [0.0, 0.0]  # m/s, of the water towards north and east; it is estimated in each log",
    ]


_WATER = ("parameters = {current = 0.3}  # m/s, before a log begins", "parameters_drift = 0.003  # m/s in a second")
"""Lines of [uncertainty] of a ship: how large the current usually is, and how it changes."""


def _of_ship(guess: Draft) -> dict[str, models.Parameter]:
    """Parameters of a ship that are not zero, whose second input is a thrust or the speed of a propeller."""
    drive = {} if _has_thrust(guess) else {"parameters.propeller": 0.05}
    return {name: each for name, each in models.load("ship", drive).model.parameters.items() if np.any(each.value)}


def _has_thrust(guess: Draft) -> bool:
    return logs.is_unit_of(guess.units.get("u", ("rad", "N"))[1], ("N",))


def _next_of_ship(guess: Draft) -> list[str]:
    """What to do next with the draft of a ship."""
    thrust, scale = "the thrust tells the masses", "no force is logged: all forces scale with the masses, not fitted"
    return [
        "put the numbers of the data sheet into [parameters] of the model file; "
        + (thrust if _has_thrust(guess) else scale),
        "then fit: covariant fit MODEL LOG -o FITTED",
    ]


def _chain(guess: Draft) -> list[str]:
    """The system and its parameters where all positions are angles."""
    n = len(guess.q)
    # The length of the last link enters nothing, so that nobody is asked for it.
    between = f"{marked([0.3] * (n - 1))}; " if n > 1 else "# "
    lines = [
        'system = "pendulum_chain"  # other machines: docs/models.md',
        "",
        "[parameters]",
        'angles = "relative"  # or "absolute": each link from the vertical',
        'zero = "hanging"  # or "upright": where the angles are 0',
        "gravity = 9.81",
        _guess_line("mass", 1.0, n, "kg"),
        f"length = {[0.3] * n}  {between}m, from joint to joint; that of the last link does not matter",
        _guess_line("com", 0.15, n, "m, from joint to centre of mass"),
        _guess_line("inertia", 0.01, n, "kg m^2, about the centre of mass"),
        _guess_line("viscous", 0.01, n, "N m s/rad, friction in each joint"),
        _guess_line("coulomb", 0.01, n, f"N m, {DRY_FRICTION}"),
    ]
    if len(guess.u) < n:
        how = "as they are named" if guess.driven else "the first ones are guessed"
        driven = guess.driven or list(range(len(guess.u)))
        lines.append(f"actuated = {driven}" + f"  # joints that the inputs drive, from 0: {how}" * bool(guess.u))
    return lines


def _guess_line(key: str, value: float, n: int, what: str) -> str:
    """The line of a parameter of n entries, or of one number where n is 0, whose value is a guess."""
    return _list_line(key, [value] * max(n, 1), what, bool(n))


def _list_line(key: str, values: Sequence[float] | np.ndarray, what: str, is_list: bool = False) -> str:
    numbers = [float(value) for value in values]
    return f"{key} = {numbers if is_list or len(numbers) > 1 else numbers[0]}  {marked(numbers)}; {what}"


def _python_system_lines(guess: Draft, module: str) -> list[str]:
    """The system and its parameters where its equations of motion are in a Python file."""
    n = len(guess.q)
    lines = [f'system = "{module}:make"  # the function make of {module}.py, beside this file', "", "[parameters]"]
    if _is_cart_pole(guess):
        lines += [
            _guess_line("cart_mass", 1.0, 0, "kg"),
            _guess_line("pole_mass", 0.1, 0, "kg"),
            _guess_line("com", 0.15, 0, "m, from the pivot to the centre of mass of the pole"),
            _guess_line("inertia", 0.001, 0, "kg m^2, of the pole about its centre of mass"),
        ]
    else:
        lines += [
            _guess_line("mass", 1.0, n, f"{_both(guess, 'kg', 'kg m^2')}, what moves with each position"),
            _guess_line("weight", 0.0, n, f"{_both(guess, 'N', 'N m')}, against which each position rises"),
        ]
    return [
        *lines,
        _guess_line("viscous", 0.01, n, f"{_both(guess, 'N s/m', 'N m s/rad')}, friction"),
        _guess_line("coulomb", 0.01, n, f"{_both(guess, 'N', 'N m')}, {DRY_FRICTION}"),
    ]


def _is_cart_pole(guess: Draft) -> bool:
    return guess.lengths == (True, False)


def _both(guess: Draft, length: str, angle: str) -> str:
    """The units of a number for each position."""
    kinds = dict.fromkeys(length if is_length else angle for is_length in guess.lengths or (False,))
    return " and ".join(kinds)


def _equations(guess: Draft) -> str:
    """The text of the Python file with the equations of motion."""
    n, m = len(guess.q), len(guess.u)
    trailing = "," if n == 1 else ""
    words = {
        "POSITIONS": ", ".join(map(servo_draft.quoted, guess.plain_names)) + trailing,
        "UNITS": ", ".join('"m"' if is_length else '"rad"' for is_length in guess.lengths) + trailing,
        "CIRCLES": tuple(i for i, is_length in enumerate(guess.lengths) if not is_length),
        "INPUTS": m,
        "PUSHES": "the positions that they name" if guess.driven else f"the first {m} of {n} positions: a guess",
        "POSITIONCOUNT": n,
        "DRIVEN": guess.driven or list(range(m)),
    }
    machine = fill("covariant.verbs", "machine.py", words).splitlines()
    file = "cart_pole.py" if _is_cart_pole(guess) else "separate_masses.py"
    return fill("covariant.verbs", file, {"MACHINE": machine})


def _sensor(guess: Draft) -> str:
    unit = _both(guess, "m", "rad")
    if guess.is_ship:
        x, y, turn = np.ravel(guess.noise)
        noise = (max(x, y), max(x, y), turn)
        return f"std = {_digits(noise, 3)}  # m, m, rad, at most: along, across, about; from third differences"
    if guess.quantum is not None:
        return f"quantum = {_digits(guess.quantum, 6)}  # {unit}, the tick that positions of this log are multiples of"
    return f"std = {_digits(guess.noise, 3)}  # {unit}, at most: from third differences of the positions"


def _period(guess: Draft) -> list[str]:
    """The line of the periods after which readings repeat; none where they do not."""
    if not any(guess.period):
        return []
    texts = [f"{each:.9g}" for each in guess.period]
    written = f"[{', '.join(texts)}]" if len(texts) > 1 else texts[0]
    return [f"period = {written}  # {_both(guess, 'm', 'rad')}, after which readings of this log begin anew"]


def _digits(values: float | Sequence[float], digits: int) -> str:
    """One number, or a list of them; zero, which no sensor has, is written as next to nothing."""
    if isinstance(values, Sequence):
        return "[" + ", ".join(_digits(value, digits) for value in values) + "]"
    return f"{max(values, 1e-12):.{digits}g}"


def _units(guess: Draft) -> list[str]:
    """The table of the units of the log, where these are not those of the file."""
    if not guess.units:
        return []
    lines = ["", "[units]"]
    for field, texts in guess.units.items():
        written = servo_draft.quoted(texts[0]) if len(set(texts)) == 1 else servo_draft.quoted(texts)
        why = "guessed from the numbers: `covariant check` looks closer" if field in guess.guessed else "as stated"
        lines.append(f"{field} = {written}  # {why}")
    return lines
