"""What the site has beside the pages in `docs`: the README, the scripts of the gallery, the docstrings of every room.

`mkdocs.yml` names this file as a hook; `make docs` builds the site.
"""

import ast
import html
import re
from pathlib import Path
from typing import NamedTuple

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "covariant"
GALLERY = ROOT / "gallery"
IMAGES = ROOT / "docs" / "images"
WITHOUT_PAGE = ("cli", "papers")
LATER = "---\nsearch:\n  boost: 0.5\n---\n\n"
"""Head of a page that the search lists behind those that explain."""


def front_page(readme: str) -> str:
    """The README with its links as seen from within `docs`."""
    return re.sub(r"\]\(docs/", "](", readme).replace("[docs/", "[")


class Script(NamedTuple):
    """A script of the gallery: its page, its source, its figure if any, and what its docstring says.

    The paragraph of the docstring that begins with "Figure:" is the caption, with the number that the figure shows.
    """

    path: Path
    title: str
    text: str
    caption: str
    source: str
    figure: Path | None

    @property
    def page(self) -> str:
        return f"gallery/{self.path.stem}.md"

    @property
    def name(self) -> str:
        words = _subject(self.path).replace("_", " ").capitalize()
        return words.replace(" imu", " IMU").replace(" panda", " Panda")


def _subject(path: Path) -> str:
    """Name of a script without its number."""
    return re.sub(r"^\d+_", "", path.stem)


def gallery() -> list[Script]:
    """The numbered scripts of the gallery and the demos, in order."""
    return [_script(path) for path in [*sorted(GALLERY.glob("[0-9]*.py")), *sorted(GALLERY.glob("demo*.py"))]]


def _script(path: Path) -> Script:
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    title, _, text = (ast.get_docstring(tree) or path.stem).partition("\n")
    lines = source.splitlines(keepends=True)[tree.body[0].end_lineno :]  # behind the docstring, which the page shows
    paragraphs = text.strip().split("\n\n")
    caption = " ".join(p.removeprefix("Figure: ").replace("\n", " ") for p in paragraphs if p.startswith("Figure: "))
    text = "\n\n".join(p for p in paragraphs if not p.startswith("Figure: "))
    return Script(path, title.removesuffix("."), text, caption, "".join(lines).strip() + "\n", _figure(path))


def _figure(path: Path) -> Path | None:
    """The figure that is in `docs`, or else the one that the script has drawn here."""
    subject = _subject(path)
    places = (
        IMAGES / f"{subject}.png",
        IMAGES / f"{subject.removeprefix('demo_')}.png",
        GALLERY / f"out/{path.stem}.png",
    )
    return next((place for place in places if place.exists()), None)


def gallery_page(script: Script) -> str:
    """The page of one script: what it shows, its figure, and its source."""
    picture = f"![{script.title}]({_picture(script)})\n\n" if script.figure else ""
    picture += f"*{script.caption}*\n\n" if script.caption else ""
    run = f"`python gallery/{script.path.name}`, in a checkout, runs this script"
    run += " and draws its figure.\n" if script.figure else ".\n"
    source = f"## Source {{ data-search-exclude }}\n\n```python\n{script.source}```\n"  # found by words, not by names
    return f"{LATER}# {script.title}\n\n{script.text}\n\n{picture}{run}\n{source}"


def _picture(script: Script) -> str:
    """Link to the figure, from a page of the gallery."""
    assert script.figure is not None
    return f"../images/{script.figure.name}" if script.figure.parent == IMAGES else f"out/{script.figure.name}"


def gallery_index(scripts: list[Script]) -> str:
    """The page that lists the scripts."""
    cards = "\n".join(_card(script) for script in scripts)
    text = "Short scripts that each teach one topic, with the figures that they draw."
    return f'# Gallery\n\n{text}\n\n<div class="cards">\n{cards}\n</div>\n'


def _card(script: Script) -> str:
    """A link with the figure, the title and the caption."""
    picture = f'<img class="card" loading="lazy" alt="" src="{_picture(script)}">' if script.figure else ""
    title, caption = html.escape(script.title), html.escape(script.caption)
    return f'<a href="{script.path.stem}.html">{picture}<strong>{title}</strong><span>{caption}</span></a>'


def rooms() -> dict[str, list[str]]:
    """The public names of every room, from its text; none where everything without an underscore is public."""
    paths = [*PACKAGE.glob("*/**/__init__.py"), *PACKAGE.glob("[!_]*.py")]
    found = {".".join(p.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): names(p) for p in paths}
    return {room: listed for room, listed in sorted(found.items()) if room not in WITHOUT_PAGE}


def names(path: Path) -> list[str]:
    """What a room's stub, or a file, lists in `__all__`."""
    stub = path.with_suffix(".pyi")
    for node in ast.parse((stub if stub.exists() else path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def reference(room: str, listed: list[str]) -> str:
    """The page of one room."""
    options = "    options:\n      members:\n" + "".join(f"        - {name}\n" for name in listed) if listed else ""
    return f"{LATER}# covariant.{room}\n\n::: covariant.{room}\n{options}"


def on_config(config: MkDocsConfig) -> None:
    """Put gallery and reference into the navigation, before and behind the notation."""
    assert config.nav is not None
    place = next(k for k, entry in enumerate(config.nav) if "Notation" in entry)
    pages = [{script.name: script.page} for script in gallery()]
    config.nav.insert(place + 1, {"API reference": [{f"covariant.{room}": f"reference/{room}.md"} for room in rooms()]})
    config.nav.insert(place, {"Gallery": [{"All scripts": "gallery/index.md"}, *pages]})


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the pages that are not in `docs`, and the figures drawn here that they show."""
    scripts = gallery()
    llms = (ROOT / "llms.txt").read_text(encoding="utf-8")
    text = {
        "index.md": front_page((ROOT / "README.md").read_text(encoding="utf-8")),
        "llms.txt": re.sub(r"\]\(docs/(.+?)\.md\)", r"](\1.html)", llms),
        "gallery/index.md": gallery_index(scripts),
    }
    text |= {script.page: gallery_page(script) for script in scripts}
    text |= {f"reference/{room}.md": reference(room, listed) for room, listed in rooms().items()}
    for name, content in text.items():
        files.append(File.generated(config, name, content=content))
    for figure in {script.figure for script in scripts if script.figure and script.figure.parent != IMAGES}:
        files.append(File.generated(config, f"gallery/out/{figure.name}", abs_src_path=str(figure)))


def _unbroken(code: str) -> str:
    """Code whose words with hyphens stay whole, those apart that are longer than a narrow column."""
    return re.sub(r"(?<!\S)[^\s-]{0,20}(?:-[^\s-]{0,20}){1,3}(?=\s|$)", r'<span class="whole">\g<0></span>', code)


def on_page_content(html: str, **_: object) -> str:  # the name is that of the hook
    """Let every figure open on its own, which a small screen needs, and break no option or name at its hyphens."""
    inline = r"(?<!</span>)(?<!<pre>)<code>([^<]+)</code>"
    html = re.sub(inline, lambda code: f"<code>{_unbroken(code[1])}</code>", html)
    return re.sub(r'<img (?!class="card")[^>]*?src="([^"]+)"[^>]*>', r'<a href="\1">\g<0></a>', html)
