"""
All stars of a crowded image together, with its background.

`photometry` has `CrowdedMixturePhotometry`; `plan` cuts the image into tiles,
`solve` takes one tile from first search to last fit: `search` finds stars on
the residual, `bright` treats saturated stars, `given` a list of the user's.
A `tile` is a `model`, stars on the mesh of `background` and the light of
`diffuse`, and the `equations` of its joint fit. `judge` tells stars from
smooth light. `stars` has the one form that stars have from list or search
to the table, and who is beside whom; `table` says what is reported of each.
`psf_loop` makes the PSF of the image's own stars, which `psf_stars` chooses,
for `own_psf`, that has `fit_crowded_psf`. `injection` has
`inject_and_recover`, artificial stars for completeness and errors. Changing
where tiles are cut must not change a star: tests hold that.

Many images of one field go the same way. Start at `many_images`: `many_plan`
cuts the sky into tiles, `many_solve` solves one, `many_search` adds up the
evidence of all images, `many_tile` has one `model` for each image and the
stars of all, `many_equations` their joint fit, `many_table` what comes out.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'CrowdedMixturePhotometry': 'photometry',
    'fit_crowded_psf': 'own_psf',
    'inject_and_recover': 'injection',
    'InjectionResult': 'injection',
    'UnfinishedTilesError': 'unfinished',
})
