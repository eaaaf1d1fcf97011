"""The one table of renderer backends. A new one is a folder of this package and a row here; nothing else names it.

Importing this loads none of them: a row knows where its ``render`` is.
"""

from __future__ import annotations

import functools
import importlib.util
import platform
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neuprim.core.cameras.projections import AnyCamera, RayCamera
from neuprim.core.compute import device as hardware
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.model.forms import Constant, Cosine, RayNet
from neuprim.core.notices import warn_once

if TYPE_CHECKING:
    from neuprim.core.model.primitives import Lowered
    from neuprim.core.render.shading import Draw
    from neuprim.core.settings import RenderSettings

__all__ = [
    "AUTO",
    "ORACLE",
    "TABLE",
    "Backend",
    "at_hand",
    "available",
    "candidates",
    "check_device",
    "check_name",
    "check_pair",
    "choose",
    "compiled_ahead",
    "computing_device",
    "find",
    "names",
    "no_card",
    "run_device",
]

AUTO = "auto"
"""The setting that takes the first backend of the table that does not refuse."""

ORACLE = "reference"
"""The backend that draws every form, in float64, and that others are judged against."""


def _nothing() -> None:
    return None


def _draws_all(lowered: Lowered, camera: AnyCamera | None) -> None:
    return None


@functools.cache
def _processor() -> str:
    return f"cpu ({platform.processor() or platform.machine()})"


@dataclass(frozen=True)
class Backend:
    """One way to draw.

    Attributes:
        name: of the setting ``renderer.backend``.
        load: imports it and returns its ``render(lowered, camera, background, settings)``, see
        :data:`~neuprim.core.render.shading.Draw`. refuses: what it cannot draw of a model through a camera (None: any
        pinhole), as the rest of a sentence that starts with
            "cannot draw"; None if it can.
        device: what it computes on, for a run's numbers.
        missing: why this machine cannot run it at all, such as a driver that is not there; None if it can. Cheap.
        compiles: whether it compiles something once per installation, which a run then does beside its other
        preparations. devices: kinds of device that it draws tensors of, its own first: frames whose tensors are
        elsewhere are moved there and back. checks: whether it refuses numbers that are not finite itself, while it
        prepares a frame; the others get :func:`refuse_non_finite`. parts: loads and returns what draws parts of a set
        of primitives in one frame, see :mod:`~neuprim.core.render.parts`; None without. differentiates_intrinsics:
        whether gradients reach focal lengths and the principal point.
    """

    name: str
    load: Callable[[], Draw]
    refuses: Callable[[Lowered, AnyCamera | None], str | None] = _draws_all
    device: Callable[[], str] = _processor
    missing: Callable[[], str | None] = _nothing
    compiles: bool = False
    checks: bool = False
    differentiates_intrinsics: bool = False
    devices: tuple[str, ...] = (hardware.CPU,)
    parts: Callable[[], Callable[..., tuple[Tensor, Tensor]] | None] = _nothing

    @property
    def lacking(self) -> str | None:
        """Why this machine cannot run it on its own device; None if it can."""
        return (hardware.cuda_unavailable() if self.devices[0] == hardware.CUDA else None) or self.missing()

    def place(self, settings: RenderSettings) -> str:
        """The kind of device that it draws on under these settings."""
        return self.devices[0] if settings.device == AUTO else settings.device

    def computer(self, settings: RenderSettings) -> str:
        """What it computes on under these settings, for a run's numbers."""
        return self.device() if self.place(settings) == self.devices[0] else _processor()

    def absent(self, place: str) -> str | None:
        """Why it cannot draw on this kind of device here, as the rest of a sentence; None if it can."""
        if place not in self.devices:
            return f"draws on the {' or '.join(self.devices)}, but renderer.device is {place}"
        missing = (hardware.cuda_unavailable() if place == hardware.CUDA else None) or self.missing()
        return None if missing is None else f"cannot run here: {missing}"

    def fault(self, lowered: Lowered, camera: AnyCamera | None, place: str | None = None) -> str | None:
        """Why it does not draw this here, as the rest of a sentence; None if it does.

        Args:
            place: the kind of device that it is to draw on; None is its own.
        """
        absent = self.absent(place or self.devices[0])
        if absent is not None:
            return absent
        refused = self.refuses(lowered, camera)
        if refused is None and not lowered.movable and (place or self.devices[0]) != lowered.kind:
            refused = f"code of the model's own that works on the {lowered.kind}; it draws on the {self.devices[0]}"
        return None if refused is None else f"cannot draw {refused}"


