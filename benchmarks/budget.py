"""Does more training make a better model? Every scene at budgets that double, counted in steps, each a run of its own
from the beginning.

    python benchmarks/budget.py [--scenes chair smoke_fire fire lit_solids] [--chair DIR] [--fire DIR] [--doublings 5]
    [--seeds 3] [--set KEY=VALUE ... --record FILE] [--jobs 2] [--docs] [--print]

The first budget is about what 15 seconds of one core were when the presets were chosen, the last with --doublings 5
about eight minutes. Schedules run on the used share of a budget, so that each point is what a user gets who asks for so
much, not an early look at a longer run. All is the preset `quick` but the budget; one thread each. The last checkpoint
is judged on the test views. --seeds are for the first four budgets, the longer ones have one. Results go to
benchmarks/results/budget.json after every run, and only what is missing is run; --set changes every run, and wants
another file.

A *fall* is a doubling after which a measure is more than 0.1 dB worse. --docs puts the tables between the markers of
docs/results/budgets.md and draws docs/pictures/budgets.png; --print runs nothing.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from shared.arguments import make_parser, require_folders
from shared.forms import SCENES
from shared.tables import DOCS, RESULT_PAGES, RESULTS, Run, Table, between_markers, read_trials, spread
from shared.trials import Trial, run_all

from neuprim.report.charts import LARGE, Chart, ChartPoints, write_png_charts

RECORD = RESULTS / "budget.json"
PICTURE = DOCS / "pictures" / "budgets.png"
FIRST = {"chair": 640, "smoke_fire": 500, "fire": 500, "lit_solids": 360}  # steps of the smallest budget
SEVERAL = 4  # budgets with all seeds
FALL = 0.1
TITLES = {
    "chair": "NeRF-synthetic chair, 200×200",
    "smoke_fire": "`smoke_fire` (simulated), 64×64",
    "fire": "EmberGen fire, 96×96",
    "lit_solids": "`lit_solids` (generated), 128×128",
}
_VOLUME = {"psnr": "all pixels", "psnr_mask": "inside the mask", "psnr_pooled_mask": "inside the mask, pooled"}
_LIT = {
    "psnr_linear_clamped": "clamped",
    "psnr": "unclamped",
    "psnr_pooled_lit": "lit pixels",
    "psnr_pooled_cast_shadow": "cast shadows",
    "psnr_pooled_attached_shadow": "attached shadows",
    "psnr_pooled_highlight": "highlights",
}
MEASURES = {
    "chair": {"psnr": "all pixels", "psnr_worst": "worst view"},
    "smoke_fire": _VOLUME,
    "fire": _VOLUME,
    "lit_solids": _LIT,
}
KEYS = (
    *dict.fromkeys(key for measures in MEASURES.values() for key in measures),
    *("ssim", "primitives", "parameters_per_primitive"),
)


def plan(args: argparse.Namespace) -> list[Trial]:
    """Short budgets first, so that a benchmark that is cut short has whole curves for as far as it came."""
    trials = []
    for doubling in range(args.doublings + 1):
        for seed in range(args.seeds if doubling < SEVERAL else 1):
            for name in args.scenes:
                steps = FIRST[name] << doubling
                words = (*SCENES[name].all_words(vars(args), name), *args.set)
                facts = (("scene", name), ("doubling", doubling))
                trials.append(Trial(f"{name}-{steps}-{seed}", words, steps, seed, facts=facts, interventions=None))
    return trials


def values_by_budget(runs: Sequence[Run], scene: str, measure: str) -> dict[int, list[float]]:
    """Of every budget in steps, one number per seed."""
    found: dict[int, list[float]] = {}
    for run in sorted(runs, key=lambda run: (run["iterations"], run["seed"])):
        if run["scene"] == scene:
            found.setdefault(run["iterations"], []).append(run[measure])
    return found


def gains(runs: Sequence[Run], scene: str, measure: str) -> list[tuple[int, int, float]]:
    """(steps, steps, dB) of each doubling, between means over the seeds that both have."""
    result = []
    for (few, before), (many, after) in pairwise(values_by_budget(runs, scene, measure).items()):
        common = min(len(before), len(after))
        result.append((few, many, statistics.mean(after[:common]) - statistics.mean(before[:common])))
    return result


def table(scene: str, runs: Sequence[Run]) -> Table:
    seconds = values_by_budget(runs, scene, "cpu_seconds")
    heads = (f"{steps:,} ({statistics.mean(took):.0f} s)" for steps, took in seconds.items())
    made = Table("steps (seconds of a core)", *heads, "last doubling")
    for measure, title in MEASURES[scene].items():
        last = gains(runs, scene, measure)
        cells = (spread(found, 2) for found in values_by_budget(runs, scene, measure).values())
        made.row(title, *cells, f"{last[-1][2]:+.2f} dB" if last else "–")
    return made


def describe_falls(runs: Sequence[Run]) -> str:
    """What became worse by more than ``FALL``, and the budgets after which it did."""
    doublings = [
        (f"{TITLES[scene]}, {title}: {gain:+.2f} dB from {few:,} to {many:,} steps", gain)
        for scene, measures in MEASURES.items()
        for measure, title in measures.items()
        for few, many, gain in gains(runs, scene, measure)
    ]
    found = [text for text, gain in doublings if gain < -FALL]
    head = f"Doubling the budget lowered a PSNR by more than {FALL} dB in"
    if not found:
        return f"{head} none of {len(doublings)} cases."
    listed = "\n".join(f"* {line}" for line in found)
    return f"{head} {len(found)} of {len(doublings)} cases:\n\n{listed}"


def make_chart(scene: str, runs: Sequence[Run]) -> Chart:
    """Every measure of a scene over the budget."""
    lines = []
    for number, (measure, title) in enumerate(MEASURES[scene].items()):
        found = values_by_budget(runs, scene, measure)
        means = [statistics.mean(own) for own in found.values()]
        lines.append(ChartPoints(list(found), means, f"C{number}", name=title))
    return Chart(TITLES[scene].replace("`", ""), lines, "steps", "dB, test views", LARGE, log_x=True)


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--seeds", "--jobs", "--docs", "--print", scenes=FIRST)
    parser.add_argument("--doublings", type=int, default=5)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--record", type=Path, default=RECORD)
    args = parser.parse_args()
    if args.set and args.record == RECORD:
        parser.error("--set changes what is measured: it wants another --record")
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        run_all(plan(args), args.record, KEYS, args.jobs)
    runs = read_trials(args.record)
    scenes = [name for name in FIRST if any(run["scene"] == name for run in runs)]
    text = "\n\n".join(f"**{TITLES[name]}**\n\n{table(name, runs)}" for name in scenes)
    falls = describe_falls(runs)
    print(f"\n{falls}")
    if args.docs:
        between_markers(RESULT_PAGES / "budgets.md", "budgets", f"{text}\n\n{falls}")
        write_png_charts(PICTURE, [make_chart(name, runs) for name in scenes], rows=2)


if __name__ == "__main__":
    main()
