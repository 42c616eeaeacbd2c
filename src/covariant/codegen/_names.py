"""Checks names of exports, which must not be reserved or used in C, C++, JavaScript, Python, CMake or file systems.

The name of an export is the prefix of all names in its C code. It is also a namespace of C++, an object of JavaScript,
a module of Python, a target of CMake and part of the names of files.
"""

import keyword
import re
import sys

from scalargraph import check_name
from scalargraph.errors import InputError

LONGEST = 63
"""Number of letters of a name that every C99 compiler distinguishes (C99, 5.2.4.1)."""

_HEADERS = (
    "assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdalign stdarg stdatomic "
    "stdbool stddef stdint stdio stdlib stdnoreturn string tgmath threads time uchar wchar wctype "
    "aio alloca dirent dlfcn endian features fcntl fnmatch ftw getopt glob grp iconv langinfo libgen malloc memory "
    "mqueue netdb poll pthread pwd regex sched search semaphore spawn strings syslog tar termios unistd utime values "
    "wordexp conio direct io process tchar windows"
)
"""Headers of C, POSIX and Windows, which the header of an export would hide if its folder were searched first."""
_POSIX = (
    "accept access alarm bind brk chdir chmod close connect daylight dup environ execl execv fileno fork getopt getpid "
    "index ioctl kill link listen mkdir nice open optarg opterr optind optopt pause pipe poll popen random read recv "
    "rindex select send sleep socket srandom stat sync times timezone truncate tzname usleep wait write "
    "cnd mtx sem posix std"
)
"""Functions and variables of POSIX, reserved namespaces, and names for which `NAME_init` already exists."""
_ARDUINO = "setup loop bit boolean byte word sq min max far near small interface PI HIGH LOW INPUT OUTPUT DEFAULT F"
"""Functions, types and macros of Arduino and of Windows."""
_BUILD = (
    "all clean help install package package_source rebuild_cache edit_cache test list_install_components ALL_BUILD "
    "INSTALL PACKAGE RUN_TESTS ZERO_CHECK c dl gcc m rt util"
)
"""Targets of CMake, and system libraries that a library of the same name would hide."""
_JAVASCRIPT = (
    "arguments await debugger enum eval export extends finally function implements import in instanceof interface let "
    "null package super typeof undefined var void with yield"
)
"""Reserved words of JavaScript."""
_GLOBALS = (
    "Array ArrayBuffer Boolean Buffer DataView Date Error Float32Array Float64Array Function Infinity JSON Map Math "
    "NaN Number Object Promise Proxy RangeError Reflect RegExp Set String Symbol Uint8Array WebAssembly "
    "alert atob blur btoa close closed confirm console crypto customElements document event external fetch find focus "
    "frames global globalThis history isFinite isNaN length location locationbar menubar module moveTo name navigator "
    "open opener origin parent parseFloat parseInt performance personalbar print process prompt require screen scroll "
    "scrollbars self status statusbar stop structuredClone toolbar top window"
)
"""Properties of the global object of a page or of Node. Some cannot be set, and setting `location` loads a page."""
_PACKAGES = "numpy covariant pip setuptools wheel"
"""Packages that an exported package would hide: it needs numpy, and the others install it."""


def check_export_name(name: str, python: bool = False, wasm: bool = False) -> None:
    """Check that an export may have a name; raises `ValueError` otherwise.

    Names of Python modules are refused only with `python`, and JavaScript globals only with `wasm`.
    """
    check_name(name)
    kinds = (
        (_ARDUINO, "a name of Arduino or of Windows"),
        (_HEADERS, "a header of the system"),
        (_POSIX, "a name of POSIX or a namespace that C++ reserves"),
        (_BUILD, "a target of CMake or a library of the system"),
        (_JAVASCRIPT, "a word of JavaScript"),
        (" ".join(keyword.kwlist), "a word of Python"),
        (_GLOBALS if wasm else "", "a global of JavaScript"),
        (" ".join((*sys.stdlib_module_names, _PACKAGES)) if python else "", "a module of Python"),
    )
    for names, kind in kinds:
        if name in names.split():
            raise InputError(f"{name!r} is {kind}; take another name, such as 'my_{name}'")
    if re.fullmatch(r"con|prn|aux|nul|(com|lpt)[0-9]", name, re.IGNORECASE):
        raise InputError(f"{name!r} is a device of Windows, which has no file {name}.c; take another name")
    if "__" in name or name.endswith("_"):
        raise InputError(f"{name!r}: C++ reserves names with two underscores in a row, as in {name}_init; take another")
    if len(name) > LONGEST:
        raise InputError(f"{name[:20]!r}… has {len(name)} letters; take at most {LONGEST}")


def export_name(text: str, python: bool = False, wasm: bool = False) -> str:
    """Derive the name of an export from the name of a model."""
    plain = re.sub(r"[\W_]+", "_", text, flags=re.ASCII).strip("_").lower()
    try:
        check_export_name(plain[:LONGEST].rstrip("_"), python, wasm)
    except InputError:  # for example if it begins with a digit
        plain = f"observer_{plain}"
    return plain[:LONGEST].rstrip("_")
