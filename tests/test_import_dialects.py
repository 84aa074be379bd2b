"""Tables as laboratories write them: encodings, delimiters, cut and padded lines, dates, rows of units, names."""

import numpy as np
import pytest

pytest.importorskip("pyarrow")
from soro_bench.recording.importers import import_recording, table_text
from soro_bench.recording.recording import NOTES, Recording, RecordingError
from tests.arm import says

CLOCK = '[time]\ncolumn = "t"\n'
X = '[signals.x]\ncolumns = ["x"]\nunit = "mm"\n'
U = '[commands.u]\ncolumns = ["u"]\nunit = "1"\n'


@pytest.fixture
def read(tmp_path):
    """Reads a table, given as text or bytes, with a mapping."""

    def read(table: str | bytes, mapping: str) -> Recording:
        (tmp_path / "a.csv").write_bytes(table.encode() if isinstance(table, str) else table)
        (tmp_path / "a.toml").write_text(mapping)
        return import_recording(tmp_path / "a.csv", tmp_path / "a.toml")

    return read


def values(recording: Recording) -> list[float]:
    """Of the one signal, in mm."""
    return np.round(1e3 * recording.signals["x"].values, 9).tolist()


GERMAN = "Zeit [s];Weg [µm];x\r\n0,00;0;1,5\r\n0,01;0;2,5"


@pytest.mark.parametrize(
    ("encoding", "named"),
    [("cp1252", "cp1252"), ("utf-16", "utf-16"), ("utf-16-le", "utf-16"), ("ISO-8859-15", "cp1252")],
)
def test_a_text_of_another_encoding_needs_the_entry_that_the_message_names(read, encoding, named):
    mapping = '[format]\ndelimiter = ";"\ndecimal = ","\n[time]\ncolumn = "Zeit [s]"\n' + X
    with pytest.raises(RecordingError, match=says("encoding = ", named)):
        read(GERMAN.encode(encoding), mapping)
    assert values(read(GERMAN.encode(encoding), f'[format]\nencoding = "{encoding}"\n' + mapping[9:])) == [1.5, 2.5]
    with pytest.raises(RecordingError, match=says("encoding = 'zip'", "utf-8", "cp1252")):
        read(GERMAN, '[format]\nencoding = "zip"\n' + mapping[9:])


@pytest.mark.parametrize(
    "table",
    [
        "t,x,u\n0,1,5,\n1,2,6,\n",
        "t,x,u,\n0,1,5,\n1,2,6,\n",
        "t,x,u,\n0,1,5\n1,2,6\n",
        "t,x,u,,\n0,1,5,\n1,2,6\n",
        't,x,u\n0,1,"5",\n1,2,6,\n',
        "sep=,\nt,x,u\n0,1,5\n1,2,6\n",
        "\ufefft,x,u\n\n0,1,5\n\n1,2,6\n\n",
        "\nt,x,u\r0,1,5\r1,2,6\r",
        "t,x,u\n0,+1,5\n1, 2 ,6\n",
        't,x,u\n0,TRUE,"5,0"\n1,"2,0","6,0"\n',
    ],
)
def test_what_does_not_change_a_table(read, table):
    """Delimiters at the end of rows, the line of Excel, empty lines, a byte order mark, signs, blanks, decimal commas
    in quotation marks, and truth values."""
    recording = read(table, ('[format]\ndecimal = ","\n' if "TRUE" in table else "") + CLOCK + X + U)
    assert (values(recording), recording.commands["u"].values.tolist()) == ([1, 2], [5, 6])
    assert recording.signals["x"].time.tolist() == [0, 1]


def test_a_delimiter_that_excel_contradicts_is_refused(read):
    with pytest.raises(RecordingError, match=says("delimiter = ','", "sep=;")):
        read("sep=;\nt;x\n0;1\n", '[format]\ndelimiter = ","\n' + CLOCK + X)


