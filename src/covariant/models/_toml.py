"""The layout of a model file: its tables and keys, and the values that each of them may have."""

import math
import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

from covariant.logs import ATTITUDES, Columns, unit_factor
from covariant.models._sensor_keys import EVERY_SENSOR, SENSOR_KEYS
from covariant.models._systems import unknown

Overrides = Sequence[str] | Mapping[str, Any]
"""Values that replace those of a model file: `table.key=value` each, or a mapping from `table.key` to values."""

NUMBERS = {
    ("inputs", "lag"): ("input_lag", 1.0),
    ("inputs", "delay"): ("input_delay", 1.0),
    ("measurement", "std"): ("measurement_std", 1.0),
    ("measurement", "delay"): ("delay", 1.0),
    ("measurement", "quantum"): ("quantum", 1.0),
    ("measurement", "bias"): ("bias", 1.0),
    ("measurement", "bias_drift"): ("bias_drift", 1.0),
    ("uncertainty", "acceleration"): ("acceleration_std", 1.0),
    ("uncertainty", "torque"): ("torque_std", 1.0),
    ("uncertainty", "correlation_time"): ("correlation_time", 1.0),
    ("uncertainty", "process"): ("process_std", 1.0),
    ("initial", "state"): ("initial_state", 1.0),
    ("initial", "std"): ("initial_std", 1.0),
    ("uncertainty", "external_force"): ("external_force", 1.0),
    ("uncertainty", "external_force_std"): ("external_force_std", 1.0),
    ("uncertainty", "external_force_time"): ("external_force_time", 1.0),
    ("uncertainty", "parameters_drift"): ("parameters_drift", 1.0),
    ("uncertainty", "motion_acceleration"): ("motion_std", 1.0),
    ("uncertainty", "motion_time"): ("motion_time", 1.0),
    ("design", "damping"): ("damping", 1.0),
    ("design", "natural_frequency"): ("natural_frequency", 1.0),
    ("reference", "half"): ("reference_half", 1.0),
    ("reference", "order"): ("reference_order", 1),
}
"""Table and key of each number, with the field of `ModelFile` it fills and the factor that converts it."""

WORDS = {("inputs", "between"): ("input_between", ("held", "linear"))}
"""Table and key of each choice, with the field of `ModelFile` it fills and the values that it may have."""

UNCERTAIN = ("uncertainty", "parameters")
"""Table and key of the numbers of [parameters] that are estimated with the motion, with their relative deviations."""

WRENCH = "wrench"
"""Table of the forces that act on links, a table for each."""
_OF_WRENCH = ("link", "force_std", "torque_std", "time", "frame", "point")

SENSORS = "sensors"
"""Table of the sensors beside the measured positions, a table for each."""

_NAMES = tuple(field for field in Columns._fields if field != "units")
"""Keys of [columns], and of [units] but for attitudes, which have none."""
_KEYS = {"columns": _NAMES, "units": tuple(name for name in _NAMES if name not in ATTITUDES)} | {
    table: tuple(key for other, key in (*NUMBERS, *WORDS, UNCERTAIN) if other == table)
    for table in dict.fromkeys(table for table, _ in NUMBERS)
}
_QUOTED = re.compile(r"""\"(?:[^"\\]|\\.)*\"|'[^']*'""")
_ODD_NUMBER = re.compile(r"(?<![\w-])[+-]?(?:0[xob]\w|[0-9.]+_)")
"""TOML allows underscores and hexadecimal numbers; on a command line these are more likely typing errors."""
_MAY_BE_ZERO = {("inputs", "lag"), ("inputs", "delay"), ("measurement", "delay")} | {
    ("measurement", "bias"),
    ("measurement", "bias_drift"),
    ("uncertainty", "parameters_drift"),
}
_ANY_SIGN = {("initial", "state")}
_FORCE_IN_THE_LONG_RUN = {"external_force_std", "external_force_time"}
"""Keys of a force that returns to zero, which go together."""
_OF_STATES = {("uncertainty", "process"), ("initial", "state"), ("initial", "std")}
"""Numbers of state-space models, of which there may be one for each state."""
_MAY_BE_LISTS = {("measurement", key) for key in ("std", "quantum", "delay", "bias", "bias_drift")} | {
    ("uncertainty", "torque"),
    ("uncertainty", "external_force_std"),
    *_OF_STATES,
}
"""Numbers of which there may be one for each coordinate or state."""
_RIVALS = {
    "measurement.std": ("quantum",),
    "measurement.quantum": ("std",),
    "uncertainty.external_force": ("external_force_std", "external_force_time"),
    "uncertainty.external_force_std": ("external_force",),
} | {f"columns.{kind}": tuple(other for other in ATTITUDES if other != kind) for kind in ATTITUDES}


