"""A graph as C99: a function of scalars without memory management, or variables outside it.

The text depends on the graph alone, so that it is the same on every machine. Numbers are written with as many digits as
identify them. A long function is written as several of limited length, since compilers take more than linear time;
values that one of them leaves to another stand in an array on the stack, whose places are used again.
"""

import itertools
import re
import textwrap
from collections import Counter
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

from covariant.lowering._c_operations import (
    HELPERS,
    LIBRARY,
    TRUTHS,
    Words,
    expression,
    helpers,
    literal,
    looked_up,
    of_truth,
)
from covariant.lowering._graph import Graph
from covariant.lowering._loops import Repetition
from covariant.lowering._lowered import Lowered
from covariant.lowering._peephole import simplified

Real = Literal["double", "float"]

MOST_STATEMENTS = 500
"""Longest function: gcc takes minutes for one with ten thousand statements, and seconds for the same in parts."""
MOST_IN_LANES = 2000
"""The same in lanes, where what one function leaves to another takes so many times the memory."""
LONGEST_EXPRESSION = 60
"""Longest expression [characters] that is written into the one that uses it."""


class Signature(NamedTuple):
    """How a C function gets its arguments.

    - `declared`: its parameters as declared, such as `const double *x, double *y`; `passed`: their names, `("x", "y")`.
    - `inputs`, `outputs`: C expressions of all inputs and results, such as `x[0]`; results must not overlap inputs.
    """

    declared: str
    passed: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class CText(NamedTuple):
    """C of a function.

    - `text`: the function with those that it calls, all but the last of them `static`.
    - `helpers`: names of the `c_helpers` it calls.
    - `operations`: how many of each kind a call does, the same in every call.
    - `scratch`: numbers on its stack beside its variables.
    """

    text: str
    helpers: frozenset[str]
    operations: Counter[str]
    scratch: int


def c_function(
    lowered: Lowered,
    name: str,
    signature: Signature | None = None,
    real: Real = "double",
    prefix: str = "",
    static: bool = False,
    most_statements: int | None = None,
    lanes: int = 1,
) -> CText:
    """A lowered function as C.

    - `signature`: by default `void name(const real *x, real *y)`, from all inputs to all results.
    - `real`: the type of all numbers. For "float" lower the function with arguments of single precision.
    - `prefix`: of the names of the helpers that it calls, which `c_helpers` writes.
    - `lanes`: how many arguments it is evaluated for at once, a power of 2. Above 1 a number is a vector of the
      compilers gcc and clang, of the type `{prefix}lanes`, with one entry for each argument.

    Raises `ValueError` where the signature has another number of inputs or results.
    """
    lowered = simplified(lowered)
    chosen = signature or _flat(lowered, Words(real, prefix, lanes).real)
    for what, given, needed in (
        ("inputs", chosen.inputs, lowered.inputs),
        ("results", chosen.outputs, len(lowered.outputs)),
    ):
        if len(given) != needed:
            raise ValueError(f"{name}: the function has {needed} {what}; the signature names {len(given)}")
    most = most_statements or (MOST_STATEMENTS if lanes == 1 else MOST_IN_LANES)
    return _Writer(lowered, name, chosen, Words(real, prefix, lanes), static, most).written()


def c_helpers(names: Sequence[str] | frozenset[str], real: Real = "double", prefix: str = "", lanes: int = 1) -> str:
    """The static functions, and for lanes the types, of C of graphs, to stand before it; it needs <math.h>."""
    return helpers(names, Words(real, prefix, lanes))


def c_number(value: float, real: Real = "double") -> str:
    """A number in C, in the fewest digits that identify it."""
    return literal(value, Words(real, ""))


def _flat(lowered: Lowered, real: str) -> Signature:
    inputs = tuple(f"x[{i}]" for i in range(lowered.inputs))
    outputs = tuple(f"y[{i}]" for i in range(len(lowered.outputs)))
    return Signature(f"const {real} *x, {real} *y", ("x", "y"), inputs, outputs)


