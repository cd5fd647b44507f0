"""Convergence of chains, from arrays alone: any version of PyMC will do."""
import numpy as np
from scipy.special import ndtri


def split_r_hat(draws):
    """
    Return the rank-normalised split R-hat of draws (c, d).

    The larger of that of the draws and that of their distances from the
    median (Vehtari et al. 2021, Sec. 4).
    """
    folded = np.abs(draws - np.median(draws))
    return max(_r_hat(_normal_scores(_split(draws))),
               _r_hat(_normal_scores(_split(folded))))


def effective_size(draws):
    """Return the bulk effective sample size of draws (c, d)."""
    chains = _normal_scores(_split(draws))
    if np.ptp(chains) == 0:
        return np.nan
    m, n = chains.shape
    covariance = _autocovariance(chains)
    within = covariance[:, 0].mean() * n / (n - 1)
    pooled = within * (n - 1) / n
    if m > 1:
        pooled += chains.mean(axis=1).var(ddof=1)
    rho = 1 - (within - covariance.mean(axis=0) * n / (n - 1)) / pooled
    rho[0] = 1
    # Geyer: sums of pairs, while positive, made to fall.
    pairs = rho[:n // 2 * 2].reshape(-1, 2).sum(axis=1)
    last = np.argmax(pairs < 0) if (pairs < 0).any() else len(pairs)
    pairs = np.minimum.accumulate(pairs[:last])
    time = max(-1 + 2 * pairs.sum(), 1 / np.log10(m * n))
    return m * n / time


def _split(draws):
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _normal_scores(draws):
    if np.ptp(draws) == 0:
        return np.zeros_like(draws)
    from scipy.stats import rankdata
    rank = rankdata(draws).reshape(draws.shape)
    return ndtri((rank - 0.375) / (draws.size + 0.25))


def _r_hat(chains):
    n = chains.shape[1]
    within = chains.var(axis=1, ddof=1).mean()
    between = chains.mean(axis=1).var(ddof=1)
    if within == 0:
        return np.nan
    return float(np.sqrt((n - 1) / n + between / within))


def _autocovariance(chains):
    """Return the autocovariance (m, n) of each chain, by FFT."""
    n = chains.shape[1]
    centred = chains - chains.mean(axis=1, keepdims=True)
    spectrum = np.fft.rfft(centred, 2 * n)
    return np.fft.irfft(np.abs(spectrum)**2, 2 * n)[:, :n] / n
