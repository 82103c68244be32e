"""Reader of the cells of workbooks (.xlsx): a stream of the XML of each sheet, in bounded time and memory.

A few kilobytes may unpack to gigabytes, so limits are checked while reading. Charts, links, colours and other parts are
not read.
"""

from __future__ import annotations

import datetime
import io
import posixpath
import re
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from functools import lru_cache
from itertools import chain
from xml.parsers import expat

from taichi_msm.errors import SceneError
from taichi_msm.machines.cells import MAX_BYTES, NUMBER_PATTERN, Grid, Row, read_bytes

# Limits of all sheets: bytes of XML, its characters < and =, which begin tags and values of attributes; rows and cells,
# including empty ones before others; characters of cells.
MAX_UNPACKED_BYTES, MAX_MARKS, MAX_CELLS, MAX_CHARACTERS = 2**28, 3 * 10**7, 6 * 10**6, MAX_BYTES

# Limits of XML: nested elements, names of elements and attributes, bytes of a tag.
MAX_DEPTH, MAX_NAMES, MAX_TAG_BYTES = 100, 1000, 2**20

# Limits of the format, or above those of programs.
MAX_ROWS, MAX_COLUMNS, MAX_CELL_CHARACTERS = 2**20, 2**14, 2**15 - 1
MAX_SHEETS, MAX_STYLES, MAX_MERGED = 1000, 2**16, 10**5

CHUNK_BYTES = 2**16

# Built-in number formats of dates and times of day; literal parts of other formats; day 0 of dates.
DATE_FORMATS = {*range(14, 23), *range(27, 37), *range(45, 48), *range(50, 59)}
LITERAL = re.compile(r'"[^"]*"|\[(?![hms]+\])[^\]]*\]|[\\_*].', re.IGNORECASE)
DAY_0 = datetime.datetime(1899, 12, 30)

# Letters of a column, number of a row or a text, and a range of merged cells.
LETTERS, INDEX = re.compile("[A-Z]{1,3}"), re.compile("[0-9]{1,9}")
RANGE = re.compile(r"([A-Z]{1,3})([0-9]{1,7}):([A-Z]{1,3})([0-9]{1,7})")

Attributes = dict[str, str]


class LimitError(Exception):
    """A workbook exceeds a limit."""


def read_workbook(name: str, expected: str) -> dict[str, Grid]:
    """Return the worksheets of a workbook by name; `expected` describes a readable file, for messages."""
    data = read_bytes(name, expected)
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return _Workbook(archive).read(name)
    except LimitError as error:
        raise SceneError([f"{name}: {error}; save the table alone, or as CSV"]) from None
    # zipfile, expat and conversions raise errors of any kind for a damaged file.
    except Exception as error:
        reason = f"not a workbook, or a damaged one ({type(error).__name__})"
        raise SceneError([f"{name}: {reason}; save it again as .xlsx, or as CSV"]) from None


