"""What the rows of many logs say together: odd logs, findings that begin at a date, numbers that drift or differ."""

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import median_filter
from scipy.special import stdtrit

from covariant._names import natural_key

FEWEST = 8
"""Fewest logs among which one can be odd."""
FAR = 6.0
"""Robust standard deviations from the median beyond which a number is odd."""
LEAST_FACTOR = 1.5
"""Least factor between an odd number and the median, where all logs are nearly alike."""
LEAST_FACTORS = {"rate": 1.002}
"""The same of numbers that vary less: clocks are good to a tenth of this."""
FEWEST_ROWS = 50
"""Fewest rows of a log whose numbers can be odd and not chance."""
CHANCE = 1e-3
"""Probability that of numbers without an outlier one is called so."""
MOST_OUTLIERS = 100
"""Most outliers that are looked for."""
IDLE, AT_REST = "too little motion", ("nothing moves", "too little motion")
"""Verdict on a log that says nothing of its model, which among many logs is no fault, and the findings with it."""
SHORTEST_STRETCH = 3
"""Least number of logs before and after a change, of which fewer are odd ones."""
CLEAR = 4.0
"""Standard errors beyond which an offset or a drift is more than chance, among many logs."""
JUDGED = ("nis", "nees", "innovation_rms", "velocity_rmse", "state_rmse", "rate")
"""Beginnings of the names of columns in which a log can be odd."""
NEARLY_NONE = 1e-6
"""Weight of an odd log, relative to another."""
LISTED = 5
"""Most logs that a sentence names."""


class LogRow(NamedTuple):
    """The row of a log, under the name of the log."""

    name: str
    row: dict[str, Any]


class Among(NamedTuple):
    """What is unlike the rest among the rows of many logs.

    Attributes:
        sentences: What to print.
        odd: Names of the odd numbers of a log, by the index of its row.
    """

    sentences: tuple[str, ...]
    odd: dict[int, list[str]]


def among_logs(given: Sequence[LogRow]) -> Among:
    """Compare the rows of many logs, those of a machine in the order of their dates, or of their names."""
    order = _in_time(given)
    rows = [given[k] for k in order]
    failed = [k for k, (_, row) in enumerate(rows) if "failed" in row]
    known = [k for k, (_, row) in enumerate(rows) if "failed" not in row]
    idle = [k for k in known if rows[k].row.get("verdict") == IDLE]
    sound = [k for k in known if not rows[k].row.get("wrong") and rows[k].row.get("rows", math.inf) >= FEWEST_ROWS]
    odd = _odd(rows, sound)
    by_row = _grouped((order[k], name) for name, (_, places) in odd.items() for k in places)
    sentences = (
        *_failures(rows, failed),
        *_findings(rows, known),
        *([f"IDLE {len(idle)} of {len(known)} logs, which move too little: {_where(rows, idle, known)}"] * bool(idle)),
        *(sentence for sentence, _ in odd.values()),
        *_numbers([rows[k] for k in known]),
    )
    return Among(sentences, by_row)


def _in_time(rows: Sequence[LogRow]) -> list[int]:
    """Indices of the rows by machine and date, or name where a log of the machine has no date: log2 before log10."""
    dated = {
        machine: all("t_counts_from" in rows[k].row for k in places if "failed" not in rows[k].row)
        for machine, places in by_machine(rows, range(len(rows))).items()
    }

    def key(k: int) -> tuple[Any, ...]:
        name, row = rows[k]
        machine = machine_of(name)
        return natural_key(machine), row.get("t_counts_from", "") if dated[machine] else "", natural_key(name)

    return sorted(range(len(rows)), key=key)


def _failures(rows: Sequence[LogRow], failed: Sequence[int]) -> Iterator[str]:
    """Why logs failed, once where the reasons differ in numbers alone."""

    def reason(name: str, row: dict[str, Any]) -> str:
        text = row["failed"].replace(name, "").replace(Path(name).name, "")
        return re.sub(r"\S*/\S*|(?<![A-Za-z_])\d[\d.e+-]*", "#", text)

    kinds = _grouped((reason(*rows[k]), k) for k in failed)
    by_count = sorted(kinds.values(), key=lambda places: -len(places))
    for places in by_count[: 2 * LISTED]:
        name, row = rows[places[0]]
        several = f"FAILED {len(places)} of {len(rows)} logs: {_where(rows, places, range(len(rows)))}. The first"
        yield f"{several if len(places) > 1 else name}: {row['failed']}"
    if more := sum(map(len, by_count[2 * LISTED :])):
        yield f"FAILED {more} more, for other reasons, which are in the table"


