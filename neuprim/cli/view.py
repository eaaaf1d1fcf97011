"""``neuprim view``, and what a viewer beside a training prints."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.cli.progress import RunProgress
    from neuprim.config import RunConfig
    from neuprim.config.viewer import ViewerSettings

__all__ = ["for_view", "run_viewed", "view"]


def for_view(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments."""
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument(
        "--port", type=_port, default=8080, metavar="N", help="of the page's address; 0 for any (default: 8080)"
    )
    parser.add_argument(
        "--host", metavar="ADDRESS", help="to listen on (default: 127.0.0.1, which this machine alone reaches)"
    )


def view(args: argparse.Namespace) -> int:
    """Shows the run until Ctrl-C."""
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import LineProgress
    from neuprim.config.viewer import ViewerSettings
    from neuprim.viewer.view import view_run

    settings = ViewerSettings(port=args.port) if args.host is None else ViewerSettings(args.host, args.port)
    _warn_of_others(settings)
    console = plain_console(stderr=True)

    def opened(address: str) -> None:
        print(f"{address}\nopen it in a browser; Ctrl-C ends the viewer", flush=True)

    try:
        view_run(
            args.run_dir,
            settings,
            opened,
            lambda text: console.print(f"neuprim: {text}", markup=False),
            LineProgress(console),
        )
    except KeyboardInterrupt:
        print("neuprim: the viewer is closed", file=sys.stderr)
    return 0


def run_viewed(config: RunConfig, events: RunProgress, settings: ViewerSettings) -> Path:
    """``neuprim run`` with a page beside the training; raises as :func:`neuprim.runs.run.run`."""
    from neuprim.runs.events import Note
    from neuprim.runs.run import run
    from neuprim.viewer.training import LiveTraining

    _warn_of_others(settings)
    with LiveTraining(settings, config, lambda address: events(Note(f"the viewer is at {address}")), events) as live:
        return run(config, live, live.between)


def _warn_of_others(settings: ViewerSettings) -> None:
    """A page that others can reach is worth a word."""
    from neuprim.config.viewer import LOOPBACK
    from neuprim.viewer.server import is_loopback

    if is_loopback(settings.host):
        return
    print(
        f"neuprim: warning: the viewer at {settings.host} is reached from other machines, without encryption: whoever can read the network can "
        f"read its token. Safer: leave the host out, and on the other machine `ssh -L {settings.port or 8080}:{LOOPBACK}:{settings.port or 8080} THIS_MACHINE`",
        file=sys.stderr,
    )


def _port(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise ConfigError(f"--port {text}: expected a port, 1 to 65535, or 0 for any")
    return int(text)
