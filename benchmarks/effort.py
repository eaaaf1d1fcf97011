"""What is the best use of so much time? The levels `effort=1` to `9` of every task: how many primitives, and how many
views.

    python benchmarks/effort.py [--scenes chair smoke_fire lit_solids] [--chair DIR] [--write] [--docs] [--print]

A level is a share of the time that the preset `quick` takes, from a sixteenth of it to four times as much, on any
machine. Level by level the number of primitives that was best so far is tried, and at most levels twice as many, while
that is better: they share the time at paces measured side by side. Each is trained once, one thread, all else as the
preset has it, and judged by views held out of the training ones (volumes: by the two test cameras of a rig of 38, as
those of the usual 40 must not decide). The level is the smallest model within TIE dB of the best of so much time or
less. Results go to benchmarks/results/effort/SCENE.json after
every run, and only what is missing is run. --write freezes the levels in the tasks' `effort/NAME.yaml`, --docs puts the
tables between the markers of docs/tradeoffs.md and draws docs/pictures/effort.png; --print runs nothing.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from shared.forms import SCENES
from shared.tables import ROOT, Table, between_markers
from shared.trials import Trial, begin, paces_of, recorded, run_all

from neuprim.config import compose
from neuprim.config.task_files import LEVELS
from neuprim.core.compute.threads import cpu_name

RESULTS = Path(__file__).parent / "results" / "effort"
PICTURE = ROOT / "docs" / "pictures" / "effort.png"
NAMES = ("chair", "smoke_fire", "lit_solids")
"""One scene of each task."""
TITLES = {
    "chair": "static: NeRF-synthetic chair, 200×200",
    "smoke_fire": "dynamic: `smoke_fire` (simulated), 64×64",
    "lit_solids": "relight: `lit_solids` (generated), 128×128",
}
JUDGED = {"chair": "all pixels", "smoke_fire": "inside the mask", "lit_solids": "clamped"}
TIMES = (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 1.5, 2, 3, 4)
"""Of the preset's own time, level by level."""
FIRST = 0.5
"""Of the preset's own number of primitives, where the first level begins, and half of which it tries as well."""
DOUBLED = {1: 4, 2: 4, 3: 4, 4: 4, 5: 4, 7: 1}
"""Levels that try twice as many, and so many times twice as many again while that is better; the others take what the
one before found."""
TIE = 0.05
PACED = 320
"""Steps of the short runs that tell the paces; a whole one each, as primitives are born on the way."""
HOLD_OUT = 8
KEYS = ("psnr", "psnr_mask", "psnr_linear_clamped", "ssim", "primitives", "model_bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(NAMES), choices=NAMES)
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if "chair" in args.scenes and args.chair is None:
            parser.error("--chair: wants the folder of its data; or leave it out of --scenes")
        for scene in args.scenes:
            Climb(scene, vars(args)).run()
    found = {scene: recorded(file_of(scene)) for scene in NAMES}
    found = {scene: rows for scene, rows in found.items() if {row["level"] for row in rows} == set(LEVELS)}
    tables = {scene: table(rows, scene) for scene, rows in found.items()}
    if args.write:
        for scene, rows in found.items():
            task = SCENES[scene].task
            target = ROOT / "neuprim" / "tasks" / task / "conf" / "effort" / f"{task}.yaml"
            target.parent.mkdir(exist_ok=True)
            target.write_text(frozen(rows, scene))
    if args.docs:
        text = "\n\n".join(f"**{TITLES[scene]}**\n\n{made}" for scene, made in tables.items())
        between_markers(ROOT / "docs" / "tradeoffs.md", "effort", text)
        draw(found)


def file_of(scene: str) -> Path:
    return RESULTS / f"{scene}.json"


class Climb:
    """Goes up the levels of a scene; what is recorded is not run again."""

    def __init__(self, scene: str, folders: Mapping[str, Any]) -> None:
        torch.set_num_threads(1)
        self.scene, self.words = scene, words_of(scene, folders)
        self.own = compose(self.words, check_output=False)
        assert self.own.train.iterations is not None, "presets are stated in views"
        self.steps = self.own.train.iterations
        there = json.loads(file_of(scene).read_text()) if file_of(scene).exists() else {}
        self.paces: dict[str, float] = there.get("paces", {})

    def run(self) -> None:
        share = FIRST
        for level in LEVELS:
            found = self.tried(level, share)
            if level == LEVELS[0] and self.tried(level, share / 2) >= found - TIE:
                share, found = share / 2, self.tried(level, share / 2)
            for _ in range(DOUBLED.get(level, 0)):
                twice = self.tried(level, 2 * share)
                if twice <= found + TIE:
                    break
                share, found = 2 * share, twice

    def tried(self, level: int, share: float) -> float:
        """dB of the level's time spent on so many of the preset's primitives."""
        primitives = round(share * self.own.model.primitives)
        steps = _round(TIMES[level - LEVELS[0]] * self.steps / self.pace(share))
        facts = (("scene", self.scene), ("level", level), ("asked", primitives))
        words = (*self.words, f"model.primitives={primitives}")
        hold_out = 0 if SCENES[self.scene].task == "dynamic" else HOLD_OUT
        name, judged = f"{self.scene}-{level}-{share:g}", SCENES[self.scene].judged
        trial = Trial(name, words, steps, 0, hold_out, facts, interventions=None)
        run_all(
            [trial],
            file_of(self.scene),
            KEYS,
            1,
            lambda row: f"{row[judged]:.2f} dB",
            {"cpu": cpu_name(), "paces": self.paces},
        )
        return float(next(row[judged] for row in recorded(file_of(self.scene)) if row["trial"] == name))

    def pace(self, share: float) -> float:
        """Time of a step, as a multiple of the preset's."""
        if f"{share:g}" not in self.paces:
            words = {s: (*self.words, f"model.primitives={round(s * self.own.model.primitives)}") for s in (1.0, share)}
            took = paces_of(
                {f"{s:g}": begin(Trial("", w, PACED, interventions=None)).trainer for s, w in words.items()}, PACED
            )
            self.paces[f"{share:g}"] = took[f"{share:g}"] / took["1"]
        return self.paces[f"{share:g}"]


def words_of(scene: str, folders: Mapping[str, Any]) -> tuple[str, ...]:
    found = SCENES[scene]
    return (*found.all_words(folders, scene), *(found.tuning if found.task == "dynamic" else ()))


def _round(steps: float) -> int:
    """To two digits, as people write budgets."""
    digits = len(str(round(steps))) - 2
    return int(round(steps, -digits))


def of_level(rows: Sequence[Mapping[str, Any]], level: int) -> list[Mapping[str, Any]]:
    return sorted((row for row in rows if row["level"] == level), key=lambda row: row["asked"])


def chosen(rows: Sequence[Mapping[str, Any]], scene: str, level: int) -> Mapping[str, Any]:
    """The smallest model, and of these the soonest trained, that is about as good as the best of the level's time or
    less: more of it is no use of its own."""
    tried, judged = [row for at in LEVELS if at <= level for row in of_level(rows, at)], SCENES[scene].judged
    best = max(row[judged] for row in tried)
    return min((row for row in tried if row[judged] >= best - TIE), key=lambda row: (row["asked"], row["iterations"]))


def frozen(rows: Sequence[Mapping[str, Any]], scene: str) -> str:
    """A task's file of levels."""
    lines = [
        "# Levels of effort: the best use of 1/16 to 4 times the time that the preset takes, as measured by "
        "`python benchmarks/effort.py --write`",
        f"# on {TITLES[scene].partition(': ')[2]}. Tables: docs/tradeoffs.md",
        "",
        "preset: quick",
        "levels:",
    ]
    for level in LEVELS:
        row = chosen(rows, scene, level)
        lines.append(f"  {level}: {{model.primitives: {row['asked']}, train.iterations: {row['iterations']}}}")
    return "\n".join(lines) + "\n"


def table(rows: Sequence[Mapping[str, Any]], scene: str) -> Table:
    """Levels down, with what else was tried."""
    judged = SCENES[scene].judged
    made = Table(
        "`effort=`",
        "time",
        "primitives",
        "views",
        f"dB, {JUDGED[scene]}",
        "SSIM",
        "bytes",
        "seconds of a core",
        "also tried",
    )
    for level in LEVELS:
        best = chosen(rows, scene, level)
        others = ", ".join(f"{r['asked']:,}: {r[judged]:.2f}" for r in of_level(rows, level) if r is not best) or "–"
        made.row(
            level,
            f"{TIMES[best['level'] - LEVELS[0]]:.3g}",
            f"{best['asked']:,}",
            f"{best['iterations']:,}",
            f"{best[judged]:.2f}",
            f"{best['ssim']:.4f}",
            f"{best['model_bytes']:,}",
            f"{best['cpu_seconds']:.0f}",
            others,
        )
    return made


def draw(found: Mapping[str, Sequence[Mapping[str, Any]]]) -> None:
    """Quality against training time, a panel a task; levels are joined and numbered, what else was tried is grey."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        1, len(found), figsize=(4.2 * len(found), 3.3), constrained_layout=True, squeeze=False
    )
    for axis, (scene, rows) in zip(axes[0], found.items(), strict=True):
        judged = SCENES[scene].judged
        levels = [chosen(rows, scene, level) for level in LEVELS]
        others = [row for row in rows if row not in levels]
        axis.scatter(
            [r["cpu_seconds"] for r in others],
            [r[judged] for r in others],
            s=14,
            color="0.7",
            label="also tried",
            zorder=2,
        )
        axis.plot(
            [r["cpu_seconds"] for r in levels],
            [r[judged] for r in levels],
            marker="o",
            markersize=4.5,
            label="levels",
            zorder=3,
        )
        for row in {row["trial"]: row for row in levels}.values():
            name = ", ".join(str(level) for level, other in zip(LEVELS, levels, strict=True) if other is row)
            axis.annotate(
                name, (row["cpu_seconds"], row[judged]), (-3, 5), textcoords="offset points", fontsize=8, ha="right"
            )
        axis.set_xscale("log", base=2)
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_title(TITLES[scene].replace("`", ""), fontsize=9)
        axis.set_xlabel("training, seconds of a core", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(True, alpha=0.3)
        axis.legend(frameon=False, fontsize=7, loc="lower right")
    axes[0][0].set_ylabel("dB, held-out views", fontsize=8)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=120)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
