"""
Damaged files: every reader gives a clean error or a value.

One small valid file of each kind is changed at random, with a seed, and read.
A clean error is a ValueError or OSError that names the file. Anything else
that is raised is unclean, more than 5 s is a hang, and more than 1 GB of
memory is refused by the system and counted. ::

    python tests/fuzz/campaign.py             500 cases
    python tests/fuzz/campaign.py --long      20 000 cases
    python tests/fuzz/campaign.py --keep DIR  writes what fails to a folder
"""
import argparse
import gzip
import io
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path

import asdf
import astropy.units as u
import gwcs
import numpy as np
from astropy.coordinates import ICRS
from astropy.io import fits
from astropy.modeling import models
from astropy.table import QTable, Table
from astropy.wcs import WCS
from gwcs import coordinate_frames
from photutils.psf import ImagePSF

import photutils_mgauss as mg
from photutils_mgauss.files import epsfs, image_layers
from photutils_mgauss.files.tables import read_table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from helpers import star_list_files

SEED = 20260101
LONGEST = 5.0
MEMORY = 2**30
OUTCOMES = ('clean error', 'equal', 'different', 'unclean', 'hang', 'memory')
BAD = ('unclean', 'hang', 'memory')

STEPS = np.arange(-10, 11) / 2


# The valid files.

def gaussian(sigma=1.2, steps=STEPS):
    profile = np.exp(-(steps**2) / 2 / sigma**2)
    return np.outer(profile, profile) / (2 * np.pi * sigma**2)


def mixture():
    return mg.GaussianMixture.from_stddevs(
        [0.6, 0.4], [(0, 0), (0.1, 0)], [(1, 1.1), (2, 2.2)], [0.1, 0])


def grid():
    return mg.GriddedMixturePSF(
        [mixture()] * 4, [(x, y) for y in (0, 9) for x in (0, 9)])


def field():
    return mg.MixtureField(
        np.zeros((1, 1, 6)), (3, 3), 2, np.ones((3, 3)),
        QTable({'x': [1.0], 'y': [2.0], 'used': [True], 'reason': ['']}))


def write_psfex(path):
    planes = np.stack([gaussian(), 0.1 * gaussian(2), 0.05 * gaussian(3)])
    hdus = [fits.PrimaryHDU()]
    for scale in (1, 2):
        column = fits.Column('PSF_MASK', f'{planes.size}E', dim=str(
            planes.shape[::-1]), array=scale * planes[None])
        table = fits.BinTableHDU.from_columns([column], name='PSF_DATA')
        table.header.update(
            POLNAXIS=2, POLNGRP=1, PSF_SAMP=0.5, PSFNAXIS=3, PSFAXIS1=21,
            PSFAXIS2=21, PSFAXIS3=3, POLNAME1='X_IMAGE', POLGRP1=1,
            POLZERO1=9.0, POLSCAL1=5.0, POLNAME2='Y_IMAGE', POLGRP2=1,
            POLZERO2=8.0, POLSCAL2=5.0, POLDEG1=1)
        hdus.append(table)
    fits.HDUList(hdus).writeto(path)


def write_stdpsf(path):
    hdu = fits.PrimaryHDU(np.array([gaussian()] * 8, 'f4'))
    hdu.header.update(NXPSFS=2, NYPSFS=4, IPSFX01=0, IPSFX02=99, JPSFY01=0,
                      JPSFY02=50, JPSFY03=50, JPSFY04=99)
    hdu.writeto(path)


