"""C of a functional mock-up unit: the observer behind the functions of FMI 3.0 or 2.0 for co-simulation.

Source: Modelica Association 2022, Functional Mock-up Interface Specification 3.0, and 2.0.4 of the same year.
"""

from collections.abc import Sequence

import numpy as np

from covariant.codegen import _fmi2, _fmi3
from covariant.codegen._program import Leaf, Program
from covariant.codegen._source import entries
from covariant.lowering import c_number


def unit_source(
    program: Program, name: str, version: str, token: str, sizes: Sequence[int], starts: Sequence[float]
) -> str:
    """The C source of a unit, beside that of the observer.

    Args:
        program: The observer as graphs.
        name: Prefix of all names in C.
        version: Version of FMI, "3.0" or "2.0".
        token: Token, or GUID, which the description has too.
        sizes: Number of entries of each variable: measurement, input, parameters, outputs.
        starts: First values of the first of these entries; all others are zero.
    """
    parameters = [Leaf(key, np.shape(value)) for key, value in program.numbers.items()]
    outputs = [Leaf(leaf.name, leaf.shape) for leaf in (*program.x, *program.told)]
    inputs = int(np.prod(program.y)) + program.u
    at = inputs
    reads, writes = [], []
    for leaf in parameters:
        reads += [f"    params->{e} = ({name}_real)m->numbers[{at + i}];" for i, e in enumerate(entries("", leaf))]
        at += leaf.size
    for leaf in outputs:
        writes += [f"    m->numbers[{at + i}] = (double)output->{e};" for i, e in enumerate(entries("", leaf))]
        at += leaf.size
    firsts = np.cumsum([0, *sizes])[:-1].tolist()
    # `forget` sets all numbers to zero first.
    start = [f"    m->numbers[{i}] = {c_number(v)};" for i, v in enumerate(starts) if v != 0]
    replacements = {
        "@NAME@": name,
        "@UPPER@": name.upper(),
        "@TOKEN@": token,
        "@NUMBERS@": str(at),
        "@INPUTS@": str(inputs),
        "@OUTPUTS@": str(at - sum(leaf.size for leaf in outputs)),
        "@VARIABLES@": str(len(sizes)),
        "@FIRSTS@": ", ".join(map(str, firsts)),
        "@SIZES@": ", ".join(map(str, sizes)),
        # Without parameters the structure has one unused member, which C demands, and m is not read.
        "@TAKEN@": "\n".join(reads) or "    (void)m;\n    params->unused = 0;",
        "@SHOWN@": "\n".join(writes),
        "@START@": "\n".join(start),
    }
    kind = _fmi3 if version == "3.0" else _fmi2
    text = _CORE + _SHARED + kind.FUNCTIONS + "\n".join(_refused(line, version) for line in kind.REFUSED)
    for placeholder, replacement in (replacements | kind.WORDS).items():
        text = text.replace(placeholder, replacement)
    return text


def _refused(line: str, version: str) -> str:
    """A function that this unit does not have: it returns an error or, where nothing is asked for, none."""
    name, _, kinds = line.partition(" ")
    parameters = kinds.split(",") if kinds else ["void *"]
    names = [f"a{i}" for i in range(len(parameters))]
    declared = ", ".join(f"{kind.strip()} {n}".replace("* ", "*") for kind, n in zip(parameters, names, strict=True))
    ignored = "".join(f"    (void){n};\n" for n in names)
    instance = name.startswith("Instantiate")
    asked = next((n for n, kind in zip(names, parameters, strict=True) if kind.strip() == "size_t"), None)
    # A function that asks for no values, n = 0, has nothing to refuse.
    result = "NULL" if instance else "ERROR" if asked is None else f"{asked} == 0 ? OK : ERROR"
    kind = "void *" if instance else "int "
    return f"EXPORT {kind}fmi{version[0]}{name}({declared})\n{{\n{ignored}    return {result};\n}}\n"