def kernels_refuse(lowered: Lowered, camera: AnyCamera | None) -> str | None:
    """What kernels that are compiled ahead of a model do not know."""
    if not (isinstance(lowered.density, Cosine) and isinstance(lowered.colour, Constant | RayNet)):
        forms = f"{type(lowered.density).__name__} density, {type(lowered.colour).__name__} colour"
        return f"{forms}; it knows Cosine, and Constant or RayNet"
    if isinstance(camera, RayCamera):
        return "a RayCamera (fisheye, equirectangular); it knows pinhole cameras"
    return None


def _cpu() -> Draw:
    from neuprim.core.render.cpu.backend import render

    return render


def _cuda() -> Draw:
    from neuprim.core.render.cuda.backend import render

    return render


@functools.cache
def _no_warp() -> str | None:
    return None if importlib.util.find_spec("warp") else "Warp is not installed: pip install 'neuprim[cuda]'"


def _cpu_parts() -> Callable[..., tuple[Tensor, Tensor]]:
    from neuprim.core.render.cpu.backend import render_parts

    return render_parts


def _cuda_parts() -> Callable[..., tuple[Tensor, Tensor]]:
    from neuprim.core.render.cuda.backend import render_parts

    return render_parts


def _card() -> str:
    return "cuda (no card)" if hardware.cuda_unavailable() else f"cuda ({torch.cuda.get_device_name()})"


def _reference() -> Draw:
    from neuprim.core.render.reference.backend import render

    return render


TABLE: tuple[Backend, ...] = (
    Backend(
        "cuda",
        _cuda,
        kernels_refuse,
        _card,
        _no_warp,
        checks=True,
        devices=(hardware.CUDA, hardware.CPU),
        parts=_cuda_parts,
    ),
    Backend("cpu", _cpu, kernels_refuse, compiles=True, checks=True, parts=_cpu_parts),
    Backend(ORACLE, _reference, differentiates_intrinsics=True),
)
"""Fastest first."""


def names() -> tuple[str, ...]:
    """Those of the whole table, in its order."""
    return tuple(backend.name for backend in TABLE)


def available() -> tuple[Backend, ...]:
    """Those that this machine can run."""
    return tuple(backend for backend in TABLE if backend.lacking is None)


def check_name(name: object) -> None:
    """Raise :class:`ConfigError` unless the setting ``renderer.backend`` may have this value."""
    valid = (AUTO, *names())
    if name in valid:
        return
    raise ConfigError(f"renderer.backend={name}: expected {', '.join(valid[:-1])} or {valid[-1]}")


def find(name: str) -> Backend:
    """The backend of this name.

    Raises:
        ConfigError: there is none.
    """
    for backend in TABLE:
        if backend.name == name:
            return backend
    check_name(name)
    raise ConfigError(f"renderer.backend={name}: expected the name of one backend: {', '.join(names())}")


def candidates(settings: RenderSettings, kind: str = hardware.CPU) -> tuple[Backend, ...]:
    """Those that may draw tensors on a ``kind`` of device under these settings, whatever is drawn.

    Tensors stay where they are if they can: those on the processor go to a card only where the settings say so.

    Raises:
        ConfigError: they name a backend that does not exist.
    """
    if settings.backend != AUTO:
        return (find(settings.backend),)
    chosen = kind if settings.device == AUTO else settings.device
    own = tuple(backend for backend in TABLE if backend.devices[0] == chosen and backend.absent(chosen) is None)
    if chosen == hardware.CPU or settings.device != AUTO:
        return own
    return own + candidates(settings)


def no_card() -> str | None:
    """Why nothing is drawn on a card here, in words; None if something is."""
    missing = hardware.cuda_unavailable()
    rows = [backend.missing() for backend in TABLE if backend.devices[0] == hardware.CUDA]
    if missing is None and not rows:
        return "no backend draws there"
    return missing or (None if None in rows else rows[0])


