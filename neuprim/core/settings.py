"""Settings of rendering and of what is measured on request."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from neuprim.core.errors import ConfigError
from neuprim.core.validation import Range, nonempty_text, validate_fields

SortOrder = Literal["center", "entry"]
DeviceChoice = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class RenderSettings:
    """How a frame is drawn; part of a run's configuration as ``renderer``.

    Attributes:
        backend: a name of the table :mod:`neuprim.core.render.backends`: "reference" (float64 torch, the oracle), "cpu"
            (numba), ...; or "auto", the fastest that can run the model.
        device: where a run keeps the model, the optimiser's state and the images it compares: "cpu", "cuda" (refused
            where there is no NVIDIA GPU), or "auto": a GPU with a backend that draws the model, else the CPU. Files are
            the same either way: a run begun on one goes on on the other.
        sort: what is composited front to back. "center": whole primitives by camera-z of their centres, one order for
            all pixels. "entry": the chords of each pixel by camera-z of where the ray enters them, those cut by the
            near plane first, and by their centres where entries are equal; no popping when centres swap, but slower.
        samples: rays per pixel side, on a regular grid inside the pixel, averaged: 1 draws through pixel centres, n
            costs n^2.
        alpha_max: opacity clamp of one primitive; at most 0.9999, as the backward pass divides by 1 - alpha.
        alpha_min: a ray-primitive pair fainter than this is skipped.
        transmittance_min: a ray stops after the primitive that takes its transmittance below this.
        near: camera-z of the near plane, scene units; chords are cut there. Ray distance for a ``RayCamera``, which has
            no z plane. "auto", the default of a run: 1/400 of the median depth at which training cameras see the
            starting points, and at most a tenth of the least; decided when training begins, and recorded. Without a
            training it follows from the primitives and each camera.
        depth_floor: lower bound on D = 1 - |x_m|^2 in the backward pass only: gradients grow as D^-1/2 at a silhouette,
            where float32 knows D to about 3e-7. At 1e-4 they keep three digits, and one chord in ten thousand is
            affected.
        depth: whether to accumulate the depth image.
        threads: worker threads of the cpu backend, 0 for all cores; results are bit-identical for any count.
    """

    backend: Annotated[str, nonempty_text("auto or the name of a backend")] = "auto"
    device: DeviceChoice = "auto"
    sort: SortOrder = "center"
    samples: Annotated[int, Range(1, 16, says="a whole number of rays per pixel side, 1 to 16")] = 1
    alpha_max: Annotated[float, Range(above=0, at_most=0.9999)] = 0.99
    alpha_min: Annotated[float, Range(at_least=0, below=1)] = 1.0 / 255.0
    transmittance_min: Annotated[float, Range(at_least=0, below=1)] = 1e-4
    near: Annotated[float, Range(above=0, says="a positive distance")] | Literal["auto"] = 0.01
    depth_floor: Annotated[float, Range(above=0, below=1)] = 1e-4
    depth: bool = False
    threads: Annotated[int, Range(at_least=0, says="0 (all cores) or a positive count")] = 0

    def __post_init__(self) -> None:
        validate_fields(self, "renderer")

    @property
    def near_plane(self) -> float:
        """``near`` as a number; raises ConfigError where it is still "auto"."""
        if self.near == "auto":
            raise ConfigError("renderer.near=auto: nothing has decided it here; expected a positive distance")
        return self.near


@dataclass(frozen=True)
class MetricsSettings:
    """What a run measures beside its usual numbers; part of its configuration as ``metrics``.

    Attributes:
        lpips: weights for LPIPS, as :meth:`neuprim.core.metrics.lpips.Lpips.load` reads them; None does not measure it.
            neuprim has no weights and downloads none.
    """

    lpips: Annotated[str, nonempty_text("a file or folder with the weights of LPIPS")] | None = None

    def __post_init__(self) -> None:
        validate_fields(self, "metrics")
