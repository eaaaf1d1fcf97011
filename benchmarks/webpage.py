"""Pages of models: how exact they are, how large, how long a frame is prepared.

    python benchmarks/webpage.py ROW=RUN_DIR … [--views 8] [--docs]
    python benchmarks/webpage.py --prepare [--docs]
    python benchmarks/webpage.py --print [--docs]

ROW=RUN_DIR: a name in the table, and a finished run whose data are at hand. Held-out views of it, evenly spread, are
drawn by its page, with every bit of its numbers, in headless Chromium and read back as floats, and by the run's
backend, without a limit of transmittance (blending cannot stop a ray) and with the run's own: largest differences,
colours as the model has them. Sizes and errors are those of pages at levels 0, 1 and 3, pictures of held-out views
among them.
Chords are the pixels of the silhouettes in the first view at 1280 x 720.

--prepare: milliseconds of the worker, preparation and sort, for models of 5,000 and 20,000 primitives where the
trainings of `solids`, `smoke_fire` and `lit_solids` begin: the median of 60 frames after 60, while the camera moves,
and while time or the light moves, too. The time in which the page draws shadow maps is not included.

Needs a Chromium and the package playwright. Results go to benchmarks/results/webpage.json, by row and scene; --docs
puts both tables into docs/results/performance.md.
"""

from __future__ import annotations

import math
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser
from shared.tables import (
    RESULT_PAGES,
    RESULTS,
    ROOT,
    Run,
    Table,
    between_markers,
    make_table,
    read_record,
    update_record,
)
from torch import Tensor

from neuprim.config import compose
from neuprim.core.cameras import Camera, orbit
from neuprim.core.compute.threads import cpu_name
from neuprim.core.conditions import read_conditions
from neuprim.core.extensions import TrainedModel
from neuprim.core.render import render
from neuprim.runs.export import export_run
from neuprim.runs.fit import prepare_training
from neuprim.runs.open import open_run
from neuprim.webpage import Condition, PageScene, make_model_webpage
from neuprim.webpage.model_page import webpage_camera_numbers

sys.path.insert(0, str(ROOT))

from tests.browsers import Tab, browser, open_tab

RECORD = RESULTS / "webpage.json"
LEVELS = (0, 1, 3)
WIDE, HIGH = 1280, 720
COUNTS = (5_000, 20_000)
FRAMES = 60
STARTS: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "solids": (("task=static", "scene=solids", "scene.size=64"), {}),
    "smoke_fire": (
        ("task=dynamic", "scene=smoke_fire", "scene.size=32", "scene.timesteps=8", "scene.cameras=8"),
        {"time": f"0:1:{FRAMES}"},
    ),
    "lit smoke_fire": (
        ("task=dynamic", "scene=smoke_fire", "scene.lights=4", "scene.size=32", "scene.timesteps=8", "scene.cameras=8"),
        {"light": f"orbit:4:40:{FRAMES}"},
    ),
    "lit_solids": (("task=relight", "scene=lit_solids", "scene.size=32"), {"light": f"orbit:4:40:{FRAMES}"}),
}
"""Scene -> words, and what moves, as `neuprim render` takes it. Images are small, as none is looked at."""


# ---------------------------------------------------------------- exactness, size and work


def measure_pages(chromium: Any, run_dir: Path, count: int, folder: Path) -> dict[str, Any]:
    """Everything about the pages of one run."""
    run = open_run(run_dir)
    found: dict[str, Any] = {"task": run.task.name, "primitives": run.model.count, "levels": {}}
    pages = {level: folder / f"{run_dir.name}_{level}.html" for level in LEVELS}
    for level, path in pages.items():
        report = export_run(run_dir, "html", path, (f"level={level}",), overwrite=True)
        found["levels"][str(level)] = {"bytes": path.stat().st_size, **report.errors}
    with open_tab(chromium, pages[0]) as tab:
        found["views"] = list(compare_views(tab, run, count))
        found["chords"] = count_chords(tab, run)
        assert not tab.faults, tab.faults
    return found


