"""Predicted against achieved: what the validation of one network says, and of the campaign."""

from math import ceil
from typing import Any

from markupsafe import Markup

from netdesign.reporting import charts, words
from netdesign.reporting.length_chart import length_chart
from netdesign.reporting.record import NetworkRecord, RunRecord

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


LEAST_FOR_A_HISTOGRAM = 8


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


def length_proof(network: NetworkRecord) -> Values | None:
    """Return chart and caption of the length measurement errors, None where there are none."""
    test = (network.validation or {}).get("length_test")
    if test is None or test["longest_share_of_diagonal"] is None:
        return None
    lengths = test["lengths"]
    inside = sum(abs(row["error_um"]) <= row["u95_um"] for row in lengths if row["u95_um"] is not None)
    lines = len({row["line"] for row in lengths})
    caption = (
        f"In the manner of VDI/VDE 2634 part 1: {len(lengths)} lengths along {lines} lines, the longest "
        f"{100 * test['longest_share_of_diagonal']:.0f} % of the volume's diagonal. Dots: error; bars: ± U95 (k = 2), "
        f"predicted from the full covariance. {inside} of {len(lengths)} lie inside; of independent lengths at least "
        f"{ceil(test['acceptance_low'] * len(lengths) - 1e-9)} would in 99 % of all cases. Scale: {test['scale']}."
    )
    return {"chart": length_chart(lengths), "caption": caption}


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


def absolute_bars(network: NetworkRecord) -> list[tuple[str, str, float, str]]:
    """Return the rows of the chart in the robot's frame; none where the robot's repeatability is not stated."""
    content = (network.validation or {}).get("absolute")
    if content is None:
        return []
    predicted = content["predicted_rms_um"]
    return [
        ("P1 total, at design", "poses by repeatability", float(predicted["design"]), "total"),
        ("P2 total, as measured", "poses by repeatability", float(predicted["used"]), "used"),
        ("Achieved", "rms error, robot's frame", float(content["achieved_rms_um"]), "achieved"),
    ]


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


def campaign(record: RunRecord) -> Values | None:
    """Return what the page shows of all networks together; None when nothing has been validated."""
    validated = [network for network in record.networks if network.validation is not None]
    if not validated:
        return None
    content = record.campaign or {}
    failed = [network.name for network in validated if scatter(network) is None]
    verdicts = []
    if "statement" in content:
        verdicts.append({"kind": _decision(content), "text": content["statement"]})
    if failed:
        verdicts.append({"kind": "bad", "text": f"Not in these figures, because they failed: {', '.join(failed)}."})
    counted = len(record.networks) - len(validated)
    if counted:
        verdicts.append({"kind": "warn", "text": f"Not validated yet: {counted} of {len(record.networks)} networks."})
    return {
        "lead": f"{len(validated)} of {len(record.networks)} networks of the front were rendered, measured and "
        "adjusted. One network alone cannot confirm a prediction to ten per cent; many together can.",
        "verdicts": verdicts,
        "pooled": charts.interval_chart(interval_rows(content.get("statistics", {})), "99 %"),
        "pooled_caption": "All networks as one: T, s0² and F from summed squares, each in its exact 99 % interval.",
        "margins": charts.band_chart(_bands(content)),
        "margins_caption": "The decision is one of equivalence: the 90 % interval (line) has to lie inside the margin "
        "(bar). ρ: geometric mean of achieved over predicted (P2), each network over its exact expectation, which "
        "lies below 1 when few directions carry most of the error, and weighted with its precision. √F: the geometry "
        "alone.",
        "ratios": _ratios(content),
        "pits": _histograms(content),
        "pit_caption": "The probability integral transforms of all networks. If every prediction is right they are "
        "uniform: bars within the shaded 95 % band. p: Kolmogorov and Smirnov's test of it.",
        "repeats": [
            f"Network {name}: {item['count']} realisations, {100 * max(item['bias_share'], 0):.1f} % of the mean "
            "squared error is common to all of them (bias), the rest is noise."
            for name, item in sorted(content.get("repeats", {}).items())
        ],
        "scatter_caption": "Each dot is a network: the rms error really made against the rms sigma predicted for the "
        f"image points used (P2), datum: {words.SHORT_DATUM}. Dashed: equal; shaded: ten per cent. Crosses: outside "
        "their own intervals." + _trend(content),
    }


def _decision(content: Values) -> str:
    """Return good when equivalence is shown, bad when the opposite is, warn when the networks are too few to tell."""
    if content["equivalent"]:
        return "good"
    apart = [row.high < row.margin[0] or row.low > row.margin[1] for row in _bands(content)]
    return "bad" if any(apart) else "warn"


def _bands(content: Values) -> list[charts.BandRow]:
    rows = (("rho", "ρ", "over its expectation"), ("root_f", "√F", "geometry alone"))
    found = [(content.get(key) or {}, label, note) for key, label, note in rows]
    return [
        charts.BandRow(
            label=label,
            note=note,
            value=item["value"],
            low=item["low"],
            high=item["high"],
            margin=tuple(item["margin"]),
        )
        for item, label, note in found
        if item.get("value") is not None
    ]


def _ratios(content: Values) -> list[Values]:
    """Return achieved over predicted, over the networks, for the three predictions, and the plain geometric mean."""
    names = {"limited": "achieved / P0, limited", "total": "achieved / P1, total", "used": "achieved / P2, as measured"}
    ratios = content.get("achieved_over_predicted", {})
    rows = [{"name": names[key], "value": f"{ratios[key]:.3f}"} for key in names if ratios.get(key) is not None]
    plain = content.get("plain_geometric_mean", {})
    if plain.get("used") is not None:
        rows.append({"name": "achieved / P2, plain geometric mean", "value": f"{plain['used']:.3f}"})
        rows.append({"name": "the same, expected of right predictions", "value": f"{plain['expected']:.3f}"})
    if content.get("coverage95") is not None:
        rows.append({"name": "points inside 95 % ellipsoids", "value": f"{100 * content['coverage95']:.1f} %"})
    if content.get("kendall") is not None:
        rows.append({"name": "rank correlation (Kendall)", "value": f"{content['kendall']:.2f}"})
    return rows


def _histograms(content: Values) -> list[Markup]:
    names = {"t": "T", "s0_squared": "s0²", "f": "F", "rho": "ρ"}
    p_values = content.get("uniformity_p", {})
    pits = content.get("pit", {})
    return [
        charts.histogram_chart(pits[key], f"{label}   p = {p_values.get(key, float('nan')):.2g}", _bins(len(pits[key])))
        for key, label in names.items()
        if len(pits.get(key, ())) >= LEAST_FOR_A_HISTOGRAM
    ]


def _bins(count: int) -> int:
    """Return so many bins that about four values are expected in each, from four to ten."""
    return min(max(count // 4, 4), 10)


def _trend(content: Values) -> str:
    slope = content.get("slope") or {}
    if slope.get("value") is None:
        return ""
    return (
        f" Slope in logarithms {slope['value']:.2f}, 90 % interval {slope['low']:.2f} to {slope['high']:.2f} "
        "(1 is expected; a narrow front leaves it wide)."
    )
