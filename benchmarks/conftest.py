"""The processor only, so that runs compare, a table that fits a screen, and the ratios of each run in a file."""

import datetime
import json
import os
import platform
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")

RATIOS = Path(__file__).with_name("ratios.json")
"""Least times of the members of a group, divided by that of the first, the reference; all of one run."""


def pytest_configure(config):
    """Columns that fit a screen."""
    config.option.benchmark_columns = ["min", "median", "iqr", "rounds"]


def pytest_sessionfinish(session, exitstatus):
    """Write the ratios of the groups that ran to the end; those of other groups stay with their dates."""
    benchmarks = getattr(getattr(session.config, "_benchmarksession", None), "benchmarks", [])
    kept = json.loads(RATIOS.read_text(encoding="utf-8")) if RATIOS.exists() else {}
    groups: dict[str, dict[str, float]] = {}
    for each in benchmarks:
        if each.group and not each.has_error:
            groups.setdefault(each.group, {})[each.name] = each.stats.min
    for group, times in groups.items():
        reference = next(iter(times))
        ratios = {name: float(f"{time / times[reference]:.3g}") for name, time in times.items()}
        where = {"date": datetime.date.today().isoformat(), "python": platform.python_version()}
        kept[group] = {**where, "reference": reference, "ratios": ratios}
    if groups:
        text = json.dumps(dict(sorted(kept.items())), indent=1, ensure_ascii=False)
        RATIOS.write_text(text + "\n", encoding="utf-8")
