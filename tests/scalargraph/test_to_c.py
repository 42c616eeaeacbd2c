"""`to_c` writes complete files of C that compute what JAX computes, and refuses what has no such form."""

import ctypes
import math
import re
import shutil
import subprocess
from collections import OrderedDict
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scalargraph import LoweringError, to_c

COMPILER = shutil.which("gcc") or shutil.which("cc") or ""
compiles = pytest.mark.skipif(not COMPILER, reason="there is no C compiler, `gcc` or `cc`")
FLAGS = "-std=c99 -O1 -Wall -Wextra -Wpedantic -Wconversion -Wdouble-promotion -Wmissing-prototypes -Wshadow -Werror"
TYPES = {"double": np.float64, "float": np.float32}


class Motion(NamedTuple):
    position: jax.Array
    velocity: jax.Array


def swing(q, v, dt):
    """Two pendulums that are coupled, one step of semi-implicit Euler."""
    force = jnp.array([[-9.81, 0.5], [0.5, -9.81]], q.dtype) @ jnp.sin(q) - 0.1 * v * jnp.abs(v)
    v = v + dt * force
    return Motion(q + dt * v, v)


def relations(x, y):
    return {"less": x < y, "rank": jnp.argmax(x), "largest": jnp.maximum(x, y[0]), "none": jnp.zeros((0, 2))}


def halvings(x):
    """A loop whose length depends on the argument."""
    return jax.lax.while_loop(lambda z: jnp.abs(z) > 1.0, lambda z: z / 2.0, x)


def repeated(x):
    """A loop of known length with much work in a turn, which stays a loop."""
    return jax.lax.fori_loop(0, 5, lambda _, z: jnp.tanh(z @ z.T) @ z / 40.0 + jnp.cos(x), x)


def looked_up(x):
    table = jnp.asarray(np.linspace(0.0, 1.0, 100) ** 2, x.dtype)
    return jax.lax.dynamic_slice(table, (jnp.floor(10.0 * jnp.abs(x)).astype(int),), (2,)) * x


def by_cases(x):
    return jax.lax.cond(x > 0.0, jnp.sin, jnp.cos, x)


def by_long_cases(a):
    """A branch that is long enough to be left out where it is not taken, on numbers and a statement."""

    def taken(a, p):
        return jnp.tanh(a @ a) @ a, ~p

    return jax.lax.cond(a[0, 0] > 0.0, taken, lambda a, p: (a, p), a, a[0, 1] > 0.0)[0]


def over_rows(a):
    """A turn that is long enough to stay a loop, over rows in the order from the last to the first, with a branch."""

    def turn(total, row):
        return jax.lax.cond(row[0, 0] > 0.0, lambda t, r: jnp.tanh(t @ r), lambda t, r: t - 1.0, total, row), None

    return jax.lax.scan(turn, a[0], a, reverse=True)[0]


FUNCTIONS = {
    "scalar": (lambda x: jnp.sin(x) * x, [()]),
    "vector": (lambda x: x / (1.0 + jnp.sum(x**2)), [(5,)]),
    "matrix by vector": (lambda a, x: a @ x, [(4, 3), (3,)]),
    "outer product": (lambda x, y: jnp.exp(jnp.outer(x, y)), [(2,), (3,)]),
    "transpose": (lambda a: a.T, [(2, 3)]),
    "three axes": (lambda a: jnp.einsum("ijk->kij", a) - a[0, 0, 0], [(2, 3, 4)]),
    "named tuple": (swing, [(2,), (2,), ()]),
    "dictionary": (relations, [(3,), (3,)]),
    "gradient": (jax.grad(lambda x: jnp.sum(jnp.tanh(x) ** 3)), [(4,)]),
    "determinant": (jnp.linalg.det, [(3, 3)]),
    "in parts": (lambda a: jnp.tanh(a @ a) @ jnp.tanh(a.T), [(8, 8)]),
    "loop of unknown length": (halvings, [()]),
    "loop of known length": (repeated, [(8, 8)]),
    "branch": (by_cases, [()]),
    "long branch": (by_long_cases, [(8, 8)]),
    "long branch where it does not hold": (lambda a: by_long_cases(-a), [(8, 8)]),
    "rows of a loop": (over_rows, [(3, 8, 8)]),
    "table": (looked_up, [()]),
    "empty argument": (lambda x, e: x + jnp.sum(e), [(2,), (0, 3)]),
    "no argument": (lambda: jnp.arange(3.0), []),
    "argument that is not used": (lambda x, y: 2.0 * y, [(2,), (3,)]),
}


