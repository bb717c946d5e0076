"""Minima and convexity of a cost on a grid whose columns are periodic."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage


@dataclass(frozen=True)
class Shape:
    """Shape of a cost on a grid of sizes (rows) and phases (columns, periodic)."""

    lowest: tuple[int, int]
    """Row and column of the lowest value."""
    minima: int
    """Number of local minima: cells that are lower than all of their eight neighbours."""
    basin: float
    """Share of the cells from which the steepest descent ends at the lowest one."""
    convex: NDArray[np.bool_]
    """Cells around the lowest one, connected with it, in which the Hessian is positive definite."""

    def half_width(self, axis: int) -> float:
        """Return half the width of the convex domain through the lowest cell, along an axis [cells]."""
        row, column = self.lowest
        if axis == 0:
            line = self.convex[:, column]
            place = row
        else:
            # Columns are periodic: the lowest cell is moved to the middle.
            line = self.convex[row]
            place = len(line) // 2
            line = np.roll(line, place - column)
        if not line[place]:
            return 0.0
        label, _ = ndimage.label(line)
        return 0.5 * np.count_nonzero(label == label[place])


def shape_of(cost: NDArray[np.float64]) -> Shape:
    """Return the shape of a cost, shape (sizes, phases). The lowest cell is the cell of the lowest inner row.

    The Hessian is made of second differences in steps of the grid; convexity does not depend on the steps' lengths.
    """
    near = _neighbours(cost)
    lowest_neighbour = np.min(list(near.values()), axis=0)
    inner = np.zeros(cost.shape, np.bool_)
    inner[1:-1] = True
    is_minimum = inner & (cost < lowest_neighbour)
    index_of_lowest = int(np.argmin(np.where(inner, cost, np.inf)))
    row, column = divmod(index_of_lowest, cost.shape[1])

    # Where the Hessian is positive definite
    with np.errstate(invalid="ignore"):
        along = near[1, 0] - 2.0 * cost + near[-1, 0]
        across = near[0, 1] - 2.0 * cost + near[0, -1]
        mixed = (near[1, 1] - near[1, -1] - near[-1, 1] + near[-1, -1]) / 4.0
        positive = inner & (along > 0.0) & (along * across > mixed**2)
    label = _periodic_label(positive)
    convex = positive & (label == label[row, column])

    ends_at_lowest = _ends_of_descent(cost, near) == index_of_lowest
    return Shape(
        lowest=(row, column),
        minima=int(is_minimum.sum()),
        basin=float(np.mean(ends_at_lowest)),
        convex=convex,
    )


def _neighbours(cost: NDArray[np.float64]) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return the costs of the eight neighbours of all cells, by the steps (row, column) to them; inf outside."""
    rows, columns = cost.shape
    wrapped = np.pad(cost, ((0, 0), (1, 1)), mode="wrap")
    around = np.pad(wrapped, ((1, 1), (0, 0)), constant_values=np.inf)
    near = {}
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            if (down, right) != (0, 0):
                top = 1 + down
                left = 1 + right
                near[down, right] = around[top : top + rows, left : left + columns]
    return near


def _ends_of_descent(
    cost: NDArray[np.float64], near: dict[tuple[int, int], NDArray[np.float64]]
) -> NDArray[np.intp]:
    """Return the index of the cell in which the steepest descent from each cell ends, shape (cells,)."""
    rows, columns = cost.shape
    index = np.arange(cost.size).reshape(cost.shape)
    row, column = np.divmod(index, columns)

    # The next cell of the descent: the lowest neighbour, or the cell itself if all are higher
    stacked = np.stack(list(near.values()))
    steps = np.array(list(near))[stacked.argmin(axis=0)]
    next_row = np.clip(row + steps[..., 0], 0, rows - 1)
    next_column = (column + steps[..., 1]) % columns
    goes_on = stacked.min(axis=0) < cost
    following = np.where(goes_on, next_row * columns + next_column, index)

    # Each repetition doubles the number of steps.
    end = following.ravel()
    for _ in range(math.ceil(math.log2(cost.size))):
        end = end[end]
    return end


def _periodic_label(mask: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return the number of the connected region of each cell, in which columns are periodic."""
    label, _ = ndimage.label(mask)
    for low, high in zip(label[:, 0], label[:, -1], strict=True):
        if low and high:
            label[label == high] = low
    return np.asarray(label, np.int32)
