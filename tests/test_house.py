"""The house rules: who may import whom, what loads with the package, and which names are public."""

import ast
import functools
import graphlib
import importlib
import importlib.util
import re
import subprocess
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import get_origin

import sizes

import scalargraph

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "covariant"

PLAN = (
    "_errors _domains _door _programs _version _typing _gauss_markov _functional _optional _cases _numbers _names "
    "signals scoring _linalg _integrate _adaptive lowering logs geometry models metrics observers simulation "
    "certificates calibration codegen engine report papers verbs many cli"
)
"""A room may import from itself, from any room to its left, never to its right, and from `scalargraph`."""


FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent.name != "templates")
"""The modules of the library; a template is one of another program."""
OF_GRAPHS = sorted((SOURCE.parent / "scalargraph").rglob("*.py"))
"""Those of the package beside it, which keeps the same rules but for the order of rooms."""


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


ROOMS = sorted(".".join(path.parent.relative_to(SOURCE).parts) for path in SOURCE.glob("*/**/__init__.pyi"))
"""Rooms and sub-rooms; the stub of each lists what others may import from it."""

PUBLIC = [room for room in ROOMS if "." not in room] + [
    "geometry.lie",
    "models.marine",
    "models.robots",
]
"""Of these, the ones whose names are for users. Those of other sub-rooms are for the rest of the library."""

SUBMODULES = {room: {path.stem for path in (SOURCE / room.replace(".", "/")).glob("[!_]*")} for room in ROOMS}


def place(path: Path) -> str:
    return path.relative_to(SOURCE.parent).as_posix().removeprefix("covariant/")


