"""The text of a model file whose numbers are to be changed, and which verbs have written it. Loads nothing heavy."""

import contextlib
import io
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from covariant._door import MODEL
from covariant.models.robots import ROBOTS
from scalargraph.files import read_bytes

OF_ROBOTS = (".urdf", ".xml")
WRITTEN_BY = {"fit": "# Fitted by covariant fit to ", "tune": "# Tuned by covariant tune to "}
"""The beginning of the head of a model file that a verb writes."""


def model_text(model: str | os.PathLike[str], sources: Mapping[Path, bytes] = MappingProxyType({})) -> str:
    """Text of a model file whose numbers are to be changed, from `sources` if it is one of these."""
    spec = os.fspath(model)
    if spec in ROBOTS or spec.endswith(OF_ROBOTS):
        return 'system = "robot"\n'
    if not spec.endswith(".toml"):
        return f'system = "{spec}"\n'
    content = sources.get(Path(spec))
    with io.BytesIO(read_bytes(spec, MODEL) if content is None else content) as file:
        return io.TextIOWrapper(file, encoding="utf-8").read()  # as `read_text`, with the line ends of Windows


def advice(model: Any, **by_verb: str) -> str:
    """Sentences of advice by the verb that each names, without those on what the model file was just written by."""
    text = ""
    with contextlib.suppress(OSError):  # a result may be shown when its file is gone
        text = model_text(model) if str(model).endswith(".toml") else ""
    done = {verb for verb, head in WRITTEN_BY.items() if head in text}
    return ", ".join(sentence for verb, sentence in by_verb.items() if verb not in done)
