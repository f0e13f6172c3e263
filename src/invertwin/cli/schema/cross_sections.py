"""Cross-sections of run files that are known otherwise."""

from invertwin import channel
from invertwin.registry.kinds import KindGroup, Registry


def register(registry: Registry) -> None:
    """Add the oracles of radar signatures."""
    registry.groups["cross_section"] = KindGroup(product=channel.CrossSection)
    registry.add("cross_section", "plate", channel.PlateSection)
    registry.add("cross_section", "dihedral", channel.DihedralSection)
    registry.add("cross_section", "trihedral", channel.TrihedralSection)
    registry.add("cross_section", "square_trihedral", channel.SquareTrihedralSection)
    registry.add("cross_section", "sphere", channel.SphereSection)
