"""
Stars fitted to the pixels of all epochs together: positions, motions, fluxes.

A catalogue of one epoch has no entry for a star that is too faint to be found
there, and a motion made of catalogues knows nothing of it. Here a star that
moves is one model of all images at once, so that images count that do not
show it by themselves. Start at `fitter`, which has the public class. `epoch`
is one image and where and when it was taken, `campaign` all of them read for
the fit, `stars` the list of stars that the user gives, `solve` the fit with
neighbours, `posterior` what stands for the peak of the likelihood of faint
stars, `refine` the frames from bright stars, `errors` what frames and PSFs add
to the errors of stars, `tables` and `cutouts` what comes out, `find` the
search for stars in the evidence of all images. The fit itself is
`photometry.joint_pixels`, which `fit_many` uses for stars at rest; frames come
from `motions`.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'ImageEpoch': 'epoch',
    'PixelMotionFitter': 'fitter',
    'PixelMotionSolution': 'solution',
})
