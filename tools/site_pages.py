"""What the site has beside the pages in `docs`: the README, the scripts of the gallery, the docstrings of every room.

`mkdocs.yml` names this file as a hook; `make docs` builds the site.
"""

import ast
import re
import tomllib
from pathlib import Path
from typing import NamedTuple

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

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
    "logs.md": ["encoder resolution", "quantisation", "quantization", "encoder ticks", "CSV", "rosbag"],
    "observers.md": ["residual", "innovation", "outliers", "Kalman filter", "delay", "time delay"],
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
    """A script of the gallery: its page, its title and text from its docstring, its source, and its figure if any."""

    path: Path
    title: str
    text: str
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
    return Script(path, title.removesuffix("."), text.strip(), "".join(lines).strip() + "\n", _figure(path))


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
    lines = [f"- [{script.name}]({Path(script.page).name}): {script.title}" for script in scripts]
    return "# Gallery\n\nShort scripts that each teach one topic, with the figures that they draw.\n\n" + "\n".join(
        lines
    )


def rooms() -> dict[str, list[str]]:
    """The public names of every room, in the order of `docs/api.md`; the rooms that it does not have come last.

    A room without names shows everything without an underscore.
    """
    paths = [*PACKAGE.glob("*/**/__init__.py"), *PACKAGE.glob("[!_]*.py")]
    found = {".".join(p.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): p for p in paths}
    order = api_order()
    last = sorted(set(found) - set(order) - set(WITHOUT_PAGE))
    return {"": order[""]} | {
        room: sorted_names(names(found[room]), order.get(room, [])) for room in [*order, *last] if room
    }


def api_order() -> dict[str, list[str]]:
    """Rooms and names in the order of the page `docs/api.md`; the package itself, with the verbs, is the room ""."""
    page = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    parts = re.split(r"^## covariant\.?", page, flags=re.MULTILINE)[1:]
    return {part.partition("\n")[0]: re.findall(r"^- \*\*`(\w+)`\*\*", part, re.MULTILINE) for part in parts}


def sorted_names(listed: list[str], order: list[str]) -> list[str]:
    """Names in an order, with those that it lacks behind it."""
    return [name for name in order if name in listed] + [name for name in listed if name not in order]


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
    title = f"covariant.{room}".removesuffix(".")
    return f"{LATER}# {title}\n\n::: {title}\n{options}"


def on_config(config: MkDocsConfig) -> None:
    """Put the gallery and the reference into the navigation, and the version into the foot of every page."""
    assert config.nav is not None
    place = next(k for k, entry in enumerate(config.nav) if "API" in entry)
    pages = [{script.name: script.page} for script in gallery()]
    public, reference = len(api_order()), [{title: page} for page, title in _reference_pages().items()]
    config.nav[place]["API"] += [*reference[:public], {"Inside the library": reference[public:]}]
    config.nav.insert(place, {"Gallery": [{"All scripts": "gallery/index.md"}, *pages]})
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    config.copyright = f"covariant {version} · BSD-3-Clause"


def _reference_pages() -> dict[str, str]:
    """The page of each room, with its title."""
    titles = [f"covariant.{room}".removesuffix(".") for room in rooms()]
    return {f"reference/{title.removeprefix('covariant.')}.md": title for title in titles}


def on_page_markdown(markdown: str, page: Page, **_: object) -> None:
    """Let the search list guides first, and find them by the words that others use."""
    if page.file.src_uri in SEARCHED:
        page.meta["tags"] = SEARCHED[page.file.src_uri]
    if page.file.src_uri.count("/") == 0:
        page.meta.setdefault("search", {"boost": 2})


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
    text |= dict(zip(_reference_pages(), (reference(*room) for room in rooms().items()), strict=True))
    for name, content in text.items():
        files.append(File.generated(config, name, content=content))
    for figure in {script.figure for script in scripts if script.figure and script.figure.parent != IMAGES}:
        files.append(File.generated(config, f"gallery/out/{figure.name}", abs_src_path=str(figure)))


def _unbroken(code: str) -> str:
    """Code whose words with hyphens stay whole, those apart that are longer than a narrow column."""
    return re.sub(r"(?<!\S)[^\s-]{0,20}(?:-[^\s-]{0,20}){1,3}(?=\s|$)", r'<span class="whole">\g<0></span>', code)


def on_page_content(html: str, **_: object) -> str:
    """Let every figure open on its own, which a small screen needs, and break no option or name at its hyphens."""
    inline = r"(?<!</span>)(?<!<pre>)<code>([^<]+)</code>"
    html = re.sub(inline, lambda code: f"<code>{_unbroken(code[1])}</code>", html)
    return re.sub(r'<img [^>]*?src="([^"]+)"[^>]*>', r'<a href="\1">\g<0></a>', html)
