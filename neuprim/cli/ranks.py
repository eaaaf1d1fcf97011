"""``torchrun -m neuprim run``: one run by several processes, of which the first one speaks."""

from __future__ import annotations

import os
import shlex
import signal
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from neuprim.core.errors import BackendUnavailable, ConfigError, RankError, one_line

if TYPE_CHECKING:
    from neuprim.config import RunConfig
    from neuprim.core.train.distributed.group import Group
    from neuprim.core.train.distributed.place import Place

__all__ = ["run_as_rank"]


def run_as_rank(place: Place, words: list[str], more: bool) -> int:
    """Fit one scene as one of several ranks; returns the exit status.

    What goes wrong is one line, whoever finds it: of all ranks, the first to say so.

    Args:
        words: the overrides.
        more: whether anything but one run is asked for.
    """
    from neuprim.core.compute.threads import limit_process_threads, machine_cores
    from neuprim.core.train.distributed.group import Group
    from neuprim.core.train.distributed.wire import Wire

    group = Group(place, Wire(place, os.environ))
    failed = True

    def terminated(number: int, frame: FrameType | None) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise group.cause(RankError("ended by SIGTERM"))

    before = signal.signal(
        signal.SIGTERM, terminated
    )  # torchrun sends it where another rank died; a training listens for it itself
    try:
        with limit_process_threads(max(machine_cores() // place.local_size, 1)):
            _fit(_composed(words, more, group), words, group)
        failed = False
        return 0
    except KeyboardInterrupt:
        group.fail("interrupted")
        if group.first:
            raise
        return 130
    except Exception as error:
        line = one_line(error)
        if line is None:
            group.fail(f"{type(error).__name__}: {error}")
            print(f"neuprim: rank {group.rank} failed:", file=sys.stderr)
            raise
        if not (isinstance(error, RankError) and error.told):
            said = group.fail(line, isinstance(error, RankError))
            if said is not None:
                print(f"neuprim: error: {said}", file=sys.stderr, flush=True)
        return 2
    finally:
        group.close(failed)
        signal.signal(signal.SIGTERM, before)


def _composed(words: list[str], more: bool, group: Group) -> RunConfig:
    """The configuration; where the first rank writes is where the run is, as the others find its files there."""
    from neuprim.config import compose
    from neuprim.config.launcher import take_launcher
    from neuprim.config.target import take_target
    from neuprim.config.viewer import take_viewer

    elsewhere = any(len(split(words)[1]) < len(words) for split in (take_target, take_launcher, take_viewer))
    if group.first and (more or elsewhere):
        raise ConfigError(
            f"{group.size} processes of torchrun fit one scene together; expected neither -m, --config, --cfg, a target, a launcher, nor a viewer"
        )
    config = compose(words) if group.first else None
    directory = group.tell({"output_dir": "" if config is None else str(config.output_dir)})[0]["output_dir"]
    if config is None:
        config = replace(compose(words, check_output=False), output_dir=Path(directory))
    _choose_card(config, group.place)
    return config


def _choose_card(config: RunConfig, place: Place) -> None:
    """A card for each rank of a machine, the first for the first.

    Raises:
        BackendUnavailable: there are cards, and too few.
    """
    import torch

    from neuprim.core.compute.device import CPU

    cards = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if cards == 0 or config.renderer.device == CPU:
        return
    if cards < place.local_size:
        raise BackendUnavailable(
            f"renderer.device={config.renderer.device}: {cards} cards for {place.local_size} ranks of this machine; "
            f"expected a card for each, or renderer.device={CPU}"
        )
    torch.cuda.set_device(place.local_rank)


def _fit(config: RunConfig, words: Sequence[str], group: Group) -> bool:
    """Train, and on the first rank say so; returns False."""
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import RunProgress
    from neuprim.config.overrides import CommandLine
    from neuprim.runs.events import silent
    from neuprim.runs.run import run

    place = group.place
    launcher = f"torchrun --nproc-per-node {place.local_size}" if place.size == place.local_size else "torchrun …"
    command = f"{launcher} -m {shlex.join(['neuprim', 'run', *CommandLine(words).resume_arguments(config.output_dir)])}"
    try:
        if not group.first:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the first rank warns
                run(config, silent, ranks=group)
            return False
        with RunProgress(
            plain_console(stderr=True), f"{config.task}/{config.scene_name}, {group.size} ranks"
        ) as events:
            print(run(config, events, ranks=group))
    except RankError as error:
        raise RankError(f"{error}; to go on: {command}", error.told) from error
    except KeyboardInterrupt:
        if not group.first:
            # torchrun takes any other status for a failure, and ends the first rank, which has the rest to do
            return False
        there = (
            "has the run up to here"
            if (config.output_dir / "checkpoint.safetensors").exists()
            else "has no checkpoint yet"
        )
        raise KeyboardInterrupt(
            f"; {config.output_dir} {there}; to go on, with any number of processes:\n  {command}"
        ) from None
    return False
