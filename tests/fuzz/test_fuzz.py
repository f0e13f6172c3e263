"""Damaged files of every format: an error of one line or success, in short (`make fuzz`: long)."""

import pytest
from hypothesis import HealthCheck, given, settings

from fuzz.cases import outcome
from fuzz.damage import EDITS, Edits, damaged
from fuzz.formats import FORMATS

# Those that start processes take long.
NAMES = [
    pytest.param(name, marks=pytest.mark.slow) if name == "planted" else name for name in FORMATS
]


@pytest.mark.parametrize("name", NAMES)
def test_valid_files_are_read(unchecked, name):
    for files in FORMATS[name].samples():
        assert outcome(FORMATS[name], files)[0] is None


@pytest.mark.parametrize("name", NAMES)
def test_damaged_files_are_one_line(unchecked, name):
    form = FORMATS[name]
    samples = form.samples()

    @settings(
        max_examples=form.short,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
    )
    @given(EDITS)
    def one_line(edits: Edits) -> None:
        found, _ = outcome(form, damaged(samples, edits, form.levels))
        assert found is None

    one_line()
