"""Settings of the documentation: ``sphinx-build -W --keep-going docs docs/_build/html``."""

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))
os.environ.setdefault("MPLBACKEND", "agg")

import amiwarp  # noqa: E402

project = "amiwarp"
author = "the amiwarp authors"
project_copyright = author
version = release = amiwarp.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "api_pages",
    "command_pages",
    "offline",
    "page_commands",
    "paper_results",
    "repository_pages",
    "results_table",
]
exclude_patterns = [
    "_build",
    "tutorials",
    "gallery/backreferences",
    "reference/paper-results/*",
    "**/*.ipynb",
]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

smartquotes = False  # options begin with two hyphens
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True  # the members are documented too
autodoc_default_options = {"members": True, "undoc-members": True, "member-order": "bysource"}
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
python_display_short_literal_types = True
toc_object_entries_show_parents = "hide"

api_rooms = [
    "optics", "events", "io", "imaging", "simulation", "sensors", "calib", "compensation", "reconstruction",
    "translation", "live", "plotting", "studies", "viewer",
]  # fmt: skip

repository_pages = {
    "changelog": "CHANGELOG.md",
    "contributing": "CONTRIBUTING.md",
    "releasing": "RELEASING.md",
    "security": "SECURITY.md",
    "code-of-conduct": "CODE_OF_CONDUCT.md",
    "how-to/rig-numbers": "rig/numbers.md",
    "how-to/robot-nodes": "ros/amiwarp_ros/README.md",
    "reference/measurements/*": "benchmarks/results/*.md",
    "reference/files/*": "examples/*.py",
    "reference/files/reader_c": "examples/shared_memory/reader.c",
    "reference/files/reader_rust": "examples/shared_memory/reader.rs",
    "reference/files/reader_python": "examples/shared_memory/reader.py",
    "reference/files/auto": "benchmarks/auto.py",
    "reference/files/mutants": "benchmarks/mutants.toml",
    "reference/files/planted": "benchmarks/planted.toml",
    "reference/files/stream_format": "amiwarp/live/stream/stream_format.py",
    "reference/files/prism_pair": "amiwarp/kernels/prism_pair.py",
}
repository_aliases = {
    "README.md": "index",
    **{
        f"docs/tutorials/{path.name}": f"gallery/{path.stem}"
        for path in HERE.glob("tutorials/*.py")
    },
}

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "gallery",
    "filename_pattern": r"[\\/]\d\d_",
    "within_subsection_order": "FileNameSortKey",
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("amiwarp",),
    "abort_on_example_error": True,
    "remove_config_comments": True,
    "show_memory": False,
    "min_reported_time": 3600,
    "plot_gallery": True,
    "write_computation_times": False,  # its pages load scripts from the network
    "image_srcset": ["2x"],
    "reset_modules": ("matplotlib", "tutorial_style.reset"),
}

html_theme = "furo"
html_title = f"amiwarp {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
templates_path = ["_templates"]
html_sidebars = {
    "**": [
        f"sidebar/{part}.html"
        for part in ("brand", "search", "sections", "scroll-start", "navigation", "scroll-end")
    ]
}
html_show_sourcelink = False
html_copy_source = False
html_show_copyright = False
html_math_renderer = "mathml"
pygments_style = "friendly"
copybutton_selector = (
    "div:is(.highlight-sh, .highlight-python, .highlight-Python) pre"  # not what a program prints
)
html_theme_options = {"footer_icons": [], "top_of_page_buttons": []}
