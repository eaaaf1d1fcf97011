"""The paper's tables, and the runs that stand for their rows: ``neuprim bench paper``.

What a run is compared by are its ``psnr``, and its ``ssim_3dgs`` and ``lpips_3dgs``, the rules by which tables like
these are made. It is the last checkpoint of one seed; the paper's are the best of a run on the test views, whose number
of seeds it does not say.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from neuprim.config import RunConfig, compose
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.metrics import from_json
from neuprim.runs.fit import compile_kernels, prepare_training, use_one_torch_thread

_KINDS = ("psnr", "ssim", "lpips")
_OURS = {"psnr": "psnr", "ssim": "ssim_3dgs", "lpips": "lpips_3dgs"}
_UNITS = {"s": 1, "m": 60, "h": 3600}


@dataclass(frozen=True)
class Figures:
    """Numbers of one scene; None for one that is not there."""

    psnr: float | None
    ssim: float | None
    lpips: float | None
    primitives: int | None = None


@dataclass(frozen=True)
class Row:
    """One of the paper's models.

    Attributes:
        name: what chooses it.
        preset: of the static task, that stands for it.
        figures: by scene, the paper's.
        beside: what the paper puts beside it, and that one's figures by scene; an empty name for nothing.
    """

    name: str
    preset: str
    figures: Mapping[str, Figures]
    beside: tuple[str, Mapping[str, Figures]]


@dataclass(frozen=True)
class Table:
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
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Planned:
    """A run that stands for a row in one scene."""

    table: Table
    row: Row
    scene: str
    config: RunConfig


def tables() -> list[Table]:
    """All of the paper's tables, as shipped."""
    text = (resources.files(__package__) / "paper_tables.yaml").read_text(encoding="utf-8")
    return [_table(entry) for entry in yaml.safe_load(text)]


def _table(entry: Mapping[str, Any]) -> Table:
    scenes = tuple(entry["scenes"])

    def figures(found: Mapping[str, Any]) -> dict[str, Figures]:
        columns = [found[kind] for kind in _KINDS] + [found.get("primitives", [None] * len(scenes))]
        return {scene: Figures(*values) for scene, *values in zip(scenes, *columns, strict=True)}

    rows = []
    for row in entry["rows"]:
        beside = row.get("beside")
        rows.append(
            Row(row["name"], row["preset"], figures(row), (beside["name"], figures(beside)) if beside else ("", {}))
        )
    images = dict(zip(scenes, entry.get("images", ()), strict="images" in entry))
    return Table(entry["title"], tuple(entry["tables"]), entry["loader"], scenes, images, tuple(rows))


def budget_words(budget: str) -> list[str]:
    """Settings of a budget: "full", the preset's own steps, or a run's seconds of training as 90s, 10m or 2h.

    Raises:
        ConfigError: it is something else.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", budget)
    if budget == "full":
        return []
    if match is None or float(match[1]) == 0:
        raise ConfigError(f"--budget {budget}: expected full, or the training time of a run such as 90s, 10m or 2h")
    return [f"train.max_seconds={float(match[1]) * _UNITS[match[2]]:g}"]


def plan(
    data: Path,
    chosen: Sequence[Table],
    scenes: Mapping[str, str],
    rows: Sequence[str],
    budget: str,
    seeds: int,
    out: Path,
    words: Sequence[str],
) -> list[Planned]:
    """Every run of the rows whose data are there, checked before one starts.

    Args:
        data: holds a folder per scene, named like it in any case.
        scenes: those to take, and the names of their folders; empty for all.
        rows: names of rows; empty for all.
        seeds: runs of each, with the seeds from 0.
        out: gets a run directory for each.
        words: ``key=value`` settings over the protocol's.

    Raises:
        ConfigError: no such scene, row or folder, nothing found, or a setting that is refused.
    """
    _known("--scenes", scenes, [s for t in chosen for s in t.scenes])
    _known("--rows", rows, [r.name for t in chosen for r in t.rows])
    if not data.is_dir():
        raise ConfigError(f"--data {data}: no such folder")
    folders = {entry.name.casefold(): entry for entry in sorted(data.iterdir()) if entry.is_dir()}
    found = []
    for table in chosen:
        for scene in (s for s in table.scenes if not scenes or s in scenes):
            folder = folders.get(scenes.get(scene, scene).casefold()) or folders.get(f"{scene}s")
            if folder is None:
                if scenes:
                    raise ConfigError(f"--scenes {scene}: {data} has no folder {scenes[scene]}")
                continue
            for row in (r for r in table.rows if not rows or r.name in rows):
                for seed in range(seeds):
                    name = f"{scene}-{row.name}-{budget}-seed{seed}"
                    own = [
                        f"scene={table.loader}",
                        f"scene.path='{folder}'",
                        f"preset={row.preset}",
                        f"seed={seed}",
                        f"output_dir='{out / name}'",
                    ]
                    if scene in table.images and (folder / table.images[scene]).is_dir():
                        own.append(f"scene.images={table.images[scene]}")
                    found.append(
                        Planned(table, row, scene, compose(["task=static", *own, *budget_words(budget), *words]))
                    )
    if not found:
        raise ConfigError(
            f"--data {data}: no folder named like a scene; expected one of "
            f"{', '.join(s for t in chosen for s in t.scenes)}"
        )
    return found


def _known(flag: str, given: Sequence[str] | Mapping[str, str], names: Sequence[str]) -> None:
    for name in given:
        if name not in names:
            raise ConfigError(f"{flag} {name}: not in these tables{nearest(name, names)}")


def pace(planned: Planned, steps: int = 8) -> float:
    """Seconds that a step takes at the start of a run, on this machine; a population that grows makes later ones
    slower."""
    fitted = prepare_training(planned.config)
    compile_kernels(fitted.trainer)
    with use_one_torch_thread():
        fitted.trainer.train_step()
        begin = time.perf_counter()
        for _ in range(steps):
            fitted.trainer.train_step()
        return (time.perf_counter() - begin) / steps


def compared(
    planned: Planned, metrics: Mapping[str, Any]
) -> Iterator[tuple[str, float | None, float | None, float | None]]:
    """(what, ours, the paper's, that of what the paper puts beside it) of a finished run; None for what is not there.

    LPIPS of another network than the paper's tools', VGG, is left out.
    """
    theirs, other = planned.row.figures[planned.scene], planned.row.beside[1].get(planned.scene)
    for kind in _KINDS:
        ours = from_json(metrics, _OURS[kind]) if kind != "lpips" or metrics.get("lpips_network") == "vgg" else None
        yield kind.upper(), ours, getattr(theirs, kind), None if other is None else getattr(other, kind)
    yield "primitives", float(metrics["primitives"]), theirs.primitives, None
