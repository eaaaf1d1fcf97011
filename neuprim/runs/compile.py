"""Compile the renderer's kernels in a process of their own, while a run is still busy with its data.

Compiling takes a minute of one core, once per installation, and its result is kept on disk, so that the run finds it
there when it needs it. Nothing depends on it: a run that finds no kernels compiles them itself.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from neuprim.core.compute.kernels import cache_directory, sources_hash

_LIMIT = 600.0  # seconds after which the run goes on alone


def kernel_variant(colour: str, edge: int) -> str:
    """Name of the kernels that draw a form of colour (the name of its class) with an edge of density."""
    return f"{colour}-{edge}"


def is_compiled(backend: str, form: str) -> bool:
    """Whether the kernels with which a backend draws a :func:`variant` are on disk."""
    return _marker(backend, form).exists()


def mark_compiled(backend: str, form: str) -> None:
    """Say so for the next run; a folder that cannot be written only costs that run a message."""
    try:
        _marker(backend, form).parent.mkdir(parents=True, exist_ok=True)
        _marker(backend, form).touch()
    except OSError:
        pass


def _marker(backend: str, form: str) -> Path:
    return cache_directory() / f"{backend}-{form}-{sources_hash(Path(__file__))}.compiled"


class KernelCompilation:
    """A process that compiles, or none where there is nothing to do."""

    def __init__(self, process: subprocess.Popen[bytes] | None) -> None:
        self._process = process

    @property
    def running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def wait(self) -> None:
        """Until it is done, however it ends: what it leaves out the run does itself."""
        if self._process is not None:
            try:
                self._process.wait(_LIMIT)
            except subprocess.TimeoutExpired:
                self.stop()

    def stop(self) -> None:
        """End it now."""
        if self.running and self._process is not None:
            self._process.kill()
            self._process.wait()


@contextmanager
def compile_in_background(backend: str | None, edge: int = 0) -> Iterator[KernelCompilation]:
    """Start compiling this backend for densities of an edge, None for none, unless that has been done; the process
    never outlives the block."""
    process = None
    if backend is not None and not is_compiled(backend, kernel_variant("Constant", edge)) and sys.executable:
        quiet, words = subprocess.DEVNULL, [sys.executable, "-m", "neuprim.runs.compile", backend, str(edge)]
        process = subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet)
    started = KernelCompilation(process)
    try:
        yield started
    finally:
        started.stop()


def main(backend: str, edge: int = 0) -> None:
    """A training step on a few primitives drawn by this backend: forward, backward, colours, loss, optimiser."""
    from neuprim.core.cameras import Camera, look_at
    from neuprim.core.data import View
    from neuprim.core.model.colours.sh_cpu import fused_colors
    from neuprim.core.model.densities.cosine import CosineDensity
    from neuprim.core.model.fields import Constant
    from neuprim.core.model.geometry import GEOMETRY_SPECS, Geometry
    from neuprim.core.model.primitives import Lowered
    from neuprim.core.model.schema import InitContext, ParameterSpec
    from neuprim.core.render import RenderSettings, render_lowered
    from neuprim.core.task import Supervision
    from neuprim.core.train.losses import photometric
    from neuprim.core.train.optimizer import RowAdam

    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand((8, 3), generator=generator) - 0.5
    context = InitContext(means, torch.full((8,), 0.3), torch.full((8, 3), 0.5), generator)
    density = CosineDensity(edge=edge)
    dc = ParameterSpec("dc", (3,), 1e-3, lambda c: torch.zeros(c.count, 3))
    specs = [
        *GEOMETRY_SPECS,
        *density.parameters(),
        dc,
        ParameterSpec("rest", (15, 3), 1e-3, lambda c: torch.zeros(c.count, 15, 3)),
    ]
    params = {spec.name: spec.init(context).float().contiguous().requires_grad_() for spec in specs}
    eye = torch.tensor([0.0, -3.0, 0.5], dtype=torch.float64)
    camera = Camera(
        look_at(eye, torch.zeros(3, dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0])), 30.0, 30.0, 16.0, 16.0, 32, 32
    )
    geometry = Geometry(params["means"], params["log_scales"], params["quats"])
    colour = Constant(fused_colors(params["means"], params["dc"], params["rest"], camera.position, 3) + 0.5)
    output = render_lowered(
        Lowered(geometry, density.lower(params, geometry, {}), colour), camera, RenderSettings(backend=backend)
    )
    output.request_contributions(torch.ones(output.rgb.shape[:2]))
    loss, _ = photometric({"ssim_weight": 0.2})(
        output.rgb, torch.zeros_like(output.rgb), Supervision(View("warm", camera))
    )
    loss.backward()
    RowAdam(specs, params).step(params, {spec.name: 1e-3 for spec in specs})
    mark_compiled(backend, kernel_variant("Constant", edge))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