@pytest.mark.parametrize("end", ["2", "2.0,", "2.0,3", "2.0,3.", "2.0,30.5,4", '2.0,"3', "\x00\x00\x00"])
def test_a_last_line_that_is_cut_is_left_out_and_said(read, end):
    """In a number, too: others have two decimals."""
    recording = read("t,x\n0.0,10.25\n1.0,-2.50\n" + end, CLOCK + X)
    assert values(recording) == [10.25, -2.5]
    assert "left out" in recording.metadata[NOTES]


@pytest.mark.parametrize(
    ("table", "expected"),
    [("0.0,10.25\n1.0,-2.50", [10.25, -2.5]), ("0,1e-05\n1,2e+05", [1e-5, 2e5]), ("0,7\n1,8", [7, 8]), ("0,7", [7])],
)
def test_a_last_line_without_an_end_counts_if_it_is_as_long_as_the_others(read, table, expected):
    recording = read("t,x\n" + table, CLOCK + X)
    assert values(recording) == expected
    assert NOTES not in recording.metadata


def test_a_letter_of_several_bytes_that_is_cut(read):
    assert values(read("t,x,µ\n0.0,1.5,a\n1.0,2.5,b\n2.0,3.5,\u00b5".encode()[:-1], CLOCK + X)) == [1.5, 2.5]


@pytest.mark.parametrize(
    "table",
    ["# t   x  y\n0  1.5 7\n 1\t2.5  8 \n\n2 3.5 9\n", "%t x y\n0 1.5 7\n1 2.5 8\n2 3.5 9\n"],
)
def test_columns_between_blanks(read, table):
    mapping = '[format]\ndelimiter = "blank"\n' + CLOCK + X
    assert values(read(table, mapping)) == [1.5, 2.5, 3.5]
    with pytest.raises(RecordingError, match=says("line", "cells", 'delimiter = "blank"')):
        read("t x y\n0  1 2\n", mapping.replace("blank", " "))


