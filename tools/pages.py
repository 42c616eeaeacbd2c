"""The parts of the pages that are written from code and results: tables, misprints, the house, `llms.txt`.

    python tools/pages.py

writes them into `docs`, and the tests fail where they are not up to date.
"""

import ast
import importlib
import inspect
import itertools
import re
import tomllib
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from types import ModuleType

from house import drawing
from peers.page import page as peers_page

from covariant.models import ModelFile
from covariant.models.files._model_file import KEYS
from covariant.observers import REGISTRY, Entry
from covariant.papers import errata

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

NUMBERS = {
    "gains": "α, β",
    "gains and force": "α, β, ρ",
    "gains and speed": "α, β, V",
    "noise": "covariances",
    "noise or ticks": "covariances, quantum",
    "bandwidth": "bandwidth",
    "window": "window, order",
    "motion": "motion, noise",
    "jerk": "jerk",
    "loop": "bandwidth",
    "state noise": "covariances, first estimate",
}
PAPERS = ("aghannan-rouchon", "maithripala", "sanfelice-praly", "jouffroy-fossen")
"""Papers with a page of their own, whose file has the paper's name."""


def observers_table(entries: tuple[Entry, ...] = REGISTRY) -> str:
    """The registry as a Markdown table; what an entry fits is the first line of its predicate's docstring."""
    head = "| name | in Python | what it is | when | for | set by | source |"
    return "\n".join([head, "|---" * 7 + "|", *map(_row, entries)])


def _row(entry: Entry) -> str:
    fits = (entry.fits.__doc__ or "").strip().split("\n")[0].removesuffix(".")
    cells = entry.about, entry.when, fits[:1].lower() + fits[1:], NUMBERS[entry.tuned_by], entry.source
    return f"| `{entry.name}` | `{entry.observer.__name__}` | {' | '.join(cells)} |"


def keys_table() -> str:
    """The keys of a model file as a Markdown table; what each means is in the docstring of `ModelFile`."""
    listed = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", inspect.cleandoc(ModelFile.__doc__ or ""), re.MULTILINE)
    meanings = {field: " ".join(text.split()) for field, text in listed}
    values = {name: re.sub(r", or a list with one for each \w+", " or list", key.values) for name, key in KEYS.items()}
    rows = [f"| `{key.path}` | {values[name]}{_default(name)} | {meanings[name]} |" for name, key in KEYS.items()]
    return "\n".join(["| key | value (default) | meaning |", "|---|---|---|", *rows])


def _default(field: str) -> str:
    value = ModelFile._field_defaults[field]
    return f' ("{value}")' if isinstance(value, str) else f" ({value:.4g})" if isinstance(value, float | int) else ""


def errata_sections(paper: str) -> str:
    """The misprints of a paper, each with both formulas, what is wrong and its effect; tests are in `papers.toml`."""
    return "\n\n".join(map(_erratum, errata.of(paper)))


def _erratum(entry: errata.Erratum) -> str:
    lines = (
        f"### Misprint in {entry.where}\n",
        f"- *as printed:* `{entry.printed}`",
        f"- *corrected:* `{entry.corrected}`",
        f"- *reason:* {entry.reason}",
        f"- *effect:* {entry.effect}",
    )
    return "\n".join(lines)


def papers_tables() -> str:
    """Every item of the four papers in `papers.toml`, with its code, its test and its page."""
    papers = tomllib.loads((DOCS / "papers.toml").read_text(encoding="utf-8"))
    return "\n\n".join(_paper_table(paper["title"], paper["rows"]) for paper in papers.values())


def _paper_table(title: str, rows: list[list[str]]) -> str:
    head = ["| in the paper | what it is | code | test |", "|---" * 4 + "|"]
    return "\n".join([f"## {title}", "", *head, *(_paper_row(*row) for row in rows)])


