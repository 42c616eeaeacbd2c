"""Converts measured configurations between columns and arrays, with attitudes and poses as matrices.

If a configuration has several kinds of parts, each row (m,) of `y` is the block-diagonal matrix of a body and its
wheels, flattened row by row, followed by the matrices of ball joints and by the coordinates.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from covariant.logs._columns import ATTITUDES, Columns, LogError
from covariant.logs._rotations import KINDS


class Body(NamedTuple):
    """The columns of one body.

    Its matrices are rotations (d, d), or poses (d + 1, d + 1) with the position in the last column; d is `space`.

    Attributes:
        kind: Representation of its rotation, a key of `ATTITUDES`, or "angle".
        rotation: Names of the columns of its rotation.
        position: Names of the columns of its position [m]; none for a rotation.

    Example:
        >>> from covariant import logs
        >>> columns = logs.Columns(position=("x", "y"), angle=("heading",))
        >>> body, = logs.bodies(columns)
        >>> body.kind, body.space, body.order
        ('angle', 2, 3)
    """

    kind: str
    rotation: tuple[str, ...]
    position: tuple[str, ...] = ()

    @property
    def space(self) -> int:
        """Dimension d of the space in which the body moves, 2 or 3."""
        return 2 if self.kind == "angle" else 3

    @property
    def order(self) -> int:
        """Number of rows of its matrices: d, or d + 1 with a position."""
        return self.space + bool(self.position)


def bodies(columns: Columns) -> tuple[Body, ...]:
    """Bodies of a configuration: one with an attitude or a position, a wheel for each angle, and ball joints.

    Args:
        columns: Names of the columns of a log.

    Returns:
        First the body with an attitude or a position, then a wheel for each angle, then a ball joint for each further
        attitude; empty if the configuration has coordinates only.

    Raises:
        LogError: The columns do not form a configuration.

    Example:
        >>> from covariant import logs
        >>> [body.rotation for body in logs.bodies(logs.Columns(angle=("left", "right")))]
        [('left',), ('right',)]
    """
    together, balls = _bodies(columns)
    return together + balls


def _bodies(columns: Columns) -> tuple[tuple[Body, ...], tuple[Body, ...]]:
    """Bodies that share one block-diagonal matrix, and ball joints, each with a separate matrix."""
    attitudes = [kind for kind in ATTITUDES if getattr(columns, kind)]
    if len(attitudes) > 1:
        raise LogError(f"{' and '.join(attitudes)} both give the attitude; keep one")
    kind = attitudes[0] if attitudes else "angle"
    names = getattr(columns, kind) if attitudes else columns.angle[:1]
    needed = ATTITUDES.get(kind, 1)
    each = [names[i : i + needed] for i in range(0, len(names), needed)] or [()]
    first = (Body(kind, each[0], columns.position),) if attitudes or columns.position else ()
    balls = tuple(Body(kind, rotation) for rotation in each[1:])
    if any(len(body.rotation) != needed or len(body.position) not in (0, body.space) for body in first + balls):
        raise LogError(
            f"position ({', '.join(columns.position) or 'none'}) and {kind} ({', '.join(names) or 'none'}) make no "
            "pose; three names go with a quaternion of 4 or a matrix of 9 columns, two with an angle"
        )
    for body in (*first, *balls) if kind.startswith("quaternion") else ():
        letters, order = "".join(name.rstrip("]")[-1:].lower() for name in body.rotation), kind[-needed:]
        if letters != order and sorted(letters) == sorted(order):
            raise LogError(
                f"{kind} has {', '.join(map(repr, body.rotation))}, whose letters are in the order {letters}; name "
                f"them in the order {order}"
            )
    # Without an attitude the first angle is the heading of a body in the plane.
    wheels = columns.angle[1:] if first and not attitudes else columns.angle
    return (*first, *(Body("angle", (name,)) for name in wheels)), balls


def from_cells(name: str, columns: Columns, cells: Float[np.ndarray, "T k"]) -> np.ndarray:
    """Configurations from the cells of their columns."""
    together, balls = _bodies(columns)
    if not together:
        return cells
    named = dict(zip(columns.measured, cells.T, strict=True))
    groups = [together, *((ball,) for ball in balls)]
    parts = [_matrices_from_columns(name, group, named) for group in groups]
    if len(parts) == 1 and not columns.q:
        return parts[0]
    return np.concatenate([*(part.reshape(len(cells), -1) for part in parts), cells[:, : len(columns.q)]], axis=1)


def _matrices_from_columns(
    name: str, parts: tuple[Body, ...], named: dict[str, np.ndarray]
) -> Float[np.ndarray, "T N N"]:
    """The block-diagonal matrices of these bodies."""
    order = sum(body.order for body in parts)
    cells = np.stack([named[name] for body in parts for name in (*body.rotation, *body.position)], axis=1)
    y = np.full((len(cells), order, order), np.nan)
    # One empty cell makes the whole pose missing.
    present = np.isfinite(cells).all(axis=1)
    named = {name: column[present] for name, column in named.items()}
    y[present] = 0.0
    for body, corner in zip(parts, _corners(parts), strict=True):
        rotation = np.stack([named[name] for name in body.rotation], axis=1)
        _check(name, body, rotation, np.flatnonzero(present) + 1)
        turn, end = slice(corner, corner + body.space), corner + body.space
        y[present, turn, turn] = KINDS[body.kind].matrices(rotation)  # the check before leaves only rounding to remove
        if body.position:
            y[present, turn, end] = np.stack([named[name] for name in body.position], axis=1)
            y[present, end, end] = 1.0
    return y


def to_columns(columns: Columns, y: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of configurations, by name.

    Args:
        columns: Names and kinds of the columns.
        y: Configurations (T, n), (T, N, N) or (T, m); NaN stays NaN.

    Returns:
        Arrays (T,) in the order of `columns.measured`. Quaternions have no jumps of sign, and angles no jumps of a
        whole turn.

    Example:
        >>> import numpy as np
        >>> from covariant import logs
        >>> columns = logs.Columns(quaternion_wxyz=("w", "x", "y", "z"))
        >>> {name: cells.tolist() for name, cells in logs.to_columns(columns, np.eye(3)[None]).items()}
        {'w': [1.0], 'x': [0.0], 'y': [0.0], 'z': [0.0]}
    """
    parts = bodies(columns)
    if not parts:
        return dict(zip(columns.q, np.asarray(y).T, strict=True))
    named = dict(zip(columns.q, coordinates(columns, y).T, strict=True))
    for body, g in zip(parts, matrices(columns, y), strict=True):
        present = np.isfinite(g).all(axis=(1, 2))
        cells = np.full((len(g), len(body.rotation)), np.nan)
        cells[present] = KINDS[body.kind].cells(g[present, : body.space, : body.space])
        named |= dict(zip(body.rotation, cells.T, strict=True))
        # If a body has no position, there are no names and zip stops at once.
        named |= dict(zip(body.position, g[:, : body.space, -1].T, strict=False))
    return {name: named[name] for name in columns.measured}