@pytest.mark.parametrize(
    ("stamps", "entries", "expected"),
    [
        ("2024-06-27 10:11:02.000|2024-06-27 10:11:02.25", "", [0, 0.25]),
        ("2024-06-27T23:59:59Z|2024-06-28T02:00:00.5+02:00", "", [0, 1.5]),
        ("27.06.2024 10:11:02|27.06.2024 10:11:03", "", [0, 1]),
        ("27-Jun-2024 10:11:02|27-JUN-2024 10:11:03", "", [0, 1]),
        ("27-Okt-2024 10:11:02 GMT|27-OCT-2024 10:11:03 GMT", "", [0, 1]),
        ("20240627T101102.5Z|20240627_101103Z", "", [0, 0.5]),
        ("20240627235959|20240628000000.5", "", [0, 1.5]),
        ("20240627235959250|20240628000000125", "", [0, 0.875]),
        ("20240627101161|20240628101161", 'unit = "ns"', [0, 1e-3]),
        ("2024-06-27 10:11:02+02|2024-06-27 08:11:03Z", "", [0, 1]),
        ("2:59.5|3:00.25", "", [0, 0.75]),
        ("30/06/2024 23:59:59|01/07/2024 00:00:00", 'date = "day/month/year"', [0, 1]),
        ("06/30/2024 11:59 PM|07/01/2024 12:00 AM", 'date = "month/day/year"', [0, 60]),
        ("23:59:59.5|0:00:00.25", "", [0, 0.75]),
        ("11:59:59 AM|12:00:01 PM", "", [0, 2]),
        ("|2024-06-27 10:11:02", "", [0]),
        ("0 days 23:59:59.750000|1 days 00:00:01.000000", "", [0, 1.25]),
        ("-1 days +23:59:59.5|0 days 00:00:01", "", [0, 1.5]),
        ("0 days 00:00:01|1 day 0:00:01.5", "", [0, 86400.5]),
        ("PT59.5S|PT1M0.25S|P0DT0H1M2S|P1D", "", [0, 0.75, 2.5, 86340.5]),
        ("0.23:59:59.5|1.00:00:01", "", [0, 1.5]),
        ("4294967280|4294967290|4", 'unit = "ms"', [0, 0.01, 0.02]),
        ("4294967280|4294967290|14|4", 'unit = "ms"\norder = "sort"', [0, 0.01, 0.02, 0.03]),
        ("4294967.28|4294967.29|0.004", "", [0, 0.01, 0.02]),
        ("4294.95|4294.96|0.002704", "", [0, 0.01, 0.02]),
    ],
)
def test_dates_and_times(read, stamps, entries, expected):
    table = "t,x\n" + "".join(f"{stamp},{i}\n" for i, stamp in enumerate([*stamps.split("|"), ""]))
    np.testing.assert_allclose(read(table, CLOCK + entries + "\n" + X).signals["x"].time, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("stamps", "entries", "parts"),
    [
        ("2024-06-27 10:11:02|2024-06-27 10:11:03Z", "", ("line 3", "a zone")),
        ("2024-06-27 10:11:02|soon", "", ("line 3", "'soon'", "no time such as")),
        ("2024-13-27 10:11:02|", "", ("line 2", "no date")),
        ("27-Foo-2024 10:11:02|", "", ("line 2", "no date", "months are jan")),
        ("06/27/2024 10:11:02|", "", ("line 2", "date = ", "day/month/year")),
        ("06/27/2024 10:11:02|", 'date = "us"', ("date = 'us'", "day/month/year")),
        ("0|1", 'date = "day/month/year"', ("date has no effect",)),
        ("27 June 2024 10:11:02|", "", ("line 2", "as 2024-06-27T10:11:02")),
        ("0001-01-01 10:11:02|", "", ("line 2", "expected a year")),
        ("20240627101102|20240627101103", 'unit = "us"', ("unit of time has no effect",)),
        ("2024-06-27 10:11:02|", 'unit = "s"', ("unit of time has no effect",)),
        ("2024-06-27 10:11:02|", "period = 60", ("[time] period has no effect", "dates")),
        ("27 June|28 June", "", ("line 2", "no finite number")),
        ("10:75:00|10:76:00", "", ("line 2", "'10:75:00'")),
        ("PT1.25S|PT", "", ("line 3", "'PT'", "no time such as")),
        ("P1Y|P2Y", "", ("line 2", "'P1Y'")),
    ],
)
def test_bad_dates_and_times(read, stamps, entries, parts):
    table = "t,x\n" + "".join(f"{stamp},{i}\n" for i, stamp in enumerate(stamps.split("|")))
    with pytest.raises(RecordingError, match=says(*parts)):
        read(table, f"{CLOCK}{entries}\n{X}")


def test_time_in_two_columns(read):
    """As ros2 topic echo --csv writes it: to the nanosecond, without a header."""
    table = "1719433753,999999999,base,1.5\n1719433754,1,base,2.5\n"
    mapping = '[format]\nheader = false\n[time]\ncolumns = [1, "2"]\nunits = ["s", "ns"]\n' + X.replace('"x"', '"4"')
    time = read(table, mapping).signals["x"].time
    np.testing.assert_allclose(time, [0, 2e-9], rtol=1e-9)
    with pytest.raises(RecordingError, match=says("2 columns", 'units = ["s", "ns"]')):
        read(table, mapping.replace('units = ["s", "ns"]', ""))
    with pytest.raises(RecordingError, match=says("[time] period has no effect", "several columns")):
        read(table, mapping.replace("units", "period = 60\nunits"))
    with pytest.raises(RecordingError, match=says("both unit and units")):
        read(table, mapping.replace("units = ", 'unit = "s"\nunits = '))