class _Writer:
    """Writes one function: orders its nodes, cuts the list into parts, and finds places for what goes between them."""

    def __init__(
        self, lowered: Lowered, name: str, signature: Signature, words: Words, static: bool, most_statements: int
    ):
        self.graph, self.outputs = lowered.graph, lowered.outputs
        self.name, self.signature, self.words, self.static = name, signature, words, static
        self.truth = truths(self.graph)
        order = _order(self.graph, self.outputs)
        self.inside = self._inside(order)
        statements = [i for i in order if i not in self.inside]
        self.parts = _parts(self.graph, statements, most_statements)
        self.loops = self._loops([i for i in statements if self.graph.nodes[i].op == "loop"], most_statements)
        self.part = {i: k for k, part in enumerate(self.parts) for i in part}
        looked_up = dict.fromkeys(self.graph.nodes[i].value for i in statements if self.graph.nodes[i].op == "table")
        self.tables: dict[Any, str] = {table: f"{name}_table{k + 1}" for k, table in enumerate(looked_up)}

    def written(self) -> CText:
        places, counts = self._places()
        last = len(self.parts) - 1
        sizes = (("real", self.words.real, counts[False]), ("truth", self.words.truth, counts[True]))
        arrays = [(f"{kind}s", c, size) for kind, c, size in sizes if size]
        rest = "".join(f", {c} *restrict {array}" for array, c, _ in arrays)
        parts = [_array(name, table.numbers, self.words) for table, name in self.tables.items()]
        parts += [text for loop in self.loops.values() for text in loop.texts]
        for k, part in enumerate(self.parts):
            lines = self._lines(k, part, places)
            if last == 0:
                parts.append(self._function(self.name, self.static, "", lines))
            else:
                parts.append(self._function(f"{self.name}_{k + 1}", True, rest, lines, [a for a, _, _ in arrays]))
        if last > 0:
            calls = ", ".join([*self.signature.passed, *(array for array, _, _ in arrays)])
            lines = [f"{c} {array}[{size}];" for array, c, size in arrays]
            parts.append(
                self._function(
                    self.name, self.static, "", [*lines, *(f"{self.name}_{k + 1}({calls});" for k in range(last + 1))]
                )
            )
        operations = Counter(node.op for node in self.graph.nodes if node.op not in _NO_OPERATIONS)
        used = frozenset(h for i in range(len(self.graph.nodes)) for h in self._helpers(i))
        scratch = sum(counts.values())
        for loop in self.loops.values():
            operations += loop.operations
            used |= loop.helpers
            scratch += loop.scratch
        return CText("\n".join(parts), used, operations, scratch)

    def _loops(self, nodes: Sequence[int], most_statements: int) -> dict[int, "_LoopText"]:
        """The functions of the loops, by their nodes."""
        return {
            i: _loop(self.graph.nodes[i].value, f"{self.name}_loop{k + 1}", self.words, most_statements)
            for k, i in enumerate(nodes)
        }

    def _helpers(self, i: int) -> list[str]:
        node = self.graph.nodes[i]
        if node.op == "stumpff":
            return [f"stumpff{int(self.graph.nodes[node.arguments[0]].value)}"]  # pyright: ignore[reportArgumentType]
        return [node.op] if node.op in HELPERS or (node.op in LIBRARY and self.words.lanes > 1) else []

    def _function(self, name: str, static: bool, rest: str, lines: list[str], arrays: Sequence[str] = ()) -> str:
        body = "\n".join(f"    {line}" for line in lines)
        unused = [p for p in (*self.signature.passed, *arrays) if not _mentions(body, p)]
        ignored = "".join(f"    (void){p};\n" for p in unused)
        head = f"{'static ' if static else ''}void {name}({self.signature.declared}{rest})"
        return f"{head}\n{{\n{ignored}{body}\n}}\n"

    def _inside(self, order: list[int]) -> set[int]:
        """The nodes that are written into the expression of the one node that uses them."""
        uses = Counter(a for i in order for a in set(self.graph.nodes[i].arguments))
        twice = Counter(a for i in order for a in self.graph.nodes[i].arguments)
        results = set(self.outputs)
        length: dict[int, int] = {}
        inside = set()
        for i in order:
            node = self.graph.nodes[i]
            if node.op in ("input", "constant"):
                inside.add(i)
                length[i] = 12
                continue
            length[i] = 4 + sum(length[a] if a in inside else 5 for a in node.arguments)
            simple = node.op in _SIMPLE and length[i] <= LONGEST_EXPRESSION
            if simple and uses[i] == twice[i] == 1 and i not in results:
                inside.add(i)
        return inside

    def _needed(self, i: int) -> set[int]:
        """The statements whose values the statement of a node uses."""
        found, stack = set(), list(self.graph.nodes[i].arguments)
        while stack:
            a = stack.pop()
            if a in self.inside:
                stack.extend(self.graph.nodes[a].arguments)
            else:
                found.add(a)
        return found

    def _places(self) -> tuple[dict[int, str], dict[bool, int]]:
        """The place of each value that another part uses, and the number of places for numbers and for truth values."""
        until: dict[int, int] = {}
        for k, part in enumerate(self.parts):
            for i in part:
                for a in self._needed(i):
                    if self.part[a] != k:
                        until[a] = k
        for i in self.outputs:  # results are written in the last part, when all inputs have been read
            for a in [i] if i not in self.inside else self._needed(i):
                if self.part[a] != len(self.parts) - 1:
                    until[a] = len(self.parts) - 1
        places: dict[int, str] = {}
        free: dict[bool, list[int]] = {False: [], True: []}
        counts = {False: 0, True: 0}
        index: dict[int, int] = {}
        for k, part in enumerate(self.parts):
            for i in sorted(j for j in index if until[j] == k):  # read here for the last time, before it is overwritten
                free[self.truth[i]].append(index.pop(i))
            for i in part:
                if i in until:
                    kind = self.truth[i]
                    slots = free[kind]
                    if not slots:
                        slots.append(counts[kind])
                        counts[kind] += 1
                    index[i] = slots.pop(0)
                    places[i] = f"{'truths' if kind else 'reals'}[{index[i]}]"
        return places, counts

    def _lines(self, k: int, part: list[int], places: dict[int, str]) -> list[str]:
        lines, stores, declared = [], [], []
        number = {i: n for n, i in enumerate(part)}

        def name(i: int) -> str:
            if self.part[i] != k:
                return places[i]
            return f"{'p' if self.truth[i] else 'v'}{number[i]}"

        def text(i: int) -> str:
            node = self.graph.nodes[i]
            if node.op == "part":
                (loop,) = node.arguments
                return f"l{number[loop]}[{self.graph.nodes[loop].value.fixed + node.value}]"
            if node.op == "input":
                return self.signature.inputs[node.value]  # pyright: ignore[reportArgumentType, reportCallIssue]
            if node.op == "constant":
                return literal(node.value, self.words)  # pyright: ignore[reportArgumentType]
            operands = [text(a) if a in self.inside else name(a) for a in node.arguments]
            if node.op == "table":
                last = len(node.value.numbers) - 1  # pyright: ignore[reportOptionalMemberAccess]
                return looked_up(self.tables[node.value], operands[0], last, self.words)
            return expression(node.op, [_bracketed(o) for o in operands], self.words, self.truth[i])

        for i in part:
            node = self.graph.nodes[i]
            if node.op == "loop":
                local = f"l{number[i]}"
                values = ", ".join(text(a) if a in self.inside else name(a) for a in node.arguments)
                lines += [*_declarations(declared), f"{self.words.real} {local}[{len(node.arguments)}] = {{{values}}};"]
                lines += [f"{self.loops[i].name}({local});"]
                declared = []
                continue
            declared.append((self.words.truth if self.truth[i] else self.words.real, f"{name(i)} = {text(i)}"))
            if i in places:
                stores.append(f"{places[i]} = {name(i)};")
        if k == len(self.parts) - 1:
            for target, i in zip(self.signature.outputs, self.outputs, strict=True):
                value = text(i) if i in self.inside else name(i)
                stores.append(f"{target} = {of_truth(value, self.words) if self.truth[i] else value};")
        return [*lines, *_declarations(declared), *stores]


