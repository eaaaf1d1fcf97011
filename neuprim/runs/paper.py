"""The paper's tables, and the runs that stand for their rows: ``neuprim bench paper``.

Runs are compared by ``psnr``, ``ssim_3dgs`` and ``lpips_3dgs``, the rules by which such tables are made. Numbers of a
run are those of its last checkpoint; the paper's are the best of a run on the test views.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from neuprim.config import RunConfig, compose
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.metrics import metric_from_json

_OWN_NAMES = {"psnr": "psnr", "ssim": "ssim_3dgs", "lpips": "lpips_3dgs"}
_UNITS = {"s": 1, "m": 60, "h": 3600}

Figures = Mapping[str, float | None]
"""psnr, ssim, lpips and primitives of one scene; None for one that is not there."""


@dataclass(frozen=True)
class PaperRow:
    """One of the paper's models.

    Attributes:
        name: what chooses it.
        preset: of the static task, that stands for it.
        figures: by scene, the paper's.
        beside: what the paper puts beside it; "" for nothing. beside_figures: its figures by scene.
    """

    name: str
    preset: str
    figures: Mapping[str, Figures]
    beside: str
    beside_figures: Mapping[str, Figures]


@dataclass(frozen=True)
class PaperTable:
    """Tables of one data set.

    Attributes:
        numbers: theirs in the paper's appendix.
        loader: the scene of the static task that reads the data.
        scenes: in the paper's order, lower case.
        images: by scene, the folder of images to take where there is one.
    """

    title: str
    numbers: tuple[int, ...]
    loader: str
    scenes: tuple[str, ...]
    images: Mapping[str, str]
    rows: tuple[PaperRow, ...]


@dataclass(frozen=True)
class PlannedRun:
    """A run that stands for a row in one scene."""

    table: PaperTable
    row: PaperRow
    scene: str
    config: RunConfig


def load_paper_run_tables() -> list[PaperTable]:
    """All of the paper's tables, as shipped."""
    text = (resources.files(__package__) / "paper_tables.yaml").read_text(encoding="utf-8")
    return [_parse_paper_run_table(entry) for entry in yaml.safe_load(text)]


def _parse_paper_run_table(entry: Mapping[str, Any]) -> PaperTable:
    scenes = tuple(entry["scenes"])

    def figures(found: Mapping[str, Any]) -> dict[str, Figures]:
        kinds = [kind for kind in (*_OWN_NAMES, "primitives") if kind in found]
        return {scene: {kind: found[kind][i] for kind in kinds} for i, scene in enumerate(scenes)}

    rows = []
    for row in entry["rows"]:
        other = row.get("beside", {"name": ""})
        rows.append(PaperRow(row["name"], row["preset"], figures(row), other["name"], figures(other)))
    images = dict(zip(scenes, entry.get("images", ()), strict="images" in entry))
    return PaperTable(entry["title"], tuple(entry["tables"]), entry["loader"], scenes, images, tuple(rows))


def paper_run_budget_overrides(budget: str) -> list[str]:
    """Overrides of a budget: "full", the preset's own steps, or a run's seconds of training as 90s, 10m or 2h.

    Raises:
        ConfigError: it is something else.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", budget)
    if budget == "full":
        return []
    if match is None or float(match[1]) == 0:
        raise ConfigError(f"--budget {budget}: expected full, or the training time of a run such as 90s, 10m or 2h")
    return [f"train.max_seconds={float(match[1]) * _UNITS[match[2]]:g}"]


def plan_paper_runs(
    data: Path,
    tables: Sequence[PaperTable],
    scenes: Sequence[str],
    rows: Sequence[str],
    budget: str,
    seeds: int,
    out: Path,
    words: Sequence[str],
) -> list[PlannedRun]:
    """Every run of the rows whose data are there, checked before one starts.

    Args:
        data: holds a folder per scene, named like it in any case.
        scenes: those to take; empty for all.
        rows: names of rows; empty for all.
        seeds: runs of each, with the seeds from 0.
        out: gets a run directory for each.
        words: ``key=value`` settings over the protocol's.

    Raises:
        ConfigError: no such scene, row or folder, nothing found, or a setting that is refused.
    """
    every_scene = [scene for table in tables for scene in table.scenes]
    every_row = [row.name for table in tables for row in table.rows]
    for flag, given, known in (("--scenes", scenes, every_scene), ("--rows", rows, every_row)):
        for name in given:
            if name not in known:
                raise ConfigError(f"{flag} {name}: not in these tables{nearest(name, known)}")
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    folders = {entry.name.casefold(): entry for entry in sorted(data.iterdir()) if entry.is_dir()}
    common = [*paper_run_budget_overrides(budget), *words]
    planned = []
    for table in tables:
        for scene in (s for s in table.scenes if not scenes or s in scenes):
            folder = folders.get(scene) or folders.get(f"{scene}s")
            if folder is None and scenes:
                raise ConfigError(f"--scenes {scene}: {data} has no folder {scene}")
            if folder is None:
                continue
            own = ["task=static", f"scene={table.loader}", f"scene.path='{folder}'"]
            if scene in table.images and (folder / table.images[scene]).is_dir():
                own.append(f"scene.images={table.images[scene]}")
            for row in (r for r in table.rows if not rows or r.name in rows):
                for seed in range(seeds):
                    place = f"output_dir='{out / f'{scene}-{row.name}-{budget}-seed{seed}'}'"
                    config = compose([*own, f"preset={row.preset}", f"seed={seed}", place, *common])
                    planned.append(PlannedRun(table, row, scene, config))
    if not planned:
        raise ConfigError(f"--data {data}: no folder named like a scene; expected one of {', '.join(every_scene)}")
    return planned


def compare_run_with_paper(
    planned: PlannedRun, metrics: Mapping[str, Any]
) -> Iterator[tuple[str, float | None, float | None, float | None]]:
    """(what, ours, the paper's, that of what the paper puts beside it) of a finished run; None for what is not there.

    LPIPS of another network than the paper's tools', VGG, is left out.
    """
    paper, beside = planned.row.figures[planned.scene], planned.row.beside_figures[planned.scene]
    for kind, name in _OWN_NAMES.items():
        ours = metric_from_json(metrics, name) if kind != "lpips" or metrics.get("lpips_network") == "vgg" else None
        yield kind.upper(), ours, paper[kind], beside.get(kind)
    yield "primitives", float(metrics["primitives"]), paper.get("primitives"), None
