"""The siege sees what is no refusal, what is too large, and what is lost."""

import pytest


def test_there_are_many_cases_of_every_kind(siege):
    kinds = [case.kind for case in siege.CASES]
    assert len(kinds) >= 60
    assert min(kinds.count(kind) for kind in set(kinds)) >= 5
    assert len({(case.kind, case.name) for case in siege.CASES}) == len(kinds)


@pytest.mark.parametrize(
    ("code", "expects", "failure"),
    [
        ("raise InputError('expected a, got b')", "refused", ""),
        ("raise InputError('expected a, got b')", "done", "expected exit code 0, got 2"),
        ("print('well')", "done", ""),
        ("print('well')", "refused", "expected one line and exit code 2"),
        ("1 / 0", "refused", "traceback: ZeroDivisionError"),
        ("print('a', file=sys.stderr); raise InputError('b')", "refused", "got 2 lines"),
        ("a = bytearray(2_100_000_000); raise InputError('b')", "refused", "took 2.1 GB"),
    ],
)
def test_outcomes(siege, code, expects, failure):
    text = f"import sys\nfrom invertwin.errors import InputError\n{code}"
    case = siege.Case("kind", "name", lambda _: None, ("-c", text), expects=expects)
    found = siege.run(case)
    assert failure in found.failure
    assert bool(found.failure) == bool(failure)
    assert 0 < found.seconds < 20


def test_files_of_the_user_must_stay(siege):
    def make(folder):
        (folder / "mine").write_text("mine")
        return siege.Made(keep=["mine"])

    case = siege.Case("kind", "name", make, ("-c", "open('mine', 'w')"), expects="done")
    assert siege.run(case).failure == "the user's files have changed"


def test_memory_is_that_of_the_case_not_of_who_runs_it(siege):
    held = bytearray(600_000_000)
    case = siege.Case("kind", "name", lambda _: None, ("-c", "print('well')"), expects="done")
    assert siege.run(case).gigabytes < 0.4
    assert len(held) == 600_000_000
