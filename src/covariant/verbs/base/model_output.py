"""What `fit` and `tune` read and write, checked before anything is computed. Loads nothing heavy."""

import contextlib
import hashlib
import importlib.machinery
import itertools
import modulefinder
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from covariant import logs
from covariant._door import MESH, MODEL, ROBOT, parse_toml, read_toml
from covariant.models.robots import ROBOTS
from covariant.verbs.base.model_text import OF_ROBOTS, model_text
from covariant.verbs.base.outputs import check_output
from scalargraph.errors import InputError
from scalargraph.files import read_bytes, utf8


def as_logs(log: Any) -> tuple[Any, ...]:
    """Convert an argument that is one log, a list or tuple of them, or a folder, to a tuple of logs."""
    each = tuple(log) if type(log) in (list, tuple) else (log,)  # a Record is a tuple of another type
    if not each:
        raise InputError("log: no log is given; give a path, a Record, a table, or a list of them")
    for one in each:
        if isinstance(one, str | os.PathLike) and not logs.part_of(one)[0].exists():
            raise FileNotFoundError(f"{one}: no such file")
    return tuple(part for one in each for part in logs.episodes(one))


def check_model_output(model: object, path: str | Path | None, overwrite: bool = False, urdf: bool = False) -> None:
    """Check that a model file may be written, before anything is computed.

    Args:
        model: The model whose file is written anew with other numbers.
        path: The file to write (.toml); None, for no file, passes.
        overwrite: Whether a file that exists may be replaced, the model file itself included.
        urdf: Whether a URDF file of the same name is written beside it.

    Raises:
        ValueError: One line that names the path or the model, and what to do. The URDF file of the robot itself is not
            replaced, `overwrite` or not.

    Example:
        >>> from covariant import verbs
        >>> verbs.check_model_output("oscillator", "fitted.toml")
        >>> verbs.check_model_output("oscillator", "fitted.csv")
        Traceback (most recent call last):
            ...
        scalargraph.errors.InputError: fitted.csv: the file to write must end in .toml
    """
    if path is None:
        return
    path = Path(path)
    check_output(path, ".toml")
    if not isinstance(model, str | os.PathLike):
        raise InputError(f"{path}: the model has no file; give its file or its name, or put the numbers into your code")
    spec = os.fspath(model)
    if ":" in spec and not spec.endswith(".toml"):
        raise InputError(f"{path}: {spec} is code, which is not rewritten; put the numbers there")
    if path.exists() and not overwrite:
        same = Path(spec).exists() and path.samefile(spec)
        what = "this is the model file itself" if same else "there is such a file already"
        raise InputError(f"{path}: {what}; write to another file, or say `overwrite=True`")
    beside = path.with_suffix(".urdf")
    if urdf and beside.exists():
        _refuse_source(beside, _robot_file(spec))
        check_output(beside, ".urdf", overwrite=overwrite)


def _robot_file(spec: str) -> Path | None:
    """Path of the file of a robot that a model names; None where it names none, or cannot be read, which others say."""
    if not spec.endswith(".toml"):
        return Path(spec)
    try:
        parameters = read_toml(spec, MODEL).get("parameters")
    except InputError:
        return None
    stated = parameters.get("path") if isinstance(parameters, dict) else None
    return Path(spec).parent / stated if isinstance(stated, str) else None


def _refuse_source(path: Path, robot: Path | None) -> None:
    """Raise where a URDF file that would be written is the one that the robot is read from."""
    if robot is not None and path.exists() and robot.exists() and path.samefile(robot):
        raise InputError(
            f"{path}: the robot is read from this file, which is never replaced; write to another file, such as "
            f"{path.stem}_fitted.toml, beside which the URDF file with the new inertias then is"
        )


def read_sources(model: object) -> dict[Path, bytes]:
    """Read the files that a model with other numbers is written from: its own, and that of its robot."""
    if not isinstance(model, str | os.PathLike):
        return {}
    spec = os.fspath(model)
    paths = (Path(spec) if spec.endswith(".toml") else None, _robot_file(spec))
    return {path: read_bytes(path, ROBOT) for path in paths if path is not None and path.is_file()}


def model_hash(model: object) -> list[str]:
    """Hashes of all files that a model is read from: its own, those of its robot, and modules of its code."""
    contents = read_sources(model)
    spec, folder = (os.fspath(model) if isinstance(model, str | os.PathLike) else ""), None
    for path, content in list(contents.items()):
        if path.suffix == ".xml":
            contents |= _named_files(path, content)
        if path.suffix == ".toml":
            with contextlib.suppress(ValueError):  # which others say
                spec, folder = str(parse_toml(content.decode()).get("system", "")), path.parent
    return [hashlib.sha256(content).hexdigest() for content in contents.values()] + code_hash(spec, folder)


