"""Runs validation cases and keeps what they measured.

    python validation/run.py [CASE...] [--runs FOLDER] [--table]

A case (cases/NAME.toml) names a study of datasets/, what it changes in it, and the criterion of every claim. The search
is run, the claims are measured on its front, results/NAME.json is written, and the table in README.md is renewed from
all results. With `prove = true` the networks are rendered and adjusted as well. --table only renews the table.
"""

import argparse
import json
import tomllib
from pathlib import Path

import tomli_w
from claims import CLAIMS

from netdesign import __version__
from netdesign.design import design_study
from netdesign.files.packages import PACKAGE_SCHEME
from netdesign.files.store import plain
from netdesign.validate import validate_run

HERE = Path(__file__).parent
BEGIN, END = "<!-- results -->\n", "<!-- end -->\n"


def study_of(case, folder):
    """Write the case's study, with absolute paths of its inputs, into ``folder`` and return its path."""
    source = (HERE / "cases" / case["study"]).resolve()
    study = tomllib.loads(source.read_text(encoding="utf-8"))
    for table, changes in case.get("change", {}).items():
        study[table] = study.get(table, {}) | changes
    for table, key in (("part", "mesh"), ("targets", "file"), ("camera", "file")):
        name = study[table].get(key)
        if name is not None and not name.startswith(PACKAGE_SCHEME):
            study[table][key] = str((source.parent / name).resolve())
    study["name"] = case["name"]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{case['name']}.toml"
    path.write_text(tomli_w.dumps(study), encoding="utf-8")
    return path


def run_case(path, runs):
    """Run one case and return its result."""
    case = tomllib.loads(path.read_text(encoding="utf-8")) | {"name": path.stem}
    # Anew every time: a finished run may be that of an earlier engine.
    run = design_study(study_of(case, runs), runs / path.stem, seed=None, resume=False, threads=2).run
    front = json.loads((run / "design.json").read_text(encoding="utf-8"))
    result = {
        "case": path.stem,
        "version": __version__,
        "study_sha256": front["study_sha256"],
        "networks": len(front["networks"]),
        "claims": {name: CLAIMS[name](front, **criterion) for name, criterion in case["claims"].items()},
    }
    if case.get("prove"):
        validate_run(run, None, workers=2, dask=None)
        result["campaign"] = json.loads((run / "validation.json").read_text(encoding="utf-8"))
    return result


def table(results):
    """Return the results as the lines of a Markdown table."""
    lines = ["| claim | case | criterion | measured | holds |", "|---|---|---|---|---|"]
    for result in results:
        case = tomllib.loads((HERE / "cases" / f"{result['case']}.toml").read_text(encoding="utf-8"))
        for name in (name for name in CLAIMS if name in result["claims"]):
            measured = result["claims"][name]
            criterion = ", ".join(f"{key} {value:g}" for key, value in case["claims"][name].items())
            values = ", ".join(
                f"{key.replace('_', ' ')} {value:.4g}" for key, value in measured.items() if key != "holds"
            )
            claim = CLAIMS[name].__doc__.splitlines()[0]
            lines.append(
                f"| {claim} | {result['case']} | {criterion} | {values} | {'yes' if measured['holds'] else 'no'} |"
            )
    return "".join(f"{line}\n" for line in lines)


def renew_table():
    """Put the table of all results into README.md."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted((HERE / "results").glob("*.json"))]
    readme = HERE / "README.md"
    before, rest = readme.read_text(encoding="utf-8").split(BEGIN)
    readme.write_text(before + BEGIN + table(results) + END + rest.split(END)[1], encoding="utf-8")


def main():
    """Run the named cases, or all."""
    parser = argparse.ArgumentParser(description="Run validation cases.")
    parser.add_argument("case", nargs="*")
    parser.add_argument("--runs", type=Path, default=Path("runs/validation"))
    parser.add_argument("--table", action="store_true", help="only renew the table in README.md")
    options = parser.parse_args()
    cases = [] if options.table else options.case or sorted(path.stem for path in (HERE / "cases").glob("*.toml"))
    for name in cases:
        result = run_case(HERE / "cases" / f"{name}.toml", options.runs)
        text = json.dumps(plain(result), indent=1, sort_keys=True, ensure_ascii=False) + "\n"
        (HERE / "results" / f"{name}.json").write_text(text, encoding="utf-8")
        verdicts = ", ".join(f"{claim} {'holds' if m['holds'] else 'FAILS'}" for claim, m in result["claims"].items())
        print(f"{name}: {result['networks']} networks; {verdicts}", flush=True)
    renew_table()


if __name__ == "__main__":
    main()