def _findings(rows: Sequence[LogRow], known: Sequence[int]) -> Iterator[str]:
    """What `check` finds wrong, with the logs it is found in."""
    findings = ((finding, k) for k in known for finding in rows[k].row.get("wrong", "").split("; ") if finding)
    by_finding = _grouped(findings)
    for finding, places in sorted(by_finding.items(), key=lambda pair: -len(pair[1])):
        yield f"WRONG {finding} in {len(places)} of {len(known)} logs: {_where(rows, places, known)}"


def machine_of(name: str) -> str:
    """The folder of a log, which is one for each machine; that of a data set, for its files in chunks."""
    folder = Path(name).parent
    in_chunks = folder.parent.name == "data" and folder.name.startswith("chunk-")
    return str(folder.parent.parent if in_chunks else folder)


def by_machine(rows: Sequence[LogRow], places: Iterable[int]) -> dict[str, list[int]]:
    """Logs by their folder, which is one for each machine."""
    return _grouped((machine_of(rows[k].name), k) for k in places)


def _grouped(pairs: Iterable[tuple[Any, Any]]) -> dict[Any, list[Any]]:
    """Values by their keys."""
    groups: dict[Any, list[Any]] = defaultdict(list)
    for key, value in pairs:
        groups[key].append(value)
    return dict(groups)


def _where(rows: Sequence[LogRow], places: Sequence[int], compared: Sequence[int]) -> str:
    """Logs by machine: all, all from one on among those that are compared, how many, or which."""
    here_, others_, all_ = (by_machine(rows, which) for which in (places, compared, range(len(rows))))
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


def _odd(rows: Sequence[LogRow], sound: Sequence[int]) -> dict[str, tuple[str, list[int]]]:
    """Numbers that are in some logs far from those of the others: a sentence, and these logs."""
    found = {}
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
        odd = np.abs(sizes - median) > max(FAR * spread, math.log(LEAST_FACTORS.get(name, LEAST_FACTOR)))
        if odd.any():
            low, high, middle = (f"{v:.4g}" for v in (values[odd].min(), values[odd].max(), math.exp(median)))
            found[name] = (
                f"ODD {name} in {odd.sum()} of {len(values)} logs ({low}{f' to {high}' * (low != high)}, "
                f"median {middle}): {_where(rows, places[odd].tolist(), places.tolist())}",
                places[odd].tolist(),
            )
    return found


def _numbers(rows: Sequence[LogRow]) -> Iterator[str]:
    """Numbers fitted to each log: the shared one, machines or logs that are unlike it, and drifts from log to log."""
    names = dict.fromkeys(
        name for _, row in rows for name in row if f"{name}_std" in row and isinstance(row[name], float)
    )
    several = len(by_machine(rows, range(len(rows)))) > 1
    for name in names:
        value, std = (np.array([row.get(key, math.nan) for _, row in rows], float) for key in (name, f"{name}_std"))
        known = np.flatnonzero(np.isfinite(value) & np.isfinite(std) & (std > 0)).tolist()
        if len(known) < 3:
            continue
        groups = by_machine(rows, known)
        compared = groups if several else {rows[k].name: [k] for k in known}
        means, errors = np.array([weighted_mean(value[places], std[places])[:2] for places in compared.values()]).T
        odd = find_outliers(means, errors)
        shared, error, between = weighted_mean(means[~odd], errors[~odd])
        of = f"{f'{sum(~odd)} of ' * bool(odd.any())}{len(means)} {'machines' if several else 'logs'}"
        yield f"{name} = {shared:.4g} ± {error:.2g} shared by {of}, which differ by {between:.2g} beyond their errors"
        unlike = [
            f"{each}: {mean - shared:+.3g} ± {own:.2g}"
            for each, mean, own, is_odd in zip(compared, means, errors, odd, strict=True)
            if is_odd and abs(mean - shared) > CLEAR * math.hypot(own, error)
        ]
        yield from (f"  {sentence}" for sentence in unlike[:LISTED])
        if len(unlike) > LISTED:
            yield f"  and {len(unlike) - LISTED} more"
        for machine, places in groups.items():
            on = f" on {machine}" * several
            change = find_change(value[places], std[places])
            drift = None if change else find_drift(value[places], std[places])
            if change:
                yield f"  {name} changes{on}: {change[1]:+.3g} ± {change[2]:.2g} from {rows[places[change[0]]].name} on"
            if drift is not None:
                first, last = rows[places[0]].name, rows[places[-1]].name
                yield f"  {name} drifts{on}: {drift:+.3g} from {first} to {last}"


