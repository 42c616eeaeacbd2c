"""Code is loaded from the cache only where it is what was written, from a folder in which nobody else can write."""

import ctypes
import errno
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import zlib
from pathlib import Path

import pytest

from covariant import verbs
from covariant._programs import CHECKED, drop_broken_programs
from scalargraph import cache as caching, compiler as _compile, files as _files
from scalargraph.cache import cache_folder, open_cache_folder
from scalargraph.compiler import FAST, compiled, compiler
from scalargraph.files import read_sealed, write_sealed

needs_compiler = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")
needs_owners = pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have no owner here")
HALF = "double half(double x) { return x / 2; }\n"
LOADS = """
import covariant, ctypes, sys
from scalargraph.compiler import FAST, compiled
half = compiled("double half(double x) { return x / 2; }\\n", FAST, ctypes.CDLL).half
half.restype, half.argtypes = ctypes.c_double, [ctypes.c_double]
print(half(3.0))
"""


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """A cache folder that is empty."""
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path / "cache"))
    folder = cache_folder()
    assert folder is not None
    return folder


def python(script: str = LOADS, **variables: str) -> subprocess.CompletedProcess:
    words = [sys.executable, "-c", script]
    return subprocess.run(words, env=os.environ | variables, capture_output=True, text=True, check=False)


def replaced_by_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def of_another_source(path: Path) -> None:
    compiled("double half(double x) { return -x; }\n", FAST, ctypes.CDLL)
    (other,) = (entry for entry in path.parent.glob("*.so") if entry != path)
    other.replace(path)


DAMAGES = {
    "truncated": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
    "zeroed": lambda path: path.write_bytes(bytes(path.stat().st_size)),
    "patched": lambda path: path.write_bytes(path.read_bytes()[:-1000] + b"?" + path.read_bytes()[-999:]),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"?"),
    "without its hash": lambda path: path.write_bytes(read_sealed(path) or b""),
    "of another source": of_another_source,
    "no library": lambda path: path.write_text("#!/bin/sh\n"),
}


@pytest.mark.core(3)
@needs_compiler
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_library_that_is_not_as_it_was_written_is_compiled_again(damage, cache):
    assert python().stdout == "1.5\n"
    (path,) = cache.glob("*.so")
    whole = path.read_bytes()
    DAMAGES[damage](path)
    assert read_sealed(path) is None
    done = python()
    assert (done.returncode, done.stdout, done.stderr) == (0, "1.5\n", "")
    assert path.read_bytes() == whole
    assert read_sealed(path) is not None
    assert {entry.suffix for entry in cache.iterdir()} == {".so"}


@needs_compiler
def test_a_library_behind_a_link_is_loaded_by_its_content_and_a_new_one_takes_the_place_of_the_link(cache):
    assert python().stdout == "1.5\n"
    (path,) = cache.glob("*.so")
    replaced_by_link(path)
    assert python().stdout == "1.5\n"
    os.truncate(cache / "elsewhere", 100)
    assert python().stdout == "1.5\n"
    assert not path.is_symlink()
    assert (cache / "elsewhere").stat().st_size == 100
    os.link(path, cache / "again.so")  # a hard link: its name is another one
    assert read_sealed(cache / "again.so") is None


@needs_compiler
def test_what_was_compared_with_its_hash_is_what_is_loaded(cache, monkeypatch):
    """Even where the file is replaced between the two, and truncated after them."""
    compiled(HALF, FAST, ctypes.CDLL)
    (path,) = cache.glob("*.so")

    def load(place: str) -> ctypes.CDLL:
        assert Path(place) != path
        path.write_bytes(b"another")
        library = ctypes.CDLL(place)
        os.truncate(path, 0)
        return library

    half = compiled(HALF, FAST, load).half
    half.restype, half.argtypes = ctypes.c_double, [ctypes.c_double]
    assert half(3.0) == 1.5


@needs_compiler
def test_several_processes_at_once_on_an_empty_cache_all_get_the_library(tmp_path):
    place = {"COVARIANT_CACHE": str(tmp_path / "cache")}
    words = [sys.executable, "-c", LOADS]
    running = [subprocess.Popen(words, env=os.environ | place, stdout=subprocess.PIPE, text=True) for _ in range(4)]
    assert [process.communicate()[0] for process in running] == ["1.5\n"] * 4
    assert len([entry for entry in tmp_path.glob("cache/*/*") if entry.suffix == ".so"]) == 1
    assert not list(tmp_path.glob("cache/*/*.tmp"))


