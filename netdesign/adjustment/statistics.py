"""Null distributions of the comparison statistics, exact to the printed digits.

The squared RMS ratio is a weighted sum of chi² (1) variables. Its distribution function is inverted from the
characteristic function φ(u) = Π (1 - 2iλu)^(-1/2) by the Fourier-series method (J. Abate and W. Whitt, Queueing Systems
10, 1992; the exact alternative to J. P. Imhof, Biometrika 48, 1961): on a period X beyond which the tail is below
1e-13, F(x) = x/X + 2 Re Σ φ(u_n) (1 - exp(-i u_n x)) / (i u_n X),  u_n = 2πn/X.
Moment approximations
(Satterthwaite, Liu-Tang-Zhang) miss the lower tail and are not used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import chi2, f

from netdesign.model.adjustment import Interval
from netdesign.model.arrays import Floats


@dataclass(frozen=True, kw_only=True)
class WeightedChi2:
    """The distribution of Σ λ z² / Σ λ for independent standard normal z.

    Attributes:
        frequencies: (q,) u_n > 0.  coefficients: (q,) complex φ(u_n).  period: X.
    """

    frequencies: Floats
    coefficients: np.ndarray[tuple[int], np.dtype[np.complex128]]
    period: float

    @staticmethod
    def of(weights: Floats) -> "WeightedChi2":
        """Return the distribution for weights λ (k,), positive up to rounding."""
        share = np.sort(np.maximum(weights, 0.0))[::-1]
        share = share[share > 1e-14 * share[0]]
        share = share / share.sum()
        # Chernoff: P(Y > X) <= exp(-sX) Π (1 - 2sλ)^(-1/2) with s = 0.45/λmax; X where that is e^-32.
        s = 0.45 / share[0]
        period = float((32.0 - 0.5 * np.log1p(-2.0 * s * share).sum()) / s)
        step = float(2.0 * np.pi / period)
        found: list[np.ndarray[tuple[int], np.dtype[np.complex128]]] = []
        first = 1
        while True:
            u = step * np.arange(first, first + 256)
            log = np.zeros(len(u), dtype=np.complex128)
            for chunk in np.array_split(share, max(1, len(share) // 64)):
                log -= 0.5 * np.log1p(-2j * chunk[:, None] * u).sum(axis=0)
            found.append(np.exp(log))
            first += 256
            if abs(found[-1][-1]) < 1e-15 or first > 200_000:
                break
        coefficients = np.concatenate(found)
        return WeightedChi2(
            frequencies=step * np.arange(1.0, len(coefficients) + 1.0), coefficients=coefficients, period=period
        )

    def cdf(self, x: float) -> float:
        """Return P(Y <= x)."""
        if x <= 0.0:
            return 0.0
        if x >= self.period:
            return 1.0
        u = self.frequencies
        terms = self.coefficients * (1.0 - np.exp(-1j * u * x)) / (1j * u)
        return float(np.clip((x + 2.0 * terms.sum().real) / self.period, 0.0, 1.0))

    def ppf(self, probability: float) -> float:
        """Return the quantile of a probability in (0, 1)."""
        return float(brentq(lambda x: self.cdf(x) - probability, 1e-12, self.period, xtol=1e-12))


def log_rms_moments(weights: Floats) -> tuple[float, float]:
    """Return mean and standard deviation of log rho, rho² = Σ λ z² / Σ λ, under the null hypothesis.

    The mean of rho² is 1 but that of log rho is negative, about -1 / (2 nu_eff): -0.1 for five effective degrees of
    freedom. With E exponential, V = E / rho² has the survival function P(V > t) = Π (1 + 2 λ t)^(-1/2), the Laplace
    transform of rho²; log V = log E - log rho² is a sum of independent terms, so that the moments of log rho² are
    those of log V less those of log E. On t = exp(s) the integrands are analytic and the trapezoidal rule is exact.

    Args:
        weights: (k,) λ, positive up to rounding.
    """
    share = np.maximum(weights, 0.0)
    share = share[share > 1e-14 * share.max()]
    share = share / share.sum()
    step = 0.05
    s = np.arange(-40.0, 80.0, step)
    survival = np.zeros(len(s))
    for chunk in np.array_split(share, max(1, len(share) // 64)):
        survival -= 0.5 * np.log1p(2.0 * chunk[:, None] * np.exp(s)).sum(axis=0)
    gap = np.exp(survival) - np.exp(-np.exp(np.minimum(s, 7.0)))
    first, second = float(gap.sum() * step), float((2.0 * s * gap).sum() * step)
    variance = second + 2.0 * np.euler_gamma * first - first**2
    return -0.5 * first, 0.5 * float(np.sqrt(max(variance, 0.0)))


MOMENTS = ("t_mean", "t_variance", "v_mean", "v_variance", "common")


@dataclass(frozen=True, kw_only=True)
class SumsOfSquares:
    """Mean and variance of T = dᵀMd and V = vᵀPv where the errors of image points are correlated, and their covariance.

    With independent errors T is chi² (nu) and V chi² (r). Else both are weighted sums of many chi² (1); with hundreds
    of degrees of freedom the scaled chi² of the same mean and variance is exact enough (F. E. Satterthwaite, 1946).
    """

    t_mean: float
    t_variance: float
    v_mean: float
    v_variance: float
    common: float

    @staticmethod
    def independent(nu: int, r: int) -> "SumsOfSquares":
        """Return those of independent errors."""
        return SumsOfSquares(t_mean=nu, t_variance=2.0 * nu, v_mean=r, v_variance=2.0 * r, common=0.0)

    @staticmethod
    def kept(sums: Mapping[str, float]) -> "SumsOfSquares":
        """Return those among the sums of a validation; of one kept without them, those of independent errors."""
        if "t_mean" not in sums:
            return SumsOfSquares.independent(int(sums["nu"]), int(sums["r"]))
        return SumsOfSquares(**{name: sums[name] for name in MOMENTS})

    @staticmethod
    def pooled(parts: "Sequence[SumsOfSquares]") -> "SumsOfSquares":
        """Return those of the sums over independent realisations: means and variances add."""
        return SumsOfSquares(**{name: sum(getattr(part, name) for part in parts) for name in MOMENTS})

    @property
    def moments(self) -> dict[str, float]:
        """All five by name, as they are kept in files."""
        return {name: float(getattr(self, name)) for name in MOMENTS}

    @property
    def t_dof(self) -> float:
        """Degrees of freedom of the scaled chi² that stands for T."""
        return 2.0 * self.t_mean**2 / self.t_variance

    @property
    def v_dof(self) -> float:
        """The same for V."""
        return 2.0 * self.v_mean**2 / self.v_variance

    @property
    def ratio_dofs(self) -> tuple[float, float]:
        """Degrees of freedom of the F that stands for T/V, whose logarithm varies less by what both have in common."""
        apart = 2.0 / self.t_dof + 2.0 / self.v_dof
        share = apart / (apart - 2.0 * self.common / (self.t_mean * self.v_mean))
        return self.t_dof * share, self.v_dof * share


def chi2_interval(value: float, dof: float, level: float, mean: float = 1.0) -> Interval:
    """Return a mean square ``value`` = mean chi²/dof with its two-sided interval."""
    low, high = mean * chi2.ppf([0.5 * (1 - level), 0.5 * (1 + level)], dof) / dof
    return Interval(value=value, low=float(low), high=float(high), pit=float(chi2.cdf(value / mean * dof, dof)))


def f_interval(value: float, dof_above: float, dof_below: float, level: float, mean: float = 1.0) -> Interval:
    """Return a ratio of mean squares, ``mean`` times an F, with its two-sided interval."""
    low, high = mean * f.ppf([0.5 * (1 - level), 0.5 * (1 + level)], dof_above, dof_below)
    return Interval(value=value, low=float(low), high=float(high), pit=float(f.cdf(value / mean, dof_above, dof_below)))


def rms_interval(value: float, weights: Floats, level: float) -> Interval:
    """Return an achieved / predicted RMS ratio with its exact interval.

    Args:
        weights: (k,) eigenvalues of the joint covariance.
    """
    distribution = WeightedChi2.of(weights)
    low, high = (np.sqrt(distribution.ppf(p)) for p in (0.5 * (1 - level), 0.5 * (1 + level)))
    return Interval(value=value, low=float(low), high=float(high), pit=distribution.cdf(value**2))


def sampled_interval(value: float, draws: Floats, level: float) -> Interval:
    """Return a statistic with the interval of seeded draws (s,) under the null hypothesis; ties count half."""
    low, high = np.quantile(draws, [0.5 * (1 - level), 0.5 * (1 + level)])
    pit = float((draws < value).mean() + 0.5 * (draws == value).mean())
    return Interval(value=value, low=float(low), high=float(high), pit=pit)
