"""The part's surface beside a seam as a grid of columns that sealant fills: the bead's coordinates.

A column stands on the surface at an arc length s and an offset u to the right of travel, and points back
along the nozzle's taught direction. In a fillet the columns' feet make a V, over a groove a notch.
"""

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array, cross

# Columns that would meet before the sealant is this high are taken as parallel there: a hollow bend tighter
# than that is filled by a volume that is too large by the overlap.
_DEEPEST_M = 8e-3
_LEAST_SHARE = 0.05


class Strip(NamedTuple):
    """Columns in the part's frame; S of them along the seam, U across.

    The volume of a column of height h is ``area h + spread h^2``: at bends the columns fan out.

    Attributes:
        arc: Arc length of the rows, evenly spaced, shape (S,), m.
        across: Offset of the columns, evenly spaced, increasing to the right of travel, shape (U,), m.
        base: The columns' feet, shape (S, U, 3), m.
        along: Unit direction of travel, shape (S, 3).
        column: Unit direction of the columns, shape (S, 3).
        area: Of the columns' section at the foot, shape (S, U), m^2; 0 where there is no surface.
        spread: Half the growth of the section with height, shape (S, U), m.
        slant: Cosine between a column and the surface's normal: a layer of height h is h times this thick,
            shape (S, U).
        gap_along: Distance from a foot to the next one along the seam, shape (S, U), m; 0 in the last row.
        gap_across: Distance from a foot to the next one to the right, shape (S, U), m; 0 in the last column.
        up: Unit vector against gravity, shape (3,).
    """

    arc: Array
    across: Array
    base: Array
    along: Array
    column: Array
    area: Array
    spread: Array
    slant: Array
    gap_along: Array
    gap_across: Array
    up: Array

    @classmethod
    def of(
        cls,
        arc: Array,
        across: Array,
        line: tuple[Array, Array, Array],
        height: Array,
        normal: Array,
        up: Array | None = None,
    ) -> Self:
        """Builds the columns over a curve.

        Args:
            arc: Arc length of the rows, evenly spaced and increasing, shape (S,), m.
            across: Offsets, evenly spaced and increasing, shape (U,), m.
            line: The curve's points [m], unit tangents and unit column directions, shape (S, 3) each.
            height: Of the surface over the curve's plane, along the columns, shape (S, U), m; NaN where there
                is no surface.
            normal: Outward unit normals of the surface at the feet, shape (S, U, 3).
            up: Against gravity, shape (3,); z by default.

        Returns:
            The strip.

        Raises:
            SeamError: If shapes do not fit or the spacing is not even.
        """
        rows, columns = len(arc), len(across)
        shapes = (np.shape(height), np.shape(normal), *(np.shape(x) for x in line))
        wanted = ((rows, columns), (rows, columns, 3), *[(rows, 3)] * 3)
        require(
            rows >= 3 and columns >= 3 and shapes == wanted,
            f"height, normal and line have shapes {shapes}: must be {wanted}, at least 3 rows and columns",
            SeamError,
        )
        for name, values in (("arc", arc), ("across", across)):
            steps = np.diff(values)
            require(
                bool(np.all(steps > 0) and np.ptp(steps) < 1e-6 * steps.mean()),
                f"Strip.{name} must increase in even steps; got steps of {steps.min():g}..{steps.max():g} m",
                SeamError,
            )
        point, along, column = (np.ascontiguousarray(x, dtype=np.float64) for x in line)
        side = cross(along, column)
        there = np.isfinite(height)
        foot = np.where(there, height, 0.0)
        base = point[:, None] + across[:, None] * side[:, None] + foot[..., None] * column[:, None]
        # Lengths along the seam grow with the offset and the height as the frame turns: 1 + u x' t + h a' t.
        turn_side, turn_column = (np.sum(np.gradient(v, arc, axis=0) * along, axis=1) for v in (side, column))
        stretch = np.sum(np.gradient(point, arc, axis=0) * along, axis=1)
        length = stretch[:, None] + across * turn_side[:, None] + foot * turn_column[:, None]
        length = np.maximum(length, _LEAST_SHARE)
        cell = (arc[1] - arc[0]) * (across[1] - across[0])
        spread = np.maximum(0.5 * turn_column[:, None], -0.5 * length / (2.0 * _DEEPEST_M))
        slant = np.clip(np.sum(normal * column[:, None], axis=2), _LEAST_SHARE, 1.0)
        gap_along, gap_across = np.zeros_like(foot), np.zeros_like(foot)
        gap_along[:-1] = np.linalg.norm(np.diff(base, axis=0), axis=2)
        gap_across[:, :-1] = np.linalg.norm(np.diff(base, axis=1), axis=2)
        return cls(
            arc=np.ascontiguousarray(arc, dtype=np.float64),
            across=np.ascontiguousarray(across, dtype=np.float64),
            base=np.ascontiguousarray(base),
            along=along,
            column=column,
            area=np.where(there, cell * length, 0.0),
            spread=np.where(there, cell * spread, 0.0),
            slant=np.ascontiguousarray(slant),
            gap_along=gap_along,
            gap_across=gap_across,
            up=np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, dtype=np.float64),
        )

    @property
    def there(self) -> NDArray[np.bool_]:
        """Where there is a surface, shape (S, U)."""
        return np.asarray(self.area > 0.0)

    @property
    def foot(self) -> Array:
        """Height of the feet over the seam along the columns, shape (S, U), m; NaN without a surface."""
        middle = self.base - self.base[:, [len(self.across) // 2]]
        over = np.sum(middle * self.column[:, None], axis=2)
        return np.where(self.there, over, np.nan)

    def volume(self, height: Array) -> Array:
        """Volume of columns.

        Args:
            height: Shape (..., S, U), m.

        Returns:
            Shape (..., S, U), m^3.
        """
        return np.asarray((self.area + self.spread * height) * height)

    def height(self, volume: Array) -> Array:
        """Height of columns: the inverse of ``volume``.

        Args:
            volume: Shape (..., S, U), m^3.

        Returns:
            Shape (..., S, U), m.
        """
        root = np.sqrt(np.maximum(self.area**2 + 4.0 * self.spread * volume, 0.0))
        return np.asarray(np.where(self.there, 2.0 * volume / np.maximum(self.area + root, 1e-30), 0.0))
