"""Predicted against achieved: what the validation of one network says, and of the campaign."""

from typing import Any

from netdesign.reporting import charts, words
from netdesign.reporting.record import NetworkRecord

Values = dict[str, Any]

# Key in validation.json, its name, what it tests, and where it lies when the prediction is right.
STATISTICS = (
    ("t_over_nu", "T / ν", "whole covariance", 1.0),
    ("s0_squared", "s0²", "image noise", 1.0),
    ("f", "F", "geometry alone", 1.0),
    ("rho", "ρ", "achieved / predicted", 1.0),
    ("coverage95", "coverage", "95 % ellipsoids", 0.95),
    ("nees_over_3", "NEES / 3", "per point", 1.0),
)


def network_proof(network: NetworkRecord) -> Values | None:
    """Return chart and caption of a validated network; a chart without rows when it could not be adjusted."""
    content = network.validation
    if content is None:
        return None
    if "statistics" not in content:
        return {"chart": "", "caption": "Could not be compared: " + "; ".join(content.get("reasons", ["no reason"]))}
    level = f"{100 * content['level']:.4g} %"
    used = content["points_used"]
    caption = (
        f"Dots: the value found; bars: its exact {level} interval if the prediction is right; dashed: where it is "
        f"expected. T, F and ρ decide. {used} of {len(network.total)} points compared after a similarity over them; "
        f"ρ has about {content['nu_eff']:.0f} effective degrees of freedom. Datum: {content['datum']}."
    )
    return {"chart": charts.interval_chart(interval_rows(content["statistics"]), level), "caption": caption}


def interval_rows(statistics: Values) -> list[charts.IntervalRow]:
    """Return a chart row for every statistic there is."""
    return [
        charts.IntervalRow(
            label=label, note=note, value=item["value"], low=item["low"], high=item["high"], expected=expected
        )
        for key, label, note, expected in STATISTICS
        if (item := statistics.get(key)) is not None and None not in (item["value"], item["low"], item["high"])
    ]


def bars(network: NetworkRecord) -> list[tuple[str, str, float, str]]:
    """Return the rows of the chart of predicted and achieved rms: P0, P1, and P2 and the achieved one when proved."""
    rows = [
        ("P0 limited, at design", "poses error-free", network.rms_um, "limited"),
        ("P1 total, at design", "free datum", network.total_rms_um, "total"),
    ]
    content = network.validation or {}
    if "achieved_rms_um" in content:
        used = float(content["predicted_rms_um"]["used"])
        rows.append(("P2 total, as measured", "free datum, points used", used, "used"))
        rows.append(("Achieved", "rms error, free datum", float(content["achieved_rms_um"]), "achieved"))
    for repeat in network.repeats:
        if "achieved_rms_um" in repeat:
            name = f"Achieved, repeat {repeat['repeat']}"
            rows.append((name, "rms error, free datum", float(repeat["achieved_rms_um"]), "achieved"))
    return rows


def adjustment_numbers(network: NetworkRecord) -> list[Values]:
    """Return what an adjustment protocol opens with."""
    content = network.adjustment
    if content is None:
        return []
    return [
        {"name": "observations n", "value": str(content["n_observations"])},
        {"name": "unknowns u", "value": str(content["n_unknowns"])},
        {"name": "redundancy r", "value": str(content["redundancy"])},
        {"name": "sigma0 (a priori 1)", "value": words.finite(float(content["sigma0"] or "nan"), 3)},
        {"name": "image points rejected", "value": str(len(content["rejected"]))},
    ]


def scatter(network: NetworkRecord) -> Values | None:
    """Return predicted (P2) and achieved rms of a proved network, µm, for the figure of the campaign."""
    content = network.validation or {}
    if "achieved_rms_um" not in content:
        return None
    return {
        "predicted": float(content["predicted_rms_um"]["used"]),
        "achieved": float(content["achieved_rms_um"]),
        "pass": bool(content["passed"]),
    }
