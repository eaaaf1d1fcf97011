"""The terminal, for text that is printed as it is.

rich reads ``[name]`` as markup and ``:name:`` as an emoji, and leaves out what it takes for either: ``pip install
'neuprim[video]'`` would lose its extra, and a path its folder. Names, paths and commands come from outside, so nothing
here is markup.
"""

from __future__ import annotations

from rich.console import Console

__all__ = ["plain_console"]


def plain_console(stderr: bool = False) -> Console:
    """A console without markup, emoji or guessed colours; lines are as long as their text."""
    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True)
