"""The benchmark's bookkeeping: limits on either side, rows of parts that did not run stay, the README follows."""

import json

import pytest

from validation.benchmarks import table
from validation.benchmarks.table import Row


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(table, "README", tmp_path / "README.md")
    (tmp_path / "README.md").write_text(f"before\n{table.BEGIN}\nold\n{table.END}\nafter\n")
    return tmp_path


@pytest.mark.parametrize(
    ("row", "holds", "words"),
    [
        (Row("fast", 4.0, [3.0, 5.0, 4.0]), True, ">= 4"),
        (Row("fast", 4.0, [3.0, 5.0, 3.9]), False, ">= 4"),
        (Row("short", 2.0, [1.0, 5.0, 2.0], at_most=True), True, "<= 2"),
        (Row("short", 2.0, [1.0, 5.0, 2.1], at_most=True), False, "<= 2"),
        (Row("growth", None, [1.0]), None, ""),
        (Row("remark", 1.0, []), None, "remark"),
    ],
)
def test_the_median_decides(row, holds, words):
    assert row.holds is holds
    assert words in str(row)
    assert ("does not hold" in str(row)) is (holds is False)


def test_only_a_whole_run_of_a_part_forgets_its_rows(files):
    table.store("engines", [Row("quick", 4.0, [5.0]), Row("slow", 1.0, [2.0])], whole=True)
    table.store("kernels", [Row("c", 0.75, [0.5]), Row("remark", None, [])], whole=False)
    table.store("engines", [Row("quick", 4.0, [3.0])], whole=False)
    stored = json.loads((files / "results.json").read_text())
    assert {part: set(rows) for part, rows in stored.items()} == {"engines": {"quick", "slow"}, "kernels": {"c"}}
    assert stored["engines"]["quick"]["median"] == 3.0
    table.store("engines", [Row("quick", 4.0, [6.0])], whole=True)
    readme = (files / "README.md").read_text()
    assert readme.startswith("before\n")
    assert readme.endswith("after\n")
    assert "| quick | >= 4 | 6.000 | holds |" in readme
    assert "| c | >= 0.75 | 0.5000 | does not hold |" in readme
    assert "slow" not in readme
    assert "old" not in readme.split(table.BEGIN)[1].replace("holds", "").replace("hold", "")
    assert not list(files.glob(".*"))
