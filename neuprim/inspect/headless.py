"""Whether VTK can draw without a display. It ends the process where a library is missing, so another process tries
first."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from functools import cache

from neuprim.core.errors import BackendUnavailable

__all__ = ["has_display", "prepare_headless", "require_pyvista"]

_VARIABLE = "VTK_DEFAULT_OPENGL_WINDOW"
_PROBE = """
from vtkmodules.vtkRenderingCore import vtkActor, vtkPolyDataMapper, vtkRenderer, vtkRenderWindow, vtkWindowToImageFilter
from vtkmodules.vtkFiltersSources import vtkSphereSource
import vtkmodules.vtkRenderingOpenGL2
window, renderer, actor, mapper, ball, image = (
    vtkRenderWindow(), vtkRenderer(), vtkActor(), vtkPolyDataMapper(), vtkSphereSource(), vtkWindowToImageFilter()
)
mapper.SetInputConnection(ball.GetOutputPort())
actor.SetMapper(mapper)
renderer.AddActor(actor)
window.SetOffScreenRendering(1)
window.SetSize(32, 32)
window.AddRenderer(renderer)
window.Render()
image.SetInput(window)
image.Update()
print("drawn" if image.GetOutput().GetScalarRange()[1] > 0 else "black")
"""
_SECONDS = 120.0


def require_pyvista() -> None:
    """Raises:
    BackendUnavailable: the package is missing.
    """
    try:
        import pyvista  # noqa: F401
    except ImportError as error:
        raise BackendUnavailable(
            f"pyvista cannot be imported ({error}); pip install 'neuprim[viewer]', or --out FILE.html or .vdb"
        ) from None


def has_display() -> bool:
    """Whether a window could be opened."""
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@cache
def prepare_headless() -> None:
    """Chooses the first of VTK's ways of drawing off screen that works here, for this process.

    Raises:
        BackendUnavailable: none of them works; names the packages to install.
    """
    chosen = os.environ.get(_VARIABLE)
    ways = (chosen,) if chosen else (*([""] if has_display() else []), "vtkEGLRenderWindow", "vtkOSOpenGLRenderWindow")
    failures = []
    for way in ways:
        failure = _try(way)
        if failure is None:
            if way:
                os.environ[_VARIABLE] = way
            return
        failures.append(f"{way or 'display'}: {failure}")
    raise BackendUnavailable(
        f"VTK cannot draw pictures here ({'; '.join(failures)}); on Debian or Ubuntu: apt install libegl1 libgl1-mesa-dri; "
        "--out FILE.html and --out FILE.vdb need none of it"
    )


def _try(way: str) -> str | None:
    """Why one way does not work; None if it does."""
    environment = {**os.environ, **({_VARIABLE: way} if way else {})}
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE], env=environment, capture_output=True, text=True, timeout=_SECONDS
        )
    except subprocess.TimeoutExpired:
        return f"no picture after {_SECONDS:.0f} s"
    if done.returncode < 0:
        return f"ended by {signal.Signals(-done.returncode).name}"
    if done.returncode:
        return (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1][:200]
    return None if "drawn" in done.stdout else "the picture is black"
