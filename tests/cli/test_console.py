"""What reaches the terminal is what was said: brackets and colons in names, paths and commands are no markup."""

from __future__ import annotations

import ast
import io
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

import neuprim
from neuprim.cli.command import plain_console
from neuprim.cli.progress import DrawProgress, RunProgress
from neuprim.core.train.trainer import StepReport
from neuprim.runs.fit import Finishing, Note, Preparing, Step

ODD = "pip install 'neuprim[video]' [bold]loud[/bold] [/] :smile: C:dir:x"
"""Markup that would vanish, a closing tag that would raise, an emoji's name."""


def train(console: Console) -> None:
    with RunProgress(ODD, console) as progress:
        progress(Preparing(ODD, 0.5))
        progress(Step(StepReport(1, 0.1, 0.5, {}, 20.0, 10, "view", None), 0.5))
        progress(Finishing(ODD))
        progress(Note(ODD))


def draw(console: Console) -> None:
    with DrawProgress(console) as progress:
        progress.print_note(ODD)
        progress.show(ODD, 0.5)
        progress.bar.refresh()


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("show", [train, draw])
def test_progress_shows_text_as_it_is(show: Callable[[Console], None], terminal: bool) -> None:
    text = io.StringIO()
    show(plain_console(file=text, width=400, force_terminal=terminal, color_system=None, legacy_windows=False))
    lines = [line for line in text.getvalue().replace("\r", "\n").splitlines() if "neuprim" in line]
    assert lines and any(ODD in line for line in lines)
    assert all("[video]" in line and ":smile:" in line for line in lines if "pip install" in line), lines


def test_every_console_is_a_plain_one() -> None:
    root = Path(neuprim.__file__).parent
    made = [
        str(file.relative_to(root))
        for file in sorted(root.rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "Console"
    ]
    assert made == ["cli/command.py"]