def _array(name: str, numbers: Sequence[float], words: Words) -> str:
    """A table as a constant array."""
    text = textwrap.fill(
        ", ".join(literal(float(x), words._replace(lanes=1)) for x in numbers), 116, break_long_words=False
    )
    return f"static const {words.scalar} {name}[{len(numbers)}] = {{\n{textwrap.indent(text, '    ')}\n}};\n"


def _declarations(declared: Sequence[tuple[str, str]]) -> list[str]:
    """Constants of a type and their values as lines, those of one type together."""
    lines = []
    for kind, group in itertools.groupby(declared, key=lambda each: each[0]):
        texts = [text for _, text in group]
        lines += [f"const {kind} {texts[0]}", *texts[1:]]
        lines[-len(texts) :] = [f"{line}," for line in lines[-len(texts) : -1]] + [f"{lines[-1]};"]
    return lines


class _LoopText(NamedTuple):
    """The function of a loop, `void name(real *numbers)`, with those that it calls; the rest as in `CText`."""

    name: str
    texts: tuple[str, ...]
    helpers: frozenset[str]
    operations: Counter[str]
    scratch: int


def _loop(loop: Repetition, name: str, words: Words, most_statements: int) -> _LoopText:
    """C of a loop on its fixed and carried numbers, which it changes in place; a turn of unknown count counts once."""
    real, width, carried = words.real, loop.body.inputs, loop.carried
    inputs = tuple(f"x[{i}]" for i in range(width))
    made = {}
    for what, graph in (("turn", loop.body), ("going", loop.going)):
        if graph is not None:
            outputs = tuple(f"y[{i}]" for i in range(len(graph.outputs)))
            signature = Signature(f"const {real} *restrict x, {real} *restrict y", ("x", "y"), inputs, outputs)
            made[what] = _Writer(graph, f"{name}_{what}", signature, words, True, most_statements).written()
    stop, first = "", f"turn = 0; turn < {loop.turns}; ++turn"
    index, carry = "    int turn;\n", "y[i]"
    if loop.turns is None:
        stop = f"        {name}_going(x, y);\n        if (!(y[0] > {literal(0.0, words)}))\n            return;\n"
        index, first = "", ";;"
        if words.lanes > 1:  # a lane that has come to its end waits there for the others
            index = f"    {words.truth} on;\n"
            stop = (
                f"        {name}_going(x, y);\n        on = y[0] > {literal(0.0, words)};\n"
                f"        if (!{words.real}_any(on))\n            return;\n"
            )
            carry = f"{words.real}_choose(on, y[i], x[{loop.fixed} + i])"
    driver = (
        f"static void {name}({real} *x)\n{{\n    {real} y[{max(carried, 1)}];\n    int i;\n{index}"
        f"    for ({first}) {{\n{stop}        {name}_turn(x, y);\n"
        f"        for (i = 0; i < {carried}; ++i)\n            x[{loop.fixed} + i] = {carry};\n    }}\n}}\n"
    )
    times, operations = 1 if loop.turns is None else loop.turns, Counter[str]()
    for text in made.values():
        operations += Counter({op: times * n for op, n in text.operations.items()})
    helpers = frozenset().union(*(text.helpers for text in made.values()))
    scratch = width + carried + max(text.scratch for text in made.values())
    return _LoopText(name, (*(text.text for text in made.values()), driver), helpers, operations, scratch)


