"""``torchrun -m neuprim run``: one run by several processes, of which rank 0 writes and prints."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from neuprim.core.errors import BackendUnavailable, ConfigError, RankError, one_line

if TYPE_CHECKING:
    from neuprim.config import RunConfig
    from neuprim.core.train.distributed.process_group import ProcessGroup
    from neuprim.core.train.distributed.torchrun import TorchrunRank


def run_as_rank(place: TorchrunRank, words: list[str], more: bool) -> int:
    """Fit one scene as one of several ranks; returns the exit status.

    An error is printed once, in one line, by the first rank that fails.

    Args:
        words: the overrides.
        more: whether anything but one run was asked for.
    """
    from neuprim.core.compute.threads import limit_process_threads, machine_cores
    from neuprim.core.train.distributed.process_group import ProcessGroup

    group = ProcessGroup(place, os.environ)

    def terminate(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if sys.exc_info()[0] is not None:  # on its way out already, with an error that says more
            return
        raise group.explain(RankError("ended by SIGTERM"))

    # torchrun sends it when another rank ended; a training handles it by itself
    before = signal.signal(signal.SIGTERM, terminate)
    try:
        with limit_process_threads(max(machine_cores() // place.local_size, 1)):
            _fit(_compose(words, more, group), words, group)
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


def _compose(words: list[str], more: bool, group: ProcessGroup) -> RunConfig:
    """Compose the configuration; all ranks take the output directory of rank 0, which writes there."""
    from neuprim.config import compose
    from neuprim.config.command_settings import take_launcher, take_target, take_viewer

    more = more or any(len(take(words)[1]) < len(words) for take in (take_target, take_launcher, take_viewer))
    if group.is_first and more:
        raise ConfigError(
            f"{group.size} processes of torchrun fit one scene together; expected neither -m, --config, --cfg, "
            "a target, a launcher, nor a viewer"
        )
    config = compose(words) if group.is_first else None
    directory = group.gather(None if config is None else str(config.output_dir))[0]
    if config is None:
        config = compose(words, check_output=False)
        config.output_dir = Path(directory)
    _select_gpu(config, group.place)
    return config


def _select_gpu(config: RunConfig, place: TorchrunRank) -> None:
    """Use GPU i for the i-th rank of a machine.

    Raises:
        BackendUnavailable: there are GPUs, but fewer than ranks.
    """
    import torch

    from neuprim.core.compute.device import CPU

    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if gpus == 0 or config.renderer.device == CPU:
        return
    if gpus < place.local_size:
        raise BackendUnavailable(
            f"renderer.device={config.renderer.device}: {gpus} GPUs for {place.local_size} ranks of this machine; "
            f"expected one for each, or renderer.device={CPU}"
        )
    torch.cuda.set_device(place.local_rank)


def _fit(config: RunConfig, overrides: Sequence[str], group: ProcessGroup) -> None:
    """Train, and show it on rank 0."""
    from neuprim.cli.command import describe_interruption
    from neuprim.cli.progress import RunProgress
    from neuprim.config.overrides import CommandLine
    from neuprim.runs.fit import ignore_event
    from neuprim.runs.run import run

    ranks = f"--nproc-per-node {group.place.local_size}" if group.size == group.place.local_size else "…"
    typed = CommandLine(overrides)
    try:
        if not group.is_first:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # rank 0 warns
                run(config, ignore_event, group=group)
            return
        with RunProgress(f"{config.task}/{config.scene_name}, {group.size} ranks") as events:
            print(run(config, events, group=group))
    except RankError as error:
        command = f"torchrun {ranks} -m {typed.resume_command(config.output_dir)}"
        raise RankError(f"{error}; to go on: {command}", error.reported) from error
    except KeyboardInterrupt:
        # torchrun takes any other status than 0 for a failure, and ends rank 0, which still has to write
        if group.is_first:
            text = describe_interruption(config.output_dir, typed)
            raise KeyboardInterrupt(text.replace("  neuprim run", f"  torchrun {ranks} -m neuprim run")) from None
