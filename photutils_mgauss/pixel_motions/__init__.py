"""Positions, motions and fluxes of stars from the pixels of all epochs.

The catalogue of one epoch does not list a star that is too faint to be
detected there, so motions from catalogues miss it. Here a moving star is one
model of all images at once, and images count that do not show it by
themselves. Start at `fitter`, which has the public class. `epoch` is one image
with its place and time, `campaign` all images prepared for the fit, and
`stars` the list of stars from the user. `solve` fits stars with their
neighbours, `posterior` replaces the peak of the likelihood by its mean for
faint stars, `refine` solves for the frames with bright stars, `errors` adds
what frames and PSFs contribute to the errors, `tables` and `cutouts` are
results, and `find` searches for stars in all images together. The fit itself
is `photometry.joint_pixels`, which `fit_many` uses for stars at rest; the
frames come from `motions`.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'ImageEpoch': 'epoch',
    'PixelMotionFitter': 'fitter',
    'PixelMotionSolution': 'solution',
})
