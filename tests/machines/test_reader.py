"""Tables of testing machines as exported: texts, workbooks, and their faults."""

from __future__ import annotations

import random
import re
import shlex
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import datetime, time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taichi_msm.cli.main  # noqa: F401  # registers the commands
from taichi_msm.cli.options import program
from taichi_msm.errors import SceneError
from taichi_msm.fitting.machine_model import is_table
from taichi_msm.machines.reader import MachineTest, cut_window, read_machine_test
from tests.golden import Messages

COUNT = 12
TIME = 0.1 * np.arange(COUNT)
DEPTH = 1e-4 * np.arange(COUNT)
FORCE = 0.05 * np.arange(COUNT)
NUMBERS = list(zip(TIME, DEPTH, FORCE, strict=True))


def rows(separator: str = ";", line: str = "{t:.1f}{s}{d:.2f}{s}{f:.3f}", count: int = COUNT) -> str:
    """Rows of numbers: time [s], depth [mm] and force [N]."""
    return "\n".join(line.format(s=separator, t=0.1 * n, d=0.1 * n, f=0.05 * n) for n in range(count)) + "\n"


def comma(text: str) -> str:
    return text.replace(".", ",")


TABLE = "Time [s];Depth [mm];Force [N]\n" + rows()

MACH_1 = f"""<Mach-1 File>
<INFO>
Date:\tThu, Feb 17, 2022
Time:\t15:13:47.698
Load Cell Name:\t250N - SN: 1811864
<END INFO>
<Move Relative>
Stage Axis:\tPosition (z)
Amplitude, mm:\t-150.0000
<DATA>
Time, s\tPosition (z), mm\tFz, gf
{rows("{s}", "{t:.6f}{s}-{d:.6f}{s}-{f:.6f}").replace("{s}", chr(9))}<END DATA>

"""
LABVIEW = f"""LabVIEW Measurement\t
Writer_Version\t2
Separator\tTab
Decimal_Separator\t,
***End_of_Header***\t
\t
Channels\t2\t\t
Samples\t12\t12\t
***End_of_Header***\t\t\t
X_Value\tTravel (mm)\tLoad (N)\tComment
{comma(rows(chr(9)))}"""
ZWICK = "\n".join(
    [
        '"Prüfdatum";"03.04.2023"',
        '"Probe 1";"Probe 1";"Probe 1";"Probe 1"',
        '"Prüfzeit";"Standardkraft";"Standardweg";"Werkzeugabstand"',
        '"s";"N";"mm";"mm"',
        comma(rows(";", "{t:.1f}{s}{f:.3f}{s}{d:.2f}{s}17.23")),
    ]
)
BLUEHILL = (
    'Results Table 1\n"","Load at Break (N)","Extension at Break (mm)","Time at Break (s)"\n"1","0.5","1.1","1.1"\n\n'
    '"Time","Extension","Load","Tensile strain (Extension)","Load rate"\n"(s)","(mm)","(N)","(%)","(N/s)"\n'
    + rows(",", '"{t:.5f}"{s}"{d:.5f}"{s}"{f:.5f}"{s}"0.1"{s}"0.0"')
)
US_MACHINE = '"Time","Extension","Load"\n"(sec)","(in)","(lbf)"\n' + rows(",", '"{t:.5f}"{s}"{d:.5f}"{s}"{f:.5f}"')
MTS = "MTS793|MPT|ENU|1|0\n\nStation Name: a.cfg\nAxial Count\tTime\tAxial Displacement\tAxial Force\n"
MTS += "segments\tSec\tmm\tN\n" + rows("\t", "{t:.3f}{s}{t:.3f}{s}{d:.4f}{s}{f:.4f}")
WINTEST = '"WinTest","7.1"\nPoints,Elapsed Time ,Disp  ,Load 1  ,\n  ,Sec ,mm ,N ,\n' + rows(",", "1,{t}{s}{d}{s}{f},")
ANTON_PAAR = f"""Indentation\r
   Max load :\t1000.00 \tµN\r
Time :8:00:16 AM\r
Measured values\r
Time (s)\tPd (µm)\tFn (µN)\tFnRef (µN)\r
\r
{rows(chr(9), "{t:.1f}{s}{d:.1f}{s}{f:.3f}{s}5.35")}"""
PIUMA = "Date\t15.11.2023\nTime\t10:12:13\n\nTime (s)\tLoad (uN)\tIndentation (nm)\tPiezo (nm)\n"
PIUMA += comma(rows("\t", "{t:.1f}{s}{f:.3f}{s}{d:.1f}{s}9"))
JPK = "# xPosition: 0.0\n#\n# units: m N s\n# columns: height vDeflection seriesTime\n"
JPK_ROWS = rows(" ", "-{d:.1f}e-3 {f:.3f} {t:.1f}")
JPK_NAMES = '# fancyNames: "Height" "Vertical deflection" "Series time"\n'
JPK_UNITS_BELOW = "# columns: height vDeflection seriesTime\n# units: m N s\n" + JPK_ROWS
LVM = """LabVIEW Measurement\t
X_Columns\tNo
***End_of_Header***\t
Samples\t12\t12\t
Y_Unit_Label\tmm\tN\t
X_Dimension\tTime\tTime\t
Delta_X\t0.100000\t0.100000\t
***End_of_Header***\t\t\t
X_Value\tDisplacement\tLoad cell force\tComment
"""
OWN_NAMES = "".join(f"Step {n}: {n}\n" for n in range(90)) + "Probe 7;Beef;\nt;Eindringtiefe;Last\ns;mm;N\n" + rows()
OWN = ["time=t", "depth=Eindringtiefe", "force=Last"]
NUMBERED = ["time=1, s", "depth=2, mm", "force=3, N"]
SIDE_BY_SIDE = ",Test 1,,,Test 2,,\nForce,Distance,Time,Force,Distance,Time\ng,mm,sec,g,mm,sec\n"
TEXTURE_ANALYSER = "PROBE TEST1\n\nForce\tDistance\tTime\ng\tmm\tsec\n" + rows("\t", "{f:.3f}{s}{d:.2f}{s}{t:.1f}")

