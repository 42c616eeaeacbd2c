"""The house rules: who may import whom, what loads with the package, and which names are public."""

import ast
import functools
import graphlib
import importlib
import json
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import get_origin

import pytest
from style import docstrings

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "covariant"

PLAN = (
    "_errors _domains _door _rooms _files _programs _compile _typing _gauss_markov _functional _templates _optional "
    "_cases _numbers _names signals scoring _linalg _integrate _adaptive lowering logs geometry models metrics "
    "observers simulation proofs certificates calibration codegen engine report papers workflow cli"
)
"""A room may import from itself and from any room to its left, never to its right."""

OPTIONAL = (
    "pyarrow",
    "rosbags",
    "matplotlib",
    "plotly",
    "mujoco",
    "typer",
    "rich",
    "scipy",
    "sympy",
    "xarray",
    "zarr",
    "dask",
    "distributed",
    "flint",
    "clarabel",
    "control",
    "cffi",
)

FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent.name != "templates")
"""The modules of the library; a template is one of another program."""


@functools.cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


ROOMS = sorted(".".join(path.parent.relative_to(SOURCE).parts) for path in SOURCE.rglob("__init__.pyi"))
"""Rooms and sub-rooms; the stub of each lists what others may import from it."""

PUBLIC = [room for room in ROOMS if "." not in room] + [
    "geometry.lie",
    "models.marine",
    "models.robots",
]
"""Of these, the ones whose names are for users. Those of other sub-rooms are for the rest of the library."""

SUBMODULES = {room: {path.stem for path in (SOURCE / room.replace(".", "/")).glob("[!_]*")} for room in ROOMS}


def place(path: Path) -> str:
    return path.relative_to(SOURCE).as_posix()


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


OF_TUPLES = ("_asdict", "_fields", "_make", "_replace")
"""What Python calls the public methods of a named tuple, so that they are none of its fields."""


def private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name not in OF_TUPLES


def right_of(path: Path) -> list[str]:
    """The rooms that a file imports although the plan puts them to the right of its own."""
    plan, room = PLAN.split(), room_of(path)
    if room == "__init__":  # the front door loads every room
        return sorted(imported_rooms(path) - set(plan))
    assert room in plan, f"{room} is not in the import plan; give it a place"
    return sorted(other for other in imported_rooms(path) if plan.index(other) > plan.index(room))


def test_rooms_import_only_from_their_left():
    wrong = {place(path): right_of(path) for path in FILES}
    assert not {file: rooms for file, rooms in wrong.items() if rooms}, "these imports go to the right of the plan"


def test_what_passes_through_the_rooms_enters_none_twice():
    """The ways that `docs/contributing.md` draws follow the order of the plan."""
    page = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
    ways = [re.findall(r"\w+", cells) for cells in re.findall(r"\| (`\w+`(?: → `\w+`)+) \|", page)]
    places = [[PLAN.split().index(room) for room in way] for way in ways]
    assert len(ways) == 3
    assert all(way == sorted(set(way)) for way in places)


def test_proofs_know_functions_and_boxes_and_no_model():
    rooms = set().union(*(imported_rooms(path) for path in (SOURCE / "proofs").rglob("*.py")))
    assert rooms == {"_door", "_errors", "_compile", "_rooms", "_templates", "_typing", "lowering", "proofs"}


def uses_private(path: Path) -> set[str]:
    """The private names of other rooms and sub-rooms that a file imports or reads."""
    here = ("covariant", *path.relative_to(SOURCE).parent.parts)
    others, wrong = set(), set()
    for name, local in imported(path):
        parts = tuple(name.split("."))
        first = next((i for i, part in enumerate(parts) if private(part)), len(parts))
        if parts[0] == "covariant" and parts[: len(here)] != here:
            others.add(local)
        # What is private to a package is for its own files, and for those of its sub-rooms.
        if parts[0] == "covariant" and first < len(parts) and first > 1 and here[:first] != parts[:first]:
            wrong.add(name)
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Attribute) and private(node.attr) and ast.unparse(node.value) in others:
            wrong.add(ast.unparse(node))
    return wrong


def test_no_room_uses_what_is_private_to_another():
    wrong = {place(path): uses_private(path) for path in FILES}
    assert not {file: names for file, names in wrong.items() if names}, "let those rooms offer them as public names"


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(SOURCE.parent).with_suffix("").parts).removesuffix(".__init__")


def test_modules_import_each_other_in_no_circle():
    """Imports inside functions count like those at the top of a file, and those for types alone do too."""
    modules = {module_of(path): path for path in FILES}
    needs: dict[str, set[str]] = {}
    for module, path in modules.items():
        names = {name for name, _ in imported(path) if name.startswith("covariant")}
        found = {name if name in modules else name.rpartition(".")[0] for name in names}
        needs[module] = (found & set(modules)) - {module}
    graphlib.TopologicalSorter(needs).prepare()  # raises CycleError, which names the circle


