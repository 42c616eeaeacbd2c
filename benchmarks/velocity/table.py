"""Tables and figure of the results: losses first."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

DOCS = Path(__file__).parents[2] / "docs"
RESULTS = Path(__file__).with_name("results.json")
TUNED = ("covariant", "covariant-kalman")
"""Estimators that `covariant tune` tunes, without true velocities."""
Result = dict[str, Any]


def best(result: Result, knows_model: bool | None = None) -> str:
    """Name of the estimator with the least error of those that are searched, or of these with or without a model."""
    rows = result["estimators"]
    names = [name for name in rows if name not in TUNED and knows_model in (None, rows[name]["knows_model"])]
    return min(names, key=lambda name: rows[name]["error"])


def excess(result: Result) -> float:
    """Error of the default as a multiple of the least error of all."""
    return result["estimators"]["covariant"]["error"] / result["estimators"][best(result)]["error"]


def summary(results: list[Result]) -> str:
    """A line for every log: the default beside the best with and without a model; the worst first."""
    head = ("log", "rate [Hz]", "best without a model", "best with it", "default after `tune`", "ratio to the best")
    lines = [f"| {' | '.join(head)} | by the second reading |", "|---|--:|---|---|---|---|--:|"]
    for one in sorted(results, key=excess, reverse=True):
        rows = one["estimators"]
        free, informed = (
            f"{name} {percent(rows[name]['error'])}" for name in (best(one, knows) for knows in (False, True))
        )
        default, (value, low, high) = rows["covariant"], rows[best(one)]["ratio"]
        ours = f"{default['note']} {percent(default['error'])}"
        cells = (one["log"], f"{one['rate']:.3g}", free, informed, ours, f"{value:.2f} ({low:.2f} to {high:.2f})")
        seconds = [row["second"] for row in rows.values() if "second" in row]
        second = f"{default['second'] / min(seconds):.2f}" if seconds else ""
        lines.append(f"| {' | '.join(cells)} | {second} |")
    return "\n".join(lines)


def percent(value: float) -> str:
    """A fraction in percent, with three digits."""
    return f"{100 * value:.3g} %" if np.isfinite(value) else "failed"


def details(result: Result) -> str:
    """All scores of every estimator on one log, best first."""
    judged = f"{result['rows']} rows judged against {result['against']}"
    head = "| estimator | error | lag [ms] | noise | worst tenth | in its 95 % band | operations | numbers |"
    lines = [f"{result['log']}, {result['rate']:.4g} Hz, {judged}", "", head, "|---|--:|--:|--:|--:|--:|--:|---|"]
    for name, row in sorted(result["estimators"].items(), key=lambda item: item[1]["error"]):
        if not np.isfinite(row["error"]):
            lines.append(f"| {name} | {row['note']} | | | | | | |")
            continue
        numbers = row["note"] or ", ".join(f"{key} {value:.3g}" for key, value in row["numbers"].items())
        cells = (
            *(name, percent(row["error"]), f"{1e3 * row['lag']:.3g}", percent(row["noise"])),
            *(percent(row["worst_tenth"]), percent(row["band"]) if "band" in row else "", row["operations"] or ""),
        )
        lines.append(f"| {' | '.join(map(str, cells))} | {numbers} |")
    if any("second" in row for row in result["estimators"].values()):
        order = sorted(result["estimators"], key=lambda name: result["estimators"][name].get("second", np.inf))
        late = f"{1e3 * result['second_delay']:.3g} ms later than the positions"
        lines += ["", f"By the second reading, which is {late}, the order is {', '.join(order)}."]
    return "\n".join(lines)


def matrix(results: list[Result]) -> str:
    """Errors of all estimators on all logs as multiples of the least one of each log."""
    names = sorted({name for one in results for name in one["estimators"]}, key=lambda name: middle(results, name))
    short = [str(k) for k in range(1, len(results) + 1)]
    lines = [f"| estimator | median | {' | '.join(short)} |", f"|---|{'--:|' * (len(short) + 1)}"]
    for name in names:
        lines.append(f"| {name} | {middle(results, name):.2f} | {' | '.join(multiple(one, name) for one in results)} |")
    logs = "; ".join(f"{k} {one['log']}" for k, one in zip(short, results, strict=True))
    return "\n".join([*lines, "", f"Logs: {logs}."])


def multiple(result: Result, name: str) -> str:
    """Error of an estimator as a multiple of the least one of a log, as text."""
    rows = result["estimators"]
    if name not in rows:
        return ""
    value = rows[name]["error"] / min(row["error"] for row in rows.values())
    return "failed" if not np.isfinite(value) else f"{value:.2f}" if value < 10 else f"{value:.0f}"


def middle(results: list[Result], name: str) -> float:
    """Median over the logs of the error of an estimator as a multiple of the least one."""
    found = [
        one["estimators"][name]["error"] / min(row["error"] for row in one["estimators"].values())
        for one in results
        if name in one["estimators"]
    ]
    return float(np.median(found))


def write_page(results: list[Result]) -> None:
    """Write the results, and the tables and the figure of the page."""
    RESULTS.write_text(json.dumps(_rounded(results), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    page = DOCS / "velocity-benchmark.md"
    text = page.read_text(encoding="utf-8")
    for name, part in (("logs", summary(results)), ("estimators", matrix(results))):
        text = _replaced(text, name, part)
    page.write_text(text, encoding="utf-8")
    draw(results, DOCS / "images" / "velocity-benchmark.svg")


def _replaced(text: str, name: str, part: str) -> str:
    """The page with what stands between `<!-- name -->` and `<!-- end -->` replaced."""
    begin, end = f"<!-- {name}: written by `python -m benchmarks.velocity --page` -->", "<!-- end -->"
    return re.sub(f"{re.escape(begin)}.*?{end}", lambda _: f"{begin}\n\n{part}\n\n{end}", text, flags=re.DOTALL)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.4g}") if np.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _rounded(each) for key, each in value.items()}
    return [_rounded(each) for each in value] if isinstance(value, list) else value


def draw(results: list[Result], path: Path) -> None:
    """Errors of every estimator on every log, as multiples of the least one: a column of points for each log."""
    import matplotlib

    matplotlib.use("svg")
    from matplotlib import pyplot as plt

    plt.rcParams["svg.hashsalt"] = "velocity"
    ordered = sorted(results, key=excess, reverse=True)
    figure, axes = plt.subplots(figsize=(9, 4.6), constrained_layout=True)
    kinds = {"without a model": (False, "#9aa5b1", "o"), "with the model": (True, "#3b6ea5", "o")}
    for label, (knows, colour, marker) in kinds.items():
        points = [
            (k, row["error"] / one["estimators"][best(one)]["error"])
            for k, one in enumerate(ordered)
            for name, row in one["estimators"].items()
            if name not in TUNED and row["knows_model"] == knows and np.isfinite(row["error"])
        ]
        axes.scatter(*zip(*points, strict=True), s=26, color=colour, marker=marker, alpha=0.75, lw=0, label=label)
    default = [excess(one) for one in ordered]
    axes.scatter(range(len(ordered)), default, s=52, color="#c8452d", marker="D", label="default after tune", zorder=3)
    axes.axhline(1, color="0.6", lw=0.8)
    axes.set_yscale("log")
    axes.set_ylim(0.4, 100)
    axes.set_yticks([0.5, 1, 2, 5, 10, 20, 50, 100], ["0.5", "1", "2", "5", "10", "20", "50", "100"])
    axes.set_xticks(range(len(ordered)), [one["log"] for one in ordered], rotation=38, ha="right", fontsize=8)
    axes.set_ylabel("velocity error / that of the best\nof the searched estimators")
    axes.legend(frameon=False, loc="upper right", fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)
