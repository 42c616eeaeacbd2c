"""covariant: intrinsic and contracting observers for mechanical systems.

Importing it loads nothing heavy: a subpackage, such as `covariant.models`, is loaded on first use. From then on JAX
works in double precision, and its compiled programs are cached in the user's cache folder (`COVARIANT_CACHE`).
"""

import importlib
import os
import sys
from typing import TYPE_CHECKING, Any

from covariant._errors import InputError
from covariant._programs import keep_programs

if TYPE_CHECKING:
    from covariant import (
        calibration,
        certificates,
        codegen,
        engine,
        geometry,
        logs,
        lowering,
        metrics,
        models,
        observers,
        papers,
        proofs,
        report,
        scoring,
        signals,
        simulation,
        workflow,
    )
    from covariant.signals import Record, Run, StepCode
    from covariant.workflow import (
        certify,
        check,
        compare,
        design_excitation,
        estimate,
        export,
        fit,
        simulate,
        smooth,
        tune,
    )

    __version__: str

# JAX reads this variable when it is imported, which may happen long after this, or may have happened already.
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
keep_programs()

VERBS = ("check", "certify", "compare", "design_excitation", "estimate", "export", "fit", "simulate", "smooth", "tune")
"""Functions of `covariant.workflow` that are also available here: from a model and a log to a result."""

__all__ = [
    "InputError",
    "Record",
    "Run",
    "StepCode",
    "__version__",
    "calibration",
    "certificates",
    "certify",
    "check",
    "codegen",
    "compare",
    "design_excitation",
    "engine",
    "estimate",
    "export",
    "fit",
    "geometry",
    "logs",
    "lowering",
    "metrics",
    "models",
    "observers",
    "papers",
    "proofs",
    "report",
    "scoring",
    "signals",
    "simulate",
    "simulation",
    "smooth",
    "tune",
    "workflow",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("covariant")
    if name in ("Record", "StepCode", "Run"):
        return getattr(importlib.import_module("covariant.signals"), name)
    if name in __all__ and name in VERBS:
        return getattr(importlib.import_module("covariant.workflow"), name)
    if name in __all__:
        return importlib.import_module(f"covariant.{name}")
    raise AttributeError(f"module 'covariant' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