def compiled(text, folder, name="f"):
    """The C function of a file that is compiled on its own, with all warnings as errors."""
    (folder / "f.c").write_text(text)
    subprocess.run([COMPILER, *FLAGS.split(), "-c", "-fPIC", "f.c", "-o", "f.o"], cwd=folder, check=True)
    subprocess.run([COMPILER, "-shared", "f.o", "-o", "f.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "f.so"))[name]


def called(function, arguments, results, dtype):
    """The results of a C function, with `margin` behind each array that must stay as it was."""
    margin = 7.0
    ins = [np.append(np.ravel(x), margin).astype(dtype) for x in arguments]
    outs = [np.full(np.size(y) + 1, margin, dtype) for y in results]
    function(*(array.ctypes.data_as(ctypes.c_void_p) for array in (*ins, *outs)))
    assert all(array[-1] == margin for array in (*ins, *outs))
    return [array[:-1].reshape(np.shape(y)) for array, y in zip(outs, results, strict=True)]


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler")
@pytest.mark.parametrize("name", ["in parts", "rows of a loop", "table"])
def test_the_file_compiles_as_cpp_too(name, tmp_path):
    function, shapes = FUNCTIONS[name]
    (tmp_path / "f.cpp").write_text(to_c(function, *map(jnp.zeros, shapes)))
    subprocess.run(["g++", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-c", "f.cpp"], cwd=tmp_path, check=True)


@pytest.mark.core(3)
@compiles
@pytest.mark.parametrize("real", TYPES)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_compiled_c_computes_what_jax_computes(name, real, tmp_path):
    function, shapes = FUNCTIONS[name]
    dtype, rng = TYPES[real], np.random.default_rng(len(name))
    text = to_c(function, *map(jnp.zeros, shapes), real=real)
    in_c = compiled(text, tmp_path)
    in_jax = jax.jit(function)
    for _ in range(10):
        arguments = [jnp.asarray(rng.normal(size=shape), dtype) for shape in shapes]
        expected = [np.asarray(leaf) for leaf in jax.tree.leaves(in_jax(*arguments))]
        results = called(in_c, arguments, expected, dtype)
        for ours, theirs in zip(results, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=100 * np.finfo(dtype).eps, atol=100 * np.finfo(dtype).eps)


def test_single_precision_has_no_number_of_double_precision():
    text = to_c(swing, *map(jnp.zeros, [(2,), (2,), ()]), real="float")
    assert "double" not in text
    assert "sinf(" in text
    assert re.findall(r"\d\.\d+(?![\df])", text) == []


def test_the_head_says_arguments_shapes_and_order():
    text = to_c(swing, np.zeros(2), jax.ShapeDtypeStruct((2,), jnp.float32), 0.0, name="swing")
    head, _, code = text.partition("*/")
    assert head.splitlines()[2:9] == [
        " * Arguments:",
        " *   in1[2]  q, shape (2,)",
        " *   in2[2]  v, shape (2,)",
        " *   in3[1]  dt, shape ()",
        " * Results:",
        " *   out1[2]  result.position, shape (2,)",
        " *   out2[2]  result.velocity, shape (2,)",
    ]
    assert "row-major" in head
    declared = "void swing(const double *in1, const double *in2, const double *in3, double *out1, double *out2)"
    assert f"\n#include <math.h>\n\n{declared};\n\n{declared}\n{{\n" in code


def test_truth_values_and_whole_numbers_are_said_to_be_such():
    text = to_c(relations, np.zeros(3), np.zeros(3))
    assert "result['less'], shape (3,), 0 for false and 1 for true\n" in text
    assert "result['rank'], shape (), whole numbers\n" in text


@compiles
def test_arguments_are_pytrees_too_and_keys_may_be_any_text(tmp_path):
    keys = OrderedDict({"*/ int x; /*": 1.0, "ü\n": np.ones((2, 1)), "\\": 3.0})
    text = to_c(lambda state, *rest: state["ü\n"] * rest[1], keys, 0.0, 0.0)
    assert text.isascii()
    assert re.findall(r"in\d\[\d\]  (.*), shape", text) == [
        "state['* / int x; / *']",
        r"state['\xfc\n']",
        r"state['\\']",
        "rest[0]",
        "rest[1]",
    ]
    (result,) = called(
        compiled(text, tmp_path), [1.0, np.array([[2.0], [3.0]]), 4.0, 5.0, 6.0], [np.ones((2, 1))], float
    )
    np.testing.assert_array_equal(result, [[12.0], [18.0]])


@pytest.mark.core(2)
@compiles
@pytest.mark.parametrize("name", ["x", "in", "out", "in1", "v0", "p0", "l0", "reals", "truths", "i", "a", "f_1"])
def test_names_of_the_file_itself_do_no_harm(name, tmp_path):
    """Shadowing is no error of C; what is computed must be right."""
    text = to_c(lambda a, x: jnp.maximum(jnp.tanh(a @ a) @ a, x), np.zeros((8, 8)), 0.0, name=name)
    rng = np.random.default_rng(1)
    a = rng.normal(size=(8, 8))
    (tmp_path / "f.c").write_text(text)
    subprocess.run([COMPILER, "-std=c99", "-shared", "-fPIC", "f.c", "-o", "f.so", "-lm"], cwd=tmp_path, check=True)
    expected = np.maximum(np.tanh(a @ a) @ a, 0.2)
    (result,) = called(ctypes.CDLL(str(tmp_path / "f.so"))[name], [a, 0.2], [expected], float)
    np.testing.assert_allclose(result, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (["while", "restrict"], "a keyword of C"),
        (["class"], r"a keyword of C or C\+\+"),
        (["sin", "sinf", "y0", "free", "main", "NULL", "uint8_t"], "a name of the C library"),
        (["", "2nd", "_f", "f(", "größe", "f\n"], "no name in C"),
    ],
)
def test_names_that_a_function_of_c_cannot_have_are_refused(names, reason):
    for name in names:
        with pytest.raises(ValueError, match=reason):
            to_c(jnp.sin, 0.0, name=name)


def by_callback(x):
    return jax.pure_callback(math.sin, jax.ShapeDtypeStruct((), x.dtype), x)


@pytest.mark.parametrize(
    ("function", "example", "operation"),
    [
        (by_callback, 0.0, "'pure_callback' has no graph of scalars"),
        (jnp.linalg.inv, np.eye(3), "'lu' has no graph of scalars"),
        (jnp.sort, np.zeros(3), "'sort' has no graph of scalars"),
        (lambda x: jnp.abs(jax.lax.complex(x, x)), 0.0, "complex128, which is no real number"),
    ],
)
def test_functions_that_have_no_form_in_c_are_refused_by_name(function, example, operation):
    with pytest.raises(LoweringError, match=operation):
        to_c(function, example)


@pytest.mark.parametrize(
    ("example", "where"),
    [
        ("text", "x is 'text', of the type str"),
        (None, "x is None, of the type NoneType"),
        (object(), "of the type object"),
        (1, "x is 1, of the type int"),
        (True, "of the type bool"),
        (1j, "of the type complex"),
        (np.arange(3), "of the type int"),
        ([0.0, {"a": np.array("b")}], r"x\[1\]\['a'\] is array\('b'"),
    ],
)
def test_examples_that_are_no_real_numbers_are_refused(example, where):
    with pytest.raises(TypeError, match=f"example of {where}" if where.startswith("x") else where):
        to_c(lambda x: x, example)


def test_what_else_is_wrong_is_refused():
    with pytest.raises(ValueError, match="real is 'half'"):
        to_c(jnp.sin, 0.0, real="half")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="f: the function returns no array"):
        to_c(lambda x: None, 0.0)
    with pytest.raises(TypeError, match="positional argument"):
        to_c(lambda x: x, 0.0, 0.0)


def test_the_text_depends_on_the_shapes_alone():
    kinds = (np.zeros, lambda s: jnp.ones(s, jnp.float32), lambda s: jax.ShapeDtypeStruct(s, float))
    assert len({to_c(lambda a, x: a @ x, *map(kind, [(4, 3), (3,)])) for kind in kinds}) == 1
