"""Specular paths between antennas: geometry and polarised fields, differentiable.

Which paths there are is found by rays and is detached (``images``). What they are worth is computed
here from the vertices of the triangles that they meet: the length to the image of the transmitter,
and the field, turned from one plane of incidence to the next.

Source: derivations §10.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Complex128, Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from invertwin.channel.em.plane_waves import (
    dot,
    mirrored,
    plane_of_incidence,
    points_at,
    polarisations,
)
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.scene_tables import vertex_velocities
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.specular.candidates import (
    Powers,
    Sequences,
    every_sequence,
    shot_sequences,
)
from invertwin.channel.specular.diffracted_paths import diffracted_paths
from invertwin.channel.specular.diffraction_candidates import Bends, find_bends
from invertwin.channel.specular.image_method import (
    Chains,
    Walls,
    chains_between,
    corners_of,
    images,
)
from invertwin.channel.specular.ray_paths import REFLECTION, TRANSMISSION, RayPaths, joined
from invertwin.channel.specular.wedge_scene import EdgedScene
from invertwin.checks import (
    ArrayLike,
    checked_count,
    checked_number,
    checked_tensor,
    plain,
)
from invertwin.constants import SPEED_OF_LIGHT
from invertwin.errors import InputError
from invertwin.limits import MOST
from invertwin.scene import FieldCoefficients
from invertwin.scene.scene import Scene

_DEEPEST, _MOST_EDGES = 6, 3
_ROWS_AT_ONCE = 1 << 15
_BENT_AT_ONCE = 1 << 13  # paths round edges, which hold more
_UP = (0.0, 0.0, 1.0)
_STILL = "give one vector, or one per antenna"


@dataclass(frozen=True)
class Stage:
    """Scene and antennas as paths are computed from them, differentiable.

    Attributes:
        scene: Its objects.
        topology: Their triangles.
        vertices: [m].
        velocities: Of the vertices [m/s]; None = all at rest.
        tx, rx: Antennas [m].
        tx_velocity, rx_velocity: [m/s].
        frequency: [Hz].
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
    tx_velocity: ArrayLike = (0.0, 0.0, 0.0),
    rx_velocity: ArrayLike = (0.0, 0.0, 0.0),
) -> RayPaths:
    """Paths between point antennas: line of sight, mirrored, through sheets, and round edges.

    Smooth surfaces mirror on both sides; sheets (``Slab``, ``Multilayer``) also let through, on a
    straight line. Delays, directions, vertices, coefficients and Doppler shifts are differentiable
    with respect to the scene, its materials and the antennas, at fixed visibility. A link without a
    path has no rows. With ``edges``, sharp edges diffract by the uniform theory: the sum of all
    paths then has no jump where one of them is lost, and derivatives by sizes and across shadows
    are right.

    Candidates are the sequences of surfaces that ``rays`` rays follow, shot from the side with
    fewer antennas. A sequence that fills the solid angle Ω about such an antenna is missed with
    less than the probability exp(−rays·Ω/4π); ``RayPaths.missed`` estimates what is missed in all.
    With ``rays=None`` every sequence of planes is tried, and none is missed.

    Args:
        scene: What is in the way.
        tx: Transmitters, [3] or [tx, 3] in the world [m].
        rx: Receivers, [3] or [rx, 3] [m].
        frequency: Of the coefficients [Hz].
        depth: Most surfaces that a path meets, 0 to 6; a sheet that it passes counts as one.
        edges: Most edges that a path goes round, 0 to 3. Paths round one edge also meet up to
            ``depth`` surfaces; round two, none.
        rays: Shot from each antenna of the side with fewer, and from all edges together; None tries
            every sequence.
        seed: Of the rays' directions.
        tx_velocity: Of the transmitters, one or one for each [m/s].
        rx_velocity: Of the receivers [m/s].

    Raises:
        InputError: Wrong shapes or numbers, a cloud, or too many sequences to try one by one.

    Source: derivations §9 and §10.
    """
    stage = staged(scene, tx, rx, frequency, tx_velocity, rx_velocity)
    most = checked_count(depth, "depth", 0)
    if most > _DEEPEST:
        raise InputError(
            f"expected a depth of at most {_DEEPEST}, got {most}; paths of more mirrors are weak"
        )
    if checked_count(edges, "edges", 0) > _MOST_EDGES:
        raise InputError(f"expected at most {_MOST_EDGES} edges on a path, got {edges}")
    if rays is not None and not 1 <= checked_count(rays, "rays", 1) <= MOST:
        raise InputError(f"expected at most {MOST:,} rays, got {rays}; shoot fewer")
    with tracing():
        powers = powers_of(stage)
        # Discrete: to `torch.func`, tensors made on the way would be its own.
        with _DisableFuncTorch():
            walls = _walls(stage)
            found, missed = _searched(stage, walls, powers, most, rays, seed)
            bends = _bends(stage, walls, powers, edges, most, rays, seed) if edges else []
        parts = [part for chains in found for part in paths_of(stage, chains)]
        around = _around(stage, walls)
        parts += [part for some in bends for part in _bent(stage, around, some)]
    return replace(joined(parts), missed=missed)


