"""All stars of a crowded image, fitted together with its background.

`photometry` has `CrowdedMixturePhotometry`. `plan` cuts the image into tiles
and `solve` takes one tile from the first search to the last fit: `search`
finds stars in the residual image, `bright` treats saturated stars, and `given`
reads a list of stars from the user. A `tile` consists of a `model`, the stars,
the mesh of the `background`, the light of `diffuse` sources and the
`equations` of the joint fit. `judge` tells stars from smooth light. `stars`
holds the one form that stars have between search and table, and their
neighbours; `table` makes the table of results. `own_psf` has
`fit_crowded_psf`, which makes the PSF from stars of the same image:
`psf_stars` chooses them and `psf_loop` alternates between PSF and stars.
`injection` has `inject_and_recover`, which measures completeness and errors
with artificial stars. Where tiles are cut must not change any star; tests
check that.

Many images of one field are solved in the same steps. Start at `many_images`:
`many_plan` cuts the sky into tiles, `many_solve` solves one, `many_search`
adds up the evidence of all images, `many_tile` holds one `model` for each
image and the stars of all images, `many_equations` their joint fit, and
`many_table` makes the table.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'CrowdedMixturePhotometry': 'photometry',
    'fit_crowded_psf': 'own_psf',
    'inject_and_recover': 'injection',
    'InjectionResult': 'injection',
    'UnfinishedTilesError': 'unfinished',
})
