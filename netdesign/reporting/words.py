"""What the report says in sentences: the headline, the captions, the glossary."""

from collections import Counter

import numpy as np

from netdesign.model.stations import ViewingSphere
from netdesign.model.study import Study, ViewpointsTable
from netdesign.reporting.record import UM, NetworkRecord, RunRecord

LIMITED_DATUM = "exterior orientation error-free (limited error propagation)"
SHORT_DATUM = "inner constraints over all object points"

RECOMPUTED = 1e-6  # largest relative difference that rounding may make between design.json and the report

# Ratio of P2 to P1 beyond which there is something to say: 20 % missed tags make 1.35 (adjustment notes).
DESIGN_GAP = (0.7, 1.5)

GLOSSARY = (
    ("Object point", "A corner of the black square of an AprilTag; every tag has four of them, named tag.corner."),
    (
        "Rms sigma",
        "The root of the mean variance over all coordinates of all object points (equation 2 of the source paper). "
        "The largest sigma is that of the worst single coordinate.",
    ),
    (
        "Limited and total propagation",
        "Limited (or limiting) error propagation takes the poses of the cameras as error-free, quick to search with; "
        "total propagation is the covariance of the full bundle adjustment with unknown poses.",
    ),
    (
        "Datum",
        "What coordinates refer to. Free network: position, orientation and scale are fixed by inner constraints over "
        "all object points, so that a sigma says how well the shape is known; sigmas in different datums must not be "
        "compared.",
    ),
    ("Front", "The networks that no other network found beats in precision, motion and number of images at once."),
    (
        "Lower bound, bound ratio",
        "A proven limit below which no network of so many images can go from the admissible stations; the ratio is f1 "
        "over that limit, so 1.10 means that at most 10 % of the variance is left to gain.",
    ),
    (
        "Knee",
        "The network farthest, in logarithms scaled to the front, on the good side of the plane through the three "
        "best-in-one-thing corners: more precision costs much from here on, less saves little.",
    ),
    (
        "Without it",
        "What the rms sigma (limited propagation) would become if that one image were lost, and how many object points "
        "would be left with too few rays: the stations not to lose.",
    ),
    ("Tour", "The open path through all stations in visiting order; its length is objective f2."),
    ("Rays", "Images that see an object point; with fewer than three a gross error cannot be found."),
    (
        "Ellipsoid",
        "The surface one standard deviation away from an object point, drawn larger by the factor printed with it.",
    ),
    (
        "P0, P1, P2",
        "The same sigma predicted three times: at design with limited propagation, at design with total propagation, "
        "and with total propagation on the image points that were really measured.",
    ),
    (
        "T / ν",
        "The squared error of all points weighted with the full predicted covariance, per degree of freedom: 1 when "
        "noise level and geometry are both as predicted.",
    ),
    ("s0²", "The squared residuals of the adjustment per redundancy: 1 when the image noise is as predicted."),
    (
        "F",
        "T/ν over s0²: tests the geometry alone, whatever the noise level, because a common error of the image sigma "
        "cancels.",
    ),
    (
        "ρ",
        "The rms error really made over the rms sigma predicted: the number a user means by “is the prediction right”. "
        "One realisation scatters, so it is judged by its interval, never by a fixed percentage.",
    ),
    (
        "Coverage, NEES/3",
        "Share of points inside their 95 % ellipsoid, and the mean squared error per coordinate in units of its "
        "variance.",
    ),
    (
        "Probability integral transform",
        "The probability, under the prediction, of a statistic at most as large as the one found: uniform over many "
        "networks when the predictions are right.",
    ),
)


def headline(record: RunRecord) -> str:
    """Return the title of the report: what there is to choose from."""
    networks = record.networks
    sizes = [network.images for network in networks]
    best = min(record.precision_um(network) for network in networks)
    spread = f"{min(sizes)} images" if min(sizes) == max(sizes) else f"{min(sizes)} to {max(sizes)} images"
    count = "One camera network" if len(networks) == 1 else f"{len(networks)} camera networks"
    return f"{count} of {spread}, down to {best:.3g} µm {record.precision_name}"


def verdict(record: RunRecord) -> str:
    """Return the outcome of the validation of the whole front in one or two sentences."""
    counts = Counter(network.verdict for network in record.networks)
    total = len(record.networks)
    proved, failed = counts["pass"], total - counts["pass"] - counts["not validated"]
    fixed = len(record.task.existing)
    existing = f" and from {fixed} existing stations" if fixed else ""
    part = (
        f"For “{record.task.study.name}”: {len(record.task.scene.targets.ids)} tags on the part, "
        f"seen from a {stations(record.task.study.viewpoints)}{existing}. "
    )
    if proved + failed == 0:
        return part + "Designed, not proved yet: every sigma below is a prediction."
    text = f"{proved} of {total} networks kept what was predicted: T, F and ρ lie inside their intervals."
    if failed:
        text += f" {failed} did not; the reasons stand with the flags."
    if counts["not validated"]:
        text += f" {counts['not validated']} have not been validated."
    return part + text


def chip_kind(outcome: str) -> str:
    """Return the colour class of a verdict."""
    return {"pass": "good", "not validated": ""}.get(outcome, "bad")


def network_flags(network: NetworkRecord) -> list[dict[str, str]]:
    """Return everything to be said against a network; the colour says how bad it is."""
    flags = [] if network.determined else [{"kind": "bad", "text": "Not determined by a full bundle adjustment."}]
    reasons = (network.validation or {}).get("reasons", [])
    flags += [{"kind": "bad", "text": str(reason)} for reason in reasons]
    flags += [{"kind": "warn", "text": text} for text in network.warnings if text not in reasons]
    flags += [{"kind": "warn", "text": text} for text in design_gap(network)]
    return flags


