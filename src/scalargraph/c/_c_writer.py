"""Writes the operations of a graph as C statements, one after the other.

A long function is written as several functions of limited length, since compilers take more than linear time. Values
that one of these functions passes to another are stored in an array on the stack, whose places are reused.
"""

import itertools
import re
import textwrap
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from scalargraph.c._c_operations import HELPERS, LIBRARY, Words, expression, literal, looked_up, of_truth
from scalargraph.graph import NO_OPERATIONS, TRUTHS, Graph, Lowered, Repetition

LONGEST_EXPRESSION = 60
"""Longest expression [characters] that is inlined into the one statement that uses it."""


class Signature(NamedTuple):
    """How a C function gets its arguments.

    Attributes:
        declared: Its parameters as declared, such as `const double *x, double *y`.
        passed: The names of these parameters, `("x", "y")`.
        inputs: C expressions of all inputs, such as `x[0]`.
        outputs: C expressions of all results, such as `y[0]`; they must not overlap the inputs.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> signature = scalargraph.Signature("double angle, double *sine", ("angle", "sine"), ("angle",), ("*sine",))
        >>> text = scalargraph.c_function(scalargraph.lower(lambda x: jnp.sin(x), jnp.array(0.0)), "f", signature).text
        >>> text.splitlines()[0]
        'void f(double angle, double *sine)'
    """

    declared: str
    passed: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


class CText(NamedTuple):
    """Generated C of a function.

    Attributes:
        text: The function with those that it calls, all but the last of them `static`.
        helpers: Names of the `c_helpers` that it calls.
        operations: Number of operations of each kind in a call, the same in every call. A loop of unknown length counts
            as one turn.
        scratch: Number of values that it keeps in an array on its stack, besides its variables.

    Example:
        >>> import jax.numpy as jnp
        >>> import scalargraph
        >>> text = scalargraph.c_function(scalargraph.lower(lambda x: jnp.sin(x) * x, jnp.array(0.0)), "f")
        >>> dict(text.operations), text.scratch
        ({'sin': 1, 'mul': 1}, 0)
    """

    text: str
    helpers: frozenset[str]
    operations: Counter[str]
    scratch: int


