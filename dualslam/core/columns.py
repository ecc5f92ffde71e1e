"""Dataclasses whose fields are columns: arrays with a row for each item."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

ColumnsT = TypeVar("ColumnsT", bound="DataclassInstance")


def concatenate(parts: Sequence[ColumnsT]) -> ColumnsT:
    """Return the rows of several such dataclasses of one type (at least one of them), one after the other."""
    names = [field.name for field in fields(parts[0])]
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
