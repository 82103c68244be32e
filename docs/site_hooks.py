"""Hooks of the site: files outside docs/ that pages link to become part of it, so links work there and on GitHub."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parent.parent
PAGES = ("CONTRIBUTING.md", "CHANGELOG.md")
# A generated table of public names, and a class or function of it.
NAMES = re.compile(r"<!-- ([\w ]+): made by docs/make_tables.py -->.*?<!-- end of \1 -->\n", re.DOTALL)
NAME = re.compile(r"^\| `([A-Za-z][\w.]*)", re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s#]+)(#[^)\s]*)?\)")


def resolve(page: str, target: str) -> str:
    """Return the path of a link's target from the repository's root.

    Args:
        page: path of the page in docs/, or of one of `PAGES`.
        target: the link, relative to the page.
    """
    folder = "" if page in PAGES else posixpath.join("docs", posixpath.dirname(page))
    return posixpath.normpath(posixpath.join(folder, target))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages at the repository's root, and every file outside docs/ that a page links to."""
    for name in PAGES:
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    outside: set[str] = set()
    for file in files.documentation_pages():
        for target, _ in LINK.findall(file.content_string):
            path = resolve(file.src_uri, target)
            if not path.startswith("docs/") and path not in PAGES and (ROOT / path).is_file():
                outside.add(path)
    for path in sorted(outside):
        uri = f"{path}.txt" if path.endswith(".md") else path
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def with_reference(table: re.Match[str]) -> str:
    """Return a table of public names, followed by their signatures and docstrings."""
    # Those of a scene are on the page of keys.
    options = "    options:\n      members: false\n" if table[1] == "scenes" else ""
    return table[0] + "".join(f"\n::: taichi_msm.{name}\n{options}" for name in NAME.findall(table[0]))


def on_page_markdown(markdown: str, page: Page, files: Files, **_: object) -> str:
    """Rewrite links to the paths of their targets in the site, and complete the page of public names."""
    if page.file.src_uri == "api.md":
        markdown = NAMES.sub(with_reference, markdown)

    def moved(link: re.Match[str]) -> str:
        path, anchor = resolve(page.file.src_uri, link[1]), link[2] or ""
        inside = path.removeprefix("docs/")
        if path == "README.md":
            inside = "index.md"
        if "://" in link[1] or files.get_file_from_path(inside) is None:
            return link[0]
        return f"]({posixpath.relpath(inside, posixpath.dirname(page.file.src_uri) or '.')}{anchor})"

    # In Markdown, [a] [b] is a reference; in tables of keys it is a value and its unit.
    return LINK.sub(moved, re.sub(r"(?<=\]) \[(?=s\])", r" \\[", markdown))
