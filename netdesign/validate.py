"""The verb ``validate``: every network of the front is photographed, measured, adjusted and compared.

No network is dropped: one that fails keeps its reason. Networks that are done are not done again.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from netdesign.adjustment.campaign import pool
from netdesign.cluster import executor_of
from netdesign.files.adjustment import campaign_member, campaign_payload
from netdesign.files.design_json import PlannedNetwork, find_network, read_networks
from netdesign.files.image_folder import complete_image_folder
from netdesign.files.store import read_json, write_json
from netdesign.imageset import worker_pool
from netdesign.imaging.photograph import RendererName, Shoot
from netdesign.model.figures import significant
from netdesign.model.progress import Progress, silent
from netdesign.model.task import Task
from netdesign.proof import is_proved, photograph, prove_network
from netdesign.run_folder import open_run

# Of all deciding intervals of a campaign together; each has Bonferroni's share: right predictions fail anywhere in a
# whole campaign with a probability of at most one per cent.
FAMILY_LEVEL = 0.99
FAR_OFF = 2.0  # times the sigma that the study assumes
DECIDING = 3  # T, F and rho of every realisation
POOLED = ("network", "repeat", "verdict", "reasons", "warnings", "predicted_rms_um", "achieved_rms_um", "statistics")


@dataclass(frozen=True, kw_only=True)
class ValidationOutcome:
    """Verdicts by network id ("pass", "fail" or "failed") and what to print."""

    verdicts: dict[int, str]
    summary: str


def network_folder(run: Path, number: int, repeat: int = 0) -> Path:
    """Return where a network's images and results lie; repeats beyond the first have folders of their own."""
    folder = run / "networks" / f"{number:04d}"
    return folder if repeat == 0 else folder / f"repeat-{repeat:02d}"


def render_network(
    run: Path, number: int, out: Path, workers: int, renderer: RendererName, progress: Progress = silent
) -> int:
    """Render the image set of one network into ``out`` and return the number of images.

    Raises:
        InputError: no such run or network.  EnvironmentProblem: the renderer's system libraries are missing.
    """
    task = open_run(run)
    network = find_network(run, number)
    with worker_pool(workers) as executor:
        count = len(photograph(task, network, out, 0, executor, progress, renderer))
    title = f"{task.study.name}, network {number}: {count} synthetic images made by netdesign."
    complete_image_folder(out, task.camera, task.scene.targets, title=title, bits=Shoot.bits)
    return count


def validate_run(
    run: Path, numbers: list[int] | None, *, workers: int, dask: str | None, progress: Progress = silent
) -> ValidationOutcome:
    """Validate networks of a run (all of them by default) and pool every network that is validated.

    Args:
        workers: processes for rendering and measuring.  dask: address of a scheduler to use instead.

    Raises:
        InputError: no such run or network.  EnvironmentProblem: the renderer's system libraries are missing.
    """
    task = open_run(run)
    networks = read_networks(run)
    for number in numbers or []:
        find_network(run, number)
    chosen = sorted(set(networks if numbers is None else numbers))
    repeats = range(task.study.validation.repeats)
    level = 1.0 - (1.0 - FAMILY_LEVEL) / (DECIDING * max(len(networks) * len(repeats), 1))
    with executor_of(workers, dask) as executor:
        for done, number in enumerate(chosen):
            progress("validate", done, len(chosen), f"network {number}")
            for repeat in repeats:
                folder = network_folder(run, number, repeat)
                if not is_proved(task, networks[number], folder):
                    prove_network(task, networks[number], folder, repeat, level, executor)
            progress("validate", done + 1, len(chosen), f"network {number}")
    return _pool(task, run, networks)


def _pool(task: Task, run: Path, networks: dict[int, PlannedNetwork]) -> ValidationOutcome:
    """Write RUN/validation.json from every network that is validated, the failed ones with their reasons."""
    records = []
    for number, network in sorted(networks.items()):
        for repeat in range(task.study.validation.repeats):
            folder = network_folder(run, number, repeat)
            if is_proved(task, network, folder):
                records.append(read_json(folder / "validation.json", "network-validation"))
    adjusted = [record for record in records if record["verdict"] != "failed"]
    payload: dict[str, Any] = {"networks": [{key: record.get(key) for key in POOLED} for record in records]}
    statement = "no network could be adjusted"
    if adjusted:
        campaign = pool([campaign_member(f"{record['network']:04d}", record) for record in adjusted])
        payload |= campaign_payload(campaign)
        statement = campaign.statement
    write_json(run / "validation.json", "validation", payload, task.sha256)
    worst = {"pass": 0, "fail": 1, "failed": 2}
    verdicts: dict[int, str] = {}
    for record in sorted(records, key=lambda record: worst[record["verdict"]]):
        verdicts[record["network"]] = record["verdict"]
    lines = [_line(record) for record in records] + [statement] + noise_hint(task, adjusted)
    return ValidationOutcome(verdicts=verdicts, summary="\n".join(lines))


def noise_hint(task: Task, records: list[dict[str, Any]]) -> list[str]:
    """Return that the image points are of quite another quality than the study's sigma_px says, in one line or none."""
    predicted = [record["predicted_rms_um"] for record in records]
    ratios = [row["total"] / row["used"] for row in predicted if row["total"] and row["used"]]
    if task.camera.corner_noise is not None or not ratios:
        return []
    ratio = float(np.exp(np.mean(np.log(ratios))))
    if 1.0 / FAR_OFF < ratio < FAR_OFF:
        return []
    return [
        f"the image points measured here have about {task.camera.sigma_px / ratio:.2g} px where the design assumes "
        f'camera.sigma_px = {task.camera.sigma_px:g}; camera.noise = "detector" predicts with this detector'
    ]


def _line(record: dict[str, Any]) -> str:
    """Return a network's outcome in one line."""
    name = f"network {record['network']:04d}" + (f" repeat {record['repeat']}" if record["repeat"] else "")
    if record["verdict"] == "failed":
        return f"  {name}: failed: {'; '.join(record['reasons'])}"
    predicted, achieved = record["predicted_rms_um"], record["achieved_rms_um"]
    rho = record["statistics"]["rho"]
    text = (
        f"  {name}: {record['verdict']}, rms {_um(achieved)} um achieved, {_um(predicted['limited'])} limited and "
        f"{_um(predicted['total'])} total at design, {_um(predicted['used'])} from the image points used; "
        f"rho {rho['value']:.3f} in [{rho['low']:.3f}, {rho['high']:.3f}]"
    )
    if "absolute" in record:
        absolute = record["absolute"]
        text += (
            f"; in the robot's frame {_um(absolute['achieved_rms_um'])} um achieved, "
            f"{_um(absolute['predicted_rms_um']['design'])} at design"
        )
    return text + (f"; {'; '.join(record['reasons'])}" if record["reasons"] else "")


def _um(value: float) -> str:
    """Three digits of a sigma in um, whatever the size of the part."""
    return significant(value, 3)
