"""Arrays that grow by rows: the storage under a submap."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class Table:
    """Named numpy columns of one length; rows are appended in bulk and stay where they are.

    Columns are reached by ``table["name"]`` as views of the live rows, writable in place. A view taken before an
    append may be left behind by it: take it anew.

    `**columns` (dtype, shape): type and trailing shape of each column.
    """

    def __init__(self, **columns: tuple[Any, tuple[int, ...]]) -> None:
        self._spec = columns
        self._n = 0
        self._data: dict[str, NDArray[Any]] = {
            name: np.zeros((64, *shape), dtype) for name, (dtype, shape) in columns.items()
        }

    def __len__(self) -> int:
        return self._n

    def __getitem__(self, column: str) -> NDArray[Any]:
        return self._data[column][: self._n]

    def append(self, n: int, **values: Any) -> NDArray[np.int64]:
        """Append `n` rows (columns not given are zero) and return their indices."""
        end = self._n + n
        for name, old in self._data.items():
            if end > len(old):
                new = np.zeros((max(end, 2 * len(old)), *old.shape[1:]), old.dtype)
                new[: self._n] = old[: self._n]
                self._data[name] = new
            if name in values:
                self._data[name][self._n : end] = values[name]
        rows = np.arange(self._n, end)
        self._n = end
        return rows

    def taken(self, rows: NDArray[np.int64]) -> Table:
        """Return a table of some of the rows, in the order given."""
        return Table.from_columns({name: self[name][rows] for name in self._data})

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return copies of all columns: what is needed to make the same table again with `from_columns`."""
        return {name: self[name].copy() for name in self._data}

    def copy(self) -> Table:
        """Return a table of its own that holds the same."""
        twin = Table(**self._spec)
        twin._data, twin._n = self.columns(), self._n
        return twin

    @classmethod
    def from_columns(cls, columns: dict[str, NDArray[Any]]) -> Table:
        """Make a table that holds `columns`."""
        table = cls(**{name: (a.dtype, a.shape[1:]) for name, a in columns.items()})
        n = len(next(iter(columns.values())))
        table.append(n, **columns)
        return table


def landmark_table(descriptor: NDArray[np.generic]) -> Table:
    """Return an empty table of landmarks; `descriptor`: an example row, which gives type and length."""
    return Table(
        xyz_mu=(np.float64, (3,)),
        alive=(np.bool_, ()),
        descriptor=(descriptor.dtype, descriptor.shape),
        normal=(np.float64, (3,)),
        distance_mu=(np.float64, ()),
        scale=(np.float64, ()),
        first_kf=(np.int64, ()),
        replaced_by=(np.int64, ()),
        n_visible=(np.int64, ()),
        n_found=(np.int64, ()),
        condemned=(np.bool_, ()),
    )


def observation_table() -> Table:
    """Return an empty table of observations."""
    return Table(kf=(np.int64, ()), feature=(np.int64, ()), landmark=(np.int64, ()), alive=(np.bool_, ()))
