"""Compiled programs are cached between processes, in the user's cache folder.

JAX compiles a program in seconds and loads a cached one in milliseconds. `COVARIANT_CACHE=off` stores none, and
`COVARIANT_CACHE=FOLDER` stores them in that folder. Where `JAX_COMPILATION_CACHE_DIR` is set, it is respected.

Files in the folder run as code. So only its owner may be able to write there, and each entry is compared with its
SHA-256 before it is loaded. The hash does not protect against other processes of the owner, which can replace it too.
"""

import contextlib
import functools
import hashlib
import os
import platform
import shlex
import stat
import sys
import time
import warnings
import zlib
from pathlib import Path

from platformdirs import user_cache_path

OFF = ("off", "0", "no")
"""Values of `COVARIANT_CACHE` with which nothing is stored."""
FATAL = "3"
"""Lowest severity of the compiler's messages that are printed; errors in compilation raise exceptions as well."""
WORTH_KEEPING = "0"
"""Shortest compilation time [s] of a program that is stored: also many short ones add up to seconds."""
UNUSED = 180 * 24 * 3600.0
"""Time [s] without use after which a program is evicted: each version of a library leaves some behind."""
IMPORTED = time.time()
"""Time [s] since 1970 at which this process imported the library; files changed later are not what runs."""


def keep_programs() -> None:
    """Set the environment variables by which JAX, when it is imported, learns where to cache its programs.

    Does nothing where JAX has been imported before: then it is too late to suppress the notes that its compiler writes
    about each program it loads. Whoever imports JAX earlier sets these variables.
    """
    decided = "jax" in sys.modules or "JAX_COMPILATION_CACHE_DIR" in os.environ
    folder = None if decided else cache_folder()
    if folder is None:
        return
    drop_broken_programs(folder)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", WORTH_KEEPING)
    # The compiler reports features that the processor lacks as errors. 1 is the level that JAX itself sets.
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "1") == "1":
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = FATAL


class SharedFolderError(OSError):
    """Another user can write to a folder; the message is one line with the remedy."""


def cache_folder() -> Path | None:
    """Return the cache folder for this kind of processor, created if it is missing; None if nothing is cached.

    A folder to which other users can write is refused, with a warning.
    """
    try:
        return open_cache_folder()
    except SharedFolderError as error:
        warnings.warn(f"compiled programs are not cached: {error}", RuntimeWarning, stacklevel=1)
    except (OSError, RuntimeError):  # there is no home folder, or it cannot be written to
        pass
    return None


def open_cache_folder() -> Path | None:
    """Return the cache folder, or None if `COVARIANT_CACHE` disables it; raises `OSError` if it cannot be used."""
    chosen = os.environ.get("COVARIANT_CACHE", "")
    if chosen.lower() in OFF:
        return None
    folder = Path(chosen).expanduser() if chosen else user_cache_path("covariant", appauthor=False)
    if not chosen and not folder.is_absolute():  # the system knows no home, so that "~" was not replaced
        raise FileNotFoundError("there is no home folder")
    # Each instruction set has its folder, since a program may not run on another processor. Links are followed before
    # the check, so that the folder that is checked is the one that is opened.
    folder = folder.resolve() / _processor()
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    # The check comes before anything is created: no folder may be created in another user's home.
    if missing:
        need_private(missing[-1].parent)
    for place in reversed(missing):
        place.mkdir(mode=0o700, exist_ok=True)
    need_private(folder, alone=True)
    if folder.stat().st_mode & 0o077:
        folder.chmod(0o700)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"{folder} cannot be written")
    return folder


def need_private(folder: Path, alone: bool = False, setting: str = "COVARIANT_CACHE") -> None:
    """Check that no other user can replace the content of a folder; raises `SharedFolderError`.

    With `alone`, it also checks that no other user can create files in it. The message names the environment variable
    `setting`, by which another folder can be chosen.
    """
    if not hasattr(os, "getuid"):  # Windows: the folders of a user are closed to others by access lists
        return
    me = os.getuid()
    for place in (folder, *folder.parents):
        status = place.lstat()
        inside = alone and place == folder
        if status.st_uid not in ((me,) if inside else (me, 0)):
            raise SharedFolderError(f"{place} belongs to another user; set {setting} to a folder of yours")
        # In a sticky folder, such as /tmp, only the owner of an entry, or of the folder, can rename the entry.
        sticky = status.st_mode & stat.S_ISVTX and not inside
        others = status.st_mode & stat.S_IWOTH
        group = status.st_mode & stat.S_IWGRP and (inside or not _is_own_group(place, status.st_gid))
        if stat.S_ISLNK(status.st_mode):
            raise SharedFolderError(f"{place} is no folder but a link; set {setting} to a folder")
        if not stat.S_ISDIR(status.st_mode):
            raise NotADirectoryError(f"{place} is no folder")
        if (others or group) and not sticky:
            remedy = f"chmod go-w {shlex.quote(str(place))}"
            if inside:  # whoever could write there may have left an entry with a hash
                remedy = f"remove it by rm -r {shlex.quote(str(place))}"
            raise SharedFolderError(f"other users can write to {place}; {remedy}, or set {setting} to another one")