MOST_LINES, MOST_LINES_OF = (
    400,
    {
        "certificates/checking/_check.py": 300,
        "observers/filters/_intrinsic_kalman.py": 430,
        "workflow/_fit_to_logs.py": 490,
    },
)
"""Of the check, which has to be believed, less than of others; its jobs are parts of the trees of claims. The filter is
one step, which is read as a whole; the three kinds of fit answer one protocol, and are read beside each other."""


def test_no_file_is_too_long_to_be_read_in_one_sitting():
    """Docstrings, which are read one at a time, do not count."""

    def length(path: Path) -> int:
        return path.read_text(encoding="utf-8").count("\n") - sum(lines for _, lines in docstrings(tree(path)))

    assert not {place(path) for path in FILES if length(path) > MOST_LINES_OF.get(place(path), MOST_LINES)}


def test_kinds_of_models_are_told_apart_by_what_they_offer():
    """At most so many lines ask for the kind of a model: each is a place that a third kind would have to know."""
    kinds = re.compile(r"isinstance\(.*(StateSpace|MechanicalSystem|Lagrangian|GroupSystem|Craft)\b")
    lines = [line for path in FILES for line in path.read_text(encoding="utf-8").split("\n")]
    asked = [line for line in lines if kinds.search(line)]
    assert len(asked) <= 5, "\n".join(asked)


DERIVATIVES = {
    *("jacfwd", "jacrev", "grad", "value_and_grad", "jvp", "vjp", "linearize", "hessian", "jet", "fwd_and_bwd"),
    *("filter_grad", "filter_value_and_grad", "filter_jvp", "filter_vjp", "filter_jacfwd", "filter_jacrev"),
    *("filter_hessian", "filter_closure_convert", "saved_input_vjp"),
}
"""The derivatives of JAX and equinox, which believe `stop_gradient` and custom rules."""
VALUES_OF_THE_CODE = {
    ("certificates/sampled/_sampled_step.py", "_stiffness", "jvp"): "any field is a metric, and the code of the prover "
    "and of the checker is one: test_declared.py compares its inequality with differences of its values",
    ("certificates/sampled/_sampled_body.py", "_stiffness", "jvp"): "as in _sampled_step.py",
    ("certificates/sampled/_sampled_body.py", "body_variables", "differential"): "which entries of a matrix the force "
    "of the model reads, where the model itself computes the force in this way",
}
"""Derivatives that are values of the code that runs, with why no statement rests on their being derivatives."""


def derivatives(module: ast.Module, names: set[str]) -> set[tuple[str, str]]:
    """Derivatives with these names that a module takes, each with the function at its top level that takes it."""
    imports = [node for node in ast.walk(module) if isinstance(node, ast.Import | ast.ImportFrom)]
    aliases = [(getattr(node, "module", None) or "", alias) for node in imports for alias in node.names]
    # `jacobian` alone is also the name of the derivative that statements take, by `lowering`.
    both = {name for room, alias in aliases if (name := alias.name) == "jacobian" and room.startswith("jax")}
    local = {alias.asname or alias.name: alias.name for _, alias in aliases if alias.name in names | both}
    jax = {"jax"} | {alias.asname for _, alias in aliases if alias.name == "jax"}
    found = {("", "*") for _, alias in aliases if alias.name == "*"}
    for top in module.body:
        where = getattr(top, "name", "")
        for node in ast.walk(top):
            match node:
                case ast.Attribute(attr=name) if name in names:
                    found.add((where, name))
                case ast.Attribute(attr="jacobian", value=ast.Name(id=root)) if root in jax:
                    found.add((where, "jacobian"))
                case ast.Constant(value=str(name)) if name in DERIVATIVES:
                    found.add((where, name))
                case ast.Name(id=name) if name in local:
                    found.add((where, local[name]))
    return found


@functools.cache
def derived_by_jax() -> set[str]:
    """Functions and methods of the library that take a derivative of JAX, and whose name is theirs alone.

    Those of `lowering` and `proofs` are left out, which are where statements and the checker take theirs.
    """
    names, taking = Counter(), set()
    for path in FILES:
        for node in ast.walk(tree(path)):
            for each in getattr(node, "body", ()) if isinstance(node, ast.Module | ast.ClassDef) else ():
                if isinstance(each, ast.FunctionDef):
                    names[each.name] += 1
                    if room_of(path) not in ("lowering", "proofs") and derivatives(ast.Module([each], []), DERIVATIVES):
                        taking.add(each.name)
    return {name for name in taking if names[name] == 1 and not name.startswith("_")}


def makes_statements(path: Path, module: ast.Module) -> bool:
    """Whether a module is one of the certificates, uses one, or makes a statement or a premise itself."""
    called = {ast.unparse(node.func).rpartition(".")[2] for node in ast.walk(module) if isinstance(node, ast.Call)}
    uses = any(name.startswith("covariant.certificates") for name, _ in imported(path))
    return room_of(path) == "certificates" or uses or not called.isdisjoint({"Statement", "Hypothesis"})


