"""Many networks, one verdict: is the predicted accuracy the achieved one?

One network cannot confirm a prediction to 10 %; K of them can. Pooled over networks, realisations independent:

    T = Σ Tᵢ ~ chi²(Σ nuᵢ),   v'Pv = Σ ~ chi²(Σ rᵢ),   F = (T/Σnu) / (v'Pv/Σr) ~ F(Σnu, Σr)
    (where image points correlate: scaled, with fewer degrees of freedom; ``statistics.SumsOfSquares``)
    PIT of every statistic uniform (Kolmogorov-Smirnov)
    geometric mean of rho over its expectation, slope of log achieved against log predicted

A single rho of a network with few effective degrees of freedom scatters widely and, as E rho² = 1, its logarithm lies
low on average: by 1/(2 nu_eff), a tenth for nu_eff = 5. The plain geometric mean of right predictions is therefore
below 1. Here every log rho is taken less its exact expectation and weighted with its exact variance
(``statistics.log_rms_moments``); the plain mean and what is expected of it are reported beside.

With real detectors the null hypothesis is never exactly true and a large campaign rejects it for a 2 % error of sigma.
The decision is therefore one of equivalence (two one-sided tests of 5 %, D. J. Schuirmann,
J. Pharmacokinet. Biopharm. 15, 1987): the 90 % interval of the geometric mean of rho inside [0.90, 1.11] and that
of sqrt(F) inside [0.95, 1.05]. The exact p-values are reported beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import f, kendalltau, kstest, t

from netdesign.adjustment.statistics import SumsOfSquares, chi2_interval, f_interval
from netdesign.errors import InfeasibleError
from netdesign.model.adjustment import Interval, Validation
from netdesign.model.arrays import Floats

RHO_MARGIN = (0.90, 1.11)
ROOT_F_MARGIN = (0.95, 1.05)
LEVEL = 0.99


@dataclass(frozen=True, kw_only=True)
class Member:
    """What one validated network gives to the campaign.

    Attributes:
        name: of the network.  t_sum, nu, vpv, r: its sums.  expected: what they are when the prediction is right.
        rho: its RMS ratio.  log_rho_mean, log_rho_sd: of log rho when the prediction is right.
        pits: of "t", "s0_squared", "f" and "rho".
        predicted ("limited", "total", "used"), achieved: RMS, m.
        coverage: share inside the 95 % ellipsoids, of points_used points.
        errors: (m, 3) m after alignment, rows of NaN without estimate; for repeats of one network.
    """

    name: str
    t_sum: float
    nu: float
    vpv: float
    r: float
    expected: SumsOfSquares
    rho: float
    log_rho_mean: float
    log_rho_sd: float
    pits: dict[str, float]
    predicted: dict[str, float]
    achieved: float
    coverage: float
    points_used: int
    errors: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Band:
    """An estimate with its 90 % confidence interval and the margin it must stay in."""

    value: float
    low: float
    high: float
    margin: tuple[float, float]

    @property
    def equivalent(self) -> bool:
        """Both one-sided tests of 5 % reject a deviation as large as the margin."""
        return self.margin[0] <= self.low and self.high <= self.margin[1]


@dataclass(frozen=True, kw_only=True)
class Repeats:
    """Bias and noise of one network that was realised several times.

    Attributes:
        count: realisations.  bias_share: share of the mean squared error that all realisations have in common
            (an unbiased estimate; slightly negative means none).
    """

    count: int
    bias_share: float


@dataclass(frozen=True, kw_only=True)
class Campaign:
    """The pooled verdict.

    Attributes:
        members: networks pooled.  t, s0_squared, f: pooled statistics with exact intervals.
        rho: geometric mean of achieved / predicted from the observations used, each over its expectation and weighted
            with its precision; root_f: square root of the pooled F over its expectation.
        against: the same of achieved / predicted for "limited", "total" and "used".
        plain: plain geometric mean of the same, and what it is "expected" to be and the "sd" of its logarithm when all
            predictions are right.
        slope: of log achieved against log predicted, with its 90 % interval; nan with fewer than three networks.
        kendall: rank correlation of predicted and achieved; nan with fewer than three networks.
        ks: p-value of the PITs' uniformity per statistic.  pits: the PITs, for histograms.
        coverage: share of all points inside their 95 % ellipsoids.
        repeats: by network, where it was realised more than once.
        equivalent: the decision.  statement: in words.
    """

    members: int
    t: Interval
    s0_squared: Interval
    f: Interval
    rho: Band
    root_f: Band
    against: dict[str, float]
    plain: dict[str, float]
    slope: Band
    kendall: float
    ks: dict[str, float]
    pits: dict[str, tuple[float, ...]]
    coverage: float
    equivalent: bool
    statement: str
    repeats: dict[str, Repeats] = field(default_factory=dict)


def member_of(name: str, validation: Validation) -> Member:
    """Return what a validation gives to the campaign."""
    sums = validation.sums
    return Member(
        name=name,
        t_sum=sums["t"],
        nu=sums["nu"],
        vpv=sums["vpv"],
        r=sums["r"],
        expected=SumsOfSquares.kept(sums),
        rho=validation.rho.value,
        log_rho_mean=validation.log_rho_mean,
        log_rho_sd=validation.log_rho_sd,
        pits={
            "t": validation.t.pit,
            "s0_squared": validation.s0_squared.pit,
            "f": validation.f.pit,
            "rho": validation.rho.pit,
        },
        predicted=dict(validation.predicted),
        achieved=validation.achieved_rms,
        coverage=validation.coverage.value,
        points_used=validation.points_used,
        errors=validation.errors,
    )


def pool(members: Sequence[Member], level: float = LEVEL) -> Campaign:
    """Pool networks (and repeats of them) into one verdict.

    Raises:
        InfeasibleError: nothing to pool.
    """
    if not members:
        raise InfeasibleError("campaign: no network was adjusted, nothing to pool")
    nu, r = sum(m.nu for m in members), sum(m.r for m in members)
    t_mean, s0 = sum(m.t_sum for m in members) / nu, sum(m.vpv for m in members) / r
    expected_sum = SumsOfSquares.pooled([m.expected for m in members])
    t_expected, s0_expected = expected_sum.t_mean / nu, expected_sum.v_mean / r
    ratio = t_mean / s0 / (t_expected / s0_expected)
    low, high = f.ppf([0.05, 0.95], *expected_sum.ratio_dofs)
    root_f = Band(
        value=float(np.sqrt(ratio)),
        low=float(np.sqrt(ratio / high)),
        high=float(np.sqrt(ratio / low)),
        margin=ROOT_F_MARGIN,
    )
    rho = _typical_rho(members)
    ratios = {
        name: np.log([m.achieved / m.predicted[name] for m in members])
        for name in ("limited", "total", "used")
        if all(m.predicted.get(name) and np.isfinite(m.predicted[name]) for m in members)
    }
    expected, weight = np.array([m.log_rho_mean for m in members]), np.array([m.log_rho_sd for m in members]) ** -2.0
    plain = {name: float(np.exp(logs.mean())) for name, logs in ratios.items()}
    plain |= {"expected": float(np.exp(expected.mean())), "sd": float(np.sqrt((1.0 / weight).sum()) / len(members))}
    pits = {name: tuple(m.pits[name] for m in members) for name in ("t", "s0_squared", "f", "rho")}
    slope, kendall = _trend(members)
    points = sum(m.points_used for m in members)
    equivalent = rho.equivalent and root_f.equivalent
    return Campaign(
        members=len(members),
        t=chi2_interval(t_mean, expected_sum.t_dof, level, t_expected),
        s0_squared=chi2_interval(s0, expected_sum.v_dof, level, s0_expected),
        f=f_interval(t_mean / s0, *expected_sum.ratio_dofs, level, t_expected / s0_expected),
        rho=rho,
        root_f=root_f,
        against={name: float(np.exp(np.average(logs - expected, weights=weight))) for name, logs in ratios.items()},
        plain=plain,
        slope=slope,
        kendall=kendall,
        ks={name: float(kstest(values, "uniform").pvalue) for name, values in pits.items()},
        pits=pits,
        coverage=float(sum(m.coverage * m.points_used for m in members) / points),
        equivalent=equivalent,
        statement=_statement(len(members), rho, root_f, plain),
        repeats=_repeats(members),
    )


def _typical_rho(members: Sequence[Member]) -> Band:
    """Return the weighted geometric mean of rho over its expectation, with its 90 % interval.

    The scatter is taken from theory or from the sample, whichever is larger: few networks that happen to agree prove
    nothing.
    """
    excess = np.log([m.rho for m in members]) - np.array([m.log_rho_mean for m in members])
    weight = np.array([m.log_rho_sd for m in members]) ** -2.0
    mean, count = float(np.average(excess, weights=weight)), len(members)
    half = 1.645 / float(np.sqrt(weight.sum()))
    if count > 1:
        scatter = float((weight * (excess - mean) ** 2).sum() / (count - 1))
        half = max(half, float(t.ppf(0.95, count - 1) * np.sqrt(scatter / weight.sum())))
    return Band(
        value=float(np.exp(mean)), low=float(np.exp(mean - half)), high=float(np.exp(mean + half)), margin=RHO_MARGIN
    )


def _trend(members: Sequence[Member]) -> tuple[Band, float]:
    """Return slope of log achieved, less its expectation, against log predicted, and Kendall's rank correlation."""
    x = np.log([m.predicted["used"] for m in members])
    y = np.log([m.achieved for m in members]) - np.array([m.log_rho_mean for m in members])
    margin = (0.9, 1.1)
    if len(members) < 3 or np.ptp(x) < 1e-6:
        return Band(value=float("nan"), low=float("nan"), high=float("nan"), margin=margin), float("nan")
    weight = np.array([m.log_rho_sd for m in members]) ** -2.0
    centre = float((weight * x).sum() / weight.sum())
    scatter = float((weight * (x - centre) ** 2).sum())
    value = float((weight * (x - centre) * y).sum() / scatter)
    residual = y - value * (x - centre) - (weight * y).sum() / weight.sum()
    dof = len(members) - 2
    factor = max(1.0, float((weight * residual**2).sum() / dof))
    half = float(t.ppf(0.95, dof) * np.sqrt(factor / scatter))
    return Band(value=value, low=value - half, high=value + half, margin=margin), float(kendalltau(x, y).statistic)