def parse(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Args:
        text: Text of the document.

    Returns:
        Tables and keys as nested dictionaries and lists.

    Raises:
        ValueError: Names the line of the first mistake.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"not a TOML document: {error}") from error


def override(document: dict[str, Any], overrides: Overrides) -> dict[str, Any]:
    """Replace values of a document.

    Args:
        document: Tables and keys of a model file; it is changed.
        overrides: `table.key=value` each, with values as in TOML, or a mapping from `table.key` to Python values.

    Returns:
        The same document.

    Raises:
        ValueError: An override is not so written, or does not name a key of a table.
    """
    for text, key, value in _pairs(overrides):
        *tables, last = key.split(".")
        if not last or not all(tables):
            raise ValueError(f"override {text!r} must be written table.key=value, as in design.damping=0.5")
        table = document
        for name in tables:
            table = table.setdefault(name, {})
            if not isinstance(table, dict):
                raise ValueError(f"override {text!r}: {name!r} is not a table")
        for rival in _RIVALS.get(key, ()):  # of two keys for the same number the new one replaces the old
            table.pop(rival, None)
        table[last] = value
    return document


def _pairs(overrides: Overrides) -> Iterator[tuple[str, str, Any]]:
    """Text, key and value of each override."""
    if isinstance(overrides, Mapping):
        yield from ((key, key, _plain(value)) for key, value in overrides.items())
        return
    for text in overrides:
        key, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise ValueError(f"override {text!r} must be written table.key=value, as in design.damping=0.5")
        yield text, key, _value(text, value)