def test_a_date_and_a_time_of_day_in_two_columns(read):
    mapping = '[time]\ncolumns = ["d", "t"]\n' + X
    for late, early in (("2024-06-27,23:59:59", "2024-06-28,00:00:01"), ("20240627,235959.0", "20240628,000001.0")):
        recording = read(f"d,t,x\n{late},1\n{early},2\n", mapping)
        np.testing.assert_allclose(recording.signals["x"].time, [0, 2])


@pytest.mark.parametrize("words", [("WAHR", "FALSCH"), ("vrai", "faux"), ("ON", "OFF")])
def test_truth_values_of_office_programs_and_switches(read, words):
    recording = read(f"t,x,u\n0,1,{words[0]}\n1,2,{words[1]}\n", CLOCK + X + U)
    assert recording.commands["u"].values.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("table", "entries", "parts"),
    [
        ('t,x\n0,"1,234.5"\n', "", ("line 2", "separators of thousands")),
        ("t;x\n0;1.234,5\n", 'delimiter = ";"\ndecimal = ","\n', ("line 2", "separators of thousands")),
        ("t;x\n0;1 234,5\n", 'delimiter = ";"\ndecimal = ","\n', ("line 2", "separators of thousands")),
        ("t;x\n0;1,5\n", 'delimiter = ";"\n', ("line 2", "decimal = ")),
        ("t;x\n0;a, b\n1;2\n", 'delimiter = ";"\n', ("line 2", "[format] missing")),
        ("t,x\n0,1\n", "header = false\n", ("line 1", "leave [format] header = false out")),
        ("t,x\ns,mm\ntime,way\n0,1\n", 'unit_row = "take"\n', ("line 3", "header = false and skip_rows")),
        ("t,x\n0,1\n1,2\n", 'unit_row = "skip"\n', ("unit_row = 'skip'", "has numbers")),
        ("t,x,n\n0,7,A\n1,2,A\n", 'unit_row = "skip"\n', ("unit_row = 'skip'", "has numbers")),
    ],
)
def test_the_message_on_a_cell_says_what_helps(read, table, entries, parts):
    mapping = '[time]\ncolumn = "1"\n[signals.x]\ncolumns = ["2"]\nunit = "mm"\n' if "false" in entries else CLOCK + X
    with pytest.raises(RecordingError, match=says(*parts)):
        read(table, f"[format]\n{entries}" + mapping)


def test_ticks_of_a_tenth_of_a_microsecond_since_the_year_one(read):
    table = "t,x\n" + "".join(f"{639_000_000_000_000_000 + 100_000 * i},{i}\n" for i in range(5))
    signal = read(table, CLOCK + 'unit = "100ns"\n' + X).signals["x"]
    np.testing.assert_allclose(signal.time, 0.01 * np.arange(5), atol=2e-5)  # 64 bits of a number have that much


def test_a_row_of_units(read):
    """It is taken or skipped on request, and not taken for numbers."""
    table, signal = "t,x,q\nms,[mm],\u00b0\n0,1,90\n10,2,180\n", '[signals.q]\ncolumns = ["q"]\n'
    with pytest.raises(RecordingError, match=says("line 2", 'unit_row = "take" or "skip"')):
        read(table, CLOCK + X)
    taken = read(table, '[format]\nunit_row = "take"\n' + CLOCK + X + signal)
    np.testing.assert_allclose(taken.signals["q"].values, [np.pi / 2, np.pi])
    np.testing.assert_allclose(taken.signals["q"].time, [0, 0.01])
    spelt = read(table.replace("ms", "Millisekunden"), '[format]\nunit_row = "take"\n' + CLOCK + X)
    np.testing.assert_allclose(spelt.signals["x"].time, [0, 0.01])
    with pytest.raises(RecordingError, match=says("row of units says 'ticks'", "[time] unit, one of ns, 100ns, us")):
        read(table.replace("ms", "ticks"), '[format]\nunit_row = "take"\n' + CLOCK + X)
    with pytest.raises(RecordingError, match=says("[time] unit = 's'", "row of units says 'ms'")):
        read(table, '[format]\nunit_row = "take"\n' + CLOCK + 'unit = "s"\n' + X)
    skipped = read(table, '[format]\nunit_row = "skip"\n' + CLOCK + 'unit = "s"\n' + X)
    assert (skipped.signals["x"].time.tolist(), values(skipped)) == ([0, 10], [1, 2])
    with pytest.raises(RecordingError, match=says("signals.x", "unit = 'm'", "mm")):
        read(table, '[format]\nunit_row = "take"\n' + CLOCK + X.replace('"mm"', '"m"'))
    with pytest.raises(RecordingError, match=says("signals.x", "'[mm]'", "'ms'", "unit")):
        read(table, '[format]\nunit_row = "take"\n' + CLOCK + '[signals.x]\ncolumns = ["t", "x"]\n')
    short = read(table.replace(",\u00b0", ""), '[format]\nunit_row = "take"\n' + CLOCK + X)
    assert values(short) == [1, 2]
    with pytest.raises(RecordingError, match="no unit"):
        read(table, CLOCK + '[signals.x]\ncolumns = ["x"]\n')


