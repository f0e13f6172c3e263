"""Studies of invertwin: figures, peers to compare with, training of the prior, public recordings.

A plugin of invertwin: it adds the run-file sections `[methods]` and `[loss_scan]`, the commands
`loss-scan` and `train-prior`, the readers of two public recordings, the `[data]` kinds
`openradar` and `rail_sar`, and the public space of vehicles, the shape `vehicle` with the unknown
`shape_space`. `mirrors` has ghosts in maps and fields, to be called from Python. Nothing in
invertwin builds on it.
"""

from typing import Any


def register(registry: Any) -> None:
    """Adds the sections, commands and readers of the studies to invertwin.

    Called by the entry point `invertwin.plugins`.
    """
    from invertwin_studies.commands import loss_scan, train_prior
    from invertwin_studies.sections import LossScan, Methods

    registry.sections["methods"] = Methods
    registry.sections["loss_scan"] = LossScan
    registry.commands["loss-scan"] = loss_scan
    registry.commands["train-prior"] = train_prior
    registry.add("shape", "vehicle", "invertwin_studies.vehicle_space:vehicle")
    coordinates = "invertwin_studies.vehicle_space:vehicle_coordinates"
    registry.add("parameter", "shape_space", coordinates)
    moments = "invertwin_studies.dihedral_moments:DihedralByMoments"
    registry.add("cross_section", "dihedral_moments", moments)
    registry.add("model", "random_phase", "invertwin_studies.random_phase:RandomPhaseMap")
    for kind, file, board in (
        ("openradar", "openradar.npz", "xWR1642"),
        ("rail_sar", "bwsi_rail_trial6.npz", None),
    ):
        registry.add("data", kind, f"invertwin_studies.recordings.kinds:{kind}_data")
        registry.recordings[file] = (kind, board)
