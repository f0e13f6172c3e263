"""The table of run-file keys says all that the schema knows."""

import pytest

from cli.small import call
from invertwin.cli.schema.keys import json_schema, key_index, key_tables
from invertwin.errors import InputError
from invertwin.radar.boards import BOARDS


def test_every_key_of_every_section_is_listed_and_explained():
    index = key_index().rows
    assert all(text for _, text in index)
    listed = {row[0]: row for name, _ in index for table in key_tables(name) for row in table.rows}
    listed |= dict.fromkeys(json_schema()["properties"])
    whole = json_schema()
    sections = [whole, *(found for found in whole["$defs"].values() if "properties" in found)]
    assert len(sections) > 70
    for section in sections:
        for key, field in section["properties"].items():
            assert key in listed
            assert field.get("description") or "const" in field, (section["title"], key)


def test_keys_in_degrees_are_explained_in_degrees():
    sections = [found.get("properties", {}) for found in json_schema()["$defs"].values()]
    keys = [(k, f) for section in sections for k, f in section.items() if k.endswith("_deg")]
    assert len(keys) > 30
    assert [key for key, field in keys if "rad]" in field.get("description", "")] == []
    (pattern,) = [t for t in key_tables("radar.board.pattern") if '"table"' in t.title]
    (angles,) = [row for row in pattern.rows if row[0] == "theta_deg"]
    assert angles[-1] == "angles to boresight, from 0 on [°]"


def test_units_limits_and_defaults_are_shown():
    (table,) = key_tables("grid")
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.title == "[grid]"
    assert rows["range_min"] == [
        "number",
        "required",
        "minimum range [m], at least 0 without a range origin",
    ]
    assert rows["u_max"] == [
        "number > 0, ≤ 1",
        "1.0",
        "maximum direction cosine to the left; the map is symmetric",
    ]


def test_kinds_are_listed_apart_with_what_they_share_first():
    titles = [table.title for table in key_tables("radar.transmitters")]
    assert titles[:2] == [
        "[radar.transmitters], all kinds",
        '[radar.transmitters] kind = "planar"',
    ]


def test_what_a_board_owner_looks_for_is_listed():
    """Boards, waveforms, readers, raw files and front ends that the library has."""
    waveforms = {table.title.partition(" kind = ")[2] for table in key_tables("radar.waveform")}
    assert waveforms == {'"fmcw"', '"stepped"', '"ofdm"', '"impulse"'}
    kinds = {table.title.partition(" kind = ")[2].strip('"') for table in key_tables("data")}
    assert kinds >= {"simulated", "capture", "dca1000", "arrays", "sweeps", "rail_sar"}
    (name,) = [row for t in key_tables("radar.board") for row in t.rows if row[0] == "name"]
    assert name[1].replace('"', "").split(", ") == list(BOARDS)
    for section in ("chirps", "raw", "impairments"):
        assert key_tables(section)


def test_sections_repeated_elsewhere_are_referred_to():
    rows = {row[0]: row for row in key_tables("radar")[0].rows}
    assert rows["receivers"][3].endswith("keys as in [radar.transmitters]")


def test_unknown_sections_get_the_nearest():
    with pytest.raises(InputError, match="did you mean `radar`"):
        key_tables("radra")


def test_the_command_prints_them(monkeypatch, capsys):
    assert call(monkeypatch, "keys", "reconstruct") == 0
    said = capsys.readouterr().out
    assert "position_limit" in said
    assert "0.03" in said
