"""``netdesign run``: design, validate every network of the front, write the report."""

from dataclasses import dataclass
from pathlib import Path

from netdesign.design import design_study
from netdesign.model.progress import Progress
from netdesign.report import write_report
from netdesign.validate import validate_run


@dataclass(frozen=True, kw_only=True)
class RunOutcome:
    """What the main job has to say, and why no network keeps the study's requirements (None: one does)."""

    report: Path
    summary: str
    unmet: str | None


def run_study(
    study: Path, output: Path | None, *, seed: int | None, resume: bool, workers: int, progress: Progress
) -> RunOutcome:
    """Do the main job; a run that was interrupted goes on where it stopped.

    Raises:
        InputError, InfeasibleError, EnvironmentProblem: as the verbs.
    """
    designed = design_study(study, output, seed=seed, resume=resume, threads=workers, progress=progress)
    validated = validate_run(designed.run, None, workers=workers, dask=None, progress=progress)
    report = write_report(designed.run)
    summary = f"{designed.summary}\n{validated.summary}\nreport: {report}"
    return RunOutcome(report=report, summary=summary, unmet=designed.unmet)
