"""The small run file in a folder of its own."""

import pytest

from cli.small import RUN


@pytest.fixture
def run_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "small.toml"
    file.write_text(RUN)
    return file
