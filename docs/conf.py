"""The documentation site: `make docs` builds it into docs/_build/html, and neither that nor a reader needs the web."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE / "_extensions")]

from nerif import __version__  # noqa: E402

sys.path.append(str(HERE.parent / "tools"))
from publication import Addresses  # noqa: E402

project = "nerif"
author = "The nerif developers"
copyright = "the nerif developers; MIT licence"
version = release = __version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.githubpages",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
    "docstrings",
    "mathml",
    "figures",
    "repository",
]
exclude_patterns = ["_build", "_drawings", "_extensions", "_templates", "tutorials"]
language = "en_GB"
smartquotes = False  # -- is an option of the command line
suppress_warnings = [
    "misc.highlighting_failure",  # TOML with "..." where a matrix stands
    "ref.python",  # two classes of one name, in annotations that are not evaluated
]

ADDRESSES = Addresses.read()
INSTALL = f": %pip install git+{ADDRESSES.repository}" if ADDRESSES.repository else ""

sphinx_gallery_conf = {  # the notebooks: scripts that run when the site is built
    "examples_dirs": "tutorials",
    "gallery_dirs": "notebooks",
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_signature": False,
    "first_notebook_cell": f"# nerif has to be installed where this runs{INSTALL}",
    "write_computation_times": False,  # a page with scripts from the web
}

# Markdown: $...$ and $$...$$ (label) for formulas, links to headings of other pages
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
myst_update_mathjax = False
math_numfig = False
math_eqref_format = "Eq. ({number})"
html_math_renderer = "mathml"

autodoc_default_options = {"members": True, "special-members": "__call__"}
autodoc_member_order = "bysource"
autodoc_class_signature = "mixed"
autodoc_typehints = "signature"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
add_module_names = False
toc_object_entries_show_parents = "hide"

html_theme = "furo"
html_title = f"nerif {version}"
html_baseurl = f"{ADDRESSES.site}/latest/" if ADDRESSES.site else ""  # the canonical address of a page
html_static_path = ["_static"]
templates_path = ["_templates"]
html_sidebars = {  # the theme's, with the other versions
    "**": [
        "sidebar/scroll-start.html",
        "sidebar/brand.html",
        "versions.html",
        "sidebar/search.html",
        "sidebar/navigation.html",
        "sidebar/scroll-end.html",
    ]
}
html_js_files = ["versions.js"]
html_css_files = ["nerif.css"]
html_copy_source = False
html_show_sourcelink = False
html_theme_options = {  # the blues of Okabe and Ito
    "light_css_variables": {"color-brand-primary": "#00598c", "color-brand-content": "#0072b2"},
    "dark_css_variables": {"color-brand-primary": "#56b4e9", "color-brand-content": "#56b4e9"},
}
