"""Lines of code of every room, and how many each verb reaches through imports: `python tools/sizes.py`.

Counted are lines that are neither blank nor comments nor docstrings, also in templates. An import of a name from a room
counts only the file that defines it, which the stub of the room tells, since rooms load their files on first use.
"""

import ast
import functools
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src"
COMMENTS = ("#", "//", "/*", "*/", "* ", "<!--")


@functools.cache
def code_lines(path: Path) -> int:
    """The lines of code of a file of the library, or of a template."""
    text = path.read_text(encoding="utf-8")
    lines = {k for k, line in enumerate(text.split("\n"), 1) if line.strip() and not line.strip().startswith(COMMENTS)}
    if path.suffix != ".py" or path.parent.name == "templates":
        return len(lines)
    return len(lines.difference(*(range(node.lineno, node.end_lineno + 1) for node in _docstrings(_tree(path)))))


@functools.cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _docstrings(tree: ast.AST) -> Iterator[ast.Expr]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node


def rooms() -> dict[str, int]:
    """Lines of code of `scalargraph` and of each room; those of the files beside the rooms are `common`."""
    lines: Counter[str] = Counter()
    for path in SOURCE.rglob("*"):
        if path.is_file() and (path.suffix == ".py" or path.parent.name == "templates"):
            package, *folders = path.relative_to(SOURCE).parent.parts
            room = package if package != "covariant" else folders[0] if folders else "common"
            lines[room] += code_lines(path)
    return dict(lines.most_common())


def verbs() -> dict[str, int]:
    """Lines of code that each verb reaches."""
    lines = {name: code_lines(path) for name, path in modules().items()}
    files = [name for name in modules() if name.startswith("covariant.verbs._")]
    return {name.rpartition("._")[2]: sum(lines[each] for each in reached(name)) for name in sorted(files)}


@functools.cache
def modules() -> dict[str, Path]:
    """Files by the full names of their modules."""
    paths = [path for path in SOURCE.rglob("*.py") if path.parent.name != "templates"]
    names = [path.relative_to(SOURCE).with_suffix("").parts for path in paths]
    return {".".join(name).removesuffix(".__init__"): path for name, path in zip(names, paths, strict=True)}


@functools.cache
def _offered(room: str) -> dict[str, tuple[str, str]]:
    """Module and name of all that the stub of a room, if it has one, imports."""
    stub = modules()[room].with_suffix(".pyi")
    tree = ast.parse(stub.read_text(encoding="utf-8") if stub.exists() and stub.stem == "__init__" else "")
    nodes = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (_absolute(room, node), alias.name) for node in nodes for alias in node.names}


def _absolute(package: str, node: ast.ImportFrom) -> str:
    base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
    return ".".join([*base, *filter(None, [node.module])])


def _defining_module(module: str, name: str) -> str:
    """The module that defines a name which `module` offers."""
    if f"{module}.{name}" in modules():
        return f"{module}.{name}"
    there = _offered(module).get(name) if module in modules() else None
    return _defining_module(*there) if there else module


@functools.cache
def imports(module: str) -> frozenset[str]:
    """The modules that one imports anywhere, inside functions and for types alone too."""
    path = modules()[module]
    nodes = [*ast.walk(_tree(path))]
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found, local = set(), dict[str, str]()
    for node in nodes:
        if isinstance(node, ast.Import):
            local |= {alias.asname: alias.name for alias in node.names if alias.asname}
            local |= {name.partition(".")[0]: name.partition(".")[0] for name in (a.name for a in node.names)}
            found |= {alias.name for alias in node.names if "." in alias.name}
        elif isinstance(node, ast.ImportFrom):
            source = _absolute(package, node)
            for alias in node.names:
                place = _defining_module(source, alias.name)
                found.add(place)
                if place == f"{source}.{alias.name}":
                    local[alias.asname or alias.name] = place
    for node in nodes:
        if isinstance(node, ast.Attribute):
            found |= _used(node, local)
    return frozenset(name for name in found & modules().keys() - {module} if not _is_room(name))


def _is_room(name: str) -> bool:
    """Whether a module only offers names, so that what is used of it is counted where it is defined."""
    return modules()[name].name == "__init__.py" and bool(_offered(name))


def _used(node: ast.expr, local: dict[str, str]) -> set[str]:
    """The module that `room.name` takes a name from."""
    parts = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    place = local.get(node.id, "") if isinstance(node, ast.Name) else ""
    for part in reversed(parts):
        if place not in modules() or modules()[place].name != "__init__.py":
            break
        place = _defining_module(place, part)
    return {place} if place else set()


def names() -> int:
    """Number of names that rooms offer each other and users, by the stubs of `scalargraph` and of each room."""
    rooms = [
        name for name in modules() if name == "scalargraph" or (name.startswith("covariant.") and name.count(".") == 1)
    ]
    return sum(len(_offered(name)) for name in rooms)


def reached(module: str) -> set[str]:
    """All modules that one needs, directly or through others."""
    found, rest = set(), [module]
    while rest:
        name = rest.pop()
        if name not in found:
            found.add(name)
            rest += imports(name)
    return found


def main() -> None:
    """Print the number of names and both tables."""
    lines = rooms()
    counted = lines | {"in all": sum(lines.values())}
    print(f"{names():7d}  names in stubs")
    for title, table in (("lines of code", counted), ("lines that a verb reaches", verbs())):
        print(title, *(f"{count:7d}  {name}" for name, count in table.items()), sep="\n")


if __name__ == "__main__":
    main()
