"""``neuprim bench paper``: compare runs with the tables of the paper that introduced the method.

Runs are compared by ``psnr``, ``ssim_3dgs`` and ``lpips_3dgs``, which are computed by the conventions of such tables. A
run is measured at its last checkpoint. The paper reports the best checkpoint on the test views.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from neuprim.config import RunConfig, compose
from neuprim.config.command_settings import parse_duration_setting
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.metrics import metric_from_json

_OWN_NAMES = {"psnr": "psnr", "ssim": "ssim_3dgs", "lpips": "lpips_3dgs"}


@dataclass(frozen=True)
class PlannedRun:
    """A run that reproduces one table row for one scene; :func:`load_paper_run_tables` returns tables and rows."""

    table: Mapping[str, Any]
    row: Mapping[str, Any]
    scene: str
    config: RunConfig


def load_paper_run_tables() -> list[dict[str, Any]]:
    """Load the paper's tables from ``paper_tables.yaml``. Lists in a row have one number per scene, in order."""
    tables: list[dict[str, Any]] = yaml.safe_load(
        (resources.files(__package__) / "paper_tables.yaml").read_text(encoding="utf-8")
    )
    return tables


def find_paper_figure(table: Mapping[str, Any], row: Mapping[str, Any], scene: str, kind: str) -> float | None:
    """Return the paper's psnr, ssim, lpips or primitives (``kind``) for a scene and table row; None if missing."""
    figure: float | None = row[kind][table["scenes"].index(scene)] if kind in row else None
    return figure


def plan_paper_runs(
    data: Path,
    tables: Sequence[Mapping[str, Any]],
    scenes: Sequence[str],
    rows: Sequence[str],
    budget: str | None,
    seeds: int,
    out: Path,
    words: Sequence[str],
) -> list[PlannedRun]:
    """Plan a run for each table row and scene whose data exist. All configurations are checked before a run starts.

    Args:
        data: folder with a folder per scene, named like the scene in upper or lower case.
        scenes: names of scenes; empty for all.
        rows: names of rows; empty for all.
        budget: training time of a run as 90s, 10m or 2h; None for the preset's own steps.
        seeds: number of runs per row and scene, with seeds from 0.
        out: folder for the run directories.
        words: overrides ``key=value``, on top of those of the table and row.

    Raises:
        ConfigError: a scene, row or folder does not exist, no data were found, or a setting is refused.
    """
    every_scene = [scene for table in tables for scene in table["scenes"]]
    every_row = [row["name"] for table in tables for row in table["rows"]]
    for flag, given, known in (("--scenes", scenes, every_scene), ("--rows", rows, every_row)):
        for name in given:
            if name not in known:
                raise ConfigError(f"{flag} {name}: not in the chosen tables{nearest(name, known)}")
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    folders = {entry.name.casefold(): entry for entry in sorted(data.iterdir()) if entry.is_dir()}
    common = list(words)
    if budget is not None:
        common.insert(0, f"train.max_seconds={parse_duration_setting(budget, f'budget={budget}'):g}")
    planned = []
    for table in tables:
        images = dict(zip(table["scenes"], table.get("images", ()), strict="images" in table))
        for scene in (s for s in table["scenes"] if not scenes or s in scenes):
            folder = folders.get(scene) or folders.get(f"{scene}s")
            if folder is None and scenes:
                raise ConfigError(f"--scenes {scene}: {data} has no folder {scene}")
            if folder is None:
                continue
            own = ["task=static", f"scene={table['loader']}", f"scene.path='{folder}'"]
            if scene in images and (folder / images[scene]).is_dir():
                own.append(f"scene.images={images[scene]}")
            for row in (r for r in table["rows"] if not rows or r["name"] in rows):
                for seed in range(seeds):
                    name = f"{scene}-{row['name']}-{budget or 'full'}-seed{seed}"
                    place = f"output_dir='{out / name}'"
                    config = compose([*own, f"preset={row['preset']}", f"seed={seed}", place, *common])
                    planned.append(PlannedRun(table, row, scene, config))
    if not planned:
        raise ConfigError(f"--data {data}: no folder named like a scene; expected one of {', '.join(every_scene)}")
    return planned


def compare_run_with_paper(
    planned: PlannedRun, metrics: Mapping[str, Any]
) -> Iterator[tuple[str, float | None, float | None, float | None]]:
    """Yield (metric, value of the run, value in the paper, value of the paper's baseline method) of a finished run.

    Missing values are None. The run's LPIPS counts as missing unless it was measured with VGG, like the paper's LPIPS.
    """
    table, row, scene = planned.table, planned.row, planned.scene
    for kind, name in _OWN_NAMES.items():
        ours = metric_from_json(metrics, name) if kind != "lpips" or metrics.get("lpips_network") == "vgg" else None
        beside = find_paper_figure(table, row.get("beside", {}), scene, kind)
        yield kind.upper(), ours, find_paper_figure(table, row, scene, kind), beside
    yield "primitives", float(metrics["primitives"]), find_paper_figure(table, row, scene, "primitives"), None
