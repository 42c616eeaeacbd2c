"""Files appear whole or not at all, and what a killed writer leaves is gone after the next one."""

import concurrent.futures
import errno
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from scalargraph.files import attended, sweep, temporary, write_atomically, write_together

KILLED = """
import os, signal, sys
from pathlib import Path
from scalargraph import files as _files

path, folder = Path(sys.argv[1]), sys.argv[2] == "folder"

def die(file):
    file.write(b"half of it")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)

if folder:
    with _files.temporary(path, Path.mkdir) as fresh, (fresh / "a").open("wb") as file:
        die(file)
_files.write_atomically(path, die)
"""


def full_after(count: int):
    """A function of `os` that finds the disk full from a call on."""
    calls = iter(range(count))

    def call(*_):
        if next(calls, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    return call


def left(folder) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_writer_leaves_is_swept_by_the_next(tmp_path, kind):
    path = tmp_path / "page[1].html"
    other = tmp_path / f".other.html.{32 * '0'}.tmp"
    other.touch()
    killed = subprocess.run([sys.executable, "-c", KILLED, str(path), kind], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert len(left(tmp_path)) == 2
    assert not path.exists()
    write_atomically(path, lambda file: file.write(b"whole"))
    assert left(tmp_path) == [other.name, path.name], "the files of other targets are not ours to remove"
    assert path.read_bytes() == b"whole"


def test_a_living_writer_keeps_its_file(tmp_path):
    path, begun, go_on = tmp_path / "log.csv", threading.Event(), threading.Event()

    def slow(file):
        file.write(b"slow")
        begun.set()
        assert go_on.wait(60)

    with concurrent.futures.ThreadPoolExecutor() as pool:
        writing = pool.submit(write_atomically, path, slow)
        assert begun.wait(60)
        sweep(path)
        write_atomically(path, lambda file: file.write(b"quick"))
        assert path.read_bytes() == b"quick"
        go_on.set()
        writing.result(60)
    assert path.read_bytes() == b"slow"
    assert left(tmp_path) == ["log.csv"]


def test_many_writers_at_once_each_put_a_whole_file(tmp_path):
    path = tmp_path / "log.csv"
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        texts = [str(k).encode() * 1000 for k in range(64)]
        list(pool.map(lambda text: write_atomically(path, lambda file: file.write(text)), texts))
    assert path.read_bytes() in texts
    assert left(tmp_path) == ["log.csv"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = write_atomically(tmp_path / "a", lambda file: file.write(b"old"))
    with pytest.raises(ZeroDivisionError):
        write_atomically(path, lambda file: 1 / 0)
    with pytest.raises(FileExistsError), temporary(path, Path.mkdir) as fresh:
        fresh.mkdir()
    assert left(tmp_path) == ["a"]
    assert path.read_bytes() == b"old"
    with pytest.raises(FileNotFoundError):
        write_atomically(tmp_path / "none" / "a", lambda file: None)


def test_a_full_disk_names_the_file_and_not_the_temporary_one(tmp_path, monkeypatch):
    path = tmp_path / "run.csv"
    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full_after(0))
            with pytest.raises(OSError, match="No space left") as error:
                write_atomically(path, lambda file: file.write(b"new"))
        assert error.value.filename == str(path)
    with pytest.raises(FileNotFoundError) as error:
        write_atomically(tmp_path / "none" / "a", lambda file: None)
    assert error.value.filename == str(tmp_path / "none" / "a")
    with pytest.raises(FileNotFoundError) as error:  # of another file
        write_atomically(path, lambda file: open(tmp_path / "log.csv"))  # noqa: SIM115
    assert error.value.filename == str(tmp_path / "log.csv")
    assert left(tmp_path) == []


def test_files_that_belong_together_are_all_written_before_one_is_replaced(tmp_path, monkeypatch):
    paths = [write_atomically(tmp_path / name, lambda file: file.write(b"old")) for name in "abc"]
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full_after(2))
        with pytest.raises(OSError, match="No space left") as error:
            write_together(dict.fromkeys(paths, b"new"))
    assert error.value.filename == str(paths[2])
    assert [path.read_bytes() for path in paths] == 3 * [b"old"]
    assert left(tmp_path) == ["a", "b", "c"]
    write_together(dict.fromkeys(paths, b"new"))
    assert [path.read_bytes() for path in paths] == 3 * [b"new"]
    assert left(tmp_path) == ["a", "b", "c"]


def test_a_folder_is_tidied_only_where_nobody_else_writes(tmp_path):
    tidied = []
    with attended(tmp_path, lambda: tidied.append("first")):
        with attended(tmp_path, lambda: tidied.append("second")):
            pass
        assert tidied == ["first"]
    with attended(tmp_path, lambda: tidied.append("third")):
        assert tidied == ["first", "third"]
