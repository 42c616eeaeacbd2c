"""Defines the layout of a model file: its tables and keys, and the values that each key may have."""

import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from covariant._door import parse_toml
from covariant._names import refuse_unknown
from covariant.logs import ATTITUDES, Columns, unit_factor
from covariant.models._parameters import ZERO_OR_MORE
from covariant.models.files._keys import Counts, Number
from covariant.models.files._model_file import KEYS
from covariant.models.files._sensor_keys import EVERY_SENSOR, SENSOR_KEYS
from scalargraph.errors import InputError

Overrides = Sequence[str] | Mapping[str, Any]
"""Values that replace those of a model file: a text `table.key=value` each, or a mapping from `table.key` to values."""

WRENCH = "wrench"
"""Table of the forces that act on links, with one table for each force."""
_OF_WRENCH = {"link": True, "force_std": True, "torque_std": False, "time": True, "frame": False, "point": False}
"""Keys of the table of a force, and whether each is required."""

SENSORS = "sensors"
"""Table of the sensors in addition to the measured positions, with one table for each sensor."""

SERVO = "servo"
"""Table of the servos of a robot, with one table for each joint; `models.robots` defines its keys."""

LOOP = "loop"
"""Table of the closed loops of a robot, with one table for each loop; `models.robots` defines its keys."""

_NAMES = tuple(field for field in Columns._fields if field != "units")
"""Keys of [columns], and of [units] except attitudes, which have no unit."""
_PLACES = [key.path.split(".") for key in KEYS.values()]
_OF_TABLE = {"columns": _NAMES, "units": tuple(name for name in _NAMES if name not in ATTITUDES)} | {
    table: tuple(key for other, key in _PLACES if other == table) for table, _ in _PLACES
}
"""Keys of each table, except tables whose keys are names."""
_QUOTED = re.compile(r"""\"(?:[^"\\]|\\.)*\"|'[^']*'""")
_ODD_NUMBER = re.compile(r"(?<![\w-])[+-]?(?:0[xob]\w|[0-9.]+_)")
"""Numbers with underscores or in hexadecimal: TOML allows them, but on a command line they are likely typing errors."""
_REPLACES = {key.path: key.replaces for key in KEYS.values()} | {
    f"columns.{kind}": tuple(other for other in ATTITUDES if other != kind) for kind in ATTITUDES
}
"""Keys of the same table that a key replaces, since they state the same in another way."""
_PASSING_FORCE = {"external_force_std", "external_force_time"}
"""Keys of a force that is forgotten over time; both or none must be given."""


def override(document: dict[str, Any], overrides: Overrides) -> dict[str, Any]:
    """Replace values of a document, which is changed and returned."""
    for text, key, value in _pairs(overrides):
        *tables, last = key.split(".")
        if not last or not all(tables):
            raise InputError(f"override {text!r} must be written table.key=value, as in design.damping=0.5")
        table = document
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise InputError(f"override {text!r}: {name!r} is not a table")
        for rival in _REPLACES.get(key, ()):  # a new key replaces other keys that state the same number
            table.pop(rival, None)
        table[last] = value
    return document


def _pairs(overrides: Overrides) -> Iterator[tuple[str, str, Any]]:
    """Text, key and value of each override."""
    if isinstance(overrides, Mapping):
        yield from ((key, key, plain(value)) for key, value in overrides.items())
        return
    for text in overrides:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise InputError(f"override {text!r} must be written table.key=value, as in design.damping=0.5")
        yield text, key, _value(text, value)