def compare_views(tab: Tab, run: TrainedModel, count: int) -> Iterator[dict[str, Any]]:
    """The largest difference in each of some held-out views."""
    views, background = run.dataset().test, torch.tensor(run.header["background"])
    for index in sorted({k * len(views) // count for k in range(count)}):
        view = views.view(index)
        pixels = torch.from_numpy(tab.numbers(view.camera, view.conditions))
        got = pixels[..., :3] + pixels[..., 3:] * background.double()
        row: dict[str, Any] = {"view": view.name, "brightest": float(got.max())}
        for key, least in (("whole", 0.0), ("configured", run.settings.transmittance_min)):
            settings = replace(run.settings, transmittance_min=least, samples=1, sort="center")
            with torch.no_grad():
                wanted = render(run.model, view.camera, view.conditions, settings, background).rgb
            row[key] = float((got - wanted.double()).abs().max())
        yield row


def count_chords(tab: Tab, run: TrainedModel) -> int:
    """Pixels of all silhouettes of the first held-out view: ellipses of half axes hx and hy on sheared axes, none more
    than the screen."""
    view = run.dataset().test.view(0)
    scale = HIGH / view.camera.height
    fx, fy = scale * view.camera.fx, scale * view.camera.fy
    camera = replace(view.camera, fx=fx, fy=fy, cx=WIDE / 2, cy=HIGH / 2, width=WIDE, height=HIGH)
    halves = tab.page.evaluate(_HALVES, [webpage_camera_numbers(camera), as_lists(view.conditions)])
    return round(sum(min(math.pi * hx * hy, WIDE * HIGH) if hx >= 0 else WIDE * HIGH for hx, hy in halves))


_HALVES = """async ([camera, values]) => {
  const { rows, count } = await probe.frame(camera, values), halves = [];
  for (let n = 0; n < count; n++) halves.push([rows[ROW * n + 35], rows[ROW * n + 36]]);
  busy = false;
  return halves;
}"""


def as_lists(conditions: Mapping[str, Tensor]) -> dict[str, Any]:
    return {name: value.double().tolist() for name, value in conditions.items()}


# ---------------------------------------------------------------- preparation


def measure_preparation(chromium: Any, scene: str, count: int, folder: Path) -> dict[str, Any]:
    """Milliseconds of the worker. The model has not learned yet: how much work it is does not depend on what it would
    have."""
    words, sweep = STARTS[scene]
    words = (*words, f"model.primitives={count}", "train.population.grow_from=1")
    fitted = prepare_training(compose(words, check_output=False))
    fitted.unlock_bands()
    model, view, specs = fitted.model, fitted.dataset.test.view(0), fitted.task.conditions
    conditions = [Condition(spec, view.conditions[spec.name]) for spec in specs]
    path = folder / f"{scene}_{count}.html"
    page = make_model_webpage(scene, model, (0, 1, 2), fitted.config.renderer, PageScene(conditions=conditions))
    path.write_text(page.text, encoding="utf-8")
    middle = model.params["means"].detach().mean(0)
    away = float((view.camera.position - middle).norm())
    cameras = orbit(view.camera, middle, fitted.dataset.up, away, 0.3, FRAMES)
    still = [dict(view.conditions) for _ in cameras]
    moved = read_conditions(specs, sweep)
    moving = [values | {name: found[k] for name, found in moved.items()} for k, values in enumerate(still)]
    result: dict[str, Any] = {"scene": scene, "primitives": model.count}
    with open_tab(chromium, path) as tab:
        result["camera"] = time_frames(tab, cameras, still)
        if moved:
            result["conditions"] = time_frames(tab, cameras, moving)
        assert not tab.faults, tab.faults
    return result


def time_frames(tab: Tab, cameras: Sequence[Camera], conditions: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """Median and fastest frame, and how many primitives a frame has; frames before are for the browser's compiler."""
    frames = [
        [webpage_camera_numbers(camera), as_lists(values)] for camera, values in zip(cameras, conditions, strict=True)
    ]
    rounds = [tab.page.evaluate(_TIMES, frames) for _ in range(2)]
    times = [one["milliseconds"] for one in rounds[-1]]
    return {
        "median": statistics.median(times),
        "fastest": min(times),
        "drawn": statistics.median(one["count"] for one in rounds[-1]),
    }


_TIMES = """async frames => {
  const found = [];
  for (const [camera, values] of frames) {
    const { milliseconds, count } = await probe.frame(camera, values);
    busy = false;
    found.push({ milliseconds, count });
  }
  return found;
}"""


# ---------------------------------------------------------------- tables


def page_table(runs: Mapping[str, Run]) -> Table:
    def worst(key: str) -> Callable[[tuple[str, Run]], str]:
        return lambda row: f"{max(view[key] for view in row[1]['views']):.1e}"

    def size(level: int) -> Callable[[tuple[str, Run]], str]:
        def cell(row: tuple[str, Run]) -> str:
            found = row[1]["levels"][str(level)]
            return f"{found['bytes'] / 1e6:.2f} MB" + (f", {found['psnr']:.1f} dB" if "psnr" in found else "")

        return cell

    columns = {
        "run": lambda row: f"`{row[0]}`, {len(row[1]['views'])} views",
        "primitives": lambda row: f"{row[1]['primitives']:,}",
        "brightest value": lambda row: f"{max(view['brightest'] for view in row[1]['views']):.2f}",
        "without `transmittance_min`": worst("whole"),
        "as configured": worst("configured"),
        **{f"{'page, ' if level == 0 else ''}level {level}": size(level) for level in LEVELS},
        "chords at 1280×720": lambda row: f"{row[1]['chords'] / 1e6:.1f} M",
    }
    return make_table(columns, runs.items())


def prepare_table(rows: Sequence[Run]) -> Table:
    columns = {
        "scene": lambda row: f"`{row['scene']}`",
        "primitives": lambda row: f"{row['primitives']:,}",
        "drawn": lambda row: f"{row['camera']['drawn']:,.0f}",
        "only the camera moves": lambda row: f"{row['camera']['median']:.1f} ms",
        "time or light moves": lambda row: f"{row['conditions']['median']:.1f} ms" if "conditions" in row else "",
    }
    return make_table(columns, rows)


def main() -> None:
    parser = make_parser(__doc__, "--docs", "--print")
    parser.add_argument("runs", type=lambda text: text.split("=", 1), nargs="*", metavar="ROW=RUN_DIR")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--prepare", action="store_true")
    args = parser.parse_args()
    record = {"runs": {}, "prepare": []} | read_record(RECORD)
    if not args.only_print:
        with browser() as chromium, tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            for row, run in args.runs:
                record["runs"][row] = measure_pages(chromium, Path(run), args.views, folder)
            if args.prepare:
                starts = [(scene, count) for scene in STARTS for count in COUNTS]
                record["prepare"] = [measure_preparation(chromium, *start, folder) for start in starts]
        update_record(RECORD, **record | {"cpu": cpu_name()})
    tables = {"webpage": page_table(record["runs"]), "webpage-prepare": prepare_table(record["prepare"])}
    if args.docs:
        for marker, table in tables.items():
            between_markers(RESULT_PAGES / "performance.md", marker, str(table))


if __name__ == "__main__":
    main()
