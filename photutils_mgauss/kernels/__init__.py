r"""
The only loops over pixels, compiled with numba.

One module a subject: `gaussian` has one Gaussian at one point, `rows` a walk
along a pixel row, `tile` and `image` patches and whole images, `grid` mixtures
at the nodes of a detector grid, and each kind of fit its own. Arrays are
float64 and C-contiguous, results go into arrays that are passed in, and
nothing is raised: the rooms above check arguments first and spread work over
threads. `jit` is the only module that names numba. Whoever adds a loop over
pixels adds it here, with the shapes of its arrays in the docstring, and lists
what other rooms may call below; they write ``kernels.NAME``.

A Gaussian of covariance :math:`\Sigma` is handed over as a row of six
numbers, *amplitude, x, y, p, s, q*: its peak value, its centre, and the
factors of its exponent when :math:`x` is conditioned on :math:`y`,

.. math::

    g = A \exp\left[-\tfrac12 \left(p\,(x - s y)^2 + q\,y^2\right)\right],
    \quad q = 1 / \Sigma_{yy},\ s = \Sigma_{xy} / \Sigma_{yy},\
    p = \Sigma_{yy} / \det\Sigma .

This form loses no digits to cancellation when the Gaussian is thin and
tilted, and it is what a walk along a pixel row needs.
"""
from photutils_mgauss.utils.lazy import hand_on

__getattr__, __dir__, __all__ = hand_on(__name__, {
    'MeshEquations': 'crowded_fit',
    'Pairs': 'crowded_fit',
    'StarEquations': 'crowded_fit',
    'joint_covariances': 'crowded_fit',
    'CovarianceScratch': 'crowded_fit',
    'mesh_sums': 'crowded_fit',
    'own_equations': 'crowded_fit',
    'pair_blocks': 'crowded_fit',
    'solve_joint': 'crowded_fit',
    'MOST_TOGETHER': 'crowded_many',
    'Blocks': 'crowded_many',
    'Evidence': 'crowded_many',
    'Phases': 'crowded_many',
    'Points': 'crowded_many',
    'Ties': 'crowded_many',
    'Together': 'crowded_many',
    'add_places': 'crowded_many',
    'advance': 'crowded_many',
    'apply_shared': 'crowded_many',
    'evidence': 'crowded_many',
    'evidence_beside': 'crowded_many',
    'flux_variances': 'crowded_many',
    'invert_places': 'crowded_many',
    'precondition_shared': 'crowded_many',
    'Fit': 'crowded_search',
    'Limits': 'crowded_search',
    'Planes': 'crowded_search',
    'Templates': 'crowded_search',
    'score': 'crowded_search',
    'score_beside': 'crowded_search',
    'BesideScratch': 'crowded_search',
    'star_quality': 'crowded_search',
    'Gaussians': 'crowded_stamps',
    'Sources': 'crowded_stamps',
    'Stamps': 'crowded_stamps',
    'WingScratch': 'crowded_stamps',
    'add_stars': 'crowded_stamps',
    'star_stamps': 'crowded_stamps',
    'turn_stamps': 'crowded_stamps',
    'FAIR_GAIN': 'descent',
    'FIRST_GROWTH': 'descent',
    'LEAST_FALL': 'descent',
    'POOR_GAIN': 'descent',
    'adapted_damping': 'descent',
    'next_damping': 'descent',
    'remainder': 'descent',
    'FieldShapes': 'field_fit',
    'FieldStars': 'field_fit',
    'FieldSums': 'field_fit',
    'field_model': 'field_fit',
    'field_normal': 'field_fit',
    'evaluate': 'gaussian',
    'evaluate_slopes': 'gaussian',
    'derivatives': 'gaussian',
    'model_rows': 'gaussian',
    'differentiate_grid': 'grid',
    'differentiate_matched': 'grid',
    'evaluate_grid': 'grid',
    'evaluate_matched': 'grid',
    'render_grid': 'grid',
    'render_matched': 'grid',
    'GroupMoments': 'groups',
    'GroupPixels': 'groups',
    'group_moments': 'groups',
    'star_scores': 'groups',
    'weigh_groups': 'groups',
    'DEPTH': 'image',
    'bleed': 'image',
    'render_epsfs': 'image',
    'render_image': 'image',
    'render_matched_image': 'image',
    'solve': 'linear',
    'adapt_to_images': 'moments',
    'adapt_to_mixtures': 'moments',
    'render': 'rows',
    'FIT_STOPPED': 'stamp_fit',
    'StampScratch': 'stamp_fit',
    'StampTarget': 'stamp_fit',
    'fit_starts': 'stamp_fit',
    'BoxScratch': 'star_normal',
    'Image': 'star_normal',
    'Tiling': 'star_normal',
    'count_pixels': 'star_normal',
    'star_derivatives': 'star_normal',
    'BAD_ERROR': 'star_fit',
    'CONVERGED': 'star_fit',
    'STALLED': 'star_fit',
    'FitScratch': 'star_fit',
    'StarFits': 'star_fit',
    'Stars': 'star_fit',
    'fit_stars': 'star_fit',
})
