"""Pages of which scripts write a part: what lies after a comment that says so, up to another comment or to the end."""

from __future__ import annotations


def with_part(page: str, begin: str, lines: list[str], end: str | None = None) -> str:
    """Return a page whose part between two marks is replaced; a blank line follows the first, one precedes the second.

    Parameters
    ----------
    page : text of the page
    begin, end : the lines that mark the part, without their line break; without `end` it reaches to the page's end
    lines : of the new part

    Raises
    ------
    ValueError
        When the page lacks a mark.
    """
    head, found, rest = page.partition(f"{begin}\n")
    if not found:
        raise ValueError(f"The page has no line {begin!r}.")
    part = "\n".join([begin, "", *lines, ""])
    if end is None:
        return head + part
    _, found, tail = rest.partition(f"{end}\n")
    if not found:
        raise ValueError(f"The page has no line {end!r} after {begin!r}.")
    return f"{head}{part}\n{end}\n{tail}"