def test_columns_of_one_name_are_chosen_by_number(read):
    table = "t,x,t,u\n0,1,0.5,3\n1,2,1.5,4\n"
    with pytest.raises(RecordingError, match=says("2 columns are called 't'", "by its number", "1, 3")):
        read(table, CLOCK + X)
    recording = read(table, "[time]\ncolumn = 1\n" + X + U + "time = 3\n")
    assert recording.commands["u"].time.tolist() == [0.5, 1.5]
    with pytest.raises(RecordingError, match=says("no column 5", "1 to 4")):
        read(table, "[time]\ncolumn = 5\n" + X)


@pytest.mark.parametrize(
    "word",
    ["inf", "-inf", "#N/A", "#DIV/0!", "-nan(ind)", "1.#QNAN", "-1.#IND00", "#NV", "#WERT!", "#N/D", "NULL", "NaN", ""],
)
def test_what_is_no_finite_number_is_missing(read, word):
    recording = read(f"t,x\n0,1\n1,{word}\n2,3\n", CLOCK + X)
    assert (recording.signals["x"].time.tolist(), values(recording)) == ([0, 2], [1, 3])
    assert values(read(f"t,x\n0,\u22121\n1,{word}\n", CLOCK + X)) == [-1]


def test_missing_belongs_to_one_signal(read):
    """Zeros of a lost marker are no zeros of a command."""
    table = "t,x,u\n0,0.000,0\n1,2,0\n2,3,1\n"
    with pytest.raises(RecordingError, match=says("commands.u", "missing = ['0']", "empty 2", "at the signals")):
        read(table, '[format]\nmissing = ["0"]\n' + CLOCK + X + U)
    for word in ('["0"]', "[0]", "0.0"):
        mapping = (
            f"[format]\nmissing = {word}\n{CLOCK}{X}{U}missing = []\n"
            if word == "[0]"
            else (CLOCK + X + f"missing = {word}\n" + U)
        )
        recording = read(table, mapping)
        assert (values(recording), recording.commands["u"].values.tolist()) == ([2, 3], [0, 0, 1])
    with pytest.raises(RecordingError, match=says("line 2", "'lost'", "missing at one signal")):
        read("t,x,u\n0,lost,1\n1,2,lost\n", CLOCK + X + U + 'missing = ["lost"]\n')


