"""Whether this package runs as its text says: nobody has put a function or a number of their own into it.

Who tries another equation by `Intrinsic.bend = mine`, or another constant, runs another program than the text says.
"""

import ast
import contextlib
import re
import sys
import sysconfig
import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
INSTALLED = tuple({str(Path(sysconfig.get_path(name))) for name in ("stdlib", "purelib", "platlib")})
"""Where Python and the packages below this one are."""
DEFINED = re.compile(r"^(?:def|class) (\w+)", re.MULTILINE)
CONSTANT = re.compile(r"^(_?[A-Z][A-Z_0-9]*)(?::[^=\n]*)? = (.+)$", re.MULTILINE)


def intact(texts: Mapping[str, str]) -> bool:
    """Whether the loaded modules hold what their texts, by the paths of their files, define.

    Functions, classes with their methods, and literal numbers, words and tuples on one line are looked at.
    """
    modules = [module for name, module in list(sys.modules.items()) if name.split(".")[0] == ROOT.name]
    return all(_as_written(module, texts) for module in modules if getattr(module, "__file__", None) in texts)


def _as_written(module: types.ModuleType, texts: Mapping[str, str]) -> bool:
    held, text = vars(module), texts[str(module.__file__)]
    for name, value in CONSTANT.findall(text):
        with contextlib.suppress(ValueError, SyntaxError):  # a value that is computed is not compared
            written = ast.literal_eval(value)
            if not isinstance(written, (dict, list, set)) and repr(held.get(name)) != repr(written):
                return False
    # Another installed package may put its own there as well: what a text defines is of this one.
    defined = (held.get(name) for name in DEFINED.findall(text))
    if any(hasattr(x, "__qualname__") and x.__module__.split(".")[0] != ROOT.name for x in defined):
        return False
    return all(_ours(value, module.__name__, "") for value in held.values())


def _ours(x: Any, module: str, owner: str) -> bool:
    """Whether a value of a module, or of a class with the name `owner` in it, was not put there by another's file."""
    if isinstance(x, type):
        inside = x.__module__ == module and not owner
        return _installed(x) and (not inside or all(_ours(v, module, x.__qualname__) for v in vars(x).values()))
    wrapped = (getattr(x, name, None) for name in ("__func__", "fget", "func", "method", "__wrapped__"))
    functions = [part for part in (x, *wrapped) if isinstance(part, types.FunctionType)]
    return _installed(type(x)) and all(_at_home(function, module, owner) for function in functions)


def _installed(kind: type) -> bool:
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    return kind.__module__ != "__main__" and (file is None or file.startswith((str(ROOT), *INSTALLED)))


def _at_home(function: types.FunctionType, module: str, owner: str) -> bool:
    file = function.__code__.co_filename
    if file.startswith("<"):  # written by `dataclass` and the like, or at a prompt
        return function.__globals__.get("__name__") != "__main__"
    if not file.startswith(str(ROOT)):
        return file.startswith(INSTALLED)
    # A method of another class is no method of this one.
    name = function.__qualname__
    return not owner or (function.__module__ == module and (name.startswith(f"{owner}.") or "<locals>" in name))
