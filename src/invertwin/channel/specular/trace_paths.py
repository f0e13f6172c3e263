"""Paths between antennas by the image method and UTD: geometry and fields, differentiable.

The search for paths uses rays and is detached (``image_method``, ``diffraction_candidates``). Their
delays and fields are computed here from the vertices of the triangles that they meet: the length is
the distance to the image of the transmitter, and the polarisation basis is rotated from one plane
of incidence to the next.

Source: derivations §10.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.utils.checkpoint import checkpoint

from invertwin import checks
from invertwin.channel.em import plane_waves
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.scene_tables import connect_surfaces, vertex_velocities
from invertwin.channel.rays.topology import Topology
from invertwin.channel.specular import image_method
from invertwin.channel.specular.candidates import find_sequences
from invertwin.channel.specular.diffracted_paths import evaluate_diffracted_paths
from invertwin.channel.specular.diffraction_candidates import (
    DiffractionCandidates,
    find_diffraction_candidates,
)
from invertwin.channel.specular.image_method import (
    CandidateSurfaces,
    FaceInteractions,
    SpecularPaths,
    UnfoldedPaths,
)
from invertwin.channel.specular.ray_paths import REFLECTION, TRANSMISSION, RayPaths, join_ray_paths
from invertwin.channel.specular.wedge_scene import WedgeScene
from invertwin.checks import ArrayLike, checked_count, checked_tensor, strip_derivatives
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.limits import MAX_COUNT
from invertwin.runtime.memory import require_at_most
from invertwin.scene import FieldCoefficients
from invertwin.scene.scene import Scene

_MAX_DEPTH, _MAX_EDGES = 6, 3
_ROWS_AT_ONCE = 1 << 15
_EDGE_ROWS_AT_ONCE = 1 << 13  # diffracted paths need more memory a row
_AT_REST = (0.0, 0.0, 0.0)
_Columns = dict[str, Tensor]  # columns of `RayPaths` by name
_VELOCITY_HINT = "give one vector, or one per antenna"


@dataclass(frozen=True)
class PathScene:
    """Scene and antennas in world axes, differentiable.

    Attributes:
        scene: objects of the scene.
        topology: triangles of all objects.
        vertices: vertex positions [m].
        velocities: vertex velocities [m/s]; None = all at rest.
        tx, rx: antenna positions [m].
        tx_velocity, rx_velocity: antenna velocities [m/s].
        frequency: carrier frequency [Hz].
    """

    scene: Scene
    topology: Topology
    vertices: Float64[Tensor, "v 3"]
    velocities: Float64[Tensor, "v 3"] | None
    tx: Float64[Tensor, "tx 3"]
    rx: Float64[Tensor, "rx 3"]
    tx_velocity: Float64[Tensor, "tx 3"]
    rx_velocity: Float64[Tensor, "rx 3"]
    frequency: float

    def detach(self) -> "PathScene":
        """Return the scene with positions that carry no derivatives."""
        positions = {n: strip_derivatives(getattr(self, n)) for n in ("vertices", "tx", "rx")}
        return replace(self, **positions)


def trace_paths(
    scene: Scene,
    tx: ArrayLike,
    rx: ArrayLike,
    frequency: float,
    *,
    depth: int = 3,
    edges: int = 0,
    rays: int | None = 1_000_000,
    seed: int = 0,
    tx_velocity: ArrayLike = _AT_REST,
    rx_velocity: ArrayLike = _AT_REST,
) -> RayPaths:
    """Trace paths between point antennas: line of sight, reflections, transmissions, diffraction.

    Smooth surfaces reflect on both sides; sheets (``Slab``, ``Multilayer``) also transmit, along a
    straight line. Delays, directions, vertices, coefficients and Doppler shifts are differentiable
    with respect to the scene, its materials and the antennas, at fixed visibility. A link without a
    path has no rows. With ``edges``, sharp edges diffract by the uniform theory: the sum of all
    paths is then continuous where one of them vanishes, and derivatives with respect to sizes and
    across shadow boundaries are correct.

    Candidates are the sequences of surfaces that ``rays`` rays follow, shot from the side with
    fewer antennas. A sequence that subtends the solid angle Ω at such an antenna is missed with a
    probability below exp(−rays·Ω/4π); ``RayPaths.missed_fraction`` estimates the total. With
    ``rays=None`` every sequence of planes is tested, and none is missed.

    Args:
        scene: scene with surfaces.
        tx: transmitter positions, [3] or [tx, 3], in world axes [m].
        rx: receiver positions, [3] or [rx, 3], in world axes [m].
        frequency: carrier frequency of the coefficients [Hz].
        depth: maximum number of reflections on a path, 0 to 6. Up to 8 sheets on the way are
            passed, and use up nothing of it.
        edges: maximum number of edges on a path, 0 to 3. Paths over one edge also reflect up to
            ``depth`` times and pass sheets; over two or three, they meet no surfaces.
        rays: number of rays from each antenna of the side with fewer, and from all edges together;
            None tests every sequence.
        seed: random seed of the rays' directions.
        tx_velocity: velocities of the transmitters, [3] or [tx, 3] [m/s].
        rx_velocity: velocities of the receivers, [3] or [rx, 3] [m/s].

    Raises:
        InputError: wrong shapes or numbers, a cloud, or too many sequences to test one by one.

    Source: derivations §9 and §10.
    """
    path_scene = prepare_path_scene(scene, tx, rx, frequency, tx_velocity, rx_velocity)
    limit = checked_count(depth, "depth", 0)
    for count, most, what, do in (
        (limit, _MAX_DEPTH, "reflections (depth)", "paths of more reflections are weak"),
        (checked_count(edges, "edges", 0), _MAX_EDGES, "edges on a path", "ask for fewer"),
        (1 if rays is None else checked_count(rays, "rays", 1), MAX_COUNT, "rays", "shoot fewer"),
    ):
        require_at_most(count, most, what, do)
    with tracing():
        interactions = face_interactions(path_scene)
        # Discrete: `torch.func` would claim the intermediate tensors.
        with _DisableFuncTorch():
            bare = path_scene.detach()
            antennas = torch.cat([bare.tx, bare.rx])
            surfaces = CandidateSurfaces(bare.vertices, bare.topology, antennas, interactions)
            specular, missed = _find_specular(bare, surfaces, limit, rays, seed)
            ends, options = (bare.tx, bare.rx), (edges, limit, rays, seed)
            wedges = _wedge_scene(bare, surfaces)
            diffracted = list(find_diffraction_candidates(wedges, *ends, *options))
        paths = [part for group in specular for part in evaluate_paths(path_scene, group)]
        wedge_scene = _wedge_scene(path_scene, surfaces)
        for some in diffracted:
            columns = partial(_diffracted_columns, path_scene, wedge_scene, some)
            paths += _evaluate_in_chunks(path_scene, some.tx, some.rx, _EDGE_ROWS_AT_ONCE, columns)
    return replace(join_ray_paths(paths), missed_fraction=missed)


def _find_specular(
    bare: PathScene, surfaces: CandidateSurfaces, depth: int, rays: int | None, seed: int
) -> tuple[list[SpecularPaths], float | None]:
    """Find the specular paths, and the estimated fraction of missed directions."""
    swapped = len(bare.rx) < len(bare.tx)
    sources, targets = (bare.rx, bare.tx) if swapped else (bare.tx, bare.rx)
    sequences = find_sequences(surfaces, sources, depth, rays, seed)
    found = image_method.find_paths_along(surfaces, sequences.steps, sources, targets)
    return [group.reverse() if swapped else group for group in found], sequences.missed_fraction


def prepare_path_scene(
    scene: Scene,
    tx: ArrayLike,
    rx: ArrayLike,
    frequency: float,
    tx_velocity: ArrayLike = _AT_REST,
    rx_velocity: ArrayLike = _AT_REST,
) -> PathScene:
    """Prepare a scene and antennas for the search for paths.

    Args:
        scene: scene of surfaces only.
        tx, rx: antenna positions, [antenna, 3] or [3] [m].
        frequency: carrier frequency [Hz].
        tx_velocity, rx_velocity: velocities, [3] for all or [antenna, 3] [m/s].

    Raises:
        InputError: a cloud in the scene, or antennas of wrong shape.
    """
    topology, vertices = connect_surfaces(scene)
    ends = checks.checked_rows(tx, "tx positions [m]"), checks.checked_rows(rx, "rx positions [m]")
    given = zip((tx_velocity, rx_velocity), map(len, ends), ("tx", "rx"), strict=True)
    tx_speed, rx_speed = itertools.starmap(_check_velocities, given)
    objects, velocities = scene.objects.values(), None
    if any(item.velocity is not None for item in objects):
        velocities = torch.cat([vertex_velocities(item) for item in objects])
    surfaces = scene, topology, vertices, velocities
    frequency = checks.checked_number(frequency, "frequency [Hz]", 0.0, open_low=True)
    return PathScene(*surfaces, *ends, tx_speed, rx_speed, frequency)


def _check_velocities(value: ArrayLike, count: int, what: str) -> Tensor:
    found = torch.as_tensor(value, dtype=torch.float64)
    rows = found.expand(count, 3) if found.ndim == 1 and len(found) == 3 else found
    return checked_tensor(rows, (count, 3), f"{what} velocities", _VELOCITY_HINT, SPEED_OF_LIGHT)


def face_interactions(path_scene: PathScene) -> FaceInteractions:
    """Find the triangles that reflect, and those that transmit, at 45° incidence."""
    reflect, transmit = [], []
    for item in path_scene.scene.objects.values():
        count = len(item.mesh.faces)
        cosine = torch.full((count,), math.sqrt(0.5), dtype=torch.float64)
        with torch.no_grad():
            found = item.material.coefficients(path_scene.frequency, cosine, torch.arange(count))
        moduli = [strip_derivatives(value).abs() for value in found]
        reflect.append((moduli[0] + moduli[1]) > 0)
        transmit.append((moduli[2] + moduli[3]) > 0)
    return FaceInteractions(torch.cat(reflect), torch.cat(transmit))


def _wedge_scene(path_scene: PathScene, surfaces: CandidateSurfaces) -> WedgeScene:
    coefficients = partial(_face_coefficients, path_scene)
    return WedgeScene(path_scene.vertices, path_scene.topology, surfaces, coefficients)


def _evaluate_in_chunks(
    path_scene: PathScene, tx: Tensor, rx: Tensor, size: int, columns: Callable[[Tensor], _Columns]
) -> list[RayPaths]:
    """Evaluate the columns of paths in chunks, with checkpointing for many rows."""
    inputs = (path_scene.vertices, path_scene.tx, path_scene.rx)
    heavy = len(tx) > size and any(value.requires_grad for value in inputs)
    found: list[RayPaths] = []
    for rows in torch.arange(len(tx)).split(size):
        values = checkpoint(columns, rows, use_reentrant=False) if heavy else columns(rows)
        paths = RayPaths(
            counts=(len(path_scene.tx), len(path_scene.rx)),
            frequency=path_scene.frequency,
            tx=tx[rows],
            rx=rx[rows],
            objects=path_scene.topology.face_object[values["faces"]],
            names=path_scene.scene.names,
            missed_fraction=None,
            **values,
        )
        found.append(paths)
    return found


def _diffracted_columns(
    path_scene: PathScene, wedge_scene: WedgeScene, candidates: DiffractionCandidates, rows: Tensor
) -> _Columns:
    """Columns of diffracted paths."""
    candidates = candidates.select(rows)
    k = 2 * math.pi * path_scene.frequency / SPEED_OF_LIGHT
    found = evaluate_diffracted_paths(wedge_scene, candidates, path_scene.tx, path_scene.rx, k)
    ways = found.directions.unbind(1)
    sent, received = (
        plane_waves.polarisations(way).to(found.transfer) for way in (ways[0], -ways[-1])
    )
    matrix = torch.einsum("pri,pij,ptj->prt", received, found.transfer, sent)
    slopes = torch.einsum("pri,psij,ptj->psrt", received, found.slopes, sent)
    scale = SPEED_OF_LIGHT / path_scene.frequency / (4 * math.pi)
    legs = _leg_columns(path_scene, found.tx, found.rx, ways, found.points, found.faces)
    columns = legs | {
        "delay": found.length / SPEED_OF_LIGHT,
        "coefficient": matrix * scale,
        "kinds": found.kinds,
    }
    if candidates.edge.shape[1] > 1:
        return columns
    return columns | {"slopes": slopes * scale, "axes": found.axes}


def _leg_columns(
    path_scene: PathScene,
    tx: Tensor,
    rx: Tensor,
    directions: Sequence[Tensor],
    vertices: Float64[Tensor, "path vertex 3"],
    faces: Int64[Tensor, "path vertex"],
) -> _Columns:
    """Columns of the legs, with Doppler shifts from the rate at which path lengths decrease."""
    rate = plane_waves.dot(directions[0], path_scene.tx_velocity[tx])
    rate = rate - plane_waves.dot(directions[-1], path_scene.rx_velocity[rx])
    if path_scene.velocities is not None and faces.shape[1]:
        triangles = path_scene.topology.faces[faces]
        corners, speeds = path_scene.vertices[triangles], path_scene.velocities[triangles]
        moved = plane_waves.interpolate_vectors(speeds, corners, vertices)
        for step in range(faces.shape[1]):
            rate = rate + plane_waves.dot(directions[step + 1] - directions[step], moved[:, step])
    doppler = path_scene.frequency / SPEED_OF_LIGHT * rate
    ends = {"departure": directions[0], "arrival": -directions[-1]}
    return ends | {"vertices": vertices, "faces": faces, "doppler": doppler}


def evaluate_paths(path_scene: PathScene, specular_paths: SpecularPaths) -> list[RayPaths]:
    """Evaluate specular paths in chunks, with checkpointing where derivatives are needed.

    Args:
        path_scene: scene and antennas.
        specular_paths: triangles that each path meets.
    """

    def columns(rows: Tensor) -> _Columns:
        return _specular_columns(path_scene, specular_paths.select(rows))

    ends = specular_paths.source, specular_paths.target
    return _evaluate_in_chunks(path_scene, *ends, _ROWS_AT_ONCE, columns)


def _specular_columns(path_scene: PathScene, paths: SpecularPaths) -> _Columns:
    """Columns of specular paths."""
    tx, rx = path_scene.tx[paths.source], path_scene.rx[paths.target]
    moving = path_scene.vertices, path_scene.topology
    unfolded = UnfoldedPaths(*moving, paths.faces, paths.transmitted, tx)
    distance = (rx - unfolded.image).norm(dim=1)
    units, vertices = unfolded.directions(rx), unfolded.interaction_points(rx)
    matrix = _transfer_matrix(path_scene, paths, units, unfolded.normal)
    scale = SPEED_OF_LIGHT / path_scene.frequency / (4 * math.pi) / distance
    ends = paths.source, paths.target
    return _leg_columns(path_scene, *ends, units, vertices, paths.faces) | {
        "delay": distance / SPEED_OF_LIGHT,
        "coefficient": matrix * scale[:, None, None],
        "kinds": torch.where(paths.transmitted, TRANSMISSION, REFLECTION),
    }


def _transfer_matrix(
    path_scene: PathScene, paths: SpecularPaths, directions: list[Tensor], normal: Tensor
) -> Complex128[Tensor, "path 2 2"]:
    """Polarisation transfer matrix between V and H at both ends, without spreading."""
    before = plane_waves.polarisations(directions[0])
    matrix = torch.eye(2, dtype=torch.complex128).expand(len(before), 2, 2)
    cosine = plane_waves.dot(torch.stack(directions, 1)[:, :-1], normal).abs()
    found = _face_coefficients(path_scene, paths.faces.ravel(), cosine.ravel())
    r_s, r_p, t_s, t_p = (value.view(paths.faces.shape).unbind(1) for value in found)
    for step, passing in enumerate(paths.transmitted.unbind(1)):
        across, into, out = plane_waves.plane_of_incidence(normal[:, step], directions[step])
        through = passing[:, None]
        matrix = _change_of_basis(torch.cat([across, into], 1), before) @ matrix
        mirrors = torch.stack([r_s[step], r_p[step]], 1)
        passes = torch.stack([t_s[step], t_p[step]], 1)
        matrix = torch.where(through, passes, mirrors)[..., None] * matrix
        before = torch.cat([across, torch.where(through[..., None], into, out)], 1)
    return _change_of_basis(plane_waves.polarisations(-directions[-1]), before) @ matrix


def _change_of_basis(new: Tensor, old: Tensor) -> Tensor:
    """Matrix from components along two unit vectors to components along two others."""
    return plane_waves.dot(new[:, :, None], old[:, None]).to(torch.complex128)


def _face_coefficients(
    path_scene: PathScene, faces: Int64[Tensor, " n"], cosine: Float64[Tensor, " n"]
) -> FieldCoefficients:
    """Field coefficients of triangles, with one evaluation per material."""
    materials = [item.material for item in path_scene.scene.objects.values()]
    owner = path_scene.topology.face_object[faces]
    first = torch.searchsorted(path_scene.topology.face_object, torch.arange(len(materials)))
    found = [torch.zeros(len(faces), dtype=torch.complex128) for _ in range(4)]
    for material in {id(each): each for each in materials}.values():
        rows = torch.nonzero(torch.tensor([each is material for each in materials])[owner])[:, 0]
        if not len(rows):
            continue
        triangle = faces[rows] - first[owner[rows]]
        values = material.coefficients(path_scene.frequency, cosine[rows], triangle)
        pairs = zip(found, values, strict=True)
        found = [total.index_put((rows,), value.to(torch.complex128)) for total, value in pairs]
    return FieldCoefficients(*found)
