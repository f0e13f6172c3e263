"""Tables with one row for each path, ray, edge or surface point."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Int64, Num
from torch import Tensor

from invertwin.checks import strip_derivatives

Table = TypeVar("Table", bound="Rows")


@dataclass(frozen=True, eq=False)
class Rows:
    """Base of tables: their tensors have one row each, and so do the tables in a table."""

    def select(self: Table, rows: Tensor) -> Table:
        """Select rows.

        Args:
            rows: mask or row numbers.
        """
        columns = {n: v[rows] for n, v in vars(self).items() if isinstance(v, Tensor)}
        tables = {n: v.select(rows) for n, v in vars(self).items() if isinstance(v, Rows)}
        return replace(self, **columns, **tables)


def concatenate_rows(parts: Sequence[Table], **columns: Tensor) -> Table:
    """Concatenate tables; what is not a tensor is taken from the first.

    Args:
        parts: one or more tables.
        columns: columns that are joined otherwise.
    """
    names = [n for n, v in vars(parts[0]).items() if isinstance(v, Tensor) and n not in columns]
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **joined, **columns)


def strip_rows(table: Table) -> Table:
    """Return a table of tensors without derivatives.

    Args:
        table: its tensors may have derivatives of any kind.
    """
    return replace(table, **{name: strip_derivatives(value) for name, value in vars(table).items()})


def bound_groups(
    group: Int64[Tensor, " row"], values: Num[Tensor, "row column"], count: int
) -> tuple[Num[Tensor, "group column"], Num[Tensor, "group column"]]:
    """Compute the smallest and the largest values of each group of rows; zero without rows.

    Args:
        group: number of the group of each row.
        values: numbers of each row.
        count: number of groups.
    """
    rows, zero = group[:, None].expand_as(values), values.new_zeros(count, values.shape[1])
    low = zero.scatter_reduce(0, rows, values, "amin", include_self=False)
    return low, zero.scatter_reduce(0, rows, values, "amax", include_self=False)
