"""The site builds without a warning, is searched without a server, and asks no other machine for anything."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from check_site import problems

ROOT = Path(__file__).parents[2]

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: extra docs"),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    # Not --quiet, which would hide warnings from --strict.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    (folder / "browser-demo.html").touch()  # written by tools/browser_page.py, whose tests are in test_wasm.py
    return folder


def test_links_lead_to_places_and_nothing_is_loaded_from_elsewhere(site):
    assert list(problems(site)) == []


def test_what_is_wrong_with_a_site_is_found(site, tmp_path):
    wrong = tmp_path / "site"
    shutil.copytree(site, wrong)
    page = wrong / "choose.html"
    bad = '<a href="gone.html">a</a><a href="check.html#gone">b</a><img src="gone.png"><img src="http://a.b/c.png">'
    page.write_text(page.read_text(encoding="utf-8") + bad, encoding="utf-8")
    assert sorted(problems(wrong)) == [
        "choose.html leads to check.html#gone, a place that is not on that page",
        "choose.html leads to gone.html, which is not there",
        "choose.html loads gone.png, which is not there",
        "choose.html loads http://a.b/c.png, from elsewhere",
    ]


def test_pages_are_found_by_the_words_of_others(site):
    script = (site / "search" / "search_index.js").read_text(encoding="utf-8")
    entries = json.loads(script.removeprefix("var __index = "))["docs"]
    found = {tag: entry["location"] for entry in entries for tag in entry.get("tags", ())}
    for words, page in (
        ("quantisation", "logs.html"),
        ("external torque", "forces.html"),
        ("residual", "estimates.html"),
    ):
        assert found[words].startswith(page)


def test_every_class_for_users_has_a_page(site):
    pages = {path.stem for path in (site / "reference" / "observers").glob("*.html")}
    assert {"Intrinsic", "EKF", "AbstractObserver"} <= pages
    assert "REGISTRY" not in pages
    table = (site / "reference" / "observers.html").read_text(encoding="utf-8")
    assert table.index("observers/Intrinsic.html") < table.index("observers/AbstractObserver.html")


def test_the_gallery_and_the_papers_are_pages(site):
    scripts = {path.stem for path in (ROOT / "gallery").glob("[0-9]*.py")}
    notebooks = {path.stem for path in (ROOT / "gallery").glob("*.ipynb")}
    assert scripts | notebooks <= {path.stem for path in (site / "gallery").glob("*.html")}
    for page in ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen"):
        text = (site / f"{page}.html").read_text(encoding="utf-8")
        assert "as printed" in text
        assert "corrected" in text
        assert (site / "llms.txt").read_text(encoding="utf-8").count(f"({page}.html)") == 1
