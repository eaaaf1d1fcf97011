"""LPIPS, the learned perceptual distance of two images (Zhang et al. 2018), and the metric FLIP.

Users provide the weights of LPIPS: state dictionaries that LPIPS and torchvision publish, as torch or safetensors
files. The weights are either one file with a whole ``lpips.LPIPS(net="vgg")``, or a folder with one file of linear
layers and one file of convolutions. The indices of the convolutions tell whether the network is AlexNet or VGG16.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.metrics.image import comparable_images

__all__ = ["Lpips", "flip", "flip_available"]


class _Layer(NamedTuple):
    """A convolution of AlexNet or VGG16, followed by a ReLU."""

    number: int  # index in torchvision's features
    inputs: int
    outputs: int
    side: int
    stride: int
    padding: int
    pool: int  # side of the max pooling before the layer, stride 2; 0 for none
    tap: bool  # whether the distance compares the layer's output


def _vgg16() -> tuple[_Layer, ...]:
    layers, index, inputs = [], 0, 3
    for block, (outputs, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        for i in range(count):
            layers.append(_Layer(index, inputs, outputs, 3, 1, 1, 2 if block and i == 0 else 0, i == count - 1))
            index, inputs = index + 2, outputs
        index += 1  # the max pooling
    return tuple(layers)


_ALEXNET = (
    _Layer(0, 3, 64, 11, 4, 2, 0, True),
    _Layer(3, 64, 192, 5, 1, 2, 3, True),
    _Layer(6, 192, 384, 3, 1, 1, 3, True),
    _Layer(8, 384, 256, 3, 1, 1, 0, True),
    _Layer(10, 256, 256, 3, 1, 1, 0, True),
)
_NETWORKS = {"alex": _ALEXNET, "vgg": _vgg16()}
_LEAST = {"alex": 31, "vgg": 16}  # the smallest image side that leaves a pixel for the last layer

_SHIFT, _SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
_EPS = 1e-10

_CONVOLUTION = re.compile(r"(?:features|net\.slice\d+)\.(\d+)\.(weight|bias)")
_LINEAR = re.compile(r"lins?\.?(\d+)\.model\.\d+\.weight")
_SUFFIXES = (".pth", ".pt", ".safetensors")


@dataclass(frozen=True)
class Lpips:
    """The LPIPS distance (version 0.1) with one set of weights; call it with two (H, W, 3) images."""

    network: str  # "alex" or "vgg"
    weights: tuple[Tensor, ...]  # weights of the convolutions, in order
    biases: tuple[Tensor, ...]  # biases of the convolutions
    linear: tuple[Tensor, ...]  # (C,) weights of the channels of each compared layer

    @property
    def least(self) -> int:
        """Smallest height and width of images that LPIPS accepts, in pixels."""
        return _LEAST[self.network]

    @staticmethod
    def load(path: str | Path) -> Lpips:
        """Return the LPIPS distance with the weights in a file, or in all files of a folder; raises DataError."""
        where = Path(path)
        files = sorted(f for f in where.iterdir() if f.suffix in _SUFFIXES) if where.is_dir() else [where]
        if not files:
            raise DataError(f"{where}: the folder has no weights; expected files that end in {', '.join(_SUFFIXES)}")
        return _lpips_of_weights({key: value for file in files for key, value in _read_weights(file).items()}, where)

    def __call__(self, rendered: Tensor, truth: Tensor) -> float:
        """Return the LPIPS distance of two (H, W, 3) images; values are clamped to 0..1 and mapped to -1..1."""
        return self._distance(*(2.0 * image - 1.0 for image in self._images(rendered, truth)))

    def unmapped(self, rendered: Tensor, truth: Tensor) -> float:
        """Return the LPIPS distance as 3D Gaussian splatting tools compute it: values 0..1 are not mapped to -1..1."""
        return self._distance(*self._images(rendered, truth))

    def _images(self, rendered: Tensor, truth: Tensor) -> list[Tensor]:
        """Return both images as (1, 3, H, W) float32, clamped to 0..1."""
        images = [image.clamp(0.0, 1.0).permute(2, 0, 1)[None].float() for image in comparable_images(rendered, truth)]
        if images[0].shape[1] != 3 or min(images[0].shape[2:]) < self.least:
            raise DataError(
                f"LPIPS: images of shape {tuple(rendered.shape)}; expected at least ({self.least}, {self.least}, 3)"
            )
        return images

    def _distance(self, first: Tensor, second: Tensor) -> float:
        with torch.inference_mode():
            pairs = zip(self._features(first), self._features(second), self.linear, strict=True)
            return sum(float(((a - b).square() * w[None, :, None, None]).sum(1).double().mean()) for a, b, w in pairs)

    def _features(self, image: Tensor) -> Iterable[Tensor]:
        """Yield the output (1, C, h, w) of every layer that LPIPS compares; the channels of each pixel are normalised
        to length 1."""
        x = (image - torch.tensor(_SHIFT)[None, :, None, None]) / torch.tensor(_SCALE)[None, :, None, None]
        for layer, weight, bias in zip(_NETWORKS[self.network], self.weights, self.biases, strict=True):
            if layer.pool:
                x = max_pool2d(x, layer.pool, 2)
            x = conv2d(x, weight, bias, layer.stride, layer.padding).relu()
            if layer.tap:
                yield x / (x.square().sum(1, keepdim=True).sqrt() + _EPS)


def _read_weights(file: Path) -> Mapping[str, Any]:
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(file)
        found = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file fails in torch's pickle, zip and tensor code alike
        reason = " ".join(str(error).split())
        raise DataError(f"{file}: cannot be read as weights ({type(error).__name__}: {reason[:160]})") from error
    if not isinstance(found, Mapping):
        raise DataError(f"{file}: found {type(found).__name__}; expected a state dictionary")
    return found


def _lpips_of_weights(found: Mapping[str, Any], where: Path) -> Lpips:
    parts: dict[tuple[str, int], Tensor] = {}
    for key, value in found.items():
        for pattern in (_CONVOLUTION, _LINEAR):
            match = pattern.fullmatch(key)
            if match and isinstance(value, Tensor):
                parts[match[2] if pattern is _CONVOLUTION else "linear", int(match[1])] = value.detach().float()
    indices = {index for name, index in parts if name == "weight"}
    for network, layers in _NETWORKS.items():
        if indices == {layer.number for layer in layers}:
            return _checked_weights(network, layers, parts, where)
    raise DataError(
        f"{where}: found convolutions {sorted(indices) or 'none'}; expected the layers of AlexNet or VGG16, named "
        f"features.N or net.sliceM.N"
    )


def _checked_weights(
    network: str, layers: tuple[_Layer, ...], parts: Mapping[tuple[str, int], Tensor], where: Path
) -> Lpips:
    def part(name: str, index: int, *shape: int) -> Tensor:
        value = parts.get((name, index))
        if value is None or tuple(value.shape) != shape or not bool(torch.isfinite(value).all()):
            label = f"lin{index}.model.1.weight" if name == "linear" else f"features.{index}.{name}"
            state = "missing" if value is None else f"shape {tuple(value.shape)}, or not finite"
            raise DataError(f"{where}: {label} of LPIPS ({network}): {state}; expected finite numbers of shape {shape}")
        return value

    weights = tuple(part("weight", l.number, l.outputs, l.inputs, l.side, l.side) for l in layers)
    biases = tuple(part("bias", l.number, l.outputs) for l in layers)
    taps = [l for l in layers if l.tap]
    return Lpips(
        network, weights, biases, tuple(part("linear", i, 1, l.outputs, 1, 1).flatten() for i, l in enumerate(taps))
    )


PIXELS_PER_DEGREE = 67.0  # the authors' default: a 0.7 m wide screen of 3840 pixels at 0.7 m


def flip_available() -> bool:
    """Return whether the package ``flip-evaluator`` is installed."""
    return find_spec("flip_evaluator") is not None


def flip(rendered: Tensor, truth: Tensor) -> float:
    """Return the mean LDR-FLIP of two (H, W, 3) sRGB images, clamped to 0..1; from 0 for equal images to 1."""
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise BackendUnavailable(
            f"FLIP needs the package flip-evaluator ({error}); pip install 'neuprim[flip]'"
        ) from error
    first, second = (
        np.ascontiguousarray(x.clamp(0.0, 1.0).numpy(), dtype=np.float32) for x in comparable_images(rendered, truth)
    )
    return float(evaluate(second, first, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})[1])
