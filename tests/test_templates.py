"""Templates of generated files: each is used, valid in its own language, and leaves no placeholder in a file."""

import ast
import functools
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest

import covariant
from covariant import codegen, observers
from covariant._templates import PLACEHOLDER, fill
from covariant.codegen import _fmu, _python_package, _wasm

SOURCE = Path(covariant.__file__).parent
TEMPLATES = {path.relative_to(SOURCE).as_posix(): path for path in sorted(SOURCE.glob("*/templates/*"))}


def of_suffix(suffix: str) -> list[Path]:
    return [path for path in TEMPLATES.values() if path.suffix == suffix]


@functools.cache
def modules(room: str) -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in (SOURCE / room).rglob("*.py"))


def test_every_template_is_used_in_its_room():
    unused = [name for name, path in TEMPLATES.items() if f'"{path.name}"' not in modules(name.partition("/")[0])]
    # Names of these have the version of FMI in them.
    assert unused == [f"codegen/templates/fmi{k}{rest}" for k in (2, 3) for rest in (".c", "_refused.h")]


@pytest.mark.parametrize("flat", [True, False])
def test_all_forms_of_an_export_are_filled(flat, monkeypatch):
    for module in (_fmu, _python_package):
        monkeypatch.setattr(module, "compiler_command", lambda: None)
    monkeypatch.setattr(_wasm, "_compiled", lambda files: b"")
    recipe = codegen.with_open_numbers(observers.FilteredDerivative(20.0), () if flat else ("*",))
    graphs, measured = codegen.program(recipe, np.zeros(1)), np.zeros((codegen.ROWS + 1, 1))
    graphs = graphs._replace(alone=(("configuration", graphs.step),), signals=codegen.Signals(("q [rad]",)))
    run = codegen.vectors(graphs, measured, 100.0)
    about, facts = "The text xNAMEx stays.", codegen.Facts(100.0, None)
    texts = codegen.export_texts(graphs, "speed", about, measured, facts, run=run, python=flat, wasm=flat, ros2=flat)
    written = [*texts.values()]
    written += [text.decode() for text in codegen.python_files(graphs, texts, "speed", about, 100.0).values()]
    written += [text.decode() for text in codegen.wasm_files(graphs, texts, "speed", about, 100.0, run).values()]
    written += [
        text.decode() for text in codegen.ros_files(graphs._replace(alone=()), texts, "speed", about, 100.0).values()
    ]
    for version in ("3.0", "2.0"):
        files = codegen.fmu(graphs, "speed", about, 100.0, np.zeros(1), version).files
        written += [text.decode() for text in files.values()]
    assert sum(about in text for text in written) > 5
    assert not [text for text in written if PLACEHOLDER.search(text.replace(about, ""))]


def test_a_placeholder_without_a_text_is_an_error():
    with pytest.raises(KeyError, match="NAME"):
        fill("codegen", "__main__.py", {})


def test_templates_of_python_are_python_and_those_of_xml_are_xml():
    assert [ast.parse(path.read_text(encoding="utf-8")) for path in of_suffix(".py")]
    assert [ElementTree.parse(path) for path in of_suffix(".xml")]


@pytest.mark.skipif(shutil.which("node") is None, reason="there is no node")
def test_templates_of_javascript_are_javascript():
    assert of_suffix(".js")
    for path in of_suffix(".js"):
        done = subprocess.run(["node", "--check", str(path)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler, `cc`")
def test_lists_of_refused_functions_are_headers(tmp_path):
    for path in of_suffix(".h"):
        if path.name.endswith("_refused.h"):
            (tmp_path / "alone.c").write_text(f'#include "{path}"\n')
            subprocess.run(["cc", "-std=c99", "-Wall", "-Werror", "-fsyntax-only", tmp_path / "alone.c"], check=True)


def test_pages_of_html_load_nothing():
    for path in of_suffix(".html"):
        assert not re.search(r"https?://|@import|<link(?![^>]*data:)", path.read_text(encoding="utf-8"))


def test_git_ignores_no_template():
    """The wheel has all files of the package that git does not ignore."""
    command = ["git", "check-ignore", *map(str, TEMPLATES.values())]
    assert not subprocess.run(command, cwd=SOURCE, capture_output=True, check=False).stdout
