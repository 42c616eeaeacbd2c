"""Files beside an exported observer: build files, a wrapper in C++, and an example of its use."""

from collections.abc import Mapping

from covariant.codegen._program import Program
from covariant.codegen._source import SENTENCE, field


def companions(program: Program, name: str, about: str, python: bool, wasm: bool) -> dict[str, str]:
    """The files beside an exported observer: CMake, Arduino, a class in C++ and a README.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C.
        about: A line that says what the observer is, for comments and texts.
        python: Whether the README lists the files of `python_files`.
        wasm: Whether it lists those of `wasm_files`.

    Returns:
        The texts by file name. The self-test is in a separate folder, which Arduino does not compile.
    """
    replacements = {
        "@PYTHON@": _PYTHON if python else "",  # before the name, which is in it
        "@WASM@": _WASM if wasm else "",
        "@NAME@": name,
        "@UPPER@": name.upper(),
        "@ABOUT@": about,
        "@SENTENCE@": SENTENCE,
        "@Y@": str(_count(program)),
        "@U@": str(max(1, program.u)),
        "@FIRST@": f"{field(program.x[-1])}{'[0]' if program.x[-1].shape else ''}",
        "@REAL@": program.real,
    }
    templates = {
        "CMakeLists.txt": _CMAKE,
        "library.properties": _ARDUINO,
        f"{name}.hpp": _CPP,
        "README.md": _README,
    }
    return {file: filled(text, replacements) for file, text in templates.items()}


def _count(program: Program) -> int:
    count = 1
    for side in program.y:
        count *= side
    return count


def filled(text: str, replacements: Mapping[str, str]) -> str:
    """A template with its placeholders replaced, in order.

    Args:
        text: The template.
        replacements: Replacements by placeholder, such as `@NAME@`.
    """
    for placeholder, replacement in replacements.items():
        text = text.replace(placeholder, replacement)
    return text


_CMAKE = """# @ABOUT@
cmake_minimum_required(VERSION 3.13)
project(@NAME@ LANGUAGES C)

add_library(@NAME@ STATIC @NAME@.c)
add_library(@NAME@::@NAME@ ALIAS @NAME@)
set_target_properties(@NAME@ PROPERTIES C_STANDARD 99 C_STANDARD_REQUIRED ON POSITION_INDEPENDENT_CODE ON)
target_include_directories(@NAME@ PUBLIC
    $<BUILD_INTERFACE:${CMAKE_CURRENT_SOURCE_DIR}> $<INSTALL_INTERFACE:include>)
if(CMAKE_C_COMPILER_ID MATCHES "GNU|Clang")
    target_compile_options(@NAME@ PRIVATE -ffp-contract=fast) # products and sums in one instruction
endif()
if(UNIX)
    target_link_libraries(@NAME@ PUBLIC m)
endif()

if(CMAKE_SOURCE_DIR STREQUAL PROJECT_SOURCE_DIR)
    enable_testing()
    add_executable(@NAME@_test test/@NAME@_test.c)
    target_link_libraries(@NAME@_test PRIVATE @NAME@)
    add_test(NAME @NAME@_test COMMAND @NAME@_test)
endif()

# find_package(@NAME@) finds what `cmake --install` puts in place.
install(TARGETS @NAME@ EXPORT @NAME@ ARCHIVE DESTINATION lib)
install(FILES @NAME@.h @NAME@.hpp DESTINATION include)
install(EXPORT @NAME@ FILE @NAME@Config.cmake NAMESPACE @NAME@:: DESTINATION lib/cmake/@NAME@)
"""

_ARDUINO = """name=@NAME@
version=1.0.0
author=exported by covariant
maintainer=you
sentence=@ABOUT@
paragraph=One plain C file without memory management.
category=Signal Input/Output
url=https://example.org
architectures=*
includes=@NAME@.h
"""

