"""Examples as pages of a gallery: what sphinx-gallery is given, and how it finds their pictures.

Examples are scripts that take ``--fast`` and ``--out``, and write their pictures to files. sphinx-gallery
wants a heading at the top of each, and figures: a copy with a heading is made here, and the files are taken.
"""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path
from typing import Any

from sphinx_gallery.scrapers import figure_rst

#: scripts of that folder that show nothing by themselves
HELPERS = re.compile(r"^(__init__|demo|picture|reference|compare|data_.*|rendered)$")
#: where a script writes, seen from its own folder: what it prints then shows no path of this machine
OUT = "out"
#: how words of file names are written
WORDS = {
    word.lower(): word
    for word in ("Faithful", "Gibbs", "GNP", "Ising", "Merwe", "MPI", "Nile", "SLAM", "TrueSkill")
}
#: what a picture has to be for a page to show it
SHOWN = (".png", ".gif")


def gallery_sources(examples: Path, target: Path) -> Path:
    """Copies of all examples that make a picture, with a heading each, in an emptied folder."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    (target / "README.rst").write_text(
        "Gallery\n=======\n\nWhat each script of ``examples/`` prints and draws, here with few draws; "
        "``python -m examples.nile`` runs one in full.\n",
        encoding="utf-8",
    )
    for path in sorted(examples.glob("*.py")):
        text = path.read_text(encoding="utf-8")
        if HELPERS.match(path.stem) or "def main(" not in text:
            continue
        (target / path.name).write_text(_with_heading(path.stem, text), encoding="utf-8")
    return target


class Arguments:
    """What a script finds on its command line."""

    def __repr__(self) -> str:  # part of sphinx-gallery's record of its options
        return "Arguments"

    def __call__(self, _: Any, variables: dict[str, Any]) -> list[str]:
        return ["--fast", "--out", OUT]


class Pictures:
    """A scraper: the files that a script has written since the last look."""

    def __repr__(self) -> str:  # part of sphinx-gallery's record of its options
        return "Pictures"

    def __call__(self, _: Any, variables: dict[str, Any], conf: dict[str, Any]) -> str:
        folder, paths = Path(variables["src_file"]).parent / OUT, variables["image_path_iterator"]
        taken = []
        for path in sorted(folder.glob("*")):
            if path.suffix in SHOWN:
                place = Path(next(paths)).with_suffix(path.suffix)
                shutil.move(path, place)
                taken.append(str(place))
        return figure_rst(taken, conf["src_dir"])


def _with_heading(stem: str, text: str) -> str:
    """The name of the file in words above its docstring."""
    title = " ".join(WORDS.get(word, word) for word in stem.split("_"))
    title = title[0].upper() + title[1:]
    doc = ast.get_docstring(ast.parse(text), clean=False) or ""
    rest = text.split('"""', 2)[2]
    return f'r"""\n{title}\n{"=" * len(title)}\n\n{_as_markup(doc)}\n"""{rest}'


def _as_markup(doc: str) -> str:
    """Indented paragraphs as they stand; bars and stars that mean themselves."""
    found = []
    for paragraph in doc.strip("\n").split("\n\n"):
        if paragraph.startswith("    "):
            found.append("::\n\n" + paragraph)
        else:
            found.append(re.sub(r"(?<!\\)([|]|(?<!\*)\*(?=\w))", r"\\\1", paragraph))
    return "\n\n".join(found)
