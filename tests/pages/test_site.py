"""The site builds without a warning, is searched without a server, and asks no other machine for anything."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from urllib.parse import urldefrag, urljoin

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(importlib.util.find_spec("mkdocs") is None, reason="mkdocs is not installed: extra docs"),
]

PHRASES = ("velocity from encoder", "URDF", "EKF", "misprint")
"""What a reader types into the search."""
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc="([^"]*)"|<link\b[^>]*?\bhref="([^"]*)"|url\(\s*["']?([^"')]+)"""
    r"""|@import\s+["']([^"']+)"""
)
"""Addresses that a browser fetches by itself, in HTML and in CSS; those of `<a>` are not among them."""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    # Not --quiet, which would hide warnings from --strict.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_the_search_finds_what_readers_look_for(site):
    script = (site / "search" / "search_index.js").read_text(encoding="utf-8")  # read from files; JSON is for servers
    entries = json.loads(script.removeprefix("var __index = "))["docs"]
    for phrase in PHRASES:
        hits = {urldefrag(entry["location"]).url for entry in entries if phrase.lower() in plain(entry)}
        assert hits, f"no page has {phrase!r}"


def plain(entry: dict[str, str]) -> str:
    return " ".join(re.sub(r"<[^>]+>", " ", f"{entry['title']} {entry['text']}").lower().split())


def test_nothing_is_loaded_from_elsewhere(site):
    """Every address that a page or a style loads is a file of the site or data of its own."""
    for path in [*site.rglob("*.html"), *site.rglob("*.css")]:
        for match in LOADED.finditer(path.read_text(encoding="utf-8")):
            address = next(filter(None, match.groups()), "")
            if address.startswith(("data:", "#")):
                continue
            assert not re.match(r"\w+:|//", address), f"{path.relative_to(site)} loads {address}"
            if path.suffix == ".html" and path.name != "404.html":  # that page is for servers, with paths from the root
                file = urljoin(f"/{path.relative_to(site)}", address).partition("?")[0].partition("#")[0]
                assert (site / file.lstrip("/")).exists(), f"{path.relative_to(site)} loads {address}, which is missing"


def test_links_lead_to_pages_of_the_site(site):
    for path in site.rglob("*.html"):
        if path.name == "404.html":
            continue
        for address in re.findall(r'<a\b[^>]*?\bhref="([^"#]+)', path.read_text(encoding="utf-8")):
            if not re.match(r"\w+:", address):  # figures are links, too
                file = urljoin(f"/{path.relative_to(site)}", address)
                assert (site / file.lstrip("/")).exists(), f"{path.relative_to(site)} leads to {address}"


def test_the_gallery_and_the_papers_are_pages(site):
    scripts = {path.stem for path in (ROOT / "gallery").glob("[0-9]*.py")}
    assert scripts <= {path.stem for path in (site / "gallery").glob("*.html")}
    for page in ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen"):
        text = (site / f"{page}.html").read_text(encoding="utf-8")
        assert "as printed" in text
        assert "corrected" in text
        assert (site / "llms.txt").read_text(encoding="utf-8").count(f"({page}.html)") == 1