GF = 9.80665e-3
LBF = 453.59237 * GF

# Exported tables, chosen columns, and the unit of force in newtons.
EXPORTS: dict[str, tuple[str, list[str], float]] = {
    "semicolons": (TABLE, [], 1),
    "commas": (TABLE.replace(";", ","), [], 1),
    "tabs": (TABLE.replace(";", "\t"), [], 1),
    "bars": (TABLE.replace(";", "|"), [], 1),
    "spaces": (TABLE.replace(";", " "), [], 1),
    "aligned": ("# Temps d'essai (s)   Weg (mm)  Kraft (N)\n" + rows("    "), [], 1),
    "aligned decimal commas": ("Time, s   Position (z), mm   Fz, N\n" + comma(rows("   ")), [], 1),
    "minus": (TABLE.replace(";0", ";\N{MINUS SIGN}0").replace(";1", ";\N{MINUS SIGN}1"), [], 1),
    "exponents": ("Time_s;Depth_mm;Force_N\n" + rows(";", "{t:.3E}{s}{d:+.3e}{s}{f:.4E}"), [], 1),
    "comments": ("% of a rig\n" + TABLE.replace("\n0.5", "\n# paused\n\n0.5"), [], 1),
    "comma in names": (TABLE.replace(" [s]", ", s").replace(" [mm]", " / mm").replace(" [N]", " in N"), [], 1),
    "footer": (TABLE + "\nMaximum force;0.55\nOperator;A\n", [], 1),
    "carriage returns": (TABLE.replace("\n", "\r\n"), [], 1),
    "Zwick": (ZWICK, [], 1),
    "Instron": (BLUEHILL, [], 1),
    "Mach-1": (MACH_1, [], GF),
    "texture analyser": (TEXTURE_ANALYSER, [], GF),
    "LabVIEW": (LABVIEW, [], 1),
    "LabVIEW, time chosen": (LABVIEW, ["time=X_Value, s"], 1),
    "LabVIEW without times": (LVM + rows("\t", "{s}{d:.1f}{s}{f:.3f}"), [], 1),
    "MTS": (MTS, [], 1),
    "TA Instruments": (WINTEST, [], 1),
    "Anton Paar": (ANTON_PAAR, ["depth=Pd, mm", "force=Fn, N"], 1),
    "JPK": (JPK + JPK_NAMES + JPK_ROWS, [], 1),
    "JPK, raw names": (JPK_UNITS_BELOW, [], 1),
    "own names": (OWN_NAMES, OWN, 1),
    "own names by number": (OWN_NAMES, ["time=1", "depth=2", "force=3"], 1),
    "no names": (rows(), NUMBERED, 1),
    "no names, spaces": (rows("   ", "  {t:.7e}{s}{d:.7e}{s}{f:.7e}"), NUMBERED, 1),
    "no names, decimal commas": (comma(rows(" ")), NUMBERED, 1),
    "one number": (TABLE.replace("Depth", "z"), ["depth=2, mm"], 1),
    "a name is no number": (TABLE.replace("Depth", "1"), ["depth=1, mm"], 1),
    "clock": (TABLE.replace("Time [s]", "Time").replace("\n0.", "\n23:01:00.").replace("\n1.", "\n23:01:01."), [], 1),
}


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., MachineTest]:
    """Read a text as a table."""

    def read_text(text: str | bytes, *columns: str, block: int | None = None) -> MachineTest:
        path = tmp_path / "test.csv"
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return read_machine_test(path, columns, block=block)

    return read_text