def _repeats(members: Sequence[Member]) -> dict[str, Repeats]:
    """Return bias against noise for every network that was realised more than once."""
    result: dict[str, Repeats] = {}
    for name in sorted({m.name for m in members}):
        errors = [m.errors for m in members if m.name == name and m.errors is not None]
        if len(errors) < 2:
            continue
        stack = np.stack(errors)
        stack = stack[:, np.isfinite(stack).all(axis=(0, 2))]
        mean_square, count = float((stack**2).sum(axis=(1, 2)).mean()), len(errors)
        common = float((stack.mean(axis=0) ** 2).sum())
        # E|mean|² = bias² + noise²/R and E|d|² = bias² + noise²: solve for the bias.
        bias = (count * common - mean_square) / (count - 1)
        result[name] = Repeats(count=count, bias_share=bias / mean_square)
    return result


def _statement(count: int, rho: Band, root_f: Band, plain: dict[str, float]) -> str:
    """Return the verdict in words: shown, refuted, or what it would take to decide."""
    tested = (rho, root_f)
    if all(band.equivalent for band in tested):
        verdict = "is shown to be the achieved one."
    elif any(band.high < band.margin[0] or band.low > band.margin[1] for band in tested):
        verdict = "is not the achieved one: an interval lies wholly outside its margin."
    elif all(band.margin[0] < band.value < band.margin[1] for band in tested):
        needed = max(_realisations_needed(band, count) for band in tested if not band.equivalent)
        verdict = (
            "is not shown to be the achieved one yet: nothing speaks against it, but so few leave the interval too "
            f"wide. About {needed} would decide ([validation] repeats)."
        )
    else:
        verdict = "is not shown to be the achieved one."
    bands = [
        f"{band.value:.3f} [{band.low:.3f}, {band.high:.3f}] against [{band.margin[0]:.2f}, {band.margin[1]:.2f}]"
        for band in (rho, root_f)
    ]
    return (
        f"Over {count} realisation(s) the predicted accuracy {verdict} "
        f"With 90 % intervals: achieved / predicted over its expectation {bands[0]}; geometry alone, sqrt(F), "
        f"{bands[1]}. Plain geometric mean of achieved / predicted {plain['used']:.3f}; right predictions would give "
        f"{plain['expected']:.3f} +- {plain['expected'] * plain['sd']:.3f}, below 1 because few directions carry most "
        "of the error of a network."
    )


def _realisations_needed(band: Band, count: int) -> int:
    """Return how many realisations would narrow the interval enough if the value stayed: its width falls as 1/√n."""
    value, low, high = np.log([band.value, band.low, band.high])
    inner, outer = np.log(band.margin)
    widest = max((value - low) / (value - inner), (high - value) / (outer - value))
    return int(np.ceil(count * widest**2))
