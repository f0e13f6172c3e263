"""Learned and free shapes of a run file: their meshes, modules, and terms of the loss."""

from collections.abc import Callable, Mapping
from functools import partial

import torch
from torch import Tensor, nn

from invertwin.cli import schema
from invertwin.cli.bodies import SoughtBody, posed
from invertwin.errors import InputError
from invertwin.inversion.prior import LatentNorm
from invertwin.inversion.regularization import Laplacian, Regularizer
from invertwin.inversion.remeshing import remeshed, signed_distance
from invertwin.scene import Mesh, Object, Scene
from invertwin.scene.geometry import (
    DensityGrid,
    DistanceGrid,
    LatticeDeformation,
    LinearShape,
    NeuralDistance,
    PriorShape,
    SmoothVertices,
    load_prior,
    load_vehicle_space,
)
from invertwin.scene.parameters import Vertices


def shape_mesh(table: schema.Placement) -> Mesh:
    """The mesh of a learned shape, in the object's frame.

    Raises:
        InputError: Files are missing, or more coefficients than the space has.
    """
    match table:
        case schema.Vehicle():
            space = load_vehicle_space(table.folder, table.level)
            mesh = space.mesh(space.mean.new_tensor(table.coefficients))
            return mesh if table.max_edge is None else remeshed(mesh, table.max_edge)
        case schema.Learned():
            prior = load_prior(table.prior)
            latent = torch.zeros(prior.latent_size, dtype=torch.float64)
            return prior.mesh(latent if table.latent is None else latent.new_tensor(table.latent))
        case schema.BodyShape():
            return posed(table)
    raise InputError(f"expected a shape, got {type(table).__name__}; add `shape`")


def shape_module(
    table: schema.Parameter,
    mesh: Mesh,
    bodies: Mapping[str, SoughtBody],
    item: schema.SceneObject | None = None,
) -> nn.Module:
    """The module of a shape that is sought, from the object's present mesh.

    Args:
        table: The parameter.
        mesh: Of its object.
        bodies: Bodies whose joints are sought, by object.
        item: The table of its object, whose coordinates are where those of its own space start.

    Raises:
        InputError: A box without volume, files are missing, too many coordinates, or fewer than
            the object has.
    """
    match table:
        case schema.VerticesParameter():
            if table.smooth > 0:
                return SmoothVertices(table.object, mesh, table.smooth)
            return Vertices(table.object, len(mesh.vertices))
        case schema.LatticeParameter():
            return LatticeDeformation(table.object, table.low, table.high, table.counts)
        case schema.DistanceGridParameter():
            distance: Callable[[Tensor], Tensor] = partial(signed_distance, mesh)
            return DistanceGrid.sampled(
                table.object, table.low, table.high, table.counts, distance, table.smooth
            )
        case schema.NeuralDistanceParameter():
            return NeuralDistance(
                table.object,
                table.low,
                table.high,
                table.counts,
                radius=table.radius,
                width=table.width,
                depth=table.depth,
                frequency=table.frequency,
            )
        case schema.ShapeSpaceParameter():
            space = load_vehicle_space(table.folder, table.level)
            return LinearShape(table.object, space, _coefficients(table, item))
        case schema.BodyParameter():
            return bodies[table.object].module(table.object, mesh)
        case schema.PriorParameter():
            latent = None
            if isinstance(item, schema.Learned) and item.prior == table.file:
                latent = item.latent
            return PriorShape(table.object, load_prior(table.file), latent, table.counts)
    raise InputError(f"expected a shape, got {table.kind}; choose another kind")


def _coefficients(table: schema.ShapeSpaceParameter, item: schema.SceneObject | None) -> Tensor:
    """Where the coordinates start: as the object's, where it is of the same space; else 0."""
    found = torch.zeros(table.modes, dtype=torch.float64)
    if isinstance(item, schema.Vehicle) and (item.folder, item.level) == (
        table.folder,
        table.level,
    ):
        count = len(item.coefficients)
        if count > table.modes:
            raise InputError(
                f"expected at least as many modes as {table.object} has coefficients, {count}, got "
                f"{table.modes}; raise modes"
            )
        found[:count] = found.new_tensor(item.coefficients)
    return found


def density_module(table: schema.DensityParameter, item: Object) -> DensityGrid:
    """The module of a density: from the object's present cloud, else faint and even.

    Raises:
        InputError: A box without volume.
    """
    if item.cloud is not None:
        cloud = item.cloud
        return DensityGrid(table.object, cloud.low, cloud.high, cloud.density.detach())
    return DensityGrid.even(table.object, table.low, table.high, table.counts)


def shape_terms(table: schema.Parameter, module: nn.Module, scene: Scene) -> list[Regularizer]:
    """What keeps a shape that is sought plausible.

    Args:
        table: The parameter.
        module: Its module.
        scene: Where the fit starts.
    """
    match table:
        case schema.VerticesParameter() if table.laplacian > 0:
            return [Laplacian(scene, table.object, table.laplacian)]
        case schema.ShapeSpaceParameter() | schema.PriorParameter() if table.weight > 0:
            return [LatentNorm(module, table.weight)]
    return []
