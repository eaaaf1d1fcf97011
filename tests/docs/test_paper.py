"""What pages say of the paper: its equations by the numbers of the appendix, and every preset that follows it in the
lists of what differs."""

from __future__ import annotations

import re

import pytest

from neuprim.config import presets
from neuprim.plugins.registry import load_task
from tests.docs.pages import ROOT

FILES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *(
        file
        for folder in ("docs", "neuprim", "benchmarks")
        for kind in ("*.md", "*.py", "*.yaml")
        for file in (ROOT / folder).rglob(kind)
    ),
]
MATHEMATICS = (ROOT / "docs" / "mathematics.md").read_text(encoding="utf-8")


def test_equations_have_the_numbers_of_the_appendix() -> None:
    """10 to 12 are colour in time, 13 is the density in time, 14 colour under a light; the density of a static
    primitive has no number there."""
    found = [
        (file.relative_to(ROOT).as_posix(), match[0].lower().replace("–", " to "))
        for file in FILES
        for match in re.finditer(
            r"\bequations? (\d+)(?:(?: to |–)(\d+))?", file.read_text(encoding="utf-8"), re.IGNORECASE
        )
    ]
    known = {f"equation {n}" for n in (11, 12, 13, 14)} | {f"equations 10 to {n}" for n in (12, 13, 14)}
    assert [entry for entry in found if entry[1] not in known] == []
    assert len(found) > 30 and any("mathematics" in file for file, _ in found)


@pytest.mark.parametrize("task", ["static", "dynamic", "relight"])
def test_every_preset_of_the_paper_is_in_the_lists_of_what_differs(task: str) -> None:
    own = [name for name in presets(load_task(task)) if name.startswith("paper")]
    title = {"static": "Static", "dynamic": "Dynamic", "relight": "Relighting"}[task]
    heading = (
        f"**{title}** ("
        + ", ".join(
            f"`{name}`" for name in ["paper", *(n for n in ("paper_real", "paper_200", "paper_5k") if n in own)]
        )
        + "):"
    )
    assert heading in MATHEMATICS and len(own) == heading.count("`") // 2
    table = MATHEMATICS.split(heading)[1].split("\n\n")[1]
    assert table.startswith("| | paper, or its released code | here | why |") and len(table.splitlines()) > 3


def test_no_page_says_that_shadows_cannot_be_learned() -> None:
    """Equation 14 has 18.0 dB in cast shadows, a constant colour 12.2: it learns them, and worse."""
    claims = re.compile(r"(?:does not|cannot|never) learn\w* (?:cast )?shadows", re.IGNORECASE)
    assert [file.name for file in FILES if claims.search(" ".join(file.read_text(encoding="utf-8").split()))] == []
