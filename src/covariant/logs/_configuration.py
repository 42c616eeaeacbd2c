"""Measured configurations as columns and as arrays: coordinates as they are, attitudes and poses as matrices."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._columns import ATTITUDES, Columns, LogError
from covariant.logs._rotations import KINDS


class Body(NamedTuple):
    """The columns of one body: the way its rotation is written, their names, and those of its position, if it has one.

    Its matrices are rotations (d, d), or poses (d + 1, d + 1) with the position in the last column; d is `space`.
    """

    kind: str
    rotation: tuple[str, ...]
    position: tuple[str, ...] = ()

    @property
    def space(self) -> int:
        """Dimension d of the space it turns in."""
        return 2 if self.kind == "angle" else 3

    @property
    def order(self) -> int:
        """Number of rows of its matrices."""
        return self.space + bool(self.position)


def bodies(columns: Columns) -> tuple[Body, ...]:
    """The bodies of a configuration on a group: one with an attitude or a position first, then a wheel for each angle.

    None where the configuration is coordinates. Raises `LogError` when the columns do not make a configuration.
    """
    attitudes = [kind for kind in ATTITUDES if getattr(columns, kind)]
    if len(attitudes) > 1:
        raise LogError(f"{' and '.join(attitudes)} both give the attitude; keep one")
    kind = attitudes[0] if attitudes else "angle"
    names = getattr(columns, kind) if attitudes else columns.angle[:1]
    needed = ATTITUDES.get(kind, 1)
    first = (Body(kind, names, columns.position),) if attitudes or columns.position else ()
    if any(len(body.rotation) != needed or len(body.position) not in (0, body.space) for body in first):
        raise LogError(
            f"position ({', '.join(columns.position) or 'none'}) and {kind} ({', '.join(names) or 'none'}) make no "
            "pose; three names go with a quaternion of 4 or a matrix of 9 columns, two with an angle"
        )
    wheels = columns.angle[1:] if first and not attitudes else columns.angle
    found = (*first, *(Body("angle", (name,)) for name in wheels))
    if found and columns.q:
        raise LogError(f"q names {', '.join(columns.q)}, but the configuration is on a group; keep one of the two")
    return found


def from_cells(path: Path, columns: Columns, cells: Float[np.ndarray, "T k"]) -> np.ndarray:
    """Configurations (T, n) or (T, N, N) from the cells of `columns.measured`, a group's all NaN where any cell is."""
    parts = bodies(columns)
    if not parts:
        return cells
    order = sum(body.order for body in parts)
    y = np.full((len(cells), order, order), np.nan)
    present = np.isfinite(cells).all(axis=1)
    named = dict(zip(columns.measured, cells[present].T, strict=True))
    y[present] = 0.0
    for body, corner in zip(parts, _corners(parts), strict=True):
        rotation = np.stack([named[name] for name in body.rotation], axis=1)
        _check(path, body, rotation, np.flatnonzero(present) + 1)
        turn, end = slice(corner, corner + body.space), corner + body.space
        y[present, turn, turn] = KINDS[body.kind].matrices(rotation)
        if body.position:
            y[present, turn, end] = np.stack([named[name] for name in body.position], axis=1)
            y[present, end, end] = 1.0
    return y


def to_columns(columns: Columns, y: np.ndarray) -> dict[str, np.ndarray]:
    """Configurations (T, n) or (T, N, N) as columns by name, laid out as `columns` says; NaN stays.

    Quaternions and angles are written without jumps: not of sign, and not of a whole turn.
    """
    parts = bodies(columns)
    if not parts:
        return dict(zip(columns.q, np.asarray(y).T, strict=True))
    found = {}
    for body, g in zip(parts, matrices(columns, y), strict=True):
        present = np.isfinite(g).all(axis=(1, 2))
        cells = np.full((len(g), len(body.rotation)), np.nan)
        cells[present] = KINDS[body.kind].cells(g[present, : body.space, : body.space])
        found |= dict(zip(body.rotation, cells.T, strict=True))
        found |= dict(zip(body.position, g[:, : body.space, -1].T, strict=False))
    return {name: found[name] for name in columns.measured}


def matrices(columns: Columns, y: Float[np.ndarray, "T N N"]) -> list[np.ndarray]:
    """The matrices (T, order, order) of each of the `bodies` in configurations on a group."""
    parts = bodies(columns)
    spans = [slice(corner, corner + body.order) for body, corner in zip(parts, _corners(parts), strict=True)]
    return [np.asarray(y)[:, span, span] for span in spans]


def _corners(parts: tuple[Body, ...]) -> list[int]:
    return [sum(body.order for body in parts[:i]) for i in range(len(parts))]


def _check(path: Path, body: Body, cells: np.ndarray, rows: np.ndarray) -> None:
    bad, words = KINDS[body.kind].fault(cells)
    if bad.any():
        k = int(bad.argmax())
        where = f"{path}: columns {', '.join(map(repr, body.rotation))}, row {rows[k]}"
        raise LogError(f"{where}: {words(k)}, or leave the row empty if its measurement is missing")
