"""An export as WebAssembly does what its C does, in Node, and says what is missing to make it."""

import functools
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import covariant
from covariant import observers
from covariant.codegen import _wasm, program, with_open_numbers


@functools.cache
def compiles() -> bool:
    try:
        return bool(_wasm._compiled({"a.c": "int a;", "calls.c": "#include <math.h>\nint b;"}))
    except ValueError:
        return False


@pytest.fixture
def wasm():
    """Skips where WebAssembly cannot be made or run."""
    if shutil.which("node") is None or not compiles():
        pytest.skip("there is no compiler for WebAssembly, or no node")


def node(script: str, folder: Path) -> str:
    done = subprocess.run(["node", "-e", script], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_without_a_compiler_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setattr(_wasm.shutil, "which", lambda name: None)
    monkeypatch.setattr(_wasm, "zig", lambda: None)
    graphs = program(with_open_numbers(observers.FilteredDerivative(20.0)), np.zeros(1))
    run = covariant.codegen.vectors(graphs, np.zeros((41, 1)), 100.0)
    texts = {"speed.h": "", "speed.c": ""}
    message = (
        r"^no compiler for WebAssembly is installed; install the packages clang, lld and wasi-libc of the system, or "
        r"the extra wasm: pip install 'covariant\[wasm\]'$"
    )
    with pytest.raises(ValueError, match=message):
        covariant.codegen.wasm_files(graphs, texts, "speed", "A test.", 100.0, run)
    # Before anything is designed: this model does not even exist.
    with pytest.raises(ValueError, match=message):
        covariant.export("no_such_system", tmp_path / "a", rate=100.0, wasm=True, python=True)
    with pytest.raises(ValueError, match="wasm is for a folder, and a unit is one file"):
        covariant.export("oscillator", tmp_path / "a.fmu", rate=100.0, wasm=True)


def test_a_compiler_that_knows_no_webassembly_is_quoted(monkeypatch, tmp_path):
    """As clang without wasi-libc."""
    clang = tmp_path / "clang"
    clang.write_text("#!/bin/sh\necho 'no such header' >&2\nexit 1\n")
    clang.chmod(0o755)
    monkeypatch.setattr(_wasm.shutil, "which", lambda name: str(clang))
    monkeypatch.setattr(_wasm, "zig", lambda: None)
    message = r"no WebAssembly could be compiled; install (.|\n)*clang does not compile the observer: no such header"
    with pytest.raises(ValueError, match=message):
        _wasm._compiled({"a.c": "", "calls.c": ""})
