"""Hostile tables are read or refused in bounded time and memory: patterns are linear, workbooks are streams."""

from __future__ import annotations

import io
import multiprocessing
import resource
import zipfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from taichi_msm.errors import SceneError
from taichi_msm.fitting.forces import read_forces
from taichi_msm.machines.reader import read_machine_test

# Limits of a case [s] and of a process [KiB]; in fact cases take below 3 s, and processes below 700 MiB.
MAX_S, MAX_KIB = 20.0, 2 * 2**20

CHARACTERS = " \n\t([{\"'0-.,;:#%=ae\\"
SIZE = 10**6

Case = tuple[str, str | bytes, list[str]]


def texts(title: str, rows: str) -> Iterator[Case]:
    """Yield names, contents and --columns of a megabyte of every character: alone, in a title, and below a table."""
    for character in CHARACTERS:
        line, lines = character * SIZE, f"{character * 99}\n" * (SIZE // 100)
        for where, content in {
            "line": line,
            "lines": lines,
            "title": f"{title}{line}\n{rows}",
            "line below": f"{title}\n{rows}{line}",
            "lines below": f"{title}\n{rows}{lines}",
        }.items():
            yield f"{where} of {character!r}", content, []
        yield f"column {character!r}", f"{title}\n{rows}", [f"depth={line}"]
    yield "titles", title + ";(a" * 30_000 + f"\n{rows}", []
    yield "candidates", title + "".join(f";Force {n} [N]" for n in range(10_000)) + f"\n{rows}", []
    yield "headers", f"{title}\n" * 10_000, []
    yield "headers before a long row", f"{title}\n" * 10_000 + "0;" * (SIZE // 2), []
    yield "columns and rows", title + ";a" * 30_000 + "\n" * 100_000 + rows, []


MACHINE_ROWS = "".join(f"{n};{n};{n}\n" for n in range(12))


def machine_tables() -> Iterator[Case]:
    return texts("Time [s];Depth [mm];Force [N]", MACHINE_ROWS)


def forces_tables() -> Iterator[Case]:
    # The cells are read as those of machine tables.
    cases = texts("time;probe;force_x;force_y;force_z", "0;0;1;2;3\n")
    return (case for case in cases if not case[0].startswith(("line", "column '")))


BOOK = "<sheets><sheet name='a' r:id='works'/></sheets>"
TITLES = "".join(f"<c t='str'><v>{title}</v></c>" for title in ("Time [s]", "Depth [mm]", "Force [N]"))
TABLE = f"<row>{TITLES}</row>" + "".join(f"<row>{f'<c><v>{n}</v></c>' * 3}</row>" for n in range(12))


def relations(*kinds: str) -> str:
    """Return the relations to parts, by kind."""
    listed = "".join(f"<Relationship Id='{kind[:5]}' Type='/{kind}' Target='{kind[:5]}'/>" for kind in kinds)
    return f"<Relationships>{listed}</Relationships>"


def workbook(
    cells: str = "", end: str = "", texts: str = "", styles: str = "", book: str = BOOK, dtd: str = ""
) -> bytes:
    """Return a workbook whose sheet has a table, more cells, and an end."""
    parts = {
        "_rels/.rels": relations("officeDocument"),
        "_rels/offic.rels": relations("worksheet", "sharedStrings", "styles"),
        "offic": f"<workbook>{book}</workbook>",
        "works": f"<worksheet><sheetData>{TABLE}{cells}</sheetData>{end}</worksheet>",
        "share": f"{dtd}<sst>{texts}</sst>",
        "style": f"<styleSheet>{styles}</styleSheet>",
    }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    return file.getvalue()


def cell(text: str, kind: str = "n") -> str:
    return f"<c t='{kind}'><v>{text}</v></c>"


def row(cells: str) -> str:
    return f"<row>{cells}</row>"


def workbooks() -> Iterator[Case]:
    """Yield names and contents of small workbooks that unpack to large ones."""
    many = 10**7
    for character in CHARACTERS:
        text, longest = character * SIZE, character * 32_000
        shared = row(cell("0", "s") * 30) * 99
        yield f"text of {character!r}", workbook(texts=f"<si><t>{text}</t></si>"), []
        yield f"tag of {character!r}", workbook(f"<row {text}>"), []
        yield f"cells of {character!r}", workbook(row(cell(longest, "str") * 30)), []
        yield f"shared text of {character!r}", workbook(shared, texts=f"<si><t>{longest}</t></si>"), []
    attributes = ("".join(f"b{n}_{m}='' " for m in range(9)) for n in range(30_000))
    entities = "".join(f"<!ENTITY e{n + 1} '{f'&e{n};' * 10}'>" for n in range(9))
    for name, content in {
        "merged": workbook(end="<mergeCell ref='A1:XFD1048576'/>"),
        "links": workbook(end="<hyperlink ref='A1:XFD1048576'/>"),
        "many merged": workbook(end="<mergeCell ref='A1:XFD1048576'/>" * 200_000),
        "cells": workbook(row(cell("1") * 9000) * 1000),
        "wide rows": workbook("<row><c r='XFD1'><v>1</v></c></row>" * 10_000),
        "high column": workbook("<row r='1048576'><c r='A1048576'><v>1</v></c></row>"),
        "no column": workbook("<row r='99999999'><c r='ZZZZ1'><v>1</v></c></row>"),
        "rows": workbook("<row/>" * 500_000),
        "digits": workbook(row(cell("1" * 5000))),
        "long text": workbook(row(cell("1" * many))),
        "depth": workbook("<a>" * many),
        "names": workbook("".join(f"<a{n}/>" for n in range(300_000))),
        "attributes": workbook("".join(f"<a {names}/>" for names in attributes)),
        "value of an attribute": workbook(f"<c r='{'A' * many}'/>"),
        "comment": workbook(f"<!--{'a' * many}-->"),
        "blanks": workbook(" " * many),
        "shared texts": workbook(texts="<si><t>ab</t></si>" * 500_000),
        "runs of a text": workbook(texts=f"<si>{'<r><t>a</t></r>' * 500_000}</si>"),
        "styles": workbook(styles="<cellXfs>" + "<xf numFmtId='14'/>" * 500_000 + "</cellXfs>"),
        "format": workbook(styles=f"<numFmt numFmtId='200' formatCode='{'[' * SIZE}'/>"),
        "sheets": workbook(book="".join(f"<sheet name='{n}' r:id='works'/>" for n in range(100_000))),
        "entities": workbook(dtd=f"<!DOCTYPE sst [<!ENTITY e0 'a'>{entities}]>", texts="<si><t>&e9;</t></si>"),
        "file": workbook(
            dtd="<!DOCTYPE sst [<!ENTITY file SYSTEM 'file:///etc/hostname'>]>", texts="<si><t>&file;</t></si>"
        ),
    }.items():
        yield name, content, []


def test_workbook_without_hostile_parts_is_read(tmp_path: Path) -> None:
    (tmp_path / "table.xlsx").write_bytes(workbook())
    assert len(read_machine_test(tmp_path / "table.xlsx").time) == 12


def test_only_numbers_of_workbooks_are_read(tmp_path: Path) -> None:
    """Neither underscores, which Python accepts, nor digits of other scripts, nor indices from the end."""
    for text, kind in (("1_000", "n"), ("1_0.5", "n"), ("\u0661", "n"), ("-1", "s"), ("1_0", "b")):
        (tmp_path / "table.xlsx").write_bytes(workbook(row(cell(text, kind)), texts="<si><t>a</t></si>" * 20))
        with pytest.raises(SceneError, match="damaged"):
            read_machine_test(tmp_path / "table.xlsx")


def answer(connection: Connection, forces: bool) -> None:
    """Read the tables of a connection; answer with an empty text, or with an error other than a SceneError."""
    while request := connection.recv():
        path, columns = request
        try:
            with suppress(SceneError):
                read_forces(path, 1.0, 1) if forces else read_machine_test(path, columns)
            error = ""
        except Exception as caught:
            error = repr(caught)
        connection.send((error, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))


@pytest.mark.parametrize(
    ("cases", "suffix"),
    [(machine_tables, ".csv"), (forces_tables, ".forces.csv"), (workbooks, ".xlsx")],
    ids=["texts", "forces", "workbooks"],
)
def test_hostile_tables(cases: Callable[[], Iterator[Case]], suffix: str, tmp_path: Path) -> None:
    connection, its = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=answer, args=(its, suffix == ".forces.csv"))
    process.start()
    path = tmp_path / f"table{suffix}"
    try:
        for name, content, columns in cases():
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
            connection.send((path, columns))
            assert connection.poll(MAX_S), f"{name}: not read within {MAX_S} s"
            error, memory = connection.recv()
            assert not error, name
            assert memory < MAX_KIB, f"{name}: {memory} KiB"
    finally:
        process.kill()
        process.join()
