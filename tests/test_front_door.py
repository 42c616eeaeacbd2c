"""What the package offers by its name, and what that costs to load."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import get_args

import pytest

import covariant
from covariant.certificates.proving import CHECKERS
from covariant.cli._commands import COMMANDS
from covariant.engine import EngineName
from covariant.verbs._certify import OBSERVERS as CERTIFIED
from covariant.verbs._reproduce import PAPERS
from covariant.verbs.base.find import FIND
from scalargraph.proofs import MOST_BOXES


def python(script: str, **variables: str) -> str:
    kept = ("JAX_COMPILATION", "JAX_PERSISTENT")
    surroundings = {name: value for name, value in os.environ.items() if not name.startswith(kept)} | variables
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, env=surroundings)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout.strip()


def test_importing_the_package_loads_no_jax():
    assert python("import covariant, sys; print('jax' in sys.modules, 'numpy' in sys.modules)") == "False False"


@pytest.mark.core(1)
@pytest.mark.parametrize("options", [("--help",), ("certify", "--help"), ("--version",)])
def test_help_and_version_load_no_jax(options):
    script = f"""
import sys
sys.argv = ['covariant', *{options!r}]
from covariant.cli import main
try:
    main()
except SystemExit as done:
    print('LOADED', 'jax' in sys.modules, done.code)
"""
    assert python(script).endswith("LOADED False 0")


def test_the_version_is_that_of_the_package():
    assert covariant.__version__ == version("covariant")


def test_rooms_are_there_without_being_imported():
    assert python("import covariant; print(covariant.models.ball_and_beam().coordinates)") == "('r', 'theta')"
    assert python("from covariant import models; print(models.robots.ROBOTS[0] in models.robots.ROBOTS)") == "True"


def test_every_name_is_offered():
    assert set(dir(covariant)) == set(covariant.__all__)
    for name in covariant.__all__:
        assert getattr(covariant, name) is not None
    with pytest.raises(AttributeError, match="No covariant attribute robots"):
        _ = covariant.robots  # pyright: ignore[reportAttributeAccessIssue]


def option(verb, name):
    """The option of a verb's argument, as the command line has it."""
    command = next(command for command in COMMANDS if command.verb == verb)
    return next(option for option in command.options if option.name == name)


@pytest.mark.parametrize(
    ("verb", "name", "names"),
    [
        ("estimate", "engine", get_args(EngineName)),
        ("compare", "engine", get_args(EngineName)),
        ("tune", "engine", get_args(EngineName)),
        ("certify", "observer", CERTIFIED),
        ("certify", "checker", CHECKERS),
        ("certify", "find", FIND),
        ("reproduce_paper", "paper", PAPERS),
    ],
)
def test_the_names_that_a_docstring_quotes_are_those_that_there_are(verb, name, names):
    assert {*option(verb, name).kind.choices} == {*names}


def test_the_default_effort_is_that_of_all_proofs():
    assert option("certify", "boxes").default == MOST_BOXES


def test_programs_are_kept_in_the_users_cache_folder(tmp_path):
    home = {"COVARIANT_CACHE": "", "HOME": str(tmp_path), "XDG_CACHE_HOME": "", "LOCALAPPDATA": str(tmp_path)}
    script = "import covariant, os; print(os.environ['JAX_COMPILATION_CACHE_DIR'])"
    folder = Path(python(script, **home))
    assert folder.is_relative_to(tmp_path)
    assert folder.parent.name == "covariant"
    assert folder.is_dir()


@pytest.mark.parametrize(
    ("before", "variables"),
    [
        ("", {"COVARIANT_CACHE": "off"}),
        ("", {"COVARIANT_CACHE": "/dev/null/nowhere"}),
        ("import jax; ", {"COVARIANT_CACHE": ""}),  # too late: JAX has read its variables
    ],
)
def test_no_programs_are_kept_where_none_may_be(before, variables, tmp_path):
    script = f"{before}import covariant, os; print('JAX_COMPILATION_CACHE_DIR' in os.environ)"
    assert python(script, HOME=str(tmp_path), XDG_CACHE_HOME=str(tmp_path), **variables) == "False"
    assert not list(tmp_path.iterdir())


def test_a_folder_given_to_jax_is_left_alone(tmp_path):
    script = "import covariant, os; print(os.environ['JAX_COMPILATION_CACHE_DIR'])"
    assert python(script, COVARIANT_CACHE="", JAX_COMPILATION_CACHE_DIR=str(tmp_path)) == str(tmp_path)
