"""Commands killed at random moments, and given again."""
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]


def run_with_kills(words, folder, *, n_kills, seconds, seed):
    """
    Run ``mgauss`` until it succeeds, killing (-9) it at random moments.

    Parameters
    ----------
    words : list of str
        The arguments.
    folder : path-like
        Where to run.
    n_kills : int
        How often it is killed before it is left alone.
    seconds : float
        It is killed after a time of up to so many seconds.
    seed : int

    Returns
    -------
    int
        How often it was killed; less than ``n_kills`` if it was faster.
    """
    rng = np.random.default_rng(seed)
    environment = os.environ | {'PYTHONPATH': str(ROOT)}
    command = [sys.executable, '-m', 'photutils_mgauss', *map(str, words)]
    killed = 0
    while True:
        limit = rng.uniform(0, seconds) if killed < n_kills else None
        try:
            run = subprocess.run(command, cwd=folder, env=environment,
                                 timeout=limit, capture_output=True,
                                 text=True, check=False)
        except subprocess.TimeoutExpired:  # run() has killed it by then
            killed += 1
            continue
        if run.returncode:
            raise RuntimeError(run.stderr)
        return killed
