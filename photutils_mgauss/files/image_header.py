"""What the header of an image says of its unit, its noise and its time."""
import re

import astropy.units as u
import numpy as np
from astropy.io.fits.card import Undefined
from astropy.io.fits.verify import VerifyError
from astropy.time import Time
from erfa import ErfaError

_GAIN = ('GAIN', 'EGAIN', 'ATODGAIN', 'CCDGAIN')
_READ_NOISE = ('RDNOISE', 'READNOIS', 'RON', 'READNSEA')
_EXPOSURE_TIME = ('EXPTIME', 'XPOSURE', 'EFFEXPTM', 'TEXPTIME', 'EXPOSURE')
# MJy/sr for one DN/s.
_CONVERSION = ('PHOTMJSR', 'FLUXCONV')
_START = ('EXPSTART', 'MJD-BEG', 'MJD-OBS')
# The outputs of ESO's detectors: electrons in a count, its inverse, and the
# noise of the readout; and by how much the first two may disagree.
_OUTPUT = 'ESO DET OUT{} {}'
_MOST_OUTPUTS = 64
_DISAGREE = 0.1
_SATURATION = ('SATURATE', 'SATLEVEL', 'SATURAT')

# Numbers in headers are smaller, which leaves out infinity.
_HUGE = 1e300

# Modified Julian dates of the years 1000 and 3000: no image is older or
# newer.
_OLDEST, _NEWEST = -313_000, 455_000

# Spellings of what detectors count, and of "each second".
_COUNTED = {'e': u.electron, 'e-': u.electron, 'electron': u.electron,
            'electrons': u.electron, 'adu': u.adu, 'dn': u.DN,
            'count': u.count, 'counts': u.count}
# How times are written as numbers, and between which they are (1858 to 2131).
_NUMBER = re.compile(r'(JD|MJD|J)?\s*=?\s*(\d+\.?\d*(?:E\+?\d+)?)')
_RANGES = {'jd': (2_400_000.5, 2_500_000), 'mjd': (15_000, 99_999.5),
           'jyear': (1858, 2200)}
_PREFIX = {'jd': 'JD', 'mjd': 'MJD', 'jyear': 'J'}
# Day, month and year of the twentieth century, as FITS had dates before 1999;
# no camera with pixels is older than 1970.
_OLD_DATE = re.compile(r'^(\d\d)/(\d\d)/([7-9]\d)$')
_SLASHES = re.compile(r'^(\d{4})/(\d\d)/(\d\d)')
# A number in a card of text.
_TEXT_NUMBER = re.compile(
    r'[+-]?(\d+\.?\d*|\.\d+)([ED][+-]?\d+)?', re.IGNORECASE)
_RATE = re.compile(r'(.+?)(?:/s(?:ec)?|\*?\*?s(?:\^|\*\*)?-1)')


def _positive(keys, words):
    """Return a property of `Cards`: the first number, if positive."""
    return property(lambda cards: cards.positive(*keys), doc=words)


