"""Studies of invertwin: the paper's figures, peers to compare with, training of the shape prior.

A plugin of invertwin: it adds the run-file sections `[methods]` and `[loss_scan]` and the commands
`loss-scan` and `train-prior`. Nothing in invertwin builds on it.
"""

from typing import Any


def register(registry: Any) -> None:
    """Adds the sections and commands of the studies to invertwin.

    Called by the entry point `invertwin.plugins`.
    """
    from invertwin_studies.commands import loss_scan, train_prior
    from invertwin_studies.sections import LossScan, Methods

    registry.section("methods", Methods)
    registry.section("loss_scan", LossScan)
    registry.command("loss-scan", loss_scan)
    registry.command("train-prior", train_prior)