@needs_compiler
def test_a_full_disk_changes_no_result(cache, monkeypatch):
    made = tempfile.mkstemp

    def mkstemp(suffix: str, dir: Path) -> tuple[int, str]:
        if Path(dir) == cache:
            raise OSError(errno.ENOSPC, "No space left on device")
        return made(suffix, dir=dir)

    def full(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(tempfile, "mkstemp", mkstemp)
        patched.setattr(_compile, "write_sealed", full)
        assert compiled(HALF, FAST, ctypes.CDLL).half
        assert not list(cache.iterdir())
    compiled(HALF, FAST, ctypes.CDLL)
    monkeypatch.setattr(tempfile, "mkstemp", mkstemp)
    assert compiled(HALF, FAST, ctypes.CDLL).half


def test_an_entry_is_on_the_disk_before_it_is_named(tmp_path, monkeypatch):
    events = []

    def kind(descriptor: int) -> str:
        return "folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file"

    sync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda descriptor: (events.append(kind(descriptor)), sync(descriptor)))
    monkeypatch.setattr(os, "replace", lambda *paths: (events.append("name"), replace(*paths)))
    write_sealed(tmp_path / "entry", b"content")
    assert events == ["file", "name", "folder"]
    assert read_sealed(tmp_path / "entry") == b"content"


def shared(chosen: Path) -> str:
    """The warning about a cache folder that is refused."""
    with pytest.warns(RuntimeWarning) as warned:
        assert cache_folder() is None
    (warning,) = warned
    message = str(warning.message)
    assert message.startswith("compiled programs are not cached: ")
    assert "\n" not in message
    assert "set COVARIANT_CACHE to" in message
    return message


@needs_owners
@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702, 0o720, 0o1777])
def test_a_folder_that_others_can_write_is_refused(mode, cache, tmp_path):
    cache.chmod(mode)
    assert f"other users can write to {cache}; remove it by rm -r" in shared(cache)
    with pytest.warns(RuntimeWarning):
        (part,) = (part for part in verbs.doctor().parts if part.name == "cache folder")
    assert "other users can write to" in part.problem
    shutil.rmtree(cache)
    assert cache_folder() == cache


@needs_owners
@pytest.mark.parametrize(("mode", "refused"), [(0o777, True), (0o702, True), (0o1777, False), (0o755, False)])
def test_so_is_one_below_a_folder_in_which_others_can_rename(mode, refused, cache, tmp_path):
    (tmp_path / "cache").chmod(mode)
    if refused:
        assert f"other users can write to {tmp_path / 'cache'}; chmod go-w" in shared(cache)
        (tmp_path / "cache").chmod(0o755)
    assert cache_folder() == cache


@needs_owners
def test_a_folder_of_a_group_counts_as_shared_unless_its_user_is_alone_in_it(cache, tmp_path, monkeypatch):
    (tmp_path / "cache").chmod(0o775)
    for alone in (True, False):
        monkeypatch.setattr(caching, "_is_own_group", lambda place, group, alone=alone: alone)
        if alone:
            assert cache_folder() == cache
        else:
            shared(cache)


@needs_owners
def test_a_folder_of_another_user_is_refused_and_nothing_is_created_below_it(cache, tmp_path, monkeypatch):
    someone = os.stat(tmp_path).st_uid + 4711
    monkeypatch.setattr(os, "getuid", lambda: someone)
    assert "belongs to another user; set COVARIANT_CACHE to a folder of yours" in shared(cache)
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path / "new"))
    if tmp_path.stat().st_uid:  # what root owns, anybody may use
        shared(tmp_path)
    else:
        tmp_path.chmod(0o702)
        shared(tmp_path)
    assert not (tmp_path / "new").exists()


@needs_owners
def test_a_folder_that_others_can_read_is_closed(cache):
    """As versions before left some."""
    cache.chmod(0o755)
    assert cache_folder() == cache
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


