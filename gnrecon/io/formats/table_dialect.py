"""How a table in text is written: its encoding, separator, decimal mark, quotes, head and columns.

Each pair of separator and decimal mark is tried on the first lines. The right one is that in which most lines hold at
least three numbers, and in which no cell holds several: in ``1,5 2,5 3,5``, commas cannot separate, because ``5 2`` is
no number. What precedes the first row is searched for the names of the columns; all else there is metadata. What is no
such table ends in an `InputError` that says why.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gnrecon.io.column_names import COLOR, NORMAL, POSITION, columns_of_role, is_angle
from gnrecon.runtime.errors import InputError

BLANKS = r"\s+"
MISSING = (
    *("", "nan", "+nan", "na", "n/a", "#n/a", "null", "none", "-nan", "nan(ind)", "-nan(ind)", "1.#qnan", "-1.#qnan"),
    *("1.#ind", "-1.#ind", "-", "--", "nil", "<na>", "missing", "#value!", "#ref!", "#div/0!", "#num!", "#name?"),
)
"""Cells without a number, in lower case."""

_HASH = r"#(?!N/A|DIV/0|[A-Z]+[!?])"  # but not an error of a spreadsheet
COMMENT = re.compile(rf"^\s*(?:{_HASH}|//|%|!|;(?!\s*[-+\d])).*$|(?<=[\s\d])(?:{_HASH}|//).*$", re.MULTILINE)


@dataclass(frozen=True)
class Dialect:
    """How the rows of a table are read.

    Parameters
    ----------
    separator : of columns: one character, or `BLANKS`
    decimal : the decimal mark
    thousands : the mark between groups of digits, or None
    replaced : pairs of text and what replaces it in rows before they are parsed
    skipped : number of lines before the first row
    width : number of columns; of rows that differ in length, those that are read
    names : of the columns, or None without a header
    numeric : whether each column holds numbers
    count : number of points that a line before the rows declares, or None
    ragged : whether rows may be longer than `width`
    remarks : sentences on how the table is read
    """

    separator: str
    decimal: str = "."
    thousands: str | None = None
    replaced: tuple[tuple[str, str], ...] = ()
    skipped: int = 0
    width: int = 0
    names: tuple[str, ...] | None = None
    numeric: tuple[bool, ...] = ()
    count: int | None = None
    ragged: bool = False
    remarks: tuple[str, ...] = ()

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line, without quotes and blanks around them."""
        for old, new in self.replaced:
            line = line.replace(old, new)
        line = line.strip() if self.separator == BLANKS else line.strip("\r\n")
        if self.separator == BLANKS:
            return [word.strip("\"'") for word in re.findall(r'"[^"]*"|\S+', line)]
        try:
            cells = next(csv.reader([line], delimiter=self.separator, skipinitialspace=True), [])
        except csv.Error:
            cells = line.split(self.separator)
        return [cell.strip().strip("\"'").strip() for cell in cells]

    def is_number(self, cell: str) -> bool:
        """Whether a cell holds a number in this dialect."""
        mark = re.escape(self.decimal)
        known = rf"(\d+({mark}\d*)?|{mark}\d+)(e[+-]?\d+)?|inf(inity)?|nan"
        known += rf"|\d{{1,3}}({re.escape(self.thousands)}\d{{3}})+({mark}\d*)?" if self.thousands else ""
        return re.fullmatch(f"[+-]?({known})", cell, re.IGNORECASE | re.ASCII) is not None

    def is_value(self, cell: str) -> bool:
        """Whether a cell holds a number, or is one of those that stand for none."""
        return cell.lower() in MISSING or self.is_number(cell)


