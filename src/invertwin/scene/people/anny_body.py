"""Body template of the open model Anny: people of all ages and builds."""

import importlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from invertwin.errors import InputError
from invertwin.scene.people.body import BodyTemplate

_STEP = 0.05  # step of a phenotype for its central difference
# Anny's bodies face −y, z up; here they face −x, z up.
_ANNY_TO_BODY_AXES = torch.tensor(
    [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64
)


def load_anny(
    phenotypes: Mapping[str, float] | None = None, coordinates: Sequence[str] = ()
) -> BodyTemplate:
    """Load a body of the model Anny (Apache-2.0), which the optional extra ``anny`` installs.

    The joints are its 104 bones by their names, such as ``upperarm01.L`` and ``lowerarm01.L``; the
    rest pose is Anny's, rotated to face −x, z up. The first use of Anny prepares files for about a
    minute.

    Args:
        phenotypes: values by their names in Anny ("gender", "age", "muscle", "weight", "height",
            "proportions"), from 0 to 1; the default is 0.5.
        coordinates: phenotypes that become shape coordinates, as changes from the given values.
            They follow Anny's own blending to first order.

    Raises:
        InputError: Anny is not installed, or has no such phenotype.
    """
    try:
        anny: Any = importlib.import_module("anny")
    except ImportError:
        raise InputError(
            "expected the package anny, got none; install it with pip install 'invertwin[anny]'"
        ) from None
    model = anny.Anny(skinning_method="lbs").to(dtype=torch.float64)
    values = dict.fromkeys(model.phenotype_labels, 0.5)
    unknown = [name for name in (*(phenotypes or {}), *coordinates) if name not in values]
    if unknown:
        raise InputError(
            f"expected phenotypes among {', '.join(values)}, got {', '.join(unknown)}; "
            "use Anny's names"
        )
    values |= {name: float(value) for name, value in (phenotypes or {}).items()}
    rest, places = _rest(model, values)
    skin, bones = [], []
    for name in coordinates:
        ends = [_rest(model, values | {name: values[name] + s * _STEP}) for s in (1.0, -1.0)]
        (up, heads_up), (down, heads_down) = ends
        skin.append((up - down) / (2 * _STEP))
        bones.append((heads_up - heads_down) / (2 * _STEP))
    share = torch.zeros(len(rest), len(model.bone_labels), dtype=torch.float64)
    share.scatter_add_(1, model.vertex_bone_indices.long(), model.vertex_bone_weights.double())
    return BodyTemplate(
        rest,
        model.get_triangular_faces().long(),
        share,
        (-1, *(int(parent) for parent in model.bone_parents[1:])),
        places,
        torch.stack(skin, dim=-1) if skin else None,
        torch.stack(bones, dim=-1) if bones else None,
        names=tuple(model.bone_labels),
    )


def _rest(model: Any, values: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    """Return skin and joints of the rest pose in this package's axes."""
    given = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
    with torch.no_grad():
        found = model(pose_parameters=None, phenotype_kwargs=given)
    rest, places = (found[name][0].double() for name in ("rest_vertices", "rest_bone_heads"))
    return rest @ _ANNY_TO_BODY_AXES.T, places @ _ANNY_TO_BODY_AXES.T
