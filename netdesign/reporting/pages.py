"""The page: everything it shows as plain values for the template, and the template filled in."""

import importlib.resources
from dataclasses import dataclass
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from netdesign import __version__
from netdesign.model.figures import significant
from netdesign.reporting import charts, palette, proof, words
from netdesign.reporting.articles import article, uri
from netdesign.reporting.mesh import PartMesh
from netdesign.reporting.payload import as_script, payload
from netdesign.reporting.record import RunRecord

Values = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """Static figures as WebP: the front, every network by id, robot cell, reach, achieved against predicted if any."""

    front: bytes
    networks: dict[int, bytes]
    cell: bytes | None
    reach: bytes | None
    achieved: bytes | None


def page(record: RunRecord, mesh: PartMesh, pictures: Pictures, study_text: str) -> str:
    """Return the whole report as one HTML document that loads nothing."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("netdesign", "reporting/templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    # As files, not as templates: braces of CSS and JavaScript mean themselves.
    folder = importlib.resources.files("netdesign.reporting") / "templates"
    source = {name: (folder / name).read_text(encoding="utf-8") for name in ("report.css", "report.js")}
    study = record.task.study
    return environment.get_template("report.html.j2").render(
        version=__version__,
        title=study.name,
        seed=study.seed,
        sha256=record.task.sha256,
        knee=record.knee,
        css=Markup(source["report.css"]),
        script=Markup(source["report.js"]),
        plotly=Markup(get_plotlyjs().replace("</script", "<\\/script")),
        data=Markup(as_script(payload(record, mesh))),
        words={
            "headline": words.headline(record),
            "verdict": words.verdict(record),
            "reason": record.reason[0].upper() + record.reason[1:] + ".",
            "footer": f"Sigmas are one standard deviation per coordinate. Limited: {words.LIMITED_DATUM}. "
            f"Total and achieved: {words.SHORT_DATUM}.",
        },
        tiles=_tiles(record),
        captions=_captions(record),
        images={
            "front": uri("webp", pictures.front),
            "achieved": uri("webp", pictures.achieved) if pictures.achieved else "",
        },
        cell={"uri": uri("webp", pictures.cell) if pictures.cell else "", "caption": _cell_caption(record)},
        reach={
            "uri": uri("webp", pictures.reach) if pictures.reach else "",
            "caption": words.reach_caption(record.task.sphere),
        },
        columns=_columns(record),
        rows=_rows(record),
        networks=[article(record, network, pictures.networks[network.id]) for network in record.networks],
        point_count=len(record.task.scene.targets.points),
        campaign=proof.campaign(record),
        flags=words.all_flags(record),
        inputs=_inputs(record),
        history=_history(record),
        study_text=study_text,
        glossary=words.GLOSSARY,
    )


def _cell_caption(record: RunRecord) -> str:
    return f"The cell: the robot at the first station of the recommended network {record.knee:04d}, and its tour."


def _tiles(record: RunRecord) -> list[Values]:
    knee = next(network for network in record.networks if network.id == record.knee)
    return [
        {
            "name": "Recommended",
            "value": knee.name,
            "unit": "",
            "note": f"{knee.images} images, tour {significant(knee.tour)} {record.tour_unit}",
        },
        {
            "name": "Rms sigma, total",
            "value": words.finite(knee.total_rms_um, 1),
            "unit": "µm",
            "note": f"of {knee.name}; datum: {words.SHORT_DATUM}",
        },
        {
            "name": "Rms sigma, limited",
            "value": words.finite(knee.rms_um, 1),
            "unit": "µm",
            "note": f"of {knee.name}; the criterion of the search, poses error-free",
        },
        {
            "name": "Above the bound",
            "value": "–" if knee.bound_ratio is None else f"{100 * (np.sqrt(knee.bound_ratio) - 1):.0f}",
            "unit": "" if knee.bound_ratio is None else "%",
            "note": "no lower bound was computed"
            if knee.bound_ratio is None
            else f"in sigma, over what {knee.images} images can give at best",
        },
    ]


def _captions(record: RunRecord) -> Values:
    unit = record.tour_unit
    datum = f"Sigma: {record.precision_name}, {record.task.study.objectives.propagation} error propagation"
    bound = (
        " The dashed curve is the proven lower bound: no network of so many images can go below it."
        if record.bounds_um()
        else ""
    )
    return {
        "motion": f"Each curve joins the networks of one size. {datum}.",
        "images": f"What one more image buys.{bound}",
        "travel": f"Tour length in {unit}; more images do not always need a longer tour.",
        "cloud": "The discrete number of images gives layers; drag to turn.",
        "static": f"{datum}. Ringed: the recommended network {record.knee:04d}.",
        "table": f"Sigmas in µm per coordinate. Limited: {words.LIMITED_DATUM}. Total: full bundle adjustment, datum: "
        f"{words.SHORT_DATUM}. Click a heading to sort, a row to see the network.",
    }


def _columns(record: RunRecord) -> list[Values]:
    names = [
        ("id", "network", "", True),
        ("images", "images", "", False),
        ("tour", f"tour [{record.tour_unit}]", "objective f2", False),
        ("rms", "rms σ limited", "objective f1 as a sigma", False),
        ("max", "max σ limited", "the worst coordinate", False),
        ("total", "rms σ total", words.SHORT_DATUM, False),
        ("totalmax", "max σ total", words.SHORT_DATUM, False),
        ("bound", "bound ratio", "f1 over its proven lower bound", False),
        ("rays", "least rays", "images that see the worst point", False),
        ("verdict", "validation", "", True),
    ]
    return [{"key": key, "name": name, "title": title, "left": left} for key, name, title, left in names]


def _rows(record: RunRecord) -> list[Values]:
    colors = palette.ordered(network.images for network in record.networks)
    rows = []
    for network, color in zip(record.networks, colors, strict=True):
        cells: list[Values] = [
            {"text": network.name, "sort": network.id, "left": True, "color": color,
             "mark": "recommended" if network.id == record.knee else ""},
            {"text": str(network.images), "sort": network.images},
            {"text": words.finite(network.tour, 2 if network.tour < 1000 else 0), "sort": network.tour},
        ]  # fmt: skip
        for value in (network.rms_um, network.max_um, network.total_rms_um, network.total_max_um):
            cells.append({"text": words.finite(value), "sort": value if np.isfinite(value) else ""})
        ratio = network.bound_ratio
        cells.append({"text": "–" if ratio is None else f"{ratio:.3f}", "sort": "" if ratio is None else ratio})
        least = int(network.rays.min())
        cells.append({"text": str(least), "sort": least})
        flagged = bool(network.warnings) and network.verdict in ("pass", "not validated")
        cells.append(
            {"text": network.verdict + (" · flagged" if flagged else ""), "sort": network.verdict, "left": True,
             "chip": "warn" if flagged else words.chip_kind(network.verdict) or "plain"}
        )  # fmt: skip
        default = {"left": False, "color": "", "chip": "", "mark": ""}
        rows.append({"id": network.id, "cells": [{**default, **cell} for cell in cells]})
    return rows


def _history(record: RunRecord) -> Markup:
    history = record.design.get("history") or {}
    return charts.line_chart(
        history.get("evaluations", []), history.get("hypervolume", []), "networks evaluated", "hypervolume"
    )


def _inputs(record: RunRecord) -> list[dict[str, str]]:
    task, study = record.task, record.task.study
    camera, sphere, limits = study.camera, study.viewpoints, study.visibility
    size = np.ptp(task.scene.part.vertices, axis=0) * 1e3
    near, far = task.camera.depth_of_field()
    noise = f"{camera.sigma_px:g} px" if task.camera.corner_noise is None else "calibrated model of the detector"
    facts = [
        ("Part", f"{study.part.mesh}, {len(task.scene.part.faces)} triangles, "
                 f"{size[0]:.1f} × {size[1]:.1f} × {size[2]:.1f} mm"),
        ("Targets", f"{len(task.scene.targets.ids)} tags {study.targets.family}, {study.targets.size_mm:g} mm, "
                    f"{len(task.scene.targets.points)} object points"
                    + (f"; {len(task.left_out)} left out, hardly seen" if task.left_out else "")),
        ("Camera", f"{camera.width_px} × {camera.height_px} px, f = {camera.focal_px[0]:g} px"
                   + (f", pixel {camera.pixel_um:g} µm" if camera.pixel_um else "")),
        ("Distortion k1 k2 p1 p2", ", ".join(f"{value:g}" for value in camera.distortion)),
        ("Depth of field", f"{near * 1e3:.0f} to {far * 1e3:.0f} mm" if np.isfinite(far) else "not limited"),
        ("Image noise per coordinate", noise),
        ("Stations", f"{words.stations(sphere)}, elevation {sphere.elevation_deg[0]:g}° to "
                     f"{sphere.elevation_deg[1]:g}°, azimuth {sphere.azimuth_deg[0]:g}° to {sphere.azimuth_deg[1]:g}°, "
                     f"roll {sphere.roll_deg}{'' if sphere.roll_deg == 'free' else '°'}"),
        ("Visibility", f"incidence ≤ {limits.max_incidence_deg:g}°, tag ≥ {limits.min_tag_px:g} px, "
                       f"≥ {limits.min_rays} rays per point, ≥ {limits.min_points_per_image} points per image, "
                       f"occlusion {'on' if limits.occlusion else 'off'}"),
        ("Robot", "none: motion is measured in the workspace" if study.robot is None
                  else f"{study.robot.name or study.robot.urdf}, camera mount {study.robot.camera_mount}"),
        ("Objectives", f"{study.objectives.precision}, {study.objectives.propagation} propagation; tour "
                       f"({study.motion}); images, at most {sphere.max_images}"),
        ("Search", f"{study.search.engine}, population {study.search.population}, "
                   f"{study.search.generations} generations"),
        ("Datum of the proof", f"{study.validation.datum}: {words.SHORT_DATUM}"),
        ("Seed · version", f"{study.seed} · {record.design.get('netdesign_version', '')}"),
    ]  # fmt: skip
    asked = words.requirements(study)
    if asked:
        facts.append(("Requirements", "; ".join(asked)))
    return [{"name": name, "value": value} for name, value in facts]
