"""Losses and optimisers of run files."""

from typing import Any

import torch
from pydantic import model_validator

from invertwin.channel import Grid, Sampling
from invertwin.errors import InputError
from invertwin.inversion.initialisation.multi_start import pose_grid
from invertwin.inversion.initialisation.starts import place_at_poses, sample_nearby_poses
from invertwin.inversion.loss import CorrelationLoss, SpectrumLoss
from invertwin.inversion.optimizer import Optimizer
from invertwin.limits import Count
from invertwin.models import FacetField, FacetMap, SurrogateMap
from invertwin.radar.surrogate.surrogate import Surrogate, resolve_surrogate
from invertwin.registry.kinds import ConstructorTable, KindGroup, Registry
from invertwin.registry.section import raise_key_error
from invertwin.scene.scene import Object


class SurrogateTable(ConstructorTable):
    """Kernels of the smooth model; the additional blur widths anneal to zero, in cells.

    A name may stand for the table: surrogate = "exact", "response", "annealed", "gaussian" or
    "dirichlet", before the first table.

    Attributes:
        exact: fit exact signals instead; rough surfaces need boundary = false
    """

    exact: bool = False

    @model_validator(mode="before")
    @classmethod
    def _accept_name(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        try:
            chosen = resolve_surrogate(data)
        except InputError as error:
            raise_key_error(str(error))
        return {"exact": True} if chosen is None else {"exact": False, **vars(chosen)}


class SearchTable(ConstructorTable):
    """Poses in which an object may begin, beside its start; the best few are fitted.

    Attributes:
        object: name in the scene
        fits: number of best starts that are fitted
        shortlist: fit these in the first stage only; the best of them is fitted in all
    """

    object: str
    fits: Count = 4
    shortlist: bool = False


def register(registry: Registry) -> None:
    """Add losses, optimizers and models beside the surrogate's; others come from plugins."""
    registry.groups["loss"] = KindGroup(default="likelihood")
    registry.groups["optimizer"] = KindGroup(default="adam")
    registry.groups["model"] = KindGroup()
    registry.groups["search"] = KindGroup(base=SearchTable)
    registry.given |= {Grid, Surrogate, Sampling, Object, torch.Generator}
    registry.add("loss", "mse", SpectrumLoss, without=("floor", "degrees"))
    registry.add("loss", "likelihood", SpectrumLoss, without=("degrees",))
    registry.add("loss", "heavy_tailed", SpectrumLoss)
    registry.add("loss", "correlation", CorrelationLoss)
    registry.add("model", "surrogate", SurrogateMap, without=("_reference",), checked=False)
    registry.add("model", "chains", FacetMap, checked=False)
    registry.add("model", "chain_field", FacetField, checked=False)
    registry.add("search", "random", sample_nearby_poses)
    registry.add("search", "grid", pose_grid)
    registry.add("search", "given", place_at_poses)
    for name in ("adam", "sgd", "gauss_newton"):
        registry.add("optimizer", name, Optimizer, without=("module_rates",))
