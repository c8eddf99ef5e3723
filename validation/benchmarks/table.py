"""Rows of the benchmark: what is compared, what must hold, what was measured; printed and stored."""

import json
import statistics
from pathlib import Path
from typing import NamedTuple

RESULTS = Path(__file__).with_name("results.json")


class Row(NamedTuple):
    """One comparison: the ratios of calls made side by side, or of runs with different seeds; none: only a remark."""

    what: str
    must: float | None
    ratios: list[float]

    @property
    def holds(self) -> bool | None:
        """Whether the median is at least what it must be."""
        return None if self.must is None else bool(statistics.median(self.ratios) >= self.must)

    def __str__(self) -> str:
        """Return the row as a line of the printed table."""
        if self.must is None:
            return f"    {self.what}"
        low, high = min(self.ratios), max(self.ratios)
        measured = f"{statistics.median(self.ratios):9.2f} ({low:.2f} to {high:.2f})"
        return f"{self.what:68s} >= {self.must:<6g} {measured:32s} {'holds' if self.holds else 'MISSED'}"


def store(rows: list[Row]) -> None:
    """Write the comparisons of this run over those of earlier ones with the same name."""
    stored = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.is_file() else {}
    for row in rows:
        if row.must is not None:
            stored[row.what] = {
                "must": row.must, "median": statistics.median(row.ratios), "low": min(row.ratios),
                "high": max(row.ratios), "count": len(row.ratios), "holds": row.holds,
            }  # fmt: skip
    RESULTS.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n", encoding="utf-8")
