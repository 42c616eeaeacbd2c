"""The pages: links lead somewhere, the site has them all, and what is written from the code is current."""

import inspect
import re
from pathlib import Path

import pytest
from pages import WRITTEN
from style import PAGES as WITH_NUMBERS, with_zeros

from covariant import observers

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


def anchors(page: Path) -> set[str]:
    """What a link may name on a page: its headings, as both the site and the repository's pages write them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ +(.+)$", text, re.MULTILINE)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip().lower()) for heading in headings}


@each_page
def test_links_lead_to_files_and_headings_that_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target, anchor in re.findall(r"\]\((?!\w+:)([^)#\s]*)(?:#([^)\s]+))?\)", text):
        found = (page.parent / target).resolve() if target else page
        assert found.exists(), target
        assert found.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(found), f"{target}#{anchor}"


def test_links_on_the_pages_stay_among_them():
    """The site has the pages and the README, and nothing else of the repository."""
    for page in PAGES[1:]:
        for target in re.findall(r"\]\((?!\w+:)([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).resolve().is_relative_to(ROOT / "docs"), f"{page.name}: {target}"


def test_the_site_names_every_page():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("nav:")[-1]
    named = re.findall(r"[\w/-]+\.md", navigation)
    assert sorted(named) == sorted(["index.md", *(page.name for page in PAGES[1:])])


def test_numbers_have_a_zero_before_their_decimal_point():
    texts = {page.name: page.read_text(encoding="utf-8") for page in WITH_NUMBERS}
    assert not [name for name, text in texts.items() if with_zeros(text) != text], "run: python tools/style.py --pages"
    assert with_zeros("`--push .5,.2`, -.03 or (.9), v.2, 1.5, {x[.1]:.3f}, %.4g") == (
        "`--push 0.5,0.2`, -0.03 or (0.9), v.2, 1.5, {x[0.1]:.3f}, %.4g"
    )


@pytest.mark.core(4)
@pytest.mark.parametrize("path", WRITTEN, ids=lambda p: p.name)
def test_what_is_written_from_the_code_is_up_to_date(path):
    assert path.read_text(encoding="utf-8") == WRITTEN[path](), "run: python tools/pages.py"


def test_every_observer_is_on_the_page_of_observers():
    page = (ROOT / "docs" / "observers.md").read_text(encoding="utf-8")
    for name in dir(observers):
        kind = getattr(observers, name)
        if isinstance(kind, type) and issubclass(kind, observers.AbstractObserver) and not inspect.isabstract(kind):
            assert f"`{name}`" in page, f"docs/observers.md does not name {name}"
