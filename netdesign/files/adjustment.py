"""adjustment.json and validation.json of one network: values to plain dictionaries, in the units of files (mm, px)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from netdesign.adjustment.absolute import Absolute
from netdesign.adjustment.campaign import Band, Campaign, Member
from netdesign.adjustment.lengths import LengthTest
from netdesign.adjustment.statistics import SumsOfSquares
from netdesign.model.adjustment import Adjustment, Interval, Validation
from netdesign.photogrammetry.collinearity import INTRINSIC_NAMES
from netdesign.photogrammetry.reliability import external_reliability, minimal_detectable_error

MM = 1e3


def adjustment_payload(
    adjustment: Adjustment, image_names: Sequence[str], point_names: Sequence[str]
) -> dict[str, Any]:
    """Return the contents of adjustment.json (contract, section 4).

    Sigmas and covariances are a posteriori (scaled by sigma0) with the a-priori sigma beside them; without
    redundancy there is no sigma0 and the a-priori values stand in both places.
    """
    factor = adjustment.sigma0 if np.isfinite(adjustment.sigma0) else 1.0
    sigma = np.sqrt(np.diagonal(adjustment.point_covariance, axis1=1, axis2=2)) * MM
    inner = np.sqrt(np.maximum(np.diagonal(adjustment.inner_covariance, axis1=1, axis2=2), 0.0)) * MM
    rays, observations = adjustment.rays, adjustment.observations
    position = adjustment.sigma_position * MM
    rotation = np.sqrt(np.diagonal(adjustment.pose_covariance[:, :3, :3], axis1=1, axis2=2))
    squared = (adjustment.residuals_px**2).sum(axis=1)
    per_image = np.bincount(observations.image, minlength=len(adjustment.world_from_cam))
    rms = np.sqrt(np.bincount(observations.image, squared, len(per_image)) / np.maximum(2 * per_image, 1))
    matrices = adjustment.world_from_cam.copy()
    matrices[:, :3, 3] *= MM
    return {
        "n_observations": adjustment.n_observations,
        "n_image_points": len(observations),
        "n_unknowns": adjustment.n_unknowns,
        "n_datum": adjustment.n_datum,
        "redundancy": adjustment.redundancy,
        "sigma0": adjustment.sigma0,
        "datum": adjustment.datum,
        "iterations": adjustment.iterations,
        "converged": adjustment.converged,
        "lambda8": adjustment.lambda8,
        "points": [
            {
                "id": point_names[j],
                "xyz_mm": adjustment.points[j] * MM if adjustment.used[j] else [None] * 3,
                "sigma_mm": sigma[j] * factor,
                "sigma_apriori_mm": sigma[j],
                "sigma_inner_mm": inner[j] * factor,
                "covariance_mm2": adjustment.point_covariance[j] * (MM * factor) ** 2,
                "rays": rays[j],
            }
            for j in range(len(point_names))
        ],
        "images": [
            {
                "name": image_names[i],
                "world_from_cam_mm": matrices[i],
                "sigma_position_mm": position[i] * factor,
                "sigma_position_apriori_mm": position[i],
                "sigma_rotation_rad": rotation[i] * factor,
                "rays": per_image[i],
                "rms_px": rms[i],
            }
            for i in range(len(image_names))
        ],
        "intrinsics": _intrinsics(adjustment, factor),
        "reliability": _reliability(adjustment, image_names, point_names),
        "rejected": [
            {"image": image_names[r.image], "point": point_names[r.point], "statistic": r.statistic}
            for r in adjustment.rejected
        ],
        "warnings": list(adjustment.warnings),
    }


def _intrinsics(adjustment: Adjustment, factor: float) -> dict[str, Any]:
    """Return values and a-posteriori sigmas by name; of one camera, or of a list of cameras in their order."""
    sigma = np.sqrt(np.maximum(np.diag(adjustment.parameter_covariance), 0.0))
    scale = np.where(sigma > 0, sigma, 1.0)
    count = len(adjustment.intrinsics)
    share = len(sigma) // count
    names = [name.split()[-1] for name in adjustment.parameter_names[:share]]
    cameras = [
        {
            "values": dict(zip(INTRINSIC_NAMES, row, strict=True)),
            "sigma": dict(zip(names, sigma[c * share : (c + 1) * share] * factor, strict=True)),
        }
        for c, row in enumerate(adjustment.intrinsics)
    ]
    content: dict[str, Any] = {
        "parameters": list(adjustment.parameter_names),
        "correlation": adjustment.parameter_covariance / scale[:, None] / scale[None, :],
    }
    return {**content, **cameras[0]} if count == 1 else {**content, "cameras": cameras}


def _reliability(adjustment: Adjustment, image_names: Sequence[str], point_names: Sequence[str]) -> dict[str, Any]:
    """Return how well the image points are checked: mean redundancy numbers, detectable errors, the weakest points."""
    numbers, observations = adjustment.redundancy_numbers, adjustment.observations
    sigma = np.sqrt(observations.covariance[:, [0, 1], [0, 1]])
    detectable = minimal_detectable_error(numbers, sigma).max(axis=1)
    effect = external_reliability(numbers).max(axis=1)
    weakest = np.argsort(numbers.min(axis=1), kind="stable")[:20]
    return {
        "mean_redundancy_xy": numbers.mean(axis=0),
        "min_redundancy": numbers.min(initial=1.0),
        "sum_image_points": numbers.sum(),
        "sum_other_observations": adjustment.extra_redundancy,
        "median_detectable_error_px": float(np.median(detectable)),
        "weakest": [
            {
                "image": image_names[observations.image[k]],
                "point": point_names[observations.point[k]],
                "redundancy_xy": numbers[k],
                "detectable_error_px": detectable[k],
                "effect_on_unknowns_sigma": effect[k],
            }
            for k in weakest
        ],
    }


def interval_payload(interval: Interval) -> dict[str, Any]:
    """Return one statistic."""
    return {
        "value": interval.value,
        "low": interval.low,
        "high": interval.high,
        "pit": interval.pit,
        "inside": interval.inside,
    }


def validation_payload(validation: Validation, point_names: Sequence[str]) -> dict[str, Any]:
    """Return the contents of a network's validation.json; lengths in um."""
    statistics = {
        "t_over_nu": validation.t,
        "s0_squared": validation.s0_squared,
        "f": validation.f,
        "rho": validation.rho,
        "coverage95": validation.coverage,
        "nees_over_3": validation.nees,
    }
    return {
        "passed": validation.passed,
        "reasons": list(validation.reasons),
        "warnings": list(validation.warnings),
        "datum": validation.datum,
        "level": validation.level,
        "points_used": validation.points_used,
        "nu_eff": validation.nu_eff,
        "log_rho_expected": {"mean": validation.log_rho_mean, "sd": validation.log_rho_sd},
        "statistics": {name: interval_payload(value) for name, value in statistics.items()},
        "sums": dict(validation.sums),
        "predicted_rms_um": {name: value * 1e6 for name, value in validation.predicted.items()},
        "achieved_rms_um": validation.achieved_rms * 1e6,
        "errors_um": [
            {"id": name, "error_um": error * 1e6} for name, error in zip(point_names, validation.errors, strict=True)
        ],
        **validation.details,
    }


