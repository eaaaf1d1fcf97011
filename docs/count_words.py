"""Count the hand-written words of the README and the site.

    python docs/count_words.py [--most WORDS]

Prints the words of each page and their sum. Words are counted as `wc -w` does, code blocks included. Generated text
does not count: blocks between <!-- name --> and <!-- /name -->, the API pages, the pages that docs/make_reference.py
writes, and all tables of the results pages. Nor does the changelog. --most exits with status 1 if the sum is larger.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
LEFT_OUT = {"docs/cli.md", "docs/settings.md", "docs/changelog.md", "docs/contributing.md"}
"""Generated pages, and the stubs of files that lie outside of docs."""
_BLOCK = re.compile(r"^<!-- (?P<name>[\w -]+) -->\n.*?^<!-- /(?P=name) -->$", re.DOTALL | re.MULTILINE)
_TABLE_ROW = re.compile(r"^\|.*$", re.MULTILINE)


def hand_written(text: str, tables: bool = True) -> int:
    """Return the words of a page without its generated blocks, and without its tables unless ``tables``."""
    text = _BLOCK.sub("", text)
    return len((text if tables else _TABLE_ROW.sub("", text)).split())


def count() -> dict[str, int]:
    """Return the hand-written words of each page, by its path in the repository."""
    found = {}
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        name = page.relative_to(ROOT).as_posix()
        if name not in LEFT_OUT and not name.startswith("docs/api/"):
            tables = not name.startswith("docs/results/")
            found[name] = hand_written(page.read_text(encoding="utf-8"), tables)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=int, metavar="WORDS", help="exit with status 1 if there are more")
    args = parser.parse_args()
    found = count()
    for name, words in found.items():
        print(f"{words:7,} {name}")
    total = sum(found.values())
    print(f"{total:7,} words")
    return int(args.most is not None and total > args.most)


if __name__ == "__main__":
    raise SystemExit(main())
