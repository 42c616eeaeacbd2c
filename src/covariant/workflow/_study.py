"""A study of many runs: what its file says, checked."""

import itertools
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from covariant._names import unknown
from covariant.metrics import Grid

KEYS = ("model", "observers", "duration", "rate", "noise", "amplitude", "frequency", "below", "seed", "start", "set")
"""Keys of a study beside its axes."""


class Axis(NamedTuple):
    """What varies: its key, its values, and whether observers are designed for each."""

    key: str
    values: Sequence[Any]
    designs: bool

    @property
    def name(self) -> str:
        """Its name in the store."""
        return self.key.replace(".", "_")

    @property
    def ends(self) -> tuple[float, float]:
        """Ends of the axis in the store; values that are not equally spaced are numbered from 0."""
        return (float(self.values[0]), float(self.values[-1])) if self._spaced else (0.0, len(self.values) - 1.0)

    @property
    def _spaced(self) -> bool:
        if self.designs or not all(isinstance(value, int | float) for value in self.values):
            return False
        return bool(np.allclose(np.diff(self.values), self.values[1] - self.values[0])) and (
            self.values[0] < self.values[1]
        )

    def at(self, x: Any) -> Any:
        """Value at a coordinate of the store."""
        return x if self._spaced else jnp.asarray(self.values, float)[jnp.round(x).astype(int)]


class Study(NamedTuple):
    """A study as its file says it.

    Attributes:
        text: All of it as JSON.
        model: The model, as for `estimate`.
        observers: Names of the observers.
        axes: What varies.
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
        """Values of the axes for which observers are designed, in all combinations."""
        axes = [axis for axis in self.axes if axis.designs]
        return [
            dict(zip((axis.key for axis in axes), each, strict=True))
            for each in itertools.product(*(a.values for a in axes))
        ]

    @property
    def grid(self) -> Grid:
        """All cases."""
        low, high = zip(*(axis.ends for axis in self.axes), strict=True)
        names = [axis.name for axis in self.axes]
        return Grid(names, ["1"] * len(names), low, high, [len(axis.values) for axis in self.axes])


def read_study(path: Path) -> Study:
    """Read the file of a study."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ValueError(f"{path}: not a TOML file: {error}") from error
    return parse_study(content, str(path), path.parent)


def parse_study(content: Mapping[str, Any], name: str = "study", folder: Path = Path()) -> Study:
    """Check the content of a study."""
    content = dict(content)
    for key in content:
        if key not in (*KEYS, "axes"):
            raise ValueError(f"{name}: {unknown('key', key, (*KEYS, 'axes'))}")
    for key in ("model", "observers", "duration", "axes"):
        if not content.get(key):
            raise ValueError(f"{name}: {key} is missing")
    if (folder / str(content["model"])).exists():
        content["model"] = str((folder / content["model"]).absolute())
    axes = []
    for key, values in content["axes"].items():
        if isinstance(values, Mapping):
            try:
                low, high, count = (float(values[end]) for end in ("low", "high", "count"))
            except (KeyError, TypeError, ValueError) as error:
                raise ValueError(f"{name}: axes.{key} needs a list, or {{low, high, count}}") from error
            values = np.linspace(low, high, int(count)).tolist()
        elif key == "draw":
            values = list(range(int(values)))
        if not isinstance(values, list) or len(values) < 2:
            raise ValueError(f"{name}: axes.{key} needs two values or more; put a single one into [set] or [start]")
        axes.append(Axis(key, values, not (key.startswith("start.") or key in ("noise", "draw"))))
    if "rate" not in content and "rate" not in content["axes"]:
        raise ValueError(f"{name}: rate is missing: samples a second [Hz], or an axis of them")
    text = json.dumps(content)  # axes keep their order
    return Study(text, content["model"], tuple(content["observers"]), tuple(axes))
