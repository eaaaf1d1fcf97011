"""Weights for LPIPS, made up: random numbers in the shapes that are published."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn

VGG = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512, "M")
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}


def features(network: str) -> nn.Sequential:
    """``torchvision.models.NETWORK().features``."""
    if network == "alex":
        a, b, c = nn.Conv2d(3, 64, 11, 4, 2), nn.Conv2d(64, 192, 5, 1, 2), nn.Conv2d(192, 384, 3, 1, 1)
        d, e = nn.Conv2d(384, 256, 3, 1, 1), nn.Conv2d(256, 256, 3, 1, 1)
        pools = [nn.MaxPool2d(3, 2) for _ in range(3)]
        return nn.Sequential(
            a, nn.ReLU(), pools[0], b, nn.ReLU(), pools[1], c, nn.ReLU(), d, nn.ReLU(), e, nn.ReLU(), pools[2]
        )
    layers: list[nn.Module] = []
    inputs = 3
    for word in VGG:
        if isinstance(word, str):
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(inputs, word, 3, 1, 1), nn.ReLU()]
            inputs = word
    return nn.Sequential(*layers)


def weights(network: str) -> dict[str, Tensor]:
    """A state dictionary of random weights, with the keys of torchvision and of the authors' linear layers."""
    torch.manual_seed(3)
    widths = (64, 192, 384, 256, 256) if network == "alex" else (64, 128, 256, 512, 512)
    linear = {f"lin{i}.model.1.weight": torch.rand(1, width, 1, 1) for i, width in enumerate(widths)}
    return {**{f"features.{key}": value for key, value in features(network).state_dict().items()}, **linear}


def written(folder: Path, state: dict[str, Tensor]) -> Path:
    path = folder / "weights.pth"
    torch.save(state, path)
    return path
