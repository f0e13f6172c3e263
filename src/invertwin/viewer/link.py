"""Link of a scene and its map: maps of moved scenes, and points that contribute to a bin."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from invertwin.channel import Grid, Sampling, trace_power
from invertwin.deprecation import rename_members
from invertwin.errors import InputError
from invertwin.models.radar import SurrogateMap
from invertwin.radar import Radar
from invertwin.runtime.concurrency import torch_threads
from invertwin.scene import Mesh, Scene, compose
from invertwin.scene.shape_models.density import replace_clouds
from invertwin.viewer.display import DisplayMesh

_SAMPLES = 20_000  # rays of a map: quick, and smooth enough for the eye
_PATHS = 4_000  # rays of which single paths are shown
_EDGES = 600  # samples of silhouettes that are shown
_SEED = 0


@dataclass(frozen=True, eq=False)
class PositionSample:
    """Predicted map and paths of one position.

    Attributes:
        position: position of the radar [3], m.
        points: Where the paths meet surfaces first and last [m].
        power: Of each path, received over transmitted.
        bins: Range and u of each path, in bins.
        edges: Points of silhouettes, where what is seen jumps [m].
    """

    position: Float[Tensor, "3"]
    points: Float[Tensor, "path 2 3"]
    power: Float[Tensor, " path"]
    bins: Float[Tensor, "path 2"]
    edges: Float[Tensor, "edge 3"]

    def points_in_bin(self, range_bin: float, u_bin: float) -> Float[Tensor, "point 3"]:
        """Points whose echoes fall into a bin, or into its neighbours.

        Args:
            range_bin: Number of the range.
            u_bin: Number of the direction.
        """
        away = (self.bins - torch.tensor([range_bin, u_bin])).abs()
        return self.points[(away <= 1.0).all(dim=1)][:, 1]


class InteractiveSensor:
    """The forward model of one radar, for maps that follow what a person moves.

    Args:
        scene: With its materials, where nothing has been moved.
        radar: All positions.
        grid: Bins of the map.
        depth: Most bounces.

    Attributes:
        frames, ranges, across: As of ``DisplayMaps``.
    """

    def __init__(self, scene: Scene, radar: Radar, grid: Grid, depth: int = 1) -> None:
        self.scene = self._begun = replace_clouds(scene)
        self.radar, self.grid = radar, grid
        self.frames, self.ranges = list(range(radar.frame_count)), grid.ranges.tolist()
        self.across: list[float] = grid.u.tolist()
        sampling = Sampling(depth=depth, samples=_SAMPLES, boundary=False)
        self._model = SurrogateMap(grid, sampling=sampling)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of what can be moved."""
        return self.scene.names

    def replace_meshes(self, meshes: Mapping[str, DisplayMesh]) -> None:
        """Put other surfaces in place of those of some objects.

        Args:
            meshes: By the name of the object.

        Raises:
            InputError: Other triangles than a material with values for each can have.
        """
        scene = self._begun
        for name, body in meshes.items():
            mesh = Mesh(torch.tensor(body.vertices).double(), torch.tensor(body.faces).long())
            scene = scene.replace(name, mesh=mesh, pose=None)
        self.scene = scene

    def move_object(self, name: str, motion: Float[Tensor, "4 4"]) -> Scene:
        """The scene with one object moved rigidly.

        Args:
            name: Of the object.
            motion: World to world.
        """
        return self.scene.replace(name, pose=compose(self.scene[name].transform, motion))

    def predict_map(self, scene: Scene, frame: int) -> Float[Tensor, "range u"]:
        """The power that one position would show, the strongest over v.

        Args:
            scene: What is seen.
            frame: Number of the position.
        """
        with torch.no_grad(), torch_threads(1):  # small work, which more threads slow
            return self._model.predict(scene, self.radar.frames([frame]), _SEED)[0].amax(2)

    def sample_paths(self, scene: Scene, frame: int) -> PositionSample:
        """Single paths of one bounce, and points of silhouettes.

        Args:
            scene: What is seen.
            frame: Number of the position.
        """
        link = self.radar.frames([frame]).link()
        sampling = Sampling(
            depth=1, samples=_PATHS, boundary_samples=_EDGES, contacts=False, boundary=True
        )
        with torch.no_grad(), torch_threads(1):  # small work, which more threads slow
            try:
                paths = trace_power(scene, link, sampling=sampling, seed=_SEED)
            except InputError:  # silhouettes of sheets have no explicit paths
                sampling = replace(sampling, boundary=False)
                paths = trace_power(scene, link, sampling=sampling, seed=_SEED)
        place = self.radar.positions[frame].detach()
        rotation, grid = self.radar.link().rotations[frame].detach(), self.grid
        edges = paths.last[paths.boundary]
        paths = paths.select(~paths.boundary)
        toward = torch.nn.functional.normalize(paths.last - place, dim=1) @ rotation
        rows = (paths.range - float(self.radar.origins[frame]) - grid.range_start) / grid.range_step
        columns = (toward[:, 1] - grid.u_start) / grid.u_step * (grid.u_count > 1)
        points, bins = torch.stack([paths.first, paths.last], 1), torch.stack([rows, columns], 1)
        return PositionSample(place, points, paths.power, bins, edges)


rename_members(PositionSample, feeding="points_in_bin", place="position")