def _is_own_group(place: Path, group: int) -> bool:
    """Whether this user is alone in a group, as on systems with a group for each user (`umask 002`)."""
    import grp
    import pwd

    try:
        name, known = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(group)
        # With an access list, the bits of the group are those of all users who are listed.
        listed = "system.posix_acl_access" in (os.listxattr(place) if hasattr(os, "listxattr") else ())
    except (KeyError, OSError):
        return False
    return known.gr_name == name and {*known.gr_mem} <= {name} and not listed


CHECKED = "checked-programs"
"""File in the cache folder with one line for each program of JAX: SHA-256, time of its last change, size and name."""


def drop_broken_programs(folder: Path) -> None:
    """Remove programs of JAX that are incomplete or were changed.

    JAX names an entry before it is complete, never replaces it, and runs its unpacked content. An entry that is found
    for the first time must unpack without an error. After that its SHA-256 must stay the same; it is computed again
    if size or time of the file changed.
    """
    known = {}
    with contextlib.suppress(OSError, ValueError):
        for line in (folder / CHECKED).read_text(encoding="utf-8").splitlines():
            digest, *unchanged, name = line.split(" ", 3)
            known[name] = digest, *map(int, unchanged)
    checked, dropped = {}, False
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith("-cache"):
                status = entry.stat(follow_symlinks=False)
                unchanged = status.st_ctime_ns, status.st_size
                digest, *before = known.get(entry.name, ("", None))
                if before != [*unchanged]:
                    digest = _check_program(Path(entry.path), digest)
                if digest:
                    checked[entry.name] = digest, *unchanged
                else:
                    dropped = True
    if dropped or checked.keys() != known.keys() or checked != known:
        from covariant._files import write_atomically  # not needed at most starts

        lines = "".join(f"{digest} {changed} {size} {name}\n" for name, (digest, changed, size) in checked.items())
        with contextlib.suppress(OSError):
            write_atomically(folder / CHECKED, lambda file: file.write(lines.encode()))


def _check_program(path: Path, digest: str) -> str:
    """Return the SHA-256 of a program of JAX; if it was changed or is incomplete, remove it and return ""."""
    with contextlib.suppress(OSError):
        content = b"" if path.is_symlink() else path.read_bytes()
        current = hashlib.sha256(content).hexdigest()
        if current == digest or (not digest and _is_complete(content)):
            return current
        path.unlink()
    return ""


def _is_complete(content: bytes) -> bool:
    """Whether a program of JAX, packed by Zstandard or else by zlib, can be unpacked."""
    try:
        if content[:4] != b"\x28\xb5\x2f\xfd":
            zlib.decompress(content)
        elif sys.version_info >= (3, 14):
            from compression import zstd

            zstd.decompress(content)
        else:
            import zstandard

            zstandard.ZstdDecompressor().decompress(content)
    except Exception:  # each library has another error; without the library JAX cannot read the entry either
        return False
    return True


def evict_unused(folder: Path) -> None:
    """Remove cached programs, of JAX and of this library, that were neither written nor read for `UNUSED` seconds."""
    for file in folder.glob("*"):
        if file.name.endswith((".so", ".json", ".made", ".tmp", "-cache")):  # .made: of versions before this one
            with contextlib.suppress(OSError):  # another process was faster, or may
                times = file.stat()
                # Many file systems do not record reads: then the time of writing counts.
                if max(times.st_atime, times.st_mtime) < time.time() - UNUSED:
                    file.unlink()


@functools.cache
def _processor() -> str:
    """A name for the instruction set of this processor."""
    known = [platform.machine()]
    listed = Path("/proc/cpuinfo")
    if listed.exists():
        lines = listed.read_text(encoding="utf-8", errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]
