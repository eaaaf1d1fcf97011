"""What is the best use of so much time? The levels `effort=1` to `9` of every task: how many primitives, and how many
views.

    python benchmarks/effort.py [--scenes smoke_fire] [--write] [--docs] [--print]

Static scenes and relighting have levels of views alone, as their number of primitives follows the views. --docs makes
their tables of what `python benchmarks/quality.py SCENE ... --tune --steps 320 500 ...` recorded. Of volumes a level is
a share of the time that the preset `quick` takes, from a sixteenth of it to four times as much. Level by level the
number of primitives that was best so far is tried, and at most levels twice as many, while that is better: they share
the time at paces measured side by side. Each is trained once, one thread, all else as the preset has it, and judged by
the two test cameras of a rig of 38, as those of the usual 40 must not decide. The level is the smallest model within
TIE dB of the best of so much time or less. Results go to benchmarks/results/effort/SCENE.json after every run, and only
what is missing is run. --write freezes the levels in the tasks' `effort/NAME.yaml`, --docs puts the tables between the
markers of docs/results/tradeoffs.md and draws docs/pictures/effort.png; --print runs nothing.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

import yaml
from shared.arguments import make_parser
from shared.forms import SCENES
from shared.tables import (
    DOCS,
    RESULT_PAGES,
    RESULTS,
    ROOT,
    Run,
    Table,
    between_markers,
    group_runs,
    make_table,
    read_trials,
)
from shared.trials import Trial, measure_paces, run_all

from neuprim.config import compose
from neuprim.config.task_files import LEVELS
from neuprim.report.charts import Chart, ChartPoints, Dot, front_chart, write_png_charts

PICTURE = DOCS / "pictures" / "effort.png"
TITLES = {
    "smoke_fire": "dynamic: `smoke_fire` (simulated), 64×64",
}
"""Of volumes."""
JUDGED = {"smoke_fire": "inside the mask"}
SCORES = {"static": ("psnr", "ssim"), "relight": ("psnr_linear_clamped", "ssim_display")}
"""Of the tasks whose levels are views alone: dB and SSIM."""
TIMES = dict(zip(LEVELS, (1 / 16, 1 / 8, 1 / 4, 1 / 2, 1, 1.5, 2, 3, 4), strict=True))  # of the preset's own time
FIRST = 0.5
"""Of the preset's own number of primitives, where the first level begins, and half of which it tries as well."""
DOUBLED = {1: 4, 2: 4, 3: 4, 4: 4, 5: 4, 7: 1}
"""Levels that try twice as many, and so many times twice as many again while that is better; the others take what the
one before found."""
TIE = 0.05
PACED = 320  # steps of the short runs that tell the paces; a whole one each, as primitives are born on the way
KEYS = ("psnr", "psnr_mask", "ssim", "primitives", "model_bytes")


def record_of(scene: str) -> Path:
    return RESULTS / "effort" / f"{scene}.json"


def levels_path(task: str) -> Path:
    return ROOT / "neuprim" / "tasks" / task / "conf" / "effort" / f"{task}.yaml"


def levels_of_views(task: str) -> dict[int, list[Run]]:
    """A run per scene of every level of a task whose levels are views alone."""
    levels = yaml.safe_load(levels_path(task).read_text(encoding="utf-8"))["levels"]
    runs = [run for run in read_trials(RESULTS / f"{task}_tune.json") if not run["settings"]]
    views = {f"{settings['train.iterations']:,} steps": level for level, settings in levels.items()}
    by_budget = group_runs((run for run in runs if run["budget"] in views), "budget")
    found = {views[budget]: sorted(own, key=lambda run: run["scene"]) for (budget,), own in by_budget.items()}
    return dict(sorted(found.items()))


