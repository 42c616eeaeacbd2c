"""The README and the pages: every example runs as it stands, links lead somewhere, tables and pictures are current."""

import inspect
import re
from pathlib import Path

import jax.numpy as jnp
import pytest
from pages import written

from covariant import models, observers
from covariant.observers import Intrinsic

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


each_page = pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)


@each_page
def test_python_examples_run(page):
    """One after the other; the names a page takes for granted are a short log of a double pendulum and an observer."""
    t = jnp.arange(20.0) * 0.002
    names = {"t": t, "u": jnp.zeros((20, 2)), "y": jnp.stack([t, -t], axis=1)}
    names["observer"] = Intrinsic(models.pendulum_chain(), 20.0, 200.0)
    for text in blocks(page, "python"):
        exec(compile(text, page.name, "exec"), names)
    assert "result" not in names or names["result"].estimate.shape == (20, 4)


@each_page
def test_model_file_examples_load(page, tmp_path):
    for text in blocks(page, "toml"):
        (tmp_path / "model.toml").write_text(text)
        assert models.load(str(tmp_path / "model.toml")).model.coordinates == ("q1", "q2")


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


@pytest.mark.parametrize("path", written(), ids=lambda p: p.name)
def test_what_is_written_from_the_code_is_up_to_date(path):
    assert path.read_text(encoding="utf-8") == written()[path], "run: python tools/pages.py"


def test_every_observer_is_on_the_page_of_observers():
    page = (ROOT / "docs" / "observers.md").read_text(encoding="utf-8")
    for name in observers.__all__:
        kind = getattr(observers, name)
        if isinstance(kind, type) and issubclass(kind, observers.AbstractObserver) and not inspect.isabstract(kind):
            assert f"`{name}`" in page, f"docs/observers.md does not name {name}"