def _walls(stage: Stage) -> Walls:
    antennas = torch.cat([plain(stage.tx), plain(stage.rx)])
    return Walls(plain(stage.vertices), stage.topology, antennas)


def _bends(
    stage: Stage,
    walls: Walls,
    powers: Powers,
    edges: int,
    depth: int,
    rays: int | None,
    seed: int,
) -> list[Bends]:
    """Which paths go round edges."""
    bare = replace(_around(stage, walls), vertices=plain(stage.vertices))
    ends = plain(stage.tx), plain(stage.rx)
    return list(find_bends(bare, powers, *ends, edges, depth, rays, seed))


def _searched(
    stage: Stage, walls: Walls, powers: Powers, depth: int, rays: int | None, seed: int
) -> tuple[list[Chains], float | None]:
    """Which paths there are, and the share of directions that was missed."""
    tx, rx = plain(stage.tx), plain(stage.rx)
    swapped = len(rx) < len(tx)
    sources, targets = (rx, tx) if swapped else (tx, rx)
    if not depth:
        sequences = Sequences((), None)
    elif rays is None:
        sequences = every_sequence(walls.planes, powers, depth)
    else:
        sequences = shot_sequences(walls, walls.planes, powers, sources, depth, rays, seed)
    found: list[Chains] = []
    for steps in (torch.zeros(1, 0, dtype=torch.int64), *sequences.steps):
        for number, source in enumerate(sources) if len(steps) else ():
            found += chains_between(walls, steps, source, targets, number)
    return [chains.reversed() if swapped else chains for chains in found], sequences.missed


def staged(
    scene: Scene,
    tx: ArrayLike,
    rx: ArrayLike,
    frequency: float,
    tx_velocity: ArrayLike,
    rx_velocity: ArrayLike,
) -> Stage:
    """A scene and antennas as the search for paths needs them.

    Args:
        scene: Surfaces only.
        tx, rx: Places [antenna, 3] or [3] [m].
        frequency: Of the carrier [Hz].
        tx_velocity, rx_velocity: One for all, or one each [m/s].

    Raises:
        InputError: A cloud in the scene, or antennas of wrong shape.
    """
    objects = scene.objects.values()
    clouds = [name for name, item in scene.objects.items() if item.cloud is not None]
    if clouds:
        raise InputError(
            f"expected objects with surfaces, got clouds for {', '.join(clouds)}; mesh them"
        )
    ends = [_antennas(place, what) for place, what in ((tx, "tx"), (rx, "rx"))]
    speeds = [
        _velocities(value, len(end), what)
        for value, end, what in ((tx_velocity, ends[0], "tx"), (rx_velocity, ends[1], "rx"))
    ]
    vertices = [item.vertices for item in objects]
    velocities = None
    if any(item.velocity is not None for item in objects):
        velocities = torch.cat([vertex_velocities(item) for item in objects])
    return Stage(
        scene,
        topology_of([item.mesh for item in objects]),
        torch.cat(vertices),
        velocities,
        ends[0],
        ends[1],
        speeds[0],
        speeds[1],
        checked_number(frequency, "frequency [Hz]", 0.0, open_low=True),
    )


def _antennas(places: ArrayLike, what: str) -> Tensor:
    found = torch.as_tensor(places, dtype=torch.float64)
    rows = found[None] if found.ndim == 1 else found
    rows = checked_tensor(rows, (None, 3), f"{what} places [m]", "give x, y, z of each")
    if not len(rows):
        raise InputError(f"expected at least one place of {what}, got none; give x, y, z of each")
    return rows


def _velocities(value: ArrayLike, count: int, what: str) -> Tensor:
    found = torch.as_tensor(value, dtype=torch.float64)
    rows = found.expand(count, 3) if found.ndim == 1 and len(found) == 3 else found
    return checked_tensor(rows, (count, 3), f"{what} velocities [m/s]", _STILL)


def powers_of(stage: Stage) -> Powers:
    """Which triangles mirror, and which let through, at 45°."""
    reflect, transmit = [], []
    for item in stage.scene.objects.values():
        count = len(item.mesh.faces)
        cosine = torch.full((count,), math.sqrt(0.5), dtype=torch.float64)
        with torch.no_grad():
            found = item.material.coefficients(stage.frequency, cosine, torch.arange(count))
        moduli = [plain(value).abs() for value in found]
        reflect.append((moduli[0] + moduli[1]) > 0)
        transmit.append((moduli[2] + moduli[3]) > 0)
    return Powers(torch.cat(reflect), torch.cat(transmit))


