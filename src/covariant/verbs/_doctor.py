"""`doctor`: what an installation consists of, what in it is wrong, and what makes this library slow."""

import os
import platform
import re
from dataclasses import dataclass
from importlib import metadata
from typing import Any

from covariant.verbs.base.result import AbstractResult
from scalargraph.cache import SharedFolderError, open_cache_folder
from scalargraph.compiler import FAST, compiled, compiler


@dataclass(frozen=True)
class Part:
    """One part of an installation.

    Attributes:
        name: What it is, such as "compiler of C".
        found: What was found.
        problem: What is wrong with it and what to do; empty where nothing is.
        advice: What would make this library faster, which runs without it; empty where nothing would.
    """

    name: str
    found: str
    problem: str = ""
    advice: str = ""


def doctor() -> "DoctorResult":
    """Examine the installation: versions, optional packages, compiler, cache folder, threads and devices.

    Returns:
        What was found, what is wrong with it, and what makes it slow.

    Example:
        >>> from covariant import verbs
        >>> examined = verbs.doctor()
        >>> [part.name for part in examined.parts][:2]
        ['covariant', 'Python']
    """
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    versions = Part("covariant", metadata.version("covariant")), Part("Python", python), *_packages(), *_extras()
    return DoctorResult((*versions, _compiler(), _cache(), _threads(), _device()))


@dataclass(frozen=True, repr=False)
class DoctorResult(AbstractResult):
    """What an installation consists of.

    Attributes:
        parts: The parts, in the order in which they are printed.

    Example:
        >>> from covariant.verbs._doctor import DoctorResult
        >>> from covariant.verbs._doctor import Part
        >>> DoctorResult((Part("cache folder", "none", "set COVARIANT_CACHE to a folder that can be written"),))
        <DoctorResult: 1 of 1 parts with a problem>
    """

    parts: tuple[Part, ...]

    @property
    def problems(self) -> tuple[Part, ...]:
        """The parts in which something is wrong."""
        return tuple(part for part in self.parts if part.problem)

    @property
    def headline(self) -> str:
        if not self.problems:
            return "nothing is wrong with this installation"
        return f"{len(self.problems)} of {len(self.parts)} parts with a problem"

    @property
    def summary(self) -> dict[str, Any]:
        return {
            part.name: {"found": part.found, "problem": part.problem or None, "advice": part.advice or None}
            for part in self.parts
        }

    def __str__(self) -> str:
        width = max(len(part.name) for part in self.parts)
        lines = []
        for part in self.parts:
            lines.append(f"{part.name:<{width}}  {part.found}")
            told = (("problem", part.problem), ("advice", part.advice))
            lines += [f"{'':<{width}}  {kind}: {text}" for kind, text in told if text]
        return "\n".join([*lines, "", f"{self.headline[0].upper()}{self.headline[1:]}."])


def _requirements() -> list[tuple[str, str, str]]:
    """Name, bounds of the version and extra, or an empty text, of each package that this library states."""
    found = []
    for line in metadata.requires("covariant") or ():
        match = re.fullmatch(r"([\w.-]+)(?:\[.*?\])?\s*([^;]*)(?:;.*?extra == ['\"](\w+)['\"])?.*", line)
        if match:
            found.append((match[1], match[2].strip(), match[3] or ""))
    return found


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _packages() -> list[Part]:
    """The packages that are always needed, and whether their versions are those that were tried."""
    from packaging.specifiers import SpecifierSet

    parts = []
    for name, bounds, extra in _requirements():
        if extra:
            continue
        version = _version(name)
        if version is None:
            parts.append(Part(name, "not installed", f"pip install '{name}{bounds}'"))
        elif SpecifierSet(bounds).contains(version, prereleases=True):
            parts.append(Part(name, version))
        else:
            parts.append(Part(name, version, f"this library was tried with {bounds}: pip install '{name}{bounds}'"))
    return parts


def _extras() -> list[Part]:
    """The extras, with the packages that are here; one that is missing is no problem, since no one needs them all."""
    extras: dict[str, list[str]] = {}
    for name, _, extra in _requirements():
        if extra not in ("", "all", "dev", "docs") and name != "covariant":
            extras.setdefault(extra, []).append(name)
    parts = []
    for extra, names in extras.items():
        missing = [name for name in names if _version(name) is None]
        there = ", ".join(f"{name} {_version(name)}" for name in names if name not in missing)
        advice = f"without {', '.join(missing)} (pip install 'covariant[{extra}]')" if missing else ""
        parts.append(Part(f"extra {extra}", "; ".join(filter(None, (there, advice)))))
    return parts


def _compiler() -> Part:
    """The compiler of C, and whether it makes a library that runs."""
    name, path = "compiler of C", compiler()
    if path is None:
        advice = "observers run in JAX, which takes longer; install one, or set CC to its name"
        named = os.environ.get("CC")
        return Part(name, f"none: CC={named} is not there", advice) if named else Part(name, "none", advice=advice)
    import ctypes

    try:
        half = compiled("double half(double x) { return x / 2; }\n", FAST, ctypes.CDLL).half
    except OSError as error:
        return Part(name, path, f"{error}; set CC to another one")
    half.restype, half.argtypes = ctypes.c_double, [ctypes.c_double]
    return Part(name, path, "" if half(3.0) == 1.5 else "what it compiles computes wrongly; set CC to another one")


def _cache() -> Part:
    """The folder in which compiled programs are kept."""
    name, chosen = "cache folder", os.environ.get("COVARIANT_CACHE")
    advice = "every process compiles anew; set COVARIANT_CACHE to a folder"
    try:
        folder = open_cache_folder()
    except SharedFolderError as error:
        return Part(name, "none: others could put code there", str(error))
    except (OSError, RuntimeError):
        reason = f"COVARIANT_CACHE={chosen} cannot be written" if chosen else "no home to write to"
        return Part(name, f"none: {reason}", advice)
    if folder is None:
        return Part(name, f"none: COVARIANT_CACHE={chosen}", advice=advice)
    files = [file.stat().st_size for file in folder.glob("*") if file.is_file()]
    return Part(name, f"{folder}, {len(files)} files, {sum(files) / 1e6:.0f} MB")


def _threads() -> Part:
    """Processors, and the threads of the BLAS that NumPy was loaded with."""
    found = f"{os.cpu_count()} processors, OPENBLAS_NUM_THREADS={os.environ.get('OPENBLAS_NUM_THREADS', 'not set')}"
    alone = os.environ.get("OPENBLAS_NUM_THREADS") == "1"
    advice = "a threaded BLAS slows small matrices down; set OPENBLAS_NUM_THREADS=1 before Python is started"
    return Part("threads", found, advice="" if alone else advice)


def _device() -> Part:
    """What JAX computes on, and whether in double precision."""
    import jax

    kinds = ", ".join(f"{device.platform} {device.device_kind}" for device in jax.devices())
    double = jax.config.jax_enable_x64  # pyright: ignore[reportAttributeAccessIssue]
    problem = "" if double else "double precision is off; import covariant before it is disabled, or leave it on"
    return Part("JAX computes on", f"{kinds}, {'double' if double else 'single'} precision", problem)
