"""
Long commands killed at random moments, and given again until they end.

    python tests/benchmarks/kill_and_resume.py --kills 20

Three kinds of work are killed (-9) in turn: the tiles of a crowded image,
images to PSFs, catalogues and motions, and the nodes of a PSF file. In the
end every number must be that of a run nobody disturbed.
"""
import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import QTable

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.kills import run_with_kills
from photutils_mgauss import GaussianMixture, GriddedMixturePSF

SIZE = 1500
MIXTURE = GaussianMixture.from_stddevs(
    [0.7, 0.3], np.zeros((2, 2)), [(1.1, 1.2), (2.0, 2.1)], [0.1, 0])
EASY = ['--n-components', '3', '--degree', '1', '--transform', 'shift']
WORK = {
    'crowded tiles': ['photometry', '1.fits', '2.fits', '--crowded', '--psf',
                      'psf.fits'],
    'images to motions': ['motions', '1.fits', '2.fits', '3.fits', *EASY],
    'nodes of a PSF': ['psf', 'model.psf', '--grid-shape', '14', '14',
                       '--n-components', '4']}


def write_files(folder, rng):
    """Write three images, their PSF, and a PSFEx model of it."""
    x, y = rng.uniform(5, SIZE - 5, (2, 6000))
    flux = 10 ** rng.uniform(3, 5, x.size)
    psf = GriddedMixturePSF([MIXTURE], [(0, 0)])
    psf.write(folder / 'psf.fits')
    from photutils_mgauss import render_stars
    for number in (1, 2, 3):
        data = 100 + render_stars(psf, x + 0.1 * number, y, flux,
                                  (SIZE, SIZE))
        hdu = fits.PrimaryHDU(rng.poisson(data).astype('f4'))
        hdu.header.update({
            'GAIN': 1.0, 'BUNIT': 'adu', 'DATE-OBS': f'{2026 + number}-01-01',
            'EXPTIME': 1.0, 'CTYPE1': 'RA---TAN', 'CTYPE2': 'DEC--TAN',
            'CRVAL1': 150.0, 'CRVAL2': 2.0, 'CRPIX1': 750.0,
            'CRPIX2': 750.0, 'CDELT1': -2e-5, 'CDELT2': 2e-5})
        hdu.writeto(folder / f'{number}.fits')
    write_psfex(folder / 'model.psf')


def write_psfex(path):
    """Write a PSFEx model that depends linearly on x and y."""
    planes = [MIXTURE.render((25, 25), 12, 12)]
    planes += [1e-3 * plane for plane in np.gradient(planes[0])]
    column = fits.Column('PSF_MASK', f'{25 * 25 * 3}E', dim='(25,25,3)',
                         array=np.array([planes], np.float32))
    hdu = fits.BinTableHDU.from_columns([column], name='PSF_DATA')
    hdu.header.update({
        'POLNAXIS': 2, 'POLNGRP': 1, 'POLDEG1': 1, 'PSFNAXIS': 3,
        'PSFAXIS1': 25, 'PSFAXIS2': 25, 'PSFAXIS3': 3, 'PSF_SAMP': 1.0,
        'PSF_FWHM': 3.0, 'CHI2': 1.0, 'LOADED': 9, 'ACCEPTED': 9})
    for n, name in ((1, 'X_IMAGE'), (2, 'Y_IMAGE')):
        hdu.header.update({f'POLNAME{n}': name, f'POLGRP{n}': 1,
                           f'POLZERO{n}': SIZE / 2, f'POLSCAL{n}': SIZE})
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)


def differences(one, other):
    """Return the names of files whose numbers are not all the same."""
    names = sorted(path.name for path in one.iterdir())
    if names != sorted(path.name for path in other.iterdir()):
        return ['other files']
    return [name for name in names
            if not same(arrays(one / name), arrays(other / name))]


def same(one, other):
    """Whether two lists of arrays are equal, number by number."""
    return all(np.array_equal(a, b, equal_nan=a.dtype.kind == 'f')
               for a, b in zip(one, other, strict=True))


def arrays(path):
    """Return all numbers of a file as arrays."""
    if path.suffix == '.ecsv':
        return [np.asarray(getattr(column, 'value', column))
                for column in QTable.read(path).itercols()]
    with fits.open(path) as hdus:
        return [np.array(hdu.data[name]) for hdu in hdus[1:]
                for name in hdu.columns.names]


def main():
    """Run all kinds of work and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--kills', type=int, default=20)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    shares = np.array_split(np.arange(options.kills), len(WORK))
    bad = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_files(folder, np.random.default_rng(options.seed))
        for (kind, words), share in zip(WORK.items(), shares, strict=True):
            begun = time.monotonic()
            run_with_kills([*words, '--output', 'whole/'], folder, n_kills=0,
                           seconds=0, seed=0)
            seconds = time.monotonic() - begun
            kills, wrong = [], []
            while sum(kills) < len(share):
                place = f'{len(kills)} of {kind}'
                kills.append(run_with_kills(
                    [*words, '--output', f'parts {place}/', '--checkpoint',
                     f'kept {place}'], folder, seconds=seconds,
                    n_kills=len(share) - sum(kills),
                    seed=options.seed + len(kills)))
                wrong += differences(folder / 'whole',
                                     folder / f'parts {place}')
            bad += len(wrong)
            print(f'{kind}: {seconds:.0f} s, killed {sum(kills)} times in '
                  f'{len(kills)} runs, '
                  f'{"different: " + ", ".join(wrong) if wrong else "equal"}',
                  flush=True)
            (folder / 'whole').rename(folder / f'whole of {kind}')
    return bad


if __name__ == '__main__':
    sys.exit(main() > 0)
