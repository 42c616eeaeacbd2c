"""What the rows of many logs say together: odd logs, findings that begin at a date, numbers that drift or differ."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
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
    failed = [k for k, (_, row) in enumerate(rows) if "failed" in row]
    known = [k for k, (_, row) in enumerate(rows) if "failed" not in row]
    sound = [k for k in known if not rows[k].row.get("wrong")]
    return (
        *_failures(rows, failed),
        *_findings(rows, known),
        *_odd(rows, sound),
        *_numbers([rows[k] for k in known]),
    )


def _failures(rows: Sequence[LogRow], failed: Sequence[int]) -> Iterator[str]:
    """Why logs failed, once where the reasons differ in numbers alone."""
    kinds: dict[str, list[int]] = defaultdict(list)
    for k in failed:
        name, row = rows[k]
        reason = row["failed"].replace(name, "").replace(Path(name).name, "")
        kinds[re.sub(r"\S*/\S*|(?<![A-Za-z_])\d[\d.e+-]*", "#", reason)].append(k)
    by_count = sorted(kinds.values(), key=lambda places: -len(places))
    for places in by_count[: 2 * LISTED]:
        name, row = rows[places[0]]
        several = f"FAILED {len(places)} of {len(rows)} logs: {_where(rows, places, range(len(rows)))}. The first"
        yield f"{several if len(places) > 1 else name}: {row['failed']}"
    if more := sum(map(len, by_count[2 * LISTED :])):
        yield f"FAILED {more} more, for other reasons, which are in the table"


def _findings(rows: Sequence[LogRow], known: Sequence[int]) -> Iterator[str]:
    """What `check` finds wrong, with the logs it is found in."""
    by_finding: dict[str, list[int]] = defaultdict(list)
    for k in known:
        for finding in filter(None, rows[k].row.get("wrong", "").split("; ")):
            by_finding[finding].append(k)
    for finding, places in sorted(by_finding.items(), key=lambda pair: -len(pair[1])):
        yield f"WRONG {finding} in {len(places)} of {len(known)} logs: {_where(rows, places, known)}"


def machine_of(name: str) -> str:
    """The folder of a log, which is one for each machine."""
    return str(Path(name).parent)


def _by_machine(rows: Sequence[LogRow], places: Iterable[int]) -> dict[str, list[int]]:
    """Logs by their folder, which is one for each machine."""
    machines: dict[str, list[int]] = defaultdict(list)
    for k in places:
        machines[machine_of(rows[k].name)].append(k)
    return machines


def _where(rows: Sequence[LogRow], places: Sequence[int], compared: Sequence[int]) -> str:
    """Logs by machine: all, all from one on among those that are compared, how many, or which."""
    here_, others_, all_ = (_by_machine(rows, which) for which in (places, compared, range(len(rows))))
    phrases: list[tuple[int, str]] = []
    for machine, here in here_.items():
        others, all_of_it, names = others_[machine], len(all_[machine]), [rows[k].name for k in here]
        count, of = len(here), f" of {machine}" * (len(all_) > 1)
        if 1 < count == all_of_it:
            phrases.append((count, f"all {count}{of}"))
        elif 2 < count < len(others) and here == others[-count:]:
            phrases.append((count, f"all{of} from {Path(names[0]).name} on, and none before"))
        elif count > LISTED:
            phrases.append((count, f"{count} of the {all_of_it}{of}, the first {Path(names[0]).name}"))
        else:
            phrases += [(1, name) for name in names]
    more = sum(count for count, _ in phrases[LISTED:])
    return "; ".join(phrase for _, phrase in phrases[:LISTED]) + (f"; and {more} more" if more else "")


def _odd(rows: Sequence[LogRow], sound: Sequence[int]) -> Iterator[str]:
    """Logs with a number far from that of the others."""
    names = dict.fromkeys(name for k in sound for name in rows[k].row if name.startswith(JUDGED))
    for name in names:
        values = np.array([rows[k].row.get(name, math.nan) for k in sound], float)
        known = np.isfinite(values) & (values > 0)
        places, values = np.array(sound)[known], values[known]
        if len(values) < FEWEST:
            continue
        # Ratios count: such numbers are positive, and a factor is as odd upwards as downwards.
        sizes = np.log(values)
        median = np.median(sizes)
        spread = 1.4826 * np.median(np.abs(sizes - median))
        odd = np.abs(sizes - median) > max(FAR * spread, math.log(LEAST_FACTOR))
        if odd.any():
            low, high = (f"{value:.3g}" for value in (values[odd].min(), values[odd].max()))
            yield (
                f"ODD {name} in {odd.sum()} of {len(values)} logs ({low}{f' to {high}' * (low != high)}, "
                f"median {math.exp(median):.3g}): {_where(rows, places[odd].tolist(), places.tolist())}"
            )


def _numbers(rows: Sequence[LogRow]) -> Iterator[str]:
    """Numbers fitted to each log: the shared one, offsets of machines, and drifts from log to log."""
    names = dict.fromkeys(
        name for _, row in rows for name in row if f"{name}_std" in row and isinstance(row[name], float)
    )
    several = len(_by_machine(rows, range(len(rows)))) > 1
    for name in names:
        value, std = (np.array([row.get(key, math.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        known = np.isfinite(value) & np.isfinite(std) & (std > 0)
        if known.sum() < 3:
            continue
        groups = _by_machine(rows, np.flatnonzero(known).tolist())
        means = {machine: _mean(value[places], std[places]) for machine, places in groups.items()}
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
    (_, slope), squares, *_ = np.linalg.lstsq(design, value / std)
    # Scatter beyond the errors of the logs widens that of the slope.
    scatter = max(1.0, float(squares.sum()) / (len(value) - 2))
    error = math.sqrt(scatter * np.linalg.inv(design.T @ design)[1, 1])
    return float(slope) if abs(slope) > CLEAR * error else None
