"""The documentation as data: pages, their code blocks, commands and links."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]

_FENCE = re.compile(
    r"^(?P<mark>`{3,}|~{3,})[ \t]*(?P<language>\w*)[^\n]*\n(?P<text>.*?)^(?P=mark)[ \t]*$", re.DOTALL | re.MULTILINE
)
_NOT_RUN = re.compile(r"<!--\s*not run:\s*(\S.*?)\s*-->\s*$")
_HEADING = re.compile(r"^#{1,6} +(.+?) *#*$", re.MULTILINE)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@dataclass(frozen=True)
class Block:
    """A fenced block; ``line`` is that of its first line of code, ``skipped`` the reason in a comment ``<!-- not run: …
    -->`` before it."""

    page: Path
    line: int
    language: str
    text: str
    skipped: str | None


def blocks(page: Path) -> list[Block]:
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _FENCE.finditer(text):
        comment = _NOT_RUN.search(text[: match.start()].rstrip("\n"))
        line = text[: match.start("text")].count("\n") + 1
        found.append(Block(page, line, match["language"], match["text"], comment[1] if comment else None))
    return found


def commands(block: Block, program: str) -> Iterator[list[str]]:
    """The words after ``program`` in every command of a shell block; comments, ellipses and the brackets of
    ``[--optional X]`` are left out."""
    for line in block.text.replace("\\\n", " ").splitlines():
        part: list[str] = []
        optional = False
        lexer = shlex.shlex(line, posix=True, punctuation_chars="&;|")
        lexer.whitespace_split, lexer.commenters = True, "#"
        for word in [*lexer, ";"]:
            if not re.fullmatch(r"[&;|]+", word):
                optional = optional or word.startswith("[--")
                plain = word.removeprefix("[").removesuffix("]") if optional else word
                optional = optional and not word.endswith("]")
                part += [plain] * (plain != "…")
                continue
            at = next((i for i, w in enumerate(part) if w == program or w.endswith("/" + program)), None)
            if at is not None:
                yield part[at + 1 :]
            part = []


def prose(page: Path) -> str:
    """The page without its fenced blocks and inline code."""
    text = _FENCE.sub("", page.read_text(encoding="utf-8"))
    return re.sub(r"(`+)(?:(?!\1).)+?\1", "", text)


def links(page: Path) -> list[str]:
    """Targets of links and pictures that are not addresses of the network."""
    text = prose(page)
    found = re.findall(r"\]\(([^)\s]+)(?: +\"[^\"]*\")?\)", text) + re.findall(
        r"<(?:img|a)[^>]*(?:src|href)=\"([^\"]+)\"", text
    )
    return [target for target in found if not re.match(r"[a-z]+:", target)]


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as mkdocs makes them."""
    names: set[str] = set()
    for heading in _HEADING.findall(_FENCE.sub("", page.read_text(encoding="utf-8"))):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).replace("`", "")
        slug = re.sub(r"[^\w\s-]", "", plain.encode("ascii", "ignore").decode()).strip().lower()
        names.add(re.sub(r"[-\s]+", "-", slug))
    return names
