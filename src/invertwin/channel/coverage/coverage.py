"""Specular power on a surface: at points of it, and what moves where beams end on it.

The mean over an area is that of points spread over it, plus boundary paths: zero in value, with the
derivative that the moving rims of lit regions have (``shadow_edges``).

Source: derivations §10 and §11.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float64, Int64
from torch import Tensor
from torch._C import _DisableFuncTorch
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from invertwin.channel.coverage.shadow_boundaries import (
    ASIDE,
    Screen,
    rim_points,
    rims,
    spread_along,
)
from invertwin.channel.em.plane_waves import cross, dot
from invertwin.channel.rays.backend import tracing
from invertwin.channel.rays.intersections import close_pairs, common_segments
from invertwin.channel.rays.topology import Topology, topology_of
from invertwin.channel.specular.candidates import every_sequence, shot_sequences
from invertwin.channel.specular.image_method import Chains, Walls, chains_between
from invertwin.channel.specular.ray_paths import RayPaths, joined
from invertwin.channel.specular.trace_paths import Stage, paths_of, powers_of, staged
from invertwin.checks import ArrayLike, differentiated, plain
from invertwin.scene.mesh import Mesh
from invertwin.scene.scene import Scene

_AT_ONCE = 1 << 13  # points

#: Takes paths and the places of their transmitters and receivers; returns what each path adds,
#: ``[path, amount]``.
Measure = Callable[[RayPaths, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class Crossing:
    """Boundary paths that end on the surface.

    Attributes:
        tx: Transmitters.
        place: Where on the surface [m].
        face: Triangle of the surface.
        amount: What each adds to the integral over the surface; zero in value.
    """

    tx: Int64[Tensor, " row"]
    place: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    amount: Float64[Tensor, "row amount"]


@dataclass(frozen=True)
class Lit:
    """What specular paths bring to a surface.

    Attributes:
        amount: At the points.
        crossings: Boundary paths.
    """

    amount: Float64[Tensor, "tx point amount"]
    crossings: tuple[Crossing, ...]


@dataclass(frozen=True)
class _Some:
    """Paths to some points: the first point, how many, and chains."""

    begin: int
    count: int
    chains: list[Chains]


def trace_coverage(
    scene: Scene,
    tx: ArrayLike,
    screen: Mesh,
    points: Float64[Tensor, "point 3"],
    frequency: float,
    measure: Measure,
    width: int,
    *,
    depth: int,
    rays: int | None,
    boundary_samples: int,
    seed: int,
) -> Lit:
    """What specular paths bring to points of a surface, and to the rims of lit regions on it.

    Args:
        scene: What is in the way.
        tx: Transmitters [tx, 3] in the world [m].
        screen: The surface, in the world; it hides nothing.
        points: On the surface [m].
        frequency: Of the coefficients [Hz].
        measure: What a path adds.
        width: Numbers that a path adds.
        depth: Most surfaces that a path meets.
        rays: Shot from each transmitter to find sequences of surfaces; None tries every one.
        boundary_samples: Points on edges, for each transmitter; 0 leaves boundary paths out. Only
            derivatives by places use them.
        seed: Of rays and edge points.
    """
    stage = staged(scene, tx, points, frequency, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    with tracing():
        trace = _Trace(stage, screen, measure, width, depth, rays, seed)
        amount = trace.amounts(stage, trace.chains(plain(stage.rx)))
        crossings: list[Crossing] = []
        moved = differentiated(stage.vertices)
        if boundary_samples and (moved or differentiated(stage.tx)):
            crossings += trace.rims(stage, boundary_samples, seed)
            crossings += trace.cuts(stage, boundary_samples, seed) if moved else []
    return Lit(amount, tuple(crossings))


class _Trace:
    """Which paths there are, and what they are worth."""

    def __init__(
        self,
        stage: Stage,
        screen: Mesh,
        measure: Measure,
        width: int,
        depth: int,
        rays: int | None,
        seed: int,
    ) -> None:
        self.measure, self.width, self.depth = measure, width, depth
        self.tx, self.powers = plain(stage.tx), powers_of(stage)
        # Discrete: to `torch.func`, tensors made on the way would be its own.
        with _DisableFuncTorch():
            places = plain(screen.vertices)
            self.walls = Walls(plain(stage.vertices), stage.topology, torch.cat([self.tx, places]))
            self.screen = Screen(places, topology_of([screen]), self.walls.origin)
            meshes = [item.mesh for item in stage.scene.objects.values()]
            self.meshes = [*meshes, screen]
            planes = self.walls.planes
            found: tuple[Tensor, ...] = ()
            if depth and rays is None:
                found = every_sequence(planes, self.powers, depth).steps
            elif depth and rays:
                found = shot_sequences(
                    self.walls, planes, self.powers, self.tx, depth, rays, seed
                ).steps
            self.sequences = tuple(steps for steps in found if len(steps))

    def chains(self, points: Tensor) -> list[_Some]:
        """The paths to points, some of the points at a time."""
        every = (torch.zeros(1, 0, dtype=torch.int64), *self.sequences)
        with _DisableFuncTorch():
            return [
                _Some(
                    begin,
                    len(points),
                    [
                        part
                        for steps in every
                        for number, source in enumerate(self.tx)
                        for part in chains_between(self.walls, steps, source, points, number)
                        if len(part.source)
                    ],
                )
                for begin, points in zip(
                    range(0, len(points), _AT_ONCE), points.split(_AT_ONCE), strict=True
                )
            ]

    def amounts(self, stage: Stage, parts: list[_Some]) -> Float64[Tensor, "tx point amount"]:
        """What paths bring to points; a derivative computes the paths again, and keeps none."""
        again = stage.vertices.requires_grad or stage.tx.requires_grad
        found: list[Tensor] = []
        for some in parts:
            rx = stage.rx[some.begin : some.begin + some.count]
            here = replace(stage, rx=rx, rx_velocity=torch.zeros_like(rx))

            def total(here: Stage = here, some: _Some = some) -> Tensor:
                sums = torch.zeros(len(self.tx) * some.count, self.width, dtype=torch.float64)
                for part in some.chains:
                    paths = joined(paths_of(here, part))
                    sums = sums.index_add(0, paths.link, self.measure(paths, here.tx, here.rx))
                return sums.unflatten(0, (len(self.tx), some.count))

            found.append(checkpoint(total, use_reentrant=False) if again else total())
        return torch.cat(found, 1)

    def rims(self, stage: Stage, samples: int, seed: int) -> list[Crossing]:
        """Boundary paths to rims: what each path would bring, times the rim's rate."""
        with _DisableFuncTorch():
            met = rim_points(
                self.walls, self.screen, self.tx, self.sequences, self.powers,
                depth=self.depth, samples=samples, seed=seed,
            )  # fmt: skip
        crossings: list[Crossing] = []
        for some in met:
            found = rims(self.walls, self.screen.corners, some, stage.tx, stage.vertices)
            here = _fixed(stage, found.place)
            with torch.no_grad():
                paths = joined(paths_of(here, found.chains))
                brought = plain(self.measure(paths, here.tx, here.rx))
            # One path a row, in another order.
            amount = torch.zeros_like(brought).index_copy(0, paths.rx, brought)
            crossings.append(
                Crossing(found.chains.source, found.place, found.face, amount * found.rate[:, None])
            )
        return crossings

    def cuts(self, stage: Stage, samples: int, seed: int) -> list[Crossing]:
        """Boundary paths where the scene cuts the screen: the jump of power, times the rate."""
        with _DisableFuncTorch():
            both = topology_of(self.meshes)
            cuts = cut_points(self.walls, self.screen, both, samples, seed)
            if not len(cuts.face):
                return []
            away = ASIDE * self.walls.margin * cuts.aside
            points = torch.cat([cuts.place + away, cuts.place - away])
        with torch.no_grad():
            here = _fixed(stage, points)
            beside, behind = plain(self.amounts(here, self.chains(points))).chunk(2, 1)
        rate = cut_rates(self.walls, cuts, stage.vertices)
        count = len(self.tx)
        return [
            Crossing(
                torch.arange(count).repeat_interleave(len(rate)),
                cuts.place.repeat(count, 1),
                cuts.on_screen.repeat(count),
                ((behind - beside) * rate[:, None]).flatten(0, 1),
            )
        ]


