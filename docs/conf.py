"""The docs site: ``make docs`` builds it into out/site, without a network."""

import shutil
import sys
from pathlib import Path

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent))
from reference_pages import write_pages

import nlosrender

project, version = "nlosrender", nlosrender.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
root_doc = "README"  # pages keep their places in the repository, and their links
include_patterns = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "docs/reference/*.md"]
exclude_patterns = [".*", "out", "build"]
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]
smartquotes = False  # options begin with two hyphens
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
html_theme = "furo"
html_theme_options = {key: {"code-font-size": "0.75rem"} for key in ("light_css_variables", "dark_css_variables")}
html_static_path, html_css_files = ["site"], ["wide.css"]
html_title = f"nlosrender {version}"
html_copy_source = html_show_sphinx = html_show_copyright = False

CONTENTS = {
    "Start": ("docs/getting-started", "docs/reference/notebook"),
    "How to": (
        *("docs/scans", "docs/meshes", "docs/textures", "docs/retroreflectors", "docs/sweeps", "docs/datasets"),
        *("docs/measured", "docs/reconstruction", "docs/formats", "docs/importing", "docs/continuous-integration"),
        *("docs/clusters", "docs/python"),
    ),
    "Reference": tuple(f"docs/reference/{name}" for name in ("configuration", "commands", "file-layout", "python-api")),
    "Theory": ("docs/engines", "docs/virtual-lights", "docs/stated-errors", "docs/benchmarks"),
    "Project": ("docs/architecture", "CONTRIBUTING", "CHANGELOG"),
}


def add_contents(_: Sphinx, page: str, source: list[str]) -> None:
    """Put the tables of contents, which only the site has, below the README."""
    if page == root_doc:
        for caption, pages in CONTENTS.items():
            source[0] += "\n".join(["\n```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```\n"])


def add_index(app: Sphinx, failure: Exception | None) -> None:
    """Copy README.html to index.html, which servers show for the folder."""
    if failure is None:
        shutil.copy(app.outdir / "README.html", app.outdir / "index.html")


def setup(app: Sphinx) -> None:
    """Write the generated pages before Sphinx looks for pages."""
    write_pages()
    app.connect("source-read", add_contents)
    app.connect("build-finished", add_index)