def room_of(path: Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported(path: Path) -> Iterator[tuple[str, str]]:
    """What a file imports anywhere, inside functions too: the full name, and the name that it has in the file."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.asname or alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((f"{node.module}.{alias.name}", alias.asname or alias.name) for alias in node.names)


def imported_rooms(path: Path) -> set[str]:
    return {name.split(".")[1] for name, _ in imported(path) if name.startswith("covariant.")}


BUDGET = tomllib.loads((ROOT / "tests" / "house.toml").read_text(encoding="utf-8"))
SLACK = 100
"""Lines by which the budget may be larger than the code: what is taken out leaves the budget too."""


def test_no_room_is_larger_than_its_budget_and_the_sum_only_falls():
    lines, budget = sizes.rooms(), BUDGET["lines"]
    assert lines.keys() == budget.keys()
    assert {room: count - budget[room] for room, count in lines.items() if count > budget[room]} == {}
    assert sum(budget.values()) <= BUDGET["most"]
    assert sum(budget.values()) - sum(lines.values()) <= SLACK
    assert sizes.names() <= BUDGET["names"]


def test_files_import_each_other_in_no_circle():
    graphlib.TopologicalSorter({name: sizes.imports(name) for name in sizes.modules()}).prepare()  # or CycleError


def test_a_verb_imports_no_other_verb_and_reaches_no_more_than_it_needs():
    verbs = {f"covariant.verbs._{name}" for name in sizes.verbs()}
    assert {name: others for name in verbs if (others := sizes.reached(name) & verbs - {name})} == {}
    reached, most = sizes.verbs(), BUDGET["reach"]
    assert reached.keys() == most.keys()
    assert {name: count - most[name] for name, count in reached.items() if count > most[name]} == {}


def test_an_import_from_a_room_is_one_of_the_file_that_defines_the_name():
    assert "covariant.verbs._estimate" in sizes.imports("covariant.many._each")
    assert "covariant.many._over_logs" not in sizes.reached("covariant.verbs._estimate")
    assert "covariant.geometry._metric" in sizes.reached("covariant.verbs._estimate")


def test_what_passes_through_the_rooms_enters_none_twice():
    """The ways that `docs/contributing.md` draws follow the order of the plan."""
    page = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
    ways = [re.findall(r"\w+", cells) for cells in re.findall(r"\| (`\w+`(?: → `\w+`)+) \|", page)]
    places = [[PLAN.split().index(room) for room in way] for way in ways]
    assert len(ways) == 3
    assert all(way == sorted(set(way)) for way in places)


def test_kinds_of_models_are_told_apart_by_what_they_offer():
    """At most so many lines ask for the kind of a model: each is a place that a third kind would have to know."""
    kinds = re.compile(r"isinstance\(.*(StateSpace|MechanicalSystem|Lagrangian|GroupSystem|Craft)\b")
    lines = [line for path in FILES + OF_GRAPHS for line in path.read_text(encoding="utf-8").split("\n")]
    asked = [line for line in lines if kinds.search(line)]
    assert len(asked) <= 5, "\n".join(asked)


def makes_statements(path: Path, module: ast.Module) -> bool:
    """Whether a module is one of the certificates, uses one, or makes a statement or a premise itself."""
    called = {ast.unparse(node.func).rpartition(".")[2] for node in ast.walk(module) if isinstance(node, ast.Call)}
    uses = any(name.startswith("covariant.certificates") for name, _ in imported(path))
    return room_of(path) == "certificates" or uses or not called.isdisjoint({"Statement", "Hypothesis"})


def test_a_module_that_makes_a_premise_is_searched_wherever_it_is():
    path = SOURCE / "models" / "_state_space.py"
    assert not makes_statements(path, tree(path))
    assert makes_statements(path, ast.parse("premise = base.Hypothesis('it holds', 'proved')"))
    assert makes_statements(SOURCE / "report" / "_certificate.py", ast.parse(""))


SHARED = {"Product"}
"""A product of spaces is a space, and one of groups a group."""


def test_a_class_is_public_in_one_room_and_defined_once():
    """There is one `Box` and one `Metric`."""
    offered = {room: dir(importlib.import_module(f"covariant.{room}")) for room in PUBLIC}
    public = Counter(name for names in offered.values() for name in names if name[0].isupper())
    assert {name for name, count in public.items() if count > 1} == SHARED
    defined = Counter(name for path in FILES + OF_GRAPHS for name in classes(path))
    assert {name: count for name, count in defined.items() if count > 1 and name in public} == dict.fromkeys(SHARED, 2)
    others = [name for path in FILES + OF_GRAPHS for name in aliases(path)]
    assert not {"Box", "Metric"} & set(others)


def classes(path: Path) -> list[str]:
    return [node.name for node in tree(path).body if isinstance(node, ast.ClassDef)]


def aliases(path: Path) -> Iterator[str]:
    """Names that a file gives to anything at its top level."""
    for node in tree(path).body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


def public_names(room: str) -> list[str]:
    """The names for users of a room: `__all__` of its stub."""
    return [name for name in importlib.import_module(f"covariant.{room}").__all__ if name not in SUBMODULES[room]]


def test_public_names_of_the_package_beside_are_documented():
    assert not [name for name in scalargraph.__all__ if not getattr(scalargraph, name).__doc__]


def undocumented(room: str) -> Iterator[str]:
    module = importlib.import_module(f"covariant.{room}")
    if not module.__doc__:
        yield f"{room} has no docstring"
    for name in public_names(room):
        value = getattr(module, name)
        alias = get_origin(value) is not None  # which cannot have a docstring
        # Python writes a docstring that opens with the call where a dataclass has none.
        if callable(value) and not alias and (not value.__doc__ or value.__doc__.startswith(f"{name}(")):
            yield f"{room}.{name} has no docstring"


def test_public_names_are_documented():
    assert not [what for room in PUBLIC for what in undocumented(room)]


MOST_PUBLIC = 200
"""Public names that a user can survey; python-control has 166."""


def test_public_names_are_few():
    front = set(importlib.import_module("covariant").__all__) - {
        path.name.partition(".")[0] for path in SOURCE.glob("[!_]*")
    }
    names = [*front, *scalargraph.__all__, *(name for room in PUBLIC for name in public_names(room))]
    assert len(names) <= MOST_PUBLIC


def tracked() -> list[str]:
    """Paths of all files in git; none outside a checkout."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    return listed.stdout.splitlines()


def test_no_output_of_a_command_is_a_part_of_the_project():
    outputs = {".csv", ".parquet", ".html", ".png", ".json", ".toml"}
    stray = [name for name in tracked() if "/" not in name and Path(name).suffix in outputs]
    assert stray in ([], ["pyproject.toml"])


def tracked_texts():
    paths = [ROOT / name for name in tracked()] or list(SOURCE.rglob("*"))
    for path in paths:
        if (
            path.is_file()
            and path.suffix in (".py", ".toml", ".md", ".txt", ".yml", ".css", ".js", "")
            and path != Path(__file__)
        ):
            yield path, path.read_text(encoding="utf-8", errors="ignore")


def test_no_file_names_a_package_host_or_a_path_of_one_machine():
    hosts = re.compile(
        r"pypi\.(org|python)|files\.pythonhosted|index-url|find-links[ =]|/root/|(?<![\w.])/(home|work|Users|mnt)/\w",
        re.IGNORECASE,
    )
    allowed = {"Makefile"}  # it switches such lines off
    found = {str(p.relative_to(ROOT)): hosts.search(text) for p, text in tracked_texts() if p.name not in allowed}
    assert not {name: hit.group() for name, hit in found.items() if hit}
    assert "://" not in (ROOT / "constraints.txt").read_text(encoding="utf-8")


def test_scripts_import_names_that_exist():
    """No suite runs all of the gallery and the benchmarks."""
    scripts = [path for folder in ("gallery", "benchmarks", "tools") for path in (ROOT / folder).rglob("*.py")]
    froms = {
        (node.module, alias.name)
        for path in scripts
        for node in ast.walk(tree(path))
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in ("covariant", "scalargraph")
        for alias in node.names
    }
    missing = [
        f"{module}.{name}"
        for module, name in sorted((str(module), name) for module, name in froms)
        if not hasattr(importlib.import_module(module), name) and importlib.util.find_spec(f"{module}.{name}") is None
    ]
    assert missing == []


def test_files_of_tests_in_two_folders_have_two_names():
    """Pytest imports them by their name alone, so of two it would run one."""
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py") if path.name != "conftest.py")
    assert [name for name, count in names.items() if count > 1] == []


def test_what_make_quick_runs_is_there():
    text = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    chosen = re.findall(r"^QUICK := (.*)$", text, re.MULTILINE)[0].split()
    assert "tests/laws/test_every_observer.py" in chosen
    assert [path for path in chosen if not (ROOT / path).is_file()] == []


def test_bands_are_named_in_the_legend():
    """Of the gallery and of the papers, as the reports of the library do it by themselves."""
    scripts = [*(ROOT / "gallery").glob("*.py"), *(ROOT / "src/covariant/papers").rglob("*.py")]
    calls = [
        (script.name, node)
        for script in scripts
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "fill_between"
    ]
    assert len(calls) >= 6
    assert [name for name, call in calls if "label" not in {key.arg for key in call.keywords}] == []


def test_figures_take_colours_and_sizes_from_the_palette():
    """Of the gallery and of the papers: blue is this library, orange an EKF, green a filter, grey the truth."""
    by_hand = re.compile(r"""color="|"C\d"|fontsize=|PALETTE\[\d""")
    scripts = [*(ROOT / "gallery").glob("*.py"), *(ROOT / "src/covariant/papers").rglob("*.py")]
    found = [
        f"{script.name}: {line.strip()}"
        for script in scripts
        for line in script.read_text(encoding="utf-8").splitlines()
        if by_hand.search(line) and 'color="w"' not in line  # on a map of colours
    ]
    assert not found
