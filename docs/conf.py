"""The site: the pages of this folder and the docstrings, by Sphinx and MyST (``make docs``).

The pages are also read on GitHub. They therefore use plain Markdown, and relative links that hold
in both places; Sphinx copies the pictures they show from ``results``.
"""

import re
import sys
from importlib.metadata import metadata
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

sys.path.insert(0, str(Path(__file__).parent.parent))  # benchmarks is not installed

project = "sb3-rainbow-coop"
author = metadata(project)["Author"]
release = version = metadata(project)["Version"]

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
]
html_theme = "sphinx_rtd_theme"
html_static_path = ["static"]
html_css_files = ["tables.css"]
html_show_copyright = False

myst_heading_anchors = 4  # those that GitHub gives

autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "all"
napoleon_numpy_docstring = False
napoleon_use_ivar = True

# What others document: their inventories would need the network.
OTHERS = ("collections", "contextlib", "gym", "gymnasium", "io", "numpy", "optuna", "os", "pandas",
          "pathlib", "pettingzoo", "rich", "stable_baselines3", "torch", "typing",
          "xml")  # fmt: skip
NAMES = ("ArrayLike", "BaseCallback", "ClosedEnvironmentError", "Console", "DependencyNotInstalled",
         "Env", "Figure", "NDArray", "NoAsyncCallError", "ResetNeeded", "VecEnv", "WrapperActType",
         "WrapperObsType")  # fmt: skip
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", rf"({'|'.join(OTHERS)})\..*"),
    ("py:.*", "|".join(NAMES)),
    ("py:.*", r"(.*\.)?(Self[A-Z]\w+|C|P|Act|MakeEnv)"),  # type variables, names of types
    ("py:class", r"coop_env\.physics\.(batch|contact|whole)\.\w+"),
    # arguments that the functions of one's own make
    ("py:class", r"benchmarks\.protocol\.presets\.\w+"),
    ("py:class", r"coop_env\..*\.(Delta|Task|Reward)Params|coop_env\..*\.Disturbance"),
]

# numpy spells its two names for arrays out, over several lines
ARRAYS = (
    (re.compile(r"~numpy\.ndarray\[tuple\[[^\]]*\], ~?numpy\.dtype\[(.*?)\]\]"), r"NDArray[\1]"),
    (re.compile(r"~numpy\._typing\.\S*_Buffer.*?bytes.*?\]\]"), "ArrayLike"),
)
# a default that is an object, with the fields of tuples in it
PROBLEM = re.compile(r"DesignProblem\((?:[^()]|\([^()]*\))*\)")


def shorten(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, returns: Any
) -> tuple[str, Any] | None:
    """Types and defaults of the parameters as the sources have them."""
    types = app.env.current_document.autodoc_annotations.get(name, {})
    for parameter, text in types.items():
        for long, short in ARRAYS:
            text = long.sub(short, text)
        types[parameter] = text
    return (PROBLEM.sub("PAPER_PROBLEM", signature), returns) if signature else None


def skip_fields(app: Sphinx, what: str, name: str, value: Any, *_: Any) -> bool | None:
    """Fields of named tuples: the class says what they are, Python only their numbers."""
    return True if type(value).__name__ == "_tuplegetter" else None


def download_results(app: Sphinx, name: str, source: list[str]) -> None:
    """Tables of ``results`` that a page links are no pages of the site, but files to take."""
    source[0] = re.sub(r"\]\((\.\./results/[^)]+\.md)\)", r"](path:\1)", source[0])


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-signature", shorten, priority=900)
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("source-read", download_results)
