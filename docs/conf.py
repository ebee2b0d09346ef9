"""The site: Sphinx with MyST-NB and furo. ``make docs`` builds it into build/docs; warnings are errors."""

import os
from importlib import metadata
from pathlib import Path

project = "imagine_bench"
author = "The imagine_bench developers"
copyright = "2026, the imagine_bench developers"
release = metadata.version("imagine-bench")

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 4
exclude_patterns = ["results/**/report", "browser/**"]
nb_execution_mode = "off"  # the notebook shows the outputs that its last run left in it
nb_output_stderr = "remove"

os.environ["MUJOCO_GL"] = "off"  # the site builds where there is no OpenGL
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True

highlight_language = "none"
html_theme = "furo"
html_title = "imagine_bench"
html_static_path = ["_static"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
html_css_files = ["site.css"]
_played = Path(__file__).parents[1] / "build" / "browser"
html_extra_path = [str(_played)] if _played.is_dir() else []  # the page in the browser, where make browser has built it
html_copy_source = False
html_show_sourcelink = False
