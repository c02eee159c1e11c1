"""Maps of the board: numbers at the points of a grid, linear between them, constant beyond it."""

from __future__ import annotations

from torch import Tensor

from neurosim.base.kernels import kernel


def cells_of(
    x: Tensor, y: Tensor, origin: Tensor, cell: float, shape: tuple[int, int]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return column and row of the cells of points, and the positions in the cells, 0..1.

    Args:
        x, y: of the points, m, board frame.
        origin: [2] of the map's first point, m.
        cell: distance between its points, m.
        shape: number of its rows and columns, at least 2.
    """
    (rows, columns), (left, low) = shape, origin.to(x).unbind()
    across = ((x - left) / cell).clamp(0.0, columns - 1.0)
    up = ((y - low) / cell).clamp(0.0, rows - 1.0)
    i, j = across.long().clamp(max=columns - 2), up.long().clamp(max=rows - 2)
    return i, j, across - i, up - j


@kernel(forceinline=True)
def cell_of(x, y, origin, cell, rows, columns):
    """Return the cell of one point, as :func:`cells_of`."""
    across, up = (x - origin[0]) / cell, (y - origin[1]) / cell
    across, up = min(max(across, 0.0), columns - 1.0), min(max(up, 0.0), rows - 1.0)
    i, j = min(int(across), columns - 2), min(int(up), rows - 2)
    return i, j, across - i, up - j