_CPP = """/* @ABOUT@
 *
 * @SENTENCE@
 */
#ifndef @UPPER@_HPP
#define @UPPER@_HPP

#include "@NAME@.h"

#include <cstddef>

namespace @NAME@ {

/* An observer with its numbers and its state. A copy goes on from where the original is. */
class Observer {
public:
    typedef @NAME@_real Real;

    explicit Observer(const @NAME@_params &numbers = @NAME@_default) : params(numbers), state_(), started_(false) {}

    bool started() const { return started_; }

    /* Start at rest at a measurement that is complete; returns the outcome. */
    int start(const Real *y, Real t = 0) {
        const int outcome = @NAME@_init(&state_, &params, y, t);
        started_ = outcome == @UPPER@_OK;
        return outcome;
    }

    /* Advance by dt [s], then correct by y. The first complete measurement starts the observer. */
    int step(const Real *y, Real dt, const Real *u = NULL, const unsigned char *missing = NULL) {
        return started_ ? @NAME@_step(&state_, &params, u, y, missing, dt) : start(y);
    }

    @NAME@_output estimate() const {
        @NAME@_output output;
        @NAME@_estimate(&state_, &params, &output);
        return output;
    }

    const @NAME@_state &state() const { return state_; }

    @NAME@_params params; /* may be changed between steps */

private:
    @NAME@_state state_;
    bool started_;
};

} /* namespace @NAME@ */

#endif
"""

_PYTHON = """| `python/@NAME@` | a Python package that needs NumPy alone; put `python` on the path |
| `python/@NAME@-….whl` | the package as a wheel for this platform, if a C compiler was found |
"""

_WASM = """| `@NAME@.wasm`, `@NAME@_wasm.c` | the observer as WebAssembly, and the C of its calls |
| `@NAME@.js` | a script for web pages and Node that holds it |
| `test/@NAME@_test.js` | its self-test: `node test/@NAME@_test.js` |
"""

_README = """# @NAME@

@ABOUT@

@SENTENCE@

| file | what it is |
|---|---|
| `@NAME@.h`, `@NAME@.c` | the observer, C99, numbers of type `@REAL@`; needs `<math.h>` and nothing else |
| `@NAME@.hpp` | a class in C++ around it |
| `test/@NAME@_test.c` | a self-test against test vectors, with a `main` of its own |
| `CMakeLists.txt`, `library.properties` | for CMake, with `find_package(@NAME@)`, and for Arduino |
| `DATASHEET.md` | what it costs, its gate, order and units of its numbers, result codes, and what it was made from |
@PYTHON@@WASM@
## Use

Call `@NAME@_init` with the first measurement, then `@NAME@_step` at each sample with the time since the one before.

```c
#include "@NAME@.h"

#include <stddef.h>

static @NAME@_state state;
static @NAME@_params params;
static int started;

/* Called by a timer: y is measured, u acted since the last call, dt has passed since then. */
double velocity_of(const @NAME@_real y[@Y@], const @NAME@_real u[@U@], @NAME@_real dt)
{
    @NAME@_output output;

    if (!started) {
        params = @NAME@_default;
        started = @NAME@_init(&state, &params, y, 0) == @UPPER@_OK;
        return 0;
    }
    if (@NAME@_step(&state, &params, u, y, NULL, dt) == @UPPER@_NOT_FINITE)
        started = 0; /* start again at the next sample */
    @NAME@_estimate(&state, &params, &output);
    return (double)output.@FIRST@;
}
```

Numbers in `params` may be changed between two steps: copy `@NAME@_default` and change the copy. A copy of a state is a
snapshot, from which the observer goes on. Each function uses only what it is given, so that several observers may run
in several threads.

## Test

    cc -std=c99 -O2 -I. @NAME@.c test/@NAME@_test.c -lm -o @NAME@_test && ./@NAME@_test

Do not compile with `-ffast-math`: missing measurements are NaN. `-ffp-contract=fast` is allowed, and saves a
tenth of the instructions where a product and a sum are one.
"""