def test_clocks_of_several_units(read):
    recording = read("t,x,tu,u\n0,1,0,5\n1,2,100,6\n", CLOCK + X + U + 'time = "tu"\ntime_unit = "ms"\n')
    assert recording.commands["u"].time.tolist() == [0, 0.1]
    dates = "".join(f"{i},1,,\n" for i in range(30)) + "30,,2024-06-27 10:11:02,5\n31,,2024-06-27 10:11:03,6\n"
    late = read("t,x,tu,u\n" + dates, U + 'time = "tu"\n')  # the first date stands far below
    assert late.commands["u"].time.tolist() == [0, 1]
    with pytest.raises(RecordingError, match=says("u begins 1.719e+09 s after signals.x", "clocks differ", "shift")):
        read("t,x,tu,u\n" + dates, CLOCK + X + U + 'time = "tu"\n')
    with pytest.raises(RecordingError, match=says("'t_ms' says ms", 'write [time] unit = "ms"')):
        read("t_ms,x\n0,1\n", CLOCK.replace('"t"', '"t_ms"') + X)
    with pytest.raises(RecordingError, match="time_unit has no effect"):
        read("t,x\n0,1\n", CLOCK + X + 'time_unit = "ms"\n')


LONG = "t,joint,q\n0,b,2\n0,a,1\n1,a,3\n1,c,9\n1,b,4\n2,b,6\n"
WIDE = "t,n1,n2,q1,q2\n0,b,a,2,1\n1,a,b,3,4\n2,b,c,6,9\n"


@pytest.mark.parametrize(
    ("table", "place"),
    [(LONG, 'columns = ["q"]\nnames_from = "joint"'), (WIDE, 'columns = ["q1", "q2"]\nnames_from = ["n1", "n2"]')],
)
def test_numbers_are_chosen_by_the_names_beside_them(read, table, place):
    signal = f'[signals.x]\nunit = "mm"\n{place}\nnames = ["a", "b"]\n'
    recording = read(table, CLOCK + signal)
    np.testing.assert_allclose(1e3 * recording.signals["x"].values, [[1, 2], [3, 4], [np.nan, 6]])
    assert recording.signals["x"].time.tolist() == [0, 1, 2]
    with pytest.raises(RecordingError, match=says("no row has the name 'd'", "there are", "a")):
        read(table, CLOCK + signal.replace('"a"', '"d"'))
    with pytest.raises(RecordingError, match="belong together"):
        read(table, CLOCK + signal.replace('names = ["a", "b"]', ""))
    with pytest.raises(RecordingError, match=says("the name 'b'", "twice")):
        read(table.replace("a,1", "b,1").replace("b,a", "b,b"), CLOCK + signal)


def test_names_whose_stamps_differ_are_said(read):
    """Each sample then lacks the numbers of all others."""
    table = "t,joint,q\n0,a,1\n0.001,b,2\n1,a,3\n1.001,b,4\n"
    mapping = '[signals.q]\ncolumns = ["q"]\nunit = "1"\nnames = ["a", "b"]\nnames_from = "joint"\n'
    assert "of 4 times 0 have all of ['a', 'b']" in read(table, CLOCK + mapping).metadata[NOTES]
    assert NOTES not in read(table.replace("001", "0"), CLOCK + mapping).metadata


def test_rows_of_one_signal(read):
    """Each signal may have rows of its own; trial 1 is not trial 10."""
    trials = read("t,x,trial\n0,1,1\n1,2,10\n2,3,1.0\n", '[format]\nlabel = "trial"\nonly = [1]\n' + CLOCK + X)
    assert values(trials) == [1, 3]
    runs = '[format]\nlabel = "trial"\nonly = ["run1"]\n'
    assert values(read("t,x,trial\n0,1,run1\n1,2,run10\n2,3,run1_pull\n", runs + CLOCK + X)) == [1, 3]
    signals = [f'[signals.{n}]\ncolumns = ["q"]\nunit = "1"\nlabel = "joint"\nonly = ["{n}"]\n' for n in "ab"]
    recording = read(LONG, CLOCK + "".join(signals))
    assert [recording.signals[n].values.tolist() for n in "ab"] == [[1, 3], [2, 4, 6]]
    assert [recording.signals[n].time.tolist() for n in "ab"] == [[0, 1], [0, 1, 2]]


