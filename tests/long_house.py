"""The house rules: who may import whom, what loads with the package, and which names are public: what takes long."""

import ast
import functools
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from style import docstrings
from test_house import (
    FILES,
    OF_GRAPHS,
    PLAN,
    SOURCE,
    aliases,
    imported,
    imported_rooms,
    makes_statements,
    place,
    room_of,
    tree,
)

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
    "clarabel",
    "control",
    "cffi",
)


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


PACKAGES = ("covariant", "scalargraph")


def uses_private(path: Path) -> set[str]:
    """The private names of other rooms and sub-rooms that a file imports or reads."""
    here = path.relative_to(SOURCE.parent).parent.parts
    others, wrong = set(), set()
    for name, local in imported(path):
        parts = tuple(name.split("."))
        first = next((i for i, part in enumerate(parts) if private(part)), len(parts))
        if parts[0] in PACKAGES and parts[: len(here)] != here:
            others.add(local)
        # What is private to a package is for its own files, and for those of its sub-rooms.
        # Files beside the rooms are for all of their package.
        shared = first == 1 and parts[0] == here[0]
        if parts[0] in PACKAGES and first < len(parts) and not shared and here[:first] != parts[:first]:
            wrong.add(name)
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Attribute) and private(node.attr) and ast.unparse(node.value) in others:
            wrong.add(ast.unparse(node))
    return wrong


def test_no_room_uses_what_is_private_to_another():
    wrong = {place(path): uses_private(path) for path in FILES + OF_GRAPHS}
    assert not {file: names for file, names in wrong.items() if names}, "let those rooms offer them as public names"


MOST_LINES = 400
MOST_LINES_OF = {
    "certificates/checking/_check.py": 300,
    "observers/filters/_intrinsic_kalman.py": 430,
}
"""Of the check, which has to be believed, less than of others; its jobs are parts of the trees of claims. The filter is
one step, which is read as a whole; the three kinds of fit answer one protocol, and are read beside each other."""


def test_no_file_is_too_long_to_be_read_in_one_sitting():
    """Docstrings, which are read one at a time, do not count."""

    def length(path: Path) -> int:
        return path.read_text(encoding="utf-8").count("\n") - sum(lines for _, lines in docstrings(tree(path)))

    assert not {place(path) for path in FILES + OF_GRAPHS if length(path) > MOST_LINES_OF.get(place(path), MOST_LINES)}


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
    ("papers/jouffroy_fossen/_odin.py", "_closed_loop", "virtual_velocity"): "the speed that the simulated controller "
    "tracks, beside which a figure shows the simulated one",
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

    Those of `scalargraph` are left out, where statements and the checker take theirs.
    """
    names, taking = Counter(), set()
    for path in FILES:
        for node in ast.walk(tree(path)):
            for each in getattr(node, "body", ()) if isinstance(node, ast.Module | ast.ClassDef) else ():
                if isinstance(each, ast.FunctionDef):
                    names[each.name] += 1
                    if derivatives(ast.Module([each], []), DERIVATIVES):
                        taking.add(each.name)
    return {name for name in taking if names[name] == 1 and not name.startswith("_")}


@pytest.mark.exhaustive
def test_statements_take_no_derivative_from_jax():
    """They take it from `scalargraph`, the checker from `scalargraph.proofs.checker`; both see values alone."""
    names = DERIVATIVES | derived_by_jax()
    files = [path for path in FILES if makes_statements(path, tree(path))]
    assert len(files) > 60
    found = {(place(path), *each) for path in files for each in derivatives(tree(path), names)}
    assert found == set(VALUES_OF_THE_CODE), "take derivatives by `scalargraph.along` or `scalargraph.jacobian`"


TAKE_DERIVATIVES = [
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
]


@pytest.mark.parametrize("line", TAKE_DERIVATIVES)
def test_a_deliberate_derivative_is_found(line):
    assert derivatives(ast.parse(line), DERIVATIVES | derived_by_jax())


def test_every_module_opens_with_what_it_is():
    assert not [place(path) for path in FILES + OF_GRAPHS if not ast.get_docstring(tree(path))]


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
