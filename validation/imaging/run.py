"""Measures what the imaging chain can and cannot do; writes results.json and the tables of README.md.

    python validation/imaging/run.py [renderer] [pipeline] [mismatch] [throughput] [detectors] [false_ids]
                                     [prediction]

Without a name everything is measured (some ten minutes on two cores). The pictures share no
sampling or blur code with the fit.
"""

import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # the package of this checkout

from netdesign.files.store import plain
from validation.imaging import chain, mismatch, renderer

HERE = Path(__file__).parent
MEASURES = {
    "renderer": renderer.renderer, "pipeline": chain.pipeline, "mismatch": mismatch.mismatch,
    "throughput": chain.throughput, "detectors": chain.detectors, "false_ids": chain.false_ids,
    "prediction": chain.prediction,
}  # fmt: skip


def main():
    """Measure what is asked for and renew the files."""
    path = HERE / "results.json"
    results = json.loads(path.read_text()) if path.is_file() else {}
    for name in sys.argv[1:] or MEASURES:
        results[name] = plain(MEASURES[name]())
        print(name, json.dumps(results[name], indent=1))
        path.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    begin, end = "<!-- mismatch -->\n", "<!-- end -->\n"
    head, rest = text.split(begin)
    readme.write_text(
        head + begin + mismatch.table(results.get("mismatch", [])) + end + rest.split(end)[1], encoding="utf-8"
    )


if __name__ == "__main__":
    main()
