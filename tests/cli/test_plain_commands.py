"""Any verb with any machine and any log gives a result or a refusal: pairs of them here, their whole product before a
release."""

import pytest
from plain_commands import FROM_LOGS, LOGS, MACHINES, NO_LOG, WITHOUT_LOGS, cover, every_case, run_case, write_machines

PAIRS = [*cover([*FROM_LOGS], [*MACHINES], [*LOGS]), *cover([*WITHOUT_LOGS], [*MACHINES], [NO_LOG])]


@pytest.fixture(scope="module")
def machines(tmp_path_factory):
    folder = tmp_path_factory.mktemp("machines")
    write_machines(folder)
    return folder


@pytest.mark.parametrize(
    ("verb", "machine", "log"),
    [pytest.param(*case, marks=() if case in PAIRS else pytest.mark.exhaustive) for case in every_case()],
)
@pytest.mark.long
def test_a_plain_command_ends_in_a_result_or_a_refusal(machines, monkeypatch, capsys, verb, machine, log):
    monkeypatch.chdir(machines)
    monkeypatch.syspath_prepend(machines)
    ended = run_case(verb, machine, log, capsys)
    assert not ended.fault, ended.fault


def test_the_pairs_meet_and_are_few():
    kinds = ("abc", "def", "gh")
    cases = cover(*kinds)
    assert {(row[i], row[j]) for row in cases for i, j in ((0, 1), (0, 2), (1, 2))} >= {
        (a, b) for i, j in ((0, 1), (0, 2), (1, 2)) for a in kinds[i] for b in kinds[j]
    }
    assert len(cases) == 9
