"""A crowded image cut into tiles, and these solved by workers."""
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field

import numpy as np

from photutils_mgauss.crowded.correlated import noise_pairs
from photutils_mgauss.crowded.solve import solve_tile
from photutils_mgauss.crowded.stars import Stars
from photutils_mgauss.crowded.table import no_stars, tabulate
from photutils_mgauss.crowded.tile import CELL, TileJob, TileOptions
from photutils_mgauss.psf.local import LocalPSF
from photutils_mgauss.utils.checkpoint import Checkpoint, digest_of
from photutils_mgauss.utils.correlated_noise import no_pairs
from photutils_mgauss.utils.image import PixelData
from photutils_mgauss.utils.parallel import Threads, tell
from photutils_mgauss.utils.waiting import progress

# The smallest and the largest size of tiles if none is given [pix].
_TILES = (1024, 2048)
# Pixels this far off the model are counted [standard deviations].
_FAR = 5.0


@dataclass(frozen=True)
class Outcome:
    """
    What comes back from a worker.

    ``saturated`` tells whether the tile has saturated stars, ``known`` whether
    it was measured what the PSF leaves of them.
    """

    stars: Stars
    chi2: float = 0.0
    n_pixels: int = 0
    widths: np.ndarray = field(default_factory=lambda: np.empty(0))
    pairs: np.ndarray = field(default_factory=no_pairs)
    n_far: int = 0
    saturated: bool = False
    known: bool = False

    @classmethod
    def of(cls, job):
        """Solve a tile."""
        if job.is_empty:
            return cls(no_stars())
        tile = solve_tile(job)
        model = tile.model
        chi2 = model.weight * model.residual**2
        return cls(tabulate(tile, job.core), float(chi2.sum()),
                   int(model.good.sum()), tile.widths, noise_pairs(model),
                   int((chi2 > _FAR**2).sum()),
                   bool(tile.stars.seeded.any()), tile.wings_known)

    @classmethod
    def of_arrays(cls, arrays):
        """Return what `arrays` made arrays of."""
        widths, pairs = arrays.pop('tile_widths'), arrays.pop('tile_pairs')
        chi2, n_pixels, n_far, *wings = arrays.pop('tile_sums')
        return cls(Stars.of_columns(arrays), float(chi2), int(n_pixels),
                   widths, pairs, int(n_far), *map(bool, wings))

    def arrays(self):
        """Return all there is as a dict of arrays."""
        return {**vars(self.stars), 'tile_widths': self.widths,
                'tile_pairs': self.pairs,
                'tile_sums': np.array([
                    self.chi2, self.n_pixels, self.n_far, self.saturated,
                    self.known], float)}


class Tiles:
    """
    What is common to plans: pieces of work that are known by their cores.

    A plan has ``cores``, what makes the ``job`` of one, and ``solve``, which
    workers call with it; ``checkpoint`` keeps the tiles that are finished.
    """

    def work(self, core):
        """Cut out a tile and solve it, if that has not been done before."""
        job = self.job(core)
        outcome = self.kept(job)
        return (self.keep(job, self.solve(job)) if outcome is None
                else outcome)

    def kept(self, job):
        """Return the outcome of a tile that was finished before, or None."""
        arrays = self.checkpoint and self.checkpoint.load(digest_of(job))
        return Outcome.of_arrays(arrays) if arrays else None

    def keep(self, job, outcome):
        """Return an outcome, and keep it."""
        if self.checkpoint:
            self.checkpoint.save(digest_of(job), outcome.arrays())
        return outcome


@dataclass(frozen=True)
class Plan(Tiles):
    """
    How an image is cut into tiles.

    ``tile_shape`` is the largest shape of a tile, None that of a size that
    does not need much memory and leaves work for more than one worker.
    ``given`` is None, or the stars of a list.
    """

    solve = staticmethod(Outcome.of)

    image: PixelData
    psf: LocalPSF
    options: TileOptions
    tile_shape: tuple | None
    overlap: int
    given: Stars | None
    checkpoint: Checkpoint | None = None

    @property
    def cores(self):
        """The pixels (y_low, y_high, x_low, x_high) of each tile."""
        shape = self.image.shape
        return cut(shape, self.tile_shape or 2 * (tile_size(shape),))

    def job(self, core):
        """Cut out a tile."""
        ny, nx = self.image.shape
        margin = self.options.background_size or 0
        y_low, y_high = window(core[:2], ny, self.overlap, margin)
        x_low, x_high = window(core[2:], nx, self.overlap, margin)
        part = given_in(self.given, (y_low, y_high, x_low, x_high))
        return TileJob(*self.image.part(np.s_[y_low:y_high, x_low:x_high]),
                       self.psf.moved(x_low, y_low), self.options,
                       (y_low, x_low),
                       reported(core, (ny, nx), self.overlap), part)