class Writer:
    """Writes one function: orders its nodes, cuts the list into parts, and places the values that parts exchange.

    Args:
        lowered: The function, simplified.
        name: Name of the C function.
        signature: How it gets its arguments.
        words: How numbers are written.
        static: Whether it is declared `static`.
        most_statements: Longest part in statements.
    """

    def __init__(
        self, lowered: Lowered, name: str, signature: Signature, words: Words, static: bool, most_statements: int
    ):
        self.graph, self.outputs = lowered.graph, lowered.outputs
        self.name, self.signature, self.words, self.static = name, signature, words, static
        self.truth = truths(self.graph)
        self.places: dict[int, int] = {}
        order = _order(self.graph, self.outputs)
        self.inside = self._inside(order)
        statements = [i for i in order if i not in self.inside]
        self.parts = in_parts(self.graph, statements, most_statements)
        self.loops = self._loops([i for i in statements if self.graph.nodes[i].op == "loop"], most_statements)
        self.part = {i: k for k, part in enumerate(self.parts) for i in part}
        looked_up = dict.fromkeys(self.graph.nodes[i].value for i in statements if self.graph.nodes[i].op == "table")
        self.tables: dict[Any, str] = {table: f"{name}_table{k + 1}" for k, table in enumerate(looked_up)}

    def written(self) -> CText:
        """Write the function with its parts, tables and loops."""
        counts = self._find_places()
        sizes = (("real", self.words.real, counts[False]), ("truth", self.words.truth, counts[True]))
        arrays = [(f"{kind}s", c, size) for kind, c, size in sizes if size]
        texts = [number_array(name, table.numbers, self.words) for table, name in self.tables.items()]
        texts += [text for loop in self.loops.values() for text in loop.texts]
        texts += self._functions(arrays)
        operations = Counter(node.op for node in self.graph.nodes if node.op not in NO_OPERATIONS)
        used = frozenset(h for i in range(len(self.graph.nodes)) for h in self._helpers(i))
        scratch = sum(counts.values())
        for loop in self.loops.values():
            operations += loop.operations
            used |= loop.helpers
            scratch += loop.scratch
        return CText("\n".join(texts), used, operations, scratch)

    def _functions(self, arrays: list[tuple[str, str, int]]) -> list[str]:
        """The functions of the parts and the one that calls them; `arrays` hold the values that parts exchange."""
        if len(self.parts) == 1:
            return [self._function(self.name, self.static, "", self._lines(0, self.parts[0]))]
        calls = [self._call(f"{self.name}_{k + 1}", arrays) for k in range(len(self.parts))]
        return [
            *(self._part(f"{self.name}_{k + 1}", k, part, arrays) for k, part in enumerate(self.parts)),
            self._function(self.name, self.static, "", [*declared(arrays), *calls]),
        ]

    def _part(self, name: str, k: int, part: list[int], arrays: list[tuple[str, str, int]]) -> str:
        rest = "".join(f", {c} *restrict {array}" for array, c, _ in arrays)
        return self._function(name, True, rest, self._lines(k, part), [array for array, _, _ in arrays])

    def _call(self, name: str, arrays: list[tuple[str, str, int]]) -> str:
        return f"{name}({', '.join([*self.signature.passed, *(array for array, _, _ in arrays)])});"

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
        """The nodes whose expression is inlined, because only one other node uses them."""
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
        """The statements whose values are used by the statement of a node."""
        needed, stack = set(), list(self.graph.nodes[i].arguments)
        while stack:
            a = stack.pop()
            if a in self.inside:
                stack.extend(self.graph.nodes[a].arguments)
            else:
                needed.add(a)
        return needed

    def _until(self) -> dict[int, int]:
        """The last part that uses a value, for each value that a later part than its own uses."""
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
        return until

    def _find_places(self) -> dict[bool, int]:
        """Assign a place to each value that another part uses; return how many numbers and truth values need."""
        until = self._until()
        free: dict[bool, list[int]] = {False: [], True: []}
        counts = {False: 0, True: 0}
        used: set[int] = set()
        for k, part in enumerate(self.parts):
            # A place is released before this part's statements get theirs, because the part reads it before writing.
            for i in sorted(j for j in used if until[j] == k):  # read here for the last time, before it is overwritten
                used.remove(i)
                free[self.truth[i]].append(self.places[i])
            for i in part:
                if i in until:
                    kind = self.truth[i]
                    slots = free[kind]
                    if not slots:
                        slots.append(counts[kind])
                        counts[kind] += 1
                    used.add(i)
                    self.places[i] = slots.pop(0)
        return counts

    def _place(self, i: int) -> str:
        return f"{'truths' if self.truth[i] else 'reals'}[{self.places[i]}]"

    def _lines(self, k: int, part: list[int]) -> list[str]:
        lines, stores, declared = [], [], []
        number = {i: n for n, i in enumerate(part)}

        def name(i: int) -> str:
            if self.part[i] != k:
                return self._place(i)
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
            return expression(node.op, [bracketed(o) for o in operands], self.words, self.truth[i])

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
            if i in self.places:
                stores.append(f"{self._place(i)} = {name(i)};")
        if k == len(self.parts) - 1:
            for target, i in zip(self.signature.outputs, self.outputs, strict=True):
                value = text(i) if i in self.inside else name(i)
                stores.append(f"{target} = {of_truth(value, self.words) if self.truth[i] else value};")
        return [*lines, *_declarations(declared), *stores]


def number_array(name: str, numbers: Sequence[float], words: Words) -> str:
    """C of a constant array."""
    text = textwrap.fill(
        ", ".join(literal(float(x), words._replace(lanes=1)) for x in numbers), 116, break_long_words=False
    )
    return f"static const {words.scalar} {name}[{len(numbers)}] = {{\n{textwrap.indent(text, '    ')}\n}};\n"


def _declarations(declared: Sequence[tuple[str, str]]) -> list[str]:
    """Declarations of constants with their values, those of the same type grouped."""
    lines = []
    for kind, group in itertools.groupby(declared, key=lambda each: each[0]):
        texts = [text for _, text in group]
        lines += [f"const {kind} {texts[0]}", *texts[1:]]
        lines[-len(texts) :] = [f"{line}," for line in lines[-len(texts) : -1]] + [f"{lines[-1]};"]
    return lines


