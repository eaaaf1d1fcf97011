"""``neuprim run … target.psnr=30 budget=10m``: what it shows while it searches, and what came of it."""

from __future__ import annotations

import shlex
from pathlib import Path

from rich.console import Console

from neuprim.cli.console import plain_console
from neuprim.cli.progress import RunProgress
from neuprim.config import RunConfig
from neuprim.config.command_settings import LauncherSettings, Target
from neuprim.config.overrides import CommandLine
from neuprim.runs.events import Event, Note, Step
from neuprim.search.size_predictor import format_forecast
from neuprim.search.target import run_target
from neuprim.search.target_record import TARGET_FILE, TargetRecord

__all__ = ["fit_target", "print_record"]


class _Searching(RunProgress):
    """Without a terminal only the search's own lines, as a dozen trials would each have ten of their own."""

    def __call__(self, event: Event) -> None:
        if self.live or isinstance(event, Note):
            super().__call__(event)
        elif isinstance(event, Step) and event.progress >= 1.0:
            self._stage = ""


def fit_target(config: RunConfig, target: Target, budget: float, launcher: LauncherSettings, typed: CommandLine) -> int:
    """Search and train; prints what was achieved and the run's directory."""
    console = plain_console(stderr=True)
    try:
        with _Searching(console, f"{config.task}/{config.scene_name}") as events:
            record = run_target(config, target, budget, events, launcher=launcher)
    except KeyboardInterrupt:
        command = shlex.join(["neuprim", "run", *typed.resume_arguments(config.output_dir)])
        raise KeyboardInterrupt(f"; {config.output_dir} has the trials up to here; to go on:\n  {command}") from None
    print_record(record, console)
    print(record.achieved["run_dir"])
    return 0


def print_record(record: TargetRecord, console: Console) -> None:
    """What was predicted and achieved, and why it ended."""

    def line(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True, markup=False, emoji=False)

    found = record.achieved
    for name, (value, doubt) in found["predicted"].items():
        text = f"predicted {format_forecast(name, value, doubt)}; held out {found['held_out'][name]:.4g}"
        line(f"{text}; test views {found['test'][name]:.4g}, {found['test_before_storing'][name]:.4g} before storing")
    whole = Path(found["run_dir"]) / "model.safetensors"
    line(
        f"{found['primitives']:,} primitives: {found['file']} {found['packed_bytes']:,} bytes, {whole.name} {found['model_bytes']:,} bytes"
    )
    line(f"{found['seconds']:.0f} s of {record.asked['budget']:g} s used; {found['fps']:.1f} frames per second")
    for why in record.why:
        line(f"ended: {why}")
    if record.warning:
        line(f"neuprim: warning: {record.warning}")
    line(f"everything that was tried: {TARGET_FILE}")
