"""The documentation site. `make docs` builds it; tutorials are executed, warnings are errors."""

import sys
from pathlib import Path

from jupyter_client.manager import KernelManager  # pyright: ignore[reportMissingImports]

import invertwin

sys.path.insert(0, str(Path(__file__).parent))

project = "invertwin"
author = "The invertwin contributors"
version = release = invertwin.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "site_directives",
]
exclude_patterns = ["*.py"]

# Copied snippets run: without prompts, and without what they print.
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
copybutton_selector = "div.highlight:not(.output div) > pre"

# Headings have the anchors that they have on GitHub, where these pages are read too.
myst_heading_anchors = 4
myst_enable_extensions = ["colon_fence"]

# Tutorials are Python files in jupytext's percent form.
nb_custom_formats = {".py": ["jupytext.reads", {"fmt": "py:percent"}]}
nb_execution_mode = "force"
nb_execution_timeout = 600  # s, of a cell
nb_execution_raise_on_error = True
nb_output_stderr = "error"
# Kernels of late warn of a connection that others on the machine could read. No
# option of myst-nb reaches what starts them.
if hasattr(KernelManager, "transport_encryption"):
    KernelManager.transport_encryption.default_value = "auto"

default_role = "code"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
napoleon_use_rtype = False
napoleon_attr_annotations = False  # the signature has them

html_theme = "pydata_sphinx_theme"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_context = {"default_mode": "auto"}  # without it every page reports an invalid mode
html_title = f"invertwin {version}"
# Nothing is fetched when a page is read: no fonts, scripts or pictures from elsewhere.
html_theme_options = {
    "navbar_end": ["theme-switcher"],
    "footer_start": ["copyright"],
    "footer_end": [],
    "show_toc_level": 2,
}
html_show_sourcelink = True
html_split_index = True
copyright = f"{author}, Apache-2.0"
