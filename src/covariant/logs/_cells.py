"""Converts cells of a log to numbers; they are read as text first, so that errors can quote a cell, column and row."""

from typing import Any

import numpy as np
from jaxtyping import Float

from covariant._numbers import NUMBER
from covariant.logs._columns import LogError, pyarrow


def numbers(where: str, column: Any, needed: bool) -> Float[np.ndarray, "T"]:
    """Convert a column to floating-point numbers.

    Args:
        where: Log and column, the beginning of error messages.
        column: A chunked array of Arrow.
        needed: Whether an empty cell is an error.

    Returns:
        Numbers (T,), NaN where a cell is empty.

    Raises:
        LogError: A cell is not a finite number; the message names the first such row.
    """
    pa = pyarrow()
    try:
        # `safe=False` rounds an integer beyond 2⁵³; otherwise Arrow would refuse it.
        values = floats(column.cast(pa.float64(), safe=False))
    except pa.ArrowInvalid:
        values = _texts(where, column, needed)
    except pa.ArrowNotImplementedError as error:
        raise LogError(f"{where} holds {column.type}; convert it to plain numbers") from error
    # NaN marks a missing measurement, but an infinite number is an error in any column.
    bad = ~np.isfinite(values) if needed else np.isinf(values)
    if bad.any():
        raise fault(where, int(bad.argmax()), column[int(bad.argmax())].as_py(), needed)
    return values


def _texts(where: str, column: Any, needed: bool) -> np.ndarray:
    """Slower conversion, for a column whose cells may have a plus sign or spaces, or are not numbers."""
    pa = pyarrow()
    compute = pa.compute
    cells = compute.utf8_trim_whitespace(compute.fill_null(column.cast(pa.string()), ""))
    written = compute.match_substring_regex(cells, rf"^({NUMBER}|(?i:true|false))?\z").to_numpy()
    if not written.all():
        row = int((~written).argmax())
        raise fault(where, row, column[row].as_py(), needed)
    # Arrow's number parser does not accept a plus sign.
    plain = compute.replace_substring_regex(cells, r"^\+", "")
    for word, digit in (("true", "1"), ("false", "0")):
        plain = compute.replace_substring_regex(plain, f"^(?i:{word})$", digit)
    filled = compute.if_else(compute.equal(plain, ""), "nan", plain)
    return floats(filled.cast(pa.float64()))


def floats(column: Any) -> np.ndarray:
    """Convert a float64 column of Arrow to a writable array, with NaN for cells that are null.

    It does not use `to_numpy`, for which pyarrow would import pandas; that takes longer than reading a log.
    """
    pa, cells = pyarrow(), column.combine_chunks()
    if not cells.null_count:
        return np.array(np.from_dlpack(cells))  # a copy: the memory of Arrow is read-only
    values = pa.Array.from_buffers(cells.type, len(cells), [None, cells.buffers()[1]], offset=cells.offset)
    return np.where(np.from_dlpack(cells.is_valid().cast(pa.int8())), np.from_dlpack(values), np.nan)


def fault(where: str, row: int, cell: str | float | None, needed: bool) -> LogError:
    """Error for a cell that is not a finite number."""
    content = "an empty cell" if cell is None or not str(cell).strip() else repr(cell)
    remedy = "only positions may be missing; fill it or cut the row" if needed else "leave it empty if it is missing"
    return LogError(f"{where}, row {row + 1}: found {content}, needs a finite number; {remedy}")