def tile_size(shape):
    """Return the largest side of tiles of an image if none is given."""
    return min(max(-(-max(shape) // 2), _TILES[0]), _TILES[1])


def cut(shape, tile_shape):
    """Return the cores (y_low, y_high, x_low, x_high) of even tiles."""
    rows, columns = (_even_parts(n, tile) for n, tile in zip(
        shape, tile_shape, strict=True))
    return [(*row, *column) for row in rows for column in columns]


def reported(core, shape, overlap):
    """Return where the stars are that the tile of a core reports."""
    # The outermost tiles also own the stars just outside the image.
    ny, nx = shape
    return (core[0] or -overlap, core[1] if core[1] < ny else ny + overlap,
            core[2] or -overlap, core[3] if core[3] < nx else nx + overlap)


def given_in(given, window):
    """Return the listed stars of a window, in its pixels, or None."""
    if given is None:
        return None
    y_low, y_high, x_low, x_high = window
    x, y = given.x, given.y
    near = ((x > x_low - 1) & (x < x_high) & (y > y_low - 1) & (y < y_high))
    return given.chosen(near).moved(-x_low, -y_low)


def _even_parts(size, largest):
    """Return (low, high) of as few even parts as the largest part allows."""
    part = -(-size // -(-size // largest))
    # Tiles see fewer pixels if they begin where cells do.
    part = min(-(-part // CELL) * CELL, largest)
    return [(low, min(low + part, size)) for low in range(0, size, part)]


def window(core, size, overlap, spacing):
    """
    Return which pixels a tile sees along an axis.

    It sees all of those that the background in its core rests on, nodes up
    to one beyond it, and whole cells of the PSF.
    """
    low, high = core[0] - overlap, core[1] + overlap
    if spacing:
        low = min(low, (core[0] // spacing - 1.5) * spacing)
        high = max(high, (-(-core[1] // spacing) + 1.5) * spacing)
    return (max(0, int(low // CELL) * CELL),
            min(size, -int(-high // CELL) * CELL))


def run(plan, executor, progress_bar):
    """
    Solve all tiles of a plan.

    Returns
    -------
    outcomes : list of Outcome or None
        One for each core of the plan, None where a worker failed.
    errors : list of Exception
    """
    if executor is None:
        with Threads() as pool:
            return run(plan, pool, progress_bar)
    if isinstance(executor, (Threads, ThreadPoolExecutor)):
        return _collect(executor, plan.work, plan.cores, progress_bar)
    return _run_elsewhere(plan, executor, progress_bar)


def _run_elsewhere(plan, executor, progress_bar):
    """Solve tiles where workers get no more than their tile."""
    if not plan.checkpoint:
        return _collect(executor, plan.solve, map(plan.job, plan.cores),
                        progress_bar)
    before = [plan.kept(plan.job(core)) for core in plan.cores]
    left = [core for core, outcome in zip(plan.cores, before, strict=True)
            if outcome is None]
    found, errors = _collect(
        executor, plan.solve, map(plan.job, left), progress_bar,
        lambda i, outcome: plan.keep(plan.job(left[i]), outcome))
    found = iter(found)
    return [next(found) if outcome is None else outcome
            for outcome in before], errors


def _collect(pool, work, tasks, progress_bar, keep=None):
    """Have tasks done; ``keep`` is given each number and outcome."""
    outcomes, errors, futures = [], [], {}
    for task in tasks:
        try:
            futures[pool.submit(work, task)] = len(outcomes)
        except RuntimeError as error:  # the pool has broken
            errors.append(error)
        outcomes.append(None)
    with progress(total=len(outcomes), desc='tiles',
                  shown=progress_bar) as bar:
        for future in as_completed(futures):
            # A cluster would do again what a worker that dies has done for a
            # future that somebody still holds.
            number = futures.pop(future)
            try:
                outcomes[number] = future.result()
            except Exception as error:  # noqa: BLE001 a worker may die of any
                errors.append(error)
            else:
                if keep is not None:
                    keep(number, outcomes[number])
            del future
            tell(len(outcomes) - len(futures), len(outcomes))
            if not bar.disable:
                _advance(bar, outcomes)
    return outcomes, errors


def _advance(bar, outcomes):
    done = [outcome for outcome in outcomes if outcome is not None]
    chi2 = sum(o.chi2 for o in done) / max(sum(o.n_pixels for o in done), 1)
    bar.set_postfix(stars=sum(len(o.stars) for o in done),
                    chi2=f'{chi2:.2f}')
    bar.update()
