"""`init`: a first model file for a log, with the columns that its header names."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from covariant import logs, models
from covariant._files import write_atomically
from covariant.identification import Draft, draft
from covariant.workflow._inputs import ColumnNames, column_names
from covariant.workflow._outputs import check_output
from covariant.workflow._progress import Progress, silent
from covariant.workflow._result import AbstractResult


def init(log: Any, *, columns: ColumnNames | None = None, progress: Progress = silent) -> "InitResult":
    """Draft a model file of a chain of pendulums from the header and the content of a log.

    Args:
        log: A path, a DataFrame, or an xarray Dataset.
        columns: Names of columns by field (t, q, u, v) that are known; the others are guessed.
        progress: Called with a description as the work goes on.

    Returns:
        The draft, with what was guessed in its comments; `save` writes it.

    Raises:
        ValueError: For a log in which no stamps or positions are found.

    Example:
        >>> import numpy as np, pandas, covariant
        >>> t = np.arange(0.0, 5.0, 0.01)
        >>> covariant.workflow.init(pandas.DataFrame({"t": t, "angle": 0.3 * np.cos(t)}))
        <InitResult: stamps t, positions angle, no inputs>
    """
    progress("reading the log")
    given = {key: list(column_names(names)) for key, names in (columns or {}).items() if names is not None}
    try:
        found = draft(logs.survey(log), given)
    except logs.LogError:
        raise
    except ValueError as error:
        raise ValueError(f"{logs.source_name(log)}: {error}") from error
    return InitResult(logs.source_name(log), found)


@dataclass(frozen=True, repr=False)
class InitResult(AbstractResult):
    """A first model file for a log.

    Attributes:
        log: Name of the log.
        draft: What was guessed of its columns.
    """

    log: str
    draft: Draft

    @property
    def text(self) -> str:
        """The text of the model file."""
        return template(Path(self.log).name, self.draft)

    @property
    def summary(self) -> dict[str, Any]:
        found = self.draft
        return {
            "log": self.log,
            "columns": {"t": found.t, "q": list(found.q), "u": list(found.u), "v": list(found.v)},
            "units": {field: list(texts) for field, texts in found.units.items()},
            "left_out": list(found.left_out),
        }

    @property
    def headline(self) -> str:
        found = self.draft
        line = f"stamps {found.t}, positions {', '.join(found.q)}"
        line += f", inputs {', '.join(found.u)}" if found.u else ", no inputs"
        return line + (f", velocities {', '.join(found.v)} to compare with" if found.v else "")

    def __str__(self) -> str:
        lines = [self.headline]
        if self.draft.units:
            units = (f"{field}: " + ", ".join(dict.fromkeys(texts)) for field, texts in self.draft.units.items())
            lines.append(f"units {', '.join(units)}")
        if self.draft.left_out:
            lines.append(f"left out: {', '.join(self.draft.left_out)}")
        return "\n".join([*lines, "put first values of your machine into [parameters] of the model file"])

    def save(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write the model file (.toml); a file that exists is not replaced, unless `overwrite` asks for it."""
        path = Path(path)
        check_output(path, ".toml", log=self.log)
        if path.exists() and not overwrite:
            raise ValueError(f"{path}: there is such a file already, and it is not overwritten; give another name")
        text = self.text
        write_atomically(path, lambda file: file.write(text.encode()))
        models.load(str(path))
        return path


def template(name: str, found: Draft) -> str:
    """The text of the model file."""
    n = len(found.q)
    spans = ", ".join(f"{q} {low:.3g} to {high:.3g}" for q, (low, high) in zip(found.q, found.span, strict=True))
    lines = [
        f"# Drafted from the log {name}: {found.rows} rows at {found.rate:.4g} Hz. The columns are guessed from their",
        "# names and their content; the numbers in [parameters] are places to put yours, not measurements.",
        "# Units: s, m, kg, rad, N m; those of the log are in [units] where they are others.",
        "",
        'system = "pendulum_chain"  # other machines: docs/models.md',
        "",
        "[parameters]",
        'angles = "relative"  # or "absolute": each link from the vertical',
        'zero = "hanging"  # or "upright": where the angles are 0',
        "gravity = 9.81",
        f"mass = {_list(1.0, n)}",
        f"length = {_list(0.3, n)}  # m, from joint to joint; that of the last link does not matter",
        f"com = {_list(0.15, n)}  # m, from joint to centre of mass",
        f"inertia = {_list(0.01, n)}  # kg m^2, about the centre of mass",
        f"viscous = {_list(0.01, n)}  # N m s/rad, friction in each joint",
        f"coulomb = {_list(0.01, n)}  # N m, times atan(100 v): dry friction, divided by pi/2",
    ]
    if len(found.u) < n:
        lines.append(
            f"actuated = {list(range(len(found.u)))}"
            + ("  # joints that the inputs drive, from 0: the first ones are guessed" if found.u else "")
        )
    lines += [
        "",
        "[columns]",
        f"t = {_quoted(found.t)}",
        f"q = {_names(found.q)}  # in this log {spans}",
        f"u = {_names(found.u)}" + ("" if found.u else "  # no input was found"),
        *([f"v = {_names(found.v)}  # only compared with, never used"] if found.v else []),
        *([f"# left out: {', '.join(found.left_out)}"] if found.left_out else []),
        *_units(found),
        "",
        "[measurement]",
        _sensor(found),
        "",
        "# Gains of observers are designed from how much acceleration the model leaves unexplained, which a log does",
        "# not tell before the model fits: set it after `covariant fit`, then take the marks of comments away.",
        "# [uncertainty]",
        "# acceleration = 2.0  # rad/s^2",
        "# correlation_time = 0.01  # s, over which it persists",
        "",
    ]
    return "\n".join(lines)


def _sensor(found: Draft) -> str:
    if found.quantum is not None:
        return f"quantum = {found.quantum:.6g}  # rad, the tick that positions of this log are multiples of"
    return f"std = {max(found.noise, 1e-12):.3g}  # rad, at most: from third differences of the positions"


def _units(found: Draft) -> list[str]:
    """The table of the units of the log, where these are not those of the file."""
    if not found.units:
        return []
    lines = ["", "[units]"]
    for field, texts in found.units.items():
        written = _quoted(texts[0]) if len(set(texts)) == 1 else _names(texts)
        why = (
            "guessed from the numbers: `covariant check` looks closer"
            if field in found.guessed
            else "as its header says"
        )
        lines.append(f"{field} = {written}  # {why}")
    return lines


def _list(value: float, n: int) -> str:
    return str([value] * n)


def _quoted(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _names(names: Sequence[str]) -> str:
    return "[" + ", ".join(map(_quoted, names)) + "]"
