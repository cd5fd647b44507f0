"""Tables 1 and 2: what the simulations are told."""
from astropy.table import QTable
from astropy.time import Time
from settings import PIXEL
from store import Comparison, Figure, Group

from photutils_mgauss import Instrument, paper_exposures

# As printed; the field of view is 12 arcmin across.
TABLE_1 = {
    'gain': (1.1, 'electrons / ADU'),
    'pixel_scale': (0.074, 'arcsec / pixel'),
    'dark': (0.02, 'electrons / s / pixel'),
    'read_noise': (5.0, 'electrons'),
    'exposure_time': (150.0, 's'),
    'bias': (500.0, 'electrons / pixel'),
    'full_well': (90000.0, 'electrons'),
}
TABLE_2 = (
    ('2024-12-12T08:07:10', 24, 'i'), ('2026-05-30T17:27:18', 23, 'g'),
    ('2026-08-11T02:49:27', 8, 'g'), ('2026-08-11T05:50:40', 7, 'i'),
    ('2027-08-09T07:50:24', 24, 'i'), ('2027-08-09T09:19:18', 22, 'r'),
    ('2028-07-21T20:02:14', 9, 'r'))


def measure(run):
    """Return the defaults of the package as two tables."""
    return {'instrument': run.table('table1_instrument', _instrument),
            'exposures': run.table('table2_exposures', _exposures)}


def _instrument():
    camera = Instrument()
    return QTable({
        'parameter': list(TABLE_1),
        'value': [getattr(camera, name) for name in TABLE_1],
        'unit': [unit for _, unit in TABLE_1.values()]})


def _exposures():
    taken = paper_exposures()
    return QTable({'time': [one.time.utc.isot for one in taken],
                   'detector': [one.detector for one in taken],
                   'band': [one.band.name for one in taken]})


def _verdict(same):
    return 'equal' if same else 'differs'


def compare_instrument(tables):
    """Compare the camera."""
    lines = [_parameter(row) for row in tables['instrument']]
    side = Instrument().shape[1] * PIXEL / 60
    return [*lines, Comparison('field of a detector', "12' x 12' (11.3' in "
                               'the text)', f"{side:.1f}'", '')]


def _parameter(row):
    printed, unit = TABLE_1[row['parameter']]
    return Comparison(f'``{row["parameter"]}`` [{unit}]', f'{printed:g}',
                      f'{row["value"]:g}', _verdict(printed == row['value']))


def compare_exposures(tables):
    """Compare dates, detectors and bands."""
    return [_exposure(row, *printed) for row, printed in
            zip(tables['exposures'], TABLE_2, strict=True)]


def _exposure(row, time, detector, band):
    same = (abs(Time(row['time']) - Time(time)).sec < 1
            and row['detector'] == detector and row['band'] == band)
    return Comparison('exposure', f'{time}, #{detector:02d}, {band}',
                      f'{row["time"][:19]}, #{row["detector"]:02d}, '
                      f'{row["band"]}', _verdict(same))


GROUPS = (Group('tables', measure, (
    Figure('table1', 'Table 1: the instrument',
           'The defaults of ``Instrument``.', None, compare_instrument),
    Figure('table2', 'Table 2: the exposures',
           'Those of ``paper_exposures``.', None, compare_exposures)),
    ('table1_instrument', 'table2_exposures'), random=False),)
