"""Tables of palpation: titles, units, presses, and faults."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from taichi_msm.errors import SceneError
from taichi_msm.palpation.presses import choose_presses
from taichi_msm.palpation.table import Table, read_table
from tests.golden import Messages

Read = Callable[..., Table]

# Depths [mm] and forces [N] of a press.
DEPTHS, FORCES = (0.1, 1.0, 2.0, 3.0), (0.01, 0.1, 0.4, 0.9)
HEADER = "place,x_mm,y_mm,z_mm,depth_mm,force_N"


def rows(count: int = 12, line: str = "p{n},{x},{y},5.0,{d},{f}", skip: int = 0) -> str:
    """Rows of presses at places 1 mm apart."""
    return "".join(
        line.format(n=n, x=float(n), y=0.5 * n, d=depth, f=round((1 + 0.1 * n) * force, 4)) + "\n"
        for n in range(count)
        for depth, force in list(zip(DEPTHS, FORCES, strict=True))[skip:]
    )


TABLE = f"{HEADER}\n{rows()}"


@pytest.fixture
def read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Read:
    """Read a text as a table."""
    monkeypatch.chdir(tmp_path)

    def read_text(text: str, *columns: str, with_force: bool = True) -> Table:
        Path("table.csv").write_text(text, encoding="utf-8")
        return read_table("table.csv", columns, with_force=with_force)

    return read_text


def assert_is_table(table: Table) -> None:
    assert table.places == tuple(f"p{n}" for n in range(12))
    n = np.arange(12)
    np.testing.assert_allclose(table.position, np.column_stack([1e-3 * n, 5e-4 * n, 5e-3 + 0 * n]), rtol=1e-14)
    np.testing.assert_array_equal(table.index, np.repeat(n, 4))
    np.testing.assert_allclose(table.depth, 1e-3 * np.tile(DEPTHS, 12), rtol=1e-14)
    expected = np.outer(1 + 0.1 * n, FORCES).ravel()
    np.testing.assert_allclose(table.force, expected, rtol=1e-12)


VECTORS = "place,x,y,z,nx,ny,nz,depth,fx,fy,fz"
UNITS = ",mm,mm,mm,,,,mm,N,N,N"
FORMS = {
    "plain": TABLE,
    "brackets": TABLE.replace(HEADER, "Place,X [mm],Y (mm),z / mm,Depth in mm,Force [N]"),
    "semicolons": TABLE.replace(",", ";").replace(".", ","),
    "tabs": TABLE.replace(",", "\t"),
    "row of units": TABLE.replace(HEADER, "place,x,y,z,depth,force\n,mm,mm,mm,mm,N"),
    "other units": f"place,x_m,y_cm,z_um,depth_mm,force_mN\n{rows(line='p{n},{x}e-3,{y}e-1,5000,{d},{f}e3')}",
    "other columns": f"place,time_s,x_mm,y_mm,z_mm,depth_mm,max depth_mm,force_N,fn_N\n"
    f"{rows(line='p{n},x,{x},{y},5.0,{d},nan,{f},')}",
    "negative": f"{HEADER}\n{rows(line='p{n},{x},{y},5.0,-{d},-{f}')}",
    "vectors win": f"{HEADER},fx_N,fy_N,fz_N\n{rows(line='p{n},{x},{y},5.0,{d},77,1,2,{f}')}",
    # The normal (0, 3, 4) / 5, with a force of 5 f along it and another one across.
    "normals": f"{VECTORS}\n{UNITS}\n{rows(line='p{n},{x},{y},5.0,0,3,4,{d},7,-8,{f}')}",
    "shuffled": f"{HEADER}\n{''.join(sorted(rows().splitlines(keepends=True), key=lambda line: line.split(',')[4]))}",
    "remarks": f"Robot 3\n\n{TABLE}\nOperator,A\n# end\n",
}


@pytest.mark.parametrize("name", FORMS)
def test_forms_of_tables(name: str, read: Read) -> None:
    table = read(FORMS[name])
    if name == "normals":
        # Part along the normal: (0 * 7 - 3 * 8 + 4 f) / 5.
        np.testing.assert_allclose(table.normal, [0, 0.6, 0.8])
        force = np.outer(1 + 0.1 * np.arange(12), FORCES).ravel()
        np.testing.assert_allclose(table.force, -(-24 + 4 * force) / 5, rtol=1e-12)
    else:
        assert_is_table(table)


def test_chosen_columns(read: Read) -> None:
    text = TABLE.replace(HEADER, "spot,x,y_mm,z_mm,Indentation,depth_mm").replace("\np", "\nq")
    table = read(text, "place=spot", "x=x, mm", "depth=Indentation, mm", "force=depth_mm, N")
    assert table.places[0] == "q0"
    assert table.position[3, 0] == pytest.approx(3e-3)
    assert table.force.max() == pytest.approx(2.1 * 0.9)


def test_components_of_0_without_digits(read: Read) -> None:
    table = read(f"{VECTORS}\n{UNITS}\n{rows(line='p{n},{x},{y},5.0,0,0,1,{d},0,0,{f}')}")
    assert table.digit == pytest.approx(1e-3)
    assert not choose_presses(table)[1]


def test_chosen_force_instead_of_a_vector(read: Read) -> None:
    assert_is_table(read(f"{HEADER},fx_N,fy_N,fz_N\n{rows(line='p{n},{x},{y},5.0,{d},{f},1,2,3')}", "force=force, N"))


def test_workbook(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append(["notes"])
    sheet = book.create_sheet("Liver")
    sheet.append(HEADER.split(","))
    for line in rows().splitlines():
        place, *numbers = line.split(",")
        sheet.append([place, *map(float, numbers)])
    book.save(tmp_path / "table.xlsx")
    assert_is_table(read_table(str(tmp_path / "table.xlsx")))
    assert_is_table(read_table(str(tmp_path / "table.xlsx"), sheet="liver"))


def test_rows_without_a_force(read: Read, message: Messages) -> None:
    # One row of p1, all of p2, and the end of a row of p3, whose cell of the force is absent.
    lines = f"{HEADER}\n{rows(14)}".splitlines()
    lines[5] = "p1,1.0,0.5,5.0,0.1,"
    lines[9:13] = ["p2,,,,,NaN"] * 4
    lines[13] = "p3,3.0,1.5,5.0,0.1"
    table = read("\n".join(lines))
    message(table.notes, "table.csv:6", "6")
    assert table.places == tuple(f"p{n}" for n in range(14))
    assert np.bincount(table.index).tolist()[:4] == [4, 3, 0, 3]
    presses, left_out = choose_presses(table)
    assert presses.count == 11
    message([f"{press.place}: {press.reason}" for press in left_out])


def test_presses_without_labels(read: Read) -> None:
    text = HEADER.removeprefix("place,") + "\n" + rows(line="{x},{y},5.0,{d},{f}")
    table = read(text)
    assert table.places == tuple(map(str, range(12)))
    np.testing.assert_array_equal(table.index, np.repeat(np.arange(12), 4))


def test_ball_that_comes_back_slowly(read: Read) -> None:
    # Each press jitters by 0.05 mm on its way down, and comes back in three rows, which belong to no press.
    depths = [0.1, 1.0, 0.97, 2.0, 3.0, 2.95, 2.0, 1.0, 0.05]
    lines = [f"{n},0,0,{d},{d}" for n in range(12) for d in depths]
    table = read("x_mm,y_mm,z_mm,depth_mm,force_N\n" + "\n".join(lines))
    assert len(table.places) == 12
    # The last row of the way back is taken as the first of the next press, whose place is that of its deepest row.
    assert np.bincount(table.index).tolist()[:3] == [6, 7, 7]
    np.testing.assert_allclose(table.position[:, 0], 1e-3 * np.arange(12), rtol=1e-14)
    assert table.depth.max() == pytest.approx(3e-3)


def test_forces_of_another_sign(read: Read, message: Messages) -> None:
    table = read(f"{HEADER}\n{rows(line='p{n},{x},{y},5.0,-{d},{f}')}")
    assert_is_table(table)
    message(table.notes, "sign")


def test_presses_that_hardly_rise(read: Read, message: Messages) -> None:
    rng = np.random.default_rng(0)
    lines = [HEADER]
    for n in range(14):
        depth = np.linspace(0.1, 3, 10)
        force = 0.02 * rng.standard_normal(10) + (0.05 * depth**2 if n != 4 else 0.0)
        force = -force if n == 6 else force
        depth = 0 * depth + 1 if n == 7 else depth
        kept = 3 if n == 9 else 10
        lines += [f"p{n},{n},0,0,{d},{f}" for d, f in zip(depth[:kept], force[:kept], strict=True)]
    presses, left_out = choose_presses(read("\n".join(lines)))
    assert presses.count == 10
    assert [press.place for press in left_out] == ["p4", "p6", "p7", "p9"]
    message([f"{press.place}: {press.reason}" for press in left_out])


def test_tables_of_places_to_predict(read: Read) -> None:
    table = read("x_mm,y_mm,z_mm,depth_mm\n" + rows(line="{x},{y},5.0,{d}"), with_force=False)
    assert len(table.places) == 12
    assert not table.force.any()
    # Rows of one depth are presses at other places.
    table = read("x_mm,y_mm,z_mm,depth_mm\n" + rows(line="{x},{y},5.0,{d}", skip=3), with_force=False)
    assert len(table.places) == 12
    np.testing.assert_allclose(table.position[:, 0], 1e-3 * np.arange(12), rtol=1e-14)


FAULTS = {
    "empty": "",
    "no header": rows(),
    "no x": TABLE.replace("x_mm", "a_mm"),
    "no force": TABLE.replace("force_N", "fn_N"),
    "half a vector": TABLE.replace("force_N", "fx_N"),
    "half a normal": TABLE.replace("place", "nx"),
    "no depth": TABLE.replace("depth_mm", "Indentation (mm)"),
    "no unit": TABLE.replace("depth_mm", "depth"),
    "two depths": TABLE.replace("force_N", "depth [m]"),
    "two headers": TABLE + HEADER + "\n",
    "no rows": HEADER + "\n",
    "no number": TABLE.replace("p3,3.0", "p3,3.0.0"),
    "no force but a text": TABLE.replace("2.0,0.4\n", "2.0,none\n"),
    "empty cell": TABLE.replace("p3,3.0", "p3,"),
    "empty place": TABLE.replace("p3,3.0", ",3.0"),
    "too many cells": TABLE.replace("p3,3.0", "p3,3,0"),
    "places too close": f"place,x_um,y_um,z_um,depth_mm,force_N\n{rows(line='p{n},{x}e-3,{y}e-3,0.005,{d},{f}')}",
    "no normal": f"{VECTORS}\n{UNITS}\n{rows(line='p{n},{x},{y},5.0,0,0,0,{d},7,-8,{f}')}",
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_tables(name: str, read: Read, message: Messages) -> None:
    with message.raises(SceneError, "table.csv"):
        read(FAULTS[name])


@pytest.mark.parametrize("choice", ["time=Zeit, s", "depth", "depth=Weg, mm"])
def test_faults_of_choices(choice: str, read: Read, message: Messages) -> None:
    with message.raises(SceneError):
        read(TABLE, choice)


def test_sheet_of_a_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.chdir(tmp_path)
    Path("table.csv").write_text(TABLE)
    with message.raises(SceneError, "--sheet"):
        read_table("table.csv", sheet="one")


@pytest.mark.parametrize("count", [8, 5001])
def test_number_of_presses(count: int, read: Read, message: Messages) -> None:
    with message.raises(SceneError, "place"):
        choose_presses(read(f"{HEADER}\n{rows(count, skip=3 if count > 1000 else 0)}"))


def test_too_few_presses_with_a_reason(read: Read, message: Messages) -> None:
    with message.raises(SceneError, "place"):
        choose_presses(read(f"{HEADER}\n{rows(12, skip=1)}"))
