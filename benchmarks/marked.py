"""Generated parts of pages: between marks that name the script, and tables."""

from __future__ import annotations

from taichi_msm.study.format import markdown_table


def replace_marked(text: str, name: str, script: str, content: str) -> str:
    """Return the text of a page with new content between the marks of a part."""
    start, end = f"<!-- {name}: made by {script} -->\n", f"<!-- end of {name} -->\n"
    before, rest = text.split(start)
    return before + start + content + end + rest.split(end)[1]


def table(head: list[str], rows: list[list[str]]) -> str:
    """Format a table with text in the first column and numbers in the others."""
    return markdown_table(head, rows, left_columns=(0,))
