"""Check the built site: `make docs` runs this when all of it is there.

    python tools/check_site.py site

mkdocs checks the links that pages have in Markdown. This checks what browsers get: every link leads to a file of the
site and to a place on it, every page loads what is there and nothing from another machine, and the search has the words
that readers look for. What is wrong is printed, and the exit code is 1.
"""

import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from urllib.parse import unquote, urldefrag, urljoin

PHRASES = ("velocity from encoder", "URDF", "EKF", "misprint")
"""What a reader types into the search."""
LOADED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*?\bsrc="([^"]*)"|<link\b[^>]*?\bhref="([^"]*)"|url\(\s*["']?([^"')]+)"""
    r"""|@import\s+["']([^"']+)"""
)
"""Addresses that a browser fetches by itself, in HTML and in CSS; those of `<a>` are not among them."""
LINK = re.compile(r'<a\b[^>]*?\bhref="([^"]*)"')
WITHOUT_PLACE = ("404.html", "browser-demo.html")
"""A page for servers, with paths from the root, and one that is a program."""


def problems(site: Path) -> Iterator[str]:
    """What is wrong with a site, a line each."""
    for path in sorted([*site.rglob("*.html"), *site.rglob("*.css")]):
        if path.name not in WITHOUT_PLACE:
            yield from _loaded(site, path)
            yield from _links(site, path)
    script = (site / "search" / "search_index.js").read_text(encoding="utf-8")  # read from files; JSON is for servers
    texts = "\n".join(_plain(entry) for entry in json.loads(script.removeprefix("var __index = "))["docs"])
    yield from (f"the search has no page with {phrase!r}" for phrase in PHRASES if phrase.lower() not in texts)


def _loaded(site: Path, path: Path) -> Iterator[str]:
    page = path.relative_to(site)
    for match in LOADED.finditer(path.read_text(encoding="utf-8")):
        address = next(filter(None, match.groups()), "")
        if re.match(r"\w+:|//", address) and not address.startswith("data:"):
            yield f"{page} loads {address}, from elsewhere"
        elif path.suffix == ".html" and not address.startswith(("data:", "#")) and not _target(site, page, address):
            yield f"{page} loads {address}, which is not there"


def _links(site: Path, path: Path) -> Iterator[str]:
    page = path.relative_to(site)
    for address in set(LINK.findall(path.read_text(encoding="utf-8"))) if path.suffix == ".html" else ():
        if re.match(r"\w+:|//", address):
            continue
        target, place = _target(site, page, address), unquote(urldefrag(address).fragment)
        if target is None:
            yield f"{page} leads to {address}, which is not there"
        elif place and target.suffix == ".html" and target.name not in WITHOUT_PLACE and place not in _places(target):
            yield f"{page} leads to {address}, a place that is not on that page"


def _target(site: Path, page: Path, address: str) -> Path | None:
    """The file of an address on a page; None where there is none."""
    file = unquote(urljoin(f"/{page}", address).partition("?")[0].partition("#")[0]).lstrip("/")
    return site / file if (site / file).is_file() else None


@cache
def _places(path: Path) -> set[str]:
    return {*re.findall(r'\b(?:id|name)="([^"]+)"', path.read_text(encoding="utf-8"))}


def _plain(entry: dict[str, str]) -> str:
    return " ".join(re.sub(r"<[^>]+>", " ", f"{entry['title']} {entry['text']}").lower().split())


def main() -> int:
    """Check the site in the folder that is named."""
    wrong = list(problems(Path(sys.argv[1])))
    print(
        "\n".join(wrong) if wrong else f"{sys.argv[1]}: links, places and files are there, and the search has its words"
    )
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