_NO_OPERATIONS = ("input", "constant", "loop", "part")
_TOGETHER = ("sin", "cos", "part")
_SIMPLE = {"add", "sub", "mul", "neg", "abs", *TRUTHS}
"""Operations that are written into the expression that uses them."""


def _bracketed(text: str) -> str:
    """An operand in brackets, unless it is one name, one number or one call."""
    return f"({text})" if " " in _outside(text) or text[0] in "-!~" else text


def _outside(text: str) -> str:
    """What of a text is outside all brackets."""
    depth, kept = 0, []
    for letter in text:
        depth -= letter in ")]"
        if depth == 0:
            kept.append(letter)
        depth += letter in "(["
    return "".join(kept)


def _mentions(body: str, name: str) -> bool:
    return re.search(rf"\b{re.escape(name)}\b", body) is not None


def truths(graph: Graph) -> list[bool]:
    """For each node whether it is a truth value and not a number."""
    found: list[bool] = []
    for node in graph.nodes:
        if node.op == "constant":
            found.append(isinstance(node.value, bool))
        elif node.op == "select":
            found.append(found[node.arguments[1]])
        else:
            found.append(node.op in TRUTHS)
    return found


def _order(graph: Graph, outputs: Sequence[int]) -> list[int]:
    """The nodes that the outputs need, each after its arguments, and soon before what uses it.

    Sine and cosine of one argument stand together, where compilers make one call of them, and so do the results of a
    loop, behind it.
    """
    partner: dict[tuple, list[int]] = {}
    for i, node in enumerate(graph.nodes):
        if node.op in _TOGETHER:
            partner.setdefault((node.op == "part", *node.arguments), []).append(i)
    seen, order = set(), []
    for output in outputs:
        stack = [output]
        while stack:
            i = stack[-1]
            missing = [a for a in graph.nodes[i].arguments if a not in seen]
            if i in seen:
                stack.pop()
            elif missing:
                stack.extend(reversed(missing))
            else:
                stack.pop()
                node = graph.nodes[i]
                together = partner.get((node.op == "part", *node.arguments), [i]) if node.op in _TOGETHER else [i]
                for k in together:
                    if k not in seen:
                        seen.add(k)
                        order.append(k)
    return order


def _parts(graph: Graph, statements: list[int], most: int) -> list[list[int]]:
    """The statements in parts of about equal length, at least one part; a loop and its results stay together."""
    count = max(1, -(-len(statements) // most))
    cuts = [len(statements) * k // count for k in range(count + 1)]
    for k, cut in enumerate(cuts[1:-1], start=1):
        cut = max(cut, cuts[k - 1])
        while cut < len(statements) and graph.nodes[statements[cut]].op == "part":
            cut += 1
        cuts[k] = cut
    return [statements[a:b] for a, b in itertools.pairwise(cuts)]
