"""Configuration of the documentation site: sphinx-build -W docs build/site."""

from importlib.metadata import version as version_of

project = "vjm"
author = "The vjm developers"
copyright = "The vjm developers"
version = release = version_of("vjm")
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns: list[str] = []
suppress_warnings = ["misc.highlighting_failure"]  # Pygments has no lexer for CSV
html_theme = "furo"
html_title = "vjm"
default_role = "code"  # `name` in a docstring is code
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 88
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
