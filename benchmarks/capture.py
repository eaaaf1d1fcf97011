"""Captures for relighting: how many photographs, and how much `scene.refine` wins back where lights or cameras are only
roughly known.

    python benchmarks/capture.py DIR [--steps 5000] [--jobs 1] [--docs] [--print]

DIR holds a data set in the layout of `scene=olat`, of which the first COUNTS training views are used, or all; then
cameras are shifted, or lights are shifted and their intensities multiplied, by normal noise of a root mean square given
in percent of their distance from the origin; the test views stay as they are and judge. One seed, one thread, 6,000
primitives. Results go to benchmarks/results/capture.json after every run, and only what is missing is run; --docs puts
the tables between the markers of docs/results/relighting.md, --print runs nothing.
"""

from __future__ import annotations

import json
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from shared.arguments import make_parser
from shared.tables import RESULT_PAGES, RESULTS, Record, Table, between_markers, read_record
from shared.trials import Trial, run_all

RECORD = RESULTS / "capture.json"
COUNTS = (30, 60, 120)
CASES = (("camera", 0.5), ("camera", 2.0), ("light", 2.0))
"""What is moved, and by how many percent."""
KEYS = ("psnr_linear_clamped", "psnr_display", "ssim_display")


def write_changed(source: Path, target: Path, moved: str, percent: float, count: int | None = None) -> Path:
    """The data set with links to its images and other training views, the first ``count``."""
    target.mkdir()
    for folder in source.iterdir():
        if folder.is_dir():
            (target / folder.name).symlink_to(folder, target_is_directory=True)
    (target / "transforms_test.json").write_bytes((source / "transforms_test.json").read_bytes())
    document, random = json.loads((source / "transforms_train.json").read_bytes()), np.random.default_rng(0)

    def shift(place: Any) -> Any:
        return place + percent / 100 / math.sqrt(3) * np.linalg.norm(place) * random.standard_normal(3)

    document["frames"] = document["frames"][:count]
    for frame in document["frames"] if moved else ():
        if moved == "camera":
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = shift(pose[:3, 3])
            frame["transform_matrix"] = pose.tolist()
        else:
            frame["pl_pos"] = shift(np.array(frame["pl_pos"])).tolist()
            strength = np.array(frame.get("pl_intensity", 1.0)) * math.exp(percent / 100 * random.standard_normal())
            frame["pl_intensity"] = strength.tolist()
    (target / "transforms_train.json").write_text(json.dumps(document), encoding="utf-8")
    return target


def plan(source: Path, work: Path, steps: int) -> list[Trial]:
    def trial(folder: Path, name: str, moved: str, percent: float, refined: bool) -> Trial:
        words = ["task=relight", "scene=olat", f"scene.path='{folder}'", "model.primitives=6000"]
        words += [f"scene.refine=[{moved}]"] if refined else []
        facts = (("moved", moved), ("percent", percent), ("refined", refined))
        return Trial(name, tuple(words), steps, 0, 0, facts, interventions=None)

    trials = [trial(source, "exact", "", 0.0, False)]
    for count in COUNTS:
        folder = write_changed(source, work / f"{count}", "", 0.0, count)
        trials.append(trial(folder, f"{count}-views", f"{count} views", 0.0, False))
    for moved, percent in CASES:
        folder = write_changed(source, work / f"{moved}-{percent:g}", moved, percent)
        trials += [
            trial(folder, f"{moved}-{percent:g}-{refined}", moved, percent, refined) for refined in (False, True)
        ]
    return trials


def tables(record: Record) -> str:
    """By the number of photographs, and by what is known roughly."""
    runs = {(run["moved"], run["percent"], run["refined"]): run for run in record["trials"]}
    exact = runs["", 0.0, False]

    def cell(run: Record) -> str:
        return f"{run['psnr_linear_clamped']:.2f} dB, {run['psnr_display']:.2f} dB"

    counted = Table("training views", *map(str, COUNTS), "all")
    counted.row(
        "PSNR, linear and display", *(cell(runs[f"{count} views", 0.0, False]) for count in COUNTS), cell(exact)
    )
    made = Table("training views", "as they are", "refined", "exact")
    for moved, percent in CASES:
        own = [runs[moved, percent, refined] for refined in (False, True)]
        made.row(f"{moved}s off by {percent:g} %", *map(cell, [*own, exact]))
    steps = f"{exact['iterations']:,}"
    return f"{counted}\n\n{made}\n\nTest views of `pt_bunny`, {steps} steps, one seed."


def main() -> None:
    parser = make_parser(__doc__, "--jobs", "--docs", "--print")
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR", help="a data set")
    parser.add_argument("--steps", type=int, default=5000)
    args = parser.parse_args()
    if not args.only_print:
        if args.folder is None:
            parser.error("found no DIR; expected the folder of a data set")
        with tempfile.TemporaryDirectory() as work:
            run_all(plan(args.folder.resolve(), Path(work), args.steps), RECORD, KEYS, args.jobs)
    text = tables(read_record(RECORD))
    if args.docs:
        between_markers(RESULT_PAGES / "relighting.md", "capture", text)


if __name__ == "__main__":
    main()
