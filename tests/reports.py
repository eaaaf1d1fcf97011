"""What a report's page offers its reader to type."""

from __future__ import annotations

import html
import re
import shlex
from pathlib import Path


def offered(page: Path) -> list[list[str]]:
    """The words of each command under "Next steps", without ``neuprim`` itself."""
    listed = re.search(r'<ul class="commands">(.*?)</ul>', page.read_text(encoding="utf-8"), re.DOTALL)
    assert listed is not None
    lines = [shlex.split(html.unescape(line)) for line in re.findall(r"<code>(.*?)</code>", listed[1])]
    assert all(words[0] == "neuprim" for words in lines)
    return [words[1:] for words in lines]