_CORE = """/* The observer @NAME@ as a functional mock-up unit, of which its own header and source know nothing. */
#include "@NAME@.h"

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#elif defined __GNUC__
#define EXPORT __attribute__((visibility("default")))
#else
#define EXPORT
#endif

#define TOKEN "@TOKEN@"
#define NUMBERS @NUMBERS@ /* measurement, input, parameters, then outputs */
#define INPUTS @INPUTS@
#define OUTPUTS @OUTPUTS@ /* where they begin */

enum { OK = 0, ERROR = 3 };

/* All of an instance; a copy is a snapshot. */
typedef struct {
    double numbers[NUMBERS];
    @NAME@_real acted[@UPPER@_INPUTS + 1]; /* the input since the last measurement */
    @NAME@_state state;                    /* after the last measurement, at the time t */
    double t, now;
    int32_t started, stepped, outcome;
} memory;

static void take(const memory *m, @NAME@_params *params)
{
@TAKEN@
}

static void show(memory *m, const @NAME@_output *output)
{
@SHOWN@
}

static void forget(memory *m)
{
    int i;
    memset(m, 0, sizeof *m);
@START@
    for (i = OUTPUTS; i < NUMBERS; ++i)
        m->numbers[i] = NAN;
}

static void tell(memory *m, const @NAME@_state *state, const @NAME@_params *params)
{
    @NAME@_output output;
    @NAME@_estimate(state, params, &output);
    show(m, &output);
}

/* Start at the measurement, where it is complete. */
static void begin(memory *m, double t)
{
    @NAME@_params params;
    @NAME@_real y[@UPPER@_MEASUREMENTS];
    int i;
    for (i = 0; i < @UPPER@_MEASUREMENTS; ++i)
        y[i] = (@NAME@_real)m->numbers[i];
    take(m, &params);
    m->outcome = @NAME@_init(&m->state, &params, y, (@NAME@_real)t);
    m->started = m->outcome == @UPPER@_OK;
    if (!m->started)
        m->outcome = @UPPER@_COASTED;
    m->t = m->now = t;
    if (m->started)
        tell(m, &m->state, &params);
}

/* From t to t + h: the measurement is of the time t, where it corrects; the outputs are predicted to t + h. */
static void advance(memory *m, double t, double h)
{
    @NAME@_params params;
    @NAME@_state ahead;
    @NAME@_real y[@UPPER@_MEASUREMENTS];
    unsigned char missing[@UPPER@_MEASUREMENTS];
    int i;
    take(m, &params);
    for (i = 0; i < @UPPER@_MEASUREMENTS; ++i) {
        y[i] = (@NAME@_real)m->numbers[i];
        missing[i] = 1;
    }
    if (!m->started || !m->stepped) {
        begin(m, t);
    } else if (t > m->t) {
        m->outcome = @NAME@_step(&m->state, &params, m->acted, y, NULL, (@NAME@_real)(t - m->t));
        m->started = m->outcome != @UPPER@_NOT_FINITE;
        m->t = t;
    }
    m->stepped = m->started;
    m->now = t + h;
    for (i = 0; i < @UPPER@_INPUTS; ++i)
        m->acted[i] = (@NAME@_real)m->numbers[@UPPER@_MEASUREMENTS + i];
    if (!m->started)
        return;
    ahead = m->state;
    if (h > 0)
        (void)@NAME@_step(&ahead, &params, m->acted, y, missing, (@NAME@_real)h);
    tell(m, &ahead, &params);
}

static void *snapshot(const memory *m, void *place)
{
    memory *copy = place != NULL ? place : malloc(sizeof *copy);
    if (copy != NULL)
        *copy = *m;
    return copy;
}

static memory *instance(const char *token)
{
    memory *m = token != NULL && strcmp(token, TOKEN) == 0 ? malloc(sizeof *m) : NULL;
    if (m != NULL)
        forget(m);
    return m;
}

"""

_SHARED = """EXPORT void @FMI@FreeInstance(void *m)
{
    free(m);
}

EXPORT int @FMI@ExitInitializationMode(void *m)
{
    if (m == NULL)
        return ERROR;
    begin(m, ((memory *)m)->now);
    return OK;
}

EXPORT int @FMI@Terminate(void *m)
{
    return m != NULL ? OK : ERROR;
}

EXPORT int @FMI@Reset(void *m)
{
    if (m == NULL)
        return ERROR;
    forget(m);
    return OK;
}

EXPORT int @FMI@GetFMU@STATE@(void *m, void **state)
{
    if (m == NULL || state == NULL)
        return ERROR;
    *state = snapshot(m, *state);
    return *state != NULL ? OK : ERROR;
}

EXPORT int @FMI@SetFMU@STATE@(void *m, void *state)
{
    return m != NULL && state != NULL && snapshot(state, m) != NULL ? OK : ERROR;
}

EXPORT int @FMI@FreeFMU@STATE@(void *m, void **state)
{
    (void)m;
    if (state == NULL)
        return OK;
    free(*state);
    *state = NULL;
    return OK;
}

EXPORT int @FMI@SerializedFMU@STATE@Size(void *m, void *state, size_t *size)
{
    (void)m, (void)state;
    *size = sizeof(memory);
    return OK;
}

EXPORT int @FMI@SerializeFMU@STATE@(void *m, void *state, @BYTE@ *bytes, size_t size)
{
    (void)m;
    if (state == NULL || size != sizeof(memory))
        return ERROR;
    memcpy(bytes, state, size);
    return OK;
}

EXPORT int @FMI@@DE@FMU@STATE@(void *m, const @BYTE@ *bytes, size_t size, void **state)
{
    (void)m;
    if (size != sizeof(memory) || state == NULL || (*state == NULL && (*state = malloc(size)) == NULL))
        return ERROR;
    memcpy(*state, bytes, size);
    return OK;
}

"""
"""Functions that are the same in both versions but for names and types."""
