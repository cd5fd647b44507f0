"""
Every reader and writer of files.

`psfex` reads PSFEx models and `epsfs` the ePSFs of other programs, `storage`
and `layout` write this package's own objects as tables of plain columns in
FITS and ASDF files and read them back to the last bit, `asdf_extension` is
what the asdf library needs to know; `image_layers` and `image_header` turn
image files into values, errors, flags, a WCS and a time, `tables` reads tables
of stars. All of them open files with `fits_files` and `asdf_files`, which
believe no size that a header tells, and turn whatever is wrong with a file
into the one error of `damage`; all that is written goes through `whole`, so
that a file is whole or not there. A format that a user hands in or takes home
belongs here; what is done with its numbers does not, so nothing here imports a
PSF class at the top of a module. Tags and schemas are promises to files that
exist: add versions, change none.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'PSFExModel': 'psfex',
    'read_psfex': 'psfex',
})
