"""
Proper motions from the catalogues of several epochs.

An `epoch` is a table with its WCS, time and observer; `matching` finds the
same star in several, `assemble` hands all of them over on one plane, with the
`references` of a catalogue. `joint` solves for all stars and frames at once,
`frames` and `relative` for what ties epochs together, and `loop` solves,
judges and rejects until nothing changes. `fitter` has `ProperMotionFitter`,
`solution` what it returns, `tables` and `corrected_wcs` make its parts,
`paper_recipe` is the recipe of the paper. Nothing here knows of pixels beyond
a position and its covariance.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'bootstrap_median': 'bootstrap',
    'decode_motion_flags': 'solution',
    'Epoch': 'epoch',
    'MotionSolution': 'solution',
    'ProperMotionFitter': 'fitter',
})
