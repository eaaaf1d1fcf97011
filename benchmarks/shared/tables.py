"""Tables in README and docs: printed as they grow, and put between their markers so that no number is typed by hand."""

from __future__ import annotations

import statistics
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PERFORMANCE = ROOT / "docs" / "performance.md"


def between_markers(page: Path, name: str, text: str) -> None:
    """Replace what stands between <!-- name --> and <!-- /name -->."""
    first, last = f"<!-- {name} -->", f"<!-- /{name} -->"
    head, rest = page.read_text().split(first, 1)
    _, tail = rest.split(last, 1)
    page.write_text(f"{head}{first}\n{text.rstrip()}\n{last}{tail}")


class Table:
    """A Markdown table that prints every row as it comes."""

    def __init__(self, *columns: str) -> None:
        self.lines: list[str] = []
        self.row(*columns)
        self.row(*["---"] * len(columns))

    def row(self, *cells: object) -> None:
        self.lines.append("| " + " | ".join(str(c) for c in cells) + " |")
        print(self.lines[-1], flush=True)

    def __str__(self) -> str:
        return "\n".join(self.lines)


def spread(values: list[float], digits: int) -> str:
    """Mean ± half the spread."""
    half = (max(values) - min(values)) / 2
    return f"{statistics.mean(values):.{digits}f}" + (f" ± {half:.{digits}f}" if len(values) > 1 else "")
