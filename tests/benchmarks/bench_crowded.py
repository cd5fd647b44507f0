"""
Crowded fields beside other programs: quality for each magnitude, CPU time.

Run as ``python tests/benchmarks/bench_crowded.py CROWDED SPARSE``, two
folders of one detector with ``sci.fits``, ``err.fits``, ``mask.fits``,
``vartrue.fits``, ``truth.ecsv`` (x, y, mag, flux) and ``meta.json`` (origin,
zp_e_per_s, exptime). The PSF is made by `fit_mixture_field` from the sparse
exposure, never the true one, and is that of all programs but SExtractor
(PSFEx, from the same sparse exposure) and DAOPHOT (its own).

Parts: ``peers`` prints completeness, false stars, RMS/CRLB, flux bias and
pulls of each program, and median position errors beside ours on each one's
list and on the stars of both; ``given`` the same with all programs that can
on SExtractor's list of its windowed positions (crowdsource moves no stars of
a given list); ``curve`` completeness over false stars at 24-25 mag;
``area`` CPU seconds and memory of growing images, corners of the scene and,
where that is smaller, scenes simulated by this package (`crowded_area.py`;
``--sizes 9216`` takes half an hour). SExtractor, PSFEx and IRAF run if they
are installed, crowdsource with ``--crowdsource PYTHON``, an interpreter that
has it and the requirements of this package. ``--crop`` takes a corner of the
scene for all, ``--small`` one for crowdsource and SExtractor's list,
``--tiny`` one for IterativePSFPhotometry, which is slow.

Differences of centring conventions, smooth over the field, are taken out of
every list with a cubic fitted on bright stars. The bound is that of the
star alone; it is read from ``bound.npy`` (x and y of each true star, with the
true PSF) or, without that file, made with our PSF, which is up to 10 %
smaller.

With ``--bars`` it needs no folders: it prints one table of what is asked of
crowded photometry and what is measured, in scenes simulated with this package
or, with ``--harness DIR --optics FILE``, with the optics of another simulator,
a folder with its modules csst_psf and csst_scene and a file of its optics: a
bulge field (``even``), a sloping sky (``plane``), clusters (``cluster``),
galaxies (``galaxy``), the PSF of the image's own stars (``own``), saturated
stars (``saturated``), and four images together (``images``).
"""
import argparse
import shutil
import tempfile
import warnings
from pathlib import Path

import crowded_area
import crowded_bars
import crowded_peers as peers
import numpy as np
from astropy.table import Table
from crowded_scores import (
    Scene,
    Score,
    complete_at,
    completeness_curve,
    make_psf,
    print_duel,
    print_score,
)

from photutils_mgauss import CrowdedMixturePhotometry

PARTS = ('peers', 'given', 'curve', 'area')
RATES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25)


def plain(result):
    names = {'x': 'x_fit', 'y': 'y_fit', 'flux': 'flux_fit',
             'x_err': 'x_err', 'y_err': 'y_err', 'flux_err': 'flux_err',
             'significance': 'significance'}
    table = Table({a: np.asarray(result[b], float)
                   for a, b in names.items()})
    return table[np.isfinite(table['x']) & (table['flux'] > 0)]


def reduce(psf, images, **kwargs):
    """Return our table of an image."""
    phot = CrowdedMixturePhotometry(psf)
    return plain(phot(images['sci'], error=images['err'],
                      mask=images['mask'], **kwargs))


def warm_up(psf, images):
    """Compile."""
    part = slice(64), slice(64)
    small = {name: image[part] for name, image in images.items()}
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        reduce(psf, small)


