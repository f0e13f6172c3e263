"""Fits from many starts: two minima are both found, and told apart only where the data do."""

from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from blobs import BINS, LAW, Blob, Needle, scene
from invertwin.errors import InputError
from invertwin.inversion import Observation, Optimizer, Schedule, pose_grid, sample_nearby_poses
from invertwin.inversion.initialisation.multi_start import Search, search
from invertwin.scene import Object, Pose, Scene, Translation, box
from scenes import float64, thing


@dataclass(frozen=True, eq=False)
class Mirrored(Blob):
    """Shows y and, as bright or somewhat darker, −y: which is which is hard to tell."""

    share: float = 1.0

    def predict(self, scene: Scene, sensor: Any, seed: int) -> Tensor:
        y = scene["ball"].center[1]
        blobs = [torch.exp(-((BINS - s * y) ** 2) / 0.08) for s in (1, -1)]
        power = 0.05 + blobs[0] + self.share * blobs[1]
        return power.expand(self.frames, -1)[..., None, None]


def found(model: Blob, places: list[float], seed: int = 0) -> Search:
    """Fits to a ball at y = 0.8 from starts at some places."""
    look = model.realisations(scene(0.8), None, 0)
    assert look is not None
    starts = [scene(y)["ball"] for y in places]
    return search(
        scene(),
        Observation(model, look(seed, 0.0), sensor=None),
        Translation("ball", axes="y"),
        {"ball": starts},
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(8),
    )


def places_of(search: Search) -> list[float]:
    return [float(end.scene["ball"].center[1].detach()) for end in search.minima]


def test_two_minima_that_look_alike_are_both_listed():
    result = found(Mirrored(), [0.7, -0.7, 0.72, -0.72])
    assert sorted(places_of(result)) == pytest.approx([-0.8, 0.8], abs=0.03)
    assert result.best is result.minima[0]
    assert result.scores[0] is None
    (told,) = result.ambiguities
    assert told.startswith(("ball moved by 1.5", "ball moved by 1.6"))
    assert "fits the data nearly equally well" in told


def test_a_minimum_that_the_data_tell_is_rejected():
    result = found(Mirrored(share=0.4), [-0.7, 0.7])
    assert places_of(result)[0] == pytest.approx(0.8, abs=0.03)
    assert len(result.minima) == 2
    assert result.scores[1] is not None
    assert result.scores[1] > 2.33
    assert result.ambiguities == ()


@pytest.mark.parametrize("seed", range(4))
def test_a_right_competitor_is_not_rejected(seed):
    """Where the other end is the right one by chance of the starts, its rival score is small."""
    result = found(Mirrored(share=0.95), [-0.7, 0.7], seed)
    right = min(range(2), key=lambda k: abs(places_of(result)[k] - 0.8))
    score = result.scores[right]
    assert score is None or score < 2.33


def test_half_turns_are_tried_without_being_asked():
    bar = Scene({"ball": thing(box([0.2, 0.4, 0.1]), (1.0, 0.0, 0.0), (0.0, 0.0, 0.3))})
    vertices = bar["ball"].mesh.vertices * float64([1.0, 1.0, 1.0])
    vertices[vertices[:, 1] > 0] *= 0.5  # so that both ends differ
    bar = bar.replace("ball", mesh=type(bar["ball"].mesh)(vertices, bar["ball"].mesh.faces))
    look = Needle().realisations(bar, None, 0)
    assert look is not None
    result = search(
        bar,
        Observation(Needle(), look(0, 0.0), sensor=None),
        Pose("ball", axes="", rotation_axes="z"),
        {"ball": [bar["ball"]]},
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(5),
    )
    assert len(result.minima) == 2
    (told,) = result.ambiguities
    assert "180.0° about z" in told or "179." in told


def test_a_grid_of_poses_covers_its_box():
    item = scene()["ball"]
    poses = list(pose_grid(item, [0, 0, 1], [1, 0, 2], 0.4, turns=2))
    assert len(poses) == 4 * 1 * 4 * 2
    centers = torch.stack([p.center for p in poses])
    assert centers.amin(0).tolist() == pytest.approx([0, 0, 1])
    assert centers.amax(0).tolist() == pytest.approx([1, 0, 2])
    steps = centers[:, 0].unique().diff()
    assert float(steps.max()) <= 0.4


def test_no_starts_are_refused():
    with pytest.raises(InputError, match="expected at least one start"):
        found(Mirrored(), [])


def test_random_starts_serve_as_well():
    generator = torch.Generator().manual_seed(1)
    starts: list[Object] = list(
        sample_nearby_poses(
            scene(0.8)["ball"], 3, distance=(0.05, 0.1), axes="y", generator=generator
        )
    )
    look = Blob().realisations(scene(0.8), None, 0)
    assert look is not None
    result = search(
        scene(),
        Observation(Blob(), look(0, 0.0), sensor=None),
        Translation("ball", axes="y"),
        {"ball": starts},
        loss=LAW,
        optimizer=Optimizer("gauss_newton", rate=0.1),
        schedule=Schedule(6),
    )
    assert places_of(result) == pytest.approx([0.8], abs=0.03)
