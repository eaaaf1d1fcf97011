"""``neuprim run`` of one configuration, in this process."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from neuprim.config import RunConfig
    from neuprim.config.launcher import LauncherSettings
    from neuprim.config.overrides import Typed
    from neuprim.config.viewer import ViewerSettings

__all__ = ["one_run"]


def one_run(
    config: RunConfig, typed: Typed, viewer: ViewerSettings | None = None, launcher: LauncherSettings | None = None
) -> Path:
    """The run's directory; an interruption says where it is and what goes on with it.

    Args:
        launcher: where the chunks of a scene that is fitted in chunks work; None: here.
    """
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import RunProgress
    from neuprim.cli.view import run_viewed
    from neuprim.config.launcher import LauncherSettings
    from neuprim.runs.run import run

    try:
        with RunProgress(plain_console(stderr=True), f"{config.task}/{config.scene_name}") as events:
            return (
                run(config, events, launcher=launcher or LauncherSettings())
                if viewer is None
                else run_viewed(config, events, viewer)
            )
    except KeyboardInterrupt:
        begun = any((config.output_dir / file).exists() for file in ("checkpoint.safetensors", "chunks.json"))
        there = "has the run up to here" if begun else "has no checkpoint yet"
        command = shlex.join(["neuprim", "run", *typed.resuming(config.output_dir)])
        raise KeyboardInterrupt(f"; {config.output_dir} {there}; to go on:\n  {command}") from None
