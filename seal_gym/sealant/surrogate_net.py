"""The surrogate's layers in torch: linear glass box and MLP-CNN (paper B 3.2.4)."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from seal_gym.core.frames import Array
from seal_gym.sealant.laydown.sections import COLUMNS, PIXEL_M, RAYS, ROWS
from seal_gym.sealant.surrogate import KINEMATIC, PLANES_M, Features, SurrogateCfg

_SEED_ROWS, _SEED_COLUMNS = ROWS // 4, COLUMNS // 4  # what the merged features are unflattened to
_BATCH = 64
_SQUEEZE = 4


class SqueezeExcitation(nn.Module):
    """Weights each channel by a number in (0, 1) that all channels' means decide (Hu et al. 2018)."""

    def __init__(self, channels: int) -> None:
        """Builds the layers.

        Args:
            channels: Of the images.
        """
        super().__init__()
        narrow = max(channels // _SQUEEZE, 2)
        self.gate = nn.Sequential(
            nn.Linear(channels, narrow), nn.ReLU(), nn.Linear(narrow, channels), nn.Sigmoid()
        )

    def forward(self, images: Tensor) -> Tensor:
        """The weighted images.

        Args:
            images: Shape (n, c, h, w).

        Returns:
            Shape (n, c, h, w).
        """
        weights: Tensor = self.gate(images.mean((2, 3)))
        return images * weights[:, :, None, None]


class Residual(nn.Module):
    """Two convolutions and a way around them, 1 x 1 if the channels differ (He et al. 2016)."""

    def __init__(self, before: int, after: int) -> None:
        """Builds the layers.

        Args:
            before: Channels of the input.
            after: Channels of the output.
        """
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(before, after, 3, padding=1, bias=False),
            nn.BatchNorm2d(after),
            nn.LeakyReLU(),
            nn.Conv2d(after, after, 3, padding=1, bias=False),
            nn.BatchNorm2d(after),
        )
        self.skip = nn.Identity() if before == after else nn.Conv2d(before, after, 1, bias=False)
        self.end = nn.LeakyReLU()

    def forward(self, images: Tensor) -> Tensor:
        """The changed images.

        Args:
            images: Shape (n, before, h, w).

        Returns:
            Shape (n, after, h, w).
        """
        out: Tensor = self.end(self.body(images) + self.skip(images))
        return out


def mlp(before: int, width: int, after: int) -> nn.Sequential:
    """Two fully connected layers, each with batch norm and leaky ReLU.

    Args:
        before: Inputs.
        width: Between.
        after: Outputs.

    Returns:
        The layers.
    """
    layers: list[nn.Module] = []
    for one, two in ((before, width), (width, after)):
        layers += [nn.Linear(one, two), nn.BatchNorm1d(two), nn.LeakyReLU()]
    return nn.Sequential(*layers)


