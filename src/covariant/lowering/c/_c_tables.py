"""C of a graph in which similar statements are done by loops over tables, for memories too small for straight C.

Straight C takes some twelve bytes an operation on a microcontroller. Most statements of a long function are alike, such
as a product added to a number: one loop does them all, over a table of the places of the numbers that each reads and
writes, with two bytes a number. The operations and their order in each result are those of straight C.
"""

import heapq
import textwrap
from collections import Counter
from collections.abc import Collection, Sequence
from itertools import groupby

from covariant.lowering.c._c_operations import expression
from covariant.lowering.c._c_writer import Writer, bracketed, declared, in_parts, number_array
from covariant.lowering.graph import COMMUTATIVE

ALIKE = frozenset({"add", "sub", "mul", "div", "neg", "abs", "sqrt"})
"""Operations that tables do; choices, angles, loops and look-ups stay straight."""
MOST_OPERANDS = 8
"""Numbers that one statement of a table reads, at most."""
FEWEST = 12
"""Statements of one shape from which a loop of their own saves memory."""
LONGEST_RUN = 32
"""Longest run, so that what it writes finds a gap; a run has three numbers beside those of its statements."""
MOST_PLACES = 65_536
"""Places that the smallest type of C for a table, of two bytes, can number."""

Shape = tuple
"""An operation on shapes, of which `()` is a number: `("add", ("mul", (), ()), ())`."""


def _gap(occupied: list[bool], length: int) -> int:
    """Occupy the smallest gap that is long enough, or places at the end; return the first of them."""
    gaps, start = [], 0
    for free, group in groupby(occupied, key=lambda each: not each):
        size = len(list(group))
        gaps += [(size, start)] if free and size >= length else []
        start += size
    last = next((n for n in range(len(occupied), 0, -1) if occupied[n - 1]), 0)
    # The smallest gap that fits: larger ones stay for longer runs.
    first = min(gaps)[1] if gaps else last
    occupied[first : first + length] = [True] * length
    return first