Read = Callable[..., MachineTest]


def assert_is_test(test: MachineTest, newtons: float = 1) -> None:
    # A conversion of units rounds once.
    np.testing.assert_allclose(test.time, TIME, rtol=1e-15, atol=1e-16)
    np.testing.assert_allclose(test.depth, DEPTH, rtol=1e-14)
    np.testing.assert_allclose(test.force, FORCE * newtons, rtol=1e-14)
    assert test.time.dtype == test.depth.dtype == test.force.dtype == np.float64


@pytest.mark.parametrize("name", EXPORTS)
def test_exports_of_machines(name: str, read: Read) -> None:
    text, columns, newtons = EXPORTS[name]
    test = read(text, *columns)
    # In a file of nm and uN the choice of mm and N has priority, with a note.
    assert len(test.notes) == (2 if name == "Anton Paar" else 0)
    if name == "clock":
        np.testing.assert_allclose(test.time, 82860 + TIME, rtol=1e-15)
        test = replace(test, time=np.round(test.time - 82860, 9))
    assert_is_test(test, newtons)


def test_units_of_other_machines(read: Read) -> None:
    """Those of their files, also above the names."""
    for text, depth, force in (
        (US_MACHINE, 25.4, LBF),
        (ANTON_PAAR, 1e-3, 1e-6),
        (PIUMA, 1e-6, 1e-6),
        (JPK + JPK_NAMES + JPK_ROWS, 1, 1),
        (JPK_UNITS_BELOW, 1, 1),
    ):
        test = read(text)
        assert test.notes == ()
        np.testing.assert_allclose(test.time, TIME, rtol=1e-14)
        np.testing.assert_allclose(test.depth, depth * DEPTH, rtol=1e-14)
        np.testing.assert_allclose(test.force, force * FORCE, rtol=1e-14)


def test_documented_commands(tmp_path: Path, save: Callable[..., Path]) -> None:
    """Every machine and program of the page has a command that reads its table."""
    side_by_side = SIDE_BY_SIDE + rows(",", "{f:.3f}{s}{d:.2f}{s}{t:.1f}{s}{f:.3f}{s}{d:.2f}{s}{t:.1f}")
    unnamed = LVM.replace("Y_Unit_Label\tmm\tN\t\n", "").replace(
        "Displacement\tLoad cell force", "Untitled\tUntitled 1"
    )
    texts = {
        "mach1.txt": MACH_1,
        "bluehill.csv": US_MACHINE,
        "mts.txt": MTS,
        "wintest.csv": WINTEST,
        "texture.csv": side_by_side,
        "unht.TXT": ANTON_PAAR,
        "piuma.txt": PIUMA,
        "jpk.txt": JPK + JPK_NAMES + JPK_ROWS,
        "labview.lvm": LVM + rows("\t", "{t:.1f}{s}{d:.1f}{s}{f:.3f}"),
        "untitled.lvm": unnamed + rows("\t", "{t:.1f}{s}{d:.1f}{s}{f:.3f}"),
        "own.csv": OWN_NAMES,
        "numbers.dat": rows("   ", "  {t:.7e}{s}{d:.7e}{s}{f:.7e}"),
    }
    for name, text in texts.items():
        (tmp_path / name).write_bytes(text.encode("cp1252" if name == "unht.TXT" else "utf-8"))
    save({"FF1": SHEET, "FF2A": SHEET}).rename(tmp_path / "zwick.xlsx")
    page = Path(__file__).parents[2] / "docs/machine-tables.md"
    commands = re.findall(r"\| `taichi-msm (fit ball\.yaml .*?)` \|", page.read_text())
    names = set()
    for command in commands:
        name, *arguments = shlex.split(command)
        given = program.commands[name].make_context(name, arguments).params
        names.add(given["observed"])
        assert is_table(given["observed"])
        path = tmp_path / given["observed"]
        test = read_machine_test(path, given["columns"], given["sheet"], given["block"])
        np.testing.assert_allclose(test.time, TIME, rtol=1e-14)
    assert names == {"zwick.xlsx", *texts}


