"""All readers and writers of files.

`psfex` reads PSFEx models and `epsfs` the ePSFs of other programs. `storage`
and `layout` write the objects of this package as plain columns of FITS and
ASDF tables and read them back without losing a bit; `asdf_extension` registers
them with the asdf library. `image_layers` and `image_header` read images:
values, errors, flags, WCS and time. `tables` reads tables of stars. All
readers open files through `fits_files` and `asdf_files`, which check the sizes
that headers declare, and turn every fault of a file into the error of
`damage`. All writers go through `whole`, which leaves either a complete file
or none. Reading and writing belongs here, computing does not: no module here
imports a PSF class when it is imported. Tags and schemas are promises to
existing files: add versions, but never change one.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'PSFExModel': 'psfex',
    'read_psfex': 'psfex',
})
