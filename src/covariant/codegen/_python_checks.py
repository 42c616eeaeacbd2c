"""Text of the checks at the end of the Python module around an exported observer: arrays and logs."""

CHECKS = '''def _real(value: object, name: str) -> np.ndarray:
    """An array of real numbers; what is masked becomes NaN."""
    try:
        array = np.asarray(np.ma.filled(value.astype(float), np.nan) if np.ma.isMaskedArray(value) else value)
    except ValueError as error:
        raise ValueError(f"{name} is no array: {error}") from error
    if array.dtype.kind == "M":
        raise ValueError(f"{name} has dates; give seconds, as (t - t[0]) / np.timedelta64(1, 's')")
    if array.dtype.kind not in "iuf":
        raise ValueError(f"{name} has the type {array.dtype}; it must be real numbers, which become {REAL}")
    return array


def _read(into: np.ndarray, value: object, name: str, shape: tuple) -> None:
    array = _real(value, name)
    if array.shape != shape:
        raise ValueError(f"{name} has the shape {array.shape}; one sample has {shape}")
    into[:] = array.ravel()


def _rows(value: object, name: str, shape: tuple) -> np.ndarray:
    array = _real(value, name)
    if array.ndim != len(shape) + 1 or array.shape[1:] != shape:
        needed = ", ".join(map(str, ("T", *shape))) + ("," if not shape else "")
        column = f"; {name}[:, None] is a column" if array.ndim == 1 and shape == (1,) else ""
        raise ValueError(f"{name} has the shape {array.shape}; {_NAME} needs ({needed}), time first{column}")
    return array


def _checked(t: object, y: object, u: object) -> tuple:
    """Stamps in double precision, measurements and inputs in that of the observer."""
    times, measured = _rows(t, "t", ()), _rows(y, "y", MEASUREMENT)
    inputs = None if u is None else _rows(u, "u", (INPUTS,))
    lengths = {"t": times, "y": measured, **({} if inputs is None else {"u": inputs})}
    if len({len(a) for a in lengths.values()}) > 1:
        raise ValueError(f"rows differ: {', '.join(f'{len(a)} of {name}' for name, a in lengths.items())}")
    if len(times) < 2:
        raise ValueError(f"a log needs at least two rows; this one has {len(times)}")
    for name, array in (("t", times), ("u", np.zeros((len(times), 0)) if inputs is None else inputs)):
        bad = ~np.isfinite(array.reshape(len(times), -1)).all(1)
        if bad.any():
            raise ValueError(f"row {bad.argmax() + 1}: {name} is not a finite number; only measurements may be missing")
    with np.errstate(over="ignore"):  # too large for the type of the observer: infinite
        measured = np.ascontiguousarray(measured, REAL)
    infinite = np.isinf(measured.reshape(len(times), -1)).any(1)
    if infinite.any():
        raise ValueError(f"row {infinite.argmax() + 1}: a measurement is infinite; mark a missing one by NaN")
    if np.isnan(measured[0].ravel()[:_FIRST]).any():
        raise ValueError("row 1 lacks a measurement, so no estimate can start there; cut the log to begin later")
    _check_stamps(times)
    return times.astype(float), measured, None if inputs is None else np.ascontiguousarray(inputs, REAL)


def _check_stamps(times: np.ndarray) -> None:
    latest = float(np.abs(times).max())
    if latest > _LATEST:
        raise ValueError(f"stamps reach {latest:g} s, after the year 2200; they must be in seconds")
    step = np.diff(times.astype(float))
    if (step < 0).any():
        k = int((step < 0).argmax())
        back = f"from {times[k]:g} s to {times[k + 1]:g} s"
        raise ValueError(f"row {k + 2}: time goes back {back}; sort or split the log")
    if (step == 0).any():
        k = int((step == 0).argmax())
        raise ValueError(f"rows {k + 1} and {k + 2} have the same stamp {times[k]:g} s; keep one of them")
    if times.dtype.kind == "f" and times.dtype.itemsize < 8:
        least, usual = float(np.spacing(np.abs(times).max())), float(np.median(step))
        if least > _COARSEST * usual:
            raise ValueError(
                f"stamps in {times.dtype} near {latest:g} s are whole multiples of {least:.2g} s, and rows are "
                f"{usual:.2g} s apart; give them in float64, or count them from the first before they are rounded"
            )
'''