def absolute_payload(absolute: Absolute, design_rms: float, point_names: Sequence[str]) -> dict[str, Any]:
    """Return the entry "absolute" of a network's validation.json: uncertainty in the robot's frame, lengths in um.

    Args:
        design_rms: m, what the design promises.
    """
    return {
        "absolute": {
            "datum": "pose priors: the robot's repeatability",
            "predicted_rms_um": {"design": design_rms * 1e6, "used": absolute.predicted_rms * 1e6},
            "achieved_rms_um": absolute.achieved_rms * 1e6,
            "rho": interval_payload(absolute.rho),
            "points": [
                {"id": name, "error_um": error * 1e6, "sigma_um": sigma * 1e6}
                for name, error, sigma in zip(point_names, absolute.errors, absolute.sigma, strict=True)
            ],
        }
    }


def campaign_member(name: str, record: dict[str, Any]) -> Member:
    """Return a network's contribution to the campaign from the contents of its validation.json.

    Args:
        record: with the entries of ``validation_payload``.
    """
    statistics, sums = record["statistics"], record["sums"]
    errors = [[np.nan if x is None else x * 1e-6 for x in row["error_um"]] for row in record["errors_um"]]
    return Member(
        name=name,
        t_sum=sums["t"],
        nu=sums["nu"],
        vpv=sums["vpv"],
        r=sums["r"],
        expected=SumsOfSquares.kept(sums),
        rho=statistics["rho"]["value"],
        log_rho_mean=record["log_rho_expected"]["mean"],
        log_rho_sd=record["log_rho_expected"]["sd"],
        pits={
            "t": statistics["t_over_nu"]["pit"],
            "s0_squared": statistics["s0_squared"]["pit"],
            "f": statistics["f"]["pit"],
            "rho": statistics["rho"]["pit"],
        },
        predicted={key: np.inf if value is None else value * 1e-6 for key, value in record["predicted_rms_um"].items()},
        achieved=record["achieved_rms_um"] * 1e-6,
        coverage=statistics["coverage95"]["value"],
        points_used=record["points_used"],
        errors=np.array(errors),
    )


