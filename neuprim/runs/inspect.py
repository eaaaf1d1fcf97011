"""``neuprim inspect``: show a run's density in a window, or write it as pictures, a web page or OpenVDB files."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.conditions import frame_numbers
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.extensions import Inspector
from neuprim.core.io import images
from neuprim.core.io.files import refuse_existing
from neuprim.core.io.images import write_animation
from neuprim.core.model.fields import Conditions
from neuprim.core.volumes.density_grid import POINTS_LIMIT, box_lattice, density_grid
from neuprim.core.volumes.density_truth import DensityTruth, measure_density_errors
from neuprim.inspect.field import (
    InspectionFrame,
    describe_inspected_conditions,
    find_inspection_box,
    open_inspection_truth,
    pair_inspected_frames,
    read_inspected_conditions,
    write_inspection_vdb,
)
from neuprim.inspect.html_page import write_inspection_page
from neuprim.inspect.layers import Layer, validate_inspection_layers
from neuprim.inspect.window import Window, has_display, list_inspection_panels, prepare_headless, require_pyvista
from neuprim.plugins.attribution import attribute_errors, find_plugin_source
from neuprim.plugins.registry import INSPECTORS, PluginError
from neuprim.runs.fit import Events, Note, ignore_run_event
from neuprim.runs.open import StoredRun, open_run

__all__ = ["InspectRequest", "inspect_run"]

FILMS = (".webp", ".gif", ".mp4")
OUTPUTS = (".png", *FILMS, ".html", ".vdb")
"""Suffixes that ``--out`` accepts."""

_SCALE_POINTS = 48  # points along the box's longest side on which the scale of all frames is found
_DEPTH = 6.0  # largest optical depth of a volume as it is shown


@dataclass(frozen=True)
class InspectRequest:
    """Request for :func:`inspect_run`, with the arguments of ``neuprim inspect``.

    Attributes:
        conditions: name -> text, e.g. ``{"time": "0:1"}``.
        grid: number of points at which the density is sampled along the longest side of the box.
        box: (2, 3) box in the coordinates of the run's data; None for the box of the ground truth, or of the model if
            there is no ground truth.
        levels: extinctions at which to draw isosurfaces, 1/scene unit.
        against: ground truth to compare with: an OpenVDB file or folder, or "scene".
        up: upward axis, "x", "y" or "z"; None for the scene's setting, or z.
        overwrite: whether existing files may be replaced.
    """

    run: Path | StoredRun  # run directory, or a loaded run
    show: Sequence[str] = ("volume",)  # names of inspectors
    conditions: Mapping[str, str] = field(default_factory=dict)
    grid: int = 128
    box: np.ndarray | None = None
    levels: tuple[float, ...] = ()
    primitive: int | None = None  # row of the primitive to show alone
    against: str | None = None
    out: Path | None = None  # file to write; None to open a window
    size: tuple[int, int] | None = None  # (width, height) of pictures, pixels
    up: str | None = None
    overwrite: bool = False


def inspect_run(request: InspectRequest, events: Events = ignore_run_event) -> list[Path]:
    """Show a run's density in a window, or write files and return them.

    Several frames become numbered files (.png, .vdb), an animation (.webp, .gif, .mp4), or a slider in a page or a
    window.

    Args:
        events: function that is called with notes for the user: ground truth, errors of each frame, grid, warnings.

    Raises:
        NeuprimError: arguments or files are wrong, or files exist already.
        PluginError: an inspector returned something that cannot be shown.
        BackendUnavailable: pyvista is missing, VTK cannot render here, or there is no display and no ``out``.
    """
    kind = "" if request.out is None else request.out.suffix.lower()
    if request.out is not None and kind not in OUTPUTS:
        raise ConfigError(f"--out {request.out}: expected a name that ends in {', '.join(OUTPUTS)}")
    inspectors = [_load_run_inspector(name) for name in dict.fromkeys(request.show)]
    if request.out is None and not has_display():
        raise BackendUnavailable("there is no display to open a window on; give --out FILE.png, .webp, .html or .vdb")
    if kind not in (".html", ".vdb"):
        require_pyvista()
        if kind:
            prepare_headless()
    if request.against is None and any(i.shows == "both" for i in inspectors):
        raise ConfigError("--show difference: there is no ground truth; give --against FILE.vdb, DIR or scene")
    film = _RunFrames(request, events)
    if film.channels.hides_channels and any(i.shows == "model" for i in inspectors):
        events(Note(f"shown: {film.channels.display_text}"))
    if request.out is not None and kind == ".html":
        write_inspection_page(request.out, film.name, film.up, len(film), film.frame, inspectors)
        return [request.out]
    if request.out is not None and kind == ".vdb":
        return _write_run_frames(request.out, film, lambda path, frame: write_inspection_vdb(path, frame, film.world))
    window = Window(list_inspection_panels(inspectors, request.against is not None), film.up, bool(kind), request.size)
    try:
        if request.out is not None:
            return _write_run_pictures(request.out, film, window)
        window.interact(len(film), film.frame)
        return []
    finally:
        window.close()


def _load_run_inspector(name: str) -> Inspector:
    """Load an inspector, which makes the layers to draw, by name.

    An inspector of a plugin is wrapped: its errors name the plugin's package, and its layers are checked.
    """
    inspector, source = INSPECTORS.load(name), find_plugin_source(INSPECTORS, name)
    if source.built_in:
        return inspector

    def layers(frame: InspectionFrame) -> Sequence[Layer]:
        with attribute_errors(source):
            found = inspector.layers(frame)
        problem = validate_inspection_layers(found)
        if problem is not None:
            raise PluginError(f"{source.label}: {problem}")
        return found

    return replace(inspector, name=name, layers=layers)


def _output_paths(out: Path | None, numbers: Sequence[int]) -> list[Path]:
    """List the files to write: one picture or OpenVDB file per frame, by its number, or a single film or page."""
    if out is None:
        return []
    suffix = out.suffix.lower()
    if len(numbers) == 1 or suffix not in (".png", ".vdb"):
        return [out]
    return [out.with_name(f"{out.stem}_{number:04d}{suffix}") for number in numbers]


def _write_run_pictures(out: Path, film: _RunFrames, window: Window) -> list[Path]:
    def draw(frame: InspectionFrame) -> Tensor:
        window.draw(frame)
        return torch.from_numpy(window.picture().copy()).float() / 255.0

    if out.suffix.lower() == ".png":
        return _write_run_frames(out, film, lambda path, frame: images.write_png(path, draw(frame)))
    out.parent.mkdir(parents=True, exist_ok=True)
    write_animation(out, [draw(film.frame(i)) for i in range(len(film))], min(24.0, max(len(film) / 4.0, 4.0)))
    return [out]


def _write_run_frames(out: Path, film: _RunFrames, write: Callable[[Path, InspectionFrame], Any]) -> list[Path]:
    out.parent.mkdir(parents=True, exist_ok=True)
    for i, path in enumerate(film.paths):
        write(path, film.frame(i))
    return film.paths


class _RunFrames:
    """The frames that an inspection shows, computed one at a time, with one box and one colour scale for all frames."""

    def __init__(self, request: InspectRequest, events: Events) -> None:
        run = open_run(request.run)
        self.model, self.world = run.model, run.world
        self.truth: DensityTruth | None = None
        self.channels = run.channels
        up = request.up or run.scene.get("up")
        self.up = up if up in ("x", "y", "z") else "z"
        self.request, self.name = request, run.directory.resolve().name
        wanted = read_inspected_conditions(run.task.conditions, request.conditions, lambda text: events(Note(text)))
        pairs: list[tuple[Conditions, int]] = [(conditions, -1) for conditions in wanted]
        if request.against is not None:
            self.truth, words = open_inspection_truth(request.against, run.volume)
            events(Note(words))
            pairs = pair_inspected_frames(wanted, self.truth)
        self.pairs = pairs
        self.paths = _output_paths(request.out, frame_numbers(run.header, [conditions for conditions, _ in pairs]))
        for path in self.paths:
            refuse_existing(path, request.overwrite)
        if request.box is not None:
            box = self.world.scene_box(request.box)
        elif self.truth is not None:
            box = np.asarray(self.truth.bounds.numpy())
        else:
            box = find_inspection_box(self.model, wanted)
        if request.grid**3 > POINTS_LIMIT:
            most = round(POINTS_LIMIT ** (1 / 3))
            raise ConfigError(f"--grid {request.grid}: expected at most {most} points per side")
        self.matrix, self.shape = box_lattice(box, request.grid)
        self.numbers = [self._compare_frame(i, events) for i in range(len(self))]
        self.top, self.gain, self.focus = self._find_scale(box)
        low, high = ([round(x, 4) for x in corner] for corner in self.world.world_box(np.asarray(box)).tolist())
        units = "scene units" if self.world.identity else "in the coordinates of the run's data"
        on = f"{' x '.join(map(str, self.shape))} points from {low} to {high} {units}"
        clamp = "in 1/scene unit, each primitive clamped at 0 from below"
        events(Note(f"extinction of {self.model.count} primitives on {on}, {clamp}"))

    def __len__(self) -> int:
        return len(self.pairs)

    def _compare_frame(self, index: int, events: Events) -> dict[str, float] | None:
        """Return the errors of the frame's density at the points of the ground truth; None without ground truth."""
        if self.truth is None:
            return None
        conditions, number = self.pairs[index]
        numbers = measure_density_errors(self.model, conditions, self.truth, number)
        words = "nothing to compare with" if numbers is None else "  ".join(f"{k} {v:.4f}" for k, v in numbers.items())
        events(Note(f"{self.truth.frames[number].name}  {describe_inspected_conditions(conditions)}  {words}"))
        return numbers

    def _find_scale(self, box: np.ndarray) -> tuple[float, float, tuple[float, ...]]:
        """Return (top, gain, focus) for all frames, from a coarse grid in the box.

        ``top`` is the end of the extinction's colour scale, 1/scene unit, and ``gain`` a factor on the opacity of drawn
        volumes. ``focus`` is the centroid (x, y, z) of the ground truth's or the model's extinction, scene units.
        """
        matrix, shape = box_lattice(box, _SCALE_POINTS)
        most, depth, total = 0.0, 0.0, np.zeros(shape)
        for conditions, number in self.pairs:
            grids = [density_grid(self.model, conditions, matrix, shape).numpy()]
            if self.truth is not None:
                grids.append(self.truth.grid(number, matrix, shape).numpy())
            total += grids[-1]
            for grid in grids:
                filled = grid[grid > 0]
                most = max(most, float(np.quantile(filled, 0.995))) if filled.size else most
                depth = max(depth, *(float(grid.sum(axis).max()) * float(matrix[0, 0]) for axis in range(3)))
        weights = total + 1e-12 * (total.max() or 1.0)
        index = [
            float(np.average(np.arange(n), weights=weights.sum(tuple({0, 1, 2} - {a})))) for a, n in enumerate(shape)
        ]
        focus = matrix[:3, :3].numpy() @ np.array(index) + matrix[:3, 3].numpy()
        return _round_scale_of_run_frames(most), _DEPTH / depth if depth > 0 else 1.0, tuple(focus.tolist())

    def frame(self, index: int) -> InspectionFrame:
        """Return frame ``index`` of the inspection. The frame computes its voxel grids on first use."""
        conditions, number = self.pairs[index]
        truth = self.truth
        return InspectionFrame(
            self.model,
            conditions,
            describe_inspected_conditions(conditions),
            self.matrix,
            self.shape,
            self.top,
            self.gain,
            self.focus,
            channels=self.channels,
            levels=self.request.levels,
            primitive=self.request.primitive,
            truth=None if truth is None else lambda: truth.grid(number, self.matrix, self.shape).numpy(),
            truth_name="" if truth is None else truth.frames[number].name,
            numbers=self.numbers[index],
        )


def _round_scale_of_run_frames(value: float) -> float:
    """Round ``value`` up to two significant digits, for the end of a colour scale; return 1 unless it is positive."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.6g}")