def _around(stage: Stage, walls: Walls) -> EdgedScene:
    return EdgedScene(
        stage.vertices,
        stage.topology,
        walls,
        lambda faces, cosine: _coefficients(stage, faces, cosine),
    )


def _bent(stage: Stage, around: EdgedScene, found: Bends) -> list[RayPaths]:
    """Paths round edges in pieces, as in ``paths_of``."""
    rows = torch.arange(len(found.tx))
    some = (stage.vertices, stage.tx, stage.rx)
    heavy = len(rows) > _BENT_AT_ONCE and any(value.requires_grad for value in some)
    parts: list[RayPaths] = []
    for row in rows.split(_BENT_AT_ONCE):
        part = found.rows(row)

        def columns(part: Bends = part) -> tuple[Tensor, ...]:
            return _bent_columns(stage, around, part)

        values = checkpoint(columns, use_reentrant=False) if heavy else columns()
        delay, coefficient, departure, arrival, vertices, doppler, *rest = values
        kinds, faces, slopes, axes = rest
        parts.append(
            RayPaths(
                (len(stage.tx), len(stage.rx)),
                stage.frequency,
                part.tx,
                part.rx,
                delay,
                coefficient,
                departure,
                arrival,
                vertices,
                kinds,
                faces,
                stage.topology.face_object[faces],
                stage.scene.names,
                doppler,
                slopes if part.edge.shape[1] == 1 else None,
                axes if part.edge.shape[1] == 1 else None,
            )
        )
    return parts


def _bent_columns(stage: Stage, around: EdgedScene, bends: Bends) -> tuple[Tensor, ...]:
    """As ``_columns``, and kinds, faces, slopes and axes, of paths round edges."""
    k = 2 * math.pi * stage.frequency / SPEED_OF_LIGHT
    found = diffracted_paths(around, bends, stage.tx, stage.rx, k)
    departure, arrival = found.ways[:, 0], -found.ways[:, -1]
    up = torch.tensor(_UP, dtype=torch.float64)
    sent, received = (polarisations(way, up).to(found.transfer) for way in (departure, arrival))
    matrix = torch.einsum("pri,pij,ptj->prt", received, found.transfer, sent)
    slopes = torch.einsum("pri,psij,ptj->psrt", received, found.slopes, sent)
    scale = SPEED_OF_LIGHT / stage.frequency / (4 * math.pi)
    rate = _approach(
        stage, bends.tx, bends.rx, list(found.ways.unbind(1)), found.points, found.faces
    )
    return (
        found.length / SPEED_OF_LIGHT,
        matrix * scale,
        departure,
        arrival,
        found.points,
        stage.frequency / SPEED_OF_LIGHT * rate,
        found.kinds,
        found.faces,
        slopes * scale,
        found.axes,
    )


def _approach(
    stage: Stage,
    tx: Tensor,
    rx: Tensor,
    ways: list[Tensor],
    vertices: Float64[Tensor, "path vertex 3"],
    faces: Int64[Tensor, "path vertex"],
) -> Float64[Tensor, " path"]:
    """How fast paths get shorter [m/s]."""
    rate = dot(ways[0], stage.tx_velocity[tx]) - dot(ways[-1], stage.rx_velocity[rx])
    if stage.velocities is not None and faces.shape[1]:
        triangles = stage.topology.faces[faces]
        moved = points_at(stage.velocities[triangles], stage.vertices[triangles], vertices)
        for step in range(faces.shape[1]):
            rate = rate + dot(ways[step + 1] - ways[step], moved[:, step])
    return rate


def paths_of(stage: Stage, chains: Chains) -> list[RayPaths]:
    """The paths in pieces; what derivatives need is computed again for each, not kept.

    Args:
        stage: Scene and antennas.
        chains: Which surfaces each path meets.
    """
    rows = torch.arange(len(chains.source))
    some = (stage.vertices, stage.tx, stage.rx)
    heavy = len(rows) > _ROWS_AT_ONCE and any(value.requires_grad for value in some)
    found: list[RayPaths] = []
    for row in rows.split(_ROWS_AT_ONCE):
        part = Chains(*(column[row] for column in vars(chains).values()))

        def columns(part: Chains = part) -> tuple[Tensor, ...]:
            return _columns(stage, part)

        values = checkpoint(columns, use_reentrant=False) if heavy else columns()
        found.append(_rows(stage, part, values))
    return found


