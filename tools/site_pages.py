"""What the site has beside the pages in `docs`: README, scripts and notebooks of the gallery, docstrings of every room.

`mkdocs.yml` names this file as a hook; `make docs` builds the site.
"""

import ast
import html
import re
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from nbconvert import MarkdownExporter

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "covariant"
GALLERY = ROOT / "gallery"
IMAGES = ROOT / "docs" / "images"
WITHOUT_PAGE = ("cli", "papers")
LATER = "---\nsearch:\n  boost: 0.5\n---\n\n"
"""Head of a page that the search lists behind those that explain."""
SEARCHED = {
    "forces.md": ["external torque", "external force", "disturbance observer", "contact force", "collision", "wrench"],
    "identification.md": ["system identification", "parameter estimation", "friction", "inertia", "calibration"],
    "fit-robots.md": ["excitation", "friction", "servo", "payload", "armature"],
    "logs.md": ["encoder resolution", "quantisation", "quantization", "encoder ticks", "CSV", "rosbag"],
    "observers.md": ["state estimation", "state observer"],
    "estimates.md": ["residual", "innovation", "consistency"],
    "intrinsic-kalman.md": ["Kalman filter", "invariant filter"],
    "slow-states.md": ["bias estimation", "augmented state", "payload"],
    "outliers.md": ["outliers", "fault detection"],
    "holes-and-delays.md": ["delay", "time delay", "missing data", "dropout"],
    "certificates.md": ["proof", "stability", "contraction"],
    "smoothing.md": ["offline", "Rauch–Tung–Striebel", "RTS smoother", "fixed lag", "zero phase"],
    "step-by-hand.md": ["Python API", "real time", "stream"],
    "tuning.md": ["noise covariance", "Q and R", "observer gains", "maximum likelihood"],
    "without-a-model.md": ["Savitzky–Golay", "tracking loop", "PLL", "filtered derivative", "lag"],
    "ekf.md": ["EKF", "extended Kalman filter", "UKF"],
    "firmware.md": ["microcontroller", "embedded", "Arduino", "C code"],
    "ros.md": ["ROS 2", "JointState"],
    "fmu.md": ["Simulink", "Modelica"],
    "robots.md": ["URDF", "MJCF", "MuJoCo"],
}
"""Words under which the search finds a page, beside those that it has."""


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
    caption = caption[:1].upper() + caption[1:]
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


class Notebook(NamedTuple):
    """A notebook of the gallery, and its title."""

    path: Path
    title: str

    @property
    def page(self) -> str:
        return f"gallery/{self.path.stem}.md"


def notebooks() -> list[Notebook]:
    """The notebooks of the gallery; the first cell of each begins with its title."""
    found = sorted(GALLERY.glob("*.ipynb"))
    return [
        Notebook(path, nbformat.read(path, as_version=4).cells[0].source.partition("\n")[0].removeprefix("# "))
        for path in found
    ]


def notebook_page(notebook: Notebook) -> str:
    """The page of one notebook as it is stored, without its outputs: to run them all takes longer than the site."""
    text, _ = MarkdownExporter().from_filename(str(notebook.path))
    run = (
        f"`jupyter lab gallery/{notebook.path.name}`, in a checkout, opens this notebook; run it to see its results.\n"
    )
    return f"{LATER}{text}\n\n{run}"


def gallery_index(scripts: list[Script]) -> str:
    """The page that lists the notebooks and the scripts."""
    cards = "\n".join(_card(script) for script in scripts)
    links = "\n".join(f"- [{each.title}]({each.path.stem}.md)" for each in notebooks())
    text = f"Notebooks:\n\n{links}\n\n"
    text += "Short scripts that each teach one topic, with the figures that they draw."
    return f'# Gallery\n\n{text}\n\n<div class="cards">\n{cards}\n</div>\n'


def _card(script: Script) -> str:
    """A link with the figure, the title and the caption."""
    picture = f'<img class="card" loading="lazy" alt="" src="{_picture(script)}">' if script.figure else ""
    title, caption = (re.sub("`(.+?)`", r"<code>\1</code>", html.escape(t)) for t in (script.title, script.caption))
    return f'<a href="{script.path.stem}.html">{picture}<strong>{title}</strong><span>{caption}</span></a>'


@cache
def defined() -> set[str]:
    """Names of the classes of the library and of scalargraph."""
    sources = (path.read_text(encoding="utf-8") for path in PACKAGE.parent.rglob("*.py"))
    return {name for source in sources for name in re.findall(r"^class (\w+)", source, re.MULTILINE)}


