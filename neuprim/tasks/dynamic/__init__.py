"""The task ``dynamic``: fit smoke and fire to OpenVDB sequences, or moving scenes to images with a time each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.errors import ConfigError
from neuprim.core.light_conditions import LIGHT_CONDITIONS, summarize_lights, typical_light
from neuprim.core.model.cosine import DENSITY_OPTIONS, DENSITY_TRADE
from neuprim.core.model.edge import NORMS, edge_profile
from neuprim.core.model.fields import (
    ColourField,
    ConditionSpec,
    Cosine,
    DensityField,
)
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.layer_frame import LayerFrame, LayerSpec
from neuprim.core.render.light import LIGHT_LAYERS
from neuprim.core.task import API_VERSION, SceneSpec, TaskSpec, lazy_function
from neuprim.core.train.losses import photometric
from neuprim.core.validation import validate_choices
from neuprim.tasks.dynamic.colour import FREQUENCIES, TimeHarmonics
from neuprim.tasks.dynamic.scattering import ScatteringHarmonics, light_smoke_by_environment
from neuprim.tasks.dynamic.time_density import TimeDensity

if TYPE_CHECKING:
    from neuprim.tasks.dynamic.volume.capture_dataset import VolumeRecording

_MIN_OPACITY = 1.0 / 255.0  # of a visible primitive


def _check_dynamic_model(model: Mapping[str, Any]) -> None:
    validate_choices(model["density"], "model.density", {"time": str, **DENSITY_OPTIONS})
    validate_choices(model["colour"], "model.colour", {"frequencies": tuple(FREQUENCIES), "powers": int, "waves": int})
    try:
        TimeDensity(model["neurons"], **model["density"])
    except ValueError as error:
        raise ConfigError(f"model.density.time: {error}") from error
    try:
        TimeHarmonics(model["sh_degree"], **model["colour"])
    except ValueError as error:
        raise ConfigError(f"model.colour: {error}") from error


def _tunable_time_settings(model: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    return {
        **DENSITY_TRADE,
        "model.density.time": ("none", "phase", "window", "window+motion", "phase+window+motion"),
        "model.sh_degree": (0, 1, 2, 3),
        "model.colour.powers": (0, 2, 4),
        "model.colour.waves": (0, 2, 4),
    }


def _build_time_fields(model: Mapping[str, Any], dataset: Dataset) -> tuple[DensityField, ColourField]:
    grids: dict[str, Any] = {}
    if dataset.points is not None:
        grids["components"] = dataset.points.components
        grids["channels"] = [(name, *own) for name, own in dataset.points.channels.items()]
    density = TimeDensity(model["neurons"], **model["density"], **grids)
    settings = (model["sh_degree"], dataset.channels, model["sh_every"])
    if "light" in dataset.train.view(0).conditions:
        if dataset.channels != 3:
            found = f"{dataset.name}: images have {dataset.channels} colour channels"
            raise ConfigError(f"{found}; task dynamic needs 3 channels if views have a light, because lights are RGB")
        more: dict[str, Any] = {**model["colour"], "typical": typical_light(dataset, False)}
        recording = vdb_recording_of(dataset)
        if recording is not None:
            optics = recording.capture.optics
            more |= {"octaves": optics.octaves, "share": optics.octave_share, "anisotropy": optics.anisotropy}
        return density, ScatteringHarmonics(*settings, **more)
    return density, TimeHarmonics(*settings, **model["colour"])


def _dataset_facts(dataset: Dataset) -> Mapping[str, Any]:
    recording = vdb_recording_of(dataset)
    frames: dict[str, Any] = {"exposure": dataset.exposure}
    if recording is not None:
        frames["frames"] = list(recording.capture.clock)
    lights = [dataset.train.view(i).conditions.get("light") for i in range(len(dataset.train))]
    known = [light for light in lights if light is not None]
    if not known:
        return frames
    return {**frames, "lights": summarize_lights(torch.stack(known), dataset.center, "irradiance", dataset.exposure)}


def _has_lights(scene: Mapping[str, Any]) -> bool:
    return scene.get("lights", 1) > 1


def parse_dynamic_time(text: str) -> list[Tensor]:
    """Parse the text after ``--time`` as a time 0..1; raise ConfigError for other text."""
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not 0.0 <= time <= 1.0:
        raise ConfigError(
            f"--time {text}: expected a time from 0 to 1, or FIRST:LAST or FIRST:LAST:COUNT, such as 0:1:100"
        )
    return [torch.tensor(time)]


# ---------------------------------------------------------------- evaluation


def vdb_recording_of(dataset: Dataset) -> VolumeRecording | None:
    """Return the volume sequence from which a dataset's images were rendered; None for other datasets.

    Raises:
        DatasetError: the dataset's ``extra`` is something else.
    """
    if dataset.extra is None:
        return None
    from neuprim.tasks.dynamic.volume.capture_dataset import VolumeRecording

    return get_extra(dataset, VolumeRecording)


def matter_mask(dataset: Dataset, index: int) -> Tensor | None:
    """Return (H, W) bool: pixels that smoke or fire covers in at least one frame of a test view's camera.

    The result is None for datasets without a volume sequence, and if training views are held out instead of the
    sequence's own test cameras.
    """
    recording = vdb_recording_of(dataset)
    return None if recording is None or dataset.test is not recording.test else recording.matter_mask(index)


def held_out_clips(dataset: Dataset) -> Sequence[Clip]:
    """Return one video clip of all frames per test camera; no clips where :func:`matter_mask` has no masks."""
    recording = vdb_recording_of(dataset)
    if recording is None or dataset.test is not recording.test:
        return ()
    n = len(recording.capture.frames)
    return [Clip(f"cam_{c:02d}", range(i * n, (i + 1) * n), 24.0) for i, c in enumerate(recording.test.cameras)]


def compare_with_vdb_recording(dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """Return errors of a model's extinction against the dataset's .vdb files, and facts about model and files.

    The result is empty for datasets without .vdb files.
    """
    recording = vdb_recording_of(dataset)
    if recording is None:
        return {}
    from neuprim.tasks.dynamic.volume.capture_density import compare_capture_extinction

    capture, times = recording.capture, recording.test.times
    return {
        "exposure": dataset.exposure,
        "vdb_bytes": sum(frame.path.stat().st_size for frame in capture.frames),
        "normalisation": vars(capture.normalisation),
        "invisible_fraction": invisible_fraction_over_time(model, times),
        **compare_capture_extinction(model, capture, [float(t) for t in times]),
    }


def invisible_fraction_over_time(model: Primitives, times: Sequence[Tensor]) -> float:
    """Return the fraction of primitives that are invisible: opacity below 1/255 along all three axes at all ``times``.

    Along axis j, with direction r_j and semi-axis s_j, the optical depth of the chord through the centre is I = (N_p
    s_j/m) (b2 + sum_k w2_k cos(omega0 b1_k) B_p(omega0 W1_k . r_j s_j/m)). W1, b1, w2 and b2 are the primitive's
    parameters at the time; omega0 is a constant frequency; m is the largest semi-axis. p is the exponent of the edge
    (how density fades at the ellipsoid's boundary). :mod:`neuprim.core.model.edge` defines N_p and B_p.
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
        waves = (form.w2.double() * torch.cos(form.omega0 * form.b1.double()))[:, :, None] * edge_profile(
            rate, form.edge
        )
        depth = NORMS[form.edge] * reach * (form.b2.double().reshape(-1, 1) + waves.sum(1))
        most_opaque = torch.maximum(most_opaque, 1.0 - torch.exp(-depth.clamp_min(0.0).amax(1)))
    return float((most_opaque < _MIN_OPACITY).double().mean())


def _draw_fire_emission(frame: LayerFrame) -> Tensor | None:
    return frame.emitted


def _draw_smoke_absorption(frame: LayerFrame) -> Tensor | None:
    return None if frame.emitted is None else frame.emitted - frame.drawn.rgb


# The two terms of the equation of transfer, dL/ds = sigma c - sigma L (Max, "Optical models for direct volume
# rendering", 1995); the image over black is emission - absorption.
_LAYERS = (
    LayerSpec(
        "emission",
        "all light that is emitted along the ray, as if nothing absorbed any: the integral of sigma c, linear light",
        _draw_fire_emission,
    ),
    LayerSpec(
        "absorption",
        "the part of the emission that is absorbed before it arrives, linear light: beauty = emission - absorption",
        _draw_smoke_absorption,
    ),
)

# ---------------------------------------------------------------- the task


_VOLUME_SCENES = {
    "smoke_fire": "fire under dark smoke, 100 timesteps; simulated, or scene.vdb=DIR",
    "colorful_smoke": "coloured smoke, 128 timesteps; simulated, or scene.vdb=DIR",
    "ground_explosion": "a blast and its cloud, 130 timesteps; simulated, or scene.vdb=DIR",
    "dust_tornado": "a column of dust, 100 timesteps; simulated, or scene.vdb=DIR",
    "vdb": "any sequence of .vdb files: scene.vdb=DIR",
}
_VOLUME_FUNCTIONS = tuple(
    lazy_function(f"neuprim.tasks.dynamic.volume.volume_scene:{function}")
    for function in ("load_volume_scene", "open_volume_source", "open_captured_vdb_frames", "split_into_time_chunks")
)
_MULTIVIEW = "images with a time per frame (D-NeRF layout): scene.path=DIR"

TASK = TaskSpec(
    api=API_VERSION,
    name="dynamic",
    summary="Smoke and fire over time, from OpenVDB sequences or images with a time each",
    config_package="neuprim.tasks.dynamic.conf",
    scenes=(
        *(SceneSpec(name, summary, *_VOLUME_FUNCTIONS) for name, summary in _VOLUME_SCENES.items()),
        SceneSpec("multiview", _MULTIVIEW, lazy_function("neuprim.tasks.dynamic.multiview:load_moving_multiview")),
    ),
    build=_build_time_fields,
    loss=photometric,
    check=_check_dynamic_model,
    tunable_settings=_tunable_time_settings,
    conditions=(
        ConditionSpec("time", (), "fraction of the sequence", (0.0, 1.0), parse_dynamic_time, sweep="0:1"),
        *(replace(spec, of_scene=_has_lights) for spec in LIGHT_CONDITIONS),
    ),
    fields={
        "TimeDensity": TimeDensity,
        "TimeHarmonics": TimeHarmonics,
        "ScatteringHarmonics": ScatteringHarmonics,
    },
    environment=light_smoke_by_environment,
    facts=_dataset_facts,
    uses=("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight"),
    mask=matter_mask,
    diagnose=compare_with_vdb_recording,
    clips=held_out_clips,
    layers=(*_LAYERS, *LIGHT_LAYERS),
)