def _paper_row(place: str, subject: str, code: str, test: str, page: str) -> str:
    named = subject.replace("misprint", "**misprint**")
    cells = (place, f"[{named}]({page})" if page else named, f"`{code}`" if code else "", _paper_test(test))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _paper_test(test: str) -> str:
    """A test by its path; a drawing, an open question and what is not done in words."""
    state, _, reason = test.partition(": ")
    if state in ("not done", "open"):
        return f"*{state}*: {reason}"
    return "*a drawing*" if test == "drawing" else f"`{test}`"


def benchmarks_table() -> str:
    """Every script and study in `benchmarks` with the first sentence of its text, and the pages with its numbers."""
    folder = ROOT / "benchmarks"
    paths = [path for kind in ("*.py", "*/__main__.py", "studies/*.toml") for path in sorted(folder.glob(kind))]
    named = [(_script(path.relative_to(folder)), text) for path in paths if (text := _about(path))]
    rows = [f"| `{name}` | {_sentence(text)} | {_pages_with(name)} |" for name, text in named]
    return "\n".join(["| script | what it measures | numbers |", "|---|---|---|", *rows])


def _script(path: Path) -> str:
    """A script by its path, a folder that runs as one by its name."""
    return (path.parent if path.stem == "__main__" else path).as_posix()


def _about(path: Path) -> str:
    """Docstring of a script, empty for one that others only import, or the first lines of a study."""
    if path.suffix == ".toml":
        lines = itertools.takewhile(lambda line: line.startswith("#"), path.read_text("utf-8").splitlines())
        return " ".join(line.lstrip("# ") for line in lines)
    return "" if path.stem in ("conftest", "moments") else ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""


def _pages_with(script: str) -> str:
    pages = [page for page in sorted(DOCS.glob("*.md")) if page.stem != "benchmarks"]
    name = f"{Path(script).name}`" if script.endswith(".toml") else f"benchmarks/{script}"
    found = [page for page in pages if name in page.read_text(encoding="utf-8")]
    return ", ".join(f"[{page.stem}]({page.name})" for page in found) or (
        "`make bench`"
        if script.startswith("test_")
        else f"`covariant sweep benchmarks/{script}`"
        if script.endswith(".toml")
        else f"`python benchmarks/{script}`"
    )


def llms_text() -> str:
    """`llms.txt`: what the library is, and every page of the site with one line."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    pages = [DOCS / name for name in navigation() if name != "index.md"]
    lines = [f"- [{_title(page)}](docs/{page.name}): {_opening(page)}" for page in pages]
    return "\n".join(["# covariant", "", f"> {_paragraph(readme)}", "", "## Pages", "", *lines, ""])


VERBS = ("check", "fit", "tune", "estimate", "smooth", "compare", "simulate", "design_excitation", "export", "certify")
"""The verbs in the order in which a user meets them."""
ROOMS = {
    "api.md": (
        *("covariant", "covariant.models", "covariant.models.robots", "covariant.models.marine"),
        *("covariant.observers", "covariant.logs", "covariant.simulation", "covariant.calibration", "covariant.engine"),
    ),
    "api-geometry.md": (
        *("covariant.codegen", "covariant.certificates", "covariant.geometry", "covariant.geometry.lie"),
        *("covariant.metrics", "covariant.verbs", "covariant.many", "covariant.report", "scalargraph"),
    ),
}
"""Rooms with public names, by their page, in the order in which a user meets them."""
HEADS = {
    "api.md": """# API

The names for users, each with the first sentence of its docstring; the rooms for geometry, proofs and code are on
[API: geometry, proofs and code](api-geometry.md). `help(name)` prints the whole docstring, and the site links to it.
The changelog says when a name changes. Other names can be imported, but serve the library itself.""",
    "api-geometry.md": """# API: geometry, proofs and code

The names for users in the rooms that [API](api.md) does not have.""",
}


def api_page(name: str) -> str:
    """The first sentence of every public name's docstring, room by room; the site adds links to the whole of them."""
    return "\n\n".join([HEADS[name], *map(_api_of, ROOMS[name])]) + "\n"