def _named_files(path: Path, content: bytes, seen: frozenset[Path] = frozenset()) -> dict[Path, bytes]:
    """The files, such as other parts and meshes, that an MJCF file names."""
    text, found = content.decode(errors="replace"), {}
    folders = ["", *re.findall(r'(?:mesh|asset)dir\s*=\s*"([^"]*)"', text)]
    for name, folder in itertools.product(re.findall(r'\bfile\s*=\s*"([^"]*)"', text), folders):
        part = path.parent / folder / name
        if part.is_file() and part not in seen:
            found[part] = read_bytes(part, MESH)
            if part.suffix == ".xml":
                found |= _named_files(part, found[part], seen | {part})
    return found


def code_hash(spec: str, folder: Path | None = None) -> list[str]:
    """Hashes of the module of `module:attribute`, from a folder or the current one, and of what it imports beside it.

    Empty for other texts, for a module that cannot be read, and for this library, which has a version.
    """
    module, beside = spec.partition(":")[0], os.path.abspath(folder or "")
    top = module.partition(".")[0]
    found = importlib.machinery.PathFinder.find_spec(top, [beside, *sys.path]) if ":" in spec and top else None
    if found is None or found.origin is None or top in ("covariant", "scalargraph"):
        return []
    root = Path(found.origin).parents[found.submodule_search_locations is not None]
    others = [each.stem for each in root.iterdir() if each.stem != top] if "site-packages" in root.parts else []
    finder = modulefinder.ModuleFinder([str(root)], excludes=others)
    with contextlib.suppress(Exception):  # a module may be broken in any way, which others say
        finder.import_hook(module)
    files = {getattr(each, "__file__", None) for each in finder.modules.values()}
    return [hashlib.sha256(Path(file).read_bytes()).hexdigest() for file in sorted(filter(None, files))]


def check_read_once(sources: Mapping[Path, bytes]) -> None:
    """Raise if a file was changed while it was read: several readers would have seen different texts."""
    for source in _changed(sources):
        raise InputError(f"{source}: it was changed while it was read; run the command again")


def _changed(sources: Mapping[Path, bytes]) -> list[Path]:
    """List the files whose content is no longer what was read."""
    return [path for path, content in sources.items() if not path.is_file() or path.read_bytes() != content]


def _check_unchanged(path: Path, sources: Mapping[Path, bytes]) -> None:
    """Raise if the file to replace, or the robot to copy, was changed after it was read."""
    for source in _changed(sources):
        if path.exists() and source.exists() and path.samefile(source):
            raise InputError(
                f"{path}: it was changed after it was read, and the change is not replaced; write to another file, "
                "which then has the text as it was read"
            )
        if source.suffix in OF_ROBOTS:
            raise InputError(
                f"{source}: it was changed after it was read, so nothing is written; run the command again"
            )


def write_models(
    model: Any,
    files: Mapping[Path, tuple[str, dict[str, Any]]],
    overwrite: bool,
    sources: Mapping[Path, bytes] | None = None,
) -> None:
    """Write files of a model with other numbers, each from its head and content; all are checked before the first.

    A robot with new inertias has a URDF file of its own beside each. Comments and layout stay. They are those of
    `sources`, the files as they were first read.
    """
    from covariant import models
    from scalargraph.files import write_together

    sources = read_sources(model) if sources is None else sources
    texts: dict[Path, bytes] = {}
    for path, (head, stated) in files.items():
        check_model_output(model, path, overwrite)
        content, urdf = robot_content(stated, path)
        if urdf is not None:
            _refuse_source(urdf[0], models.robots.located(stated["parameters"]["path"]))
            check_model_output(model, path, overwrite, urdf=True)
            texts[urdf[0]] = urdf[1].encode()
        _check_unchanged(path, sources)
        texts[path] = utf8(head + models.rewrite(model_text(model, sources), content))
    # All files or none, also on a full disk: otherwise the old model file would refer to a robot with new inertias.
    write_together(texts)


def urdf_beside(content: dict[str, Any], path: Path) -> Path | None:
    """Path of the URDF file that is written beside a model file, of a robot with other inertias; or None."""
    parameters = content.get("parameters", {})
    robot = parameters.get("path") if content.get("system") == "robot" and "inertia" in parameters else None
    return path.with_suffix(".urdf") if robot in ROBOTS or str(robot).endswith(".urdf") else None


def robot_content(content: dict[str, Any], path: Path) -> tuple[dict[str, Any], tuple[Path, str] | None]:
    """Content of a robot's model file for the place where it is written."""
    parameters = content.get("parameters", {})
    if content.get("system") != "robot" or (parameters.get("path") in ROBOTS and "inertia" not in parameters):
        return content, None
    robot, urdf = parameters["path"], urdf_beside(content, path)
    if urdf is not None:
        from covariant.models.robots import urdf_with_inertias

        rest = {key: value for key, value in parameters.items() if key != "inertia"}
        text = urdf_with_inertias(robot, parameters["inertia"])
        return content | {"parameters": rest | {"path": urdf.name}}, (urdf, text)
    return content | {"parameters": parameters | {"path": os.path.relpath(robot, path.parent)}}, None
