"""Downloads recorded logs from where their authors published them, and keeps the columns that the benchmark reads."""

import hashlib
import io
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.velocity.cases import entries, located

SECONDS = 60
"""Time after which a download that stands still is given up [s]."""


def fetch(folder: Path) -> None:
    """Download every recorded log that is not there and whose address is known; each must have its checksum."""
    for entry in entries().values():
        if "twin" in entry or located(entry) is not None:
            continue
        if "address" not in entry:
            print(f"{entry['name']}: take it from {entry['source']}, with the columns of the file in {entry['file']}")
            continue
        print(f"{entry['name']}: {_fetched(entry, folder / entry['file'])}")


def _fetched(entry: dict[str, Any], path: Path) -> str:
    try:
        with urllib.request.urlopen(entry["address"], timeout=SECONDS) as answer:
            table = pd.read_csv(io.BytesIO(answer.read()))
    except (urllib.error.URLError, TimeoutError) as error:
        return f"{entry['address']} cannot be read: {error}"
    lacking = sorted(set(entry["columns"]) - set(table.columns))
    if lacking:
        return f"{entry['address']} has no column {', '.join(lacking)}"
    kept = table[list(entry["columns"])].rename(columns=entry["columns"])
    text = kept.to_csv(index=False, float_format="%.8g", lineterminator="\n").encode()
    found = hashlib.sha256(text).hexdigest()
    if found != entry["sha256"]:
        return f"what {entry['address']} has now is another recording: its SHA-256 is {found}, not {entry['sha256']}"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part")
    partial.write_bytes(text)
    partial.replace(path)
    return f"wrote {path}"
