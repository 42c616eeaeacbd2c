"""Reads and checks the file of a study of many runs."""

import functools
import itertools
import json
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from covariant._door import STUDY, read_toml
from covariant._names import unknown
from covariant.metrics import Grid
from scalargraph.errors import InputError


def _number(value: object, least: float = -math.inf) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value < math.inf


def _numbers(value: object) -> bool:
    return _number(value) or (isinstance(value, list) and bool(value) and all(map(_number, value)))


def _positive(value: Any) -> bool:
    return _number(value, 0.0) and value > 0


KEYS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "model": (lambda value: isinstance(value, str), "the model, a text"),
    "observers": (
        lambda value: isinstance(value, list) and bool(value) and all(isinstance(each, str) for each in value),
        "a list of names of observers",
    ),
    "axes": (lambda value: isinstance(value, Mapping) and bool(value), "a table of what varies"),
    "duration": (_positive, "the length of a run, a positive number [s]"),
    "rate": (_positive, "samples a second, a positive number [Hz]"),
    "below": (_positive, "a velocity error, a positive number"),
    "seed": (lambda value: isinstance(value, int) and not isinstance(value, bool), "a whole number"),
    "gate": (lambda value: isinstance(value, bool), "true or false"),
    "feedback": (
        lambda value: isinstance(value, str) or (isinstance(value, Mapping) and set(value) == {"function", "folder"}),
        '"module:function"',
    ),
    "amplitude": (_numbers, "a number, or a list with one for each input"),
    "frequency": (_positive, "a positive number [Hz]"),
    "push": (_numbers, "a number, or a list with one for each velocity"),
    "noise": (lambda value: _number(value, 0.0), "a standard deviation"),
    "acceleration": (lambda value: _number(value, 0.0), "a standard deviation"),
    "set": (lambda value: isinstance(value, Mapping), "a table of keys of the model file"),
}
"""Keys of a study besides the tables of states, with a test of the value and its description."""
TAKEN = ("observer", "converged", "not finite", "median error", "NEES", "NIS", "in band", "basin", "beyond it")
"""Columns of the result, whose names no axis may have."""
NEEDED = ("model", "observers", "axes")
OF_RUN = ("noise", "acceleration")
"""Keys that belong to a run, besides its states."""
STATES = ("start", "spread", "error")
"""Tables of a study with a number for each position and velocity."""
OF_DESIGN = ("rate", "duration", "push")
"""Keys of the study that may differ between designs."""
ENDS = ("low", "high", "count")
"""Keys of an axis with equal steps."""
FEWEST_SAMPLES = 5
"""Least number of samples, so that the last fifth of a run, whose errors are reported, has at least one."""
MOST_SAMPLES, MOST_VALUES, MOST_DESIGNS, MOST_CASES = 10**6, 10**6, 10**4, 10**9
"""Limits on samples of a run, values of an axis, designs of an observer, and cases; a store has a file per 4096."""


def of_run(key: str) -> bool:
    """Whether a key is a number of a run, and not one for which observers are designed."""
    return key in OF_RUN or key.partition(".")[0] in STATES


