"""What the site has beside the pages in `docs`: the README as its front page, and a page of docstrings for every room.

`mkdocs.yml` names this file as a hook; `make docs` builds the site.
"""

import ast
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "covariant"
WITHOUT_PAGE = ("cli", "papers")


def front_page(readme: str) -> str:
    """The README with its links as seen from within `docs`."""
    return re.sub(r"\]\(docs/", "](", readme)


def rooms() -> dict[str, list[str]]:
    """The public names of every room, from its text; none where everything without an underscore is public."""
    paths = [*PACKAGE.glob("*/**/__init__.py"), *PACKAGE.glob("[!_]*.py")]
    found = {".".join(p.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): names(p) for p in paths}
    return {room: listed for room, listed in sorted(found.items()) if room not in WITHOUT_PAGE}


def names(path: Path) -> list[str]:
    """What a room's stub imports, or a file lists in `__all__`."""
    stub = path.with_suffix(".pyi")
    if stub.exists():
        nodes = (node for node in ast.parse(stub.read_text(encoding="utf-8")).body if isinstance(node, ast.ImportFrom))
        return sorted(alias.name for node in nodes if node.module for alias in node.names)  # rooms have their own page
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def reference(room: str, listed: list[str]) -> str:
    """The page of one room."""
    options = "    options:\n      members:\n" + "".join(f"        - {name}\n" for name in listed) if listed else ""
    return f"# covariant.{room}\n\n::: covariant.{room}\n{options}"


def on_config(config: MkDocsConfig) -> None:
    assert config.nav is not None
    config.nav.append({"Reference": [{f"covariant.{room}": f"reference/{room}.md"} for room in rooms()]})


def on_files(files: Files, config: MkDocsConfig) -> None:
    text = {"index.md": front_page((ROOT / "README.md").read_text(encoding="utf-8"))}
    text |= {f"reference/{room}.md": reference(room, listed) for room, listed in rooms().items()}
    for name, content in text.items():
        files.append(File.generated(config, name, content=content))
