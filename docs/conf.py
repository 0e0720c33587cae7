"""The site: `make docs` builds it in outputs/docs. The pages are Markdown that reads as well on GitHub."""

import re
from pathlib import Path

project = "lerobot-playbyear"
author = "The lerobot-playbyear authors"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = project
html_static_path = html_css_files = ["site.css"]
exclude_patterns = ["media"]

myst_heading_anchors = 4  # as GitHub makes them
default_role = "literal"  # `code` in docstrings
autodoc_typehints = "none"  # the signature has them in short, and the text says what they mean
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
napoleon_custom_sections = [(each, "params_style") for each in ("Inputs", "Architecture", "Training")]


def add_sidebar(app, name, source):
    """The sidebar lists the pages that index.md links, under its headings."""
    if name != "index":
        return
    for section in re.split(r"^## ", source[0], flags=re.MULTILINE)[1:]:
        caption, _, text = section.partition("\n")
        pages = re.findall(r"\]\(([\w/]+\.md)\)", text)
        source[0] += "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", "", *pages, "```", ""])


def leave_the_site(app, name, source):
    """What a page links in the repository and is not on the site, such as a folder of examples, is named without a link."""

    def name_it(link):
        target = (Path(app.srcdir, name).parent / link[2]).resolve()
        is_page = target.is_dir() or target.suffix == ".md"
        return link[1] if is_page and Path(app.srcdir) not in target.parents else link[0]

    source[0] = re.sub(r"\[([^\]]+)\]\((\.\./[^)#]+)[^)]*\)", name_it, source[0])


def setup(app):
    app.connect("source-read", add_sidebar)
    app.connect("source-read", leave_the_site)
