"""What a camera sees of a part: coloured, textured triangles, the same ones for every renderer."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from seal_gym.core.errors import SeamError, require
from seal_gym.core.frames import Array, cross

# Index into MATERIALS: what the faces of a part are made of.
PLATE, WALL, TABLE = 0, 1, 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """Look of a face.

    Attributes:
        name: Name of the material in the MuJoCo model.
        rgb: Diffuse albedo, 3 numbers in 0..1.
        texture: Amplitude of the texture (grain and scratches), 0..1.
    """

    name: str
    rgb: tuple[float, float, float]
    texture: float


MATERIALS = (
    Material(name="plate", rgb=(0.62, 0.64, 0.66), texture=0.10),
    Material(name="wall", rgb=(0.40, 0.43, 0.47), texture=0.10),
    Material(name="table", rgb=(0.30, 0.27, 0.24), texture=0.05),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """Triangles in the part's frame.

    Attributes:
        triangles: Corners, counter-clockwise seen from outside, shape (n, 3, 3), m.
        material: Index into ``MATERIALS``, shape (n,).
    """

    triangles: Array
    material: NDArray[np.int32]

    def __post_init__(self) -> None:
        """Checks shapes and values."""
        t = self.triangles
        require(
            t.ndim == 3 and t.shape[1:] == (3, 3) and len(t) > 0,
            f"Surface.triangles has shape {t.shape}: must be (n, 3, 3) with n >= 1",
            SeamError,
        )
        require(bool(np.all(np.isfinite(t))), "Surface.triangles holds a value that is not finite", SeamError)
        require(
            self.material.shape == t.shape[:1],
            f"Surface.material has shape {self.material.shape}: must be ({len(t)},)",
            SeamError,
        )

    @property
    def normals(self) -> Array:
        """Outward unit normals, shape (n, 3); zero for degenerate triangles."""
        t = self.triangles
        n = cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0])
        length = np.linalg.norm(n, axis=-1, keepdims=True)
        return np.asarray(np.divide(n, length, out=np.zeros_like(n), where=length > 0))

    @property
    def uv_m(self) -> Array:
        """Texture coordinates of the corners, shape (n, 3, 2), m.

        Planar mapping along the normal's largest component, so that grain has the same size everywhere.
        """
        axis = np.argmax(np.abs(self.normals), axis=-1)
        kept = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        return np.take_along_axis(self.triangles, kept[:, None, :].repeat(3, axis=1), axis=2)

    @classmethod
    def join(cls, *parts: Self) -> Self:
        """Puts surfaces of one frame together.

        Args:
            *parts: At least one surface.

        Returns:
            All their triangles, in order.
        """
        return cls(
            triangles=np.concatenate([p.triangles for p in parts]),
            material=np.concatenate([p.material for p in parts]),
        )
