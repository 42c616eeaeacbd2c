r"""Formulas of a function: its graph read as quotients of polynomials, and written as LaTeX.

A value is a sum of products of powers of the arguments, of functions of them, and of sums that divide. Sums are brought
over one denominator, denominators that divide the numerator cancel, and sin² becomes 1 − cos². Values that are equal by
these rules are one formula, however the function computes them.
"""

import itertools
import math
import re
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from scalargraph.errors import InputError
from scalargraph.graph import evaluate, lower

MOST = 400
"""Operations that one formula may have, which fill about half a page."""
FUNCTIONS = {op: op for op in ("sqrt", "exp", "sin", "cos", "tan", "sinh", "cosh", "tanh")} | {"log": "ln"}
FUNCTIONS |= {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}
"""Functions of one argument that LaTeX has, by the names of the operations."""

Monomial = tuple[tuple[str, int], ...]
"""Powers, none of them 0 and some negative, of what is named by its LaTeX; sorted."""
Polynomial = dict[Monomial, Fraction]
"""Sum of monomials with coefficients, none of them 0."""
ONE: Polynomial = {(): Fraction(1)}


def formulas(function: Callable[..., Any], *names: Sequence[str], most: int = MOST) -> list[str]:
    r"""Write each entry of the result of a JAX function as a LaTeX formula.

    Factors are separated by `\,`, quotients are `\frac`, and numbers have up to 15 digits.

    Args:
        function: The function, of vectors.
        names: LaTeX names of the entries of each vector. A sum as a name is in brackets.
        most: Largest number of operations of a formula, and of any value on the way to it.

    Raises:
        InputError: A formula would be larger, or has an operation, such as a choice, that no formula has.

    Example:
        >>> import jax.numpy as jnp
        >>> from scalargraph.formulas import formulas
        >>> formulas(lambda q: jnp.stack([jnp.sin(q[0]) ** 2 + jnp.cos(q[0]) ** 2, q[0] / (2 + 2 * q[1])]), "xy")
        ['1', '\\frac{x}{2\\,(1 + y)}']
    """
    lowered = lower(function, *(np.zeros(len(each)) for each in names))
    inputs = [*itertools.chain(*names)]
    rules = _Rules(inputs, most)
    for op in sorted({node.op for node in lowered.graph.nodes} - {*rules, "input"}):
        raise InputError(f"the operation '{op}' has no formula")
    return [rules.text(value) for value in evaluate(lowered, rules, [{((name, 1),): Fraction(1)} for name in inputs])]


class _Rules(dict):
    """The operations of a graph on polynomials.

    Attributes:
        rank: Places in a product of all that is named.
        factors: Sums that divide, by their names.
    """

    def __init__(self, names: list[str], most: int):
        self.most, self.factors = most, dict[str, Polynomial]()
        self.rank = {name: k for k, name in enumerate(dict.fromkeys(names))}
        super().__init__(constant=_number, div=self.quotient)
        self["add"] = lambda a, b: self.normal(_collected([*a.items(), *b.items()]))
        self["mul"] = lambda a, b: self.normal(_times(a, b))
        self["neg"] = lambda a: {monomial: -x for monomial, x in a.items()}
        self["sub"] = lambda a, b: self["add"](a, self["neg"](b))
        self |= {op: lambda a, name=name: self.function(name, a) for op, name in FUNCTIONS.items()}

    def normal(self, a: Polynomial) -> Polynomial:
        """Bring all terms over one denominator, and cancel the factors of it that divide the numerator."""
        for name, factor in self.factors.items():
            powers = [dict(monomial).get(name, 0) for monomial in a]
            least = min([0, *powers])
            if any(powers):
                over = [(_merged(m, ((name, -k),)), x) for (m, x), k in zip(a.items(), powers, strict=True)]
                products = [_times({m: x}, _raised(factor, k - least)) for (m, x), k in zip(over, powers, strict=True)]
                a = _times(_collected(term for each in products for term in each.items()), {((name, least),): ONE[()]})
        for name, factor in self.factors.items():
            while any(pair[0] == name for pair in next(iter(a), ())) and (shorter := _divided(a, factor)) is not None:
                a = _times(shorter, {((name, 1),): Fraction(1)})
        if sum(len(monomial) + 1 for monomial in a) > self.most:
            raise InputError(f"a formula has more than {self.most} operations")
        return a

    def quotient(self, a: Polynomial, b: Polynomial) -> Polynomial:
        if not b:
            raise InputError("a quotient by zero has no formula")
        (monomial, number), rest = _content(b)
        for name, factor in self.factors.items():
            while len(rest) > 1 and (shorter := _divided(rest, factor)) is not None:
                rest, monomial = shorter, _merged(monomial, ((name, 1),))
        if len(rest) > 1:
            name = f"({self.total(rest)})"
            self.factors[name], self.rank[name] = rest, len(self.rank)
            rest, monomial = ONE, _merged(monomial, ((name, 1),))
        return self["mul"](a, {_merged((), monomial, -1): 1 / (number * rest[()])})

    def function(self, name: str, a: Polynomial) -> Polynomial:
        if name in ("sin", "cos") and a and a[min(a)] < 0:
            opposite = self.function(name, self["neg"](a))
            return opposite if name == "cos" else self["neg"](opposite)
        symbol = rf"\{name}{{{self.text(a)}}}" if name == "sqrt" else rf"\{name}({self.text(a)})"
        for each in (symbol, symbol.replace(r"\sin(", r"\cos(", 1)):  # the square of the sine has the cosine
            self.rank.setdefault(each, len(self.rank))
        return {((symbol, 1),): Fraction(1)}

    def text(self, a: Polynomial) -> str:
        if not a:
            return "0"
        (monomial, number), rest = _content(a)
        fraction = 1 < number.denominator < 10
        whole = abs(number.numerator) if fraction else abs(number)
        decimal = re.sub(r"e(-?)\+?0*(\d+)", r" \\cdot 10^{\1\2}", f"{float(whole):.15g}")
        ordered = sorted(monomial, key=lambda power: self.rank[power[0]])
        powers = [(name + f"^{{{abs(k)}}}" * (abs(k) > 1), k) for name, k in ordered]
        above = [decimal] * (whole != 1) + [text for text, k in powers if k > 0]
        below = [str(number.denominator)] * fraction + [text for text, k in powers if k < 0]
        if len(below) == 1 and below[0] in self.factors:
            below = [below[0][1:-1]]
        if len(rest) > 1:
            alone = not above and (below or number > 0)
            above.append(self.total(rest) if alone else f"({self.total(rest)})")
        top, low = (r"\,".join(each) for each in (above or ["1"], below))
        return "-" * (number < 0) + (rf"\frac{{{top}}}{{{low}}}" if below else top)

    def total(self, a: Polynomial) -> str:
        """The sum as text, positive terms first and then those of low degree."""
        place = {m: (x < 0, sum(k for _, k in m), sorted(self.rank[name] for name, _ in m)) for m, x in a.items()}
        return " + ".join(self.text({m: a[m]}) for m in sorted(a, key=place.__getitem__)).replace("+ -", "- ")


