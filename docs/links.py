"""Are the links of the built site whole? ``python docs/links.py out/site`` names those that lead nowhere.

Links within the site only, to their anchors; nothing is looked up on a network.
"""

from __future__ import annotations

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

#: pages that Sphinx writes with links of their own kind
OTHERS = ("genindex", "py-modindex", "search")


class Page(HTMLParser):
    """What a page links to, and what in it can be linked to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for key, value in attrs:
            if value and key in ("id", "name"):
                self.anchors.add(value)
            if value and (tag, key) in (
                ("a", "href"),
                ("img", "src"),
                ("link", "href"),
                ("script", "src"),
            ):
                self.targets.append(value)


def broken(site: Path) -> list[str]:
    """``page: target`` of every link within the site whose file or anchor is not there."""
    paths = sorted(path for path in site.rglob("*.html") if "_static" not in path.parts)
    pages = {path.resolve(): Page(path.read_text("utf-8")) for path in paths}
    return [
        f"{path.relative_to(site.resolve())}: {target}"
        for path, page in pages.items()
        for target in page.targets
        if path.stem not in OTHERS and not _leads(path, target, pages)
    ]


def _leads(path: Path, target: str, pages: dict[Path, Page]) -> bool:
    parts = urlsplit(target)
    if parts.scheme or parts.netloc:
        return True
    file = (path.parent / unquote(parts.path)).resolve() if parts.path else path
    if file not in pages or not parts.fragment:
        return file.exists()
    return unquote(parts.fragment) in pages[file].anchors


if __name__ == "__main__":
    found = broken(Path(sys.argv[1]))
    print(*found, sep="\n", end="\n" if found else "")
    sys.exit(f"{len(found)} links lead nowhere" if found else 0)
