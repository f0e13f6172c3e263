"""Errors are one line that a terminal shows as it is."""

from invertwin.errors import InputError, to_one_line


def test_lines_control_characters_and_lengths_are_tamed():
    assert str(InputError("expected a,\n  got b")) == "expected a, got b"
    assert str(InputError("got \x1b[31mred\x00")) == "got \\x1b[31mred\\x00"
    assert to_one_line("ä → ⅔") == "ä → ⅔"
    long = to_one_line("a" * 9_000 + "b" * 9_000)
    assert len(long) == 8_003
    assert long.startswith("aaa")
    assert long.endswith("bbb")
