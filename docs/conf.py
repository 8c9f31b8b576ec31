"""Settings of the documentation site: `make docs` builds it from this folder."""

project = "eschorty_ros"
author = "the authors of eschorty_ros"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = "eschorty_ros"
html_show_copyright = False
html_show_sphinx = False
html_static_path = ["_static"]
html_css_files = ["site.css"]
# Headings get the names that GitHub gives them, so that links work in both.
myst_heading_anchors = 4
# The pages' indented blocks are commands.
highlight_language = "bash"
autodoc_typehints = "none"
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