class Bench:
    """Scenes, PSFs and our own answers, made when first asked for."""

    def __init__(self, args, folder):
        self.args, self.folder = args, folder
        whole = Scene.load(args.crowded, args.crop)
        self.psf, seconds = peers.timed(make_psf, args.sparse, whole.origin,
                                        args.components, args.radius)
        print(f'PSF: {seconds:.1f} CPU s')
        warm_up(self.psf, whole.images)
        self.scene = whole.bounded(self.psf)
        self.small, self.tiny = (
            Scene.load(args.crowded, min(size, whole.size)).bounded(self.psf)
            for size in (args.small, args.tiny))
        self.sky = np.percentile(whole.images['sci'], 20)
        self._model = None
        self._ours = {}
        self._sextractor = None
        self._crowdsource = None

    def psfex(self):
        """Return the PSFEx model, None without PSFEx."""
        if self._model is None and peers.PSFEX:
            self._model = self._psfex()
        return self._model

    def _psfex(self):
        sparse = Scene.load(self.args.sparse)
        return peers.psfex_model(sparse, self.folder / 'psfex', np.subtract(
            sparse.origin, self.scene.origin))

    def ours(self, scene):
        """Return our list of a scene and CPU seconds."""
        if scene.size not in self._ours:
            self._ours[scene.size] = peers.timed(reduce, self.psf,
                                                 scene.images)
        return self._ours[scene.size]

    def sextractor(self):
        """Return SExtractor's lists of the scene and CPU seconds."""
        if self._sextractor is None:
            self._sextractor = {} if not peers.SEXTRACTOR else (
                peers.sextractor(self.scene.images['sci'],
                                 self.folder / 'sextractor', self.psfex()))
        return self._sextractor

    def crowdsource(self):
        """Return crowdsource's list of the small scene and CPU seconds."""
        if self._crowdsource is None:
            self._crowdsource = peers.crowdsource(
                self.args.crowdsource, self.small, self.psf,
                self.folder / 'crowdsource', self.sky)
        return self._crowdsource

    def start(self, scene, name='SExtractor WIN'):
        """Return SExtractor's list with some of its positions, in a scene."""
        table = self.sextractor()[name][0]
        n = scene.size - 1
        return table[(table['x'] > 0) & (table['y'] > 0) & (table['x'] < n)
                     & (table['y'] < n)]


def compare(name, scene, ours, other):
    """Print a peer's score and its duel with ours."""
    table, seconds = other
    score = Score.of(scene, table)
    print_score(f'{name} ({scene.size}^2, {seconds:.1f} CPU s)', score)
    print_duel(name, Score.of(scene, ours), score)


def peers_part(bench):
    """Each program finds its own stars."""
    table, seconds = bench.ours(bench.scene)
    print_score(f'ours ({bench.scene.size}^2, {seconds:.1f} CPU s)',
                Score.of(bench.scene, table))
    for name, other in bench.sextractor().items():
        compare(name, bench.scene, table, other)
    table, seconds = bench.ours(bench.small)
    if bench.args.crowdsource:
        other = bench.crowdsource()
        compare('crowdsource', bench.small, table, other)
        print(f'CPU seconds, {bench.small.size}^2: ours {seconds:.2f}, '
              f'crowdsource {other[1]:.1f}, ratio {other[1] / seconds:.1f}')
    compare('IterativePSFPhotometry', bench.tiny, bench.ours(bench.tiny)[0],
            peers.timed(peers.photutils_iterative, bench.tiny, bench.psf,
                        bench.sky))


def given_part(bench):
    """All programs on SExtractor's list."""
    if not bench.sextractor():
        return
    scene, start = bench.small, bench.start(bench.small)
    init = Table({f'{c}_init': start[c] for c in 'xy'})
    print("\nAll on SExtractor's list")
    table, seconds = peers.timed(reduce, bench.psf, scene.images,
                                 init_params=init)
    print_score(f'ours ({scene.size}^2, {seconds:.1f} CPU s)',
                Score.of(scene, table))
    lists = {**{name: (bench.start(scene, name), np.nan)
                for name in bench.sextractor()},
             'PSFPhotometry': peers.timed(peers.photutils_list, scene,
                                          bench.psf, bench.sky, start)}
    if peers.IRAF:
        lists['ALLSTAR'] = peers.timed(peers.daophot, scene,
                                       bench.folder / 'daophot', bench.sky,
                                       start)
    for name, other in lists.items():
        compare(name, scene, table, other)