def test_a_table_of_several_blocks(read):
    """Unusual cells far behind change nothing, and a message knows the line, also after a cell of two lines."""
    rows = [f"{i},{i / 8},{'a' * 200}" for i in range(40_000)]
    rows[30_000] = '30000,"+3750",a'
    rows[35_000] = '35000,4375,"a\nb"'
    table = "t,x,name\n" + "\n".join(rows) + "\n"
    np.testing.assert_array_equal(read(table, CLOCK + X.replace("mm", "m")).signals["x"].values, np.arange(40_000) / 8)
    with pytest.raises(RecordingError, match="line 39993: 'lost'"):
        read(table.replace("39990,4998.75", "39990,lost"), CLOCK + X)


def test_a_file_of_comments_is_refused_before_all_are_looked_at(read, monkeypatch):
    monkeypatch.setattr(table_text, "_MOST_INTERRUPTIONS", 50)
    kept = "t,x\n0,1\n" + 50 * "#\n" + "10,2\n"
    assert values(read(kept, CLOCK + X)) == [1, 2]
    with pytest.raises(RecordingError, match=says("more than 50 lines", "comments")):
        read(kept.replace("#", "#\n#", 1), CLOCK + X)


@pytest.mark.parametrize("between", ["# paused, once, 1, 2", "% paused", "t,x,u", "t,x,u\n#\n", "#\tagain"])
def test_comments_and_a_repeated_header_between_rows_are_left_out(read, between):
    recording = read(f"t,x,u\n0,1,2\n{between}\n1,2,3\n2,3,4\n", CLOCK + X)
    assert values(recording) == [1, 2, 3]
    assert "the first is line 3" in recording.metadata[NOTES]


def test_rows_that_only_begin_as_comments_do_are_kept(read):
    mapping = CLOCK + X + 'label = "n"\nonly = ["#1"]\n'
    assert values(read("n,t,x\n#1,0,1\n#2,0,5\n#1,1,2\n", mapping)) == [1, 2]
    assert values(read("x,t\n1,0\n#N/A,1,\n3,2\n", CLOCK + X)) == [1, 3]
    with pytest.raises(RecordingError, match=says("line 3", "'#1' is no finite number")):
        read("t,x\n0,1\n#1,2\n2,3\n", CLOCK + X)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ("1.25D+01 -.5d0 2.D-1", [12.5, -0.5, 0.2]),
        ("0x10 0XfF 3", [16, 255, 3]),
        ("yes No JA", [1, 0, 1]),
        ("oui nein non", [1, 0, 0]),
        ("\u22121.5 \u20132 3", [-1.5, -2, 3]),
    ],
)
def test_numbers_and_truth_values_as_other_programs_write_them(read, cells, expected):
    assert (
        values(read("t,x\n" + "".join(f"{i},{cell}\n" for i, cell in enumerate(cells.split())), CLOCK + X)) == expected
    )


@pytest.mark.parametrize("cell", ["1.5 mm", "12D4", "0x", "(1.5)", "1.5-", "1.5D+4000", "0x1G"])
def test_what_only_resembles_a_number_is_refused(read, cell):
    with pytest.raises(RecordingError, match=says("line 3", "is no finite number", "missing")):
        read(f"t,x\n0,1\n1,{cell}\n", CLOCK + X)


def test_separators_of_thousands_that_look_like_decimal_points_are_asked_about(read):
    """In 998, 1.003; not where numbers have three decimals, or are rounded."""
    rows = [f"{i},{911 + 11 * i:,}\n".replace(",", ".").replace(".", ",", 1) for i in range(100)]
    assert "1.01 follows 999" in read("t,x\n" + "".join(rows), CLOCK + X).metadata[NOTES]
    for numbers in (np.arange(30) / 8, 990 + np.arange(30) / 4, np.arange(30) % 7 * 1.001):
        rows = [f"{i},{number:g}\n" for i, number in enumerate(numbers)]
        assert NOTES not in read("t,x\n" + "".join(rows), CLOCK + X).metadata
