"""XML of robots: read so that the file can do no harm and open no other one, with numbers that are checked."""

import math
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np


def parse(path: Path) -> Element:
    """The XML of a file. Raises `ValueError` for what is not readable, and for document types and entities."""
    data = path.read_bytes()
    if b"\0" in data:
        raise ValueError("is not text in UTF-8; save it as such")
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise ValueError("declares a document type or entities, which a robot description has no need of; remove them")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise ValueError(f"is not readable XML: {error}") from error


def vector(entry: Element | None, key: str, where: str, default: tuple[float, float, float]) -> np.ndarray:
    written = None if entry is None else entry.get(key)
    if written is None:
        return np.array(default)
    try:
        found = np.array([float(part) for part in written.split()])
    except ValueError:
        found = np.zeros(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ValueError(f"{where}: {key} must be three finite numbers; got {written!r}")
    return found


def number(entry: Element, key: str, where: str, default: float | None = None) -> float:
    written = entry.get(key)
    if written is None:
        if default is None:
            raise ValueError(f"{where}: <{entry.tag}> lacks {key!r}")
        return default
    try:
        found = float(written)
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise ValueError(f"{where}: {key} of <{entry.tag}> must be a finite number; got {written!r}")
    return found


def attribute(entry: Element, key: str, where: str) -> str:
    found = entry.get(key)
    if not found:
        raise ValueError(f"{where}: a <{entry.tag}> lacks {key!r}")
    return found


def name_of(entry: Element) -> str:
    """The name of a tag, without its namespace."""
    return entry.tag.rpartition("}")[2] if isinstance(entry.tag, str) else "comment"
