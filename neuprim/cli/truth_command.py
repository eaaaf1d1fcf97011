"""``neuprim truth``: the ground truth of a scene before runs need it."""

from __future__ import annotations

import argparse
import shlex

from neuprim.cli.command import Command, take_overrides
from neuprim.core.errors import ConfigError

_HELP = """\
Frames that are there are not made again; a run with the same scene reads them. With a launcher they are made side by
side:
  neuprim truth task=dynamic scene=vdb scene.vdb=DIR launcher=processes
  neuprim truth task=dynamic scene=vdb scene.vdb=DIR scene.cache=DIR launcher=slurm
Prints where they are."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    settings = "settings of the scene and of the launcher, as of neuprim run"
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help=settings)
    every = "of every combination of values separated by commas"
    parser.add_argument("-m", "--multirun", action="store_true", help=every)


def _truth(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import RunProgress
    from neuprim.config import compose, compose_all
    from neuprim.config.command_settings import take_launcher
    from neuprim.runs.ground_truth import render_ground_truth

    launcher, rest = take_launcher(args.overrides)
    try:
        for config in compose_all(rest) if args.multirun else [compose(rest)]:
            with RunProgress(f"{config.task}/{config.scene_name}") as events:
                made = render_ground_truth(config, launcher, events)
            if made is None:
                raise ConfigError(
                    f"scene={config.scene_name}: its images are not rendered frame by frame; expected "
                    "a scene of volumes, as task=dynamic scene=vdb"
                )
            print(made.place, flush=True)
    except KeyboardInterrupt:
        command = shlex.join(["neuprim", "truth", *(["-m"] if args.multirun else []), *args.overrides])
        raise KeyboardInterrupt(f"; frames made so far are kept; to go on:\n  {command}") from None
    return 0


COMMAND = Command(
    "truth", "render the ground truth of a scene before runs need it", _truth, _add_arguments, _HELP, take_overrides
)
