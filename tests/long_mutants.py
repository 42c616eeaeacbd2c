"""The mutation run changes one token at a time, draws the same every time, and sees a wrong sign: what takes long."""

import ast
import functools
import io
import subprocess
import sys
import tokenize
from collections import Counter

import mutants
import pytest
from mutations import ROOMS, ROOT, SOURCE, draw, mutants_of


@functools.cache
def drawn():
    return draw(7, 150)


def tokens(source: bytes) -> list[str]:
    kinds = (tokenize.NEWLINE, tokenize.NL, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT)
    return [token.string for token in tokenize.tokenize(io.BytesIO(source).readline) if token.type not in kinds]


def equal_at_the_front(a: list[str], b: list[str]) -> int:
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


@pytest.mark.exhaustive
def test_a_mutant_is_another_program_and_differs_in_one_place():
    for mutant in drawn()[::3]:
        source = (SOURCE / mutant.file).read_bytes()
        changed = mutant.apply(source)
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(source)), mutant.id
        before, after = tokens(source), tokens(changed)
        same = equal_at_the_front(before, after) + equal_at_the_front(before[::-1], after[::-1])
        several = 30 if "," in mutant.new else 4 if mutant.new == "0.0" else 1  # two arguments; what makes a NaN
        assert len(before) - same <= several, mutant.id
        old, new = mutant.diff()
        assert old != new
        assert old.encode() in source


@pytest.mark.exhaustive
def test_the_draw_is_reproducible_and_gives_every_room_its_share():
    assert draw(7, 150) == drawn() != draw(8, 150)
    assert len(set(drawn())) == 150
    counts = Counter(mutant.file.split("/")[0] for mutant in drawn())
    sizes = {
        room: sum(len(mutants_of(str(p.relative_to(SOURCE)))) for p in (SOURCE / room).rglob("*.py")) for room in ROOMS
    }
    for room, size in sizes.items():
        assert abs(counts[room] - 150 * size / sum(sizes.values())) <= 1


@pytest.mark.exhaustive
def test_a_wrong_sign_is_killed_where_a_test_sees_it_and_survives_where_none_does():
    sign = "return ConstantCurvature(1.0 / radius**2)"
    other = "return _found(q + p, q - p)"
    found = {m.diff()[1]: m.id for m in mutants_of("geometry/_spaces.py")}
    test = "tests/geometry/test_spaces.py::test_radius_sets_the_curvature"
    command = [sys.executable, "tools/mutants.py", "--ids", found[sign], found[other], "--tests", test]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stdout + done.stderr
    verdicts = {line.split()[3]: line.split()[0] for line in done.stdout.splitlines() if " s  geometry" in line}
    assert verdicts == {found[sign]: "killed", found[other]: "SURVIVED"}