@pytest.mark.parametrize("short", ["first", "second", "neither"])
def test_tests_side_by_side(short: str, read: Read, message: Messages) -> None:
    """Their rows end where those of the other test may go on; they may share the first column as time."""
    lines = rows(",", "{f:.3f}{s}{d:.2f}{s}{t:.1f}", 20).splitlines()
    ends = {"first": (COUNT, 20), "second": (20, COUNT), "neither": (COUNT, COUNT)}[short]
    pairs = [",".join(line if n < end else ",," for end in ends) for n, line in enumerate(lines[: max(ends)])]
    text = SIDE_BY_SIDE + "\n".join(pairs)
    with message.raises(SceneError, "--block", "columns 4 to 6"):
        read(text)
    for block, end in enumerate(ends, 1):
        test = read(text, block=block)
        assert len(test.time) == end
        if end == COUNT:
            assert_is_test(test, GF)
    # A number of a column chooses a test, too.
    assert len(read(text, "time=6", "depth=5", "force=4, gf").time) == ends[1]
    shared = "Time (s),Disp 1 (mm),Force 1 (N),Disp 2 (mm),Force 2 (N)\n" + rows(",", "{t}{s}7{d}{s}8{f}{s}{d}{s}{f}")
    assert_is_test(read(shared, block=2))


@pytest.mark.parametrize("name", ["own names", "no names", "no names, spaces", "clock", "no unit", "repeated"])
def test_columns_of_the_error_work_when_copied(name: str, read: Read) -> None:
    text = {
        "no unit": "Time;Depth;Force\n" + rows(),
        "repeated": "Time [s];Time [s];Depth [mm];Force [N]\n" + rows(";", "{t}{s}{t}{s}{d}{s}{f}"),
        "clock": rows(";", "00:00:0{t:.3f}{s}{d}{s}{f}"),
        **{key: text for key, (text, _, _) in EXPORTS.items() if "names" in key},
    }[name]
    with pytest.raises(SceneError) as caught:
        read(text)
    assert len(caught.value.lines) == 1
    assert_is_test(read(text, *re.findall('--columns "([^"]*)"', str(caught.value))))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_encodings(encoding: str, tmp_path: Path) -> None:
    for suffix in (".csv", ".tsv", ".txt", ".TXT"):
        path = tmp_path / f"test{suffix}"
        path.write_bytes(ZWICK.encode(encoding))
        assert_is_test(read_machine_test(str(path)))


UNITS = {
    "time": {"s": 1, "ms": 1e-3, "min": 60, "sec": 1},
    "depth": {"m": 1, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "\N{GREEK SMALL LETTER MU}m": 1e-6, "nm": 1e-9}
    | {"in": 0.0254, "inch": 0.0254},
    "force": {"N": 1, "mN": 1e-3, "kN": 1e3, "gf": GF, "kgf": 1e3 * GF, "KN": 1e3}
    | {"uN": 1e-6, "µN": 1e-6, "lbf": LBF, "ozf": LBF / 16},
}


@pytest.mark.parametrize(("quantity", "unit"), [(quantity, unit) for quantity in UNITS for unit in UNITS[quantity]])
def test_units(quantity: str, unit: str, read: Read) -> None:
    units = {"time": "s", "depth": "mm", "force": "N"} | {quantity: unit}
    scales = {key: UNITS[key][name] for key, name in units.items()}
    in_header = "Time [{time}];depth, {depth};FORCE ({force})\n".format(**units)
    in_row = "Time;depth;FORCE\n[{time}];{depth};({force})\n".format(**units)
    chosen = [f"{key}={key.title()}, {unit}" for key, unit in units.items()]
    for test in (read(in_header + rows()), read(in_row + rows()), read("Time;depth;FORCE\n" + rows(), *chosen)):
        for name, numbers in {"time": TIME, "depth": 1e3 * DEPTH, "force": FORCE}.items():
            np.testing.assert_allclose(getattr(test, name), numbers * scales[name], rtol=1e-14, atol=1e-16)


DEPTHS = "Displacement indentation Extension Elongation Allongement Stroke Position Travel Distance Weg Standardweg"
NAMES = {
    "Time": ["temps d'essai", "ZEIT", "Prüfzeit", "Test time"],
    "Depth": [*DEPTHS.split(), "Position (z)", "Compressive extension"],
    "Force": ["force", "Load", "Fz", "Kraft", "Force standard", "Standardkraft", "Indentation force"],
}


@pytest.mark.parametrize(("quantity", "name"), [(quantity, name) for quantity in NAMES for name in NAMES[quantity]])
def test_names_of_quantities(quantity: str, name: str, read: Read) -> None:
    assert_is_test(read(TABLE.replace(quantity, name)))