def designed_with(each: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a design that are keys of the model file."""
    return {key: value for key, value in each.items() if not (of_run(key) or key in OF_DESIGN)}


class Axis(NamedTuple):
    """An axis of the study: its key and its values, which may be tables of several keys."""

    key: str
    values: Sequence[Any]

    def keys_of(self, value: object) -> list[str]:
        """The keys of one of its values."""
        return [key for key in value if key != "name"] if isinstance(value, dict) else [self.key]

    @property
    def name(self) -> str:
        """Its name in the store."""
        return self.key.replace(".", "_")

    @property
    def designs(self) -> bool:
        """Whether its values are numbered, and observers are designed for each."""
        return not (of_run(self.key) or self.key in ("draw", "error")) or isinstance(self.values[0], dict)

    @property
    def inner(self) -> bool:
        """Whether one row of the result summarises all its values."""
        return not self.designs and (self.key in ("draw", "error") or self.key.partition(".")[0] in STATES)

    @property
    def labels(self) -> list[Any]:
        """Its values, as printed in the result."""
        if isinstance(self.values[0], dict):
            return [value.get("name", k + 1) for k, value in enumerate(self.values)]
        return [str(value) if isinstance(value, list) else value for value in self.values]

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the axis in the store; values that are not equally spaced are numbered from 0."""
        return (float(self.values[0]), float(self.values[-1])) if self._spaced else (0.0, len(self.values) - 1.0)

    @property
    def _spaced(self) -> bool:
        if self.designs or not all(isinstance(value, int | float) for value in self.values):
            return False
        step = self.values[1] - self.values[0]
        return step > 0 and bool(np.allclose(np.diff(self.values), step, atol=0))

    def at(self, x: Array) -> Array:
        """Value at a coordinate of the store."""
        return x if self._spaced else jnp.asarray(self.values, float)[jnp.round(x).astype(int)]


class Study(NamedTuple):
    """A study, as read from its file.

    Attributes:
        text: The whole study as JSON.
        model: The model, as for `estimate`.
        observers: Names of the observers.
        axes: The axes along which the runs vary.
    """

    text: str
    model: str
    observers: tuple[str, ...]
    axes: tuple[Axis, ...]

    @property
    def content(self) -> dict[str, Any]:
        """The study as plain data."""
        return json.loads(self.text)

    @property
    def designs(self) -> list[dict[str, Any]]:
        """Values of the axes for which observers are designed, in all combinations, by key."""
        axes = [
            [
                {k: v for k, v in value.items() if k != "name"} if isinstance(value, dict) else {axis.key: value}
                for value in axis.values
            ]
            for axis in self.axes
            if axis.designs
        ]
        return [functools.reduce(operator.or_, each, {}) for each in itertools.product(*axes)]

    @property
    def samples(self) -> list[int]:
        """Number of samples of a run, for each design."""
        content = self.content
        return [round(run["duration"] * run["rate"]) for run in ({**content, **each} for each in self.designs)]

    @property
    def steps(self) -> int:
        """Number of steps of all observers in all cases."""
        return sum(self.samples) * (self.grid.size // len(self.designs)) * len(self.observers)

    @property
    def numbers(self) -> dict[str, float]:
        """Numbers that belong to every run, by key, unless an axis varies them."""
        content = self.content
        tables = {f"{table}.{name}": v for table in STATES for name, v in content.get(table, {}).items()}
        return {key: content[key] for key in OF_RUN if key in content} | tables

    @property
    def grid(self) -> Grid:
        """All cases."""
        low, high = zip(*(axis.ends for axis in self.axes), strict=True)
        names = [axis.name for axis in self.axes]
        return Grid(names, ["1"] * len(names), low, high, [len(axis.values) for axis in self.axes])


def read_study(path: Path) -> Study:
    """Read the file of a study."""
    return parse_study(read_toml(path, STUDY), str(path), path.parent)


def parse_study(content: Mapping[str, Any], name: str = "study", folder: Path = Path()) -> Study:
    """Check the content of a study."""
    content = dict(content)
    for key, value in content.items():
        if key not in (*KEYS, *STATES):
            raise InputError(f"{name}: {unknown('key', key, (*KEYS, *STATES))}")
        if key in STATES and not isinstance(value, Mapping):
            raise InputError(f"{name}: {key} must be a table of positions and velocities; got {value!r}")
        for state, number in value.items() if key in STATES else ((None, value),):
            _check(name, key if state is None else f"{key}.{state}", number)
    for key in NEEDED:
        if key not in content:
            raise InputError(f"{name}: {key} is missing: {KEYS[key][1]}")
    if (folder / str(content["model"])).exists():
        content["model"] = str((folder / content["model"]).absolute())
    if isinstance(content.get("feedback"), str):
        content["feedback"] = {"function": content["feedback"], "folder": str(folder.absolute())}
    _refuse_twice(f"{name}: observers", content["observers"])
    axes = []
    for key, given in content["axes"].items():
        values = _values(name, key, given)
        if key in TAKEN or (isinstance(values[0], dict) and (of_run(key) or key == "draw")):
            raise InputError(f"{name}: axes.{key} cannot be a name for tables: it is taken")
        if key == "error" and not (all(_number(v, 0.0) for v in values) and np.all(np.diff(values) > 0)):
            raise InputError(f"{name}: axes.error must be multiples that grow, none negative; got {values}")
        for value in values:
            if isinstance(value, dict) and "error" in value:
                raise InputError(f"{name}: error multiplies the first error as an axis alone, not in a table of {key}")
            pairs = value.items() if isinstance(value, dict) else ((key, value),)
            for each, number in pairs:
                if each not in ("name", "draw", "error") or (isinstance(value, dict) and each != "name"):
                    _check(name, each, number)
        axes.append(Axis(key, values))
    text = json.dumps(content)  # axes keep their order
    study = Study(text, content["model"], tuple(content["observers"]), tuple(axes))
    varied = [key for axis in axes for key in {k: None for value in axis.values for k in axis.keys_of(value)}]
    for key in varied:
        if varied.count(key) > 1:
            raise InputError(f"{name}: {key} is in two axes; keep one")
    if "error" in varied and "error" not in content and not any(key.startswith("error.") for key in varied):
        raise InputError(f"{name}: axes.error multiplies the first error, which is missing: a table [error]")
    designing = [axis for axis in study.axes if axis.designs]
    for what, axes, most in (("cases", study.axes, MOST_CASES), ("designs of an observer", designing, MOST_DESIGNS)):
        sizes = {axis.key: len(axis.values) for axis in axes}
        if math.prod(sizes.values()) > most:
            counts = ", ".join(f"{key} {count}" for key, count in sizes.items())
            raise InputError(f"{name}: {math.prod(sizes.values())} {what} are more than {most}; axes have {counts}")
    for each in study.designs:
        run = {**content, **each}
        for key in ("rate", "duration"):
            if key not in run:
                raise InputError(f"{name}: {key} is missing: {KEYS[key][1]}, or an axis of it")
        samples = run["duration"] * run["rate"]
        if not FEWEST_SAMPLES <= round(min(samples, 2.0 * MOST_SAMPLES)) <= MOST_SAMPLES:
            raise InputError(
                f"{name}: a run of {run['duration']:g} s at {run['rate']:g} Hz has {samples:.7g} samples; "
                f"it needs {FEWEST_SAMPLES} to {MOST_SAMPLES}"
            )
    return study


def _values(name: str, key: str, given: object) -> list[Any]:
    """Values of an axis from the study: a number of draws, equal steps, lists by key, or a list."""
    values = given
    if key == "draw":
        if not isinstance(given, int) or isinstance(given, bool) or given < 2:
            raise InputError(f"{name}: axes.draw must be a number of draws, 2 or more; got {given!r}")
        values = range(given)
    elif isinstance(given, Mapping) and given and all(isinstance(each, list) for each in given.values()):
        lengths = {each: len(list_) for each, list_ in given.items()}
        if len(set(lengths.values())) > 1:
            counts = ", ".join(f"{each} {count}" for each, count in lengths.items())
            raise InputError(f"{name}: lists of axes.{key} vary together, and need one length; got {counts}")
        values = [dict(zip(given, together, strict=True)) for together in zip(*given.values(), strict=True)]
    elif isinstance(given, Mapping):
        values = _equal_steps(name, key, given)
    if not isinstance(values, list | range) or len(values) < 2:
        raise InputError(
            f"{name}: axes.{key} needs a list of two values or more; put a single value into [set] or [start]"
        )
    if len(values) > MOST_VALUES:
        raise InputError(f"{name}: axes.{key} has {len(values)} values; {MOST_VALUES} are the most of an axis")
    tables = [value for value in values if isinstance(value, dict)]
    if tables and len(tables) < len(values):
        raise InputError(f"{name}: axes.{key} has tables and other values; give all as tables")
    bare = [{k: v for k, v in table.items() if k != "name"} for table in tables]
    for each in (bare or values, [table["name"] for table in tables if "name" in table]):
        _refuse_twice(f"{name}: axes.{key}", each)
    return list(values)


def _refuse_twice(place: str, values: Sequence[Any]) -> None:
    """Refuse a value that occurs twice."""

    def plain(value: object) -> Any:
        if isinstance(value, dict):
            return frozenset((key, plain(each)) for key, each in value.items())
        return tuple(map(plain, value)) if isinstance(value, list) else value

    seen = set()
    for value in values:
        if (known := plain(value)) in seen:
            raise InputError(f"{place} has {value!r} twice; keep one")
        seen.add(known)


def _equal_steps(name: str, key: str, ends: Mapping[str, Any]) -> list[float]:
    """Values of an axis {low, high, count}."""
    if not all(end in ends for end in ENDS):
        raise InputError(f"{name}: axes.{key} needs a list, {{low, high, count}}, or lists by key")
    for end, value in ends.items():
        if end not in ENDS:
            raise InputError(f"{name}: axes.{key}: {unknown('key', end, ENDS)}")
        if not _number(value):
            raise InputError(f"{name}: {end} of axes.{key} must be a finite number; got {value!r}")
    low, high, count = (ends[end] for end in ENDS)
    if count != int(count) or not 2 <= count <= MOST_VALUES:
        raise InputError(f"{name}: count of axes.{key} must be a whole number from 2 to {MOST_VALUES}; got {count!r}")
    if low == high:
        raise InputError(
            f"{name}: low and high of axes.{key} are both {low!r}; put a single value into [set] or [start]"
        )
    return np.linspace(low, high, int(count)).tolist()


def _check(name: str, key: str, value: object) -> None:
    """Refuse an invalid value for a key of a study; keys of the model file are checked with that file."""
    table = key.partition(".")[0]
    if table == "spread":
        holds, what = KEYS["noise"]
    elif table in STATES:
        holds, what = (_number, "a finite number")
    else:
        holds, what = KEYS.get(key, (lambda value: True, ""))
    if not holds(value):
        raise InputError(f"{name}: {key} must be {what}; got {value!r}")
