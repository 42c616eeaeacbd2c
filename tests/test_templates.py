"""Templates of generated files: each is used, valid in its own language, and leaves no placeholder in a file."""

import ast
import functools
import re
import shutil
import subprocess
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import covariant
from scalargraph.template import fill

SOURCE = Path(covariant.__file__).parents[1]
TEMPLATES = {path.relative_to(SOURCE).as_posix(): path for path in sorted(SOURCE.glob("**/templates/*.*"))}


def of_suffix(suffix: str) -> list[Path]:
    return [path for path in TEMPLATES.values() if path.suffix == suffix]


@functools.cache
def modules(room: str) -> str:
    return "\n".join(path.read_text(encoding="utf-8") for path in (SOURCE / room).rglob("*.py"))


def test_every_template_is_used_in_its_room():
    unused = [
        name for name, path in TEMPLATES.items() if f'"{path.name}"' not in modules(name.rpartition("/templates/")[0])
    ]
    # Names of these have the version of FMI in them.
    assert unused == [f"covariant/codegen/templates/fmi{k}{rest}" for k in (2, 3) for rest in (".c", "_refused.h")]


def test_a_placeholder_without_a_text_is_an_error():
    with pytest.raises(KeyError, match="NAME"):
        fill("covariant.codegen", "__main__.py", {})


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