def table_of_views(levels: Mapping[int, Sequence[Run]], task: str) -> Table:
    """A row per level: what it costs, and dB, SSIM and seconds of a core of every scene."""
    judged, similar = SCORES[task]
    preset = {run["scene"]: run["cpu_seconds"] for run in levels[5]}

    def time_of(level: int) -> float:
        return statistics.mean(run["cpu_seconds"] / preset[run["scene"]] for run in levels[level])

    columns = {
        "`effort=`": lambda level: level,
        "time": lambda level: f"{time_of(level):.2g}",
        "views": lambda level: f"{levels[level][0]['iterations']:,}",
        "primitives": lambda level: f"{levels[level][0]['primitives']:,}",
        "bytes": lambda level: f"{levels[level][0]['model_bytes']:,}",
    }
    for number, run in enumerate(levels[5]):

        def result(level: int, number: int = number) -> str:
            own = levels[level][number]
            return f"{own[judged]:.2f}, {own[similar]:.4f} ({own['cpu_seconds']:.0f} s)"

        columns[f"{run['scene']}, {run['size']}"] = result
    return make_table(columns, levels)


def chart_of_views(levels: Mapping[int, Sequence[Run]], task: str) -> Chart:
    """PSNR of every scene against the training time of its levels."""
    lines = []
    for number, run in enumerate(levels[5]):
        own = [levels[level][number] for level in levels]
        seconds, scores = [run["cpu_seconds"] for run in own], [run[SCORES[task][0]] for run in own]
        lines.append(ChartPoints(seconds, scores, f"C{number}", name=f"{run['scene']}, {run['size']}"))
    return Chart(task, lines, "training, seconds of a core", "dB, held-out views", log_x=True)


class Climb:
    """Goes up the levels of a scene; what is recorded is not run again."""

    def __init__(self, scene: str) -> None:
        self.scene, self.record = scene, record_of(scene)
        self.words = (*SCENES[scene].all_words({}, scene), "scene.cameras=38")
        own = compose(self.words, check_output=False)
        assert own.train.iterations is not None, "presets are stated in views"
        self.steps, self.primitives = own.train.iterations, own.model.primitives

    def run(self) -> None:
        share = FIRST
        for level in LEVELS:
            found = self.train(level, share)
            if level == LEVELS[0] and (half := self.train(level, share / 2)) >= found - TIE:
                share, found = share / 2, half
            for _ in range(DOUBLED.get(level, 0)):
                twice = self.train(level, 2 * share)
                if twice <= found + TIE:
                    break
                share, found = 2 * share, twice

    def train(self, level: int, share: float) -> float:
        """dB of the level's time spent on so many of the preset's primitives."""
        whole, reduced = self._trial("", PACED, 1.0), self._trial("", PACED, share)
        pace = measure_paces(self.record, whole, {f"{share:g}": reduced}, PACED)[f"{share:g}"]
        steps = _round(TIMES[level] * self.steps / pace)
        facts = (("scene", self.scene), ("level", level), ("asked", round(share * self.primitives)))
        name = f"{self.scene}-{level}-{share:g}"
        run_all([self._trial(name, steps, share, facts)], self.record, KEYS)
        trials = read_trials(self.record)
        return float(next(run[SCENES[self.scene].judged] for run in trials if run["trial"] == name))

    def _trial(self, name: str, steps: int, share: float, facts: tuple[tuple[str, object], ...] = ()) -> Trial:
        words = (*self.words, f"model.primitives={round(share * self.primitives)}")
        return Trial(name, words, steps, 0, 0, facts, interventions=None)


def _round(steps: float) -> int:
    """To two digits, as people write budgets."""
    digits = len(str(round(steps))) - 2
    return int(round(steps, -digits))


def choose(runs: Sequence[Run], scene: str, level: int) -> Run:
    """The smallest model, and of these the soonest trained, that is about as good as the best of the level's time or
    less: more of it is no use of its own."""
    tried, judged = [run for run in runs if run["level"] <= level], SCENES[scene].judged
    best = max(run[judged] for run in tried)
    return min((run for run in tried if run[judged] >= best - TIE), key=lambda run: (run["asked"], run["iterations"]))


