"""What takes long of `test_templates.py`."""

import numpy as np
import pytest

from covariant import codegen, observers
from covariant.codegen import _fmu, _python_package, _wasm
from scalargraph.template import PLACEHOLDER


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