class Cards:
    """
    The headers that hold for an image, the most special one first.

    Parameters
    ----------
    *headers : mapping
        Of keywords and values.
    """

    def __init__(self, *headers):
        self._headers = headers

    def get(self, *keys):
        """Return the first value there is for any of the keys, or None."""
        for key in keys:
            for header in self._headers:
                value = _value(header, key)
                if value not in (None, '') and not isinstance(value,
                                                              Undefined):
                    return value
        return None

    def check(self):
        """Raise if what an image is read with cannot be read."""
        for name in ('unit', 'gain', 'read_noise', 'exposure_time',
                     'saturation', 'removed_sky', 'telescope', 'time'):
            getattr(self, name)

    def number(self, *keys):
        """Return the first finite number there is, or None."""
        for key in keys:
            value = _from_text(self.get(key))
            if (isinstance(value, (int, float, np.number))
                    and not isinstance(value, bool) and abs(value) < _HUGE):
                return float(value)
        return None

    @property
    def gain(self):
        """
        Electrons in a count, or None.

        Of ESO's outputs it is None unless all have the same; see
        `gain_problem`.
        """
        gains = self._output_gains
        return self.positive(*_GAIN) or (
            gains[0] if len(set(gains)) == 1 and not self._contradicts
            else None)

    @property
    def gain_problem(self):
        """Why gains that a header has are not used, '' if they are."""
        gains = self._output_gains
        given = self.get(*_GAIN)
        if self.gain is not None or not (gains or given):
            return ''
        if not gains:
            return f'its keyword of the gain is {given!r}, no positive number'
        if self._contradicts:
            return ('its keywords ESO DET OUTn CONAD and GAIN are not the '
                    'inverse of each other')
        return ('its outputs have different gains (ESO DET OUTn CONAD): '
                + ', '.join(f'{one:g}' for one in sorted(set(gains))))

    @property
    def read_noise(self):
        """The noise of the readout [electron], or None; see `gain`."""
        noises = self._output_noises
        return self.positive(*_READ_NOISE) or (
            noises[0] if len(noises) == 1 else None)

    @property
    def read_noise_problem(self):
        """Why read noises that a header has are not used, '' if they are."""
        noises = self._output_noises
        if self.read_noise is not None or not noises:
            return ''
        return ('its outputs have different read noises (ESO DET OUTn RON): '
                + ', '.join(f'{one:g}' for one in noises))

    @property
    def _output_noises(self):
        return sorted({noise for noise in self._outputs('RON') if noise})

    def _outputs(self, word):
        """Return a number of each of ESO's outputs, None if it has none."""
        return [self.positive(_OUTPUT.format(n, word))
                for n in range(1, _MOST_OUTPUTS + 1)]

    @property
    def _output_gains(self):
        return [electrons or 1 / counts for electrons, counts in zip(
            self._outputs('CONAD'), self._outputs('GAIN'), strict=True)
            if electrons or counts]

    @property
    def _contradicts(self):
        """Whether the two gains of one output cannot both be right."""
        return any(electrons and counts
                   and abs(electrons * counts - 1) > _DISAGREE
                   for electrons, counts in zip(
                       self._outputs('CONAD'), self._outputs('GAIN'),
                       strict=True))

    exposure_time = _positive(_EXPOSURE_TIME, 'The exposure time [s].')
    conversion = _positive(_CONVERSION, 'MJy/sr for a count each second.')
    saturation = _positive(
        _SATURATION, 'The level from which pixels are saturated, in the '
        "image's unit.")

    def positive(self, *keys):
        """Return the first number if it is positive, else None."""
        value = self.number(*keys)
        return value if value is not None and value > 0 else None

    @property
    def unit(self):
        """The unit of the image, or None."""
        text = self.get('BUNIT')
        return None if text is None else parse_unit(str(text))

    @property
    def pixel_area(self):
        """The area of a pixel, a `~astropy.units.Quantity`, or None."""
        area = self.positive('PIXAR_SR')
        return None if area is None else area * u.sr

    @property
    def removed_sky(self):
        """
        The level of a sky that is known and no longer in the image.

        MDRIZSKY is only a note in HST's single exposures, and what was taken
        away from drizzled images.
        """
        drizzled = self.get('NDRIZIM') is not None or self.get(
            'DRIZCORR') == 'COMPLETE'
        return (self.positive('MDRIZSKY') or 0.0) if drizzled else 0.0

    @property
    def telescope(self):
        """The name of the telescope, upper case."""
        return str(self.get('TELESCOP') or '').strip().upper()

    @property
    def _scale(self):
        scale = str(self.get('TIMESYS') or 'utc').strip().lower()
        return scale if scale in Time.SCALES else 'utc'

    @property
    def time(self):
        """The middle of the exposure, a `~astropy.time.Time`, or None."""
        for find in (_middle, _middle_of_limits, _start_and_length):
            time = _believable(find, self, self._scale)
            if time is not None:
                return time
        return None

    @property
    def has_only_a_day(self):
        """Whether the time of the exposure is a date without its hour."""
        if any(_believable(find, self, self._scale) is not None
               for find in (_middle, _middle_of_limits)):
            return False
        date = _date_text(self)
        return (self.number(*_START) is None and date is not None
                and ':' not in str(date))

    def time_at(self, key):
        """
        Return the time that a keyword of the user's choice has.

        It may be a date, as 2027-03-14T15:09 or 2027-073T15:09, or a
        Julian date, a modified one, or a Julian year, also with JD, MJD or J
        before it.

        Raises
        ------
        ValueError
            If there is no such keyword, or no time in it.
        """
        value = self.get(key)
        if value is None:
            msg = f'the keyword {key} must have the time, but is not there'
            raise ValueError(msg)
        try:
            return any_time(value, self._scale)
        except ValueError as error:
            msg = f'the keyword {key} must have a time: {error}'
            raise ValueError(msg) from error


def _from_text(value):
    """Return the number that a text is, or the value as it is."""
    if isinstance(value, str) and _TEXT_NUMBER.fullmatch(value.strip()):
        return float(value.upper().replace('D', 'E'))
    return value