def _plain(value: Any) -> Any:
    """A value in TOML's types: tuples and arrays become lists, NumPy's numbers become Python's."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def _value(text: str, value: str) -> Any:
    # Texts are emptied first: a name in quotes may hold anything.
    if _ODD_NUMBER.search(_QUOTED.sub('""', value)):
        raise ValueError(f"override {text!r}: write numbers in plain decimals, as 1000 or 1e3")
    try:
        # By the parser of the file, so that a value means the same in both places.
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError as error:
        reason = str(error).split(" (at ")[0]
        raise ValueError(f"override {text!r}: the value is not TOML ({reason}); text needs quotes") from error


def check_layout(document: dict[str, Any]) -> None:
    """Check that a document has no table or key but those of a model file.

    Args:
        document: Tables and keys of a model file.

    Raises:
        ValueError: Names the first unknown one and suggests the nearest name.
    """
    for table, content in document.items():
        refuse_unknown("table or key", table, ("system", "parameters", *_KEYS, WRENCH, SENSORS))
        if table != "system" and not isinstance(content, dict):
            raise ValueError(f"{table} must be a table, [{table}]; got {content!r}")
        if table in _KEYS:
            for key in content:
                refuse_unknown(f"key of [{table}]", key, _KEYS[table])


def refuse_unknown(what: str, name: str, known: Collection[str]) -> None:
    """Check that a name is a known one.

    Args:
        what: What the name is of, for the message.
        name: The name.
        known: The names that exist.

    Raises:
        ValueError: Suggests the nearest known name and lists all.
    """
    if name not in known:
        raise ValueError(unknown(what, name, known))


def columns(document: dict[str, Any]) -> dict[str, Any]:
    """Read the tables [columns] and [units] of a document.

    Args:
        document: Tables and keys of a model file.

    Returns:
        The fields of `Columns` that it has.

    Raises:
        ValueError: A value is no name, or no unit.
    """
    table = document.get("columns", {})
    for key, value in table.items():
        names = [value] if key == "t" else value
        if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
            expected = "the name of a column" if key == "t" else 'a list of column names, as in ["q1", "q2"]'
            raise ValueError(f"columns.{key} must be {expected}; got {value!r}")
        if len(set(names)) < len(names):
            raise ValueError(f"columns.{key} names a column twice: {', '.join(names)}")
    fields = {key: value if key == "t" else tuple(value) for key, value in table.items()}
    return fields | ({"units": _units(document["units"])} if "units" in document else {})


def _units(table: dict[str, Any]) -> dict[str, tuple[str, ...]]:
    """The units of each field, one or one for each column; raises `ValueError` for an unknown unit."""
    units = {key: [value] if isinstance(value, str) else value for key, value in table.items()}
    for key, texts in units.items():
        if not isinstance(texts, list) or not texts or not all(isinstance(text, str) for text in texts):
            raise ValueError(f'units.{key} must be a unit, as in "deg", or a list of units; got {table[key]!r}')
        for text in texts:
            try:
                unit_factor(text)
            except ValueError as error:
                raise ValueError(f"units.{key}: {error}") from error
    return {key: tuple(texts) for key, texts in units.items()}


def numbers(document: dict[str, Any], count: int, states: int) -> dict[str, Any]:
    """Read the numbers and choices of a document.

    Args:
        document: Tables and keys of a model file.
        count: Length of a list with one number for each coordinate; 1 where the model is on a group.
        states: Length of a list with one number for each state; 0 for a mechanical model, which has none.

    Returns:
        Values by field of `ModelFile`: numbers, or tuples where the document has lists.

    Raises:
        ValueError: Names the first invalid value.
    """
    if {"std", "quantum"} <= document.get("measurement", {}).keys():
        raise ValueError("[measurement] has both std and quantum; keep one (std = quantum / sqrt(12))")
    forces = {"external_force", *_FORCE_IN_THE_LONG_RUN} & document.get("uncertainty", {}).keys()
    if forces not in (set(), {"external_force"}, _FORCE_IN_THE_LONG_RUN):
        raise ValueError(
            "[uncertainty] needs external_force_std and external_force_time together, for a force that is forgotten, "
            f"or external_force alone, for one that stays; got {', '.join(sorted(forces))}"
        )
    entries = {(table, key): document[table][key] for table, key in NUMBERS if key in document.get(table, {})}
    fields: dict[str, Any] = {}
    for where, value in entries.items():
        field, factor = NUMBERS[where]
        if where in _OF_STATES and not states:
            raise ValueError(f"{'.'.join(where)} is for a state-space model, and this one is mechanical")
        length = states if where in _OF_STATES else count
        values = _numbers(where, value, length) if isinstance(value, list) else (_number(where, value),)
        scaled = tuple(number * factor for number in values)
        fields[field] = scaled if isinstance(value, list) else scaled[0]
    if "quantum" in fields:
        ticks = fields["quantum"]  # an error uniform over one step has the variance quantum²/12
        values = tuple(tick / math.sqrt(12) for tick in (ticks if isinstance(ticks, tuple) else (ticks,)))
        fields["measurement_std"] = values if isinstance(ticks, tuple) else values[0]
    return fields | _choices(document) | _uncertain(document, states) | _wrenches(document) | _sensors(document)


def _number(where: tuple[str, str], value: Any) -> float | int:
    # The smallest positive float as bound lets one comparison tell "positive" from "≥ 0".
    bound = -math.inf if where in _ANY_SIGN else 0.0 if where in _MAY_BE_ZERO else math.ulp(0.0)
    if (
        isinstance(value, bool)
        or not isinstance(value, int | float)
        or not (bound <= value < math.inf and math.isfinite(value))
    ):
        expected = "finite number" if bound < 0 else "positive number" if bound > 0 else "number ≥ 0"
        raise ValueError(f"{'.'.join(where)} must be a {expected}; got {value!r}")
    return value


def _numbers(where: tuple[str, str], values: list[Any], count: int) -> tuple[float | int, ...]:
    if where not in _MAY_BE_LISTS:
        _number(where, values)
    if len(values) != count:
        raise ValueError(f"{'.'.join(where)} lists {len(values)} numbers; give {count}, or one number without brackets")
    return tuple(_number(where, value) for value in values)


def _uncertain(document: dict[str, Any], states: int) -> dict[str, dict[str, float]]:
    """The relative standard deviations of uncertain parameters, by name."""
    table, key = UNCERTAIN
    deviations = document.get(table, {}).get(key, {})
    if not isinstance(deviations, dict):
        raise ValueError(
            f"{table}.{key} must name numbers of [parameters], each with the standard deviation of its relative error, "
            f'as in {{"mass[0]" = 0.3}}; got {deviations!r}'
        )
    if deviations and states:
        raise ValueError(f"{table}.{key} is for a mechanical model, and this one is a state-space model")
    # Nothing where there are none: a model that is an object keeps those that it has.
    stated = {name: _number((table, f"{key}.{name}"), value) for name, value in deviations.items()}
    return {"uncertain": stated} if stated else {}


def _wrenches(document: dict[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """The forces on links, by name, as arguments of `observers.wrench`; whose values are checked there."""
    given = document.get(WRENCH, {})
    for name, content in given.items():
        if not isinstance(content, dict):
            raise ValueError(f"{WRENCH}.{name} must be a table, [{WRENCH}.{name}]; got {content!r}")
        for key in content:
            refuse_unknown(f"key of [{WRENCH}.{name}]", key, _OF_WRENCH)
        missing = [key for key in ("link", "force_std", "time") if key not in content]
        if missing:
            raise ValueError(
                f"[{WRENCH}.{name}] needs {' and '.join(missing)}: the link, the usual size of the force [N], and the "
                "time [s] after which it is forgotten"
            )
    return {"wrenches": dict(given)} if given else {}


def _sensors(document: dict[str, Any]) -> dict[str, dict[str, dict[str, Any]]]:
    """The sensors, by name; whose numbers are checked where they are made."""
    given = document.get(SENSORS, {})
    for name, content in given.items():
        where = f"[{SENSORS}.{name}]"
        if not isinstance(content, dict):
            raise ValueError(f"{SENSORS}.{name} must be a table, {where}; got {content!r}")
        kind = content.get("kind")
        if kind not in SENSOR_KEYS:
            raise ValueError(f"{where} needs a kind, one of {', '.join(SENSOR_KEYS)}; got {kind!r}")
        required, optional = (every + own for every, own in zip(EVERY_SENSOR, SENSOR_KEYS[kind], strict=True))
        for key in content:
            refuse_unknown(f"key of {where}", key, required + optional)
        missing = [key for key in required if key not in content]
        if missing:
            raise ValueError(f"{where} needs {', '.join(missing)}")
        for key in ("columns", "of"):
            names = content.get(key, ["x"])
            if not isinstance(names, list) or not names or not all(isinstance(each, str) and each for each in names):
                raise ValueError(f'{SENSORS}.{name}.{key} must be a list of names, as in ["x", "y"]; got {names!r}')
        if "units" in content:
            _units({f"{SENSORS}.{name}": content["units"]})
        _number(("measurement", "delay"), content.get("delay", 0.0))
        attitude = content.get("attitude", next(iter(ATTITUDES)))
        if attitude not in ATTITUDES:
            raise ValueError(f"{SENSORS}.{name}.attitude must be one of {', '.join(ATTITUDES)}; got {attitude!r}")
    return {"sensors": dict(given)} if given else {}


def _choices(document: dict[str, Any]) -> dict[str, str]:
    fields = {}
    for (table, key), (field, known) in WORDS.items():
        if key in document.get(table, {}):
            choice = document[table][key]
            if choice not in known:
                raise ValueError(f"{table}.{key} must be one of {', '.join(map(repr, known))}; got {choice!r}")
            fields[field] = choice
    return fields
