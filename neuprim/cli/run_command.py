"""``neuprim run``: fit a scene, a sweep of scenes, or search for a model that reaches a target."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, add_trust_flag, describe_interruption, take_overrides
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.config import RunConfig
    from neuprim.config.command_settings import LauncherSettings, Target, ViewerSettings
    from neuprim.config.overrides import CommandLine
    from neuprim.search.target_record import TargetRecord

_COMMON_KEYS = """\
commonest keys:
  task=NAME scene=NAME preset=NAME     what to fit, and how (`neuprim tasks` lists them)
  effort=N                             1 (fast) to 9 (good): a size and length that the task has measured
  scene.path=DIR                       data of a scene that reads files
  output_dir=DIR resume=true           where to write; continue an interrupted run
  train.iterations=N train.max_seconds=S
  model.primitives=N model.neurons=K model.sh_degree=D
  train.rates.NAME=R                   learning rate of one parameter; train.rate_units.NAME=absolute|extent
  renderer.backend=auto|NAME           `neuprim doctor` lists them
  renderer.sort=center|entry           renderer.samples=N (rays per pixel side) renderer.threads=N
  seed=N
  viewer=true viewer.port=N            look at the model in the browser while it is trained; pause, step, save, stop
  target.psnr=DB budget=10m            the smallest model that reaches it, found in that time; also target.ssim=S,
                                       target.megabytes=M and target.fps=F as limits, or these alone
  launcher=inline|processes|ray|slurm  where runs work; launcher.workers=N launcher.threads=N launcher.retries=N
                                       launcher.address=... launcher.options.KEY=VALUE (docs/launching.md)
  scene.cache=DIR|URL                  volumes: where their ground truth is kept (`neuprim truth` makes it before)
