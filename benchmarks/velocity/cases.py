"""Logs of the benchmark: recorded ones from a manifest, and simulated twins, each with velocities to judge by."""

import hashlib
import os
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from benchmarks import twins
from covariant import Record
from covariant.verbs.base.inputs import Job, Loaded, ReferenceVelocity, load

HERE = Path(__file__).parent
MANIFEST = HERE / "logs.toml"
TUNED, JUDGED = 0.4, 0.45
"""Fractions of a twin up to which its rows tune, and from which they are judged."""
SETTLING = 0.1
"""Fraction of the tuning rows, at their start, that does not count: estimates start from rest."""
LATEST = 0.02
"""Largest delay [s] of a second reading of the velocity that is searched."""


class Second(NamedTuple):
    """A second, independent reading of the velocities.

    Attributes:
        v: Its readings (T, n), moved back by its delay.
        delay: The delay [s] with which it agrees best with the reference on rows that tune.
    """

    v: Float[np.ndarray, "T n"]
    delay: float


class Case(NamedTuple):
    """A log with its model, and with velocities that no estimator sees on the rows that are judged.

    Attributes:
        name: Name in tables and of the file with its results.
        loaded: Model and log as every command of the library reads them, with the input that acts in each step.
        v: Velocities (T, n) to judge by, NaN where they are not known.
        against: What these are.
        tune: Rows (T,) on which the numbers of estimators are searched.
        judge: Rows (T,) on which errors are counted.
        recorded: Whether a machine was recorded, not simulated.
        second: Another reading of the velocities, if there is one.
        key: Checksum of the log.
    """

    name: str
    loaded: Loaded
    v: Float[np.ndarray, "T n"]
    against: str
    tune: Bool[np.ndarray, "T"]
    judge: Bool[np.ndarray, "T"]
    recorded: bool
    second: Second | None
    key: str

    @property
    def model(self) -> Any:
        """The model."""
        return self.loaded.model

    @property
    def t(self) -> Float[np.ndarray, "T"]:
        """Stamps (T,) [s]."""
        return np.asarray(self.loaded.record.t)

    @property
    def acceleration(self) -> float:
        """Root mean square of the acceleration on the rows that tune, from which ranges of searches are computed."""
        v = self.v[self.tune & np.isfinite(self.v).all(axis=1)]
        return float(np.sqrt(np.mean((np.diff(v, axis=0) * self.loaded.rate) ** 2)))


def entries() -> dict[str, dict[str, Any]]:
    """What the manifest says of every log, by name."""
    tables = tomllib.loads(MANIFEST.read_text(encoding="utf-8"))
    return {entry["name"]: entry for entry in tables["log"] + tables["twin"]}


def data_folder() -> Path | None:
    """The folder with recorded logs: that of `COVARIANT_DATA`, or the one into which `--fetch` writes."""
    places = [Path(os.environ.get("COVARIANT_DATA", "")), Path("build/velocity/data")]
    return next((place for place in places if place.parts and place.is_dir()), None)


def located(entry: dict[str, Any]) -> Path | None:
    """The file of a recorded log, once its checksum is right; None where it is not there."""
    folder = data_folder()
    path = None if folder is None else folder / entry["file"]
    if path is None or not path.is_file():
        return None
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != entry["sha256"]:
        raise SystemExit(
            f"{path}: its SHA-256 is {found}, but the manifest has {entry['sha256']}; fetch it anew, or remove it"
        )
    return path


def case(entry: dict[str, Any]) -> Case | None:
    """Read a log or simulate a twin; None for a recorded log that is not there."""
    if "twin" in entry:
        return _simulated(entry)
    path = located(entry)
    if path is None:
        return None
    loaded = load(Job(entry["model"], path, entry.get("set", {}), entry.get("every", 1), anyway=True))
    reference = loaded.reference
    assert reference is not None
    t = np.asarray(loaded.record.t)
    tune, judge = (_rows(t, entry[part]) & reference.scored for part in ("tune", "judge"))
    v, label = reference.v, reference.label
    second = None
    if "second" in entry:
        table = pd.read_csv(path)
        second = _second(t, v, table["t"].to_numpy(), table[entry["second"]].to_numpy(), tune)
    return Case(entry["name"], loaded, v, label, tune, judge, True, second, entry["sha256"])


def _simulated(entry: dict[str, Any]) -> Case:
    twin = twins.TWINS[entry["twin"]]()
    rows = np.asarray(twin.record.t) <= entry.get("until", np.inf)
    record, v = Record(*(np.asarray(part)[rows] for part in twin.record[:3])), twin.v[rows]
    loaded = load(Job(twin.file, record, anyway=True))
    t, span = record.t, record.t[-1] - record.t[0]
    tune, judge = _rows(t, [SETTLING * TUNED * span, TUNED * span]), _rows(t, [JUDGED * span, span])
    loaded = loaded._replace(reference=ReferenceVelocity(v, "true velocities", judge))
    key = hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in (*record[:3], v))).hexdigest()
    return Case(entry["name"], loaded, v, "true velocities", tune, judge, False, None, key)


def _rows(t: np.ndarray, span: list[float]) -> np.ndarray:
    """Rows within a span [s], counted from the first row."""
    return (t - t[0] >= span[0]) & (t - t[0] <= span[1])


def _second(t: np.ndarray, v: np.ndarray, at: np.ndarray, readings: np.ndarray, tune: np.ndarray) -> Second:
    """A second reading, moved back by the delay with which it agrees best with the reference on rows that tune."""

    def moved(delay: float) -> np.ndarray:
        return np.stack([np.interp(t + delay, at, column) for column in readings.T], axis=1)

    delays = np.linspace(-LATEST, LATEST, 161)
    best = min(delays, key=lambda delay: float(np.nanmean((moved(delay) - v)[tune] ** 2)))
    return Second(moved(best), float(best))
