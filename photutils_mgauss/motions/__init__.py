"""
Proper motions from the catalogues of several epochs.

`fitter` has `ProperMotionFitter`, which goes one way through the room. An
`epoch` is a table (`columns`) with its WCS, those of its `chips`, time and
observer; `detections` reads all that is asked of epochs in one pass.
`assemble` hands over one finished `Sightings`: the same star found in several
epochs (`matching`, `pairing`, `orientation`), the `baseline` of time, planes
without WCS tied to the others (`ties`), and the reference objects of a
catalogue (`references`). `prepare` makes of it what stays the same in a fit,
with what is known beforehand (`priors`). `loop` solves, judges and rejects
until nothing changes: `posing` makes of maps and masks a `problem`, which is
solved for all stars and frames at once by `joint` and `frames`, `outliers` are
detections that do not belong to their stars, `perspective` allows for stars
that come nearer,
`relative` fixes what nothing else does, `chip_maps` solves for the
`distortion` of chips, `terms` depend on magnitude, colour and row,
`error_scale` makes errors right at every magnitude, `paper_recipe` is the
recipe of the paper. `solution` is what comes back: its parts are
`propagation`, `corrected_epochs`, `tables`, `bootstrap`, and `doubts`, what
speaks against it; `membership` says which stars move together. Nothing here
knows of pixels beyond a position and its covariance.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'bootstrap_median': 'bootstrap',
    'decode_motion_flags': 'solution',
    'Epoch': 'epoch',
    'MotionSolution': 'solution',
    'ProperMotionFitter': 'fitter',
})