def test_the_candidate_nearest_0_is_taken_with_a_note(read: Read, message: Messages) -> None:
    # 90 um are nearer 0 than 0.4 mm.
    test = read("Time, s;Position, um;Extension, mm;Force, N\n" + rows(";", "{t:.1f}{s}9{d:.1f}{s}0.4{s}{f:.3f}"))
    np.testing.assert_allclose(test.depth, 1e-3 * DEPTH + 9e-5, rtol=1e-12)
    message(test.notes, "Extension", "Position")
    # Neither columns without a unit nor names in brackets are candidates.
    for name in ("Position", "Strain (Extension), mm"):
        test = read(f"Time, s;{name};Extension, mm;Force, N\n" + rows(";", "{t:.1f}{s}9{d:.2f}{s}{d:.2f}{s}{f:.3f}"))
        assert_is_test(test)
        assert test.notes == ()


def test_chosen_columns(read: Read, message: Messages) -> None:
    table = "Time [s];Position [mm];Traverse;Force [N]\n" + rows(";", "{t:.1f}{s}9{d:.2f}{s}{d:.2f}{s}{f:.3f}")
    for choice in ("depth=Traverse, mm", "depth = traverse ,mm"):
        assert_is_test(read(table, choice))
    for choice in ("depth=Traverse", "depth=Traverse (mm)"):
        assert_is_test(read(table.replace("Traverse", "Traverse (mm)"), choice))
    # The given unit has priority.
    test = read(table.replace("Traverse", "Traverse (m)"), "depth=Traverse, mm")
    assert_is_test(test)
    message(test.notes, "depth", "mm")


