"""Rows of the benchmark: what is compared, what must hold, what was measured; printed, stored, put into the README."""

import json
import os
import statistics
from pathlib import Path
from typing import Any, NamedTuple

RESULTS = Path(__file__).with_name("results.json")
README = Path(__file__).resolve().parents[2] / "README.md"
ELSEWHERE = {"motion", "scaling"}  # parts that the README's table leaves out
BEGIN, END = "<!-- benchmarks -->", "<!-- end of benchmarks -->"


class Row(NamedTuple):
    """One comparison: the ratios of calls made side by side, or of runs with different seeds; none: only a remark.

    Attributes:
        what: compared with what.  must: the limit of the median, None when nothing is asked.
        ratios: measured.  note: what else is worth knowing, in one line.
        at_most: the limit is an upper one.
    """

    what: str
    must: float | None
    ratios: list[float]
    note: str = ""
    at_most: bool = False

    @property
    def holds(self) -> bool | None:
        """Whether the median is on the right side of the limit."""
        if self.must is None or not self.ratios:
            return None
        median = statistics.median(self.ratios)
        return bool(median <= self.must if self.at_most else median >= self.must)

    def stored(self) -> dict[str, Any]:
        """Return what results.json keeps."""
        return {
            "must": self.must, "at_most": self.at_most, "median": statistics.median(self.ratios),
            "low": min(self.ratios), "high": max(self.ratios), "count": len(self.ratios), "holds": self.holds,
            "note": self.note,
        }  # fmt: skip

    def __str__(self) -> str:
        """Return the row as a line of the printed table."""
        if not self.ratios:
            return f"    {self.what}"
        limit, measured, verdict = words(self.stored())
        return f"{self.what:76s} {limit:9s} {measured:32s} {verdict}" + (f"\n    {self.note}" if self.note else "")


def words(row: dict[str, Any]) -> tuple[str, str, str]:
    """Return limit, median with range, and verdict of a stored row."""
    limit = "" if row["must"] is None else f"{'<=' if row['at_most'] else '>='} {row['must']:g}"
    measured = number(row["median"])
    if row["count"] > 1:
        measured += f" ({number(row['low'])} to {number(row['high'])})"
    return limit, measured, {None: "", True: "holds", False: "does not hold"}[row["holds"]]


def number(value: float) -> str:
    """Return four digits, or whole numbers above a thousand."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:#.4g}"


def store(part: str, rows: list[Row], whole: bool) -> None:
    """Keep the rows of one part in results.json, over earlier ones of the same name, and renew the README's table.

    ``whole``: the part has run at full length, so its rows that did not come up again are no longer measured.
    """
    stored = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    new = {row.what: row.stored() for row in rows if row.ratios}
    stored[part] = new if whole else stored.get(part, {}) | new
    replaced(RESULTS, json.dumps(stored, indent=1, sort_keys=True) + "\n")
    before, rest = README.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    replaced(README, f"{before}{BEGIN}\n{markdown(stored)}{END}{after}")


def markdown(stored: dict[str, Any]) -> str:
    """Return the stored rows that must hold, as the README's table."""
    lines = ["| compared | must be | measured: median (range) | |", "|---|---|---|---|"]
    for part, rows in sorted(stored.items()):
        if part in ELSEWHERE:
            continue
        for what, row in sorted(rows.items()):
            if row["must"] is not None:
                limit, measured, verdict = words(row)
                lines.append(f"| {what} | {limit} | {measured} | {verdict} |")
    return "\n".join(lines) + "\n"


def replaced(path: Path, text: str) -> None:
    """Write beside the place, then rename."""
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