def encoding_of(path: Path) -> str:
    """Return the encoding of a text, by its byte-order mark, its zero bytes, or what decodes."""
    with path.open("rb") as file:
        head = file.read(1 << 16)
    marks = {b"\xef\xbb\xbf": "utf-8-sig", b"\xff\xfe\0\0": "utf-32", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
    if found := next((name for mark, name in marks.items() if head.startswith(mark)), None):
        return found
    if b"\0" in head:
        even, odd = head[: len(head) // 2 * 2 : 2], head[1::2]
        # ASCII in UTF-16 has a zero in every other byte, and nowhere else.
        if not (even.strip(b"\0") and odd.strip(b"\0")) and 0 in (even.count(0), odd.count(0)):
            return "utf-16-be" if even[:1] == b"\0" else "utf-16-le"
        raise InputError("expected text, but the file holds binary data.")
    try:
        head[:-4].decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def plain_text(text: str) -> str:
    """Return a text with ASCII blanks and signs, and without marks of the byte order or of DOS at its end."""
    if text.isascii() and "\x1a" not in text:
        return text
    if ";" in text or "\t" in text:
        text = re.sub(r"(?<=\d)[\xa0\u202f\u2009\u2019](?=\d{3}(?!\d))", "", text)  # between groups of digits
    return text.translate({0xA0: " ", 0x2009: " ", 0x202F: " ", 0x2212: "-", 0xFEFF: None, 0x1A: " "})


def find_dialect(lines: list[str]) -> Dialect:
    """Return the dialect of a table whose first lines these are."""
    if re.match(r"\s*(?:ncols\s+\d+\s+nrows\s+\d|DSAA\b)", "".join(lines[:2]), re.IGNORECASE):
        kind = "a grid of heights by Esri or Surfer"
        raise InputError(f"it is {kind}, not a table of points; gdal2xyz or QGIS make one of it.")
    texts = [COMMENT.sub("", line) for line in lines]
    dialect, rows = _best(texts)
    # The last line read may be cut off; all others count.
    widths = Counter(len(cells) for _, cells in rows[:-1] or rows)
    dialect = replace(dialect, width=widths.most_common(1)[0][0])
    end = next(number for number, cells in rows if len(cells) == dialect.width)
    title, names = _header(dialect, lines[:end])
    # A line of text before the rows may hold numbers, too, such as those of a box.
    rows = [(at, cells) for at, cells in rows if at > title and (at >= end or dialect.is_value(cells[0]))]
    if dialect.width > max(3, len(names or ())) and not any(len(c) == dialect.width and c[-1] for _, c in rows):
        dialect = replace(dialect, width=dialect.width - 1)  # rows end with a separator
    first = rows[0][0]
    _require_unambiguous(dialect, [cells for _, cells in rows])
    counts = [int(line) for line in map(str.strip, lines[:first]) if re.fullmatch("[0-9]{1,18}", line)]
    dialect = replace(dialect, skipped=first, count=counts[-1] if counts else None)
    if names is not None:
        dialect = _fitted(dialect, names, [cells[0] for _, cells in rows])
    else:
        _require_no_header(dialect, texts[:first], ragged=len(widths) > 2)
    columns = list(zip(*[cells[: dialect.width] for _, cells in rows if len(cells) >= dialect.width], strict=True))
    numeric = tuple(2 * sum(map(dialect.is_number, column)) >= sum(map(bool, column)) > 0 for column in columns)
    marks = dialect.decimal == "," and any("," in cell for _, cells in rows for cell in cells)
    return replace(dialect, numeric=numeric, remarks=("Commas are taken for decimal marks.",) if marks else ())


def _best(texts: list[str]) -> tuple[Dialect, list[tuple[int, list[str]]]]:
    """Return the dialect in which most lines are rows, with those rows and their places."""
    habits = (
        (r"\d[Dd][+-]?\d", (("D", "E"), ("d", "e"))),  # Fortran's exponents
        (r"^\s*[\[(]+\s*[-+.\d]", (("(", ""), (")", ""), ("[", ""), ("]", ""))),
        (r"'[-+.\d][^'\s]*'", (("'", ""),)),
    )
    shown = [pairs for pattern, pairs in habits if any(re.search(pattern, text) for text in texts)]
    common = tuple(pair for pairs in shown for pair in pairs)
    blanks = ((",", " "), (";", " "))
    candidates = [Dialect(separator, decimal) for separator in "\t;|" for decimal in ".,"]
    candidates += [Dialect("\t", ",", replaced=((", ", "\t"),)), Dialect(","), Dialect(",", ",")]
    candidates += [Dialect(BLANKS), Dialect(BLANKS, ","), Dialect(BLANKS, replaced=blanks)]
    best, most, found = candidates[0], (0, 0), []
    for candidate in candidates:
        tried = replace(candidate, replaced=candidate.replaced + common)
        quoted = '"[^"]*' if tried.separator not in "\t;|" else ""
        if re.search(r"\d\.\d{3},\d" if tried.decimal == "," else quoted + r"\d,\d{3}\.\d", "\n".join(texts)):
            tried = replace(tried, thousands="." if tried.decimal == "," else ",")
        rows = [(number, cells) for number, text in enumerate(texts) if _is_row(cells := tried.cells(text), tried)]
        both = tried.separator == "\t" and candidate.replaced
        if both and not all("," in cell for _, cells in rows for cell in cells):
            continue  # commas and blanks may separate decimal commas only
        score = (len(rows), sum(tried.is_number(cell) for _, cells in rows for cell in cells))
        # Another separator must explain more lines; another decimal mark, more cells.
        if score[0] > most[0] or (score > most and tried.separator == best.separator and not candidate.replaced):
            best, most, found = tried, score, rows
    if most[0]:
        return best, found
    body = [text.strip() for text in texts if text.strip()]
    words = [re.split(r"[\s,;]+", text) for text in body]
    header = len(words) == 1 and columns_of_role(words[0], POSITION)
    if header or all(len(row) == 1 and row[0].isdecimal() for row in words):
        raise InputError("the file holds no points.")
    counts = [len(row) for row in words if all(map(best.is_value, row))]
    if counts:
        raise InputError(f"expected at least 3 columns (x, y, z), but found {max(counts)}.")
    raise InputError(f"the first line {body[0][:60]!r} holds neither numbers nor columns named x, y and z.")


def _is_row(cells: list[str], dialect: Dialect) -> bool:
    """Whether at least three cells are numbers, and none holds several."""
    if sum(map(dialect.is_number, cells)) < 3:
        return False
    parts = [re.split(r"[\s,;]+", cell) for cell in cells if not dialect.is_number(cell)]
    return not any(len(words) > 1 and all(map(Dialect(",").is_number, words)) for words in parts)


def _require_unambiguous(dialect: Dialect, rows: list[list[str]]) -> None:
    """Refuse commas that both separate columns and mark decimals, as in ``10,8158,-30,6569,-9,6008``."""
    if dialect.separator != "," or dialect.decimal == ",":
        return
    columns = [column for column in zip(*rows, strict=False) if all(map(str.isdecimal, column))]
    # Digits after a decimal mark begin with zeros in places; numbers of their own do not.
    if sum(any(cell[0] == "0" < cell[1:] for cell in column) for column in columns) >= 2:
        raise InputError(
            "commas seem to separate the columns and to mark decimals as well; save the table with semicolons or tabs."
        )


def _header(dialect: Dialect, head: list[str]) -> tuple[int, list[str] | None]:
    """Return the place and the names of the last line of the head that names x, y and z; -1 and None without one."""
    for place, line in reversed(list(enumerate(head))):
        # A separator at the start stays: pandas leaves the name of its index empty.
        text = re.sub(r"(?i)^ *[#/%!]* *(?:(?:variables|columns|fields)\s*[:=]\s*)?", "", line.rstrip(" \r\n"))
        text = text.lstrip("; ") if dialect.separator != ";" else text
        if dialect.separator == BLANKS:
            text = re.sub(r"\s+(?=\[\w+\]|\(\w+\))", "", text)  # a unit belongs to its name
        splits = [dialect.cells(text), [word.strip("\"'") for word in re.split(r"[\s,;]+", text)]]
        for names in sorted(splits, key=lambda words: len(words) != dialect.width):
            names = [name.rstrip(",;") for name in names]
            if columns_of_role(names, POSITION) and not any(map(dialect.is_number, names)):
                return place, names
    return -1, None


def _require_no_header(dialect: Dialect, head: list[str], *, ragged: bool) -> None:
    """Refuse a head that holds damaged rows or unknown names, and rows of many lengths."""
    head = [text for text in head if text.strip()]
    for text in head:
        cells = dialect.cells(text)
        if len(cells) == dialect.width and 2 * sum(map(dialect.is_number, cells)) >= len(cells):
            wrong = next((cell for cell in cells if not dialect.is_value(cell)), cells[0])
            raise InputError(f"{wrong[:40]!r} in the line {text.strip()[:60]!r} is not a number.")
    names = dialect.cells(head[-1]) if head else []
    if len(names) == dialect.width and not any(map(dialect.is_number, names)):
        found = ", ".join(names)[:200]
        if any(map(is_angle, names)):
            raise InputError(f"the columns {found} hold angles; project latitude and longitude to metres first.")
        raise InputError(f"expected columns named x, y and z, but found {found}; name them with --columns.")
    if ragged:
        raise InputError("rows differ in length, and no header names their columns; name those to read with --columns.")


def _fitted(dialect: Dialect, names: list[str], first: list[str]) -> Dialect:
    """Return the dialect with as many names as columns, of which the first holds these cells."""
    width = dialect.width
    lists = next((place for place, name in enumerate(names) if "[]" in name), None)
    if lists is not None:
        # A list ends the row, as the track of a point of COLMAP does.
        return replace(dialect, names=tuple(names[:lists]), width=lists, ragged=True)
    while len(names) > width and not names[-1]:
        names = names[:-1]
    if len(names) > width and dialect.separator == BLANKS:
        names = _joined(names, width)
    elif len(names) == width - 1 and all(cell.isdecimal() or not dialect.is_number(cell) for cell in first):
        numbers = [int(cell) if cell.isdecimal() else place for place, cell in enumerate(first)]
        names = ["", *names] if set(np.diff(numbers)) <= {1} else names  # R names no column of the rows' names
    if len(names) != width:
        what = f"the header names {len(names)} columns, but the rows hold {width}."
        raise InputError(f"{what} Name those to read with --columns.")
    return replace(dialect, names=tuple(names))


def _joined(names: list[str], width: int) -> list[str]:
    """Join words of one name that holds blanks, where only one place is left for them."""
    known = {name for role in (POSITION, NORMAL, COLOR) for name in columns_of_role(names, role) or []}
    others = [place for place, name in enumerate(names) if name not in known]
    spare = len(names) - width
    if not others or others != list(range(others[0], others[-1] + 1)) or len(others) != spare + 1:
        return names
    return [*names[: others[0]], " ".join(names[others[0] : others[-1] + 1]), *names[others[-1] + 1 :]]