def levels_file(runs: Sequence[Run], scene: str) -> str:
    """The text of a task's file of levels."""
    lines = [
        "# Levels of effort: the best use of 1/16 to 4 times the time that the preset takes, as measured by "
        "`python benchmarks/effort.py --write`",
        f"# on {TITLES[scene].partition(': ')[2]}. Tables: docs/results/tradeoffs.md",
        "",
        "preset: quick",
        "levels:",
    ]
    for level in LEVELS:
        run = choose(runs, scene, level)
        lines.append(f"  {level}: {{model.primitives: {run['asked']}, train.iterations: {run['iterations']}}}")
    return "\n".join(lines) + "\n"


def table(runs: Sequence[Run], scene: str) -> Table:
    """A row per level, with what else was tried."""
    judged = SCENES[scene].judged

    def others(level: int, best: Run) -> str:
        tried = sorted((run for run in runs if run["level"] == level), key=lambda run: int(run["asked"]))
        return ", ".join(f"{run['asked']:,}: {run[judged]:.2f}" for run in tried if run is not best) or "–"

    columns = {
        "`effort=`": lambda row: row[0],
        "time": lambda row: f"{TIMES[row[1]['level']]:.3g}",
        "primitives": lambda row: f"{row[1]['asked']:,}",
        "views": lambda row: f"{row[1]['iterations']:,}",
        f"dB, {JUDGED[scene]}": lambda row: f"{row[1][judged]:.2f}",
        "SSIM": lambda row: f"{row[1]['ssim']:.4f}",
        "bytes": lambda row: f"{row[1]['model_bytes']:,}",
        "seconds of a core": lambda row: f"{row[1]['cpu_seconds']:.0f}",
        "also tried": lambda row: others(*row),
    }
    return make_table(columns, [(level, choose(runs, scene, level)) for level in LEVELS])


def make_chart(runs: Sequence[Run], scene: str) -> Chart:
    """Quality against training time; levels are joined and numbered."""
    names: dict[str, list[int]] = {}
    for level in LEVELS:
        names.setdefault(choose(runs, scene, level)["trial"], []).append(level)
    dots = [
        Dot(
            run["cpu_seconds"],
            run[SCENES[scene].judged],
            mark=", ".join(map(str, names[run["trial"]])) if run["trial"] in names else None,
        )
        for run in runs
    ]
    return front_chart(TITLES[scene].replace("`", ""), "training, seconds of a core", "dB, held-out views", dots)


def main() -> None:
    parser = make_parser(__doc__, "--docs", "--print", scenes=TITLES)
    parser.add_argument("--write", action="store_true", help="freeze the levels in the tasks' files")
    args = parser.parse_args()
    if not args.only_print:
        for scene in args.scenes:
            Climb(scene).run()
    found = {scene: read_trials(record_of(scene)) for scene in TITLES}
    found = {scene: runs for scene, runs in found.items() if {run["level"] for run in runs} == set(LEVELS)}
    text = "\n\n".join(f"**{TITLES[scene]}**\n\n{table(runs, scene)}" for scene, runs in found.items())
    if args.write:
        for scene, runs in found.items():
            levels_path(SCENES[scene].task).write_text(levels_file(runs, scene))
    if args.docs:
        levels = {task: levels_of_views(task) for task in SCORES}
        for task, own in levels.items():
            between_markers(RESULT_PAGES / "tradeoffs.md", f"effort-{task}", str(table_of_views(own, task)))
        between_markers(RESULT_PAGES / "tradeoffs.md", "effort", text)
        charts = [make_chart(runs, scene) for scene, runs in found.items()]
        write_png_charts(PICTURE, [*(chart_of_views(own, task) for task, own in levels.items()), *charts])


if __name__ == "__main__":
    main()