def _value(header, key):
    try:
        return header.get(key)
    except VerifyError as error:
        msg = f'the keyword {key} has a value that cannot be read'
        raise ValueError(msg) from error


def parse_unit(text):
    """Return the unit a header's word stands for, or None."""
    word = text.strip().lower().replace(' ', '')
    rate = _RATE.fullmatch(word)
    counted = _COUNTED.get(rate.group(1) if rate else word)
    if counted is not None:
        return counted / u.s if rate else counted
    unit = u.Unit(text.strip(), parse_strict='silent')
    return None if isinstance(unit, u.UnrecognizedUnit) else unit


def is_surface_brightness(unit):
    """Return whether a unit is that of MJy/sr."""
    return unit is not None and unit.is_equivalent(u.MJy / u.sr)


def electrons_in_unit(unit, gain, exposure_time, conversion=None):
    """
    Return the electrons in one unit of an image, None if that is unknown.

    Parameters
    ----------
    unit : `~astropy.units.UnitBase` or None
        An image without unit is taken to hold counts.
    gain : float or None
        Electrons in a count.
    exposure_time : float or None
        In seconds.
    conversion : float, optional
        MJy/sr for a count each second, for an image of surface brightness.
    """
    unit = u.adu if unit is None else unit
    if is_surface_brightness(unit):
        known = gain and exposure_time and conversion
        return known and (gain * exposure_time / conversion
                          * unit.to(u.MJy / u.sr))
    for counted in set(_COUNTED.values()):
        each = 1.0 if counted is u.electron else gain
        if unit == counted:
            return each
        if unit == counted / u.s:
            return each and exposure_time and each * exposure_time
    return None


def _believable(find, cards, scale):
    """Return the time that is found, None for what is no time of an image."""
    try:
        time = find(cards, scale)
    except ErfaError:
        # Of dates far away erfa does not know the leap seconds.
        return None
    return (time if time is not None and _OLDEST < time.mjd < _NEWEST
            else None)


def any_time(value, scale):
    """Return the time that a number or text can only mean."""
    try:
        return _read_time(value, scale)
    except ValueError as error:
        msg = f'must be a date, a Julian date or a Julian year, got {value!r}'
        raise ValueError(msg) from error


def _read_time(value, scale):
    text = str(value).strip().upper()
    number = _NUMBER.fullmatch(text)
    if number is None:
        # The day of the year, which astropy reads with colons only.
        text = re.sub(r'^(\d{4}-\d{3})T', lambda day: day[1].replace(
            '-', ':') + ':', text)
        return Time(text, scale=scale)
    days = float(number[2])
    kinds = [kind for kind, (low, high) in _RANGES.items()
             if low < days < high and number[1] in (None, _PREFIX[kind])]
    if not kinds:
        raise ValueError(text)
    kind, = kinds
    # A Julian year is a rate of time of its own.
    return Time(days, format=kind,
                scale='tdb' if kind == 'jyear' else scale)


def _middle(cards, scale):
    mjd = cards.number('MJD-AVG', 'EXPMID', 'MJD-MID')
    if mjd is not None:
        return Time(mjd, format='mjd', scale=scale)
    return _date(cards.get('DATE-AVG', 'DATE-MID'), scale)


def _middle_of_limits(cards, scale):
    for first, last in (('EXPSTART', 'EXPEND'), ('MJD-BEG', 'MJD-END')):
        start, end = cards.number(first), cards.number(last)
        if start is not None and end is not None:
            return Time((start + end) / 2, format='mjd', scale=scale)
    start, end = (_date(cards.get(key), scale)
                  for key in ('DATE-BEG', 'DATE-END'))
    if start is None or end is None:
        return None
    return start + (end - start) / 2


def _start_and_length(cards, scale):
    mjd = cards.number(*_START)
    start = (Time(mjd, format='mjd', scale=scale) if mjd is not None
             else _date(_date_text(cards), scale))
    if start is None:
        return None
    return start + (cards.exposure_time or 0.0) / 2 * u.s


def _date_text(cards):
    date = cards.get('DATE-BEG', 'DATE-OBS')
    time = cards.get('TIME-OBS', 'UTC-OBS', 'UTSTART', 'UT', 'UTC')
    if date is None or 'T' in str(date):
        return date
    date = _OLD_DATE.sub(r'19\3-\2-\1', str(date).strip())
    date = _SLASHES.sub(r'\1-\2-\3', date)
    if time is None:
        return date
    return f'{date}T{str(time).strip()}'


def _date(text, scale):
    if text is None:
        return None
    try:
        return Time(str(text).strip(), scale=scale)
    except ValueError:
        return None
