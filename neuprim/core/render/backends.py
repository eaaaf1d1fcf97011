"""The table of renderer backends, and functions that choose one; a backend's module is imported at its first use."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.compute import device as hardware
from neuprim.core.errors import BackendUnavailable, ConfigError, warn_once
from neuprim.core.model.fields import Conditions
from neuprim.core.model.forms import Constant, Cosine, RayNet
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render.output import Draw
from neuprim.core.settings import RenderSettings

AUTO = "auto"  # selects the first backend of the table that can draw the frame
REFERENCE = "reference"  # draws every form, in float64; the others are tested against it

_FEW = 64  # primitives that suffice to test a backend with a model: only the forms matter


def _no_backend_fault(*_: Any) -> None:
    return None


@functools.cache
def _cpu_backend_name() -> str:
    return f"cpu ({platform.processor() or platform.machine()})"


@dataclass(frozen=True)
class Backend:
    """One implementation of the renderer, a row of :data:`TABLE`."""

    name: str  # value of the setting renderer.backend
    load: Callable[[], Draw]  # imports the backend and returns its render function
    unsupported: Callable[[LoweredPrimitives, AnyCamera | None], str | None] = _no_backend_fault
    """Function of a model and a camera (None: any pinhole camera) that returns what the backend cannot render. The text
    completes a sentence that starts with "cannot draw". None means that the backend can render model and camera."""
    device_name: Callable[[], str] = _cpu_backend_name  # returns the name of the backend's main device, for reports
    missing: Callable[[], str | None] = _no_backend_fault
    """Function that returns what this machine lacks for the backend, such as a package; None if nothing is missing. The
    function must be fast."""
    checks: bool = False  # whether the backend checks that parameters are finite; if not, the renderer checks
    differentiates_intrinsics: bool = False  # whether focal lengths and principal points get gradients
    devices: tuple[str, ...] = (hardware.CPU,)  # kinds of device that the backend renders on; the first is its main one
    slabs: Callable[[], Callable[..., tuple[Tensor, Tensor]] | None] = _no_backend_fault
    """Function that loads and returns the backend's function to render all slabs (groups of primitives) in one frame.
    It returns None if the backend has no such function."""

    def drawing_device(self, settings: RenderSettings) -> str:
        """Return the kind of device, "cpu" or "cuda", on which the backend renders with these settings."""
        return self.devices[0] if settings.device == AUTO else settings.device

    def computing_on(self, settings: RenderSettings) -> str:
        """Return the name of the device on which the backend renders with these settings, for reports."""
        return self.device_name() if self.drawing_device(settings) == self.devices[0] else _cpu_backend_name()

    def unavailable(self, device: str | None = None) -> str | None:
        """Return why the backend cannot run here on ``device`` (None: its main kind of device); None if it can run."""
        device = device or self.devices[0]
        return (hardware.cuda_unavailable() if device == hardware.CUDA else None) or self.missing()

    def cannot_draw(
        self, lowered: LoweredPrimitives, camera: AnyCamera | None, device: str | None = None
    ) -> str | None:
        """Return why the backend cannot render this model, as in "cannot run here: ..."; None if it can.

        A ``camera`` of None means any pinhole camera. ``device`` is "cpu" or "cuda"; None means the backend's main
        device.
        """
        device = device or self.devices[0]
        if device not in self.devices:
            return f"draws on the {' or '.join(self.devices)}, but renderer.device is {device}"
        reason = self.unavailable(device)
        if reason is not None:
            return f"cannot run here: {reason}"
        unsupported = self.unsupported(lowered, camera)
        if unsupported is None and not lowered.movable and device != lowered.kind:
            unsupported = f"the model's own code, which runs on the {lowered.kind}; it draws on the {self.devices[0]}"
        return None if unsupported is None else f"cannot draw {unsupported}"


def unsupported_by_kernels(lowered: LoweredPrimitives, camera: AnyCamera | None) -> str | None:
    """Return which form or camera the cpu and cuda backends cannot render; None if they can render this model."""
    if not (isinstance(lowered.density, Cosine) and isinstance(lowered.colour, Constant | RayNet)):
        forms = f"{type(lowered.density).__name__} density, {type(lowered.colour).__name__} colour"
        return f"{forms}; it supports Cosine density, Constant or RayNet colour"
    if isinstance(camera, RayCamera):
        return "a RayCamera (fisheye, equirectangular); it supports pinhole cameras"
    return None


@functools.cache
def _cuda_backend_missing() -> str | None:
    return None if importlib.util.find_spec("warp") else "Warp is not installed: pip install 'neuprim[cuda]'"


def _cuda_backend_name() -> str:
    return "cuda (no GPU)" if hardware.cuda_unavailable() else f"cuda ({torch.cuda.get_device_name()})"


def _backend_loader(module: str, function: str = "render") -> Callable[[], Any]:
    def load() -> Any:
        return getattr(importlib.import_module(f"neuprim.core.render.{module}"), function)

    return load


TABLE: tuple[Backend, ...] = (
    Backend(
        "cuda",
        _backend_loader("cuda.backend"),
        unsupported_by_kernels,
        _cuda_backend_name,
        _cuda_backend_missing,
        checks=True,
        devices=(hardware.CUDA, hardware.CPU),
        slabs=_backend_loader("cuda.backend", "render_slabs"),
    ),
    Backend(
        "cpu",
        _backend_loader("cpu.backend"),
        unsupported_by_kernels,
        checks=True,
        slabs=_backend_loader("cpu.backend", "render_slabs"),
    ),
    Backend(REFERENCE, _backend_loader("reference"), differentiates_intrinsics=True),
)
"""All backends, fastest first."""


def backend_names() -> tuple[str, ...]:
    """Return the names of all backends, fastest first, whether this machine can run them or not."""
    return tuple(backend.name for backend in TABLE)


def available_backends() -> tuple[Backend, ...]:
    """Return the backends that this machine can run, fastest first."""
    return tuple(backend for backend in TABLE if backend.unavailable() is None)


def check_backend_name(name: object) -> None:
    """Raise :class:`ConfigError` unless ``name`` is a valid value of the setting ``renderer.backend``."""
    valid = (AUTO, *backend_names())
    if name not in valid:
        raise ConfigError(f"renderer.backend={name}: expected {', '.join(valid[:-1])} or {valid[-1]}")


def find_backend(name: str) -> Backend:
    """Return the backend called ``name``; raises :class:`ConfigError` if there is none."""
    for backend in TABLE:
        if backend.name == name:
            return backend
    check_backend_name(name)
    raise ConfigError(f"renderer.backend={name}: expected the name of one backend: {', '.join(backend_names())}")


def candidate_backends(settings: RenderSettings, kind: str = hardware.CPU) -> tuple[Backend, ...]:
    """Return the backends that these settings permit for tensors on a ``kind`` of device, "cpu" or "cuda".

    The backends come in order of preference. The renderer moves tensors from the CPU to a GPU only if the settings
    request a GPU.
    """
    if settings.backend != AUTO:
        return (find_backend(settings.backend),)
    chosen = kind if settings.device == AUTO else settings.device
    own = tuple(backend for backend in TABLE if backend.devices[0] == chosen and backend.unavailable(chosen) is None)
    if chosen == hardware.CPU or settings.device != AUTO:
        return own
    return own + candidate_backends(settings)


def gpu_backends_unavailable() -> str | None:
    """Return why no backend can render on a GPU of this machine; None if one can."""
    reason = hardware.cuda_unavailable()
    rows = [backend.missing() for backend in TABLE if backend.devices[0] == hardware.CUDA]
    if reason is None and not rows:
        return "no backend draws on a GPU"
    return reason or (None if None in rows else rows[0])


def check_backend_device(settings: RenderSettings) -> None:
    """Raise :class:`ConfigError` if the backend of the settings cannot use the device of the settings."""
    if AUTO in (settings.backend, settings.device):
        return
    backend = find_backend(settings.backend)
    if settings.device not in backend.devices:
        own = " or ".join((*backend.devices, AUTO))
        raise ConfigError(
            f"renderer.device={settings.device}: renderer.backend={backend.name} cannot use this device; "
            f"expected renderer.device={own}"
        )


def check_render_backend(settings: RenderSettings) -> None:
    """Raise :class:`BackendUnavailable` if the settings require a GPU backend that cannot run here."""
    if settings.device == hardware.CUDA:
        reason = gpu_backends_unavailable() if settings.backend == AUTO else hardware.cuda_unavailable()
        if reason is not None:
            raise BackendUnavailable(f"renderer.device={hardware.CUDA}: {reason}; expected {hardware.CPU} or {AUTO}")
    elif settings.device == AUTO and settings.backend != AUTO:
        backend = find_backend(settings.backend)
        reason = backend.unavailable()
        if backend.devices[0] == hardware.CUDA and reason is not None:
            raise BackendUnavailable(
                f"renderer.backend={backend.name} cannot run here: {reason}; "
                f"expected {AUTO} or the name of another backend"
            )


def with_available_render_backend(settings: RenderSettings) -> RenderSettings:
    """Return the settings of a finished run, changed so that this machine can render the run even without a GPU.

    If no GPU works and the backend is "auto", the device "cuda" becomes "auto". Other settings do not change.
    """
    gone = settings.device == hardware.CUDA and gpu_backends_unavailable() is not None and settings.backend == AUTO
    return replace(settings, device="auto") if gone else settings


def best_render_backend_device(
    model: Primitives, settings: RenderSettings, camera: AnyCamera, conditions: Conditions
) -> torch.device:
    """Return the device on which a run should store its tensors to render frames like this one."""
    check_render_backend(settings)
    if settings.device != AUTO:
        return hardware.current_device(settings.device)
    if settings.backend != AUTO:
        on_gpu = find_backend(settings.backend).devices[0] == hardware.CUDA and hardware.cuda_unavailable() is None
        return hardware.current_device(hardware.CUDA if on_gpu else hardware.CPU)
    if gpu_backends_unavailable() is None:
        rows = model.rows(torch.arange(min(model.count, _FEW), device=model.device))
        lowered = Primitives(model.density, model.colour, rows).lower(camera, conditions, shaded=False)
        if any(b.cannot_draw(lowered, camera) is None for b in TABLE if b.devices[0] == hardware.CUDA):
            return hardware.current_device(hardware.CUDA)
    return hardware.HOST


def choose_backend(lowered: LoweredPrimitives, settings: RenderSettings, camera: AnyCamera | None = None) -> Backend:
    """Return the backend that renders this model with this camera (None: any pinhole camera).

    Raises BackendUnavailable if no backend that the settings permit can render the model, and ConfigError for an
    unknown backend name.
    """
    check_render_backend(settings)
    reasons = []
    for backend in candidate_backends(settings, lowered.kind):
        device = backend.drawing_device(settings)
        reason = backend.cannot_draw(lowered, camera, device)
        if reason is None:
            if device != backend.devices[0]:
                own = next((f"; use renderer.backend={b.name}" for b in TABLE if b.devices[0] == device), "")
                warn_once(
                    f"renderer.backend={backend.name} is slow on the {device}, where it only serves for tests{own}"
                )
            return backend
        reasons.append(f"renderer.backend={backend.name} {reason}")
    other = next((b for b in TABLE if b.cannot_draw(lowered, camera) is None), None)
    advice = "" if other is None else f". Use renderer.backend={other.name}"
    raise BackendUnavailable("; ".join(reasons) + advice)
