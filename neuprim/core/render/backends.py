"""The one table of renderer backends. A new one is a folder of this package and a row here; nothing else names it.

Importing this loads none of them: a row knows where its ``render`` is.
"""

from __future__ import annotations

import functools
import platform
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from neuprim.core.cameras.rays import AnyCamera, RayCamera
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.model.forms import Constant, Cosine, RayNet

if TYPE_CHECKING:
    from neuprim.core.model.primitives import Lowered
    from neuprim.core.render.shading import Draw
    from neuprim.core.settings import RenderSettings

__all__ = ["AUTO", "ORACLE", "TABLE", "Backend", "available", "candidates", "check_name", "choose", "compiled_ahead", "find", "names"]

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
        load: imports it and returns its ``render(lowered, camera, background, settings)``, see :data:`~neuprim.core.render.shading.Draw`.
        refuses: what it cannot draw of a model through a camera (None: any pinhole), as the rest of a sentence that starts with
            "cannot draw"; None if it can.
        device: what it computes on, for a run's numbers.
        missing: why this machine cannot run it at all, such as a driver that is not there; None if it can. Cheap.
        compiles: whether it compiles something once per installation, which a run then does beside its other preparations.
        checks: whether it refuses numbers that are not finite itself, while it prepares a frame; the others get :func:`refuse_non_finite`.
        differentiates_intrinsics: whether gradients reach focal lengths and the principal point.
    """

    name: str
    load: Callable[[], Draw]
    refuses: Callable[[Lowered, AnyCamera | None], str | None] = _draws_all
    device: Callable[[], str] = _processor
    missing: Callable[[], str | None] = _nothing
    compiles: bool = False
    checks: bool = False
    differentiates_intrinsics: bool = False

    def fault(self, lowered: Lowered, camera: AnyCamera | None) -> str | None:
        """Why it does not draw this here, as the rest of a sentence; None if it does."""
        missing = self.missing()
        if missing is not None:
            return f"cannot run here: {missing}"
        refused = self.refuses(lowered, camera)
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


def _reference() -> Draw:
    from neuprim.core.render.reference.backend import render

    return render


TABLE: tuple[Backend, ...] = (
    Backend("cpu", _cpu, kernels_refuse, compiles=True, checks=True),
    Backend(ORACLE, _reference, differentiates_intrinsics=True),
)
"""Fastest first."""


def names() -> tuple[str, ...]:
    """Those of the whole table, in its order."""
    return tuple(backend.name for backend in TABLE)


def available() -> tuple[Backend, ...]:
    """Those that this machine can run."""
    return tuple(backend for backend in TABLE if backend.missing() is None)


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


def candidates(settings: RenderSettings) -> tuple[Backend, ...]:
    """Those that may draw under these settings, whatever is drawn.

    Raises:
        ConfigError: they name a backend that does not exist.
    """
    return available() if settings.backend == AUTO else (find(settings.backend),)


def compiled_ahead(settings: RenderSettings) -> Backend | None:
    """The one that a run may want to compile beside its other preparations, whatever it will draw."""
    return next((backend for backend in candidates(settings) if backend.compiles), None)


def choose(lowered: Lowered, settings: RenderSettings, camera: AnyCamera | None = None) -> Backend:
    """The backend that will draw this model through this camera; without a camera, through a pinhole.

    Raises:
        BackendUnavailable: the one asked for by name does not know the model's forms or the camera, or cannot run here.
        ConfigError: there is none of this name.
    """
    faults = []
    for backend in candidates(settings):
        fault = backend.fault(lowered, camera)
        if fault is None:
            return backend
        faults.append(f"renderer.backend={backend.name} {fault}")
    other = next((b for b in TABLE if b.fault(lowered, camera) is None), None)
    raise BackendUnavailable("; ".join(faults) + (f". Use renderer.backend={other.name}" if other is not None else ""))
