"""The mutation run changes one token at a time, draws the same every time, and sees a wrong sign."""

import mutants
import mutations
from mutations import ROOMS, ROOT, SOURCE, mutants_of

SAMPLE = '''"""Text with 1 + 2."""

__all__ = ["a"]


def f(x: Float[Array, 3], *, low=0.0) -> int | None:  # 1 - 2
    if not x < 3:
        raise ValueError(f"{x + 1} is below")
    y = (x.low  # * is no operator here
         * -x.high)
    return min(y, group.lie_bracket(x, y[::2])) if x is None and y else True, jnp.nan, float("inf")
'''
CHANGES = {
    (6, "1.0"), (7, ""), (7, "<="), (7, ">"), (7, "4"), (9, "high"), (10, "/"), (10, ""), (10, "low"), (11, "max"),
    (11, "y[::2], x"), (11, "3"), (11, "is not"), (11, "or"), (11, "False"), (11, "0.0"),
}  # fmt: skip


def test_what_is_changed_and_what_is_not(tmp_path, monkeypatch):
    (tmp_path / "sample.py").write_text(SAMPLE)
    monkeypatch.setattr(mutations, "SOURCE", tmp_path)
    assert {(mutant.line, mutant.new) for mutant in mutations.mutants_of("sample.py")} == CHANGES


def test_every_source_has_its_tests():
    for room in ROOMS:
        for path in (SOURCE / room).rglob("*.py"):
            tests = mutants.relevant(str(path.relative_to(SOURCE)))
            assert tests
            assert all((ROOT / test).is_file() for test in tests)


def test_what_is_taken_to_be_equivalent_is_a_mutant_of_the_source():
    for (file, line, changed), reason in mutants.accepted().items():
        room, name = file.split("/")
        folder = SOURCE / room if room == "scalargraph" else SOURCE / "covariant" / room
        places = [str(path.relative_to(SOURCE)) for path in folder.rglob(name)]
        assert (line, changed) in {mutant.diff() for place in places for mutant in mutants_of(place)}, (file, line)
        assert len(reason) > 40