def test_statements_take_no_derivative_from_jax():
    """They take it from `covariant.lowering`, the checker from `covariant.proofs.checker`; both see values alone."""
    names = DERIVATIVES | derived_by_jax()
    files = [path for path in FILES if makes_statements(path, tree(path))]
    assert len(files) > 60
    found = {(place(path), *each) for path in files for each in derivatives(tree(path), names)}
    assert found == set(VALUES_OF_THE_CODE), "take derivatives by `lowering.along` or `lowering.jacobian`"


@pytest.mark.parametrize(
    "line",
    [
        "jax.jacfwd(f)(x)",
        "getattr(jax, 'grad')(f)(x)",
        "eqx.filter_jvp(f, (x,), (x,))",
        "model.jacobians(t, x, u)",
        "from jax import vjp; partial(vjp, f)",
        "from jax import hessian as h; h(f)",
        "from covariant.geometry import differential; differential(manifold, f, x)",
        "from jax import *",
        "jax.jacobian(f)(x)",
        "import jax as j; j.jacobian(f)(x)",
        "from jax import jacobian as slopes; slopes(f)(x)",
    ],
)
def test_a_deliberate_derivative_is_found(line):
    assert derivatives(ast.parse(line), DERIVATIVES | derived_by_jax())


def test_a_module_that_makes_a_premise_is_searched_wherever_it_is():
    path = SOURCE / "models" / "_state_space.py"
    assert not makes_statements(path, tree(path))
    assert makes_statements(path, ast.parse("premise = base.Hypothesis('it holds', 'proved')"))
    assert makes_statements(SOURCE / "calibration" / "tuning" / "_contracting.py", ast.parse(""))


def test_every_module_opens_with_what_it_is():
    assert not [place(path) for path in FILES if not ast.get_docstring(tree(path))]


SHARED = {"Product"}
"""A product of spaces is a space, and one of groups a group."""


def test_a_class_is_public_in_one_room_and_defined_once():
    """There is one `Box` and one `Metric`."""
    offered = {room: dir(importlib.import_module(f"covariant.{room}")) for room in PUBLIC}
    public = Counter(name for names in offered.values() for name in names if name[0].isupper())
    assert {name for name, count in public.items() if count > 1} == SHARED
    defined = Counter(name for path in FILES for name in classes(path))
    assert {name: count for name, count in defined.items() if count > 1 and name in public} == dict.fromkeys(SHARED, 2)
    others = [name for path in FILES for name in aliases(path)]
    assert not {"Box", "Metric"} & set(others)


def classes(path: Path) -> list[str]:
    return [node.name for node in tree(path).body if isinstance(node, ast.ClassDef)]


def aliases(path: Path) -> Iterator[str]:
    """Names that a file gives to anything at its top level."""
    for node in tree(path).body:
        if isinstance(node, ast.Assign):
            yield from (target.id for target in node.targets if isinstance(target, ast.Name))


EAGER = "geometry models metrics observers simulation proofs certificates calibration codegen engine"
"""Rooms all of whose public names load without an optional package."""

LOAD = """
import importlib, json, sys

brought, known = {}, set()
for module in %s:
    loaded = importlib.import_module(module)
    for name in dir(loaded) if module != "covariant" else ():
        getattr(loaded, name)
    present = {name for name in %s if name in sys.modules}
    brought[module] = sorted(present - known)
    known |= present
print(json.dumps(brought))
"""


def test_imports_bring_in_no_optional_package():
    """In one process, the front door first and then one room after another, each to the right of the one before."""
    modules = ["covariant", *(f"covariant.{room}" for room in PLAN.split() if room in EAGER.split())]
    done = subprocess.run(
        [sys.executable, "-c", LOAD % (modules, OPTIONAL)], capture_output=True, text=True, check=True
    )
    brought = json.loads(done.stdout)
    assert list(brought) == modules
    assert not {module: names for module, names in brought.items() if names}


def public_names(room: str) -> list[str]:
    """The names for users of a room: `__all__` of its stub."""
    return [name for name in importlib.import_module(f"covariant.{room}").__all__ if name not in SUBMODULES[room]]


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
    assert sum(len(public_names(room)) for room in PUBLIC) + len(front) <= MOST_PUBLIC


def tracked_texts():
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split(
        "\n"
    )
    paths = [ROOT / name for name in listed if name] or list(SOURCE.rglob("*"))
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


def test_what_make_quick_runs_is_there():
    text = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
    chosen = re.findall(r"^QUICK := (.*)$", text, re.MULTILINE)[0].split()
    assert "tests/laws/test_every_observer.py" in chosen
    assert [path for path in chosen if not (ROOT / path).is_file()] == []


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