def write_stpsf(path):
    hdu = fits.PrimaryHDU(np.array([gaussian()] * 4))
    hdu.header['OVERSAMP'] = hdu.header['DET_SAMP'] = 2
    for n in range(4):
        hdu.header[f'DET_YX{n}'] = str((99.0 * (n // 2), 99.0 * (n % 2)))
    hdu.writeto(path)


def write_calc_psf(path):
    hdus = [fits.PrimaryHDU(gaussian()), fits.ImageHDU(gaussian())]
    for hdu, name, sampling in zip(hdus, ('OVERSAMP', 'DET_SAMP'), (2, 1),
                                   strict=True):
        hdu.header.update(EXTNAME=name, OVERSAMP=sampling, DET_SAMP=sampling)
    fits.HDUList(hdus).writeto(path)


def write_images(path):
    hdus = [fits.ImageHDU(gaussian(width), name=f'EPSF{width}')
            for width in (1, 2)]
    primary = fits.PrimaryHDU()
    primary.header['OVERSAMP'] = 2
    fits.HDUList([primary, *hdus]).writeto(path)


def image_header():
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = 'RA---TAN-SIP', 'DEC--TAN-SIP'
    wcs.wcs.crval, wcs.wcs.crpix = (10, 20), (9, 8)
    wcs.wcs.cd = [[-1e-5, 0], [0, 1e-5]]
    header = wcs.to_header(relax=True)
    header.update({'A_ORDER': 2, 'B_ORDER': 2, 'A_2_0': 1e-6, 'B_0_2': 1e-6,
                   'BUNIT': 'electron', 'EXPTIME': 30.0, 'GAIN': 1.5,
                   'DATE-OBS': '2027-03-14T15:09:26'})
    return header


def write_layers(path):
    data = np.arange(20 * 16, dtype='f4').reshape(20, 16)
    header = image_header()
    fits.HDUList([
        fits.PrimaryHDU(), fits.ImageHDU(data, header, 'SCI'),
        fits.ImageHDU(np.sqrt(data + 1), name='ERR'),
        fits.ImageHDU(np.zeros(data.shape, 'i2'), name='DQ')]).writeto(path)


def small_gwcs():
    detector = coordinate_frames.Frame2D(name='detector')
    sky = coordinate_frames.CelestialFrame(reference_frame=ICRS(), name='sky')
    to_sky = (models.Shift(-8.0) & models.Shift(-9.0)
              | models.Scale(1e-5) & models.Scale(1e-5)
              | models.Pix2Sky_TAN()
              | models.RotateNative2Celestial(10.0, 20.0, 180.0))
    return gwcs.WCS([(detector, to_sky), (sky, None)])


def write_with_gwcs(path):
    """Write an image with its gwcs in an extension, as JWST does."""
    write_layers(path)
    buffer = io.BytesIO()
    asdf.AsdfFile({'meta': {'wcs': small_gwcs()}}).write_to(buffer)
    content = np.frombuffer(buffer.getvalue(), np.uint8)
    column = fits.Column('ASDF_METADATA', f'{content.size}B',
                         array=content[None])
    with fits.open(path, mode='append') as hdus:
        hdus.append(fits.BinTableHDU.from_columns([column], name='ASDF'))


def write_packed(path):
    data = np.arange(40 * 32, dtype='i2').reshape(40, 32)
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(
        data, image_header(), 'SCI')]).writeto(path)


def write_asdf_image(path):
    data = np.arange(30, dtype='f4').reshape(5, 6)
    asdf.AsdfFile({'roman': {
        'data': data, 'err': np.sqrt(data), 'dq': np.zeros((5, 6), 'u4'),
        'meta': {'telescope': 'ROMAN', 'exposure': {
            'exposure_time': 30.0, 'start_time': '2027-03-14T15:09:26'}}},
    }).write_to(path)


def stars():
    table = QTable({'id': [1, 2], 'x_fit': [3.5, 4.25], 'y_fit': [1.0, 2.0],
                    'ra': [10.0, 11.0] * u.deg, 'name': ['a', 'b']})
    table.meta['mgauss'] = {'command': 'photometry', 'options': {'ext': 1}}
    return table


def fits_stars():
    table = stars()
    table.meta = {'MGRUN': '{"command": "photometry"}'}
    return table


def write_packed_copy(write):
    def packed(path):
        plain = path.with_suffix('')
        write(plain)
        path.write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
        plain.unlink()
    return packed


# How they are read.

def read_any_psf(path):
    kind = epsfs.psf_kind(path)
    if kind == 'stdpsf':
        return epsfs.read_stdpsf(path, 'all')
    if kind == 'stpsf':
        return epsfs.read_stpsf(path, 'all')
    return epsfs.read_image_psf(path, ext='all')


def read_chips(path):
    return mg.read_psfex(path, ext='all')


def star_list(name):
    program, write = star_list_files.FILES[name]
    return write, lambda path: Table.read(path, format=f'mgauss.{program}')


def write_columns(path):
    path.write_text(star_list_files.DOLPHOT_COLUMNS)
    path.with_name('described').write_text(star_list_files.DOLPHOT)


def read_described(path):
    return Table.read(path.with_name('described'), format='mgauss.dolphot',
                      columns=path)


KINDS = {
    'grid.fits': (lambda p: grid().write(p), mg.GriddedMixturePSF.read),
    'grid.asdf': (lambda p: grid().write(p), mg.GriddedMixturePSF.read),
    'grid.fits.gz': (lambda p: grid().write(p), mg.GriddedMixturePSF.read),
    'mixture.fits': (lambda p: mixture().write(p), mg.GaussianMixture.read),
    'mixture.asdf': (lambda p: mixture().write(p), mg.GaussianMixture.read),
    'model.asdf': (lambda p: mg.MultiGaussianPSFModel(mixture()).write(p),
                   mg.MultiGaussianPSFModel.read),
    'model.fits': (lambda p: mg.MultiGaussianPSFModel(mixture()).write(p),
                   mg.MultiGaussianPSFModel.read),
    'field.asdf': (lambda p: field().write(p), mg.MixtureField.read),
    'field.fits': (lambda p: field().write(p), mg.MixtureField.read),
    'chips.psf': (write_psfex, read_chips),
    'chips.psf.gz': (write_packed_copy(write_psfex), read_chips),
    'stdpsf.fits': (write_stdpsf, read_any_psf),
    'stdpsf.fits.gz': (write_packed_copy(write_stdpsf), read_any_psf),
    'stpsf.fits': (write_stpsf, read_any_psf),
    'calc_psf.fits': (write_calc_psf, read_any_psf),
    'epsfs.fits': (write_images, read_any_psf),
    'image.fits': (write_layers, image_layers.read_layers),
    'image.fits.fz': (write_packed, image_layers.read_layers),
    'gwcs.fits': (write_with_gwcs, image_layers.read_layers),
    'image.asdf': (write_asdf_image, image_layers.read_layers),
    'wcs.fits': (write_layers, image_layers.read_wcs),
    'stars.ecsv': (lambda p: stars().write(p), read_table),
    'stars.xml': (lambda p: stars().write(p, format='votable'), read_table),
    'stars.fits': (lambda p: fits_stars().write(p), read_table),
    'alone.columns': (write_columns, read_described),
    **{name: star_list(name) for name in star_list_files.FILES},
}
TEXTS = ('.asdf', '.ecsv', '.xml', '.als', '.ap', '.coo', '.lis', '.cat',
         '.xymq', '.columns', 'phot')


# What happens to them.

NUMBERS = ('0', '-1', '1', '3', '1000000000', '2147483648',
           '9223372036854775807', '99999999999999999999', '1.5', 'NaN',
           '1E999', 'T', "'text'", "''", '')


def truncate(content, rng):
    return content[:rng.integers(len(content))]


def flip(content, rng):
    changed = np.frombuffer(content, np.uint8).copy()
    where = rng.integers(changed.size, size=rng.integers(1, 9))
    changed[where] ^= (1 << rng.integers(8, size=where.size)).astype('u1')
    return changed.tobytes()


def overwrite(content, rng):
    start = rng.integers(len(content))
    size = int(rng.integers(1, 300))
    filler = (bytes(size), b'\xff' * size, rng.bytes(size),
              b'\x8a' * min(size, 3))[rng.integers(4)]
    return content[:start] + filler + content[start + len(filler):]


def cut(content, rng):
    start, stop = np.sort(rng.integers(len(content), size=2))
    return content[:start] + content[stop:]


def repeat(content, rng):
    start, stop = np.sort(rng.integers(len(content), size=2))
    return content[:stop] + content[start:]


def change_card(content, rng):
    """Change a card of a FITS header."""
    cards = [i for i in range(0, len(content), 80)
             if re.match(rb'[A-Z0-9_-]{1,8} *= ', content[i:i + 10])]
    if not cards:
        return change_word(content, rng)
    at = cards[rng.integers(len(cards))]
    card = content[at:at + 80]
    what = rng.integers(5)
    if what == 0:
        new = b' ' * 80
    elif what == 1:
        new = card[:rng.integers(8)] + b'X' + card[8:]
    elif what == 2:
        other = cards[rng.integers(len(cards))]
        new = card[:10] + content[other + 10:other + 80]
    else:
        new = card[:10] + NUMBERS[rng.integers(len(NUMBERS))].rjust(
            20).encode()
    return content[:at] + new[:80].ljust(80) + content[at + 80:]


def change_word(content, rng):
    """Change a word or a line of a text, as far as the file is one."""
    words = list(re.finditer(rb'[\w.+-]+', content[:20000]))
    if not words:
        return b''
    word = words[rng.integers(len(words))]
    new = (*(number.encode() for number in NUMBERS), b'!!binary x', b'*a',
           b'&a [*a]', b'[' * 3000, b'{', b'\t', b'- ', b'~', b'.inf')
    return (content[:word.start()] + new[rng.integers(len(new))]
            + content[word.end():])


def drop_line(content, rng):
    lines = content.split(b'\n')
    del lines[rng.integers(len(lines))]
    return b'\n'.join(lines)


def inside(content, rng):
    """Change what is compressed, and compress it again."""
    changed = change_card(gzip.decompress(content), rng)
    return gzip.compress(changed, mtime=0)


def empty(content, rng):
    return b''


COMMON = (truncate, flip, flip, overwrite, cut, repeat)


def changes_for(name):
    if name.endswith('.gz'):
        return (*COMMON, inside, inside, inside)
    if name.endswith(TEXTS):
        return (*COMMON, *4 * (change_word,), drop_line, drop_line)
    return (*COMMON, *8 * (change_card,))


# What comes of it.

class Hang(BaseException):
    """More than 5 seconds; no reader may catch it."""


def astuple_of(value):
    return [getattr(value, one.name) for one in fields(value)]


def tables_of(value):
    return value._to_tables()


def words_of(wcs):
    return [str(wcs), str(wcs.sip and [wcs.sip.a, wcs.sip.b])]


def parts_of(layers):
    cards = layers.cards
    return [layers.data, layers.error, layers.flags, layers.wcs, cards.unit,
            cards.time, cards.exposure_time]


# What the values of a type are compared by.
PARTS = {
    image_layers.Layers: parts_of,
    ImagePSF: lambda psf: [psf.data, psf.oversampling],
    WCS: words_of,
    gwcs.WCS: lambda wcs: [*wcs(3, 4), wcs.output_frame],
    Table: lambda table: [dict(table.items()), dict(table.meta)],
    u.Quantity: lambda quantity: [quantity.unit, quantity.value],
    np.ndarray: lambda array: [array.shape, array.dtype, str(array.tolist())],
    dict: lambda values: [[key, values[key]] for key in values],
    epsfs.EPSFGrid: astuple_of,
    mg.PSFExModel: astuple_of,
    mg.GriddedMixturePSF: tables_of,
    mg.GaussianMixture: tables_of,
    mg.MultiGaussianPSFModel: tables_of,
    mg.MixtureField: tables_of,
}


def plain(value):
    """Return all numbers and words of a value, to be compared."""
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    for kind, parts in PARTS.items():
        if isinstance(value, kind):
            return plain(parts(value))
    return str(value)


@contextmanager
def limits(seconds, memory):
    """Limit the time and the memory of what is done."""
    def stop(*_):
        raise Hang
    before = signal.signal(signal.SIGALRM, stop)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (
        pages * resource.getpagesize() + memory, hard))
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGALRM, before)