def campaign_payload(campaign: Campaign) -> dict[str, Any]:
    """Return the contents of a run's validation.json: the pooled verdict."""
    return {
        "realisations": campaign.members,
        "equivalent": campaign.equivalent,
        "statement": campaign.statement,
        "statistics": {
            "t_over_nu": interval_payload(campaign.t),
            "s0_squared": interval_payload(campaign.s0_squared),
            "f": interval_payload(campaign.f),
        },
        "rho": band_payload(campaign.rho),
        "root_f": band_payload(campaign.root_f),
        "slope": band_payload(campaign.slope),
        "kendall": campaign.kendall,
        "achieved_over_predicted": dict(campaign.against),
        "plain_geometric_mean": dict(campaign.plain),
        "uniformity_p": dict(campaign.ks),
        "pit": {name: list(values) for name, values in campaign.pits.items()},
        "coverage95": campaign.coverage,
        "repeats": {
            name: {"count": repeats.count, "bias_share": repeats.bias_share}
            for name, repeats in campaign.repeats.items()
        },
    }


def band_payload(band: Band) -> dict[str, Any]:
    """Return an estimate with its 90 % interval and margin."""
    return {
        "value": band.value,
        "low": band.low,
        "high": band.high,
        "margin": list(band.margin),
        "equivalent": band.equivalent,
    }


def length_payload(test: LengthTest, point_names: Sequence[str]) -> dict[str, Any]:
    """Return the length measurement errors of an acceptance protocol; for ``details`` of a validation."""
    return {
        "length_test": {
            "guideline": "in the manner of VDI/VDE 2634 part 1: seven lines, five lengths each",
            "scale": "carried to the truth" if test.scale_free else "as estimated",
            "longest_share_of_diagonal": test.longest_share,
            "inside_u95": test.inside,
            "acceptance_low": test.low,
            "rms_error_over_sigma": test.rms_ratio,
            "lengths": [
                {
                    "line": int(test.line[q]),
                    "a": point_names[test.a[q]],
                    "b": point_names[test.b[q]],
                    "length_mm": test.length[q] * MM,
                    "error_um": test.error[q] * 1e6,
                    "u95_um": test.u95[q] * 1e6,
                }
                for q in range(len(test.line))
            ],
        }
    }