def curve_part(bench):
    """Completeness over the rate of false stars at 24-25 mag."""
    lists = {'ours': (bench.scene, bench.ours(bench.scene)[0])}
    if bench.args.crowdsource:
        lists['ours, small'] = bench.small, bench.ours(bench.small)[0]
        lists['crowdsource'] = bench.small, bench.crowdsource()[0]
    print('\n24-25 mag: completeness at a rate of false stars of at most\n'
          + ' ' * 22 + ''.join(f'{rate:7.0%}' for rate in RATES))
    for name, (scene, table) in lists.items():
        for label, strength in (
                ('flux/err', table['flux'] / table['flux_err']),
                *([('significance', table['significance'])]
                  if 'significance' in table.colnames else [])):
            curve = completeness_curve(scene, table, strength)
            print(f'{name:12}{label:>13}' + ''.join(
                f'{complete_at(curve, rate):7.1%}' for rate in RATES))


def area_part(bench):
    """CPU seconds and memory of images of growing area, each a process."""
    args = bench.args
    print('\npixels a side; stars listed, and those brighter than 23 mag over '
          'the truth;\ntimes and peak memory, of which images and programs; '
          f'{args.threads} threads\n size    stars  < 23    '
          'CPU s  wall s  memory [GB]')
    seconds = []
    for size in args.sizes:
        folder = bench.folder / f'area{size}'
        if size <= bench.scene.size:
            limit = 10**(0.4 * (bench.scene.zero - crowded_area.LIMIT))
            truth = bench.scene.truth
            inside = (truth['x'] < size - 0.5) & (truth['y'] < size - 0.5)
            crowded_area.save(
                folder, {name: image[:size, :size] for name, image
                         in bench.scene.images.items()}, bench.psf, limit,
                int((inside & (truth['flux'] > limit)).sum()))
        else:
            crowded_area.run(
                folder, '--simulate', str(size), str(size), '--components',
                str(args.components), '--radius', str(args.radius))
        took = crowded_area.measure(folder, args.threads)
        shutil.rmtree(folder)
        seconds.append(took['cpu'])
        print(f'{size:5} {took["stars"]:8} {took["bright"]:5.1%} '
              f'{took["cpu"]:8.1f} {took["wall"]:7.1f}  {took["peak"]:.2f} of '
              f'which {took["start"]:.2f}', flush=True)
    if len(seconds) > 1:
        area = 2 * np.log(args.sizes)
        slope = np.polyfit(area, np.log(seconds), 1)[0]
        print(f'time grows as area to the power {slope:.2f}; the last gives '
              f'{seconds[-1] * 9216 * 9232 / args.sizes[-1]**2:.0f} CPU s for '
              '9216 x 9232')


def main():
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('crowded', nargs='?')
    parser.add_argument('sparse', nargs='?')
    parser.add_argument('--bars', nargs='*', choices=crowded_bars.PARTS)
    parser.add_argument('--harness', metavar='DIR')
    parser.add_argument('--optics', metavar='FILE')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--size', type=int, default=512)
    parser.add_argument('--own-size', type=int, default=768,
                        help='that of the scenes own and saturated')
    parser.add_argument('--images-size', type=int, default=400)
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=PARTS)
    parser.add_argument('--crop', type=int)
    parser.add_argument('--small', type=int, default=512)
    parser.add_argument('--tiny', type=int, default=256)
    parser.add_argument('--components', type=int, default=6)
    parser.add_argument('--radius', type=float, default=12)
    parser.add_argument('--crowdsource', metavar='PYTHON')
    parser.add_argument('--sizes', type=int, nargs='+',
                        default=[512, 1024, 2048])
    parser.add_argument('--threads', type=int, default=2)
    args = parser.parse_args()
    if args.bars is not None:
        args.bars = args.bars or crowded_bars.PARTS
        crowded_bars.run(args)
        return
    if not args.sparse:
        parser.error('give CROWDED and SPARSE, or --bars')
    peers.report_missing(args.crowdsource)
    parts = {'peers': peers_part, 'given': given_part, 'curve': curve_part,
             'area': area_part}
    with tempfile.TemporaryDirectory() as name:
        bench = Bench(args, Path(name))
        for part in PARTS:
            if part in args.parts:
                parts[part](bench)


if __name__ == '__main__':
    main()