def find_outliers(value: np.ndarray, std: np.ndarray, group: np.ndarray | None = None) -> np.ndarray:
    """Which of some values are outliers among the others, which may differ by more than their standard errors.

    Values of each `group`, numbered from 0, have a mean of their own, and those of all groups have one scatter.

    Source: Rosner 1983, Percentage points for a generalized ESD many-outlier procedure.
    """
    group = np.zeros(len(value), int) if group is None else group
    left, removed, count = np.arange(len(value)), [], 0
    free = len(value) - len(np.unique(group))
    most = max((free - 1) // 3, 1) if free > 1 else 0  # of two none is the odd one
    for _ in range(min(most, MOST_OUTLIERS)):
        _, own, counts = np.unique(group[left], return_inverse=True, return_counts=True)
        off = np.abs(value[left] - (np.bincount(own, value[left]) / counts)[own])
        free = len(left) - len(counts)
        spread = max(math.sqrt(np.sum(off**2) / free), math.sqrt(np.mean(std[left] ** 2)))
        off /= np.sqrt(np.maximum(1 - 1 / counts[own], 0.5))  # a value pulls the mean of its group towards it
        t = stdtrit(free - 1, 1 - CHANCE / (2 * len(left)))
        farthest = int(np.argmax(off))
        removed.append(left[farthest])
        left = np.delete(left, farthest)
        if off[farthest] / spread > t * math.sqrt(free / (free - 1 + t**2)):
            count = len(removed)
    odd = np.zeros(len(value), bool)
    odd[np.array(removed[:count], int)] = True
    return odd


def weighted_mean(value: np.ndarray, std: np.ndarray) -> tuple[float, float, float]:
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


def find_change(value: np.ndarray, std: np.ndarray) -> tuple[int, float, float] | None:
    """The log from which on a number is another, by how much, and the standard error of that; None without one.

    Two weighted means explain the values before and from some log on. The scatter beyond the errors of the logs is that
    from one log to the next, which a change leaves as it is.

    Source: Hawkins 1977, Testing a sequence of observations for a shift in location, with Bonferroni's bound.
    """
    count = len(value)
    if count < FEWEST:
        return None
    steps = np.diff(value)
    scatter = max(0.0, (1.4826 * np.median(np.abs(steps))) ** 2 - np.median(std[1:] ** 2 + std[:-1] ** 2)) / 2
    # One or two odd logs hardly count: a running median has a change where it is, and no odd ones.
    odd = np.abs(value - median_filter(value, 5, mode="mirror")) > CLEAR * np.sqrt(std**2 + scatter)
    weights = np.where(odd, NEARLY_NONE, 1) / (std**2 + scatter)
    before, sums = np.cumsum(weights)[:-1], np.cumsum(weights * value)[:-1]
    after, rest = weights.sum() - before, (weights * value).sum() - sums
    sizes, errors = rest / after - sums / before, np.sqrt(1 / before + 1 / after)
    inside = slice(SHORTEST_STRETCH - 1, count - SHORTEST_STRETCH)
    at = int(np.argmax(np.abs(sizes / errors)[inside])) + inside.start
    left = value - np.where(np.arange(count) <= at, sums[at] / before[at], rest[at] / after[at])
    rest_of_squares = np.sum(weights * left**2)
    if np.polyfit(np.arange(count), value, 1, w=np.sqrt(weights), full=True)[1].sum() < rest_of_squares:
        return None  # a drift explains it better
    # What two means leave unexplained widens the error of their difference.
    error = errors[at] * max(1.0, math.sqrt(rest_of_squares / (count - 2)))
    clear = np.abs(sizes[at]) > stdtrit(count - 2, 1 - CHANCE / (2 * count)) * error
    return (at + 1, float(sizes[at]), float(error)) if clear else None


def find_drift(value: np.ndarray, std: np.ndarray) -> float | None:
    """Change of a number from the first log to the last, along a line; None where it is no more than chance."""
    if len(value) < FEWEST:
        return None
    k = np.linspace(0.0, 1.0, len(value))
    (slope, first), covariance = np.polyfit(k, value, 1, w=1 / std, cov="unscaled")
    # Scatter beyond the errors of the logs widens that of the slope.
    scatter = max(1.0, float(np.sum(((value - first - slope * k) / std) ** 2)) / (len(value) - 2))
    error = math.sqrt(scatter * covariance[0, 0])
    return float(slope) if abs(slope) > CLEAR * error else None