class Room(NamedTuple):
    """A room of the library: its full name, and its public names in the order of `docs/api*.md`.

    `about` has the first sentence of each name that is for users. Their classes have a page each.
    """

    title: str
    listed: list[str]
    about: dict[str, str]

    @property
    def page(self) -> str:
        return f"reference/{self.title.removeprefix('covariant.')}.md"

    @property
    def classes(self) -> dict[str, str]:
        """Page of each class for users."""
        return {name: f"{self.page.removesuffix('.md')}/{name}.md" for name in self.about if name in defined()}


def rooms() -> list[Room]:
    """The rooms for users in the order of `docs/api*.md`, and behind them the others."""
    users = listed()
    paths = [*PACKAGE.glob("*/**/__init__.py"), *PACKAGE.glob("[!_]*.py")]
    found = {
        ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in paths
    }
    rest = sorted(set(found) - set(users) - {f"covariant.{name}" for name in WITHOUT_PAGE})
    return [Room(title, list(about), about) for title, about in users.items()] + [
        Room(title, names(found[title]), {}) for title in rest
    ]


API = [ROOT / "docs" / "api.md", ROOT / "docs" / "api-geometry.md"]
ROOM = re.compile(r"^## (covariant[\w.]*|scalargraph)\n", re.MULTILINE)
ENTRY = re.compile(r"^- \*\*`(\w+)`\*\*: (.+)$", re.MULTILINE)


def listed() -> dict[str, dict[str, str]]:
    """First sentence of each name in each room of `docs/api*.md`."""
    parts = [part for page in API for part in ROOM.split(page.read_text(encoding="utf-8"))[1:]]
    return {room: dict(ENTRY.findall(text)) for room, text in zip(parts[::2], parts[1::2], strict=True)}


def linked(markdown: str) -> str:
    """A page of `docs/api*.md` with a link from each room to its reference, and from each name to its docstring."""
    head, *parts = ROOM.split(markdown)
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        page = Room(name, [], {}).page
        entries = ENTRY.sub(rf"- **[`\1`][{name}.\1]**: \2", text)
        head += f"## {name}\n\n[Reference of `{name}`]({page})\n{entries}"
    return head


def names(path: Path) -> list[str]:
    """What a room's stub, or a file, lists in `__all__`; nothing if everything without an underscore is public."""
    stub = path.with_suffix(".pyi")
    for node in ast.parse((stub if stub.exists() else path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def reference(room: Room) -> dict[str, str]:
    """The pages of one room and of its classes."""
    rows = [f"| [`{name}`][{room.title}.{name}] | {text} |\n" for name, text in room.about.items()]
    table = "| name | what it is |\n|---|---|\n" + "".join(rows) + "\n" if rows else ""
    members = [name for name in room.listed if name not in room.classes]
    chosen = "      members:" + ("".join(f"\n        - {name}" for name in members) or " false") if room.listed else ""
    options = f"    options:\n      summary: {'false' if rows else 'true'}\n{chosen}\n"
    head = "    options:\n      heading_level: 1\n      show_root_heading: true\n      show_root_full_path: false\n"
    pages = {page: f"{LATER}::: {room.title}.{name}\n{head}" for name, page in room.classes.items()}
    return {room.page: f"{LATER}# {room.title}\n\n{table}::: {room.title}\n{options}"} | pages


def _entry(room: Room) -> dict:
    """A room in the navigation, and below it its classes."""
    classes = [{name: page} for name, page in room.classes.items()]
    return {room.title: [{"Overview": room.page}, *classes] if classes else room.page}


def on_config(config: MkDocsConfig) -> None:
    """Put the gallery and the reference into the navigation, and the version into the foot of every page."""
    assert config.nav is not None
    place = next(k for k, entry in enumerate(config.nav) if "API" in entry)
    pages = [{each.title: each.page} for each in notebooks()] + [{script.name: script.page} for script in gallery()]
    users, inside = [room for room in rooms() if room.about], [room for room in rooms() if not room.about]
    config.nav[place]["API"] += [*map(_entry, users), {"Inside the library": [*map(_entry, inside)]}]
    config.nav.insert(place, {"Gallery": [{"All of it": "gallery/index.md"}, *pages]})
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    config.copyright = f"covariant {version} · BSD-3-Clause"


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Let the search list guides first, and find them by the words that others use; link names to their docstrings."""
    if page.file.src_uri in SEARCHED:
        page.meta["tags"] = SEARCHED[page.file.src_uri]
    if page.file.src_uri.count("/") == 0:
        page.meta.setdefault("search", {"boost": 2})
    return linked(markdown) if page.file.src_uri in [path.name for path in API] else markdown


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
    text |= {notebook.page: notebook_page(notebook) for notebook in notebooks()}
    for room in rooms():
        text |= reference(room)
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
