"""Pages, their links and the site's list of pages agree. The strict build of the site checks more, but needs mkdocs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.docs.pages import PAGES, ROOT, anchors, links, name_of

SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_and_pictures_exist(page: Path) -> None:
    broken = []
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        if not file.is_file() or not file.is_relative_to(ROOT):
            broken.append(target)
        elif anchor and file.suffix == ".md" and not anchor.startswith("neuprim.") and anchor not in anchors(file):
            broken.append(target)
    assert broken == []


def listed(entry: Any) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    return [page for child in (entry.values() if isinstance(entry, dict) else entry) for page in listed(child)]


def test_every_page_is_on_the_site() -> None:
    pages = [p.relative_to(ROOT / "docs").as_posix() for p in PAGES if p.is_relative_to(ROOT / "docs")]
    assert sorted(listed(SITE["nav"])) == sorted(pages)


def test_every_picture_is_shown() -> None:
    shown = {(page.parent / target).resolve() for page in PAGES for target in links(page)}
    pictures = {p for p in (ROOT / "docs" / "pictures").iterdir() if p.name != Path(SITE["theme"]["favicon"]).name}
    assert pictures <= shown
