"""Networks of four parts photographed, measured and adjusted: is the predicted accuracy the achieved one?

    python validation/imaging/campaign.py FOLDER [--workers N]     design (where needed) and validate, then the table
    python validation/imaging/campaign.py FOLDER --table           the table from what FOLDER holds
    python validation/imaging/campaign.py FOLDER --part plate --networks 2     a sample: renews no file

Studies of datasets/, those of few networks realised twice. FOLDER/NAME are run directories; what is done there is not
done again. Writes campaign.json and the table of README.md. From an empty folder it takes about an hour on two cores.
"""

import argparse
import json
import sys
import tomllib
from pathlib import Path

import numpy as np
import tomli_w

from netdesign.adjustment.campaign import pool
from netdesign.design import design_study
from netdesign.files.adjustment import campaign_member, campaign_payload
from netdesign.files.design_json import read_networks
from netdesign.files.packages import PACKAGE_SCHEME
from netdesign.files.store import plain
from netdesign.validate import validate_run

HERE = Path(__file__).parent
STUDIES = HERE.parents[1] / "datasets" / "studies"
REPEATS = {"plate": 2, "bracket": 2, "robot-link": 2, "polyhedron-ur10": 1}
BEGIN, END = "<!-- campaign -->\n", "<!-- end of campaign -->\n"
TITLES = (
    "part", "networks", "realisations", "not adjusted", "fail", "achieved / total at design", "rho", "rho expected",
    "rho / expected", "T/nu", "s0²", "sqrt(F)",
)  # fmt: skip


def run_of(name, folder):
    """Design the study with its repeats unless FOLDER/NAME holds it; return the run directory."""
    run = folder / name
    if (run / "design.json").is_file():
        return run
    study = tomllib.loads((STUDIES / f"{name}.toml").read_text(encoding="utf-8"))
    study["validation"] = study.get("validation", {}) | {"repeats": REPEATS[name]}
    for table, key in (("part", "mesh"), ("targets", "file"), ("camera", "file")):
        value = study[table].get(key)
        if value is not None and not value.startswith(PACKAGE_SCHEME):
            study[table][key] = str((STUDIES / value).resolve())
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.toml"
    path.write_text(tomli_w.dumps(study), encoding="utf-8")
    return design_study(path, run, seed=None, resume=True, threads=2).run


def records_of(run):
    """Return the validation records of a run, one per realisation."""
    paths = sorted((run / "networks").rglob("validation.json"))
    return [json.loads(path.read_text(encoding="utf-8")) for path in paths]


def summary(records):
    """Return one row: counts, plain geometric means and pooled statistics."""
    adjusted = [record for record in records if record["verdict"] != "failed"]
    row = {
        "networks": len({(record["study_sha256"], record["network"]) for record in records}),
        "realisations": len(records),
        "not_adjusted": len(records) - len(adjusted),
        "fail": sum(record["verdict"] == "fail" for record in adjusted),
    }
    if not adjusted:
        return row
    names = [f"{record['study_sha256'][:8]}-{record['network']:04d}" for record in adjusted]
    members = [campaign_member(name, record) for name, record in zip(names, adjusted, strict=True)]
    pooled = campaign_payload(pool(members))
    pooled.pop("repeats", None)
    pooled.pop("pit", None)
    over = [record["achieved_rms_um"] / record["predicted_rms_um"]["total"] for record in adjusted]
    return row | {"achieved_over_total": float(np.exp(np.mean(np.log(over)))), "pooled": pooled}


def table(results):
    """Return the rows as Markdown."""
    lines = [f"| {' | '.join(TITLES)} |", "|---" * len(TITLES) + "|"]
    for name, row in results.items():
        cells = [str(row[key]) for key in ("networks", "realisations", "not_adjusted", "fail")]
        if "pooled" in row:
            pooled = row["pooled"]
            plain_mean = pooled["plain_geometric_mean"]
            tests = pooled["statistics"]
            values = [row["achieved_over_total"], plain_mean["used"], plain_mean["expected"], pooled["rho"]["value"]]
            values += [tests["t_over_nu"]["value"], tests["s0_squared"]["value"], pooled["root_f"]["value"]]
            cells += [f"{value:.3f}" for value in values]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def told(stage, done, total, note=""):
    """Print how far it is."""
    print(f"  {stage} {done}/{total} {note}", file=sys.stderr)


def main():
    """Run or resume the campaign and renew the files."""
    parser = argparse.ArgumentParser(description="the imaging campaign")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="only renew the table")
    parser.add_argument("--part", choices=REPEATS, action="append", help="this part only; repeat for more")
    parser.add_argument("--networks", type=int, help="validate no more than so many networks of each part")
    asked = parser.parse_args()
    every, results = [], {}
    for name in asked.part or REPEATS:
        if not asked.table:
            run = run_of(name, asked.folder)
            print(f"{name}: {run}", file=sys.stderr)
            chosen = None if asked.networks is None else sorted(read_networks(run))[: asked.networks]
            validate_run(run, chosen, workers=asked.workers, dask=None, progress=told)
        records = records_of(asked.folder / name)
        if records:
            results[name] = summary(records)
            every += records
    if not every:
        sys.exit(f"{asked.folder}: expected validated networks, found none")
    results["all"] = summary(every)
    if asked.part or asked.networks is not None:
        print(table(results))
        return
    (HERE / "campaign.json").write_text(json.dumps(plain(results), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    readme = HERE / "README.md"
    head, rest = readme.read_text(encoding="utf-8").split(BEGIN)
    readme.write_text(head + BEGIN + table(results) + END + rest.split(END)[1], encoding="utf-8")
    print(table(results))


if __name__ == "__main__":
    main()