def _rows(stage: Stage, chains: Chains, values: tuple[Tensor, ...]) -> RayPaths:
    delay, coefficient, departure, arrival, vertices, doppler = values
    return RayPaths(
        (len(stage.tx), len(stage.rx)),
        stage.frequency,
        chains.source,
        chains.target,
        delay,
        coefficient,
        departure,
        arrival,
        vertices,
        torch.where(chains.through, TRANSMISSION, REFLECTION),
        chains.faces,
        stage.topology.face_object[chains.faces],
        stage.scene.names,
        doppler,
    )


def _columns(stage: Stage, chains: Chains) -> tuple[Tensor, ...]:
    """Delay, coefficient, departure, arrival, vertices and Doppler shift of paths of one length."""
    tx, rx = stage.tx[chains.source], stage.rx[chains.target]
    count, length = chains.faces.shape
    corners = stage.vertices[stage.topology.faces[chains.faces]]
    sides = corners[..., 1:, :] - corners[..., :1, :]
    normal = normalize(torch.linalg.cross(sides[..., 0, :], sides[..., 1, :]), dim=-1)
    point = corners[..., 0, :]
    seen = images(tx, point, normal, chains.through)
    whole = rx - seen[-1]
    distance = whole.norm(dim=1)
    ways = [whole / distance[:, None]]
    for step in reversed(range(length)):
        turned = mirrored(ways[0], normal[:, step])
        ways.insert(0, torch.where(chains.through[:, step, None], ways[0], turned))
    cosine = [dot(way, normal[:, step]).abs() for step, way in enumerate(ways[:length])]
    field = _field(stage, chains, ways, normal, cosine)
    spread = SPEED_OF_LIGHT / stage.frequency / (4 * math.pi) / distance
    nodes = corners_of(rx, seen, point, normal)
    vertices = torch.stack(nodes, 1) if nodes else torch.zeros(count, 0, 3, dtype=torch.float64)
    rate = _approach(stage, chains.source, chains.target, ways, vertices, chains.faces)
    return (
        distance / SPEED_OF_LIGHT,
        field * spread[:, None, None],
        ways[0],
        -ways[-1],
        vertices,
        stage.frequency / SPEED_OF_LIGHT * rate,
    )


def _field(
    stage: Stage, chains: Chains, ways: list[Tensor], normal: Tensor, cosine: list[Tensor]
) -> Complex128[Tensor, "path 2 2"]:
    """Field over that of the transmitter, V and H at both ends, without the spreading."""
    up = torch.tensor(_UP, dtype=torch.float64)
    before = polarisations(ways[0], up)
    matrix = torch.eye(2, dtype=torch.complex128).expand(len(before), 2, 2)
    every = torch.stack(cosine, 1).ravel() if cosine else torch.zeros(0, dtype=torch.float64)
    met = _coefficients(stage, chains.faces.ravel(), every)
    r_s, r_p, t_s, t_p = (value.view(chains.faces.shape).unbind(1) for value in met)
    for step, passing in enumerate(chains.through.unbind(1)):
        across, into, out = plane_of_incidence(normal[:, step], ways[step])
        through = passing[:, None]
        matrix = _turn(torch.cat([across, into], 1), before) @ matrix
        mirrors = torch.stack([r_s[step], r_p[step]], 1)
        passes = torch.stack([t_s[step], t_p[step]], 1)
        matrix = torch.where(through, passes, mirrors)[..., None] * matrix
        before = torch.cat([across, torch.where(through[..., None], into, out)], 1)
    return _turn(polarisations(-ways[-1], up), before) @ matrix


def _turn(new: Tensor, old: Tensor) -> Tensor:
    """Matrix from components along two unit vectors to those along two others."""
    return dot(new[:, :, None], old[:, None]).to(torch.complex128)


def _coefficients(
    stage: Stage, faces: Int64[Tensor, " n"], cosine: Float64[Tensor, " n"]
) -> FieldCoefficients:
    """What triangles reflect and let through; every material is asked once."""
    items = list(stage.scene.objects.values())
    owner = stage.topology.face_object[faces]
    first = torch.searchsorted(stage.topology.face_object, torch.arange(len(items)))
    kinds: dict[int, int] = {}
    alike = torch.tensor([kinds.setdefault(id(item.material), len(kinds)) for item in items])
    found = [torch.zeros(len(faces), dtype=torch.complex128) for _ in range(4)]
    asked: set[int] = set()
    for number, item in enumerate(items):
        kind = int(alike[number])
        if kind in asked:
            continue
        asked.add(kind)
        rows = torch.nonzero(alike[owner] == kind)[:, 0]
        if not len(rows):
            continue
        triangle = faces[rows] - first[owner[rows]]
        values = item.material.coefficients(stage.frequency, cosine[rows], triangle)
        found = [
            total.index_put((rows,), value.to(torch.complex128))
            for total, value in zip(found, values, strict=True)
        ]
    return FieldCoefficients(*found)