@needs_owners
def test_folders_are_created_for_their_user_alone_whatever_the_umask(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path / "a" / "b"))
    before = os.umask(0)
    try:
        folder = cache_folder()
    finally:
        os.umask(before)
    assert folder is not None
    assert {stat.S_IMODE(place.stat().st_mode) for place in (folder, *list(folder.parents)[:2])} == {0o700}


@needs_owners
def test_a_link_is_followed_before_the_check_and_none_takes_the_place_of_the_folder(cache, tmp_path, monkeypatch):
    (tmp_path / "link").symlink_to("cache")
    monkeypatch.setenv("COVARIANT_CACHE", str(tmp_path / "link"))
    assert cache_folder() == cache
    cache.rename(tmp_path / "mine")
    cache.symlink_to(tmp_path / "mine")
    assert "is no folder but a link" in shared(cache)
    cache.unlink()
    cache.symlink_to(tmp_path / "nowhere")
    assert cache_folder() is None
    assert not (tmp_path / "nowhere").exists()


def test_without_a_home_nothing_is_cached_and_no_folder_is_left(tmp_path, monkeypatch):
    monkeypatch.delenv("COVARIANT_CACHE")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(caching, "user_cache_path", lambda *names, **options: Path("~/.cache/covariant"))
    assert cache_folder() is None
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("COVARIANT_CACHE", "~no-such-user/cache")
    assert cache_folder() is None


@needs_owners
@needs_compiler
def test_nothing_is_compiled_where_others_can_replace_it(tmp_path, monkeypatch):
    monkeypatch.setenv("COVARIANT_CACHE", "off")
    tmp_path.chmod(0o777)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(OSError, match=r"other users can write to .*set TMPDIR to another one"):
        compiled(HALF, FAST, ctypes.CDLL)
    tmp_path.chmod(0o1777)
    assert compiled(HALF, FAST, ctypes.CDLL).half
    assert not list(tmp_path.iterdir())


def test_a_warning_is_not_repeated(cache):
    cache.chmod(0o777)
    script = "import covariant\nfrom scalargraph.cache import cache_folder\nfor _ in range(3): cache_folder()"
    done = python(script)
    assert done.returncode == 0
    assert done.stderr.count("RuntimeWarning: compiled programs are not cached") == (1 if hasattr(os, "getuid") else 0)


PROGRAM = zlib.compress(b"a program of JAX" * 100)


def test_programs_of_jax_that_are_not_as_they_were_written_are_removed(tmp_path):
    def write(name: str, content: bytes) -> None:
        (tmp_path / f"{name}-cache").write_bytes(content)

    for name in ("whole", "touched", "truncated", "patched", "zeroed", "gone"):
        write(name, PROGRAM)
    write("new and truncated", PROGRAM[:20])
    write("new and zeroed", bytes(100))
    write("new and empty", b"")
    write("other.so", b"")
    drop_broken_programs(tmp_path)
    assert not list(tmp_path.glob("new*"))
    first = (tmp_path / CHECKED).stat()
    drop_broken_programs(tmp_path)
    assert (tmp_path / CHECKED).stat().st_ino == first.st_ino  # nothing to write
    os.utime(tmp_path / "touched-cache")
    write("truncated", PROGRAM[:20])
    write("patched", zlib.compress(b"another program!" * 100))
    write("zeroed", bytes(len(PROGRAM)))
    (tmp_path / "gone-cache").unlink()
    (tmp_path / "linked-cache").symlink_to("whole-cache")
    drop_broken_programs(tmp_path)
    assert {path.name for path in tmp_path.glob("*-cache")} == {"whole-cache", "touched-cache"}
    for broken in (b"", b"what is this\n", b"\xff\xfe", bytes(50)):
        (tmp_path / CHECKED).write_bytes(broken)
        drop_broken_programs(tmp_path)
        assert (tmp_path / "whole-cache").exists()
    listed = (tmp_path / CHECKED).read_text().splitlines()
    assert sorted(line.split(" ", 3)[3] for line in listed) == ["touched-cache", "whole-cache"]


def test_threads_that_load_one_library_all_get_it(cache):
    results = []
    threads = [threading.Thread(target=lambda: results.append(compiled(HALF, FAST, ctypes.CDLL))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert len(list(cache.glob("*.so"))) == 1
    assert open_cache_folder() == cache
    assert _files.read_sealed(cache / "nothing") is None
