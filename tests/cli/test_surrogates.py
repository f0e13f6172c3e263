"""One surrogate switch in run files: a table, or a name in its place."""

import tomllib

import pytest

from cli.small import RUN, call, read_metrics
from invertwin.cli.run_file import to_toml, validate_run
from invertwin.errors import InputError
from invertwin.radar import SURROGATES

TABLE = "[surrogate]\nrange_width = 2.0\nangle_width = 1.0\n"


def named(line: str) -> str:
    return line + RUN.replace(TABLE, "")


@pytest.mark.parametrize("name", SURROGATES)
def test_a_name_stands_for_the_table(name, tmp_path):
    run = validate_run(tomllib.loads(named(f'surrogate = "{name}"')), tmp_path / "run.toml")
    chosen = SURROGATES[name]
    assert run.surrogate.exact == (chosen is None)
    if chosen is not None:
        table = run.surrogate.model_dump(exclude={"exact"})
        assert table == {key: vars(chosen)[key] for key in table}
    assert validate_run(tomllib.loads(to_toml(run)), tmp_path / "run.toml") == run


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('surrogate = "bessel"', "surrogate: expected a Surrogate or one of exact, .* 'bessel'"),
        ("surrogate = 3", "surrogate: expected a table, got 3"),
        ('surrogate = { range_kernel = "sinc" }', "surrogate.range_kernel: expected .*dirichlet"),
    ],
)
def test_a_wrong_one_is_named(line, message, tmp_path):
    with pytest.raises(InputError, match=message):
        validate_run(tomllib.loads(named(line)), tmp_path / "run.toml")


@pytest.mark.slow
def test_the_exact_model_is_fitted_where_visibility_is_fixed(tmp_path, monkeypatch, capsys):
    text = named('surrogate = "exact"').replace("steps = 8", "steps = 3")
    (tmp_path / "exact.toml").write_text(text)
    out = tmp_path / "out"
    assert call(monkeypatch, "reconstruct", tmp_path / "exact.toml", "-o", out) == 2
    assert "boundary=False for fixed visibility" in " ".join(capsys.readouterr().err.split())
    text = text.replace("steps = 3", "steps = 3\nboundary = false")
    (tmp_path / "exact.toml").write_text(text)
    assert call(monkeypatch, "reconstruct", tmp_path / "exact.toml", "-o", out) == 0
    metrics = read_metrics(out)
    assert metrics["steps"] == 3
    assert metrics["surrogate_correlation"] >= 0.9


def test_no_gradient_check_of_exact_signals(tmp_path, monkeypatch, capsys):
    (tmp_path / "check.toml").write_text(
        named('surrogate = "exact"')
        + '[gradcheck]\nparameter = { kind = "translation", object = "plate" }\n'
        + "tangent = { translation = [0, 1, 0] }\nstep = 1e-2\n"
    )
    assert call(monkeypatch, "gradcheck", tmp_path / "check.toml", "-o", tmp_path / "out") == 2
    assert "surrogate.exact: expected a smooth map" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_reports_say_how_well_the_surrogate_agrees(tmp_path, monkeypatch):
    (tmp_path / "run.toml").write_text(RUN)
    out = tmp_path / "out"
    assert call(monkeypatch, "simulate", tmp_path / "run.toml", "-o", out) == 0
    assert 0.9 <= read_metrics(out)["surrogate_correlation"] <= 1
    assert "correlation of the surrogate with the mean of 16 exact looks" in (
        out / "report.html"
    ).read_text(encoding="utf-8")