@pytest.mark.parametrize("sign", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_signs(sign: tuple[int, int], read: Read) -> None:
    numbers = "\n".join(f"{t};{sign[0] * (1e3 * d - 0.3)};{sign[1] * (f - 0.1)}" for t, d, f in NUMBERS)
    test = read(f"Time, s;Depth, mm;Force, N\n{numbers}")
    np.testing.assert_allclose(test.depth, DEPTH - 3e-4, atol=1e-15)
    np.testing.assert_allclose(test.force, FORCE - 0.1, atol=1e-15)


@pytest.mark.parametrize(
    ("line", "unit", "digit"),
    [("{f:.3f}", "N", 1e-3), ("{f:.2f}", "mN", 1e-5), ("{f:.5E}", "N", 1e-7), ("{f:g}", "gf", 1e-2 * GF)],
)
def test_last_digit_of_the_forces(line: str, unit: str, digit: float, read: Read) -> None:
    test = read(f"Time, s;Depth, mm;Force, {unit}\n" + rows(";", f"{{t:.6f}}{{s}}{{d:.6f}}{{s}}{line}"))
    assert test.digit == pytest.approx(digit, rel=1e-12)


def test_contradictory_units(read: Read, message: Messages) -> None:
    """The unit nearest to the numbers is taken; an unknown one there leaves that of the title."""
    test = read("Time (s);Depth (mm);Force (N)\nms;m;kN\n" + rows())
    for values, numbers in ((test.time, 1e-3 * TIME), (test.depth, 1e3 * DEPTH), (test.force, 1e3 * FORCE)):
        np.testing.assert_allclose(values, numbers, rtol=1e-14)
    message(test.notes, "'ms'", "'m'", "'kN'")
    test = read("Time (s);Depth (mm);Force (N)\ns;mm;dyn\n" + rows())
    assert_is_test(test)
    message(test.notes, "Force (N)", "'dyn'")
    assert read("Time (s);Depth (mm);Force (N)\n[s];mm;(N)\n" + rows()).notes == ()


def test_grouped_thousands(read: Read) -> None:
    table = '"Time","Depth","Force"\n"(s)","(mm)","(N)"\n' + "".join(
        f'"{n}.00","{n}.00","{f:,.2f}"\n' for n, f in enumerate(1000.5 * np.arange(COUNT))
    )
    for text in (table, table.replace('","', '";"').translate(str.maketrans(",.", ".,"))):
        np.testing.assert_array_equal(read(text).force, 1000.5 * np.arange(COUNT))


def test_chosen_blocks(read: Read, message: Messages) -> None:
    second = MACH_1[MACH_1.index("<Move") :].replace("\t-0.5", "\t-0.6")
    # The line of a wait has a number, and three rows are no block.
    wait = "<Wait>\nTime, s:\t10.0\n<END DATA>\nTime, s\tPosition (z), mm\tFz, gf\n0.0\t0.0\t0.0\n"
    text = MACH_1 + wait + second
    with message.raises(SceneError, "--block", "2"):
        read(text)
    assert_is_test(read(text, block=1), GF)
    test = read(text, block=2)
    message([test.name], "block 2")
    assert test.force[-1] == pytest.approx(0.65 * GF)
    assert test.depth[5] == pytest.approx(0.6e-3)
    for block in (0, 3):
        with message.raises(SceneError, "--block"):
            read(text, block=block)
    assert_is_test(read(MACH_1, block=1), GF)


def strip(force: Callable[[float], float], depth: Callable[[float], float] = lambda t: t) -> str:
    """Table of a test of two seconds: force [N] and depth [mm] as functions of time."""
    times = np.linspace(0, 2, 200)
    return "Time, s;Extension, mm;Force, N\n" + "".join(f"{t};{depth(t)};{force(t)}\n" for t in times)


def test_a_tear_is_noted(read: Read, message: Messages) -> None:
    test = read(strip(lambda t: t if t < 1.5 else 0.3))
    message(test.notes, "tore", "--window")
    # Before the tear the test has no note.
    part = cut_window(test, 0.5, 1.45)
    assert part.notes == ()
    assert 0.5 <= part.time.min() <= part.time.max() <= 1.45
    assert len(part.time) == len(part.depth) == len(part.force) == 95
    assert cut_window(test, 0, 1.9).notes == test.notes


def relax(t: float) -> float:
    return t if t < 0.2 else 0.07 + 0.13 * np.exp(8 * (0.2 - t))


@pytest.mark.parametrize(
    "text",
    [
        # Held from 0.2 s on, with a creep of the depth.
        strip(relax, lambda t: min(t, 0.2) + 1e-3 * t),
        strip(lambda t: min(t, 2 - t), lambda t: min(t, 2 - t)),
        strip(lambda t: t if t < 1.5 else 0.8),
    ],
    ids=["relaxes", "unloaded", "falls less"],
)
def test_no_tear(text: str, read: Read) -> None:
    assert read(text).notes == ()


def test_windows(read: Read, message: Messages) -> None:
    test = read(TABLE)
    assert_is_test(cut_window(test, 0, 2))
    for window in ((0.0, 0.85), (1.0, 0.0), (5.0, 9.0)):
        with message.raises(SceneError, "--window"):
            cut_window(test, *window)


HEADER = TABLE.splitlines()[0]
FAULTS: dict[str, tuple[str | bytes, list[str], list[str]]] = {
    "empty": ("", [], ["empty"]),
    "no names": (rows(), [], ["--columns"]),
    "no depth": (TABLE.replace("Depth", "Traverse"), [], ["csv:1", "depth", "Traverse"]),
    "names in one cell": ("time/depth/force\n" + rows(), [], ["csv:1"]),
    "no unit": (TABLE.replace(" [mm]", ""), [], ["csv:1", "Depth", '--columns "depth=Depth, mm"']),
    "other unit": (TABLE.replace("[N]", "[dyn]"), [], ["Force [dyn]", "kgf"]),
    "megaunit": (TABLE.replace("[N]", "[MN]"), [], ["Force [MN]"]),
    "repeated name": (HEADER + ";Force [N]\n" + rows(";", "{t}{s}{d}{s}{f}{s}{f}"), [], ["csv:1", "Force [N]", "2"]),
    "gap": (TABLE.replace("0.5;0.50;0.250", "0.5;;0.250"), [], ["csv:7", "Depth [mm]", "empty"]),
    "too large": (TABLE.replace("0.250", "1e31"), [], ["csv:7", "Force [N]", "1e31"]),
    "word": (TABLE.replace("0.250", "over"), [], ["csv:7", "Force [N]", "over"]),
    "row of words": (TABLE.replace("0.5;0.50;0.250", "a;b;c"), [], ["csv:7", "a, b, c"]),
    "same time": (TABLE.replace("\n0.5", "\n0.4"), [], ["csv:7", "Time [s]", "0.4"]),
    "few rows": (HEADER + "\n" + rows(count=9), [], ["csv:1", "9", "10"]),
    "decimal commas between commas": (HEADER.replace(";", ",") + "\n" + comma(rows(",")), [], ["csv:2", "6", "3"]),
    "other separator": (HEADER.replace(";", ",") + "\n" + rows(), [], ["csv:2", "commas"]),
    "two decimal marks": (TABLE.replace("0.250", "0,250"), [], ["csv:7", "Force [N]", "0,250"]),
    "more cells than names": (TABLE.replace("0.250", "0.250;1"), [], ["csv:7", "4", "3"]),
    "force at rest": (HEADER + "\n" + rows(line="{t}{s}{d}{s}0.0"), [], ["csv:1", "Force [N]", "--columns"]),
    "workbook by another name": (b"PK\x03\x04\0\0", [], [".xlsx"]),
    "binary": (b"\xff\xfe\x00", [], ["text"]),
    "zero byte": (TABLE.replace("0.250", "0.25\0"), [], ["csv:7", "zero byte"]),
    "tiny times": (HEADER + "\n" + rows(line="{t}e-300{s}{d}{s}{f}"), [], ["csv:1", "Time [s]", "1.1e-300 s"]),
    "tiny depths": (HEADER + "\n" + rows(line="{t}{s}{d}e-300{s}{f}"), [], ["csv:1", "Depth [mm]", "1.1e-303 m"]),
    "tiny forces": (HEADER + "\n" + rows(line="{t}{s}{d}{s}{f}e-300"), [], ["csv:1", "Force [N]", "5.5e-301 N"]),
    "column of no quantity": (TABLE, ["strain=Strain, mm"], ["--columns", "strain"]),
    "column chosen twice": (TABLE, ["depth=Depth", "depth=Time"], ["--columns", "depth"]),
    "time of another unit": (TABLE.replace("[s]", "[ms]"), ["time=Time [s]"], ["csv:1", "Time [s]"]),
    "column for two quantities": (TABLE, ["depth=Force [N], mm"], ["csv:1", "force"]),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_a_text(name: str, read: Read, message: Messages) -> None:
    text, columns, words = FAULTS[name]
    with message.raises(SceneError, *words) as caught:
        read(text, *columns)
    assert len(caught.value.lines) == 1


def test_unreadable_files(tmp_path: Path, message: Messages) -> None:
    pytest.importorskip("openpyxl")
    with (tmp_path / "large.csv").open("wb") as file:
        file.truncate(1 << 30)
    for path in (tmp_path / "missing.csv", tmp_path, tmp_path / "large.csv", "a\0b"):
        with message.raises(SceneError):
            read_machine_test(path)
    for name in ("text.csv", "damaged.xlsx"):
        (tmp_path / name).write_text(TABLE)
    with message.raises(SceneError, "damaged.xlsx"):
        read_machine_test(tmp_path / "damaged.xlsx")
    with message.raises(SceneError, "--sheet"):
        read_machine_test(tmp_path / "text.csv", sheet="FF2")


# A table of a workbook: names, units, and rows of numbers.
SHEET: list[list[Any]] = [
    ["FF2", "FF2", "FF2", "FF2"],
    ["Temps d'essai", "Force standard", "Allongement", "Ecartement entre outils"],
    ["s", "N", "mm", "mm"],
    *([0.1 * n, 0.05 * n, 0.1 * n, 17.2 - 0.1 * n] for n in range(COUNT)),
]


def add_chart_sheet(book: Any) -> None:
    from openpyxl.chart import LineChart

    book.create_chartsheet("Chart").add_chart(LineChart())


def leave_a_chart(book: Any) -> None:
    add_chart_sheet(book)
    book.remove(book["FF2"])


@pytest.fixture
def save(tmp_path: Path) -> Callable[..., Path]:
    """Save a workbook of sheets by name, after a change."""
    openpyxl: Any = pytest.importorskip("openpyxl")

    def save_workbook(sheets: dict[str, list[list[Any]]], change: Callable[[Any], object] = lambda book: None) -> Path:
        book = openpyxl.Workbook()
        book.remove(book.active)
        for name, cells in sheets.items():
            sheet = book.create_sheet(name)
            for row in cells:
                sheet.append(row)
        change(book)
        book.save(tmp_path / "tests.xlsx")
        return tmp_path / "tests.xlsx"

    return save_workbook


Save = Callable[..., Path]


def test_workbook(save: Save, message: Messages) -> None:
    summary = [["", "Fmax", "dL(Fmax)"], ["", "N", "mm"], ["FF2", 0.55, 1.1]]
    test = read_machine_test(save({"Paramètres": [["Norme d'essai"]], "Résultats": summary, "FF2": SHEET, "Empty": []}))
    assert_is_test(test)
    assert test.digit == pytest.approx(1e-2)
    message([test.name], "FF2")
    # An upper-case suffix, a shifted table, texts as numbers, a note at its side.
    shifted: list[list[Any]] = [[], *([None, *row] for row in SHEET)]
    shifted[7] = [None, "0.3", "0.15", "0.3", 16.9, None, "a note"]
    shifted.insert(8, [None] * 6 + ["a note"])
    path = save({"FF2": shifted}, put("XFD1048576", 1))
    assert_is_test(read_machine_test(path.rename(path.with_suffix(".XLSX"))))


def test_clock_times_of_a_workbook(save: Save) -> None:
    cells = [[time(9, 0, n // 10, n % 10 * 100_000), *row[1:]] for n, row in enumerate(SHEET[3:])]
    test = read_machine_test(save({"FF2": [*SHEET[:3], *cells]}))
    # Excel keeps times as shares of a day, with 15 digits; clock times have microseconds.
    np.testing.assert_allclose(test.time, 32400 + TIME, atol=1e-6)


def test_chosen_sheet_and_block(save: Save, message: Messages) -> None:
    path = save({"notes": [["x"]], "FF1": SHEET, "FF2": [*SHEET, [], *SHEET[1:]]}, add_chart_sheet)
    with message.raises(SceneError, "--sheet", "FF1, FF2"):
        read_machine_test(path)
    assert_is_test(read_machine_test(path, sheet="ff1"))
    for name in ("FF3", "notes", "Chart"):
        with message.raises(SceneError, name):
            read_machine_test(path, sheet=name)
    with message.raises(SceneError, "--block"):
        read_machine_test(path, sheet="FF2")
    assert_is_test(read_machine_test(path, sheet="FF2", block=2))


def put(cell: str, value: object) -> Callable[[Any], None]:
    def change(book: Any) -> None:
        book["FF2"][cell] = value

    return change


SHEET_FAULTS: dict[str, tuple[list[list[Any]], Callable[[Any], object], list[str]]] = {
    "empty sheet": ([], lambda book: None, ["FF2", "empty"]),
    "several sheets without a table": ([], lambda book: book.create_sheet("FF3"), ["FF2, FF3"]),
    "only a chart": ([], leave_a_chart, ["tests.xlsx"]),
    "merged names": (SHEET, lambda book: book["FF2"].merge_cells("B2:C2"), ["FF2!B2", "merged"]),
    "column of formulas": (
        [[*row[:2], f"=A{n}" if n > 3 else row[2], row[3]] for n, row in enumerate(SHEET, 1)],
        lambda book: None,
        ["FF2!C4", "=A4"],
    ),
    "gap": (SHEET, put("B14", None), ["FF2!B14", "Force standard", "empty"]),
    "error": (SHEET, put("B14", "#DIV/0!"), ["FF2!B14", "#DIV/0!"]),
    "row of formulas": ([*SHEET[:-1], ["=A14"] * 4], lambda book: None, ["FF2!A15", "=A14"]),
    "date": (SHEET, put("A14", datetime(2023, 4, 3)), ["FF2!A14", "date"]),
    "no unit": (SHEET, put("C3", None), ["FF2!C2", "Allongement", "--columns"]),
}


@pytest.mark.parametrize("name", SHEET_FAULTS)
def test_faults_of_a_sheet(name: str, save: Save, message: Messages) -> None:
    cells, change, words = SHEET_FAULTS[name]
    with message.raises(SceneError, *words) as caught:
        read_machine_test(save({"FF2": cells}, change))
    assert len(caught.value.lines) == 1


LIMITS = "UNPACKED_BYTES MARKS CELLS CHARACTERS DEPTH NAMES TAG_BYTES CELL_CHARACTERS SHEETS STYLES MERGED"


@pytest.mark.parametrize("limit", LIMITS.split())
def test_limits_of_a_workbook(limit: str, save: Save, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    path = save({"FF2": SHEET}, lambda book: [book["FF2"].merge_cells(f"B{row}:C{row}") for row in (90, 91)])
    monkeypatch.setattr("taichi_msm.machines.workbook.CHUNK_BYTES", 50)
    monkeypatch.setattr(f"taichi_msm.machines.workbook.MAX_{limit}", 0)
    with message.raises(SceneError, "tests.xlsx", "more than 0"):
        read_machine_test(path)


def test_too_many_lines(read: Read, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr("taichi_msm.machines.cells.MAX_LINES", 10)
    with message.raises(SceneError, "test.csv", "13 lines"):
        read(TABLE)


def damage(data: bytes, rng: random.Random) -> bytes:
    """Change, remove, repeat or insert some bytes."""
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(data))
        end = min(len(data), start + rng.choice([1, 1, 1, 4, 40]))
        typed = bytes(rng.choices(b'0123456789eE+-,.;\t "\n#%=', k=end - start))
        new = rng.choice([b"", data[start:end] * 2, typed, rng.randbytes(end - start)])
        data = data[:start] + new + data[end:] or b" "
    return data


@pytest.mark.parametrize("tries", [10, pytest.param(300, marks=pytest.mark.fuzz)], ids=["some", "all"])
def test_damaged_texts(tries: int, tmp_path: Path) -> None:
    """A table with random damage is a valid test, or a SceneError."""
    rng = random.Random(0)
    for text, _, _ in EXPORTS.values():
        for encoding in ("utf-8", "utf-16"):
            for _ in range(tries):
                (tmp_path / "test.csv").write_bytes(damage(text.encode(encoding), rng))
                with suppress(SceneError):
                    test = read_machine_test(tmp_path / "test.csv")
                    assert len(test.time) == len(test.depth) == len(test.force) >= 10
                    assert np.isfinite([test.time, test.depth, test.force]).all()
                    assert (np.diff(test.time) > 0).all()
                    assert test.depth[np.abs(test.depth).argmax()] > 0