def is_clean(error, path):
    named = path.name in str(error) or (
        isinstance(error, OSError) and error.filename is not None)
    return isinstance(error, ValueError | OSError) and named


def was_memory(error):
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def outcome(path, read, truth):
    """Read a file; return what came of it, and the words for it."""
    try:
        with limits(LONGEST, MEMORY), warnings.catch_warnings():
            warnings.simplefilter('ignore')
            value = plain(read(path))
    except Hang:
        return 'hang', traceback.format_exc()
    except Exception as error:  # noqa: BLE001 - whatever readers raise
        if was_memory(error):
            return 'memory', traceback.format_exc()
        if is_clean(error, path):
            return 'clean error', str(error)
        return 'unclean', traceback.format_exc()
    return ('equal' if value == truth else 'different'), ''


def run(n_cases, seed=SEED, keep=None, kinds=KINDS):
    """
    Read n damaged files; return the outcomes by kind, and the failures.

    The cases are spread evenly over all kinds. In each kind the first are
    an empty file, a folder, and the files of two other kinds.
    """
    table = {name: Counter() for name in kinds}
    failures = []
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        originals = write_all(folder, KINDS)
        for k, name in enumerate(kinds):
            path, read = folder / name, KINDS[name][1]
            path.write_bytes(originals[name])
            truth = plain(read(path))
            share = (n_cases + k) // len(kinds)
            for i in range(share):
                rng = np.random.default_rng([seed, list(KINDS).index(name), i])
                content = damaged(i, name, originals, rng)
                found, words = read_damaged(path, content, read, truth)
                table[name][found] += 1
                if found in BAD:
                    failures.append(f'{name} case {i}: {found}\n{words}')
                    if keep and content is not None:
                        (Path(keep) / f'{i}_{name}').write_bytes(content)
    return table, failures


