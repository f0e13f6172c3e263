"""Cross-sections of run files that are known otherwise."""

from invertwin.channel import (
    CrossSection,
    DihedralByMoments,
    DihedralSection,
    PlateSection,
    SphereSection,
    SquareTrihedralSection,
    TrihedralSection,
)
from invertwin.registry.kinds import KindGroup, Registry


def register(registry: Registry) -> None:
    """Add the oracles of radar signatures."""
    registry.groups["cross_section"] = KindGroup(product=CrossSection)
    for name, kind in (
        ("plate", PlateSection),
        ("dihedral", DihedralSection),
        ("trihedral", TrihedralSection),
        ("square_trihedral", SquareTrihedralSection),
        ("sphere", SphereSection),
        ("dihedral_moments", DihedralByMoments),
    ):
        registry.add("cross_section", name, kind)
