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
    registry.add("cross_section", "plate", PlateSection)
    registry.add("cross_section", "dihedral", DihedralSection)
    registry.add("cross_section", "trihedral", TrihedralSection)
    registry.add("cross_section", "square_trihedral", SquareTrihedralSection)
    registry.add("cross_section", "sphere", SphereSection)
    registry.add("cross_section", "dihedral_moments", DihedralByMoments)
