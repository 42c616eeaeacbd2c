"""What the package offers by its name, and what that costs to load."""

import subprocess
import sys
from importlib.metadata import version

import pytest

import covariant
from covariant.cli import _certify, _names, _reproduce
from covariant.design import ESTIMATORS


def python(script: str) -> str:
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_loads_no_jax():
    assert python("import covariant, sys; print('jax' in sys.modules, 'numpy' in sys.modules)") == "False False"


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


@pytest.mark.parametrize("before", ["", "import jax; "])
def test_arrays_are_double_from_the_import_on(before):
    script = f"{before}import covariant; import jax.numpy as jnp; print(jnp.ones(1).dtype)"
    assert python(script) == "float64"


def test_every_name_is_offered():
    assert set(dir(covariant)) == set(covariant.__all__)
    for name in covariant.__all__:
        assert getattr(covariant, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'robots'; it has Record"):
        _ = covariant.robots  # pyright: ignore[reportAttributeAccessIssue]


def test_what_help_names_is_what_there_is():
    assert _names.ESTIMATORS == ESTIMATORS
    assert tuple(_certify.OBSERVERS) == _names.CERTIFIED
    assert tuple(_reproduce.PAPERS) == _names.PAPERS
