"""The site: pages of this folder, a gallery page for each example, and the API by rooms.

``make docs`` builds it into ``out/site``, every warning an error. The snippets of the pages are run by the
tests before; examples run here, with few draws, and what they print and draw is what the gallery shows.
"""

from __future__ import annotations

import http.client
import os
import shutil
import sys
import urllib.request
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
sys.path[:0] = [str(ROOT), str(DOCS)]
os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])

from api_pages import escape_stars, write_pages  # noqa: E402
from gallery import Arguments, Pictures, gallery_sources  # noqa: E402

import bayesmc  # noqa: E402

project, author, copyright = "bayesmc", "the bayesmc developers", "the bayesmc developers"  # noqa: A001
release = version = bayesmc.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # formulas are set where there is no network, too
    "numpydoc",
    "sphinx_gallery.gen_gallery",
    "sphinx_design",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**/README.rst", "gallery/*.ipynb", "gallery/*.py", "gallery/*.md5"]
source_suffix = {".rst": "restructuredtext", ".md": "myst-nb"}
myst_enable_extensions = ["amsmath", "dollarmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the tests run every snippet and compare what it prints
autosummary_generate = True
autodoc_typehints = "none"
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme = "pydata_sphinx_theme"
html_title = "bayesmc"
html_sidebars = {"coming/*": []}  # two columns of code want the whole width
html_show_sourcelink = False
html_theme_options = {
    "navbar_align": "left",
    "show_prev_next": True,
    "secondary_sidebar_items": ["page-toc"],
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": ["theme-version"],
}
mathjax_path = "mathjax/tex-chtml.js"
suppress_warnings = ["config.cache", "sphinx_gallery.space_in_filename"]

#: other projects' pages
NEIGHBOURS = {
    "python": "https://docs.python.org/3",
    "numpy": "https://numpy.org/doc/stable",
    "scipy": "https://docs.scipy.org/doc/scipy",
    "matplotlib": "https://matplotlib.org/stable",
    "networkx": "https://networkx.org/documentation/stable",
}


def _inventories() -> dict[str, tuple[str, str]]:
    """Lists of what neighbours have pages on, as far as they can be fetched: to lack one is no warning."""
    folder, found = ROOT / "out" / "inventories", {}
    folder.mkdir(parents=True, exist_ok=True)
    for name, page in NEIGHBOURS.items():
        try:
            with urllib.request.urlopen(f"{page}/objects.inv", timeout=3.0) as answer:
                text = answer.read()
        except (OSError, http.client.HTTPException):
            continue
        if text.startswith(b"# Sphinx inventory version"):
            (folder / name).write_bytes(text)
            found[name] = (page, str(folder / name))
    return found


intersphinx_mapping = _inventories()

write_pages(DOCS / "api")
SOURCES = gallery_sources(ROOT / "examples", DOCS / "_gallery")
sphinx_gallery_conf = {
    "examples_dirs": [str(SOURCES)],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "reset_argv": Arguments(),
    "image_scrapers": (Pictures(),),
    "download_all_examples": False,
    "show_memory": False,
    "remove_config_comments": True,
    "abort_on_example_error": True,
    "min_reported_time": 1e9,
    "show_signature": False,
    "within_subsection_order": "FileNameSortKey",
}


def setup(app):  # noqa: ANN001, ANN201
    """Nothing of an earlier gallery is left once its sources are gone."""
    app.connect("autodoc-process-docstring", escape_stars)
    app.connect("build-finished", lambda *_: shutil.rmtree(SOURCES, ignore_errors=True))
