"""Density grid of point scatterers: a shape without a surface until meshed."""

from collections.abc import Sequence

import torch
from jaxtyping import Float64
from torch import Tensor, nn
from torch.nn.functional import softplus

from invertwin.checks import ArrayLike, Counts, Point, checked_number
from invertwin.errors import InputError
from invertwin.limits import Positive
from invertwin.scene.cloud import Cloud
from invertwin.scene.mesh import Mesh
from invertwin.scene.parameters import Entries, ObjectModule
from invertwin.scene.scene import Object, Scene
from invertwin.scene.shape_models.distance import signed_distance
from invertwin.scene.shape_models.iso_surface import march_cubes
from invertwin.scene.shape_models.lattice import Lattice

_Samples = Float64[Tensor, "x y z"]
# Minimum initial density over the inverse node spacing: softplus is too flat below.
_MIN_DENSITY = 1e-3


class DensityGrid(ObjectModule):
    """Object as a cloud of point scatterers with densities at the nodes of a grid.

    ``σ = softplus(value) / h``, with h the mean spacing of the nodes. At a value of 0 one cell has
    a transmittance of one half. Learning rates of about 0.1 suit all grids.

    Args:
        object: name of the object; its mesh is no longer used.
        low, high: opposite corners of the box in the object's frame [m].
        density: initial extinction at the nodes [1/m], at least two along each axis. The minimum is
            0.001 of the inverse node spacing.
        albedo: see ``Cloud``.

    Attributes:
        value: parameter [x, y, z].
        albedo: albedo of the cloud, see ``Cloud``.

    Raises:
        InputError: wrong shapes, NaN, a negative density, or a box without volume.
    """

    def __init__(
        self, object: str, low: ArrayLike, high: ArrayLike, density: _Samples, albedo: float = 1.0
    ) -> None:
        super().__init__(object)
        self.albedo = checked_number(albedo, "albedo", 0.0, open_low=True)
        self.lattice = Lattice.from_bounds(low, high, density.shape)
        given = Cloud(self.lattice.low, self.lattice.high, density, albedo).density.detach()
        scaled = (given * self._density_unit).clamp_min(_MIN_DENSITY)
        # log(exp(s) − 1), the inverse of softplus, without overflow.
        self.value = nn.Parameter(scaled + torch.log(-torch.expm1(-scaled)))

    @classmethod
    def from_object(
        cls,
        object: str,
        low: Point,
        high: Point,
        counts: Counts,
        item: Object,
        extinction: Positive | None = None,
    ) -> "DensityGrid":
        """Cloud of point scatterers. It starts from the echoes of [initial], else from
        `extinction`.

        Args:
            object: name of the object.
            low, high: opposite corners of the box in the object's frame [m].
            counts: nodes along x, y and z.
            item: the object; an existing cloud is the start.
            extinction: initial extinction within the object's mesh [1/m]; None = a weak density in
                the whole box.

        Raises:
            InputError: as the class.
        """
        if item.cloud is not None:
            return cls(object, item.cloud.low, item.cloud.high, item.cloud.density.detach())
        if extinction is None:
            return cls.from_optical_depth(object, low, high, counts)
        lattice = Lattice.from_bounds(low, high, counts)
        inside = -signed_distance(item.mesh, lattice.nodes.reshape(-1, 3)) / lattice.spacing.mean()
        return cls(object, low, high, extinction * (4 * inside).sigmoid().reshape(lattice.counts))

    @classmethod
    def from_optical_depth(
        cls, object: str, low: ArrayLike, high: ArrayLike, counts: Sequence[int], depth: float = 0.5
    ) -> "DensityGrid":
        """Build a grid of one density σ from ∫σ ds through the box along its longest side.

        Args:
            object: name of the object.
            low, high: opposite corners of the box in the object's frame [m].
            counts: nodes along x, y and z.
            depth: optical depth ∫σ ds. Keep it small: an opaque cloud hides the volume behind it.
        """
        lattice = Lattice.from_bounds(low, high, counts)
        whole = checked_number(depth, "optical depth", 0.0, open_low=True)
        density = whole / (lattice.high - lattice.low).max()
        return cls(object, low, high, density.expand(lattice.counts))

    @property
    def _density_unit(self) -> float:
        return float(self.lattice.spacing.mean())

    @property
    def density(self) -> _Samples:
        """Extinction at the nodes [1/m]."""
        return softplus(self.value) / self._density_unit

    def entries(self) -> dict[str, Entries]:
        """Return the logarithm of the density, whose changes are relative."""
        value = self.value.detach()
        return {"log_density": Entries("value", slope=value.sigmoid() / softplus(value))}

    @property
    def cloud(self) -> Cloud:
        """Return the present cloud in the object's frame."""
        return Cloud(self.lattice.low, self.lattice.high, self.density, self.albedo)

    def forward(self, scene: Scene) -> Scene:
        """Return the scene with the object as the present cloud.

        Raises:
            InputError: the unused mesh carries derivatives.
        """
        if scene[self.object].mesh.vertices.requires_grad:
            raise InputError(
                f"expected no other parameters of the shape of {self.object!r} beside its density, "
                "got some, which would change nothing; remove them"
            )
        return scene.replace(self.object, cloud=self.cloud)

    def mesh(self, level: float | None = None) -> Mesh:
        """Return the closed surface of equal density, see ``cloud_surface``.

        Raises:
            InputError: no density, or all of it, is above the level.
        """
        return cloud_surface(self.cloud, level)


def cloud_surface(cloud: Cloud, level: float | None = None) -> Mesh:
    """Mesh the closed surface of equal density by marching cubes, without gradients.

    Args:
        cloud: cloud with its density.
        level: density of the surface [1/m]; None = half of the mean of the densest hundredth of the
            nodes.

    Raises:
        InputError: no density, or all of it, is above the level.
    """
    density = cloud.density.detach()
    if level is None:
        dense = density.flatten().sort(descending=True).values
        level = 0.5 * float(dense[: max(1, len(dense) // 100)].mean())
    if not float(density.min()) < level < float(density.max()):
        raise InputError(
            f"expected a level between the densities {float(density.min()):.3g} and "
            f"{float(density.max()):.3g} [1/m], got {level:.3g}; give another"
        )
    # A layer of zero density closes the surface at the faces of the box.
    corners, faces = march_cubes(nn.functional.pad(density, (1, 1, 1, 1, 1, 1)), level, "ascent")
    return Mesh(cloud.low + (corners - 1) * cloud.spacing, faces)


def replace_clouds(scene: Scene) -> Scene:
    """Replace every cloud of a scene by its surface, for exact signals and figures.

    A cloud of uniform density has no such surface: its object keeps its mesh.
    """
    for name, item in scene.objects.items():
        if item.cloud is not None:
            density = item.cloud.density.detach()
            even = float(density.max()) <= 2 * float(density.min())
            mesh = item.mesh if even else cloud_surface(item.cloud)
            scene = scene.replace(name, mesh=mesh, cloud=None)
    return scene
