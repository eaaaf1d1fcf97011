"""Evaluate models of moving scenes: masks, films, image layers, and the extinction against that of the source files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.layers import LayerFrame, LayerSpec
from neuprim.core.model.edge import NORMS, profile
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives

if TYPE_CHECKING:
    from neuprim.tasks.dynamic.volume.dataset import Recording


_MIN_OPACITY = 1.0 / 255.0  # of a visible primitive


def recording_of(dataset: Dataset) -> Recording | None:
    """The volume sequence that the images were rendered from; None if there is none.

    Raises:
        DatasetFault: the dataset's ``extra`` is something else.
    """
    if dataset.extra is None:
        return None
    from neuprim.tasks.dynamic.volume.dataset import Recording

    return get_extra(dataset, Recording)


def mask(dataset: Dataset, index: int) -> Tensor | None:
    """Pixels that show matter in some frame of the view's camera."""
    recording = recording_of(dataset)
    return None if recording is None else recording.matter_mask(index)


def clips(dataset: Dataset) -> Sequence[Clip]:
    """One film of all frames per test camera."""
    recording = recording_of(dataset)
    if recording is None:
        return ()
    frames = len(recording.capture.frames)
    return [
        Clip(f"cam_{c:02d}", range(i * frames, (i + 1) * frames), 24.0) for i, c in enumerate(recording.test.cameras)
    ]


def diagnose(dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """Compare the model's extinction and size with those of the files."""
    recording = recording_of(dataset)
    if recording is None:
        return {}
    from neuprim.tasks.dynamic.volume.ground_truth import compare_extinction

    capture, times = recording.capture, recording.test.times
    return {
        "exposure": dataset.exposure,
        "vdb_bytes": sum(frame.path.stat().st_size for frame in capture.frames),
        "normalisation": capture.normalisation.to_json(),
        "invisible_fraction": invisible_fraction(model, times),
        **compare_extinction(model, capture, [float(t) for t in times]),
    }


def invisible_fraction(model: Primitives, times: Sequence[Tensor]) -> float:
    """Share of primitives whose opacity along each of their axes stays below 1/255 at all of these times.

    The chord along axis j through the centre has half length s_j, so that I = (N_p s_j/m) (b2 + sum_k w2_k cos(omega0
    b1_k) B_p(omega0 W1_k . r_j s_j/m)) with r_j the axis' direction (:mod:`neuprim.core.model.edge`).
    """
    most_opaque = torch.zeros(model.count, dtype=torch.float64)
    density, params = model.density, {k: v.detach() for k, v in model.of(model.density).items()}
    geometry = Geometry(*(model.params[n].detach() for n in ("means", "log_scales", "quats")))
    reach = geometry.scales.double() / geometry.length_scale.double()[:, None]
    axes = geometry.rotations.double() * reach[:, None, :]  # (N, 3, 3), columns r_j s_j/m
    for time in times:
        form = density.lower(params, geometry, {"time": time})
        assert isinstance(form, Cosine)
        rate = form.omega0 * (form.W1.double() @ axes)  # (N, K, 3)
        waves = (form.w2.double() * torch.cos(form.omega0 * form.b1.double()))[:, :, None] * profile(rate, form.edge)
        depth = NORMS[form.edge] * reach * (form.b2.double().reshape(-1, 1) + waves.sum(1))
        most_opaque = torch.maximum(most_opaque, 1.0 - torch.exp(-depth.clamp_min(0.0).amax(1)))
    return float((most_opaque < _MIN_OPACITY).double().mean())


# ---------------------------------------------------------------- layers


def emission(frame: LayerFrame) -> Tensor | None:
    """(H, W, C) integral of sigma c, linear light."""
    return frame.emitted


def absorption(frame: LayerFrame) -> Tensor | None:
    """(H, W, C) integral of sigma L: emitted light that is absorbed before it arrives."""
    return None if frame.emitted is None else frame.emitted - frame.drawn.rgb


# The two terms of the equation of transfer, dL/ds = sigma c - sigma L (Max, "Optical models for direct volume
# rendering", 1995); the image over black is emission - absorption.
LAYERS = (
    LayerSpec(
        "emission",
        "all light that is emitted along the ray, as if nothing absorbed any: the integral of sigma c, linear light",
        emission,
    ),
    LayerSpec(
        "absorption",
        "the part of the emission that is absorbed before it arrives, linear light: beauty = emission - absorption",
        absorption,
    ),
)