`neuprim run task=NAME scene=NAME --cfg` shows every key with its value. A value that contains , = or brackets is quoted
twice, for the shell and for the grammar: "scene.path='a=b, c'"."""

_EXAMPLES = """\
examples:
  neuprim run task=dynamic scene=smoke_fire
  neuprim run task=dynamic scene=vdb scene.vdb=DIR scene.frames=0:100:2
  neuprim run task=static scene=solids
  neuprim run task=static scene=blender scene.path=DIR preset=paper
  neuprim run -m model.primitives=200,1000 train.max_seconds=60 launcher=processes
  neuprim run --config RUN_DIR/config.yaml seed=1
  torchrun --nproc-per-node 2 -m neuprim run task=static scene=solids      (one scene by two processes)"""


def _help(words: Sequence[str]) -> str:
    """Return the text below the arguments; it lists the installed tasks."""
    if not {"-h", "--help"} & set(words):
        return ""
    from neuprim.plugins.registry import TASKS

    tasks = [f"  {TASKS.shortest_name(info)}  ({info.origin})" for info in TASKS.list_plugins()] or [
        "  none is installed"
    ]
    return "\n\n".join([_COMMON_KEYS, "\n".join(["tasks:", *tasks]), _EXAMPLES])


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="settings, in Hydra's grammar")
    sweep = "run every combination of values separated by commas"
    parser.add_argument("-m", "--multirun", action="store_true", help=sweep)
    stored = "start with the settings of RUN_DIR/config.yaml; words beside it come first"
    parser.add_argument("--config", type=Path, metavar="FILE", help=stored)
    parser.add_argument("--cfg", action="store_true", help="print the resolved configuration and stop")
    add_trust_flag(parser)


def _run(args: argparse.Namespace) -> int:
    from neuprim.config import compose_all, read_stored_config
    from neuprim.config.command_settings import LauncherSettings, take_launcher, take_target, take_viewer
    from neuprim.config.overrides import CommandLine, drop_place
    from neuprim.core.train.distributed.torchrun import read_torchrun_rank
    from neuprim.runs.fit import is_chunked, refuse_chunks

    place = read_torchrun_rank()
    if place is not None:
        from neuprim.cli.ranks import run_as_rank

        return run_as_rank(place, args.overrides, args.multirun or args.cfg or args.config is not None)
    typed = CommandLine(args.overrides, args.config)
    viewer, overrides = take_viewer(args.overrides)
    launcher, overrides = take_launcher(overrides)
    wanted, overrides = take_target(overrides)
    launched = launcher != LauncherSettings()
    for name, given in (("-m", args.multirun), ("target", wanted is not None), ("launcher", launched)):
        if viewer is not None and given:
            raise ConfigError(f"viewer=true: shows one run; expected no {name} beside it")
    if wanted is not None and args.multirun:
        raise ConfigError(f"{wanted[0]}: a target is for one run; expected no -m beside it")
    if args.multirun and not drop_place(overrides):
        from neuprim.runs.sweep import read_sweep_overrides

        overrides = read_sweep_overrides(overrides)
        typed = CommandLine([*overrides, *args.overrides], args.config)  # what goes on with it says all of it
    stored = None if args.config is None else read_stored_config(args.config)
    configs = (compose_all if args.multirun else _compose_one)(overrides, not args.cfg, stored)
    if args.cfg:
        if wanted is not None:
            print(f"# {wanted[0]} budget={wanted[1]:g}s; the search starts from")
        print("---\n".join(config.to_yaml() for config in configs), end="")
        return 0
    if wanted is not None:
        return _fit_target(configs[0], *wanted, launcher, typed)
    if viewer is not None:
        refuse_chunks(configs[0], "viewer=true shows one training")
    if len(configs) > 1 or (launched and not is_chunked(configs[0])):  # the chunks of a scene are launched themselves
        from neuprim.cli.sweep import launch_runs

        return launch_runs(configs, overrides, launcher, typed)
    print(run_one(configs[0], typed, viewer, launcher))
    return 0


def _compose_one(overrides: Sequence[str], check_output: bool, stored: RunConfig | None) -> list[RunConfig]:
    from neuprim.config import compose

    return [compose(overrides, check_output, stored)]


def run_one(
    config: RunConfig,
    typed: CommandLine,
    viewer: ViewerSettings | None = None,
    launcher: LauncherSettings | None = None,
) -> Path:
    """Run one configuration in this process and return its directory.

    An interruption says where the run is and the command that continues it.

    Args:
        launcher: where the chunks of a scene that is fitted in chunks work; None: here.
    """
    from neuprim.cli.progress import RunProgress
    from neuprim.cli.view_command import run_viewed
    from neuprim.config.command_settings import LauncherSettings
    from neuprim.runs.run import run

    try:
        with RunProgress(f"{config.task}/{config.scene_name}") as events:
            if viewer is not None:
                return run_viewed(config, events, viewer)
            return run(config, events, launcher=launcher or LauncherSettings())
    except KeyboardInterrupt:
        raise KeyboardInterrupt(describe_interruption(config.output_dir, typed)) from None


def _fit_target(
    config: RunConfig, target: Target, budget: float, launcher: LauncherSettings, typed: CommandLine
) -> int:
    """Search for a model that reaches a target; print what was achieved and the run's directory."""
    from neuprim.cli.progress import RunProgress
    from neuprim.search.target import run_target

    try:
        with RunProgress(f"{config.task}/{config.scene_name}", search=True) as events:
            record = run_target(config, target, budget, events, launcher=launcher)
    except KeyboardInterrupt:
        command = typed.resume_command(config.output_dir)
        raise KeyboardInterrupt(f"; {config.output_dir} has the trials up to here; to go on:\n  {command}") from None
    for line in _describe_target(record):
        events.console.print(line)
    print(record.achieved["run_dir"])
    return 0


def _describe_target(record: TargetRecord) -> list[str]:
    """What was predicted and achieved, and why the search ended."""
    from neuprim.search.size_predictor import format_forecast
    from neuprim.search.target_record import TARGET_FILE

    found = record.achieved
    lines = [
        f"predicted {format_forecast(name, value, doubt)}; held out {found['held_out'][name]:.4g}; "
        f"test views {found['test'][name]:.4g}, {found['test_before_storing'][name]:.4g} before storing"
        for name, (value, doubt) in found["predicted"].items()
    ]
    files = f"{found['file']} {found['packed_bytes']:,} bytes, model.safetensors {found['model_bytes']:,} bytes"
    lines.append(f"{found['primitives']:,} primitives: {files}")
    used = f"{found['seconds']:.0f} s of {record.asked['budget']:g} s used"
    lines.append(f"{used}; {found['fps']:.1f} frames per second")
    lines += [f"ended: {why}" for why in record.why]
    if record.warning:
        lines.append(f"neuprim: warning: {record.warning}")
    return [*lines, f"everything that was tried: {TARGET_FILE}"]


COMMAND = Command("run", "fit a scene", _run, _add_arguments, _help, take_overrides)