def design_gap(network: NetworkRecord) -> list[str]:
    """Return a sentence when the image points really used promise another precision than the design assumed.

    The median over the points tells the noise level; the rms goes up when single points lose their rays.
    """
    predicted = (network.validation or {}).get("predicted_rms_um", {})
    used, design = predicted.get("used"), network.total_rms_um
    if used is None or network.adjustment is None or not np.isfinite(design):
        return []
    points = network.adjustment["points"]
    sigma = np.array([item["sigma_apriori_mm"] for item in points], dtype=np.float64) * 1e3
    typical = np.nanmedian(sigma / (np.sqrt(np.diagonal(network.total, axis1=1, axis2=2)) / UM))
    told = f"The image points that were measured promise {finite(used)} µm (P2), the design {finite(design)} µm (P1): "
    if not DESIGN_GAP[0] < typical < DESIGN_GAP[1]:
        cause = (
            f"a typical point has {typical:.2g} times the sigma of the design, so the image noise assumed in [camera] "
        )
        return [told + cause + 'is not that of the detector; noise = "detector" takes the calibrated one.']
    if DESIGN_GAP[0] < used / design < DESIGN_GAP[1]:
        return []
    lost = [(int(item["rays"]) - int(planned), item["id"]) for item, planned in zip(points, network.rays, strict=True)]
    names = ", ".join(name for change, name in sorted(lost) if change < 0)
    return [told + f"single points lost rays to tags that were not found or not used: {names or 'none'}."]


def all_flags(record: RunRecord) -> list[dict[str, str]]:
    """Return the flags of every network, the notes of the search, and the report's own check."""
    flags = []
    for network in record.networks:
        mine = network_flags(network)
        if network.verdict not in ("pass", "not validated") and not any(flag["kind"] == "bad" for flag in mine):
            mine.insert(0, {"kind": "bad", "text": f"verdict: {network.verdict}"})
        flags += [{"kind": flag["kind"], "text": f"Network {network.name}: {flag['text']}"} for flag in mine]
    flags.sort(key=lambda flag: flag["kind"] != "bad")
    flags += [{"kind": "note", "text": str(note)} for note in record.design.get("notes", ())]
    if record.recomputed <= RECOMPUTED:
        text = (
            "Recomputed for this report from the camera poses and exact rays: every sigma agrees with design.json to "
            f"{max(record.recomputed, 1e-16):.0e}."
        )
        flags.append({"kind": "good", "text": text})
    else:
        text = (
            f"Recomputing the sigmas from the camera poses differs from design.json by up to {record.recomputed:.2g} "
            "(relative): design.json and the inputs of this run do not belong together."
        )
        flags.insert(0, {"kind": "bad", "text": text})
    return flags


def ellipsoid_words(factor: float, datum: str) -> str:
    """Return what must stand under drawn ellipsoids."""
    size = f"{factor:,.0f}".replace(",", " ")
    return f"one-sigma ellipsoids of the object points drawn {size} times too large, total propagation, datum: {datum}."


def finite(value: float, digits: int = 2) -> str:
    """Return a number for a table with ``digits`` decimals, or as many as two digits need; a dash when undetermined."""
    if not np.isfinite(value):
        return "–"
    if 0.0 < abs(value) < 1.0:  # a part of some millimetres has sigmas of hundredths of a micrometre
        digits = max(digits, 1 - int(np.floor(np.log10(abs(value)))))
    return f"{value:.{digits}f}"


def stations(table: ViewpointsTable) -> str:
    """Return where cameras may stand, in words that follow "a"."""
    low, high = table.extent_mm
    if table.box_mm is not None:
        return "box from {:g}, {:g}, {:g} to {:g}, {:g}, {:g} mm".format(*low, *high)
    if table.semi_axes_mm is not None:
        between = "space between semi-axes of {:g}, {:g}, {:g} and ".format(*low)
        inner = between if low != high else "shell with semi-axes of "
        return inner + "{:g}, {:g}, {:g} mm".format(*high)
    return f"sphere of {low[0]:g} mm radius" if low == high else f"distance of {low[0]:g} to {high[0]:g} mm"


def reach_caption(sphere: ViewingSphere) -> str:
    """Return what the picture of the reach shows."""
    if sphere.depth is None:
        dots, above, free = "of the sphere", "the sphere from above", "A direction is free where all four neighbours in"
    else:
        wide = sphere.depth.has_width
        dots = "of the directions at the nearest, the middle and the farthest distance" if wide else "of the directions"
        above = (
            "the directions from above, a disc for each distance and one for the tour"
            if wide
            else "the directions from above"
        )
        free = "The search asks the robot at every station exactly; a dot is free where all four neighbours in"
    return (
        f"What the robot reaches, every dot the same share {dots}, and the tour of the recommended network. Right: "
        f"{above}, areas true. {free} the map are."
    )


def requirements(study: Study) -> list[str]:
    """Return what [requirements] asks for, each in a few words; empty without that table."""
    asked, unit = study.requirements, {"workspace": "mm", "joint": "rad", "time": "s"}[study.motion]
    limits = (("largest sigma", asked.max_sigma_um, " µm"), ("images", asked.max_images, ""))
    found = [f"{name} ≤ {limit:g}{of}" for name, limit, of in (*limits, ("tour", asked.max_tour, f" {unit}")) if limit]
    return found + [f"U95 {item.from_} to {item.to} ≤ {item.u95_um:g} µm" for item in asked.distances]