class SectionNet(nn.Module):
    """From features to sections. Inputs are normalised with the training data's mean and deviation."""

    kinematic_mean: Tensor
    kinematic_scale: Tensor
    spatial_mean: Tensor
    spatial_scale: Tensor

    def __init__(self, cfg: SurrogateCfg) -> None:
        """Builds the layers, with torch's global generator.

        Args:
            cfg: Kind and widths.
        """
        super().__init__()
        self.cfg = cfg
        places = cfg.neighbours + 1
        kinematic, spatial = KINEMATIC * places + cfg.neighbours, RAYS * places
        for name, size in (("kinematic", kinematic), ("spatial", spatial)):
            self.register_buffer(f"{name}_mean", torch.zeros(size))
            self.register_buffer(f"{name}_scale", torch.ones(size))
        if cfg.kind == "linear":
            self.glass = nn.Linear(kinematic + spatial, ROWS * COLUMNS)
            return
        wide, c = cfg.hidden, cfg.channels
        self.of_motion = mlp(kinematic, wide, wide // 2)
        self.of_surface = mlp(spatial, wide, wide)
        self.merge = mlp(wide // 2 + wide, 2 * wide, c * _SEED_ROWS * _SEED_COLUMNS)
        seen = c + (1 + len(PLANES_M) if cfg.on_fan else 0)
        self.coarse, self.middle, self.fine = (
            nn.Sequential(Residual(seen, c), SqueezeExcitation(c)) for _ in range(3)
        )
        self.last = nn.Conv2d(c, 1, 3, padding=1)
        if cfg.on_fan:  # begins as the fast tier
            self.last.load_state_dict({k: torch.zeros_like(v) for k, v in self.last.state_dict().items()})
        self.larger = nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False)

    def normalise(self, inputs: Features) -> None:
        """Takes the mean and deviation of the training data; what does not vary is only shifted.

        Args:
            inputs: The training data.
        """
        for name in ("kinematic", "spatial"):
            values = getattr(inputs, name)
            deviation = values.std(0)
            scale = np.where(deviation > 1e-6, deviation, 1.0)
            getattr(self, f"{name}_mean").copy_(torch.from_numpy(values.mean(0)))
            getattr(self, f"{name}_scale").copy_(torch.from_numpy(scale))

    def forward(self, kinematic: Tensor, spatial: Tensor, surface: Tensor, laid: Tensor) -> Tensor:
        """Sections, not clipped.

        Args:
            kinematic: See ``Features``, shape (n, k).
            spatial: Shape (n, s).
            surface: Shape (n, 40) [m].
            laid: Shape (n, 5, 40) [m].

        Returns:
            Shape (n, 20, 40). On the fast tier, nothing is where the substrate is.
        """
        ground = _filled(surface[:, None])
        around = _filled(surface[:, None] + laid) - ground
        fan, free = around[:, len(PLANES_M) // 2], 1.0 - ground[:, 0]
        moving = (kinematic - self.kinematic_mean) / self.kinematic_scale
        below = (spatial - self.spatial_mean) / self.spatial_scale
        if self.cfg.kind == "linear":
            plain: Tensor = self.glass(torch.cat((moving, below), 1)).view(-1, ROWS, COLUMNS)
            whole: Tensor = free * (fan + plain)
            return whole if self.cfg.on_fan else plain
        merged = self.merge(torch.cat((self.of_motion(moving), self.of_surface(below)), 1))
        image = merged.view(-1, self.cfg.channels, _SEED_ROWS, _SEED_COLUMNS)
        image = self.larger(self.coarse(self._beside(image, around, ground)))
        image = self.larger(self.middle(self._beside(image, around, ground)))
        last: Tensor = self.last(self.fine(self._beside(image, around, ground)))[:, 0]
        corrected: Tensor = free * (fan + last)
        return corrected if self.cfg.on_fan else last

    def _beside(self, image: Tensor, around: Tensor, ground: Tensor) -> Tensor:
        """On the fast tier, what it lays and the substrate join the channels, in the image's resolution."""
        if not self.cfg.on_fan:
            return image
        known = torch.cat((around, ground), 1)
        pooled = nn.functional.avg_pool2d(known, known.shape[-1] // image.shape[-1])
        return torch.cat((image, pooled), 1)

    def run(self, inputs: Features) -> Array:
        """Sections of features, on one thread.

        Args:
            inputs: Of the configuration's ``neighbours``.

        Returns:
            Shape (n, 20, 40), not clipped.
        """
        self.eval()
        with torch.inference_mode(), _one_thread():
            parts = [
                self(*tensors(inputs.rows(slice(k, k + _BATCH)))).numpy()
                for k in range(0, len(inputs), _BATCH)
            ]
        return np.concatenate(parts).astype(float)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The weights.

        Returns:
            Copies by name.
        """
        return {k: v.detach().numpy().copy() for k, v in self.state_dict().items()}

    def take(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Sets the weights.

        Args:
            arrays: From ``arrays``.

        Raises:
            RuntimeError: If names or shapes differ.
            ValueError: If a value is not finite.
        """
        if not all(bool(np.isfinite(a).all()) for a in arrays.values()):
            raise ValueError("a weight is not finite")
        self.load_state_dict({k: torch.from_numpy(v.copy()) for k, v in arrays.items()})


def tensors(inputs: Features) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Features as the network takes them.

    Args:
        inputs: Of n sections.

    Returns:
        Kinematic, spatial, surface, laid, of single precision.
    """
    one, two, three, four = (
        torch.from_numpy(np.ascontiguousarray(v, dtype=np.float32))
        for v in (inputs.kinematic, inputs.spatial, inputs.surface, inputs.laid)
    )
    return one, two, three, four


def _filled(tops_m: Tensor) -> Tensor:
    """``fan_section.filled`` for tops (n, m, 40): shares (n, m, 20, 40)."""
    lower = torch.arange(ROWS, dtype=tops_m.dtype)[:, None]
    return (tops_m[:, :, None] / PIXEL_M - lower).clamp(0.0, 1.0)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Keeps torch from waking its threads for so little."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
