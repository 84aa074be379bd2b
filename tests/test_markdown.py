"""Tables in Markdown."""

from soro_bench.markdown import table


def test_a_table_has_a_line_per_row_and_a_vertical_bar_stays_in_its_cell():
    expected = "| case | answer |\n|---|---|\n| 1 | a\\|b |\n| 2 |  |"
    assert table(("case", "answer"), [(1, "a|b"), (2, "")]) == expected
