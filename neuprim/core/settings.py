"""Settings of rendering and of optional metrics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from neuprim.core.errors import ConfigError
from neuprim.core.validation import Range, nonempty_text, validate_fields

SortOrder = Literal["center", "entry"]
__all__ = ["MetricsSettings", "RenderSettings"]

DeviceChoice = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class RenderSettings:
    """How images are rendered; part of a run's configuration as ``renderer``.

    Attributes:
        backend: "auto" (the fastest that can render the model), "reference" (float64 torch), "cpu" (numba) or another
            name that ``neuprim doctor`` lists.
        device: where a run keeps the model, the state of the optimiser and the images: "cpu", "cuda" (refused without
            an NVIDIA GPU) or "auto" (a GPU if a backend can render the model there, else the CPU). Files do not depend
            on the device, so a run that started on one device can continue on the other.
        sort: order of compositing, front to back. "center" sorts whole primitives by the camera-z of their centres, so
            all pixels have the same order. "entry" sorts the primitives of each pixel by the camera-z at which the ray
            enters the ellipsoid. Primitives cut by the near plane come first; ties are ordered by the centres.
            "entry" is slower, but images do not change abruptly when two centres swap their order.
        samples: number n of rays along each side of a pixel. The colours of n x n rays on a regular grid are averaged,
            which takes n^2 times as long. 1 renders through pixel centres.
        alpha_max: upper bound of the opacity of one primitive; at most 0.9999, because the backward pass divides by 1 -
            alpha.
        alpha_min: a primitive whose opacity along a ray is smaller than this is skipped for this ray.
        transmittance_min: a ray ends after the primitive at which the ray's transmittance falls below this value.
        near: camera-z of the near plane in scene units; the near plane cuts primitives. A ``RayCamera`` has no plane;
            for this camera, ``near`` is a distance along the ray. "auto", the default of a run, is 1/400 of the median
            depth at which training cameras see the starting points, and at most a tenth of the smallest depth. A
            training chooses and records this distance. Without a training, the distance follows from the primitives and
            each camera.
        depth_floor: lower bound of D = 1 - |x_m|^2 in the backward pass only, where x_m is the middle of a ray's chord
            through the ellipsoid, in units where the ellipsoid is the unit sphere. Gradients grow as D^-1/2 at a
            silhouette, where float32 resolves D only to about 3e-7. With the bound 1e-4, gradients keep three digits,
            and one chord in ten thousand is affected.
        depth: whether to render the depth image too.
        threads: threads of the cpu backend; 0 uses all cores. Results are bit-identical for any number.
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
        """``near`` as a number; raises ConfigError if it is "auto"."""
        if self.near == "auto":
            raise ConfigError(
                "renderer.near=auto: there is no scene to compute a distance from; expected a positive number"
            )
        return self.near


@dataclass(frozen=True)
class MetricsSettings:
    """What a run measures on request; part of its configuration as ``metrics``.

    Attributes:
        lpips: file or folder with weights for LPIPS (:class:`neuprim.core.metrics.lpips.Lpips`). null does not measure
            LPIPS. neuprim contains no weights and downloads none.
    """

    lpips: Annotated[str, nonempty_text("a file or folder with the weights of LPIPS")] | None = None

    def __post_init__(self) -> None:
        validate_fields(self, "metrics")
