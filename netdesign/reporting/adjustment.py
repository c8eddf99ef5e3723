"""What a person wants to know first of an adjustment, in plain lines; every sigma with its datum."""

from math import floor, isfinite, log10

import numpy as np

from netdesign.model.adjustment import Adjustment
from netdesign.model.arrays import Floats

INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")


def adjustment_text(adjustment: Adjustment) -> str:
    """Return the summary of an adjustment that the command line prints."""
    used = adjustment.used
    factor = adjustment.sigma0 if np.isfinite(adjustment.sigma0) else 1.0
    rms_px = float(np.sqrt((adjustment.residuals_px**2).mean()))
    numbers = adjustment.redundancy_numbers.mean(axis=0)
    lines = [
        f"datum        {adjustment.datum}",
        f"images       {len(adjustment.world_from_cam)}, points {int(used.sum())}, "
        f"image points {len(adjustment.observations)}, rejected {len(adjustment.rejected)}",
        f"observations {adjustment.n_observations}, unknowns {adjustment.n_unknowns}, datum constraints "
        f"{adjustment.n_datum}, redundancy {adjustment.redundancy}",
        f"sigma0       {adjustment.sigma0:.4f} (a priori 1), residuals {rms_px:.4f} px rms, "
        f"{adjustment.iterations} iterations",
        f"point sigma  {_sigmas(adjustment.point_covariance[used], factor)} (per coordinate, a posteriori)",
    ]
    if adjustment.n_datum < 6:
        inner = _sigmas(adjustment.inner_covariance[used], factor)
        lines.append(f"inner sigma  {inner} (carried to inner constraints over all points: without the frame's own)")
    station = adjustment.sigma_position * factor
    lines += [
        f"stations     {_length(_rms(station))} rms, {_length(float(station.max()))} worst (per coordinate)",
        f"redundancy   {numbers[0]:.3f} in x, {numbers[1]:.3f} in y on average",
    ]
    sigma = np.sqrt(np.maximum(np.diag(adjustment.parameter_covariance), 0.0)) * factor
    share = max(len(sigma) // len(adjustment.intrinsics), 1)
    for index, (name, value) in enumerate(zip(adjustment.parameter_names, sigma.tolist(), strict=True)):
        key = name.split()[-1]
        row = adjustment.intrinsics[index // share]
        lines.append(f"{name:<12} {_with_sigma(float(row[0 if key == 'f' else INTRINSICS.index(key)]), value)}")
    return "\n".join([*lines, *(f"warning      {text}" for text in adjustment.warnings)])


def _sigmas(covariance: Floats, factor: float) -> str:
    variance = np.trace(covariance, axis1=1, axis2=2) / 3.0 * factor**2
    variance = variance[np.isfinite(variance)]
    if len(variance) == 0:
        return "not determined"
    return f"{_length(float(np.sqrt(variance.mean())))} rms, {_length(float(np.sqrt(variance.max())))} worst"


def _with_sigma(value: float, sigma: float) -> str:
    """Return a value to the digits that its sigma knows."""
    if not (isfinite(sigma) and sigma > 0):
        return f"{value:.9g}"
    decimals = max(0, 2 - floor(log10(sigma)))
    return f"{value:.{decimals}f} +- {sigma:.{decimals}f}"


def _rms(values: Floats) -> float:
    return float(np.sqrt((values**2).mean()))


def _length(metres: float) -> str:
    """Return a length in the unit in which it is easy to read."""
    return f"{metres * 1e6:.4g} um" if metres < 1e-3 else f"{metres * 1e3:.4g} mm"
