"""Generated C of an earlier process is found again by what an observer computes, and never taken for another's."""

import json
import os
import shutil
import time

import pytest

from covariant.engine import _cache
from covariant.engine._cache import cached_text
from covariant.engine._sources import ROOT, source_files
from scalargraph import LoweringError
from scalargraph.cache import UNUSED, cache_folder
from scalargraph.files import read_sealed, write_sealed


def test_only_what_was_asked_for_is_found(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    assert cached_text("this", lambda: "1") == "1"
    assert cached_text("this", lambda: "2") == "1"
    assert cached_text("that", lambda: "3") == "3"
    for other in ("[]", "{}", '{"c": 1}', '{"c": "1", "d": "2"}', "null", "{"):
        write_sealed(cache_folder() / "this.json", other.encode())
        assert cached_text("this", lambda other=other: other) == other
    for entry in ("this", "that"):  # C that is not what was written is no text, whatever it says
        (cache_folder() / f"{entry}.json").write_text('{"c": "patched"}')
        assert cached_text(entry, lambda: "4") == "4"
    shutil.copy(cache_folder() / "this.json", cache_folder() / "other.json")
    assert cached_text("other", lambda: "not that of this") == "not that of this"
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    assert cached_text("this", lambda: "5") == "5"
    assert cached_text(None, lambda: "6") == "6"


def test_a_refusal_is_kept_and_raised_again(tmp_path, monkeypatch):
    def refuse():
        raise LoweringError("there is none")

    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    for write in (refuse, lambda: "never asked for"):
        with pytest.raises(LoweringError, match="there is none"):
            cached_text("this", write)
    [entry] = cache_folder().iterdir()
    assert json.loads(read_sealed(entry)) == {"refused": "there is none"}


def test_a_full_disk_and_a_folder_that_cannot_be_written_change_no_result(tmp_path, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    monkeypatch.setattr(_cache, "write_sealed", full)
    assert cached_text("this", lambda: "7") == "7"
    assert not list(tmp_path.glob("*/*.json"))
    monkeypatch.setenv("COVARIANT_CACHE", "/dev/null/nowhere")
    assert cached_text("this", lambda: "8") == "8"


def test_what_nobody_has_read_for_long_is_evicted(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path))
    folder = cache_folder()
    now, old = time.time(), time.time() - 1.1 * UNUSED
    ages = {f"old{ending}": (old, old) for ending in (".so", ".json", ".made", "-cache", ".tmp", ".txt")}
    ages |= {"read.so": (now, old), "made.so": (old, now)}
    for name, times in ages.items():
        (folder / name).write_text("")
        os.utime(folder / name, times)
    assert cached_text("this", lambda: "9") == "9"
    assert {file.name for file in folder.iterdir()} == {"this.json", "read.so", "made.so", "old.txt"}


def test_a_text_depends_on_every_file_that_writes_it():
    writers = {path.relative_to(ROOT).as_posix() for path in _cache._WRITERS}
    modules = [path for room in ("scalargraph", "covariant/engine") for path in (ROOT / room).rglob("*.py")]
    assert {path.relative_to(ROOT).as_posix() for path in modules} <= writers
    assert {"scalargraph/c/_c_writer.py", "scalargraph/templates/rows.c"} <= writers
    assert "covariant/engine/templates/kernel.c" in writers


def test_files_are_modules_and_templates_and_nothing_that_pip_compiled(tmp_path):
    names = ["room/_a.py", "room/inner/_b.py", "room/templates/c.c", "room/templates/d.py", "_e.py"]
    others = ["room/templates/__pycache__/d.pyc", "room/__pycache__/_a.pyc", "room/py.typed", "other/_f.py"]
    for name in names + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    listed = source_files("room", "_e.py", root=tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in listed] == sorted(names)
