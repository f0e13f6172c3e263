"""`invertwin train-prior`: small, from the command to a prior that loads."""

import pytest

from cli.small import call, read_metrics
from invertwin.scene import load_prior
from invertwin_studies.prior_training import Training


@pytest.mark.slow
def test_a_small_prior_is_trained_and_loads(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    small = ["--cars", "100", "--latent", "4", "--epochs", "1", "--seed", "3", "--wheels"]
    assert call(monkeypatch, "train-prior", *small) == 0
    out = tmp_path / "out" / "train_prior"
    metrics = read_metrics(out)
    assert metrics["held_out_error_m"] < metrics["mean_error_m"]
    assert metrics["decode_64_s"] < 1
    assert metrics["file_mb"] < 5
    log = (out / "train.log").read_text()
    assert "cars 100" in log.splitlines()[0]
    assert "wheels True, seed 3" in log.splitlines()[0]
    prior = load_prior(out / "prior.npz")
    assert prior.latent_size == 4
    # Wheels reach the ground.
    assert float(prior.mean_mesh((67, 31, 30)).vertices[:, 2].amin()) < 0.08
    report = (out / "report.html").read_text()
    assert "train-prior --cars 100 --latent 4 --epochs 1 --seed 3 --wheels" in report
    assert "Shape prior" in capsys.readouterr().out
    assert call(monkeypatch, "train-prior", *small) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_the_command_without_options_has_the_settings_of_the_packaged_prior(tmp_path, monkeypatch):
    from invertwin_studies import train_prior

    asked: list[Training] = []

    class StopError(Exception):
        pass

    def stop(settings, *_):
        asked.append(settings)
        raise StopError

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_prior, "run_train_prior", stop)
    with pytest.raises(StopError):
        call(monkeypatch, "train-prior")
    assert asked == [Training()]
