"""Units for simulators: their description fits their binary, and a step does what the observer does in Python."""

import platform
import shutil

import numpy as np
import pytest

from covariant import observers
from covariant.codegen import fmu, program, with_open_numbers
from scalargraph import compiler as _compile

needs_compiler = pytest.mark.skipif(
    shutil.which("cc") is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"),
    reason="there is no C compiler, `cc`, or the machine is another than that whose folder is named here",
)


@needs_compiler
def test_the_binary_is_made_by_the_compiler_that_cc_names(monkeypatch):
    monkeypatch.setattr(_compile, "compiler", lambda: "false")
    made = program(with_open_numbers(observers.FilteredDerivative(20.0)), np.zeros(1))
    with pytest.raises(OSError, match="false does not compile the unit"):
        fmu(made, "speed", "", 100.0, np.zeros(1))
    monkeypatch.setattr(_compile, "compiler", lambda: None)  # as on a machine with the package ziglang alone
    monkeypatch.setattr(_compile, "zig", lambda: ["cc"])
    assert "binaries/x86_64-linux/speed.so" in fmu(made, "speed", "", 100.0, np.zeros(1)).files