def plain(value: Any) -> Any:
    """A copy of a value in TOML's types: tuples and arrays become lists, NumPy's numbers become Python's."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    value = value.tolist() if hasattr(value, "tolist") else value
    return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def _value(text: str, value: str) -> Any:
    # Quoted texts are emptied first, since they may contain anything.
    if _ODD_NUMBER.search(_QUOTED.sub('""', value)):
        raise InputError(f"override {text!r}: write numbers in plain decimals, as 1000 or 1e3")
    try:
        # The parser is the same as for the file, so that a value has the same meaning in both.
        return parse_toml(f"value = {value}")["value"]
    except InputError as error:
        reason = str(error).removeprefix("not a TOML document: ").split(" (at ")[0]
        raise InputError(f"override {text!r}: the value is not TOML ({reason}); text needs quotes") from error


def check_layout(document: dict[str, Any]) -> None:
    """Check that a document contains only tables and keys of a model file."""
    for table, content in document.items():
        refuse_unknown("table or key", table, ("system", "parameters", *_OF_TABLE, WRENCH, SENSORS, SERVO, LOOP))
        if table != "system" and not isinstance(content, dict):
            raise InputError(f"{table} must be a table, [{table}]; got {content!r}")
        if table in _OF_TABLE:
            for key in content:
                refuse_unknown(f"key of [{table}]", key, _OF_TABLE[table])
        else:  # the numbers of other tables are checked against the ranges of their keys
            _check_finite(table, content)


def _check_finite(key: str, value: object) -> None:
    """Check that all numbers of a table are finite."""
    for name, entry in value.items() if isinstance(value, dict) else ():
        _check_finite(f"{key}.{name}", entry)
    for k, entry in enumerate(value if isinstance(value, list) else ()):
        _check_finite(f"{key}[{k}]", entry)
    # A TOML integer may have any number of digits, so it may exceed the range of floats.
    if isinstance(value, int | float) and not abs(value) <= sys.float_info.max:
        raise InputError(f"{key} must be a finite number; got {value if isinstance(value, float) else 'a larger one'}")


def columns(document: dict[str, Any]) -> dict[str, Any]:
    """Read the fields of `Columns` from the tables [columns] and [units]."""
    table = document.get("columns", {})
    for key, value in table.items():
        names = [value] if key == "t" else value
        if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
            expected = "the name of a column" if key == "t" else 'a list of column names, as in ["q1", "q2"]'
            raise InputError(f"columns.{key} must be {expected}; got {value!r}")
        # Several servos may share one switch or supply column, but not their commands, which come first.
        distinct = names[: len(document.get(SERVO, {})) or None] if key == "u" else names
        if len(set(distinct)) < len(distinct):
            raise InputError(f"columns.{key} names a column twice: {', '.join(names)}")
    fields = {key: value if key == "t" else tuple(value) for key, value in table.items()}
    return fields | ({"units": _units(document["units"])} if "units" in document else {})


def _units(table: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """The units of each field, one for all columns or one for each; raises `ValueError` for an unknown unit."""
    units = {key: [value] if isinstance(value, str) else value for key, value in table.items()}
    for key, texts in units.items():
        if not isinstance(texts, list) or not texts or not all(isinstance(text, str) for text in texts):
            raise InputError(f'units.{key} must be a unit, as in "deg", or a list of units; got {table[key]!r}')
        for text in texts:
            try:
                unit_factor(text)
            except InputError as error:
                raise InputError(f"units.{key}: {error}") from error
    return {key: tuple(texts) for key, texts in units.items()}


def numbers(document: dict[str, Any], counts: Counts) -> dict[str, Any]:
    """Read numbers and texts by field of `ModelFile`, with lists of the lengths `counts`."""
    if {"std", "quantum"} <= document.get("measurement", {}).keys():
        raise InputError("[measurement] has both std and quantum; keep one (std = quantum / sqrt(12))")
    forces = {"external_force", *_PASSING_FORCE} & document.get("uncertainty", {}).keys()
    if forces not in (set(), {"external_force"}, _PASSING_FORCE):
        raise InputError(
            "[uncertainty] needs external_force_std and external_force_time together, for a force that is forgotten, "
            f"or external_force alone, for one that stays; got {', '.join(sorted(forces))}"
        )
    fields = {}
    for field, key in KEYS.items():
        table, name = key.path.split(".")
        if name in document.get(table, {}):
            fields[field] = key.read(document[table][name], counts)
    if not fields.get("uncertain", True):
        del fields["uncertain"]  # an empty list keeps the uncertain parameters of a model object
    if "quantum" in fields:
        # An error distributed uniformly over one tick has the variance quantum²/12.
        ticks = fields["quantum"]
        std = tuple(tick / math.sqrt(12) for tick in ticks) if isinstance(ticks, tuple) else ticks / math.sqrt(12)
        fields["measurement_std"] = std
    return fields | _wrenches(document) | _sensors(document)


def _wrenches(document: dict[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """The forces on links by name, as arguments of `observers.wrench`, which checks their values."""
    given = document.get(WRENCH, {})
    for name, content in given.items():
        if not isinstance(content, dict):
            raise InputError(f"{WRENCH}.{name} must be a table, [{WRENCH}.{name}]; got {content!r}")
        for key in content:
            refuse_unknown(f"key of [{WRENCH}.{name}]", key, _OF_WRENCH)
        missing = [key for key, needed in _OF_WRENCH.items() if needed and key not in content]
        if missing:
            raise InputError(
                f"[{WRENCH}.{name}] needs {' and '.join(missing)}: the link, the usual size of the force [N], and the "
                "time [s] after which it is forgotten"
            )
    return {"wrenches": dict(given)} if given else {}


def _sensors(document: dict[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """The sensors by name; their numbers are checked when the sensors are created."""
    given = document.get(SENSORS, {})
    for name, content in given.items():
        where = f"[{SENSORS}.{name}]"
        if not isinstance(content, dict):
            raise InputError(f"{SENSORS}.{name} must be a table, {where}; got {content!r}")
        kind = content.get("kind")
        if kind not in SENSOR_KEYS:
            raise InputError(f"{where} needs a kind, one of {', '.join(SENSOR_KEYS)}; got {kind!r}")
        required, optional = (shared + more for shared, more in zip(EVERY_SENSOR, SENSOR_KEYS[kind], strict=True))
        for key in content:
            refuse_unknown(f"key of {where}", key, required + optional)
        missing = [key for key in required if key not in content]
        if missing:
            raise InputError(f"{where} needs {', '.join(missing)}")
        for key in ("columns", "of"):
            names = content.get(key, ["x"])
            if not isinstance(names, list) or not names or not all(isinstance(each, str) and each for each in names):
                raise InputError(f'{SENSORS}.{name}.{key} must be a list of names, as in ["x", "y"]; got {names!r}')
        if "units" in content:
            _units({f"{SENSORS}.{name}": content["units"]})
        Number(f"{SENSORS}.{name}.delay", ZERO_OR_MORE).checked(content.get("delay", 0.0))
        attitude = content.get("attitude", next(iter(ATTITUDES)))
        if attitude not in ATTITUDES:
            raise InputError(f"{SENSORS}.{name}.attitude must be one of {', '.join(ATTITUDES)}; got {attitude!r}")
    return {"sensors": dict(given)} if given else {}
