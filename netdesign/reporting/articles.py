"""One network of the front as plain values for the template."""

import base64
from typing import Any

import numpy as np

from netdesign.model.figures import significant
from netdesign.reporting import charts, proof, words
from netdesign.reporting.record import UM, NetworkRecord, RunRecord, rms_um
from netdesign.reporting.statics import exaggeration

Values = dict[str, Any]


def uri(kind: str, content: bytes) -> str:
    """Return an image as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def article(record: RunRecord, network: NetworkRecord, picture: bytes) -> Values:
    """Return everything the page shows of one network; ``picture`` is its static figure, WebP."""
    factor = exaggeration(record, network.total)
    chips = [{"kind": words.chip_kind(network.verdict), "text": network.verdict}]
    if network.id == record.knee:
        chips.insert(0, {"kind": "key", "text": "recommended"})
    unit = record.tour_unit
    ratio = network.bound_ratio
    numbers = [
        {"name": "images", "value": str(network.images)},
        {"name": "tour", "value": f"{significant(network.tour)} {unit}"},
        {"name": "rms σ total", "value": f"{words.finite(network.total_rms_um)} µm"},
        {"name": "largest σ total", "value": f"{words.finite(network.total_max_um)} µm"},
        {"name": "rms σ limited", "value": f"{words.finite(network.rms_um)} µm"},
        {"name": "bound ratio", "value": "–" if ratio is None else f"{ratio:.3f}"},
        {"name": "rays, least and mean", "value": f"{network.rays.min()} · {network.rays.mean():.1f}"},
        *proof.adjustment_numbers(network),
    ]
    return {
        "id": network.id,
        "name": network.name,
        "chips": chips,
        "numbers": numbers,
        "flags": words.network_flags(network),
        "picture": uri("webp", picture),
        "ellipsoid_caption": words.ellipsoid_words(factor, words.SHORT_DATUM),
        "bars": charts.dot_chart(proof.bars(network), "µm"),
        "bars_caption": "Rms sigma per coordinate over all object points.",
        "absolute": charts.dot_chart(absolute, "µm") if (absolute := proof.absolute_bars(network)) else "",
        "absolute_caption": "Position, turn and scale included, as the robot's repeatability lets the poses be known.",
        "proof": proof.network_proof(network),
        "lengths": proof.length_proof(network),
        "thumbnails": [{"name": name, "uri": uri("jpeg", content)} for name, content in network.thumbnails],
        "tour": _tour(record, network),
        "datum_note": f"Limited: {words.LIMITED_DATUM}. Total: datum {network.datum}.",
    }


def _tour(record: RunRecord, network: NetworkRecord) -> Values:
    """Return the run sheet: stations in visiting order, the leg that leads there, and what the loss of one costs."""
    joints = network.planned.get("joints_rad")
    degrees = None if joints is None else np.degrees(np.array(joints))
    least = record.task.limits.min_rays
    rays = network.visible_tags.sum(axis=0)
    columns = ["station", "azimuth α", "elevation β", "x mm", "y mm", "z mm", "points seen", "rms σ without it"]
    columns += [f"points left with < {least} rays", f"leg [{record.tour_unit}]"]
    columns += [] if degrees is None else [f"q{index}°" for index in range(1, degrees.shape[1] + 1)]
    rows = []
    for index, (alpha, beta) in enumerate(network.planned["viewpoints_deg"]):
        seen = network.visible_tags[index]
        change = network.without[index] / UM / rms_um(network.limited) - 1.0
        position = network.world_from_cam[index, :3, 3] * 1e3
        row = [str(index + 1), f"{alpha:.1f}°", f"{beta:.1f}°", *(f"{value:.1f}" for value in position)]
        row += [str(4 * int(seen.sum())), f"{100 * change:+.0f} %" if np.isfinite(change) else "undetermined"]
        row += [str(4 * int((seen & (rays <= least)).sum())), _leg(network, index)]
        row += [] if degrees is None else [f"{value:.1f}" for value in degrees[index]]
        rows.append(row)
    return {"columns": columns, "rows": rows}


def _leg(network: NetworkRecord, station: int) -> str:
    """Return the length of the leg to a station, and over how many via points it goes."""
    if station == 0:
        return ""
    length = f"{network.legs[station - 1]:.3g}"
    vias = network.vias.get(station - 1)
    return length if vias is None else f"{length} over {len(vias)} via"