def _fixed(stage: Stage, points: Tensor) -> Stage:
    """The stage without derivatives of places, with other receivers."""
    return replace(
        stage,
        vertices=plain(stage.vertices),
        velocities=None,
        tx=plain(stage.tx),
        rx=points,
        rx_velocity=torch.zeros_like(points),
    )


@dataclass(frozen=True)
class Cuts:
    """Points on curves where the scene cuts a screen; detached.

    Attributes:
        place: The points [m].
        face: Triangles of the scene.
        on_screen: Triangles of the screen.
        aside: Unit vectors in the screen across the curve, to the side of the normal.
        normal: Of the scene's triangles.
        weight: Length of curve that a point stands for, over n·aside [m].
    """

    place: Float64[Tensor, "row 3"]
    face: Int64[Tensor, " row"]
    on_screen: Int64[Tensor, " row"]
    aside: Float64[Tensor, "row 3"]
    normal: Float64[Tensor, "row 3"]
    weight: Float64[Tensor, " row"]


def cut_points(walls: Walls, screen: Screen, both: Topology, samples: int, seed: int) -> Cuts:
    """Points spread evenly over all curves where the scene cuts a screen.

    Args:
        walls: The scene.
        screen: The screen.
        both: The scene's triangles, and those of the screen after them.
        samples: Points.
        seed: Of the points.
    """
    vertices = walls.exact_vertices + walls.origin
    corners = vertices[walls.topology.faces]
    face, on_screen = close_pairs(corners, screen.corners)
    points = torch.cat([vertices, screen.vertices])
    met = common_segments(points, both, face, on_screen + len(corners))
    span = met.end - met.start
    row, along, weight = spread_along(span.norm(dim=1), samples, seed)
    face, on_screen = met.first[row], met.second[row] - len(corners)
    normal, up = _normals(corners[face]), _normals(screen.corners[on_screen])
    aside = normalize(normal - dot(normal, up)[:, None] * up, dim=1)
    return Cuts(
        met.start[row] + along[:, None] * span[row],
        face,
        on_screen,
        aside,
        normal,
        weight * span[row].norm(dim=1) / dot(normal, aside),
    )


def cut_rates(
    walls: Walls, cuts: Cuts, vertices: Float64[Tensor, "v 3"]
) -> Float64[Tensor, " row"]:
    """Area that the side of the normal loses, of each point's share; zero in value, attached [m²].

    Args:
        walls: The scene.
        cuts: The points.
        vertices: Of the scene in the world, attached [m].
    """
    corners = vertices[walls.topology.faces[cuts.face]]
    a, b, c = plain(corners).unbind(1)
    area = cross(b - a, c - a)
    square = dot(area, area)
    v = dot(cross(b - a, cuts.place - a), area) / square
    u = dot(cross(cuts.place - a, c - a), area) / square
    share = torch.stack([1 - u - v, u, v], 1)
    material = (share[..., None] * corners).sum(1)
    return dot(cuts.normal, material - plain(material)) * cuts.weight


def _normals(corners: Tensor) -> Tensor:
    a, b, c = corners.unbind(1)
    return normalize(cross(b - a, c - a), dim=1)