def check_pair(settings: RenderSettings) -> None:
    """Raise :class:`ConfigError` for a device that the backend asked for by name does not draw on, whatever the
    machine."""
    if AUTO in (settings.backend, settings.device):
        return
    backend = find(settings.backend)
    if settings.device not in backend.devices:
        own = " or ".join((*backend.devices, AUTO))
        raise ConfigError(
            f"renderer.device={settings.device}: renderer.backend={backend.name} does not draw there; expected {own}"
        )


def check_device(settings: RenderSettings) -> None:
    """Refuse a card that is not there.

    Raises:
        BackendUnavailable: naming the setting, and why.
    """
    if settings.device == hardware.CUDA:
        why = no_card() if settings.backend == AUTO else hardware.cuda_unavailable()
        if why is not None:
            raise BackendUnavailable(f"renderer.device={hardware.CUDA}: {why}; expected {hardware.CPU} or {AUTO}")
    elif settings.device == AUTO and settings.backend != AUTO:
        backend = find(settings.backend)
        if backend.devices[0] == hardware.CUDA and backend.lacking is not None:
            raise BackendUnavailable(
                f"renderer.backend={backend.name} cannot run here: {backend.lacking}; expected {AUTO} or the name of another backend"
            )


def at_hand(settings: RenderSettings) -> RenderSettings:
    """The same for what is drawn again later, perhaps on another machine: a card that is not there is not insisted
    on."""
    gone = settings.device == hardware.CUDA and no_card() is not None and settings.backend == AUTO
    return replace(settings, device="auto") if gone else settings


def compiled_ahead(settings: RenderSettings) -> Backend | None:
    """The one that a run may want to compile beside its other preparations, whatever it will draw."""
    kind = hardware.CUDA if no_card() is None else hardware.CPU
    return next((backend for backend in candidates(settings, kind) if backend.compiles), None)


def run_device(settings: RenderSettings, forms: Callable[[], Lowered], camera: AnyCamera) -> torch.device:
    """Where a run keeps its tensors.

    Args:
        forms: what its model lowers to, on the processor; asked for where a card could draw it.

    Raises:
        BackendUnavailable, ConfigError: see :func:`check_device`.
    """
    check_device(settings)
    kind: str = settings.device
    if kind == AUTO and settings.backend != AUTO:
        kind = find(settings.backend).devices[0]
        if kind == hardware.CUDA and hardware.cuda_unavailable() is not None:
            kind = hardware.CPU  # the first frame says why it is not drawn
    elif kind == AUTO:
        kind = hardware.CPU
        if no_card() is None:
            lowered = forms()
            if any(b.fault(lowered, camera) is None for b in TABLE if b.devices[0] == hardware.CUDA):
                kind = hardware.CUDA
    return hardware.current_device(kind)


def computing_device(settings: RenderSettings) -> torch.device:
    """Where a run computes what is no frame of its model, such as the ground truth of volumes: a card that the settings
    allow and that is there."""
    kind: str = settings.device
    if kind == AUTO:
        kind = hardware.CUDA if settings.backend == AUTO else find(settings.backend).devices[0]
    return hardware.current_device(hardware.CPU if kind == hardware.CUDA and no_card() is not None else kind)


def choose(lowered: Lowered, settings: RenderSettings, camera: AnyCamera | None = None) -> Backend:
    """The backend that will draw this model through this camera; without a camera, through a pinhole.

    Raises:
        BackendUnavailable: the one asked for by name does not know the model's forms or the camera, or cannot run here.
        ConfigError: there is none of this name.
    """
    check_device(settings)
    faults = []
    for backend in candidates(settings, lowered.kind):
        place = backend.place(settings)
        fault = backend.fault(lowered, camera, place)
        if fault is None:
            if place != backend.devices[0]:
                own = next((f"; renderer.backend={b.name} is made for it" for b in TABLE if b.devices[0] == place), "")
                warn_once(f"renderer.backend={backend.name} is slow on the {place}, where only its tests draw{own}")
            return backend
        faults.append(f"renderer.backend={backend.name} {fault}")
    other = next((b for b in TABLE if b.fault(lowered, camera) is None), None)
    raise BackendUnavailable("; ".join(faults) + (f". Use renderer.backend={other.name}" if other is not None else ""))
