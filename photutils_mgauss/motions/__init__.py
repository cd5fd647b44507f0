"""Proper motions from the catalogues of several epochs.

`fitter` has `ProperMotionFitter`, and data pass through the room in one
direction. An `epoch` is a table (`columns`) with its WCS or those of its
`chips`, a time and an observer; `detections` reads all epochs in one pass.
`assemble` returns one complete `Sightings`. To make it, it finds the same star
in several epochs (`matching`, `pairing`, `orientation`), checks the `baseline`
in time, ties planes without a WCS to the others (`ties`) and reads the
`references`. `prepare` computes everything that does not change during the
fit, with the `priors`. `loop` solves and rejects until nothing changes:
`posing` turns maps and masks into a `problem`, and `joint` and `frames` solve
it for all stars and frames at once. `outliers` finds detections that do not
belong to their stars, `perspective` handles stars with a radial velocity,
`relative` fixes what the data leave free, `chip_maps` solves for the
`distortion` of chips, `terms` has displacements that depend on magnitude,
colour and row, `error_scale` calibrates the errors by magnitude, and
`paper_recipe` is the recipe of the paper. `solution` is the result; its parts
are `propagation`, `corrected_epochs`, `tables`, `bootstrap` and `doubts`, the
warnings about it. `membership` separates a cluster from the field. This room
knows positions and their covariances, but no pixels.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'bootstrap_median': 'bootstrap',
    'decode_motion_flags': 'solution',
    'Epoch': 'epoch',
    'MotionSolution': 'solution',
    'ProperMotionFitter': 'fitter',
})