class _Workbook:
    """Parts of a workbook, and the amounts that were read so far."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        self._bytes = self._marks = self._cells = self._characters = 0

    def read(self, name: str) -> dict[str, Grid]:
        """Read all worksheets of the file of a name."""
        (book,) = [target for kind, target in self._relations("").values() if kind == "officeDocument"]
        relations, sheets = self._relations(book), {}
        for tag, attributes, _ in self._elements(book):
            if tag == "sheet":
                (key,) = [value for key, value in attributes.items() if key.endswith(":id")]
                if relations[key][0] == "worksheet":
                    sheets[attributes["name"]] = relations[key][1]
                    _require("sheets", len(sheets), MAX_SHEETS)
        parts = dict(relations.values())
        texts = self._read_texts(parts["sharedStrings"]) if "sharedStrings" in parts else []
        dates = self._date_styles(parts["styles"]) if "styles" in parts else set()
        return {title: self._read_sheet(Grid(name, title, []), part, texts, dates) for title, part in sheets.items()}

    def _relations(self, part: str) -> dict[str, tuple[str, str]]:
        """Return the kind and the path of every part that a part refers to, by key."""
        folder, file = posixpath.split(part)
        relations = {}
        for tag, attributes, _ in self._elements(posixpath.join(folder, "_rels", f"{file}.rels")):
            if tag == "Relationship":
                target = posixpath.normpath(posixpath.join("/", folder, attributes["Target"]))[1:]
                relations[attributes["Id"]] = attributes["Type"].rpartition("/")[2], target
                _require("parts", len(relations), 2 * MAX_SHEETS)
        return relations

    def _read_texts(self, part: str) -> list[str]:
        """Return the texts that cells share, by index."""
        texts, text = [], ""
        for tag, _, content in self._elements(part):
            if tag == "t":
                text += content
                _require("characters in a cell", len(text), MAX_CELL_CHARACTERS)
            elif tag == "si":
                texts.append(" ".join(text.split()))
                text = ""
        return texts

    def _date_styles(self, part: str) -> set[str]:
        """Return the indices of the styles that show numbers as dates or times of day."""
        formats, styles = {str(number) for number in DATE_FORMATS}, list[bool]()
        for tag, attributes, _ in self._elements(part):
            if tag == "cellStyleXfs":
                styles.clear()
            elif tag == "cellXfs":
                break
            elif tag == "numFmt":
                # The first section is for positive numbers; Excel accepts 255 characters.
                first = LITERAL.sub("", attributes["formatCode"][:255].partition(";")[0])
                if {*first.lower()} & {*"dmhys"}:
                    formats.add(attributes["numFmtId"])
            elif tag == "xf":
                styles.append(attributes.get("numFmtId") in formats)
            _require("styles", len(styles) + len(formats), MAX_STYLES)
        return {str(style) for style, is_date in enumerate(styles) if is_date}

    def _read_sheet(self, grid: Grid, part: str, texts: list[str], dates: set[str]) -> Grid:
        """Read the cells of a worksheet as strings into an empty grid."""
        row, column, cells, value, formula = -1, -1, list[tuple[int, str]](), "", ""
        for tag, attributes, content in self._elements(part):
            if tag == "v" or tag == "t":
                value += content
                _require("characters in a cell", len(value), MAX_CELL_CHARACTERS)
            elif tag == "f":
                formula = f"={content}"
            elif tag == "c":
                has_column, kind = "r" in attributes, attributes.get("t", "n")
                column = _column_index(attributes["r"].rstrip("0123456789")) if has_column else column + 1
                if value:
                    is_date = attributes.get("s") in dates
                    value = texts[_index(value)] if kind == "s" else _format(value, kind, is_date)
                if shown := " ".join((value or formula).split()):
                    cells.append((column, shown))
                if len(cells) > MAX_COLUMNS:
                    raise ValueError
                value = formula = ""
            elif tag == "row":
                row = _index(attributes["r"]) - 1 if "r" in attributes else row + 1
                for column, shown in cells:
                    self._put(grid.rows, row, column, shown)
                column, cells = -1, []
            elif tag == "mergeCell" and (corners := RANGE.fullmatch(attributes["ref"])):
                first, last = _column_index(corners[1]), _column_index(corners[3])
                if first < last:
                    _require("merged ranges", len(grid.merged), MAX_MERGED)
                    grid.merged.append((int(corners[2]) - 1, int(corners[4]) - 1, first))
        return grid

    def _put(self, rows: list[Row], row: int, column: int, text: str) -> None:
        """Set a cell, and add empty rows and cells before it."""
        if not (0 <= row < MAX_ROWS and 0 <= column < MAX_COLUMNS):
            raise ValueError
        self._characters += len(text)
        _require("characters", self._characters, MAX_CHARACTERS)
        new_rows = max(0, row + 1 - len(rows))
        new_cells = max(0, column + 1 - (0 if new_rows else len(rows[row])))
        self._cells += new_rows + new_cells
        _require("cells", self._cells, MAX_CELLS)
        rows.extend([] for _ in range(new_rows))
        rows[row].extend([""] * new_cells)
        rows[row][column] = text

    def _elements(self, part: str) -> Iterator[tuple[str, Attributes, str]]:
        """Yield tag, attributes and last text of every element at its end, except those of pronunciations."""
        # Before anything is kept.
        for chunk in self._chunks(part):
            self._bytes += len(chunk)
            _require("bytes of XML", self._bytes, MAX_UNPACKED_BYTES)
            self._marks += chunk.count(b"<") + chunk.count(b"=")
            _require("tags and attributes", self._marks, MAX_MARKS)
        names: dict[str, str] = {}
        opened, ended = list[Attributes](), list[tuple[str, Attributes, str]]()
        skipped = size = 0
        text = ""

        def start_element(name: str, attributes: Attributes) -> None:
            nonlocal skipped, text
            opened.append(attributes)
            text = ""
            skipped += bool(skipped or name.endswith("rPh"))

        def end_element(name: str) -> None:
            nonlocal skipped, text
            attributes = opened.pop()
            if skipped:
                skipped -= 1
            else:
                ended.append((name.rpartition(":")[2], attributes, text))
            text = ""

        def characters(content: str) -> None:
            nonlocal text
            text += content
            _require("characters in a cell", len(text), MAX_CELL_CHARACTERS)

        def refuse_entities(*_: object) -> None:
            raise ValueError

        parser = expat.ParserCreate(intern=names)
        parser.buffer_text = True
        parser.StartElementHandler, parser.EndElementHandler = start_element, end_element
        parser.CharacterDataHandler, parser.StartDoctypeDeclHandler = characters, refuse_entities
        for chunk in chain(self._chunks(part), [b""]):
            size += len(chunk)
            parser.Parse(chunk, not chunk)
            # Expat parses an unfinished tag again with every chunk, and keeps all names and open elements.
            _require("bytes in a tag", size - parser.CurrentByteIndex, MAX_TAG_BYTES)
            _require("names of XML", len(names), MAX_NAMES)
            _require("nested elements", len(opened), MAX_DEPTH)
            yield from ended
            ended.clear()

    def _chunks(self, part: str) -> Iterator[bytes]:
        """Yield a part, unpacked."""
        entry = self._archive.getinfo(part)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError  # of others zipfile unpacks any number of bytes at once
        with self._archive.open(entry) as file:
            yield from iter(lambda: file.read(CHUNK_BYTES), b"")


def _require(what: str, amount: int, limit: int) -> None:
    if amount > limit:
        raise LimitError(f"more than {limit:,} {what}")


def _index(digits: str) -> int:
    """Convert decimal digits to a number; unlike `int`, refuse signs, underscores and other digits."""
    if not INDEX.fullmatch(digits):
        raise ValueError
    return int(digits)


@lru_cache(MAX_COLUMNS)
def _column_index(letters: str) -> int:
    """Return the index of the column of given letters, from 0."""
    if not LETTERS.fullmatch(letters):
        raise ValueError
    index = 0
    for letter in letters:
        index = 26 * index + ord(letter) - ord("A") + 1
    return index - 1


def _format(value: str, kind: str, is_date: bool) -> str:
    """Format the value of a cell of a kind, numbers with the 15 digits of Excel."""
    if kind == "b":
        return str(bool(_index(value)))
    if kind == "n":
        if not NUMBER_PATTERN.fullmatch(value):
            raise ValueError
        if not is_date:
            return format(float(value), ".15g") if {*value} & {*".eE"} else str(int(value))
        if 0 <= (day := float(value)) < 1:
            time = (DAY_0 + datetime.timedelta(days=day)).time()
            return time.isoformat("microseconds")  # a clock time
        with suppress(OverflowError):
            value = str(DAY_0 + datetime.timedelta(seconds=round(86400 * day)))
    return f"a date, {value}" if is_date or kind == "d" else value
