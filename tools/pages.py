"""What is written into the pages: the table of observers, the picture of the house, what other projects' suites found.

    python tools/pages.py

writes them into `docs`, and the tests fail where they are not up to date.
"""

import re
from collections.abc import Callable
from pathlib import Path

from house import drawing
from peers.page import page as peers_page

from covariant.observers import REGISTRY, Entry

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

NUMBERS = {
    "gains": "α, β",
    "noise": "covariances",
    "noise or ticks": "covariances, quantum",
    "bandwidth": "bandwidth",
    "window": "window, order",
    "motion": "motion, noise",
    "jerk": "jerk",
    "state noise": "covariances, first estimate",
}


def observers_table(entries: tuple[Entry, ...] = REGISTRY) -> str:
    """The registry as a Markdown table; what an entry fits is the first line of its predicate's docstring."""
    head = "| name | in Python | what it is | when | for | set by | source |"
    return "\n".join([head, "|---" * 7 + "|", *map(_row, entries)])


def _row(entry: Entry) -> str:
    fits = (entry.fits.__doc__ or "").strip().split("\n")[0].removesuffix(".")
    cells = entry.about, entry.when, fits[:1].lower() + fits[1:], NUMBERS[entry.tuned_by], entry.source
    return f"| `{entry.name}` | `{entry.observer.__name__}` | {' | '.join(cells)} |"


def with_table(page: str, name: str, table: str) -> str:
    """The page with what stands between `<!-- name -->` and `<!-- end -->` replaced."""
    begin, end = f"<!-- {name}: written by tools/pages.py -->", "<!-- end -->"
    return re.sub(f"{begin}.*?{end}", lambda _: f"{begin}\n\n{table}\n\n{end}", page, flags=re.DOTALL)


def _observers_page() -> str:
    return with_table((DOCS / "observers.md").read_text(encoding="utf-8"), "observers", observers_table())


WRITTEN: dict[Path, Callable[[], str]] = {
    DOCS / "observers.md": _observers_page,
    DOCS / "peers.md": peers_page,
    DOCS / "images" / "house.svg": lambda: drawing(ROOT / "src" / "covariant"),
}
"""Every file that is written, from the code or from results, with what makes the text it should have."""


if __name__ == "__main__":
    for path, text in WRITTEN.items():
        path.write_text(text(), encoding="utf-8")
        print(f"wrote {path.relative_to(ROOT)}")
