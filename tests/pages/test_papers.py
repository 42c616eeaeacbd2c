"""The tables of the four papers: what a paper numbers has a row, and what a row names exists."""

import re
import tomllib

import pytest
from pages import DOCS, ROOT, WRITTEN
from test_links import anchors

from covariant.papers import errata

PAPERS = tomllib.loads((DOCS / "papers.toml").read_text(encoding="utf-8"))

MOST_NOT_DONE = 5
"""Rows of all tables that may have no test."""

each_paper = pytest.mark.parametrize("name", PAPERS)


def places(name: str) -> list[str]:
    """What the rows of a paper are about, but for sections and what stands above or below an equation."""
    parts = [part for row in PAPERS[name]["rows"] for part in row[0].split(", ")]
    return [part for part in parts if not part.startswith(("above", "below", "§", "app."))]


@each_paper
def test_every_number_of_a_paper_has_a_row(name):
    ends = [re.fullmatch(r"\((\d+)\)(?:–\((\d+)\))?", part) for part in places(name)]
    found = {n for end in ends if end for n in range(int(end[1]), int(end[2] or end[1]) + 1)}
    assert found == set(range(1, PAPERS[name]["equations"] + 1))
    assert {part for part in places(name) if not part.startswith("(")} == set(PAPERS[name]["named"])


@each_paper
def test_a_row_names_a_file_a_test_and_a_page_that_exist(name):
    for place, subject, code, test, page in PAPERS[name]["rows"]:
        where = f"{place}: {subject}"
        assert subject, where
        assert not code or (ROOT / "src" / "covariant" / code).is_file(), f"{where}: {code}"
        if test.startswith("open: "):
            assert page, f"{where}: no page says what is proved today"
            assert "open" in subject, where
        elif test == "drawing":
            assert place.startswith("Figure"), where
            assert not code, f"{where}: a drawing has no code"
        elif not test.startswith("not done: "):
            path, _, function = test.partition("::")
            assert re.search(rf"^def {function}\(", (ROOT / "tests" / path).read_text("utf-8"), re.MULTILINE), where
            assert page, f"{where}: no page"
        target, _, anchor = page.partition("#")
        assert not page or (DOCS / target).is_file(), f"{where}: {page}"
        assert not anchor or anchor in anchors(DOCS / target), f"{where}: {page}"


def test_few_rows_are_not_done_and_each_says_why():
    reasons = [row[3] for paper in PAPERS.values() for row in paper["rows"] if row[3].startswith("not done")]
    assert len(reasons) <= MOST_NOT_DONE, reasons
    assert all(len(reason) > len("not done: ") + 10 for reason in reasons), reasons


@each_paper
def test_every_misprint_of_the_list_has_a_row(name):
    shown = {(page.partition("#")[2], f"tests/{test}") for *_, test, page in PAPERS[name]["rows"]}
    page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    for entry in errata.of(name):
        assert f"### Misprint in {entry.where}\n" in page
        anchor = re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", f"misprint in {entry.where}").lower())
        # A site writes anchors in ASCII; a misprint without one is linked by its section.
        assert (anchor if anchor.isascii() else "errata", entry.shown_by) in shown, entry.where


def test_the_tables_are_up_to_date():
    path = DOCS / "papers.md"
    assert path.read_text(encoding="utf-8") == WRITTEN[path](), "run: python tools/pages.py"
