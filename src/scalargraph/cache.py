"""Finds and protects the cache folder of compiled code: one for each user and each kind of processor.

Files in the folder run as code. Therefore only its owner may be able to write there, and each entry is compared with
its SHA-256 before it is loaded. Other processes of the owner can replace a file together with its hash; the hash does
not protect against them.
"""

import contextlib
import functools
import hashlib
import os
import platform
import shlex
import stat
import time
import warnings
from pathlib import Path

from platformdirs import user_cache_path

OFF = ("off", "0", "no")
"""Values of the environment variable that disable the cache."""
UNUSED = 180 * 24 * 3600.0
"""Time [s] without use after which a program is removed; otherwise programs of old versions would accumulate."""


_name = ["scalargraph", "SCALARGRAPH_CACHE"]
"""Name of the folder within the user's cache folder, and of the environment variable that selects another folder."""


def name_cache(folder: str, variable: str) -> None:
    """Set the name of the cache of this process; a library that is built on this one uses its own name."""
    _name[:] = folder, variable


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
    except (OSError, RuntimeError):  # no home folder exists, or it is not writable
        pass
    return None


def open_cache_folder() -> Path | None:
    """Return the cache folder, or None if its variable disables it; raises `OSError` if it cannot be used."""
    name, variable = _name
    chosen = os.environ.get(variable, "")
    if chosen.lower() in OFF:
        return None
    folder = Path(chosen).expanduser() if chosen else user_cache_path(name, appauthor=False)
    if not chosen and not folder.is_absolute():  # "~" was not replaced, because the system knows no home folder
        raise FileNotFoundError("there is no home folder")
        # Each instruction set has a folder of its own, since a program may not run on another processor. Links are
        # resolved before the check, so that the folder that is checked is the folder that is used.
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


def need_private(folder: Path, alone: bool = False, setting: str | None = None) -> None:
    """Check that no other user can replace the content of a folder; raises `SharedFolderError`.

    With `alone`, it also checks that no other user can create files in it. The message names the environment variable
    `setting`, by which another folder can be chosen.
    """
    if not hasattr(os, "getuid"):  # Windows: the folders of a user are closed to others by access lists
        return
    setting = setting or _name[1]
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
            if inside:  # anyone who could write there may have left an entry with a matching hash
                remedy = f"remove it by rm -r {shlex.quote(str(place))}"
            raise SharedFolderError(f"other users can write to {place}; {remedy}, or set {setting} to another one")


def _is_own_group(place: Path, group: int) -> bool:
    """Whether this user is alone in a group, as on systems with a group for each user (`umask 002`)."""
    import grp
    import pwd

    try:
        name, known = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(group)
        # With an access control list, the group bits are those of all listed users, not of the group alone.
        listed = "system.posix_acl_access" in (os.listxattr(place) if hasattr(os, "listxattr") else ())
    except (KeyError, OSError):
        return False
    return known.gr_name == name and {*known.gr_mem} <= {name} and not listed


def evict_unused(folder: Path) -> None:
    """Remove cached programs, of JAX and of this library, that were neither written nor read for `UNUSED` seconds."""
    for file in folder.glob("*"):
        if file.name.endswith((".so", ".json", ".made", ".tmp", "-cache")):  # .made: of versions before this one
            with contextlib.suppress(OSError):  # another process may have removed it already
                times = file.stat()
                # Many file systems do not record reads; the time of the last write counts there.
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
