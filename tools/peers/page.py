"""The page of other projects' suites, `docs/peers.md`, written from `docs/peers.json` alone."""

import json
import re
from pathlib import Path

RESULTS = Path(__file__).parents[2] / "docs" / "peers.json"

HEAD = """# Other projects' suites

<!-- Written by tools/pages.py from peers.json; `make peers` writes both. -->

`make peers` runs test suites and programs of other projects on this library, each in its own environment, and writes
this page. A *case* is one test of the other project, or one number that is compared with a stated bound. A *deviation*
is a case that does not pass; each is listed with its reason. Times are of the machine that wrote the page, and depend
on what else it did. Long tables show the largest numbers of several rows; [peers.json](peers.json) has every row.
"""

ABOUT = {
    "geomstats": "geomstats' own tests of Riemannian metrics, unmodified, on metrics of this library: closed forms, "
    "a SCARA and three joints of a Panda. Hyperbolic and Euclidean space are also compared with geomstats' own.",
    "lie": "The laws that the public tests of jaxlie and manif state, asked of the groups here through one interface, "
    "and of jaxlie for comparison; then values beside jaxlie, Pinocchio and arithmetic of 60 digits.",
    "filterpy": "FilterPy's extended and unscented Kalman filter on the same models and logs as those here. The models "
    "are written again in NumPy for it.",
    "fmi": "FMPy validates exported units of both versions of FMI, and its simulation is compared with Python.",
    "sysid": "MuJoCo's system identification beside `covariant fit`, on one log of a servo.",
    "dynamics": "Every included robot, and random trees, beside MuJoCo and Pinocchio (`tools/compare_robots.py`).",
}
"""What each suite is, by its name."""


SHORTENED: dict[str, tuple[tuple[int, ...], str]] = {
    "Laws of Lie groups": (
        (0, 1),
        "50 laws for rotations of up to 0.01 rad, and 50 for those of 0.1 to 2.5 rad. Allowed are 1e-8 in double "
        "precision, as in the tests of jaxlie, 2e-5 in single precision, and 1e-7 for derivatives, as in the tests of "
        "manif.",
    ),
    "Digits": ((0, 2), "The largest of exp, log, J_r, J_r⁻¹ and Ad. {note}"),
    "Largest differences": ((1,), "The largest of all robots and trees. {note}"),
}
"""Tables that the page shows shortened: the columns that stay, and the note; `{note}` is that of the whole table."""


def shortened(title: str, head: list[str], rows: list[list[str]]) -> tuple[list[str], list[list[str]]]:
    """A table as the page shows it: one row for each value of the columns that stay.

    Such a row has the largest numbers and the sums of "5 of 5"; columns of words are left out.
    """
    if title not in SHORTENED:
        return head, rows
    stay, _ = SHORTENED[title]
    numbers = [k for k in range(len(head)) if k > max(stay) and all(_number(row[k]) for row in rows)]
    groups: dict[tuple[str, ...], list[list[str]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[k] for k in stay), []).append(row)
    short = [[*key, *(_joined([row[k] for row in group]) for k in numbers)] for key, group in groups.items()]
    return [head[k] for k in (*stay, *numbers)], short


def _number(cell: str) -> bool:
    return bool(re.fullmatch(r"–|[-+.\de]+|\d+ of \d+", cell))


def _joined(cells: list[str]) -> str:
    if " of " in cells[0]:
        kept, tried = zip(*(map(int, cell.split(" of ")) for cell in cells), strict=True)
        return f"{sum(kept)} of {sum(tried)}"
    return max(cells, key=lambda cell: -1.0 if cell == "–" else float(cell))


def table(head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [head, ["---"] * len(head), *rows])


def summary(results: dict[str, dict]) -> str:
    """One row for each suite."""
    rows = []
    for name, outcome in results.items():
        counts = [outcome.get(key, "–") for key in ("version", "cases", "passed")]
        deviations = len(outcome["deviations"]) if "deviations" in outcome else "–"
        cells = [f"[{name}](#{name})", *counts, deviations, outcome.get("seconds", "–"), outcome["date"]]
        rows.append([str(cell) for cell in cells])
    totals = [sum(outcome.get(key, 0) for outcome in results.values()) for key in ("cases", "passed")]
    off = sum(len(outcome.get("deviations", ())) for outcome in results.values())
    seconds = sum(outcome.get("seconds", 0) for outcome in results.values())
    rows.append(["all", "", *map(str, totals), str(off), str(seconds), ""])
    return table(["suite", "versions", "cases", "passed", "deviations", "seconds", "date"], rows)


def section(name: str, outcome: dict) -> str:
    """The results of one suite."""
    parts = [f"## {name}", ABOUT[name]]
    if "failed" in outcome:
        parts.append(f"It did not finish: {outcome['failed']}.")
    parts += [
        f"pip does not install `{what}`, which would be compared as well: {said}"
        for what, said in outcome.get("unavailable", {}).items()
    ]
    if left := outcome.get("left_out"):
        parts.append("\n".join(f"- left out, {part['what']}: {part['count']}; {part['reason']}" for part in left))
    if off := outcome.get("deviations"):
        rows = [[part["case"], part["reason"] or "not explained"] for part in off]
        parts.append(table(["deviation", "reason"], rows))
    for part in outcome.get("tables", []):
        title = part["title"]
        parts += [f"**{title}**", table(*shortened(title, part["head"], part["rows"]))]
        note = SHORTENED[title][1].format(note=part["note"]) if title in SHORTENED else part["note"]
        parts += [note] if note else []
    return "\n\n".join(parts)


def page() -> str:
    """The whole page."""
    results = json.loads(RESULTS.read_text(encoding="utf-8"))
    return "\n\n".join([HEAD.rstrip(), summary(results), *(section(*item) for item in results.items())]) + "\n"