def matrices(columns: Columns, y: np.ndarray) -> list[np.ndarray]:
    """Matrices of each of the `bodies` in configurations.

    Args:
        columns: Names of the columns.
        y: Configurations (T, N, N) or (T, m).

    Returns:
        For each body an array (T, order, order).

    Example:
        >>> import numpy as np
        >>> from covariant import logs
        >>> columns = logs.Columns(angle=("left", "right"))
        >>> [wheel.shape for wheel in logs.matrices(columns, np.eye(4)[None])]
        [(1, 2, 2), (1, 2, 2)]
    """
    parts, balls = _bodies(columns)
    order, y = sum(body.order for body in parts), np.asarray(y)
    flat = y.reshape(len(y), -1)
    together = flat[:, : order**2].reshape(-1, order, order)
    spans = [slice(corner, corner + body.order) for body, corner in zip(parts, _corners(parts), strict=True)]
    after = [flat[:, order**2 + 9 * i : order**2 + 9 * (i + 1)].reshape(-1, 3, 3) for i in range(len(balls))]
    return [together[:, span, span] for span in spans] + after


def coordinates(columns: Columns, y: np.ndarray) -> Float[np.ndarray, "T n"]:
    """Coordinates in configurations: all entries if there are no bodies, otherwise the last ones.

    Args:
        columns: Names of the columns.
        y: Configurations (T, n), (T, N, N) or (T, m).

    Returns:
        Coordinates (T, n); (T, 0) if `columns.q` is empty.

    Example:
        >>> import numpy as np
        >>> from covariant import logs
        >>> logs.coordinates(logs.Columns(q=("a", "b")), np.array([[1.0, 2.0]])).tolist()
        [[1.0, 2.0]]
    """
    y = np.asarray(y)
    return y[:, y.shape[1] - len(columns.q) :] if columns.q else np.zeros((len(y), 0))


def _corners(parts: tuple[Body, ...]) -> list[int]:
    return [sum(body.order for body in parts[:i]) for i in range(len(parts))]


def _check(name: str, body: Body, cells: np.ndarray, rows: np.ndarray) -> None:
    bad, describe = KINDS[body.kind].fault(cells)
    if bad.any():
        k = int(bad.argmax())
        where = f"{name}: columns {', '.join(map(repr, body.rotation))}, row {rows[k]}"
        raise LogError(f"{where}: {describe(k)}, or leave the row empty if its measurement is missing")
