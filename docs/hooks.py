"""What mkdocs does not do by itself; used by ``mkdocs.yml`` (``hooks``).

* Links of a page to files of the repository outside ``docs/`` work on the code host as they are; on the site the file
  is copied along.
* ``:class:`~neuprim.core.errors.DataError` `` in docstrings becomes a link where the object is documented, else its
  name.
* A page that would load something from the network fails the strict build.
"""

from __future__ import annotations

import html
import logging
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).parents[1]
log = logging.getLogger("mkdocs.hooks.neuprim")

INCLUDES = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}
"""Pages that are files of the repository's root, whose links are relative to it."""
OUTWARD = re.compile(r"\]\(((?:\.\./)+)([^)#\s]+)\)")
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):<code[^>]*>(~?)([\w.]+)(?:\(\))?</code>")
LOADED = re.compile(
    r"<(?:script|link|img|iframe|source|video|audio|embed|object)\b[^>]*?\b(?:src|href|data)=[\"']?((?:https?:)?//[^\"'>\s]+)",
    re.I,
)


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links that leave ``docs/``."""
    if page.file.src_uri in INCLUDES:
        markdown = (ROOT / INCLUDES[page.file.src_uri]).read_text(encoding="utf-8")
        for name, source in INCLUDES.items():
            markdown = markdown.replace(f"]({source}", f"]({name}")
        return re.sub(r"\]\(docs/", "](", markdown)

    def inside(match: re.Match[str]) -> str:
        up, target = match.groups()
        folder = Path(page.file.src_uri).parent
        path = (ROOT / "docs" / folder / up / target).resolve()
        if not path.is_file() or not path.is_relative_to(ROOT) or path.is_relative_to(ROOT / "docs"):
            return match.group(0)  # mkdocs looks after it
        uri = path.relative_to(ROOT).as_posix()
        for name, source in INCLUDES.items():
            if uri == source:
                return f"]({'../' * len(folder.parts)}{name})"
        if files.get_file_from_path(uri) is None:
            files.append(
                File(uri, str(ROOT), config.site_dir, config.use_directory_urls, inclusion=InclusionLevel.INCLUDED)
            )
        return f"]({'../' * len(folder.parts)}{uri})"

    return OUTWARD.sub(inside, markdown)


def on_page_content(content: str, **_: Any) -> str:
    """Roles of Sphinx in docstrings."""

    def link(match: re.Match[str]) -> str:
        short, name = match.groups()
        shown = html.escape(name.rsplit(".", 1)[-1] if short else name)
        return f'<autoref identifier="{html.escape(name)}" optional><code>{shown}</code></autoref>'

    return ROLE.sub(link, content)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    for address in LOADED.findall(output):
        log.warning("%s would load %s from the network", page.file.src_uri, address)
    return output
