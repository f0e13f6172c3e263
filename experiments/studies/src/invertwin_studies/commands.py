"""The commands of the studies. Heavy imports wait until a command is called."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from invertwin.cli.options import FileArgument, OutputOptions, RunOptions, with_options
from invertwin.errors import locate_errors

if TYPE_CHECKING:
    from invertwin.cli.report import ReportTable
    from invertwin.storage.run_folder import RunFolder


@with_options(RunOptions)
def loss_scan(options: RunOptions, file: FileArgument) -> None:
    """Show the losses of signals and of the surrogate along a line."""
    from invertwin.cli.terminal import load_runs, run_in_folder

    runs = load_runs([file], options, "loss-scan", ("loss_scan", "radar", "grid", "data"))

    def work(folder: "RunFolder") -> "tuple[list[ReportTable], str]":
        from invertwin_studies.loss_scan import run_loss_scan

        with locate_errors(file):
            return run_loss_scan(runs[file.stem], folder), ""

    run_in_folder(options, Path("out", file.stem), work, runs)


@with_options(OutputOptions)
def train_prior(
    options: OutputOptions,
    cars: Annotated[int, typer.Option(min=100, help="Cars that are drawn for it.")] = 3000,
    latent: Annotated[int, typer.Option(min=1, max=64, help="Coordinates of a shape.")] = 24,
    epochs: Annotated[int, typer.Option(min=1, help="Times that every car is seen.")] = 40,
    wheels: Annotated[bool, typer.Option("--wheels", help="Cars with wheels.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1)] = 0,
) -> None:
    """Train a shape prior on cars of the generator; the packaged one by default."""
    from invertwin.cli.terminal import limit_rate, run_in_folder
    from invertwin_studies import train_prior as training
    from invertwin_studies.prior_training import Training

    settings = Training(cars=cars, latent=latent, epochs=epochs, wheels=wheels, seed=seed)
    again = f"train-prior --cars {cars} --latent {latent} --epochs {epochs} --seed {seed}"
    again += " --wheels" if wheels else ""

    def work(folder: "RunFolder") -> "tuple[list[ReportTable], str]":
        return training.run_train_prior(settings, folder, again, limit_rate()), ""

    run_in_folder(options, Path("out/train_prior"), work)