def _api_of(room: str) -> str:
    module = importlib.import_module(room)
    if room == "covariant":
        assert set(VERBS) == {name for name in module.__all__ if inspect.isfunction(getattr(module, name))}
        names = [*VERBS, "Record", "Run", "StepCode"]
    else:
        names = [name for name in module.__all__ if not inspect.ismodule(getattr(module, name))]
        names.sort(key=partial(_use, module))
    entries = [f"- **`{name}`**: {_sentence(_documentation(module, name))}." for name in names]
    return "\n".join([f"## {room}", "", _about_room(module), "", *entries])


def _use(module: ModuleType, name: str) -> tuple[bool, str]:
    """Key of the order in which a user looks for names: constants and what is to be inherited from come last."""
    return name.startswith("Abstract") or not callable(getattr(module, name)), name.lower()


def _about_room(module: ModuleType) -> str:
    text = _sentence(module.__doc__ or "")
    subject = text.partition(": ")[2] or text
    return f"{subject[:1].upper()}{subject[1:]}."


def _documentation(module: ModuleType, name: str) -> str:
    """Docstring of a public name; of a constant, the string after its assignment in one of the room's files."""
    value = getattr(module, name)
    if not isinstance(value, tuple) or isinstance(value, type):
        return inspect.getdoc(value) or ""
    for path in sorted(Path(module.__file__ or "").parent.rglob("*.py")):
        for assignment, text in pairwise(ast.parse(path.read_text(encoding="utf-8")).body):
            match assignment, text:
                case ast.Assign(targets=[ast.Name(id=target)]), ast.Expr(value=ast.Constant(value=str(words))):
                    if target == name:
                        return inspect.cleandoc(words)
    return ""


def navigation() -> list[str]:
    """Names of the pages in the order in which the site has them."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[-1]
    return re.findall(r"^ *- (?:.*: )?([\w-]+\.md)", text, re.MULTILINE)


def _title(page: Path) -> str:
    return page.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")


def _opening(page: Path) -> str:
    return _sentence(_paragraph(page.read_text(encoding="utf-8")))


def _paragraph(text: str) -> str:
    """First paragraph of a page behind its title, as one line without links."""
    prose = next(part for part in text.split("\n\n")[1:] if re.match(r"[\w`*\[]", part))
    return re.sub(r"\[(.+?)\]\(.+?\)", r"\1", " ".join(prose.split()))


def _sentence(text: str) -> str:
    """First sentence of a text, in one line and without its full stop."""
    return re.split(r"(?<=[^.\d][.?])\s|(?<=C99\.)\s", " ".join(text.split()))[0].removesuffix(".")


def with_table(page: str, name: str, table: str) -> str:
    """The page with what stands between `<!-- name -->` and `<!-- end -->` replaced."""
    begin, end = f"<!-- {name}: written by tools/pages.py -->", "<!-- end -->"
    return re.sub(f"{begin}.*?{end}", lambda _: f"{begin}\n\n{table}\n\n{end}", page, flags=re.DOTALL)


def _page(path: Path, name: str, table: Callable[[], str]) -> str:
    return with_table(path.read_text(encoding="utf-8"), name, table())


PARTS: dict[str, tuple[str, Callable[[], str]]] = {
    "observers.md": ("observers", observers_table),
    "models.md": ("keys", keys_table),
    "benchmarks.md": ("benchmarks", benchmarks_table),
    "papers.md": ("papers", papers_tables),
    **{f"{paper}.md": ("errata", partial(errata_sections, paper)) for paper in PAPERS},
}
"""Pages with a part that is written from the code: the part's name, and what makes its text."""

WRITTEN: dict[Path, Callable[[], str]] = {
    **{DOCS / name: partial(_page, DOCS / name, *part) for name, part in PARTS.items()},
    DOCS / "peers.md": peers_page,
    DOCS / "images" / "house.svg": lambda: drawing(ROOT / "src" / "covariant"),
    **{DOCS / name: partial(api_page, name) for name in ROOMS},
    ROOT / "llms.txt": llms_text,
}
"""Every file that is written, from the code or from results, with what makes the text it should have."""


if __name__ == "__main__":
    for path, text in WRITTEN.items():
        path.write_text(text(), encoding="utf-8")
        print(f"wrote {path.relative_to(ROOT)}")