def write_all(folder, kinds):
    """Return the content of the valid file of each kind."""
    contents = {}
    for name, (write, _) in kinds.items():
        write(folder / name)
        contents[name] = (folder / name).read_bytes()
        (folder / name).unlink()
    return contents


def damaged(i, name, originals, rng):
    """Return the content of case i, None for a folder."""
    if i < 2:
        return (b'', None)[i]
    if i < 4:
        others = [other for other in originals if other != name]
        return originals[others[rng.integers(len(others))]]
    changes = changes_for(name)
    return changes[rng.integers(len(changes))](originals[name], rng)


def read_damaged(path, content, read, truth):
    """Put the content into the file and read it."""
    path.unlink()
    if content is None:
        path.mkdir()
    else:
        path.write_bytes(content)
    try:
        return outcome(path, read, truth)
    finally:
        if content is None:
            shutil.rmtree(path)
            path.touch()


def describe(table):
    """Return the table as text."""
    out = io.StringIO()
    heads = ('cases', *OUTCOMES)
    out.write(f'{"kind":16}' + ''.join(f'{head:>13}' for head in heads) + '\n')
    total = sum(table.values(), Counter())
    for name, counts in (*table.items(), ('all', total)):
        numbers = (counts.total(), *(counts[one] for one in OUTCOMES))
        out.write(f'{name:16}' + ''.join(f'{n:13}' for n in numbers) + '\n')
    return out.getvalue()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--long', action='store_true')
    parser.add_argument('--cases', type=int)
    parser.add_argument('--seed', type=int, default=SEED)
    parser.add_argument('--kinds', nargs='+', default=list(KINDS))
    parser.add_argument('--keep', metavar='DIR')
    options = parser.parse_args()
    began = time.monotonic()
    table, failures = run(
        options.cases or (20_000 if options.long else 500), options.seed,
        options.keep, options.kinds)
    sys.stdout.write('\n'.join([*failures, describe(table)]))
    sys.stdout.write(f'{time.monotonic() - began:.0f} s\n')
    return 1 if failures else 0


if __name__ == '__main__':
    sys.exit(main())