def _number(value: float) -> Polynomial:
    simple = Fraction(value).limit_denominator(1000)
    # As it was typed: 0.1 + 0.2 − 0.3 is then 0.
    exact = simple if math.isclose(simple, value, rel_tol=1e-15) else Fraction(f"{value:.15g}")
    return _collected([((), exact)])


def _collected(terms: Iterable[tuple[Monomial, Fraction]]) -> Polynomial:
    total: Polynomial = {}
    for monomial, number in terms:
        total[monomial] = total.get(monomial, Fraction(0)) + number
    return {monomial: number for monomial, number in total.items() if number}


def _merged(m: Monomial, n: Monomial, sign: int = 1) -> Monomial:
    """The product of two monomials, or their quotient where the sign is −1."""
    powers = dict(m)
    for name, k in n:
        powers[name] = powers.get(name, 0) + sign * k
    return tuple(sorted((name, k) for name, k in powers.items() if k))


def _times(a: Polynomial, b: Polynomial) -> Polynomial:
    terms = [(_merged(m, n), x * y) for (m, x), (n, y) in itertools.product(a.items(), b.items())]
    return _collected(each for term in terms for each in _without_squared_sines(*term))


def _raised(a: Polynomial, k: int) -> Polynomial:
    return _times(a, _raised(a, k - 1)) if k else ONE


def _without_squared_sines(monomial: Monomial, number: Fraction) -> list[tuple[Monomial, Fraction]]:
    for name, k in monomial:
        if name.startswith(r"\sin(") and k > 1:
            one = _merged(monomial, ((name, -2),))
            square = _merged(one, ((name.replace(r"\sin(", r"\cos(", 1), 2),))
            return _without_squared_sines(one, number) + _without_squared_sines(square, -number)
    return [(monomial, number)]


def _content(a: Polynomial) -> tuple[tuple[Monomial, Fraction], Polynomial]:
    """The common factor, with a number only where it leaves small whole coefficients, and the rest."""
    names, numbers = sorted({name for monomial in a for name, _ in monomial}), a.values()
    least = tuple((name, k) for name in names if (k := min(dict(monomial).get(name, 0) for monomial in a)))
    common = Fraction(math.gcd(*(x.numerator for x in numbers)), math.lcm(*(x.denominator for x in numbers)))
    common = common if len(a) == 1 or all(abs(x) < 10 * common for x in numbers) else Fraction(1)
    common *= -1 if all(x < 0 for x in numbers) else 1
    return (least, common), {_merged(monomial, least, -1): x / common for monomial, x in a.items()}


def _divided(top: Polynomial, factor: Polynomial) -> Polynomial | None:
    """The quotient, if there is no remainder, by division in lexicographic order."""
    names = sorted({name for monomial in (*top, *factor) for name, _ in monomial})

    def exponents(monomial: Monomial) -> list[int]:
        return [dict(monomial).get(name, 0) for name in names]

    least = [min(column) for column in zip(*map(exponents, top), strict=True)]
    lead, rest, quotient = max(factor, key=exponents), top, {}
    while rest:
        largest = max(rest, key=exponents)
        step, number = _merged(largest, lead, -1), rest[largest] / factor[lead]
        if any(k < low for k, low in zip(exponents(step), least, strict=True)):
            return None
        quotient[step] = number
        rest = _collected([*rest.items(), *((_merged(step, m), -number * x) for m, x in factor.items())])
    return quotient
