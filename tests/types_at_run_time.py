"""Types and shapes are checked at every call of a package that is imported after `check_types(package)`.

As by the import hook of jaxtyping, in less time: each function is wrapped once, its arguments are bound once, and
functions without annotations are left as they are. The name of a dimension stands for one size throughout a call.
"""

import ast
import dataclasses
import functools
import importlib.machinery
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import jaxtyping
from beartype import BeartypeConf, beartype

SUFFIX = f".typed-{Path(__file__).stat().st_mtime_ns}.pyc"
"""Of compiled modules whose types are checked; they lie beside those as written, and another hook makes its own."""
ANEW = jaxtyping.jaxtyped("context")
"""Within it, names of dimensions mean nothing that they meant outside; it may be entered again within itself."""

_checked = beartype(conf=BeartypeConf(violation_type=TypeError))


def typed(this: Any) -> Any:
    """A function that checks the types of its arguments and of its result, or a class whose constructor does."""
    if isinstance(this, type):
        if dataclasses.is_dataclass(this) and not hasattr(this.__init__, "__wrapped__"):  # not one that is typed
            this.__init__ = typed(this.__init__)
        return this
    checked = _checked(this)  # which also resolves annotations that are quoted
    return _in_one_call(checked) if "jaxtyping" in repr(this.__annotations__) else checked


def _in_one_call(function: Callable) -> Callable:
    """The function with dimensions of its own."""

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        with ANEW:
            return function(*arguments, **named)

    return call


def _says_types(node: ast.FunctionDef) -> bool:
    return node.returns is not None or any(isinstance(a, ast.arg) and a.annotation for a in ast.walk(node.args))


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module with `typed` on every function that says types, and on every class."""

    def source_to_code(self, data: Any, path: Any, *, _optimize: int = -1) -> Any:
        tree = ast.parse(data)
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):  # outermost, where a dataclass has its constructor
                node.decorator_list.insert(0, ast.copy_location(ast.Name("__typed__", ast.Load()), node))
            elif isinstance(node, ast.FunctionDef) and _says_types(node):  # innermost, where there are annotations
                node.decorator_list.append(ast.copy_location(ast.Name("__typed__", ast.Load()), node))
        return super().source_to_code(tree, path, _optimize=_optimize)

    def get_data(self, path: str) -> bytes:
        return super().get_data(_compiled(path))

    def set_data(self, path: str, data: Any, **how: Any) -> None:
        super().set_data(_compiled(path), data, **how)

    def exec_module(self, module: Any) -> None:
        module.__typed__ = typed
        super().exec_module(module)


def _compiled(path: str) -> str:
    return path.removesuffix(".pyc") + SUFFIX if path.endswith(".pyc") else path


class _Finder:
    def __init__(self, package: str, but: Iterable[str]):
        self.package, self.but = package, tuple(but)

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
        within = [f"{name}.".startswith(f"{each}.") for each in (self.package, *self.but)]
        if not within[0] or any(within[1:]):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec and spec.origin and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def check_types(package: str, but: Iterable[str] = ()) -> None:
    """Check types in a package, which has not been imported yet, but not in some packages within it."""
    assert package not in sys.modules, f"{package} has been imported already"
    sys.meta_path.insert(0, _Finder(package, but))
