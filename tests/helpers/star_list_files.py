"""One small star list of each program, as the program writes it."""
import numpy as np
from astropy.io import fits

DOLPHOT_COLUMNS = """\
1. Extension (zero for base image)
2. Chip (for three-dimensional FITS image)
3. Object X position on reference image (or first image, if no reference)
4. Object Y position on reference image (or first image, if no reference)
5. Chi for fit
6. Signal-to-noise
7. Object sharpness
8. Object roundness
9. Direction of major axis (if not round)
10. Crowding
11. Object type (1=bright star, 2=faint, 3=elongated, 4=hot pixel, 5=extended)
12. Total counts, WFC3_F606W
13. Total sky level, WFC3_F606W
14. Normalized count rate, WFC3_F606W
15. Normalized count rate uncertainty, WFC3_F606W
16. Instrumental VEGAMAG magnitude, WFC3_F606W
17. Transformed UBVRI magnitude, WFC3_F606W
18. Magnitude uncertainty, WFC3_F606W
19. Chi, WFC3_F606W
20. Signal-to-noise, WFC3_F606W
21. Instrumental VEGAMAG magnitude, WFC3_F814W
22. Magnitude uncertainty, WFC3_F814W
23. Measured counts, ib1.chip1 (WFC3_F606W, 350.0 sec)
24. Instrumental VEGAMAG magnitude, ib1.chip1 (WFC3_F606W, 350.0 sec)
"""
DOLPHOT = (
    '0 1 10.75 21.00 1.1 98.7 0.01 0.02 90 0.05 1 5550.0 10.0 55.5 0.55 '
    '20.1 20.0 0.011 1.2 97.5 19.2 0.012 5550.0 20.1\n'
    '0 1 30.50 41.00 1.0 20.4 0.03 0.04 12 0.15 1 270.0 10.0 2.7 0.13 '
    '23.4 23.3 0.052 1.1 20.1 99.999 9.999 270.0 23.4\n')
HEAD = """\
 NL    NX    NY  LOWBAD HIGHBAD  THRESH     AP1  PH/ADU  RNOISE    FRAD
  {}  2048  2048    50.0 32000.0   20.00    3.00    2.00    5.00     4.0

"""
ALS = HEAD.format(1) + """\
      7   11.250   21.500   14.250   0.0100   101.50     4.     0.95   0.010
      9   31.000   41.000   15.500   0.0300   102.50     5.     1.10  -0.020
"""
COO = HEAD.format(1) + """\
      1   11.250   21.500   -3.000    0.600    0.100   -0.050
      2   31.000   41.000   -1.500    0.650   -0.100    0.020
"""
AP = HEAD.format(2) + """\

      1   11.250   21.500   15.000   14.900
      101.500  5.00  0.10   0.0100   0.0090

      2   31.000   41.000   16.000   99.999
      102.500  5.10  0.20   0.0200   9.9999
"""
IRAF_ALS = r"""#K IRAF       = NOAO/IRAFV2.16.1        version    %-23s
#K TASK       = allstar                 name       %-23s
#
#N ID    XCENTER   YCENTER   MAG         MERR          MSKY           NITER    \
#U ##    pixels    pixels    magnitudes  magnitudes    counts         ##       \
#F %-9d  %-10.3f   %-10.3f   %-12.3f     %-14.3f       %-15.7g        %-6d
#
#N         SHARPNESS   CHI         PIER  PERROR                                \
#U         ##          ##          ##    perrors                               \
#F         %-23.3f     %-12.3f     %-6d  %-13s
#
7        11.250    21.500    14.250      0.010         101.5          4        \
           0.010       0.950       0     No_error
9        31.000    41.000    15.500      0.030         102.5          5        \
           -0.020      1.100       0     No_error
"""  # noqa: E501 - lines of 80 characters, as IRAF writes them
LIS = """\
star_a         12.150  2015.557    10.250    20.500   0.004   0.008    522.5 \
0.99  10   3666150
star_b         15.079  2015.557    30.000    40.000   0.010   0.014     22.5 \
0.98   9    246918
"""
ASCII_HEAD = """\
#   1 NUMBER                 Running object number
#   2 XWIN_IMAGE             Windowed position estimate along x       [pixel]
#   3 YWIN_IMAGE             Windowed position estimate along y       [pixel]
#   4 ERRAWIN_IMAGE          RMS windowed pos error along major axis  [pixel]
#   5 ERRBWIN_IMAGE          RMS windowed pos error along minor axis  [pixel]
#   6 ERRTHETAWIN_IMAGE      Windowed error ellipse pos angle         [deg]
#   7 FLUX_AUTO              Flux within a Kron-like aperture         [count]
#   8 FLUXERR_AUTO           RMS error for AUTO flux                  [count]
#   9 MAG_AUTO               Kron-like elliptical aperture magnitude  [mag]
#  10 FLAGS                  Extraction flags
         1    11.2500    21.5000  0.05  0.02  30.0  15849.0  10.0  -10.5  0
         2    31.0000    41.0000  0.10  0.10   0.0   3981.0  11.0   -9.0  0
"""


def write_dolphot(path):
    path.write_text(DOLPHOT)
    path.with_name(f'{path.name}.columns').write_text(DOLPHOT_COLUMNS)


def write_ldac(path, chips=1):
    hdus = [fits.PrimaryHDU()]
    for _ in range(chips):
        head = fits.Column('Field Header Card', '80A',
                           array=['SIMPLE  =                    T'])
        hdus.append(fits.BinTableHDU.from_columns([head], name='LDAC_IMHEAD'))
        columns = [fits.Column(name, '1D', array=values) for name, values in {
            'X_IMAGE': [11.25, 31.0], 'Y_IMAGE': [21.5, 41.0],
            'ERRX2_IMAGE': [1e-4, 4e-4], 'ERRY2_IMAGE': [2e-4, 4e-4],
            'ERRXY_IMAGE': [1e-5, 0.0], 'FLUX_AUTO': [1e4, 1e3],
            'FLUXERR_AUTO': [50.0, 20.0]}.items()]
        columns += [
            fits.Column('NUMBER', '1J', array=[1, 2]),
            fits.Column('VIGNET', '9E', dim='(3,3)', array=np.ones((2, 3, 3)))]
        hdus.append(fits.BinTableHDU.from_columns(columns,
                                                  name='LDAC_OBJECTS'))
    fits.HDUList(hdus).writeto(path)


def _text(content):
    return lambda path: path.write_text(content)


# Name -> the program, and what writes the file. All have two stars, the
# first at (10.25, 20.5) if the first pixel is (0, 0).
FILES = {
    'image_flc.xymq': ('hst1pass', _text(
        '11.25 21.5 -12.5 0.03\n31.0 41.0 -10.0 0.05\n')),
    'phot': ('dolphot', write_dolphot),
    'two.als': ('daophot', _text(ALS)),
    'two.coo': ('daophot', _text(COO)),
    'two.ap': ('daophot', _text(AP)),
    'iraf.als': ('daophot', _text(IRAF_ALS)),
    'keck.lis': ('starfinder', _text(LIS)),
    'stars.cat': ('sextractor', _text(ASCII_HEAD)),
    'stars.ldac': ('sextractor', write_ldac),
}
