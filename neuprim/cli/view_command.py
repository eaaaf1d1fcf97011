"""``neuprim view``: look at a run in the browser; and the viewer of a training."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.cli.progress import RunProgress
    from neuprim.config import RunConfig
    from neuprim.config.command_settings import ViewerSettings


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    port = "of the page's address; 0 for any (default: 8080)"
    parser.add_argument("--port", type=_parse_port, default=8080, metavar="N", help=port)
    host = "to listen on (default: 127.0.0.1, which this machine alone reaches)"
    parser.add_argument("--host", metavar="ADDRESS", help=host)


def _view(args: argparse.Namespace) -> int:
    """Show the run until Ctrl-C."""
    from neuprim.cli.progress import LineProgress
    from neuprim.config.command_settings import LOOPBACK, ViewerSettings
    from neuprim.viewer.view import view_run

    settings = ViewerSettings(args.host or LOOPBACK, args.port)
    _warn_of_open_host(settings)
    progress = LineProgress()

    def print_address(address: str) -> None:
        print(f"{address}\nopen it in a browser; Ctrl-C ends the viewer", flush=True)

    def print_note(text: str) -> None:
        progress.console.print(f"neuprim: {text}")

    try:
        view_run(args.run_dir, settings, print_address, print_note, progress)
    except KeyboardInterrupt:
        print("neuprim: the viewer is closed", file=sys.stderr)
    return 0


def run_viewed(config: RunConfig, events: RunProgress, settings: ViewerSettings) -> Path:
    """Run a training with a live viewer; raise as :func:`neuprim.runs.run.run`."""
    from neuprim.runs.fit import Note
    from neuprim.runs.run import run
    from neuprim.viewer.live_training import LiveTraining

    _warn_of_open_host(settings)
    with LiveTraining(settings, config, lambda address: events(Note(f"the viewer is at {address}")), events) as live:
        return run(config, live, live.between)


def _warn_of_open_host(settings: ViewerSettings) -> None:
    from neuprim.config.command_settings import LOOPBACK
    from neuprim.viewer.server import is_loopback

    if not is_loopback(settings.host):
        port = settings.port or 8080
        print(
            f"neuprim: warning: other machines can reach the viewer at {settings.host}, without encryption: whoever "
            "can read the network can read its token. Safer: leave the host out, and type on the other machine "
            f"`ssh -L {port}:{LOOPBACK}:{port} THIS_MACHINE`",
            file=sys.stderr,
        )


def _parse_port(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or int(text) > 65535:
        raise ConfigError(f"--port {text}: expected a port, 1 to 65535, or 0 for any")
    return int(text)


COMMAND = Command(
    "view",
    "look at a run in the browser: turn it, play it, move its light, edit a camera path",
    _view,
    _add_arguments,
    opens_run=True,
)