class TablesThroughout(Writer):
    """Writes one function with tables, its loops too: it groups similar statements and orders them into long runs.

    Args:
        lowered: The function, simplified.
        name: Name of the C function.
        signature: How it gets its arguments.
        words: How numbers are written; one lane only.
        static: Whether it is declared `static`.
        most_statements: Longest straight part in statements.
    """

    def _inside(self, order: list[int]) -> set[int]:
        """The nodes that are written into the statement that uses them, so that there are few shapes of statements."""
        nodes, results = self.graph.nodes, set(self.outputs)
        uses = Counter(a for i in order for a in nodes[i].arguments)
        user = {a: i for i in order for a in nodes[i].arguments}
        inside, size = set(), {}
        straight = super()._inside(order)
        for i in order:
            # Number of operands that the statement would read with what is inside it.
            size[i] = sum(size[a] if a in inside and nodes[a].op in ALIKE else 1 for a in nodes[i].arguments)
            if i not in user or nodes[i].op not in ALIKE or nodes[user[i]].op not in ALIKE:
                inside |= {i} & straight
            elif uses[i] == 1 and i not in results and size[i] <= MOST_OPERANDS // 2:
                inside.add(i)
        return self._without_rare_shapes([i for i in order if i not in inside and nodes[i].op in ALIKE], inside)

    def _without_rare_shapes(self, statements: list[int], inside: set[int]) -> set[int]:
        """The inner nodes after statements of rare shapes are split, each time at their largest operand."""
        self.shapes: dict[int, tuple[Shape, list[int]]] = {}
        new = statements
        while new:
            self.shapes |= {i: self._shape(i, inside) for i in new}
            often = Counter(shape for shape, _ in self.shapes.values())
            new = []
            for i in [i for i, (shape, _) in self.shapes.items() if often[shape] < FEWEST]:
                largest = max(self._operands(i, inside), key=lambda a: len(self._shape(a, inside)[1]), default=None)
                if largest is not None:
                    inside.remove(largest)
                    new += [i, largest]
        return inside

    def _operands(self, i: int, inside: set[int]) -> list[int]:
        nodes = self.graph.nodes
        return [a for a in dict.fromkeys(nodes[i].arguments) if a in inside and nodes[a].op in ALIKE]

    def _shape(self, i: int, inside: set[int]) -> tuple[Shape, list[int]]:
        """The shape of a statement, and the nodes of its numbers in order."""
        node = self.graph.nodes[i]
        below = [
            self._shape(a, inside) if a in inside and self.graph.nodes[a].op in ALIKE else ((), [a])
            for a in node.arguments
        ]
        if node.op in COMMUTATIVE:  # IEEE arithmetic gives both orders one value
            below.sort(key=lambda each: repr(each[0]), reverse=True)
        return (node.op, *(shape for shape, _ in below)), [a for _, read in below for a in read]

    def _split(self, statements: list[int], most: int) -> list[list[int]]:
        """The statements as parts: functions of straight ones, and each statement of a table by itself."""
        nodes = self.graph.nodes
        read = dict.fromkeys(a for _, leaves in self.shapes.values() for a in leaves)
        self.constants = [a for a in read if nodes[a].op == "constant"]
        self.places |= {a: k for k, a in enumerate(self.constants)}
        # Loops read numbers of one array only, so constants and inputs are copied into it first.
        inputs = [a for a in read if nodes[a].op == "input"]
        parts = in_parts(self.graph, inputs, most) if inputs else []
        for run in self._runs(statements):
            if run[0] in self.shapes:
                parts += [[i] for i in run]
            else:
                parts += in_parts(self.graph, run, most)
        parts.append([])  # results are written in the last one, when all has been read
        shape = [self.shapes[part[0]][0] if self._tabled(part) else () for part in parts]
        self.runs: list[list[int]] = []
        for _, group in groupby(range(len(parts)), key=lambda k: shape[k] or (k,)):
            run = list(group)
            self.runs += [run[n : n + LONGEST_RUN] for n in range(0, len(run), LONGEST_RUN)]
        return parts

    def _needed(self, i: int) -> set[int]:
        """The statements and inputs whose values the statement of a node uses."""
        if i not in self.shapes:
            return super()._needed(i)
        return {a for a in self.shapes[i][1] if self.graph.nodes[a].op != "constant"}

    def _runs(self, statements: list[int]) -> list[list[int]]:
        """The statements in an order in which each follows what it needs, as few runs of one shape, or of none.

        A run goes on as long as there are statements of its shape; then the shape with the most follows.
        """
        at = {i: k for k, i in enumerate(statements)}
        missing, users = {}, {i: [] for i in statements}
        ready: dict[Shape, list[int]] = {}

        def release(i: int) -> None:
            heapq.heappush(ready.setdefault(self.shapes[i][0] if i in self.shapes else (), []), at[i])

        for i in statements:
            needed = [a for a in self._needed(i) if a in at]
            missing[i] = len(needed)
            for a in needed:
                users[a].append(i)
            if not needed:
                release(i)
        runs = []
        while any(ready.values()):
            # By the text of the shape where two are as frequent, so that the order is the same on every machine.
            shape = max(ready, key=lambda shape: (len(ready[shape]), repr(shape)))
            runs.append([])
            while ready[shape]:
                i = statements[heapq.heappop(ready[shape])]
                runs[-1].append(i)
                for user in users[i]:
                    missing[user] -= 1
                    if not missing[user]:
                        release(user)
        return runs

    def _find_places(self) -> dict[bool, int]:
        """As in straight C, but those that a run writes stand side by side, so that a table holds the first of them."""
        until, occupied = self._until(), {False: [True] * len(self.places), True: []}
        ends: dict[int, list[int]] = {}
        for i, k in until.items():
            ends.setdefault(k, []).append(i)

        def release(k: int) -> None:
            for i in ends.get(k, ()):
                occupied[self.truth[i]][self.places[i]] = False

        for run in self.runs:
            tabled = self._tabled(self.parts[run[0]])
            if not tabled:  # all is read before anything is written
                release(run[0])
            written = [i for k in run for i in self.parts[k] if i in until]
            for kind in (False, True):
                values = [i for i in written if self.truth[i] is kind]
                for block in [values] if tabled else [[i] for i in values]:
                    first = _gap(occupied[kind], len(block))
                    self.places |= {i: first + n for n, i in enumerate(block)}
            # A run writes its first results before its last operands are read, so these keep their places until its
            # end.
            for k in run if tabled else ():
                release(k)
        return {kind: len(each) for kind, each in occupied.items()}

    def _functions(self, arrays: list[tuple[str, str, int]]) -> list[str]:
        """The functions of the straight parts, the tables with the loops over them, and the function that calls all."""
        used = dict.fromkeys(shape for shape, _ in self.shapes.values())
        number = {shape: n for n, shape in enumerate(used)}
        texts, lines, table = [], declared(arrays), []
        if self.constants:
            name, count = f"{self.name}_constants", len(self.constants)
            texts.append(number_array(name, [float(self.graph.nodes[a].value) for a in self.constants], self.words))  # pyright: ignore[reportArgumentType]
            lines += ["int i;", f"for (i = 0; i < {count}; ++i)", f"    reals[i] = {name}[i];"]
        for tabled, group in groupby(self.runs, key=lambda run: self._tabled(self.parts[run[0]])):
            start, runs = len(table), list(group)
            if tabled:
                for run in runs:
                    table += self._entries(number, [self.parts[k][0] for k in run])
                lines.append(f"{self.name}_run(reals, {self.name}_steps + {start}, {self.name}_steps + {len(table)});")
                continue
            for (k,) in runs:
                name = f"{self.name}_{k + 1}"
                texts.append(self._part(name, k, self.parts[k], arrays))
                lines.append(self._call(name, arrays))
        if table:
            texts += [self._written_table(table), self._loops_over(used)]
        return [*texts, self._function(self.name, self.static, "", lines)]

    def _tabled(self, part: list[int]) -> bool:
        return bool(part) and part[0] in self.shapes

    def _entries(self, number: dict[Shape, int], run: list[int]) -> list[int]:
        """The shape, how many statements of it follow, the first place they write, and those that each reads."""
        entries = [number[self.shapes[run[0]][0]], len(run), self.places[run[0]]]
        return entries + [self.places[a] for i in run for a in self.shapes[i][1]]

    @property
    def _index(self) -> str:
        most = max([*self.places.values(), len(self.shapes)], default=0)
        return "unsigned short" if most < MOST_PLACES else "unsigned"

    def _written_table(self, table: Sequence[int]) -> str:
        text = textwrap.fill(", ".join(map(str, table)), 116)
        return (
            f"static const {self._index} {self.name}_steps[{len(table)}] = {{\n{textwrap.indent(text, '    ')}\n}};\n"
        )

    def _loops_over(self, shapes: Collection[Shape]) -> str:
        """The function that does the statements of a part of the table, by a loop for each shape."""
        cases = []
        for n, shape in enumerate(shapes):
            text, width = self._expression(shape, 0)
            case = f"case {n}" if n < len(shapes) - 1 else "default"
            cases.append(
                f"        {case}:\n            for (at += 3; count > 0; --count, at += {width})\n"
                f"                *to++ = {text};\n            break;\n"
            )
        index, real = self._index, self.words.real
        return (
            f"static void {self.name}_run({real} *reals, const {index} *at, const {index} *end)\n{{\n"
            f"    while (at < end) {{\n        {index} count = at[1];\n        {real} *to = reals + at[2];\n"
            f"        switch (at[0]) {{\n{''.join(cases)}        }}\n    }}\n}}\n"
        )

    def _expression(self, shape: Shape, first: int) -> tuple[str, int]:
        """A shape as an expression of the numbers from `first` on, and the place behind its last."""
        if not shape:
            return f"reals[at[{first}]]", first + 1
        op, *below = shape
        operands = []
        for each in below:
            text, first = self._expression(each, first)
            operands.append(bracketed(text))
        return expression(op, operands, self.words), first


class TablesOnce(TablesThroughout):
    """Writes one function with tables, but its loops in straight C, since their statements are done many times.

    Args:
        lowered: The function, simplified.
        name: Name of the C function.
        signature: How it gets its arguments.
        words: How numbers are written; one lane only.
        static: Whether it is declared `static`.
        most_statements: Longest straight part in statements.
    """

    loops_by = Writer
