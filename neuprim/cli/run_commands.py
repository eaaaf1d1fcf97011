"""``neuprim run`` and ``neuprim truth``.

``run`` trains one run, a sweep over values of settings, or a search for the smallest model that reaches a target, such
as a PSNR. ``truth`` renders the ground-truth images of a scene before runs need them.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, add_trust_flag, describe_interrupted_command
from neuprim.core.errors import BackendUnavailable, ConfigError, RankError, one_line

if TYPE_CHECKING:
    from neuprim.config import RunConfig
    from neuprim.config.command_settings import LauncherSettings, SearchTarget
    from neuprim.config.overrides import CommandLine
    from neuprim.core.train.process_group import ProcessGroup, TorchrunRank
    from neuprim.runs.launch.jobs import JobResult
    from neuprim.search.target_record import TargetRecord


_RUN_SETTINGS = """\
in Hydra's grammar, anywhere on the line; these are the most common
  task=NAME scene=NAME                 what to fit (all are listed below)
  preset=NAME                          settings to start from (`neuprim tasks` lists them)
  effort=N                             1 (fast) to 9 (good): sets training steps and number of primitives to values
                                       measured for the task; 1 takes about a tenth of the time of preset=quick, 9
                                       about four times as long
  scene.path=DIR                       data of a scene that reads files
  resume=true                          continue an interrupted run
  train.iterations=N train.max_seconds=S
  model.primitives=N model.neurons=K model.sh_degree=D
  train.rates.NAME=R                   learning rate of one parameter; train.rate_units.NAME=absolute|extent|pixel
  renderer.backend=auto|NAME           `neuprim doctor` lists them
  renderer.sort=center|entry           renderer.samples=N (rays per pixel side) renderer.threads=N
  seed=N
  viewer=true viewer.port=N            show the model in the browser during training; pause, step, save, stop
  target.psnr=DB budget=10m            the smallest model that reaches it, found in that time; also target.ssim=S,
                                       target.megabytes=M and target.fps=F as limits, or these alone
  launcher=inline|processes|ray|slurm  where runs work; also launcher.workers=N launcher.threads=N launcher.retries=N
  scene.cache=DIR|URL                  volumes: folder of their ground truth (`neuprim truth` renders it before a run)
--print-config shows all. Quote a value that contains , = or brackets twice: "scene.path='a=b, c'\""""

_EXAMPLES = """\
examples:
  neuprim run task=static scene=solids
  neuprim run task=static scene=blender scene.path=DIR preset=paper --out RUN_DIR
  neuprim run task=dynamic scene=vdb scene.vdb=DIR scene.frames=0:100:2
  neuprim run -m model.primitives=200,1000 train.max_seconds=60 launcher=processes
  neuprim run --config RUN_DIR/config.yaml seed=1
  torchrun --nproc-per-node 2 -m neuprim run task=static scene=solids      (one scene by two processes)"""


def _run_help(words: Sequence[str]) -> str:
    """Return the help text below the arguments: installed tasks and examples. "" if ``words`` have no ``--help``."""
    if not {"-h", "--help"} & set(words):
        return ""
    from neuprim.plugins.registry import TASKS, list_scene_names

    lines = ["tasks, and their scenes (`neuprim tasks` describes them):"]
    for info in TASKS.list_plugins():
        origin = "" if info.built_in else f"  ({info.origin})"
        lines.append(f"  {TASKS.shortest_name(info):8} {', '.join(list_scene_names(info))}{origin}")
    return "\n".join([*lines, "", _EXAMPLES])


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", metavar="DIR", help="where to write (default: outputs/TASK-SCENE)")
    sweep = "run every combination of values separated by commas"
    parser.add_argument("-m", "--multirun", action="store_true", help=sweep)
    stored = "start from the settings of RUN_DIR/config.yaml; those typed replace them"
    parser.add_argument("--config", type=Path, metavar="FILE", help=stored)
    parser.add_argument("--print-config", action="store_true", help="print every setting with its value, and stop")
    add_trust_flag(parser)


