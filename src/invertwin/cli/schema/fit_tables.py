"""How maps are compared and how a gradient becomes a step, in run files."""

from typing import Any

import torch
from pydantic import model_validator

from invertwin.channel import Grid, Sampling
from invertwin.errors import InputError
from invertwin.inversion.initialisation.multi_start import pose_grid
from invertwin.inversion.initialisation.starts import nearby, posed
from invertwin.inversion.loss import SpectrumLoss
from invertwin.inversion.optimizer import Optimizer
from invertwin.models.facets import ChainField, ChainMap
from invertwin.models.radar import SurrogateMap
from invertwin.radar.surrogate.surrogate import Surrogate, chosen_surrogate
from invertwin.registry.kinds import Group, Registry, Table
from invertwin.registry.section import fail, key
from invertwin.scene.scene import Object


class SurrogateTable(Table):
    """Kernels of the smooth model; the extra widths anneal to zero, in cells.

    A name may stand for the table: surrogate = "exact", "response", "annealed", "gaussian" or
    "dirichlet", before the first table.
    """

    exact: bool = key("fit exact signals instead; rough surfaces need boundary = false", False)

    @model_validator(mode="before")
    @classmethod
    def _by_name(cls, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        try:
            chosen = chosen_surrogate(data)
        except InputError as error:
            fail(str(error))
        return {"exact": True} if chosen is None else {"exact": False, **vars(chosen)}


class SearchTable(Table):
    """Poses in which an object may begin, beside its start; the best few are fitted."""

    object: str = key("name in the scene")


def register(registry: Registry) -> None:
    """Add losses, optimizers and models beside the surrogate's; others come from plugins."""
    registry.groups["loss"] = Group(default="mse")
    registry.groups["optimizer"] = Group(default="adam")
    registry.groups["model"] = Group()
    registry.groups["search"] = Group(base=SearchTable)
    registry.given |= {Grid, Surrogate, Sampling, Object, torch.Generator}
    registry.add("loss", "mse", SpectrumLoss, without=("floor", "degrees"))
    registry.add("loss", "likelihood", SpectrumLoss, without=("degrees",))
    registry.add("loss", "heavy_tailed", SpectrumLoss)
    registry.add("model", "surrogate", SurrogateMap, without=("_reference",), checked=False)
    registry.add("model", "chains", ChainMap, checked=False)
    registry.add("model", "chain_field", ChainField, checked=False)
    for name, make in (("random", nearby), ("grid", pose_grid), ("given", posed)):
        registry.add("search", name, make)
    for name in ("adam", "sgd", "gauss_newton"):
        registry.add("optimizer", name, Optimizer, without=("module_rates",))