def declared(arrays: list[tuple[str, str, int]]) -> list[str]:
    """The declarations of the arrays between parts."""
    return [f"{c} {array}[{size}];" for array, c, size in arrays]


class _LoopText(NamedTuple):
    """The function of a loop, `void name(real *numbers)`, with the functions that it calls; other fields as `CText`."""

    name: str
    texts: tuple[str, ...]
    helpers: frozenset[str]
    operations: Counter[str]
    scratch: int


def _loop(loop: Repetition, name: str, words: Words, most_statements: int) -> _LoopText:
    """C of a loop that updates its fixed and carried numbers in place; a loop of unknown length counts as one turn."""
    real, width, carried = words.real, loop.body.inputs, loop.carried
    inputs = tuple(f"x[{i}]" for i in range(width))
    texts = {}
    for role, graph in (("turn", loop.body), ("going", loop.going)):
        if graph is not None:
            outputs = tuple(f"y[{i}]" for i in range(len(graph.outputs)))
            signature = Signature(f"const {real} *restrict x, {real} *restrict y", ("x", "y"), inputs, outputs)
            texts[role] = Writer(graph, f"{name}_{role}", signature, words, True, most_statements).written()
    stop, first = "", f"turn = 0; turn < {loop.turns}; ++turn"
    index, carry = "    int turn;\n", "y[i]"
    if loop.turns is None:
        stop = f"        {name}_going(x, y);\n        if (!(y[0] > {literal(0.0, words)}))\n            return;\n"
        index, first = "", ";;"
        if words.lanes > 1:  # a lane whose loop has ended keeps its numbers until all lanes have ended
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
    for text in texts.values():
        operations += Counter({op: times * n for op, n in text.operations.items()})
    helpers = frozenset().union(*(text.helpers for text in texts.values()))
    scratch = width + carried + max(text.scratch for text in texts.values())
    return _LoopText(name, (*(text.text for text in texts.values()), driver), helpers, operations, scratch)


_TOGETHER = ("sin", "cos", "part")
_SIMPLE = {"add", "sub", "mul", "neg", "abs", *TRUTHS}
"""Operations that may be inlined into the expression that uses them."""


def bracketed(text: str) -> str:
    """An operand in brackets, unless it is one name, one number or one call."""
    # A leading sign is bracketed too: two minus signs in a row would be a decrement.
    return f"({text})" if " " in _outside(text) or text[0] in "-!~" else text


def _outside(text: str) -> str:
    """The part of a text that is outside all brackets."""
    depth, outer = 0, []
    for letter in text:
        depth -= letter in ")]"
        if depth == 0:
            outer.append(letter)
        depth += letter in "(["
    return "".join(outer)


def _mentions(body: str, name: str) -> bool:
    """Whether a body uses a variable; a field of the same name, as in `state->u`, does not count."""
    return re.search(rf"(?<!->)(?<!\.)\b{re.escape(name)}\b", body) is not None


def truths(graph: Graph) -> list[bool]:
    """For each node of a graph, whether it is a truth value and not a number."""
    kinds: list[bool] = []
    for node in graph.nodes:
        if node.op == "constant":
            kinds.append(isinstance(node.value, bool))
        elif node.op == "select":
            kinds.append(kinds[node.arguments[1]])
        else:
            kinds.append(node.op in TRUTHS)
    return kinds


def _order(graph: Graph, outputs: Sequence[int]) -> list[int]:
    """The nodes that the outputs need, in an order of evaluation: after their arguments and shortly before their use.

    Sine and cosine of one argument are adjacent, so that compilers make one call of them. The results of a loop follow
    the loop directly.
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


def in_parts(graph: Graph, statements: list[int], most: int) -> list[list[int]]:
    """Cut statements into parts of about equal length, at least one part; a loop and its results stay together."""
    count = max(1, -(-len(statements) // most))
    cuts = [len(statements) * k // count for k in range(count + 1)]
    for k, cut in enumerate(cuts[1:-1], start=1):
        # The previous cut may have been moved past this one, behind the results of a loop.
        cut = max(cut, cuts[k - 1])
        while cut < len(statements) and graph.nodes[statements[cut]].op == "part":
            cut += 1
        cuts[k] = cut
    return [statements[a:b] for a, b in itertools.pairwise(cuts)]
