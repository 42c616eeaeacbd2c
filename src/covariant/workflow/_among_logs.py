"""What the rows of many logs say together: odd logs, findings that begin at a date, numbers that drift or differ."""

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

FEWEST = 8
"""Fewest logs among which one can be odd."""
FAR = 6.0
"""Robust standard deviations from the median beyond which a number is odd."""
LEAST_FACTOR = 1.5
"""Least factor between an odd number and the median, where all logs are nearly alike."""
CLEAR = 4.0
"""Standard errors beyond which an offset or a drift is more than chance, among many logs."""
JUDGED = ("nis", "nees", "innovation_rms", "velocity_rmse", "state_rmse", "rate")
"""Beginnings of the names of columns in which a log can be odd."""
LISTED = 5
"""Most logs that a sentence names."""


class LogRow(NamedTuple):
    """The row of a log, under the name of the log."""

    name: str
    row: dict[str, Any]


def among_logs(rows: Sequence[LogRow]) -> tuple[str, ...]:
    """Sentences on what is unlike the rest among the rows of many logs, in the order in which they are given."""
    rows = [each for each in rows if "failed" not in each.row]
    return (*_findings(rows), *_odd(rows), *_numbers(rows))


def _findings(rows: Sequence[LogRow]) -> Iterator[str]:
    """What `check` finds wrong, with the logs it is found in."""
    by_finding: dict[str, list[int]] = defaultdict(list)
    for k, (_, row) in enumerate(rows):
        for finding in filter(None, row.get("wrong", "").split("; ")):
            by_finding[finding].append(k)
    for finding, places in sorted(by_finding.items(), key=lambda pair: -len(pair[1])):
        yield f"WRONG {finding} in {len(places)} of {len(rows)} logs: {_since(rows, places) or _listed(rows, places)}"


def machine_of(name: str) -> str:
    """The folder of a log, which is one for each machine."""
    return str(Path(name).parent)


def _since(rows: Sequence[LogRow], places: Sequence[int]) -> str:
    """From which log on all logs of a machine are concerned; "" where it is otherwise."""
    machine = machine_of(rows[places[0]].name)
    own = [k for k, (name, _) in enumerate(rows) if machine_of(name) == machine]
    if len(places) < 3 or len(places) == len(own) or list(places) != own[-len(places) :]:
        return ""
    return f"all of {machine} from {Path(rows[places[0]].name).name} on, and none before"


def _listed(rows: Sequence[LogRow], places: Sequence[int]) -> str:
    more = len(places) - LISTED
    return ", ".join(rows[k].name for k in places[:LISTED]) + (f" and {more} more" if more > 0 else "")


def _odd(rows: Sequence[LogRow]) -> Iterator[str]:
    """Logs with a number far from that of the others."""
    names = dict.fromkeys(name for _, row in rows for name in row if name.startswith(JUDGED))
    for name in names:
        values = np.array([row.get(name, math.nan) for _, row in rows], float)
        known = np.isfinite(values) & (values > 0)
        if known.sum() < FEWEST:
            continue
        # Ratios count: such numbers are positive, and a factor is as odd upwards as downwards.
        sizes = np.log(np.where(known, values, 1.0))
        median = np.median(sizes[known])
        spread = 1.4826 * np.median(np.abs(sizes[known] - median))
        odd = known & (np.abs(sizes - median) > max(FAR * spread, math.log(LEAST_FACTOR)))
        for k in np.flatnonzero(odd)[:LISTED]:
            yield f"ODD {rows[k].name}: {name} is {values[k]:.3g}, and {math.exp(median):.3g} in the median of the logs"
        if odd.sum() > LISTED:
            yield f"ODD {odd.sum() - LISTED} more logs: {name}"


def _numbers(rows: Sequence[LogRow]) -> Iterator[str]:
    """Numbers fitted to each log: the shared one, offsets of machines, and drifts from log to log."""
    names = dict.fromkeys(
        name for _, row in rows for name in row if f"{name}_std" in row and isinstance(row[name], float)
    )
    machines = [machine_of(name) for name, _ in rows]
    several = len(set(machines)) > 1
    for name in names:
        value, std = (np.array([row.get(key, math.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        known = np.isfinite(value) & np.isfinite(std) & (std > 0)
        if known.sum() < 3:
            continue
        groups = {
            machine: np.flatnonzero(known & (np.array(machines) == machine)) for machine in dict.fromkeys(machines)
        }
        means = {machine: _mean(value[rows_], std[rows_]) for machine, rows_ in groups.items() if len(rows_)}
        shared, error, between = (
            _mean(*(np.array(column) for column in zip(*((m, e) for m, e, _ in means.values()), strict=True)))
            if several
            else _mean(value[known], std[known])
        )
        of = f"{len(means)} machines" if several else f"{known.sum()} logs"
        yield f"{name} = {shared:.4g} ± {error:.2g} shared by {of}, which differ by {between:.2g} beyond their errors"
        for machine, (mean, mean_error, _) in means.items() if several else ():
            if abs(mean - shared) > CLEAR * math.hypot(mean_error, between):
                yield f"  {machine}: {mean - shared:+.3g} ± {mean_error:.2g}"
        for machine, places in groups.items():
            drift = _drift(value[places], std[places])
            if drift is not None:
                first, last = rows[places[0]].name, rows[places[-1]].name
                yield f"  {name} drifts{f' on {machine}' * several}: {drift:+.3g} from {first} to {last}"


def _mean(value: np.ndarray, std: np.ndarray) -> tuple[float, float, float]:
    """Mean of values with different errors, its standard error, and the standard deviation between the true values.

    Source: DerSimonian & Laird 1986, Meta-analysis in clinical trials.
    """
    weights = 1 / std**2
    fixed = np.sum(weights * value) / np.sum(weights)
    surplus = np.sum(weights * (value - fixed) ** 2) - (len(value) - 1)
    scale = np.sum(weights) - np.sum(weights**2) / np.sum(weights)
    between = max(0.0, surplus / scale) if scale > 0 else 0.0
    weights = 1 / (std**2 + between)
    mean = np.sum(weights * value) / np.sum(weights)
    return float(mean), float(1 / math.sqrt(np.sum(weights))), math.sqrt(between)


def _drift(value: np.ndarray, std: np.ndarray) -> float | None:
    """Change of a number from the first log to the last, along a line; None where it is no more than chance."""
    if len(value) < FEWEST:
        return None
    k = np.linspace(0.0, 1.0, len(value))
    design = np.stack([np.ones_like(k), k], axis=1) / std[:, None]
    (_, slope), *_ = np.linalg.lstsq(design, value / std)
    residual = value / std - design @ np.linalg.lstsq(design, value / std)[0]
    # Scatter beyond the errors of the logs widens that of the slope.
    scatter = max(1.0, float(np.sum(residual**2) / (len(value) - 2)))
    error = math.sqrt(scatter * np.linalg.inv(design.T @ design)[1, 1])
    return float(slope) if abs(slope) > CLEAR * error else None
