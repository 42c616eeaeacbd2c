"""Files that are either the old one or the new one, never half of each."""

import os
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: str | os.PathLike[str], write: Callable[[BinaryIO], object]) -> Path:
    """Let `write` fill a file beside `path`, then put it in its place; where `write` raises, `path` stays as it was.

    Raises `FileNotFoundError` where the folder does not exist, and whatever `write` raises.
    """
    path = Path(path)
    # A plain `open`, not `tempfile`, so that the file gets the permissions any other new file would.
    fresh = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with fresh.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)
    return path