def _refuse_bare_words(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    """Raise ConfigError for words without ``KEY=``, e.g. ``solids``; suggest the command that they mean.

    ``rest`` has the words that argparse does not know. If it is empty or has flags, return it unchanged.
    """
    if not rest or any(word.startswith("-") for word in rest):
        return rest
    from neuprim.plugins.registry import TASKS, list_scene_names

    scenes = {TASKS.shortest_name(info): list_scene_names(info) for info in TASKS.list_plugins()}
    chosen = [word.partition("=")[2] for word in arguments.overrides if word.startswith("task=")]
    chosen += [word for word in rest if word in scenes]
    meant: list[str] = []
    for word in rest:
        owner = next((task for task in chosen or scenes if word in scenes.get(task, ())), None)
        if word not in scenes and owner is None:
            raise ConfigError(f"{word}: expected KEY=VALUE (see {parser.prog} --help)")
        meant += [f"task={word}"] if word in scenes else [*([] if chosen else [f"task={owner}"]), f"scene={word}"]
    command = shlex.join([*parser.prog.split(), *dict.fromkeys(meant), *arguments.overrides])
    raise ConfigError(f"{' '.join(rest)}: expected KEY=VALUE; did you mean: {command}?")


def _run_command(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import print_run_summary, run_command_here
    from neuprim.config import compose, compose_all, read_stored_config
    from neuprim.config.command_settings import (
        LauncherSettings,
        take_launcher_overrides,
        take_target_overrides,
        take_viewer_overrides,
    )
    from neuprim.config.overrides import CommandLine, drop_output_overrides, quote_override
    from neuprim.core.train.process_group import read_torchrun_rank
    from neuprim.runs.fit import is_chunked, refuse_chunks

    asked = [*args.overrides, *([] if args.out is None else [quote_override("output_dir", args.out)])]
    place = read_torchrun_rank()
    if place is not None:
        return run_command_as_rank(place, asked, args.multirun or args.print_config or args.config is not None)
    typed = CommandLine(asked, args.config)
    viewer, overrides = take_viewer_overrides(asked)
    launcher, overrides = take_launcher_overrides(overrides)
    wanted, overrides = take_target_overrides(overrides)
    launched = launcher != LauncherSettings()
    for name, given in (("-m", args.multirun), ("target", wanted is not None), ("launcher", launched)):
        if viewer is not None and given:
            raise ConfigError(f"viewer=true: the viewer shows a single run and cannot be combined with {name}")
    if wanted is not None and args.multirun:
        raise ConfigError(f"{wanted[0]}: a run with a target cannot be combined with -m; leave out -m or the target")
    if args.multirun and not drop_output_overrides(overrides):
        from neuprim.runs.sweep import read_sweep_overrides

        overrides = read_sweep_overrides(overrides)
        typed = CommandLine([*overrides, *asked], args.config)  # the command that resumes has all overrides
    stored = None if args.config is None else read_stored_config(args.config)
    check = not args.print_config
    configs = compose_all(overrides, check, stored) if args.multirun else [compose(overrides, check, stored)]
    if args.print_config:
        if wanted is not None:
            print(f"# {wanted[0]} budget={wanted[1]:g}s; the search starts from")
        print("---\n".join(config.to_yaml() for config in configs), end="")
        return 0
    if wanted is not None:
        return _run_command_with_target(configs[0], *wanted, launcher, typed)
    if viewer is not None:
        refuse_chunks(configs[0], "viewer=true shows one training")
    if len(configs) > 1 or (launched and not is_chunked(configs[0])):  # of a scene in chunks, its chunks are launched
        return run_command_with_launcher(configs, overrides, launcher, typed)
    print_run_summary(run_command_here(configs[0], typed, viewer, launcher))
    return 0


def _run_command_with_target(
    config: RunConfig, target: SearchTarget, budget: float, launcher: LauncherSettings, typed: CommandLine
) -> int:
    """Search for a model that reaches ``target``, for ``budget`` seconds; print the result; return the exit status."""
    from neuprim.cli.progress import RunProgress, print_run_summary
    from neuprim.search.target import run_target

    try:
        with RunProgress(f"{config.task}/{config.scene_name}", search=True) as events:
            record = run_target(config, target, budget, events, launcher=launcher)
    except KeyboardInterrupt:
        command = typed.resume_command(config.output_dir)
        raise KeyboardInterrupt(
            f"; {config.output_dir} holds the trials trained so far; to continue:\n  {command}"
        ) from None
    for line in _list_printed_target_lines(record):
        events.console.print(line)
    print_run_summary(Path(record.achieved["run_dir"]))
    return 0


def _list_printed_target_lines(record: TargetRecord) -> list[str]:
    """Return the text lines that report a finished search: predicted and achieved values, and why the search ended."""
    from neuprim.search.size_forecast import format_target_forecast
    from neuprim.search.target_record import TARGET_FILE

    found = record.achieved
    lines = [
        f"predicted {format_target_forecast(name, value, doubt)}; held out {found['held_out'][name]:.4g}; "
        f"test views {found['test'][name]:.4g}"
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


RUN_COMMAND = Command(
    "run", "fit a scene", _run_command, _add_run_arguments, _run_help, _RUN_SETTINGS, _refuse_bare_words
)


# ---------------------------------------------------------------- sweeps and launchers


def run_command_with_launcher(
    configs: Sequence[RunConfig], overrides: list[str], settings: LauncherSettings, typed: CommandLine
) -> int:
    """Train the runs of a sweep, or a single run, with a launcher; return the exit status.

    Args:
        configs: configuration of each run.
        overrides: ``KEY=VALUE`` arguments of the sweep, without settings of the launcher.
        settings: the launcher (this process, local processes, Ray or Slurm) and its settings.
        typed: the whole command line, from which the command that continues after Ctrl-C is made.
    """
    from neuprim.cli.progress import RunLaunchProgress, print_run_summary
    from neuprim.runs.ground_truth import render_ground_truth_of_runs
    from neuprim.runs.launch.launcher import LAUNCH_FOLDER, launch_jobs
    from neuprim.runs.sweep import make_run_job, run_sweep

    with RunLaunchProgress(configs) as progress:
        if len(configs) > 1:
            _, results = run_sweep(configs, overrides, settings, progress)
        else:
            render_ground_truth_of_runs(configs, settings, progress)
            results = launch_jobs([make_run_job(configs[0])], settings, configs[0].output_dir / LAUNCH_FOLDER, progress)
    status = _report_launched_runs(configs, results, progress.live, typed)
    if len(configs) > 1:
        print(configs[0].output_dir.parent / "sweep.html")
    elif status == 0:
        print_run_summary(configs[0].output_dir)
    return status


def _report_launched_runs(
    configs: Sequence[RunConfig], results: Sequence[JobResult | None], live: bool, typed: CommandLine
) -> int:
    """Report the results of launched runs; return the exit status: 1 if a run had a bug, 2 for bad input, else 0.

    If ``live``, a table on the terminal showed the progress. Then this function prints the errors of failed runs and,
    in a sweep, the directories of finished runs. Otherwise these lines were printed during the runs.

    Raises:
        KeyboardInterrupt: runs were interrupted. The message has the command that continues them.
    """
    status, left = 0, []
    for config, result in zip(configs, results, strict=True):
        if result is None or result.state == "interrupted":
            left.append(config.output_dir)
        elif result.state == "done":
            if live and len(configs) > 1:
                print(config.output_dir)
        else:
            if result.trace:
                print(result.trace, end="", file=sys.stderr)
            if live:
                print(f"neuprim: error: {config.output_dir}: {result.line}", file=sys.stderr)
            status = 1 if result.trace or status == 1 else 2
    if left and len(configs) == 1:
        raise KeyboardInterrupt(describe_interrupted_command(left[0], typed))
    if left:
        over = f"{left[0].parent} has {len(configs) - len(left)} of {len(configs)} finished runs"
        begun = sum((directory / "checkpoint.safetensors").exists() for directory in left)
        command = typed.resume_command(left[0])
        raise KeyboardInterrupt(f"; {over}, and checkpoints of {begun} others; to continue:\n  {command}")
    return status


# ---------------------------------------------------------------- truth


_TRUTH_HELP = """\
Prints the folder of the frames. Existing frames are kept, and a run with the same scene reads them. A launcher renders
frames in parallel:
  neuprim truth task=dynamic scene=vdb scene.vdb=DIR launcher=processes
  neuprim truth task=dynamic scene=vdb scene.vdb=DIR scene.cache=DIR launcher=slurm"""


def _add_truth_arguments(parser: argparse.ArgumentParser) -> None:
    every = "render for every combination of values separated by commas"
    parser.add_argument("-m", "--multirun", action="store_true", help=every)


def _truth_command(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import RunProgress
    from neuprim.config import compose, compose_all
    from neuprim.config.command_settings import take_launcher_overrides
    from neuprim.runs.ground_truth import launch_ground_truth_jobs

    launcher, rest = take_launcher_overrides(args.overrides)
    try:
        for config in compose_all(rest) if args.multirun else [compose(rest)]:
            with RunProgress(f"{config.task}/{config.scene_name}") as events:
                made = launch_ground_truth_jobs(config, launcher, events)
            if made is None:
                raise ConfigError(
                    f"scene={config.scene_name}: its images are not rendered frame by frame; expected "
                    "a scene of volumes, for example task=dynamic scene=vdb"
                )
            print(made.place, flush=True)
    except KeyboardInterrupt:
        command = shlex.join(["neuprim", "truth", *(["-m"] if args.multirun else []), *args.overrides])
        raise KeyboardInterrupt(f"; frames rendered so far are kept; to continue:\n  {command}") from None
    return 0


TRUTH_COMMAND = Command(
    "truth",
    "render the ground truth of a scene before runs need it",
    _truth_command,
    _add_truth_arguments,
    _TRUTH_HELP,
    "settings of the scene and of the launcher, as of `neuprim run`",
    _refuse_bare_words,
)


# ---------------------------------------------------------------- torchrun


def run_command_as_rank(place: TorchrunRank, words: list[str], more: bool) -> int:
    """Train one run in a process that torchrun started, and return the exit status.

    Several such processes (ranks) train one model together. Only the first rank that fails prints its error, one line.

    Args:
        place: rank of this process, and number of ranks.
        words: ``KEY=VALUE`` arguments of the run.
        more: whether the user typed ``-m``, ``--config`` or ``--print-config``, which are refused.
    """
    from neuprim.core.compute.threads import limit_process_threads, machine_cores
    from neuprim.core.train.process_group import ProcessGroup

    group = ProcessGroup(place, os.environ)

    def terminate(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if sys.exc_info()[0] is not None:  # it is ending already, with a more helpful error
            return
        raise group.explain_broken_connection(RankError("ended by SIGTERM"))

    # torchrun sends it when another rank ended; a training handles it by itself
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        with limit_process_threads(max(machine_cores() // place.local_size, 1)):
            _fit_with_rank_progress(_compose_rank_arguments(words, more, group), words, group)
        return 0
    except KeyboardInterrupt:
        group.record_failure("interrupted")
        if group.is_first:
            raise
        return 130
    except Exception as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # torchrun's signal would add a second message
        line = one_line(error)
        if line is None:
            group.record_failure(f"{type(error).__name__}: {error}")
            print(f"neuprim: rank {group.rank} failed:", file=sys.stderr)
            raise
        reported = isinstance(error, RankError) and error.reported
        if not reported and group.record_failure(line):
            where = "" if group.is_first or isinstance(error, RankError) else f"rank {group.rank}: "
            print(f"neuprim: error: {where}{line}", file=sys.stderr, flush=True)
        return 2
    finally:
        group.close()
        signal.signal(signal.SIGTERM, before)


def _compose_rank_arguments(words: list[str], more: bool, group: ProcessGroup) -> RunConfig:
    """Return the configuration of a rank (one of torchrun's processes), and select the GPU of the rank.

    All ranks use the output directory that rank 0 chooses and writes to. Arguments: see :func:`run_command_as_rank`.
    """
    from neuprim.config import compose
    from neuprim.config.command_settings import take_launcher_overrides, take_target_overrides, take_viewer_overrides

    more = more or any(
        len(take(words)[1]) < len(words)
        for take in (take_target_overrides, take_launcher_overrides, take_viewer_overrides)
    )
    if group.is_first and more:
        raise ConfigError(
            f"the {group.size} processes of torchrun train one run together; leave out -m, --config, "
            "--print-config, targets, launchers and the viewer"
        )
    config = compose(words) if group.is_first else None
    directory = group.gather(None if config is None else str(config.output_dir))[0]
    if config is None:
        config = compose(words, check_output=False)
        config.output_dir = Path(directory)
    _select_rank_gpu(config, group.place)
    return config


def _select_rank_gpu(config: RunConfig, place: TorchrunRank) -> None:
    """Make this process use GPU i if it is the i-th of torchrun's processes (ranks) on its machine.

    Does nothing on a machine without GPUs, or if the configuration asks for the CPU.

    Raises:
        BackendUnavailable: the machine has GPUs, but fewer GPUs than ranks.
    """
    import torch

    from neuprim.core.compute.device import CPU

    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if gpus == 0 or config.renderer.device == CPU:
        return
    if gpus < place.local_size:
        raise BackendUnavailable(
            f"renderer.device={config.renderer.device}: this machine has {gpus} GPUs for {place.local_size} ranks; "
            f"expected one GPU for each rank, or renderer.device={CPU}"
        )
    torch.cuda.set_device(place.local_rank)


def _fit_with_rank_progress(config: RunConfig, overrides: Sequence[str], group: ProcessGroup) -> None:
    """Train the run as one rank of ``group``. Only rank 0 shows the progress, and a summary at the end."""
    from neuprim.cli.progress import RunProgress, print_run_summary
    from neuprim.config.overrides import CommandLine
    from neuprim.runs.fit import ignore_run_event
    from neuprim.runs.run import run

    ranks = f"--nproc-per-node {group.place.local_size}" if group.size == group.place.local_size else "…"
    typed = CommandLine(overrides)
    try:
        if not group.is_first:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # rank 0 warns
                run(config, ignore_run_event, group=group)
            return
        with RunProgress(f"{config.task}/{config.scene_name}, {group.size} ranks") as events:
            run_dir = run(config, events, group=group)
        print_run_summary(run_dir)
    except RankError as error:
        command = f"torchrun {ranks} -m {typed.resume_command(config.output_dir)}"
        raise RankError(f"{error}; to continue: {command}", error.reported) from error
    except KeyboardInterrupt:
        # torchrun takes any other status than 0 for a failure, and ends rank 0, which still has to write
        if group.is_first:
            text = describe_interrupted_command(config.output_dir, typed)
            raise KeyboardInterrupt(text.replace("  neuprim run", f"  torchrun {ranks} -m neuprim run")) from None
